"""A hash of ids that is the same on every machine and in every release: it decides, where chance would do, in the same way for ever."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FNV_OFFSET, _FNV_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)


def hash_ids(ids: NDArray[np.str_]) -> NDArray[np.uint64]:
    """64-bit FNV-1a hash (n,) of the UTF-8 bytes of each id (Fowler, Noll, Vo)."""
    if not len(ids):
        return np.empty(0, dtype=np.uint64)
    letters, lengths = _letters(ids)
    value = np.full(len(ids), _FNV_OFFSET)
    for k in range(letters.shape[1]):  # over the letters of the longest id, all ids at once
        value = np.where(lengths > k, (value ^ letters[:, k]) * _FNV_PRIME, value)
    return value


def _letters(ids: NDArray[np.str_]) -> tuple[NDArray[np.unsignedinteger], NDArray[np.integer]]:
    """UTF-8 bytes (n, longest) of each id, and their number (n,)."""
    points = np.ascontiguousarray(ids).view(np.uint32).reshape(len(ids), -1)
    if points.max(initial=0) < 128:  # letters that are one byte each
        return points, np.char.str_len(ids)
    encoded = np.char.encode(ids, "utf-8")
    return encoded.view(np.uint8).reshape(len(ids), -1), np.char.str_len(encoded)
