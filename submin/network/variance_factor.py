"""Variance factors of a network by sensor: what the residuals of its measurements say of the sigmas that were stated for them.

Where V is the covariance of the residuals (in sigmas) when the stated sigmas are true, the squares of the residuals of group a have the
expectation ``sum_b T_ab s_b``, with s the variance factors of the groups and ``T_ab`` the sum of ``V_ij^2`` over i in a and j in b
(Helmert's variance components). With one group that is the sum of the redundancy numbers. Squares and T of tiles add, each point in the
tile whose core holds it (docs/mathematics.md, "Variance factors").
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from submin.adjustment.blunders import residuals
from submin.adjustment.elimination import LinearRays
from submin.adjustment.point_basis import gather, most_rays, orthonormal
from submin.adjustment.snooping import residual_covariance, residual_space

Array = NDArray[np.float64]
Kind = tuple[str, str]
"""Sensor and platform."""


@numba.njit(cache=True, error_model="numpy")
def _shares(
    first: NDArray[np.int64],
    image: NDArray[np.int32],
    weight: Array,
    by_ground: Array,
    by_parameters: Array,
    covariance: Array,
    group: NDArray[np.int64],
    total: Array,
) -> None:
    """Add up T (g, g) of accepted rays; ``group`` (m,) is that of each image.

    Of the covariance of residuals of different points, which is small, only its sum of squares is known, ``V_ii`` less that of the
    point's own: it is taken for that of rays of the same group.
    """
    most = most_rays(first)
    zeros = np.zeros((len(image), 2))
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot, basis, inner = np.empty((3, 3)), np.empty(3, np.int32), np.empty((2 * most, 2 * most)), np.empty((2 * most, 2 * most))
    known, product = np.empty((2 * most, 2 * most)), np.empty(2 * most)
    for j in range(len(first) - 1):
        n = gather(j, first, weight, by_ground, zeros, rays, root, b, t)
        if n == 0:
            continue
        rank = orthonormal(b, 2 * n, q, r, pivot)
        if 2 * n <= rank:
            continue
        free = residual_space(n, rays, root, image, by_parameters, q, rank, covariance, basis, known, product, inner)
        for k in range(2 * n):
            if b[k, 0] == 0.0 and b[k, 1] == 0.0 and b[k, 2] == 0.0:  # the empty row of a view along one axis
                continue
            of = group[image[rays[k // 2]]]
            left = residual_covariance(basis, inner, free, k, k)
            for i in range(2 * n):
                if b[i, 0] == 0.0 and b[i, 1] == 0.0 and b[i, 2] == 0.0:
                    continue
                square = residual_covariance(basis, inner, free, k, i) ** 2
                total[of, group[image[rays[i // 2]]]] += square
                left -= square
            total[of, of] += left


@dataclass(frozen=True, eq=False)
class Fits:
    """How measurements of some kinds of images fit.

    Attributes
    ----------
    kinds : sensor and platform of each of g kinds
    squares : (g,) sums of squared residuals in sigmas; shares : (g, g) T
    """

    kinds: tuple[Kind, ...]
    squares: Array
    shares: Array


@dataclass(frozen=True)
class VarianceFactor:
    """A posteriori variance of the measurements of one kind of image in units of the stated one; 1 within ``sigma`` when that is true.

    Attributes
    ----------
    sensor, platform : kind of image
    factor : of the variance; sigma : standard deviation of it when all stated sigmas are true, ``sqrt(2 (T^-1)_aa)``
    redundancy : sum of the redundancy numbers of its measurements
    """

    sensor: str
    platform: str
    factor: float
    sigma: float
    redundancy: float


def fits(linear: LinearRays, weight: Array, theta: Array, covariance: Array, kinds: list[Kind]) -> Fits:
    """Fits of some points' rays at a tile's estimate.

    Parameters
    ----------
    linear, weight : rays of points, weights (r,) 1 for accepted ones, 0 for all rays of points that are not to be counted
    theta, covariance : (m, p) and (m p, m p), of the tile; kinds : of each of its m images
    """
    names = sorted(set(kinds))
    group = np.array([names.index(kind) for kind in kinds], dtype=np.int64)
    squares = np.nansum(residuals(linear, weight, theta) ** 2, axis=1)
    shares = np.zeros((len(names), len(names)))
    _shares(linear.first, linear.image, weight, linear.by_ground, linear.by_parameters, covariance, group, shares)
    by_kind = np.bincount(group[linear.image], weights=squares * (weight > 0.0), minlength=len(names)).astype(np.float64)
    return Fits(tuple(names), by_kind, shares)


def pooled(parts: Iterable[Fits]) -> tuple[VarianceFactor, ...]:
    """Variance factors of the fits of all tiles; kinds whose measurements nothing checks are left out."""
    every = list(parts)
    names = sorted({kind for part in every for kind in part.kinds})
    squares, shares = np.zeros(len(names)), np.zeros((len(names), len(names)))
    for part in every:
        at = [names.index(kind) for kind in part.kinds]
        squares[at] += part.squares
        shares[np.ix_(at, at)] += part.shares
    checked = np.flatnonzero(shares.sum(axis=1) > 0.5)
    if not len(checked):
        return ()
    inverse = np.linalg.pinv(shares[np.ix_(checked, checked)], hermitian=True)
    factors, redundancy = inverse @ squares[checked], shares.sum(axis=1)[checked]
    sigma = np.sqrt(2.0 * np.clip(np.diagonal(inverse), 0.0, None))
    found = zip(checked.tolist(), factors.tolist(), sigma.tolist(), redundancy.tolist(), strict=True)
    return tuple(VarianceFactor(names[k][0], names[k][1], f, s, r) for k, f, s, r in found)
