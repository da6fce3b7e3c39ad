"""Control sets, and the policies that merge sub-MINs into one answer."""
