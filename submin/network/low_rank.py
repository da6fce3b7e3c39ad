"""A block fused into a sub-MIN by a low-rank update, or by one factorisation: whichever is cheaper.

The rays of a block change a sub-MIN in k directions, far fewer than it has parameters n. New images join with what the network says of them
already (they may share a pass with images that it has), ``theta_0`` and ``M_0``; then

    S = I + H M_0 H' = L L'      Y = L^-1 H M_0      y = L^-1 (e - H theta_0)
    theta = theta_0 + Y'y        M = M_0 - Y'Y       chi2 = chi2_0 + y'y

with H (k, n) and e (k,) what the new rays say beyond the known ones (`submin.adjustment.new_rays`). One triangle of M is updated in place
by one symmetric rank-k product. Where there are more rows than parameters touched, H is replaced by its triangular factor
(docs/mathematics.md, "Low-rank update").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from submin.adjustment.elimination import Sums
from submin.adjustment.estimation import cholesky
from submin.adjustment.images import ImageSet
from submin.adjustment.new_rays import NewRays, information_of, rows_of
from submin.adjustment.symmetric import fill_symmetric
from submin.network.cell import Cell, linear_rays
from submin.network.sub_min import SubMin, add_sums, factor

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Rows = NDArray[np.int64]

LEAST_CONDITION = 1e-6
"""Reciprocal condition of the a priori correlations by which new images are predicted from others; below it digits of the answer would go,
and the sub-MIN is factored instead."""
QR_COSTS = 1.5
"""Operations of a matrix product in the time of one of a QR factorisation, measured as the next."""
INVERSE_COSTS = 1.5
"""Operations of a matrix product in the time of one of the factorisation and inverse, measured (``python -m benchmarks sub-min``)."""
PASSES = 40.0
"""Operations that could be done in the time in which a number of the matrix is copied and mirrored."""


@dataclass(frozen=True)
class Fused:
    """A sub-MIN with a block in it.

    Attributes
    ----------
    sub_min : the state with the block
    rank : directions in which the block may change it; all, when it was factored anew
    chi_square : by how much the weighted squares grew; with the block's own redundancy as degrees of freedom
    redundancy : by how much the redundancy grew
    low_rank : False when it was factored anew
    """

    sub_min: SubMin
    rank: int
    chi_square: float
    redundancy: int
    low_rank: bool


@dataclass(frozen=True)
class InnovationRows:
    """What a block says that the state before it does not: ``innovation = design (theta - theta_0) + noise``, Cov noise = I.

    Attributes
    ----------
    parameters : (t,) places of the touched parameters in the state
    design : (k, t) H; innovation : (k,) ``e - H theta_0``
    remainder : squares that no theta explains; redundancy : number of rows before any compression
    """

    parameters: Rows
    design: Array
    innovation: Array
    remainder: float
    redundancy: int


def fuse(sub_min: SubMin, rays: NewRays, images: Index, image_set: ImageSet, sums: Callable[[], Sums]) -> Fused:
    """Fuse the new rays of one or many blocks into a sub-MIN: by a low-rank update or by one factorisation, whichever costs less.

    Measured, the update is the cheaper one up to a rank of about 0.4 of the number of parameters: of 1,000, 2,000 and 3,500 parameters one
    triplet takes 0.4, 0.1 and 0.05 of the time of the factorisation (``python -m benchmarks sub-min``; docs/mathematics.md, "Low-rank
    update"). Either way the result is that of all rays at once, whatever the order and the grouping.

    Parameters
    ----------
    sub_min : the state before; it is not changed
    rays : the new rays, with the known rays of their points, linearised as in the sums behind the sub-MIN
    images : (m,) rows of the network's images of the result, ascending: those of ``sub_min``, those that the rays touch, and others that
        are to be in it with their prior
    image_set : these images, in this order; the priors of those in ``sub_min`` are those with which it was factored
    sums : gives the summed information behind ``sub_min``, about its images; called only when it is needed

    Raises
    ------
    NumericalError
        When the information is not positive definite.
    """
    p, q = image_set.parameters, image_set.prior.shape[1]
    if _update_costs(rays.rank, len(rays.images) * p, len(images) * p) < _factor_costs(q):
        updated = update(sub_min, rays, images, image_set)
        if updated is not None:
            return updated
    return refactored(sub_min, rays, images, image_set, sums)


def refactored(sub_min: SubMin, rays: NewRays, images: Index, image_set: ImageSet, sums: Callable[[], Sums]) -> Fused:
    """The one factorisation of `fuse`, whatever it costs."""
    p = image_set.parameters
    gained = information_of(rays)
    result = factor(add_sums([(sub_min.images, sums()), (rays.images, gained)], images, p), images, image_set)
    return Fused(result, len(images) * p, result.chi_square - sub_min.chi_square, gained.redundancy, False)


def _update_costs(rows: int, touched: int, parameters: int) -> float:
    """Operations of `update`: products of k rows, the symmetric product, and what passes over the whole matrix."""
    k = min(rows, touched)
    compressed = QR_COSTS * (2.0 * rows - touched / 1.5) * touched**2 if rows > touched else 0.0
    dense = 2.0 * k * touched * (parameters + k) + k**3 / 3.0 + k**2 * parameters + k * parameters**2
    return compressed + dense + PASSES * parameters**2


def _factor_costs(whitened: int) -> float:
    """Operations of `submin.network.sub_min.factor`."""
    return INVERSE_COSTS * whitened**3 + 4.0 * PASSES * whitened**2


def update(sub_min: SubMin, rays: NewRays, images: Index, image_set: ImageSet) -> Fused | None:
    """The low-rank update of `fuse`, whatever it costs; None when the prior of new images cannot be told from the old ones without loss."""
    state = extended(sub_min, images, image_set)
    if state is None:
        return None
    p = image_set.parameters
    innovation = innovation_rows(rays, state.theta.ravel(), images, p)
    k = len(innovation.innovation)
    if not k:  # single rays, or points that no image sees
        grown = innovation.remainder
        state = replace(state, chi_square=state.chi_square + grown, redundancy=state.redundancy + innovation.redundancy)
        return Fused(state, 0, grown, innovation.redundancy, True)
    touched, m = innovation.parameters, state.covariance
    product = m[touched].T @ innovation.design.T  # (n, k): its transpose is in the order of BLAS
    s = innovation.design @ product[touched]
    s[np.diag_indices(k)] += 1.0
    lower = cholesky(s)
    y = la.blas.dtrsv(lower, innovation.innovation, lower=1)
    whitened = la.blas.dtrsm(1.0, lower, product.T, lower=1, overwrite_b=1)
    # the upper triangle of the transpose, in the order of BLAS, is the lower one of M
    la.blas.dsyrk(-1.0, whitened, beta=1.0, c=m.T, trans=1, lower=0, overwrite_c=1)
    theta = state.theta + (whitened.T @ y).reshape(-1, p)
    grown = float(innovation.remainder + y @ y)
    fused = SubMin(images, theta, fill_symmetric(m), state.chi_square + grown, state.redundancy + innovation.redundancy)
    return Fused(fused, k, grown, innovation.redundancy, True)


def innovation_rows(rays: NewRays, theta: Array, images: Index, parameters: int) -> InnovationRows:
    """What new rays say beyond a state ``theta`` (m p,) of images (rows of the network, ascending), in as few rows as that takes."""
    touched = (np.searchsorted(images, rays.images)[:, None] * parameters + np.arange(parameters)).ravel()
    design, observed, redundancy = rows_of(rays)
    innovation, t = observed - design @ theta[touched], len(touched)
    if len(innovation) <= t:
        return InnovationRows(touched, design, innovation, 0.0, redundancy)
    # Q'[H, e] with Q'Q = I says the same in t rows; the Gram matrix would say it with two digits less
    triangle = la.qr(np.column_stack([design, innovation]), mode="r", overwrite_a=True, check_finite=False)[0]
    return InnovationRows(touched, triangle[:t, :t], triangle[:t, t].copy(), float(triangle[t, t] ** 2), redundancy)


def extended(sub_min: SubMin, images: Index, image_set: ImageSet) -> SubMin | None:
    """A sub-MIN about more images, none of whose rays it has: what their prior says of them, given what the sub-MIN says of the others.

    New images are predicted from the old ones with which the a priori model couples them (one pass, one block):
    ``theta_new = T theta_R + e``, ``T = Q_nR Q_RR^-1``, ``Cov e = Q_nn - T Q_Rn``. The arrays are new in any case. None when Q_RR is too
    near to singular.
    """
    p = image_set.parameters
    at = np.searchsorted(images, sub_min.images)
    known = np.zeros(len(images), dtype=np.bool_)
    known[at] = True
    old, new = _parameters(at, p), _parameters(np.flatnonzero(~known), p)
    theta, covariance = np.zeros((len(images), p)), np.empty((len(images) * p,) * 2)
    theta[at] = sub_min.theta
    if len(old) and np.array_equal(at, np.arange(len(at))):
        covariance[: len(old), : len(old)] = sub_min.covariance
    else:
        covariance[np.ix_(old, old)] = sub_min.covariance
    if len(new):
        prior = image_set.prior
        coupled = _coupled(prior, old, new)
        own = prior[new]
        within = (own @ own.T).toarray()
        across = (own @ prior[coupled].T).toarray()
        prediction = _prediction((prior[coupled] @ prior[coupled].T).toarray(), across)
        if prediction is None:
            return None
        place = np.searchsorted(old, coupled)
        theta.reshape(-1)[new] = prediction @ sub_min.theta.ravel()[place]
        between = prediction @ sub_min.covariance[place]
        covariance[np.ix_(new, old)] = between
        covariance[np.ix_(old, new)] = between.T
        covariance[np.ix_(new, new)] = within - prediction @ across.T + between[:, place] @ prediction.T
    return SubMin(images, theta, covariance, sub_min.chi_square, sub_min.redundancy)


def _parameters(images: NDArray[np.integer], parameters: int) -> Rows:
    return np.asarray((np.asarray(images)[:, None] * parameters + np.arange(parameters)).ravel(), dtype=np.int64)


def _coupled(prior: sp.csr_array, old: Rows, new: Rows) -> Rows:
    """Those of the old parameters that the a priori factor couples with any of the new ones, directly or through one another; ascending."""
    shared = np.zeros(prior.shape[1], dtype=np.bool_)
    shared[prior[new].indices] = True
    of_old = prior[old]
    touched = np.zeros(prior.shape[1], dtype=np.bool_)
    touched[of_old.indices] = True
    shared &= touched
    if not shared.any():
        return np.empty(0, dtype=np.int64)
    rows = len(old)
    row = np.repeat(np.arange(rows), np.diff(of_old.indptr))
    size = rows + prior.shape[1]
    graph = sp.coo_array((np.ones(len(row)), (row, rows + of_old.indices)), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    return old[np.isin(label[:rows], label[rows + np.flatnonzero(shared)])]


def _prediction(within: Array, across: Array) -> Array | None:
    """``T = across within^-1`` by a Cholesky factorisation of the correlation matrix; None when that is too near to singular."""
    if not len(within):
        return np.zeros(across.shape)
    sigma = np.sqrt(np.diagonal(within))
    correlation = within / sigma[:, None] / sigma
    norm = float(np.abs(correlation).sum(axis=0).max())
    lower, info = la.lapack.dpotrf(correlation, lower=1)
    if info != 0:
        return None
    condition, _ = la.lapack.dpocon(lower, norm, uplo="L")
    if not condition > LEAST_CONDITION:
        return None
    solved, _ = la.lapack.dpotrs(lower, (across / sigma).T, lower=1)
    return np.asarray(solved.T / sigma)


def new_rays(cell: Cell, image_set: ImageSet, coming: NDArray[np.bool_]) -> NewRays:
    """Rays of a cell's images that come (m,), with the known ones of their points, at the cell's linearisation.

    ``cell`` holds both; ``image_set`` are its images, in its order.
    """
    is_new = coming[cell.rays.image]
    points = np.unique(cell.rays.point[is_new]).astype(np.int64)
    linear = linear_rays(cell, image_set, points)
    of_points = np.isin(cell.rays.point, points)
    return NewRays(
        replace(linear, image=cell.images[linear.image]), cell.rays.accepted[of_points].astype(np.float64), is_new[of_points]
    )  # fmt: skip
