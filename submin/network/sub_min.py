"""A sub-MIN: what the cells that a tile holds say together, in factored form.

    x_j = xbar_j + U_j theta        P_ij = delta_ij D_j + U_i M U_j'

``theta`` and M, of the images that the tile sees, come from one factorisation of the summed cells; D, U and xbar of a point come from its
own rays (docs/mathematics.md, "Factored form"). The dense covariance of all points is never formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, PointFactors, Sums, ground_corrections
from submin.adjustment.estimation import estimate_images, fill_symmetric
from submin.adjustment.images import ImageSet
from submin.network.cell import empty_sums, kept_rows, reordered

Array = NDArray[np.float64]
Index = NDArray[np.int32]

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
    """

    images: Index
    theta: Array
    covariance: Array
    chi_square: float
    redundancy: int


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
        # both index lists ascend, so a lower triangle lands in the lower triangle
        total.information[np.ix_(rows, rows)] += weight * sums.information
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
    covariance = estimate.covariance
    if not np.array_equal(rank, np.arange(len(rank))):
        at = (rank[:, None] * p + np.arange(p)).ravel()
        covariance = covariance[np.ix_(at, at)]
    return SubMin(rows, estimate.theta[rank], covariance, estimate.chi_square, sums.redundancy)


def locate(part: GroundPart, sub_min: SubMin) -> Array:
    """Geocentric coordinates (n, 3) of the part's points."""
    theta = np.zeros((int(sub_min.images.max(initial=-1)) + 1, sub_min.theta.shape[1]))
    theta[sub_min.images] = sub_min.theta
    return np.asarray(part.origin + ground_corrections(part.factors, part.linear, theta))


def loadings(parts: Sequence[GroundPart], images: Index, parameters: int) -> sp.csr_array:
    """U (3n, m p) of all points of some parts on ``images`` (rows of the network, ascending), sparse."""
    data, rows, columns = [], [], []
    shift = 0
    for part in parts:
        n = len(part.origin)
        point = shift + np.repeat(np.arange(n), np.diff(part.linear.first))
        at = np.searchsorted(images, part.linear.image)
        shape = part.factors.loading.shape
        rows.append(np.broadcast_to((3 * point[:, None] + np.arange(3))[:, :, None], shape).ravel())
        columns.append(np.broadcast_to((parameters * at[:, None] + np.arange(parameters))[:, None, :], shape).ravel())
        data.append(part.factors.loading.ravel())
        shift += n
    shape2 = (3 * shift, len(images) * parameters)
    if not data:
        return sp.csr_array(shape2)
    return sp.coo_array((np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))), shape=shape2).tocsr()


def joint_covariance(loading: sp.csr_array, own: Array, covariance: Array) -> Array:
    """``P = D + U M U'`` (3n, 3n) of n points, geocentric square metres, exactly symmetric.

    Parameters
    ----------
    loading : U (3n, q); own : D (n, 3, 3); covariance : M (q, q), both triangles
    """
    seen = np.unique(loading.indices)
    u, m = loading[:, seen], covariance[np.ix_(seen, seen)]
    if len(seen) <= DENSE_COLUMNS:
        dense = np.asfortranarray(u.toarray())
        half = la.blas.dsymm(1.0, np.asfortranarray(m), dense, side=1, lower=1)
        # U M U' = (U M/2) U' + U (M/2 U'): a rank-2k update writes one triangle in place
        joint = la.blas.dsyr2k(0.5, half, dense, lower=0).T
    else:
        joint = np.ascontiguousarray(u @ np.ascontiguousarray((u @ m).T))
    diagonal = np.arange(len(own))
    joint.reshape(len(own), 3, len(own), 3)[diagonal, :, diagonal, :] += own
    return fill_symmetric(joint)


def point_covariances(loading: sp.csr_array, own: Array, covariance: Array) -> Array:
    """Covariance (n, 3, 3) of each point by itself, without the joint matrix; arguments as in `joint_covariance`."""
    n, chunk = len(own), 2048
    covariances = own.copy()
    for start in range(0, n, chunk):
        u = loading[3 * start : 3 * min(start + chunk, n)]
        seen = np.unique(u.indices)
        rows = u[:, seen].toarray().reshape(-1, 3, len(seen))
        covariances[start : start + chunk] += (rows @ covariance[np.ix_(seen, seen)]) @ rows.transpose(0, 2, 1)
    return covariances
