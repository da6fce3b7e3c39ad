"""Blunders: robust weights to begin with, then Baarda's test of every ray, and of every image against its a priori model.

With whitened observations the residuals of a point's rays are ``v = P (y - A theta)``, ``P = I - QQ'`` (see
`submin.adjustment.elimination`), of covariance ``P - P A M A' P`` when ``theta`` has covariance M. The test statistic of one coordinate is
``w = v / sqrt(its variance)``, standard normal without blunders (Baarda 1968; docs/mathematics.md, "Quality assurance").
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from submin.adjustment.elimination import Array, Index, LinearRays, Offsets
from submin.adjustment.point_basis import gather, most_rays, orthonormal, remove_ground

CRITICAL_RAY = 4.0
"""A ray whose w exceeds this is a blunder (1 good coordinate in 16,000; decision 004 says why not 3.29)."""
IMAGE_FAMILY = 0.05
"""Chance that any good image of a set adjusted together is said to have a bad camera (Bonferroni over all parameters tested)."""
TESTABLE = 0.01
"""A coordinate or parameter is tested when at least this part of its a priori variance is checked by other observations."""
ROBUST_SCALE = 2.4
"""Residual, in sigmas, at which a ray's weight has fallen to one half of the Cauchy weight's way (95 % efficiency for normal errors)."""


@numba.njit(cache=True, error_model="numpy")
def _residuals(
    first: Offsets, image: Index, weight: Array, by_ground: Array, by_parameters: Array, y: Array, theta: Array
) -> tuple[Array, Array]:
    """Residuals (r, 2) of the accepted rays, in sigmas, and their variances (r, 2) for known theta; NaN for the others."""
    p = by_parameters.shape[2]
    residual, variance = np.full(y.shape, np.nan), np.full(y.shape, np.nan)
    most = most_rays(first)
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot = np.empty((3, 3)), np.empty(3, np.int32)
    for j in range(len(first) - 1):
        n = gather(j, first, weight, by_ground, y, rays, root, b, t)
        if n == 0:
            continue
        rank = orthonormal(b, 2 * n, q, r, pivot)
        for a in range(n):
            i = rays[a]
            for c in range(2):
                for u in range(p):
                    t[2 * a + c] -= root[a] * by_parameters[i, c, u] * theta[image[i], u]
        remove_ground(q, rank, 2 * n, t)
        for a in range(n):
            i = rays[a]
            for c in range(2):
                residual[i, c] = t[2 * a + c] / root[a]
                variance[i, c] = 1.0
                for e in range(rank):
                    variance[i, c] -= q[2 * a + c, e] ** 2
    return residual, variance


@numba.njit(cache=True, error_model="numpy")
def _drop(variance: Array, v0: float, v1: float, testable: float) -> float:
    """By how much the weighted squares drop when a ray with residuals v0, v1 of this covariance (2, 2) is left out: ``v' V^-1 v``.

    A direction that nothing checks (variance below ``testable``) does not count.
    """
    mean, half = 0.5 * (variance[0, 0] + variance[1, 1]), 0.5 * (variance[0, 0] - variance[1, 1])
    spread = np.hypot(half, variance[0, 1])
    angle = 0.5 * np.arctan2(variance[0, 1], half)
    along, across = np.cos(angle) * v0 + np.sin(angle) * v1, np.cos(angle) * v1 - np.sin(angle) * v0
    drop = 0.0
    if mean + spread >= testable:
        drop += along * along / (mean + spread)
    if mean - spread >= testable:
        drop += across * across / (mean - spread)
    return drop


@numba.njit(cache=True, error_model="numpy")
def _snoop(
    first: Offsets, image: Index, weight: Array, by_ground: Array, by_parameters: Array, y: Array,
    theta: Array, covariance: Array, critical: float, testable: float, statistic: Array,
) -> None:  # fmt: skip
    """Test each point's rays, reject the worst, and again until none is left to reject.

    Changes ``weight``; ``statistic`` (r,) becomes each ray's last w.
    """
    p = by_parameters.shape[2]
    most = most_rays(first)
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot, z = np.empty((3, 3)), np.empty(3, np.int32), np.empty((most, 3, p))
    drops = np.empty(most)
    row, product, variance = np.empty((2, most * p)), np.empty((2, most * p)), np.empty((2, 2))
    for j in range(len(first) - 1):
        while True:
            n = gather(j, first, weight, by_ground, y, rays, root, b, t)
            if n < 2:
                break
            rank = orthonormal(b, 2 * n, q, r, pivot)
            if 2 * n <= rank:
                break
            for a in range(n):
                i = rays[a]
                for c in range(2):
                    for u in range(p):
                        t[2 * a + c] -= by_parameters[i, c, u] * theta[image[i], u]
                for u in range(p):
                    for e in range(rank):
                        z[a, e, u] = q[2 * a, e] * by_parameters[i, 0, u] + q[2 * a + 1, e] * by_parameters[i, 1, u]
            remove_ground(q, rank, 2 * n, t)
            worst_w = 0.0
            for a in range(n):
                for c in range(2):
                    for s in range(n):
                        for u in range(p):
                            value = by_parameters[rays[s], c, u] if s == a else 0.0
                            for e in range(rank):
                                value -= q[2 * a + c, e] * z[s, e, u]
                            row[c, s * p + u] = value
                    for s in range(n):
                        at = image[rays[s]] * p
                        for u in range(p):
                            total = 0.0
                            for s2 in range(n):
                                to = image[rays[s2]] * p
                                for v in range(p):
                                    total += covariance[at + u, to + v] * row[c, s2 * p + v]
                            product[c, s * p + u] = total
                for c in range(2):
                    for d in range(2):
                        variance[c, d] = 1.0 if c == d else 0.0
                        for e in range(rank):
                            variance[c, d] -= q[2 * a + c, e] * q[2 * a + d, e]
                        for k in range(n * p):
                            variance[c, d] -= row[c, k] * product[d, k]
                statistic[rays[a]] = 0.0
                for c in range(2):
                    if variance[c, c] >= testable:
                        statistic[rays[a]] = max(statistic[rays[a]], abs(t[2 * a + c]) / np.sqrt(variance[c, c]))
                worst_w = max(worst_w, statistic[rays[a]])
                drops[a] = _drop(variance, t[2 * a], t[2 * a + 1], testable)
            if not worst_w > critical:
                break
            if n == 2:  # two rays cannot be told apart: the point goes
                weight[rays[0]] = weight[rays[1]] = 0.0
                statistic[rays[0]] = statistic[rays[1]] = worst_w
            else:
                weight[rays[np.argmax(drops[:n])]] = 0.0


def robust_weights(linear: LinearRays, weight: Array, theta: Array) -> Array:
    """Cauchy weights (r,) of rays from their residuals at these image corrections (m, p); rejected rays (weight 0) stay rejected."""
    residual, variance = _residuals(
        linear.first, linear.image, weight, linear.by_ground, linear.by_parameters, linear.y, theta
    )  # fmt: skip
    free = variance.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        distance2 = np.where(free > TESTABLE, (residual**2).sum(axis=1) / free, 0.0)
    return np.where(weight > 0.0, 1.0 / (1.0 + distance2 / ROBUST_SCALE**2), 0.0)


def residuals(linear: LinearRays, weight: Array, theta: Array) -> Array:
    """Residuals (r, 2) in sigmas at these image corrections (m, p), each point at its best place; NaN for rejected rays."""
    return np.asarray(_residuals(linear.first, linear.image, weight, linear.by_ground, linear.by_parameters, linear.y, theta)[0])


def reject_blunders(linear: LinearRays, weight: Array, theta: Array, covariance: Array) -> tuple[Array, Array]:
    """Weights (r,) of the rays, 0 for blunders, and the test statistic (r,) of each, at an adjustment of the images.

    Parameters
    ----------
    weight : (r,) 1 for rays to be tested, 0 for rays rejected before
    theta, covariance : (m, p), (m p, m p), corrections of the images and their a posteriori covariance, both triangles

    Notes
    -----
    Each point is judged by itself. While a coordinate of any of its rays exceeds the critical value, the ray goes without which the
    weighted squares drop most, and the rest are tested again. Of two rays that contradict each other both go.
    """
    judged, statistic = weight.copy(), np.zeros(len(weight))
    _snoop(
        linear.first, linear.image, judged, linear.by_ground, linear.by_parameters, linear.y,
        theta, covariance, CRITICAL_RAY, TESTABLE, statistic,
    )  # fmt: skip
    return judged, statistic


def image_statistics(theta: Array, covariance: Array, prior_variance: Array) -> Array:
    """Test statistic (m, p) of each image's correction against its a priori model: ``theta / sqrt(Q - M)``, 0 where it cannot be tested.

    Parameters
    ----------
    theta : (m, p) estimated corrections; covariance : (m p, m p), a posteriori; prior_variance : (m, p), diagonal of Q
    """
    free = prior_variance - np.diag(covariance).reshape(theta.shape)
    testable = free > TESTABLE * prior_variance
    return np.where(testable, np.abs(theta) / np.sqrt(np.where(testable, free, 1.0)), 0.0)


def critical_image(tests: int) -> float:
    """Critical value for so many two-sided tests of image parameters together.

    Examples
    --------
    >>> round(critical_image(19 * 6), 2)
    3.52
    """
    return float(ndtri(1.0 - 0.5 * IMAGE_FAMILY / max(tests, 1)))


def bad_cameras(statistics: Array, linear: LinearRays) -> NDArray[np.bool_]:
    """Images (m,) whose camera is to be released now: above the critical value and the worst among the images that they share points with.

    One bad camera makes its neighbours look bad, so only the worst of a neighbourhood is named before the images are adjusted again.

    Parameters
    ----------
    statistics : (m, p), see `image_statistics`; linear : the rays, for which images share points
    """
    worst = statistics.max(axis=1, initial=0.0)
    suspects = np.flatnonzero(worst > critical_image(int((statistics > 0.0).sum())))
    bad = np.zeros(len(worst), dtype=bool)
    if not len(suspects):
        return bad
    points = len(linear.first) - 1
    place = np.full(len(worst), -1)
    place[suspects] = np.arange(len(suspects))
    chosen = place[linear.image] >= 0
    sees = np.zeros((len(suspects), points), dtype=bool)
    sees[place[linear.image[chosen]], np.repeat(np.arange(points), np.diff(linear.first))[chosen]] = True
    for k, i in enumerate(suspects):
        linked = (sees & sees[k]).any(axis=1)
        bad[i] = worst[i] >= worst[suspects][linked].max()
    return bad
