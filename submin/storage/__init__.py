"""Catalogues and networks on disk."""
