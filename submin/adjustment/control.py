"""Stage 1 with control: a block adjusted by its rays, its images' a priori model, and control points with their *joint* covariance.

Control and images are known before the block's rays come, as a linear state of whitened vectors w, covariance I, and own parts d of points,

    x_j = X_j + F_j w + d_j,   Cov d_j = D_j          theta = theta_0 + T w

so the joint covariance of the control points is ``P = D + F F'``. It is never inverted: points as good as equal, or known without
error, are no special case. A dense P is factored (`covariance_factor`), D = 0; points surveyed apart have D alone; a network has both.

A block's point with rays ``y = A theta + B (x - X) + v``, ``B = Q R``, says what every free block says, ``(I - QQ') y``
(`submin.adjustment.elimination`), and where it is controlled Q' y more,

    e_j = Q'(y - A theta_0) = (Q'A T + R F_j) w + noise,   noise covariance  C_j = I + R D_j R'

which has as many rows as the rays determine directions of the point: three, or two for a single ray. These rows are the innovation of the
control; tie points have none. So stage 1 with control is stage 1 free of it plus the innovation (docs/stage-1.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from submin.adjustment.blunders import CRITICAL_RAY, TESTABLE
from submin.adjustment.elimination import LinearRays, eliminate, point_factors
from submin.adjustment.estimation import cholesky
from submin.adjustment.symmetric import fill_symmetric
from submin.errors import NumericalError

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Flags = NDArray[np.bool_]

SPANNED = 1e-12
"""A direction of a point's rays below this part of the largest gives no innovation. Ten times the round-off of the free elimination, so
that no direction can count in both."""
CHUNK_VALUES = 1 << 22
"""Numbers in the design matrix of the control points that are worked on at once: 32 MB."""
SEMI_DEFINITE = 1e-9
"""A stated correlation matrix may miss being positive semi-definite by this: the round-off of tables."""


def covariance_factor(covariance: Array) -> Array:
    """``F`` (n, q) with ``F F' = covariance`` (n, n), of its rank: pivoted Cholesky of the *correlation* matrix, rows then scaled.

    Works for singular matrices, and for such with rows of zeros; what it leaves out is round-off of the correlation matrix.

    Raises
    ------
    NumericalError
        When the covariance is not finite, or not positive semi-definite.
    """
    sigma = np.sqrt(np.clip(np.diagonal(covariance), 0.0, None))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    correlation = covariance / scale[:, None] / scale
    if not np.isfinite(correlation).all():
        raise NumericalError(f"a covariance ({len(sigma)} x {len(sigma)}) is not finite")
    if not len(sigma) or not sigma.any():
        if np.abs(correlation).max(initial=0.0) > SEMI_DEFINITE:
            raise NumericalError(f"a covariance ({len(sigma)} x {len(sigma)}) is not positive semi-definite")
        return np.zeros((len(sigma), 0))
    lower, pivot, rank, info = la.lapack.dpstrf(correlation, lower=1)
    if info < 0:
        raise NumericalError(f"a covariance ({len(sigma)} x {len(sigma)}) cannot be factored")
    factor = np.zeros((len(sigma), rank))
    factor[pivot - 1] = np.tril(lower)[:, :rank]
    if rank < len(sigma) and np.abs(correlation - factor @ factor.T).max() > SEMI_DEFINITE:
        raise NumericalError(f"a covariance ({len(sigma)} x {len(sigma)}) is not positive semi-definite")
    return np.asarray(factor * sigma[:, None])


@dataclass(frozen=True)
class ControlledPrior:
    """What is known of a block before its rays: control points and the corrections of its m images, jointly, by q whitened vectors.

    Attributes
    ----------
    point : (k,) rows of the block's points that are controlled, ascending
    position : (k, 3) geocentric, metres
    own : (k, 3, 3) D, square metres; may be singular, or zero
    loading : (k, 3, q) F, metres
    theta : (m, p) expected corrections of the images
    images : (m p, q) T
    """

    point: Rows
    position: Array
    own: Array
    loading: Array
    theta: Array
    images: Array

    @property
    def covariance(self) -> Array:
        """P (3k, 3k) of the control points."""
        flat = self.loading.reshape(-1, self.loading.shape[2])
        joint = flat @ flat.T
        k = np.arange(len(self.point))
        joint.reshape(len(k), 3, len(k), 3)[k, :, k, :] += self.own
        return np.asarray(joint)


def uncontrolled(prior: sp.csr_array, parameters: int) -> ControlledPrior:
    """No control: the a priori factor K of images with so many parameters each."""
    return surveyed(prior, parameters, np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))


def surveyed(prior: sp.csr_array, parameters: int, point: Rows, position: Array, covariance: Array) -> ControlledPrior:
    """Control points (k, 3) with a covariance (k, 3, 3) each, independent of one another and of the images."""
    q = prior.shape[1]
    theta = np.zeros((prior.shape[0] // max(parameters, 1), parameters))
    return ControlledPrior(point, position, covariance, np.zeros((len(point), 3, q)), theta, np.asarray(prior.todense()))


def correlated(prior: sp.csr_array, parameters: int, point: Rows, position: Array, covariance: Array) -> ControlledPrior:
    """Control points (k, 3) with a joint covariance (3k, 3k), point-major, independent of the images.

    Raises
    ------
    NumericalError
        When the covariance is not positive semi-definite.
    """
    factor = covariance_factor(covariance)
    k, (rows, q) = len(point), prior.shape
    loading = np.zeros((k, 3, q + factor.shape[1]))
    loading[:, :, q:] = factor.reshape(k, 3, -1)
    images = np.zeros((rows, loading.shape[2]))
    images[:, :q] = prior.todense()
    theta = np.zeros((rows // max(parameters, 1), parameters))
    return ControlledPrior(point, position, np.zeros((k, 3, 3)), loading, theta, images)


@dataclass(frozen=True)
class ControlledEstimate:
    """A block adjusted with control, at one linearisation.

    All errors are those of q vectors of covariance I and of the points' own parts: with the roots below ``Cov(theta) = R_t R_t'``,
    ``Cov(theta, x) = R_t R_x'``, ``Cov(x) = own + R_x R_x'``.

    Attributes
    ----------
    theta : (m, p) corrections; ground : (n, 3) geocentric metres, NaN for points that are not determined
    own : (n, 3, 3) square metres, NaN where not determined
    image_root : (m p, q) R_t
    chi_square, redundancy : weighted squares of all residuals, a priori model and control included, and their degrees of freedom
    statistic : (k,) by how much chi_square falls when the control of a point is left out, chi-square with ``dof`` degrees of freedom
    dof : (k,) directions in which each control point is checked by the block
    """

    theta: Array
    ground: Array
    own: Array
    image_root: Array
    chi_square: float
    redundancy: int
    statistic: Array
    dof: Rows
    _loading: sp.csr_array
    _on_images: NDArray[np.bool_]
    _control_loading: Array
    _control_of: Rows
    _factor: Array

    @cached_property
    def covariance(self) -> Array:
        """Covariance (m p, m p) of the corrections."""
        return np.asarray(self.image_root @ self.image_root.T)

    def ground_root(self, points: Rows) -> Array:
        """R_x (3 k, q) of some points (rows), metres."""
        q = len(self._factor)
        root = np.empty((len(points), 3, q))
        tie = self._on_images[points]
        rows = (3 * points[tie][:, None] + np.arange(3)).ravel()
        root[tie] = (self._loading[rows] @ self.image_root).reshape(-1, 3, q)
        controlled = self._control_loading[self._control_of[points[~tie]]]
        root[~tie] = _right_solved(controlled.reshape(-1, q), self._factor).reshape(-1, 3, q)
        return root.reshape(-1, q)

    def ground_covariance(self, points: Rows) -> Array:
        """Joint covariance (3 k, 3 k) of some points (rows), geocentric, point-major, square metres."""
        root = self.ground_root(points)
        joint = root @ root.T
        k = np.arange(len(points))
        joint.reshape(len(k), 3, len(k), 3)[k, :, k, :] += self.own[points]
        return fill_symmetric(joint)

    def outliers(self) -> Flags:
        """Control points (k,) that contradict the block as a ray contradicts its point: as rarely by chance as `CRITICAL_RAY`."""
        chance = 2.0 * float(norm.sf(CRITICAL_RAY))
        limit = np.where(self.dof > 0, chi2.isf(chance, np.maximum(self.dof, 1)), np.inf)
        return np.asarray(self.statistic > limit)


@dataclass(frozen=True)
class _Innovation:
    """Innovation rows of some control points, whitened: ``e = H w + noise``, Cov noise = I; rows of undetermined directions are zero.

    ``control`` (g,) places of the points in the prior, e (g, 3), H (g, 3, q); ``gain`` (g, 3, 3) ``D R' C^-1/2``, of the points' own parts.
    """

    control: Rows
    e: Array
    design: Array
    gain: Array
    rank: Rows


def _innovations(linear: LinearRays, weight: Array, prior: ControlledPrior, active: Flags) -> Iterator[_Innovation]:
    """Innovations of the active control points that have accepted rays, points with equally many rays together."""
    p, q = prior.theta.shape[1], prior.images.shape[1]
    by_image = prior.images.reshape(-1, p, q)
    of_point = np.full(len(linear.first) - 1, -1, dtype=np.int64)
    of_point[prior.point[active]] = np.flatnonzero(active)
    control = np.repeat(of_point, np.diff(linear.first))
    rays = np.flatnonzero((control >= 0) & (weight > 0.0))
    members, start, count = np.unique(control[rays], return_index=True, return_counts=True)
    for n in np.unique(count):
        of_size = np.flatnonzero(count == n)
        most = max(1, CHUNK_VALUES // (2 * int(n) * max(q, 1)))
        for chunk in np.split(of_size, np.arange(most, len(of_size), most)):
            row = rays[start[chunk][:, None] + np.arange(n)]
            root = np.sqrt(weight[row])[:, :, None]
            b = (root[..., None] * linear.by_ground[row]).reshape(len(chunk), 2 * n, 3)
            a = root[..., None] * linear.by_parameters[row]
            t = root * linear.y[row] - np.einsum("gncp,gnp->gnc", a, prior.theta[linear.image[row]])
            u, s, v = np.linalg.svd(b, full_matrices=False)
            spanned = s > SPANNED * s[:, :1]
            u = u * spanned[:, None, :]
            r = (s * spanned)[:, :, None] * v
            members_here = members[chunk]
            e = np.einsum("gic,gi->gc", u, t.reshape(len(chunk), 2 * n))
            split = u.reshape(len(chunk), n, 2, u.shape[2])
            design = np.zeros((len(chunk), u.shape[2], q))
            for k in range(n):  # rays of a point, a handful
                seen = np.einsum("gcd,gcp->gdp", split[:, k], a[:, k])
                design += seen @ by_image[linear.image[row[:, k]]]
            design += r @ prior.loading[members_here]
            to_own = prior.own[members_here] @ np.swapaxes(r, 1, 2)
            lower = np.asarray(np.linalg.cholesky(np.eye(u.shape[2]) + r @ to_own))
            yield _Innovation(
                members_here, np.linalg.solve(lower, e[:, :, None])[:, :, 0], np.asarray(np.linalg.solve(lower, design)),
                np.swapaxes(np.linalg.solve(lower, np.swapaxes(to_own, 1, 2)), 1, 2), spanned.sum(axis=1),
            )  # fmt: skip


def _right_solved(rows: Array, factor: Array) -> Array:
    """``rows L^-T`` (n, q) for a lower triangular L (q, q)."""
    return np.asarray(la.solve_triangular(factor, rows.T, lower=True, check_finite=False).T) if rows.size else rows.copy()


def _free(linear: LinearRays, weight: Array, prior: ControlledPrior) -> tuple[Array, Array, float, int]:
    """What the block says free of its control about w: information (q, q), vector (q,), misclosure and redundancy."""
    images, theta = prior.images, prior.theta.ravel()
    sums = eliminate(linear, weight, len(prior.theta))
    full = fill_symmetric(sums.information.copy())
    seen = full @ theta
    information = images.T @ full @ images
    information[np.diag_indices(len(information))] += 1.0
    misclosure = sums.misclosure - 2.0 * float(sums.vector @ theta) + float(theta @ seen)
    return information, images.T @ (sums.vector - seen), misclosure, sums.redundancy


def _controlled(
    linear: LinearRays,
    weight: Array,
    prior: ControlledPrior,
    active: Flags,
    information: Array,
    vector: Array,
    misclosure: float,
    redundancy: int,
) -> tuple[Array, Array, float, int]:
    """What the block says with its control: the innovation added, in place, to what `_free` has found."""
    for part in _innovations(linear, weight, prior, active):
        rows = part.design.reshape(-1, part.design.shape[2])
        information += rows.T @ rows
        vector += rows.T @ part.e.ravel()
        misclosure += float((part.e**2).sum())
        redundancy += int(part.rank.sum())
    return information, vector, misclosure, redundancy


def _minimum(information: Array, vector: Array, misclosure: float) -> tuple[Array, Array, float]:
    """Cholesky factor of an information matrix, which it replaces, estimate of the whitened vectors, and weighted squares there."""
    if not np.isfinite(vector).all():
        raise NumericalError("the block's right-hand side is not finite; a camera or a measurement is not")
    factor = cholesky(information) if len(information) else information
    w = la.cho_solve((factor, True), vector, check_finite=False) if len(factor) else vector
    return factor, w, float(misclosure - vector @ w)


def estimate(linear: LinearRays, weight: Array, prior: ControlledPrior, active: Flags, origin: Array) -> ControlledEstimate:
    """Estimate images and points of a block from its linearised rays (weights (r,): 0 for rejected ones) and its prior state.

    ``origin`` (n, 3) is that of the rays' ground coordinates, for controlled points their ``position``; ``active`` (k,) is False for
    control points that are left out, which become tie points.

    Raises
    ------
    NumericalError
        When the information is not finite or not positive definite.
    """
    information, vector, misclosure, redundancy = _controlled(linear, weight, prior, active, *_free(linear, weight, prior))
    factor, w, squares = _minimum(information, vector, misclosure)
    theta = prior.theta + (prior.images @ w).reshape(prior.theta.shape)
    return _with_ground(linear, weight, prior, active, origin, factor, w, theta, (squares, redundancy))


def _with_ground(
    linear: LinearRays, weight: Array, prior: ControlledPrior, active: Flags, origin: Array,
    factor: Array, w: Array, theta: Array, fit: tuple[float, int],
) -> ControlledEstimate:  # fmt: skip
    """The estimate with its points: tie points by their rays, controlled ones by both."""
    n, k, p = len(linear.first) - 1, len(prior.point), theta.shape[1]
    factors = point_factors(linear, weight)
    point = np.repeat(np.arange(n), np.diff(linear.first))
    rows = np.broadcast_to((3 * point[:, None] + np.arange(3))[:, :, None], factors.loading.shape)
    columns = np.broadcast_to((p * linear.image[:, None] + np.arange(p))[:, None, :], factors.loading.shape)
    loading = sp.coo_array((factors.loading.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, theta.size)).tocsr()
    ground = origin + factors.offset + (loading @ theta.ravel()).reshape(n, 3)
    ground[factors.rank < 3] = np.nan
    own = factors.own.copy()

    offset, control_own, control_loading = np.zeros((k, 3)), prior.own.copy(), prior.loading.copy()
    statistic, dof = np.zeros(k), np.zeros(k, dtype=np.int64)
    for part in _innovations(linear, weight, prior, active):
        j = part.control
        offset[j] = np.einsum("gce,ge->gc", part.gain, part.e)
        control_own[j] -= part.gain @ np.swapaxes(part.gain, 1, 2)
        control_loading[j] -= part.gain @ part.design
        flat = part.design.reshape(-1, part.design.shape[2])
        z = _right_solved(flat, factor).reshape(part.design.shape)
        spread: Array = np.eye(part.e.shape[1]) - z @ np.swapaxes(z, 1, 2)
        values, vectors = np.linalg.eigh(spread)
        residual = np.einsum("ged,ge->gd", vectors, part.e - part.design @ w)
        checked = values >= TESTABLE
        statistic[j] = np.where(checked, residual**2 / np.where(checked, values, 1.0), 0.0).sum(axis=1)
        dof[j] = checked.sum(axis=1) - (checked.shape[1] - part.rank)  # a row of zeros is no observation
    here = prior.point[active]
    ground[here] = (prior.position + offset + control_loading @ w)[active]
    own[here] = control_own[active]
    on_images = np.ones(n, dtype=np.bool_)
    on_images[here] = False
    of_point = np.full(n, -1, dtype=np.int64)
    of_point[here] = np.flatnonzero(active)
    return ControlledEstimate(
        theta, ground, own, _right_solved(prior.images, factor), *fit, statistic, dof,
        loading, on_images, control_loading, of_point, factor,
    )  # fmt: skip


@dataclass(frozen=True)
class InnovationTest:
    """Test of control points against a block, all together: ``d2 = nu' S^-1 nu``, chi-square with ``dof`` degrees of freedom.

    ``probability`` is that of a value as large when control, cameras and measurements are what their covariances say.
    """

    d2: float
    dof: int
    probability: float


def innovation_test(
    linear: LinearRays, weight: Array, prior: ControlledPrior, active: Flags, controlled: ControlledEstimate
) -> InnovationTest:
    """Test the control: by how much the weighted squares rise over those of the block free of it, which is ``nu' S^-1 nu``."""
    information, vector, misclosure, redundancy = _free(linear, weight, prior)
    _, _, squares = _minimum(information, vector, misclosure)
    return _test(controlled.chi_square - squares, controlled.redundancy - redundancy)


def innovation_of(linear: LinearRays, weight: Array, prior: ControlledPrior, active: Flags) -> InnovationTest:
    """The same test without an estimate of the points, at the linearisation of the rays."""
    information, vector, misclosure, redundancy = _free(linear, weight, prior)
    _, _, squares = _minimum(information.copy(), vector, misclosure)
    information, vector, misclosure, together = _controlled(linear, weight, prior, active, information, vector, misclosure, redundancy)
    _, _, controlled = _minimum(information, vector, misclosure)
    return _test(controlled - squares, together - redundancy)


def _test(rise: float, dof: int) -> InnovationTest:
    d2 = max(rise, 0.0)
    return InnovationTest(d2, dof, float(chi2.sf(d2, dof)) if dof else 1.0)
