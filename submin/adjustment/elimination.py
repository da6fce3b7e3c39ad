"""Elimination of ground points from their rays, orthogonally, and what is left for the images.

A point's whitened, linearised rays are ``y = A theta + B (x - x0) + v``, ``Cov v = I`` (all its rays stacked). With an orthonormal basis
Q of the columns of B, ``B = Q R``:

    information left about the images   G = A'(I - QQ')A,  h = A'(I - QQ')y,  f = y'(I - QQ')y
    own part of the point               D = (R'R)^-1,  U = -R^-1 Q'A,  xbar = x0 + R^-1 Q'y

so that, given an estimate of the images, ``x = xbar + U theta`` and ``P_ij = delta_ij D_j + U_i M U_j'`` (docs/mathematics.md,
"Sources"). Q spans every direction above round-off; a weak direction is never dropped, because that would keep information that is not
there. A single ray leaves ``G = 0``: the point is pending.

Only the lower triangle of the images' information is written.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.point_basis import by_images, gather, most_rays, orthonormal, remove_ground, same_images
from submin.adjustment.rays import Rays

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Offsets = NDArray[np.int64]

FITTED_SIGMAS = 5.0
"""A residual that is no larger may be an error of measurement. Where rays are judged that of an accepted one is smaller."""


@dataclass(frozen=True)
class LinearRays:
    """Rays linearised at one state of images and ground, divided by their sigmas.

    Attributes
    ----------
    first : (n + 1,) offsets of each point's rays
    image : (r,) row of each ray's image
    by_ground : (r, 2, 3) B, per metre
    by_parameters : (r, 2, p) A, per unit of each parameter
    y : (r, 2) reduced observations, ``(observed - f(theta*, x*) + A* theta* + B* (x* - x0)) / sigma``
    """

    first: Offsets
    image: Index
    by_ground: Array
    by_parameters: Array
    y: Array


@dataclass(frozen=True)
class Sums:
    """Information that rays hold about m images of p parameters: the state of a cell. Sums over disjoint points add.

    Attributes
    ----------
    information : (m p, m p), lower triangle of ``sum G_j``
    vector : (m p,) ``sum h_j``
    misclosure : ``sum f_j``
    redundancy : number of observations less the number of ground coordinates that they determine
    """

    information: Array
    vector: Array
    misclosure: float
    redundancy: int


@dataclass(frozen=True)
class PointFactors:
    """Own part and loadings of ground points.

    Attributes
    ----------
    rank : (n,) directions of the point that its rays determine; 3 for a determined point
    offset : (n, 3) ``xbar - x0``, metres (0 where rank < 3)
    own : (n, 3, 3) D, square metres (NaN where rank < 3)
    loading : (r, 3, p) U by ray: metres per unit of the ray's image's parameters (0 for rejected rays and where rank < 3)
    """

    rank: NDArray[np.int64]
    offset: Array
    own: Array
    loading: Array


def linearise(images: ImageSet, rays: Rays, theta: Array, linearised_at: Array, origin: Array) -> LinearRays:
    """Linearise rays at image corrections ``theta`` (m, p) and ground positions ``linearised_at`` (n, 3).

    ``origin`` (n, 3) is the fixed origin of each point's coordinates. A drift is that of the fitted coordinates (docs/decisions/018): the
    measured ones less their residual here, if that may be an error of measurement (`FITTED_SIGMAS`), else the measured ones.
    """
    ground = images.ground(linearised_at)
    seen = images.project(theta, ground, rays.image, rays.point, rays.observed)
    # the arrays of the projection become those of the rays
    y = _whiten(
        seen.image, seen.by_ground, seen.by_parameters, rays.observed, rays.sigma, rays.image, rays.point, theta, linearised_at - origin,
        images.drifts.of, images.drifts.axis, images.drifts.by_pixel,
    )  # fmt: skip
    return LinearRays(rays.first(len(origin)), rays.image, seen.by_ground, seen.by_parameters, y)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _whiten(
    seen: Array,
    by_ground: Array,
    by_parameters: Array,
    observed: Array,
    sigma: Array,
    image: Index,
    point: Index,
    theta: Array,
    shift: Array,
    drift_of: Index,
    drift_axis: Index,
    drift_by_pixel: Array,
) -> Array:
    """Divide partials by the sigmas of their coordinates, in place, and reduce the observations to ``y`` (r, 2).

    Drifts, here those of the measured coordinates, become those of the fitted ones; ``y`` is the same with both.
    """
    y, residual = np.empty(seen.shape), np.empty(2)
    for r in range(len(seen)):
        m = image[r]
        fits = True
        for c in range(2):
            residual[c] = observed[r, c] - seen[r, c]
            fits = fits and abs(residual[c]) <= FITTED_SIGMAS * sigma[r, c]
        for c in range(2):
            whole, part = residual[c], 1.0 / sigma[r, c]
            for u in range(by_parameters.shape[2]):
                whole += by_parameters[r, c, u] * theta[m, u]
            for u in range(by_parameters.shape[2] if fits else 0):
                if drift_of[m, u] >= 0:
                    along = drift_axis[m, u]
                    by_parameters[r, c, u] -= by_parameters[r, c, drift_of[m, u]] * drift_by_pixel[m, along] * residual[along]
            for u in range(by_parameters.shape[2]):
                by_parameters[r, c, u] *= part
            for k in range(3):
                whole += by_ground[r, c, k] * shift[point[r], k]
                by_ground[r, c, k] *= part
            y[r, c] = whole * part
    return y


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _spread(seen: Index, n: int, p: int, local: Array, information: Array) -> None:
    """Add the lower triangle ``local`` about the n images ``seen`` to that about all; zero it."""
    for a in range(n):
        for s in range(a + 1):
            at, to = seen[a] * p, seen[s] * p
            for u in range(p):
                for v in range(u + 1 if a == s else p):
                    part = local[a * p + u, s * p + v]
                    local[a * p + u, s * p + v] = 0.0
                    if at + u >= to + v:
                        information[at + u, to + v] += part
                    else:
                        information[to + v, at + u] += part
                    if at == to and a != s and u == v:  # two rays of a point in one image
                        information[at + u, to + v] += part


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _eliminate(
    first: Offsets, image: Index, weight: Array, by_ground: Array, by_parameters: Array, y: Array, information: Array, vector: Array
) -> tuple[float, int]:
    p = by_parameters.shape[2]
    most = most_rays(first)
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot, z = np.empty((3, 3)), np.empty(3, np.int32), np.empty((3, most * p))
    local, seen, count = np.zeros((most * p, most * p)), np.empty(most, np.int32), 0
    misclosure, redundancy = 0.0, 0
    # points that the same images see come together: what they say is summed in the cache, and spread once
    for j in by_images(first, image, weight):
        n = gather(j, first, weight, by_ground, y, rays, root, b, t)
        if n == 0:
            continue
        rank = orthonormal(b, 2 * n, q, r, pivot)
        if 2 * n <= rank:
            continue
        redundancy += 2 * n - rank
        for i in range(2 * n):  # a view along one axis only leaves the other row empty
            if b[i, 0] == 0.0 and b[i, 1] == 0.0 and b[i, 2] == 0.0:
                redundancy -= 1
        remove_ground(q, rank, 2 * n, t)
        for i in range(2 * n):
            misclosure += t[i] * t[i]
        if not same_images(n, rays, image, count, seen):
            _spread(seen, count, p, local, information)
            count = n
            for a in range(n):
                seen[a] = image[rays[a]]
        for e in range(rank, 3):
            z[e, : n * p] = 0.0
        for a in range(n):
            i = rays[a]
            at, to = image[i] * p, a * p
            for u in range(p):
                a0, a1 = root[a] * by_parameters[i, 0, u], root[a] * by_parameters[i, 1, u]
                vector[at + u] += a0 * t[2 * a] + a1 * t[2 * a + 1]
                for e in range(rank):
                    z[e, to + u] = q[2 * a, e] * a0 + q[2 * a + 1, e] * a1
                for v in range(u + 1):
                    local[to + u, to + v] += root[a] * (a0 * by_parameters[i, 0, v] + a1 * by_parameters[i, 1, v])
        for i in range(n * p):
            row, z0, z1, z2 = local[i], z[0, i], z[1, i], z[2, i]
            for k in range(i + 1):
                row[k] -= z0 * z[0, k] + z1 * z[1, k] + z2 * z[2, k]
    _spread(seen, count, p, local, information)
    return misclosure, redundancy


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _point_factors(
    first: Offsets, weight: Array, by_ground: Array, by_parameters: Array, y: Array
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    points, p = len(first) - 1, by_parameters.shape[2]
    rank_of = np.zeros(points, np.int64)
    offset, own = np.zeros((points, 3)), np.full((points, 3, 3), np.nan)
    loading = np.zeros((len(by_ground), 3, p))
    most = most_rays(first)
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot = np.empty((3, 3)), np.empty(3, np.int32)
    inverse = np.empty((3, 3))
    for j in range(points):
        n = gather(j, first, weight, by_ground, y, rays, root, b, t)
        if n == 0:
            continue
        rank_of[j] = orthonormal(b, 2 * n, q, r, pivot)
        if rank_of[j] < 3:
            continue
        # rows of ``inverse`` are those of R^-1, put back into the order of the coordinates
        for c in range(3):
            for d in range(3):
                inverse[c, d] = 0.0
        for c in range(3):
            inverse[pivot[c], c] = 1.0 / r[c, c]
        inverse[pivot[1], 2] = -r[1, 2] / (r[1, 1] * r[2, 2])
        inverse[pivot[0], 1] = -r[0, 1] / (r[0, 0] * r[1, 1])
        inverse[pivot[0], 2] = (r[0, 1] * r[1, 2] / r[1, 1] - r[0, 2]) / (r[0, 0] * r[2, 2])
        for e in range(3):
            dot = 0.0
            for i in range(2 * n):
                dot += q[i, e] * t[i]
            for c in range(3):
                offset[j, c] += inverse[c, e] * dot
        for c in range(3):
            for d in range(3):
                own[j, c, d] = inverse[c, 0] * inverse[d, 0] + inverse[c, 1] * inverse[d, 1] + inverse[c, 2] * inverse[d, 2]
        for a in range(n):
            i = rays[a]
            for u in range(p):
                a0, a1 = root[a] * by_parameters[i, 0, u], root[a] * by_parameters[i, 1, u]
                for e in range(3):
                    z = q[2 * a, e] * a0 + q[2 * a + 1, e] * a1
                    for c in range(3):
                        loading[i, c, u] -= inverse[c, e] * z
    return rank_of, offset, own, loading


def eliminate(linear: LinearRays, weight: Array, images: int) -> Sums:
    """Sum the information that rays, each with a weight (r,) (0: rejected, 1: accepted), hold about ``images`` images."""
    size = images * linear.by_parameters.shape[2]
    information, vector = np.zeros((size, size)), np.zeros(size)
    misclosure, redundancy = _eliminate(
        linear.first, linear.image, weight, linear.by_ground, linear.by_parameters, linear.y, information, vector
    )
    return Sums(information, vector, float(misclosure), int(redundancy))


def point_factors(linear: LinearRays, weight: Array) -> PointFactors:
    """Own parts and loadings of points from their accepted rays (weight (r,) above 0)."""
    return PointFactors(*_point_factors(linear.first, weight, linear.by_ground, linear.by_parameters, linear.y))


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _point_covariances(first: Offsets, image: Index, own: Array, loading: Array, covariance: Array) -> Array:
    p, points, total = loading.shape[2], len(first) - 1, own.copy()
    kind = np.zeros(points, np.uint64)
    for j in range(points):
        for a in range(first[j], first[j + 1]):
            kind[j] = kind[j] * np.uint64(1000003) + np.uint64(image[a] + 1)
    size = most_rays(first) * p
    u, m = np.empty((3, size)), np.empty((size, size))
    before, count = 0, 0
    # points that the same images see come together: to gather their part of M costs more than the products with it
    for j in np.argsort(kind):
        start, n = first[j], first[j + 1] - first[j]
        known = n == count
        for a in range(n):
            known = known and image[start + a] == image[before + a]
        if not known:
            for a in range(n):
                for b in range(n):
                    at, to = image[start + a] * p, image[start + b] * p
                    for v in range(p):
                        for w in range(p):
                            m[a * p + v, b * p + w] = covariance[at + v, to + w]
        before, count = start, n
        for a in range(n):
            for c in range(3):
                for v in range(p):
                    u[c, a * p + v] = loading[start + a, c, v]
        whole = total[j]
        for i in range(n * p):
            row, x, y, z = m[i], 0.0, 0.0, 0.0
            for b in range(n * p):
                x += row[b] * u[0, b]
                y += row[b] * u[1, b]
                z += row[b] * u[2, b]
            whole[0, 0] += u[0, i] * x
            whole[1, 0] += u[1, i] * x
            whole[1, 1] += u[1, i] * y
            whole[2, 0] += u[2, i] * x
            whole[2, 1] += u[2, i] * y
            whole[2, 2] += u[2, i] * z
        whole[0, 1], whole[0, 2], whole[1, 2] = whole[1, 0], whole[2, 0], whole[2, 1]
    return total


def point_covariances(first: Offsets, image: Index, factors: PointFactors, covariance: Array) -> Array:
    """``P_jj = D + U M U'`` (n, 3, 3) of each point by itself, square metres; NaN for points that are not determined.

    Parameters
    ----------
    first : (n + 1,) offsets of each point's rays; image : (r,) place of each ray's image in M
    covariance : M (m p, m p), both triangles
    """
    return np.asarray(_point_covariances(first, image, factors.own, factors.loading, covariance))


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _placed(
    first: Offsets, image: Index, weight: Array, by_ground: Array, by_parameters: Array, y: Array, theta: Array
) -> tuple[NDArray[np.bool_], Array]:
    points, p, most = len(first) - 1, by_parameters.shape[2], most_rays(first)
    determined, correction = np.zeros(points, np.bool_), np.zeros((points, 3))
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot, at = np.empty((3, 3)), np.empty(3, np.int32), np.empty(3)
    for j in range(points):
        n = gather(j, first, weight, by_ground, y, rays, root, b, t)
        if n == 0 or orthonormal(b, 2 * n, q, r, pivot) < 3:
            continue
        determined[j] = True
        at[:] = 0.0
        for a in range(n):
            i = rays[a]
            for c in range(2):
                left = 0.0
                for u in range(p):
                    left += by_parameters[i, c, u] * theta[image[i], u]
                left = t[2 * a + c] - root[a] * left
                for e in range(3):
                    at[e] += q[2 * a + c, e] * left
        at[2] /= r[2, 2]
        at[1] = (at[1] - r[1, 2] * at[2]) / r[1, 1]
        at[0] = (at[0] - r[0, 1] * at[1] - r[0, 2] * at[2]) / r[0, 0]
        for e in range(3):
            correction[j, pivot[e]] = at[e]
    return determined, correction


def placed(linear: LinearRays, weight: Array, theta: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which points (n,) their rays (weight (r,) above 0) determine, and ``x - x0`` (n, 3) in metres, given the images' corrections (m, p).

    The same as `ground_corrections` of `point_factors`, without the loadings; 0 for points that are not determined.
    """
    determined, correction = _placed(linear.first, linear.image, weight, linear.by_ground, linear.by_parameters, linear.y, theta)
    return np.asarray(determined), np.asarray(correction)


