"""Blunders: robust weights to begin with, then Baarda's test of every ray, and of every image against its a priori model.

With whitened observations the residuals of a point's rays are ``v = P (y - A theta)``, ``P = I - QQ'`` (see
`submin.adjustment.elimination`), of covariance ``P - P A M A' P`` when ``theta`` has covariance M. The test statistic of one coordinate is
``w = v / sqrt(its variance)``, standard normal without blunders (Baarda 1968; docs/mathematics.md, "Quality assurance").
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv, ndtri

from submin.adjustment.elimination import Array, Index, LinearRays, Offsets
from submin.adjustment.point_basis import gather, most_rays, orthonormal, remove_ground
from submin.adjustment.snooping import snoop

CRITICAL_RAY = 4.0
"""A ray whose w exceeds this is a blunder (1 good coordinate in 16,000; decision 004 says why not 3.29)."""
DOUBT = 9.2
"""An explanation whose weighted squares exceed the best one's by less is as good: it is one hundredth as likely, ``2 ln 100``."""
IMAGE_FAMILY = 0.05
"""Chance that any good image of a set adjusted together is said to have a bad camera (Bonferroni over all parameters tested)."""
DESERTED_RAYS = 8
"""An image with fewer rays can lose most of them to blunders."""
TESTABLE = 0.01
"""A coordinate or parameter is tested when at least this part of its a priori variance is checked by other observations."""
ROBUST_SCALE = 2.4
"""Residual, in sigmas, at which a ray's weight has fallen to one half of the Cauchy weight's way (95 % efficiency for normal errors)."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


def reject_blunders(
    linear: LinearRays, weight: Array, theta: Array, covariance: Array, noise: float = 1.0, used: Array | None = None,
    testable: Array | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """Weights (r,) of the rays, 0 for blunders, and the test statistic (r,) of each, at an adjustment of the images.

    Parameters
    ----------
    weight : (r,) 1 for rays to be tested, 0 for rays rejected before
    theta, covariance : (m, p), (m p, m p), corrections of the images and their a posteriori covariance, both triangles
    noise : variance of the measurements in units of the stated one, see `noise_bound`; 0 when the likeliest explanation is to be taken
    used : (r,) 1 for the rays with which the images were adjusted; by default those that are tested
    testable : (r,) part of a ray's variance that others must check for it to be tested, by default `TESTABLE`

    Notes
    -----
    Each point is judged by itself, see `submin.adjustment.snooping`. Of two rays that contradict each other both go.
    """
    judged, statistic = weight.copy(), np.zeros(len(weight))
    snoop(
        linear.first, linear.image, judged, weight if used is None else used, linear.by_ground, linear.by_parameters, linear.y,
        theta, covariance, CRITICAL_RAY, DOUBT * noise, np.full(len(weight), TESTABLE) if testable is None else testable, statistic,
    )  # fmt: skip
    return judged, statistic


def worst_of_sets(judged: Array, used: Array, statistic: Array, of_set: NDArray[np.integer], point: Index) -> Array:
    """Weights (r,) of the rays when of each set of correlated points only the worst of those that fail goes.

    One bad point makes those correlated with it look bad, so only the worst is left out before all are judged again. Points that were
    left out before stay as they are judged.

    Parameters
    ----------
    judged, used : (r,) weights as judged, and those with which the images were adjusted; statistic : (r,) test statistics
    of_set : (r,) number of the set of each survey's ray, -1 of all others; point : (r,)
    """
    lost = np.flatnonzero((of_set >= 0) & (used > 0.0) & ~(judged > 0.0))
    spared = judged.copy()
    for number in np.unique(of_set[lost]).tolist():
        members = lost[of_set[lost] == number]
        others = members[point[members] != point[members[np.argmax(statistic[members])]]]
        spared[others] = used[others]
    return spared


def noise_bound(chi_square: float, redundancy: int) -> float:
    """Upper bound of the variance of measurements in units of the stated one (95 %), at most 1, from an adjustment's weighted squares.

    Examples
    --------
    >>> [round(noise_bound(0.1 * redundancy, redundancy), 3) for redundancy in (0, 1, 10, 1000)]
    [1.0, 1.0, 0.254, 0.108]
    """
    least = 2.0 * gammaincinv(0.5 * redundancy, 0.05) if redundancy > 0 else 0.0
    return float(min(1.0, chi_square / least)) if least > 0.0 else 1.0


def image_statistics(theta: Array, variance: Array, prior_variance: Array) -> Array:
    """Test statistic (m, p) of each image's correction against its a priori model: ``theta / sqrt(Q - M)``, 0 where it cannot be tested.

    Parameters
    ----------
    theta : (m, p) estimated corrections; variance : (m, p), a posteriori, diagonal of M; prior_variance : (m, p), diagonal of Q
    """
    free = prior_variance - variance
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


def deserted_image(linear: LinearRays, tested: Array, judged: Array, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The image (m,), one at most, that has lost most of its rays: not they are wrong, but its camera.

    Parameters
    ----------
    tested, judged : (r,) above 0 for rays that were tested, and for those of them that passed; free : (m,) images that can be meant
    """
    every = np.bincount(linear.image, tested > 0.0, len(free))
    lost = np.bincount(linear.image, (tested > 0.0) & ~(judged > 0.0), len(free))
    part = np.where((every >= DESERTED_RAYS) & free, lost / np.maximum(every, 1.0), 0.0)
    deserted = np.zeros(len(free), dtype=np.bool_)
    if part.max(initial=0.0) > 0.5:
        deserted[np.argmax(part)] = True
    return deserted
