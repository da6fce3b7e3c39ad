"""Cells and sub-MINs: the network in factored form."""
