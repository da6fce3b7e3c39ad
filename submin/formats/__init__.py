"""Files of other programs, and tables."""
