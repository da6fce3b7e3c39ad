"""Overlapping tiles over an area, and the cells that they cut."""
