"""Symmetric matrices about images, kept as one triangle: permuted, added and multiplied from both sides without whole copies.

A matrix about m images has p rows an image. Everything here is bound by memory, so each kernel passes over the numbers once; what is cubic
is left to LAPACK.
"""

from __future__ import annotations

import numba
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

MIRROR_BLOCK = 64
DENSE_SIZE = 200
"""Up to so many rows a dense product costs less than looking up the few entries of a sparse factor."""
DENSE_PART = 0.05
"""So is a factor of which a larger part than this is not zero."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mirror(matrix: Array, block: int) -> None:
    size = len(matrix)
    for top in range(0, size, block):
        bottom = min(top + block, size)
        for left in range(0, top + 1, block):
            for i in range(top, bottom):
                for j in range(left, min(left + block, i)):
                    matrix[j, i] = matrix[i, j]


def fill_symmetric(lower: Array) -> Array:
    """The full symmetric matrix of a lower triangle, in place, block by block (a whole transpose would miss the cache).

    What stood above the diagonal takes no part.
    """
    _mirror(lower, MIRROR_BLOCK)
    return lower


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _permuted(lower: Array, order: Rows, p: int, out: Array) -> None:
    for a in range(len(order)):
        for b in range(a + 1):
            high, low = order[a] * p, order[b] * p
            if high >= low:
                for u in range(p):
                    for v in range(u + 1 if a == b else p):
                        out[a * p + u, b * p + v] = lower[high + u, low + v]
            else:
                for u in range(p):
                    for v in range(p):
                        out[a * p + u, b * p + v] = lower[low + v, high + u]


def permuted(lower: Array, order: NDArray[np.integer], parameters: int) -> Array:
    """Lower triangle about the same images in another order: image k of the result is image ``order[k]``. Zeros above the diagonal."""
    out = np.zeros(lower.shape)
    _permuted(lower, np.asarray(order, dtype=np.int64), parameters, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_into(total: Array, lower: Array, at: Rows, p: int, weight: float) -> None:
    for a in range(len(at)):
        for u in range(p):
            row, of = total[at[a] * p + u], lower[a * p + u]
            for b in range(a + 1):
                to, start = at[b] * p, b * p
                for v in range(u + 1 if a == b else p):
                    row[to + v] += weight * of[start + v]


def add_into(total: Array, lower: Array, at: NDArray[np.integer], parameters: int, weight: float = 1.0) -> None:
    """Add ``weight`` times a lower triangle about some images to one about more of them, in place.

    ``at`` are their places in ``total``, ascending: so what is below the diagonal stays below.
    """
    _add_into(total, lower, np.asarray(at, dtype=np.int64), parameters, weight)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _between(first: Rows, column: NDArray[np.int32], value: Array, full: Array, out: Array) -> None:
    row = np.empty(len(full))
    for i in range(len(first) - 1):
        row[:] = 0.0
        for a in range(first[i], first[i + 1]):
            of, weight = full[column[a]], value[a]
            for j in range(len(row)):
                row[j] += weight * of[j]
        for j in range(i + 1):
            total = 0.0
            for b in range(first[j], first[j + 1]):
                total += value[b] * row[column[b]]
            out[i, j] = total


def between(factor: sp.csr_array, full: Array, *, transposed: bool = False) -> Array:
    """``C X C'``, both triangles, of a factor C with few entries and a symmetric X (both triangles); ``transposed``: ``C' X C``.

    Row by row, so there is no matrix in between; the entries of C are few (a parameter's own vector and one of its pass).
    """
    n, q = factor.shape
    if max(n, q) <= DENSE_SIZE or factor.nnz > DENSE_PART * n * q:
        dense = factor.toarray().T if transposed else factor.toarray()
        return fill_symmetric(np.asarray(dense @ full @ dense.T))
    rows = factor.T.tocsr() if transposed else factor
    out = np.empty((rows.shape[0], rows.shape[0]))
    _between(rows.indptr.astype(np.int64), rows.indices.astype(np.int32), rows.data, full, out)
    return fill_symmetric(out)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _transposed_times(first: NDArray[np.int32], column: NDArray[np.int32], value: Array, vector: Array, out: Array) -> None:
    for i in range(len(vector)):
        for a in range(first[i], first[i + 1]):
            out[column[a]] += value[a] * vector[i]


def transposed_times(factor: sp.csr_array, vector: Array) -> Array:
    """``C' x`` (q,) of a factor C (n, q) with few entries and a vector (n,), without a transposed factor."""
    out = np.zeros(factor.shape[1])
    _transposed_times(factor.indptr.astype(np.int32), factor.indices.astype(np.int32), factor.data, vector, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pack(lower: Array, out: Array) -> None:
    k = 0
    for i in range(len(lower)):
        for j in range(i + 1):
            out[k] = lower[i, j]
            k += 1


def packed(lower: Array) -> Array:
    """Lower triangle (n (n + 1) / 2,), row by row, of a matrix (n, n); what stands above the diagonal takes no part."""
    out = np.empty(len(lower) * (len(lower) + 1) // 2)
    _pack(lower, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unpack(values: Array, out: Array) -> None:
    k = 0
    for i in range(len(out)):
        for j in range(i + 1):
            out[i, j] = values[k]
            k += 1


def unpacked(values: Array) -> Array:
    """Lower triangular matrix (n, n) of `packed`; zeros above the diagonal."""
    size = (int(np.sqrt(8 * values.size + 1)) - 1) // 2
    out = np.zeros((size, size))
    _unpack(values, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_packed(total: Array, values: Array, at: Rows) -> None:
    k = 0
    for i in range(len(at)):
        for j in range(i + 1):
            if at[i] >= at[j]:
                total[at[i], at[j]] += values[k]
            else:
                total[at[j], at[i]] += values[k]
            k += 1


def add_packed(total: Array, values: Array, at: NDArray[np.integer]) -> None:
    """Add a packed lower triangle to rows and columns ``at``, in any order, of the lower triangle of a larger one, in place."""
    _add_packed(total, values, np.asarray(at, dtype=np.int64))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take(values: Array, at: Rows, out: Array) -> None:
    for i in range(len(at)):
        for j in range(i + 1):
            high, low = max(at[i], at[j]), min(at[i], at[j])
            out[i, j] = out[j, i] = values[high * (high + 1) // 2 + low]


def taken(values: Array, at: NDArray[np.integer]) -> Array:
    """Rows and columns ``at`` (k,), in any order, of a packed symmetric matrix, both triangles (k, k)."""
    out = np.empty((len(at), len(at)))
    _take(values, np.asarray(at, dtype=np.int64), out)
    return out
