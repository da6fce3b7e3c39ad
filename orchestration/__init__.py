"""Dask, the command line, and all that a person sees."""
