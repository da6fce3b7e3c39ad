"""A sub-MIN: what the cells that a tile holds say together, in factored form.

    x_j = xbar_j + U_j theta        P_ij = delta_ij D_j + U_i M U_j'

``theta`` and M, of the images that the tile sees, come from one factorisation of the summed cells; D, U and xbar of a point come from its
own rays (docs/mathematics.md, "Factored form"). The dense covariance of all points is never formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, PointFactors, Sums, ground_corrections, point_covariances
from submin.adjustment.estimation import covariance_of, estimate_images
from submin.adjustment.images import ImageSet
from submin.adjustment.symmetric import add_into, fill_symmetric
from submin.network.cell import empty_sums, kept_rows, reordered

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Rows = NDArray[np.int64]

DENSE_COLUMNS = 600
"""Up to so many image parameters a dense product beats a sparse one (a point sees few images, but BLAS is ten times faster a number)."""


@dataclass(frozen=True)
class SubMin:
    """A posteriori state of the images of a tile, or of several tiles together.

    Attributes
    ----------
    images : (m,) rows of the network's images, ascending
    theta : (m, p) their corrections
    covariance : (m p, m p) M, both triangles
    chi_square : weighted squares of residuals, a priori model included
    redundancy : degrees of freedom of ``chi_square``
    whole : True when it is that of the whole network
    behind : rows of all images that the state comes from, where ``images`` are some of them; None: the same
    """

    images: Index
    theta: Array
    covariance: Array
    chi_square: float
    redundancy: int
    whole: bool = False
    behind: Index | None = None


@dataclass(frozen=True)
class CombinedState:
    """Corrections (m, p) of images (rows, ascending), and the covariance (n, n) of combinations of them, as the whole network has them.

    ``whole``: nothing of the network has changed since it was reconciled.
    """

    images: Index
    theta: Array
    covariance: Array
    whole: bool


def wider(sub_min: SubMin, parameters: int) -> SubMin:
    """The sub-MIN with so many parameters an image: what is added is zero, and known to be."""
    images, old = sub_min.theta.shape
    if old == parameters:
        return sub_min
    rows = kept_rows(images, old, parameters)
    theta, covariance = np.zeros((images, parameters)), np.zeros((images * parameters, images * parameters))
    theta[:, :old] = sub_min.theta
    covariance[np.ix_(rows, rows)] = sub_min.covariance
    return replace(sub_min, theta=theta, covariance=covariance)


def marginal(sub_min: SubMin, images: Index) -> SubMin:
    """The sub-MIN of those of its images that are among ``images`` (rows of the network) alone."""
    chosen, p = np.flatnonzero(np.isin(sub_min.images, images)), sub_min.theta.shape[1]
    if len(chosen) == len(sub_min.images):
        return sub_min
    rows = (chosen[:, None] * p + np.arange(p)).ravel()
    return replace(
        sub_min, images=sub_min.images[chosen], theta=sub_min.theta[chosen], covariance=sub_min.covariance[np.ix_(rows, rows)]
    )  # fmt: skip


@dataclass(frozen=True)
class GroundPart:
    """Ground points of one cell, ready to be located by any estimate of the images.

    Attributes
    ----------
    origin : (n, 3) registered positions, geocentric metres
    linear : their rays, linearised; ``image`` holds rows of the network's images
    factors : own parts and loadings
    """

    origin: Array
    linear: LinearRays
    factors: PointFactors


def add_sums(parts: Sequence[tuple[Index, Sums]], images: Index, parameters: int, weights: Sequence[float] | None = None) -> Sums:
    """Sum of the information of several cells, each about its own images, about ``images`` (rows of the network, ascending).

    ``weights`` (one a cell, default 1) scale a cell's information, as Covariance Intersection does.
    """
    total = empty_sums(len(images), parameters)
    misclosure, redundancy = 0.0, 0
    for k, (of_cell, sums) in enumerate(parts):
        weight = 1.0 if weights is None else weights[k]
        at = np.searchsorted(images, of_cell)
        rows = (at[:, None] * parameters + np.arange(parameters)).ravel()
        add_into(total.information, sums.information, at, parameters, weight)
        total.vector[rows] += weight * sums.vector
        misclosure += weight * sums.misclosure
        redundancy += sums.redundancy
    return Sums(total.information, total.vector, misclosure, redundancy)


def factor(sums: Sums, rows: Index, images: ImageSet) -> SubMin:
    """The sub-MIN of summed cells: ``images`` are the network's images of ``rows``, in this order.

    Raises
    ------
    NumericalError
        When the information is not positive definite.
    """
    # in the order of the ids: the rows tell when an image came, which must leave no trace
    by_id = np.argsort(np.array(images.ids, dtype=np.str_))
    rank, p = np.argsort(by_id), images.parameters
    estimate = estimate_images(reordered(sums, by_id, p), images.take(by_id).prior, p)
    at = (rank[:, None] * p + np.arange(p)).ravel()
    # the estimate ends here, so its factor may become the inverse, and rows of K in the order of the rows need no other permutation
    covariance = covariance_of(estimate.factor, sp.csr_array(estimate.prior[at]))
    return SubMin(rows, estimate.theta[rank], covariance, estimate.chi_square, sums.redundancy)


def locate(part: GroundPart, sub_min: SubMin | CombinedState) -> Array:
    """Geocentric coordinates (n, 3) of the part's points."""
    theta = np.zeros((int(sub_min.images.max(initial=-1)) + 1, sub_min.theta.shape[1]))
    theta[sub_min.images] = sub_min.theta
    return np.asarray(part.origin + ground_corrections(part.factors, part.linear, theta))


