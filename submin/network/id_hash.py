"""A hash of ids that is the same on every machine and in every release: it decides, where chance would do, in the same way for ever."""

from __future__ import annotations

from collections.abc import Iterable

import numba
import numpy as np
from numpy.typing import NDArray

_FNV_OFFSET, _FNV_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)
SIEVE = 64
"""Places of the sieve for each id that is looked for: as many in a hundred of all other points pass it."""
LARGEST_SIEVE = 1 << 24


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


def look_up(pieces: Iterable[tuple[NDArray[np.uint64], NDArray[np.int64]]], wanted: NDArray[np.uint64]) -> NDArray[np.int64]:
    """The value (n,) of the last entry of each wanted hash (ascending), -1 where there is none.

    Entries come in pieces, hashes (k,) and values (k,) of each, in any order of hashes.
    """
    found = np.full(len(wanted), -1, dtype=np.int64)
    sieve = np.zeros(min(1 << (SIEVE * len(wanted)).bit_length(), LARGEST_SIEVE), dtype=np.bool_)
    sieve[wanted & np.uint64(len(sieve) - 1)] = True
    for entries, values in pieces:
        _look_up(entries, values, wanted, sieve, found)
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(
    entries: NDArray[np.uint64], values: NDArray[np.int64], wanted: NDArray[np.uint64], sieve: NDArray[np.bool_], found: NDArray[np.int64]
) -> None:
    """Nearly all entries are of hashes that nobody wants, and one look at a few of their bits tells."""
    bits = np.uint64(len(sieve) - 1)
    for k in range(len(entries)):
        if sieve[entries[k] & bits]:
            at = np.searchsorted(wanted, entries[k])
            if at < len(wanted) and wanted[at] == entries[k]:
                found[at] = values[k]