def ground_corrections(factors: PointFactors, linear: LinearRays, theta: Array) -> Array:
    """Estimated ``x - x0`` (n, 3) in metres, given the images' corrections (m, p); 0 for points that are not determined."""
    by_ray = np.einsum("rcp,rp->rc", factors.loading, theta[linear.image])
    corrections = factors.offset.copy()
    seen = linear.first[1:] > linear.first[:-1]
    if seen.any():
        corrections[seen] += np.add.reduceat(by_ray, linear.first[:-1][seen], axis=0)
    return corrections


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moved(image: Index, by_parameters: Array, theta: Array) -> Array:
    moved = np.zeros(by_parameters.shape[:2])
    for r in range(len(image)):
        for u in range(by_parameters.shape[2]):
            for c in range(2):
                moved[r, c] += by_parameters[r, c, u] * theta[image[r], u]
    return moved


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moved_by_ground(first: Offsets, by_ground: Array, correction: Array) -> Array:
    moved = np.zeros(by_ground.shape[:2])
    for j in range(len(first) - 1):
        for r in range(first[j], first[j + 1]):
            for c in range(2):
                for k in range(3):
                    moved[r, c] += by_ground[r, c, k] * correction[j, k]
    return moved


def moved_rays(linear: LinearRays, theta: Array) -> Array:
    """By how much (r, 2), in sigmas, image corrections (m, p) move the image coordinates of rays."""
    return np.asarray(_moved(linear.image, linear.by_parameters, theta))


def moved_by_ground(linear: LinearRays, correction: Array) -> Array:
    """By how much (r, 2), in sigmas, shifts (n, 3) of the points in metres move the image coordinates of their rays."""
    return np.asarray(_moved_by_ground(linear.first, linear.by_ground, correction))


def residuals_of(linear: LinearRays, theta: Array, correction: Array) -> Array:
    """Linear residuals (r, 2) in sigmas of all rays at image corrections (m, p) and ground corrections ``x - x0`` (n, 3)."""
    return np.asarray(linear.y - moved_rays(linear, theta) - moved_by_ground(linear, correction))
