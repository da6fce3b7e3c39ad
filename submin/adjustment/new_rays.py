"""What new rays say about images, beyond what the rays that their points already have say.

A point's known rays, ``B = Q R``, say of its position ``R x = Q'(y - A theta) + noise``, noise of covariance I. Stacked on its new rays,

    [ R     ]       [ Q'y   ]   [ Q'A   ]
    [ B_new ] x  =  [ y_new ] - [ A_new ] theta + noise        = S x,   S = Q_s R_s,   N an orthonormal basis of what Q_s does not span

the rows ``N'[Q'A; A_new]`` with the observations ``N'[Q'y; y_new]`` are all that is new: information is only ever added, a difference of
sums is never formed, and D of the point, which is huge where its rays are nearly parallel, does not appear. The point may be new (no R),
pending (R has two rows) or determined; each new ray of a determined point gives two rows (docs/mathematics.md, "Low-rank update").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, Sums
from submin.adjustment.point_basis import complement, gather, most_rays, orthonormal
from submin.errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Rows = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class NewRays:
    """Rays of a block with the known rays of the same points.

    Attributes
    ----------
    linear : all rays of the points that new rays see, linearised together; ``image`` holds rows of the network's images
    weight : (r,) 0 for rejected rays, 1 for accepted ones
    new : (r,) True for the rays that come

    Raises
    ------
    InputError
        When a point is to be seen again by an image that sees it already: the block is fused already, and would count twice.
    """

    linear: LinearRays
    weight: Array
    new: Flags

    def __post_init__(self) -> None:
        point = np.repeat(np.arange(len(self.linear.first) - 1), np.diff(self.linear.first))
        ray = point * (int(self.linear.image.max(initial=0)) + 1) + self.linear.image
        twice = np.isin(ray[self.new], ray[~self.new])
        if twice.any():
            k = int(np.flatnonzero(self.new)[np.argmax(twice)])
            raise InputError(
                f"{int(twice.sum())} of {int(self.new.sum())} new rays are known already, that of point {point[k]} in image "
                f"{self.linear.image[k]} among them; expected each ray once: a block that is fused already would count twice"
            )

    @cached_property
    def images(self) -> Index:
        """Rows of the images that any accepted ray touches, ascending."""
        return np.unique(self.linear.image[self.weight > 0.0]).astype(np.int32)

    @cached_property
    def coming(self) -> Rows:
        """Accepted new rays (n,) of each point."""
        return self._by_point((self.weight > 0.0) & self.new)

    @cached_property
    def rank(self) -> int:
        """Rows that the new rays are expected to give: two each, less the directions of points that they are the first to determine."""
        known = self._by_point((self.weight > 0.0) & ~self.new)
        before, after = np.minimum(2 * known, 3), np.minimum(2 * (known + self.coming), 3)
        return int(np.where(self.coming > 0, 2 * self.coming - (after - before), 0).sum())

    @property
    def places(self) -> Rows:
        """Where (r,) the parameters of each ray's image begin among those of ``images``."""
        return np.asarray(np.searchsorted(self.images, self.linear.image) * self.linear.by_parameters.shape[2], dtype=np.int64)

    @property
    def weights(self) -> tuple[Array, Array]:
        """Weights (r,) of the known rays, 0 for new ones, and of the new rays, 0 for known ones."""
        return np.where(self.new, 0.0, self.weight), np.where(self.new, self.weight, 0.0)

    def _by_point(self, rays: Flags) -> Rows:
        points = len(self.linear.first) - 1
        return np.bincount(np.repeat(np.arange(points), np.diff(self.linear.first))[rays], minlength=points)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _work(most: int, p: int) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]:
    """Arrays for the point with most rays: see `_rows_of_point`."""
    wide = 2 * most + 3
    return (
        np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty((wide, 3)), np.empty((wide, 3)),
        np.empty(wide), np.empty((wide, wide)), np.empty((wide, most, p)), np.empty(wide),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rows_of_point(
    j: int, first: Rows, known: Array, new: Array, by_ground: Array, by_parameters: Array, y: Array,
    work: tuple[Array, Array, Array, Array, Array, Array, Array, Array], rays: Rows, root: Array, r: Array, pivot: Index,
) -> tuple[int, int, int]:  # fmt: skip
    """Rows of one point into the last two arrays of ``work``: by parameters (k, n, p) of its n ``rays``, and observed (k,).

    Returns k, n and the redundancy.
    """
    b, q, stack, span, right, basis, rows, observed = work
    p = by_parameters.shape[2]
    n = gather(j, first, new, by_ground, y, rays, root, b, right)
    if n == 0:
        return 0, 0, 0
    m = gather(j, first, known, by_ground, y, rays, root, b, right)
    rank = orthonormal(b, 2 * m, q, r, pivot) if m > 0 else 0
    for e in range(rank):
        observed[e] = 0.0
        for i in range(2 * m):
            observed[e] += q[i, e] * right[i]
        for c in range(3):
            stack[e, pivot[c]] = r[e, c]
    for e in range(rank):
        right[e] = observed[e]
    n = gather(j, first, new, by_ground, y, rays[m:], root[m:], stack[rank:], right[rank:])
    k = rank + 2 * n
    redundancy = 0
    for i in range(rank, k):  # a view along one axis only leaves the other row empty
        if stack[i, 0] == 0.0 and stack[i, 1] == 0.0 and stack[i, 2] == 0.0:
            redundancy -= 1
    spanned = orthonormal(stack, k, span, r, pivot)
    free = complement(span, spanned, k, basis) if k > spanned else 0
    for f in range(free):
        observed[f] = 0.0
        for i in range(k):
            observed[f] += basis[i, f] * right[i]
        for a in range(m + n):
            w0, w1, i = 0.0, 0.0, rays[a]
            if a < m:
                for e in range(rank):
                    w0 += basis[e, f] * q[2 * a, e]
                    w1 += basis[e, f] * q[2 * a + 1, e]
            else:
                w0, w1 = basis[rank + 2 * (a - m), f], basis[rank + 2 * (a - m) + 1, f]
            for u in range(p):
                rows[f, a, u] = root[a] * (w0 * by_parameters[i, 0, u] + w1 * by_parameters[i, 1, u])
    return free, m + n, redundancy + free if free else 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _write_rows(
    first: Rows, at: Rows, known: Array, new: Array, by_ground: Array, by_parameters: Array, y: Array, design: Array, observed: Array
) -> tuple[int, int]:
    """All rows into design (k, t) and observed (k,), which hold zeros; how many, and their redundancy."""
    p, most = by_parameters.shape[2], most_rays(first)
    work, rays, root = _work(most, p), np.empty(most, np.int64), np.empty(most)
    r, pivot = np.empty((3, 3)), np.empty(3, np.int32)
    row, redundancy = 0, 0
    for j in range(len(first) - 1):
        k, n, degrees = _rows_of_point(j, first, known, new, by_ground, by_parameters, y, work, rays, root, r, pivot)
        redundancy += degrees
        for f in range(k):
            observed[row] = work[7][f]
            for a in range(n):
                for u in range(p):
                    design[row, at[rays[a]] + u] += work[6][f, a, u]
            row += 1
    return row, redundancy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sum_rows(
    first: Rows, at: Rows, known: Array, new: Array, by_ground: Array, by_parameters: Array, y: Array, information: Array, vector: Array
) -> tuple[float, int]:  # fmt: skip
    """Sum the rows into a lower triangle (t, t) and vector (t,)."""
    p, most = by_parameters.shape[2], most_rays(first)
    work, rays, root = _work(most, p), np.empty(most, np.int64), np.empty(most)
    r, pivot = np.empty((3, 3)), np.empty(3, np.int32)
    misclosure, redundancy = 0.0, 0
    for j in range(len(first) - 1):
        k, n, degrees = _rows_of_point(j, first, known, new, by_ground, by_parameters, y, work, rays, root, r, pivot)
        redundancy += degrees
        rows, observed = work[6], work[7]
        for f in range(k):
            misclosure += observed[f] ** 2
            for a in range(n):
                to = at[rays[a]]
                for u in range(p):
                    vector[to + u] += rows[f, a, u] * observed[f]
        if k == 0:
            continue
        for a in range(n):
            to = at[rays[a]]
            for c in range(n):
                of = at[rays[c]]
                if of > to:
                    continue
                for u in range(p):
                    for v in range(u + 1 if of == to else p):
                        total = 0.0
                        for f in range(k):
                            total += rows[f, a, u] * rows[f, c, v]
                        information[to + u, of + v] += total
    return misclosure, redundancy


def rows_of(rays: NewRays) -> tuple[Array, Array, int]:
    """Rows (k, t) about the parameters of ``rays.images``, observations (k,) and redundancy.

    Whitened: ``observed = design theta + noise``, noise of covariance I, independent of everything that the known rays say.
    """
    linear, p = rays.linear, rays.linear.by_parameters.shape[2]
    most = 2 * int(rays.coming.sum())
    design, observed = np.zeros((most, len(rays.images) * p)), np.zeros(most)
    used, redundancy = _write_rows(
        linear.first, rays.places, *rays.weights, linear.by_ground, linear.by_parameters, linear.y, design, observed
    )  # fmt: skip
    return design[:used], observed[:used], int(redundancy)


def information_of(rays: NewRays) -> Sums:
    """What the new rays add to the information about ``rays.images``: sums like those of a cell, which add to them."""
    linear, size = rays.linear, len(rays.images) * rays.linear.by_parameters.shape[2]
    information, vector = np.zeros((size, size)), np.zeros(size)
    misclosure, redundancy = _sum_rows(
        linear.first, rays.places, *rays.weights, linear.by_ground, linear.by_parameters, linear.y, information, vector
    )  # fmt: skip
    return Sums(information, vector, float(misclosure), int(redundancy))
