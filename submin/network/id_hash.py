"""A hash of ids that is the same on every machine and in every release: it decides, where chance would do, in the same way for ever."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FNV_OFFSET, _FNV_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)


def hash_ids(ids: NDArray[np.str_]) -> NDArray[np.uint64]:
    """64-bit FNV-1a hash (n,) of the UTF-8 bytes of each id (Fowler, Noll, Vo)."""
    if not len(ids):
        return np.empty(0, dtype=np.uint64)
    encoded = np.char.encode(ids, "utf-8")
    width = max(encoded.dtype.itemsize, 1)
    matrix = encoded.astype(f"S{width}").view(np.uint8).reshape(len(ids), width)
    lengths = np.char.str_len(encoded)
    value = np.full(len(ids), _FNV_OFFSET)
    for k in range(width):  # over the letters of the longest id, all ids at once
        live = lengths > k
        value[live] = (value[live] ^ matrix[live, k].astype(np.uint64)) * _FNV_PRIME
    return value
