"""Numbers of texts: what `numpy.unique` with its inverse gives, without sorting all of them."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

LETTERS = 32
"""Texts of so many letters, of one byte each, are numbered by their bytes, eight in a word: words sort several times faster than texts."""


def numbered(texts: NDArray[np.str_]) -> tuple[NDArray[np.str_], NDArray[np.int64]]:
    """The different ones (n,) of some texts (r,), ascending, and the place (r,) of each text among them.

    Only the different ones are sorted: rays name each point several times.
    """
    if not len(texts):
        return np.unique(texts), np.empty(0, dtype=np.int64)
    letters = np.ascontiguousarray(texts).view(np.uint32).reshape(len(texts), -1)
    if letters.shape[1] <= LETTERS and letters.max(initial=0) < 128:
        return _numbered_words(texts, letters)
    encoded = pa.array(texts, type=pa.large_string()).dictionary_encode()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.combine_chunks()
    order = pc.sort_indices(encoded.dictionary).to_numpy()  # UTF-8 sorts as code points do
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    different = encoded.dictionary.take(pa.array(order)).to_numpy(zero_copy_only=False)
    return np.asarray(different, dtype=np.str_), place[encoded.indices.to_numpy()]


def _numbered_words(texts: NDArray[np.str_], letters: NDArray[np.uint32]) -> tuple[NDArray[np.str_], NDArray[np.int64]]:
    padded = np.zeros((len(texts), -(-letters.shape[1] // 8) * 8), dtype=np.uint8)
    padded[:, : letters.shape[1]] = letters
    first, place = np.zeros(1, dtype=np.int64), np.zeros(len(texts), dtype=np.int64)
    for word in padded.view(">u8").astype(np.uint64).T:
        if (word != word[0]).any():  # ids begin alike
            by_word = _ranked(word)
            # among texts that are alike so far this word decides; places are below 2**31
            first, place = by_word if len(first) == 1 else _ranked((place << 32) | by_word[1])
    return texts[first], place


def _ranked(values: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """One row (n,) of each of the different values, ascending, and the place (r,) of each value among them."""
    order = np.argsort(values)
    ordered = values[order]
    begins = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    place = np.empty(len(values), dtype=np.int64)
    place[order] = np.cumsum(begins) - 1
    return order[begins], place
