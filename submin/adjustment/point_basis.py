"""The directions in which a point's rays see it: an orthonormal basis of its stacked, whitened partials.

Compiled helpers that the kernels of `submin.adjustment.elimination` and `submin.adjustment.blunders` share. A point with n accepted rays
has 2n rows; arrays are allocated once, for the point with most rays.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Offsets = NDArray[np.int64]

ROUND_OFF = 1e-13
"""A direction of B below this part of the largest one is round-off."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def orthonormal(b: Array, k: int, q: Array, r: Array, pivot: Index) -> int:
    """Pivoted Gram-Schmidt, each step done twice, of the first k rows of b (k, 3): q (k, 3), r (3, 3) upper.

    ``pivot`` becomes the order of the columns. Returns the rank.
    """
    for c in range(3):
        pivot[c] = c
        for i in range(k):
            q[i, c] = b[i, c]
        for d in range(3):
            r[c, d] = 0.0
    largest = 0.0
    for c in range(3):
        best, best_norm = c, -1.0
        for d in range(c, 3):
            norm = 0.0
            for i in range(k):
                norm += q[i, d] * q[i, d]
            if norm > best_norm:
                best, best_norm = d, norm
        if best != c:
            pivot[c], pivot[best] = pivot[best], pivot[c]
            for i in range(k):
                q[i, c], q[i, best] = q[i, best], q[i, c]
            for i in range(c):
                r[i, c], r[i, best] = r[i, best], r[i, c]
        for e in range(c):  # second pass against the directions already found
            dot = 0.0
            for i in range(k):
                dot += q[i, e] * q[i, c]
            r[e, c] += dot
            for i in range(k):
                q[i, c] -= dot * q[i, e]
        norm = 0.0
        for i in range(k):
            norm += q[i, c] * q[i, c]
        norm = np.sqrt(norm)
        if c == 0:
            largest = norm
        if not norm > ROUND_OFF * largest:
            return c
        r[c, c] = norm
        for i in range(k):
            q[i, c] /= norm
        for d in range(c + 1, 3):
            dot = 0.0
            for i in range(k):
                dot += q[i, c] * q[i, d]
            r[c, d] = dot
            for i in range(k):
                q[i, d] -= dot * q[i, c]
    return 3


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather(j: int, first: Offsets, weight: Array, by_ground: Array, y: Array, rays: Offsets, root: Array, b: Array, t: Array) -> int:
    """Collect the accepted rays of point j: their rows, square roots of weights, stacked B and y. Returns their number."""
    n = 0
    for i in range(first[j], first[j + 1]):
        if weight[i] > 0.0:
            rays[n], root[n] = i, np.sqrt(weight[i])
            for c in range(2):
                t[2 * n + c] = root[n] * y[i, c]
                for d in range(3):
                    b[2 * n + c, d] = root[n] * by_ground[i, c, d]
            n += 1
    return n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def most_rays(first: Offsets) -> int:
    """Largest number of rays of a point, at least one."""
    most = 1
    for j in range(len(first) - 1):
        most = max(most, first[j + 1] - first[j])
    return most


@numba.njit(cache=True, nogil=True, error_model="numpy")
def by_images(first: Offsets, image: Index, weight: Array) -> Offsets:
    """The points (n,) in an order in which those with accepted rays in the same images come together, where the first of them stood.

    So the order depends neither on how images are numbered nor on rejected rays. Groups whose hashes collide are mixed.
    """
    points, mask = len(first) - 1, np.uint64(1)
    while mask < 2 * points:
        mask *= np.uint64(2)
    slot, mask = np.full(mask, -1, np.int64), mask - np.uint64(1)
    group, kinds, count = np.empty(points, np.int64), np.empty(points, np.uint64), np.zeros(points + 1, np.int64)
    groups = 0
    for j in range(points):
        kind = np.uint64(0)
        for i in range(first[j], first[j + 1]):
            if not weight[i] > 0.0:
                continue
            kind = (kind ^ np.uint64(image[i] + 1)) * np.uint64(0x9E3779B97F4A7C15)
            kind ^= kind >> np.uint64(29)
        at = kind & mask
        while slot[at] >= 0 and kinds[slot[at]] != kind:
            at = (at + np.uint64(1)) & mask
        if slot[at] < 0:
            slot[at], kinds[groups] = groups, kind
            groups += 1
        group[j] = slot[at]
        count[group[j] + 1] += 1
    for g in range(groups):
        count[g + 1] += count[g]
    order = np.empty(points, np.int64)
    for j in range(points):
        order[count[group[j]]] = j
        count[group[j]] += 1
    return order


@numba.njit(cache=True, nogil=True, error_model="numpy")
def same_images(n: int, rays: Offsets, image: Index, count: int, seen: Index) -> bool:
    """True when a point's n rays are in the images ``seen`` (count), in this order."""
    same = n == count
    for a in range(n):
        same = same and image[rays[a]] == seen[a]
    return same


@numba.njit(cache=True, nogil=True, error_model="numpy")
def complement(q: Array, rank: int, k: int, basis: Array) -> int:
    """Orthonormal basis (k, k - rank) of all that q (k, rank) does not span, Gram-Schmidt done twice. Returns the number of its columns."""
    for m in range(k - rank):
        axis, most = 0, -1.0  # the axis that has most left to say
        for i in range(k):
            left = 1.0
            for e in range(rank):
                left -= q[i, e] * q[i, e]
            for e in range(m):
                left -= basis[i, e] * basis[i, e]
            if left > most:
                axis, most = i, left
        for i in range(k):
            basis[i, m] = 1.0 if i == axis else 0.0
        for _ in range(2):
            for e in range(rank + m):
                dot = 0.0
                for i in range(k):
                    dot += (q[i, e] if e < rank else basis[i, e - rank]) * basis[i, m]
                for i in range(k):
                    basis[i, m] -= dot * (q[i, e] if e < rank else basis[i, e - rank])
        norm = 0.0
        for i in range(k):
            norm += basis[i, m] * basis[i, m]
        norm = np.sqrt(norm)
        for i in range(k):
            basis[i, m] /= norm
    return k - rank


@numba.njit(cache=True, nogil=True, error_model="numpy")
def remove_ground(q: Array, rank: int, k: int, t: Array) -> None:
    """Project the first k numbers of t onto what the point cannot explain, ``(I - QQ')t``, in place."""
    for e in range(rank):
        dot = 0.0
        for i in range(k):
            dot += q[i, e] * t[i]
        for i in range(k):
            t[i] -= dot * q[i, e]