def loadings(parts: Sequence[GroundPart], images: Index, parameters: int) -> sp.csr_array:
    """U (3n, m p) of all points of some parts on ``images`` (rows of the network, ascending), sparse."""
    shape = (3 * sum(len(part.origin) for part in parts), len(images) * parameters)
    if not parts:
        return sp.csr_array(shape)
    data, columns, lengths = [], [], []
    for part in parts:
        first = part.linear.first
        at = np.searchsorted(images, part.linear.image)
        values, places = _by_coordinate(first, at, part.factors.loading)
        data.append(values)
        columns.append(places)
        lengths.append(np.repeat(np.diff(first) * parameters, 3))
    offsets = np.concatenate([[0], np.cumsum(np.concatenate(lengths))])
    small = offsets[-1] <= np.iinfo(np.int32).max
    return sp.csr_array((np.concatenate(data), np.concatenate(columns), offsets.astype(np.int32 if small else np.int64)), shape=shape)


@numba.njit(cache=True, error_model="numpy")
def _by_coordinate(first: Rows, at: Rows, loading: Array) -> tuple[Array, Index]:
    """Loadings (r, 3, p) by ray, put by coordinate of each point: values, and columns where the rays' images begin at ``at`` (r,)."""
    p = loading.shape[2]
    values, columns = np.empty(loading.size), np.empty(loading.size, np.int32)
    k = 0
    for j in range(len(first) - 1):
        for c in range(3):
            for i in range(first[j], first[j + 1]):
                for u in range(p):
                    values[k], columns[k] = loading[i, c, u], at[i] * p + u
                    k += 1
    return values, columns


def joint_covariance(loading: sp.csr_array, own: Array, covariance: Array) -> Array:
    """``P = D + U M U'`` (3n, 3n) of n points, geocentric square metres, exactly symmetric.

    Parameters
    ----------
    loading : U (3n, q); own : D (n, 3, 3); covariance : M (q, q), both triangles
    """
    return with_own_parts(_seen_through(loading, covariance), own)


def with_own_parts(joint: Array, own: Array) -> Array:
    """`joint_covariance` where the lower triangle of ``U M U'`` (3n, 3n) is known; it is overwritten."""
    diagonal = np.arange(len(own))
    joint.reshape(len(own), 3, len(own), 3)[diagonal, :, diagonal, :] += own
    return fill_symmetric(joint)


def _seen_through(loading: sp.csr_array, covariance: Array) -> Array:
    """``U M U'``, its lower triangle at least."""
    seen = np.unique(loading.indices)
    u, m = loading[:, seen], covariance[np.ix_(seen, seen)]
    if len(seen) <= DENSE_COLUMNS:
        dense = np.asfortranarray(u.toarray())
        half = la.blas.dsymm(1.0, np.asfortranarray(m), dense, side=1, lower=1)
        # U M U' = (U M/2) U' + U (M/2 U'): a rank-2k update writes one triangle in place
        return np.asarray(la.blas.dsyr2k(0.5, half, dense, lower=0).T)
    return np.ascontiguousarray(u @ np.ascontiguousarray((u @ m).T))


def covariances_of(part: GroundPart, sub_min: SubMin) -> Array:
    """Covariance (n, 3, 3) of each of the part's points by itself, geocentric square metres."""
    at = np.searchsorted(sub_min.images, part.linear.image).astype(np.int32)
    return point_covariances(part.linear.first, at, part.factors, sub_min.covariance)
