"""Adjustment of a bundle of rays: Gauss-Newton with a robust start, blunders rejected, bad cameras named.

The same function serves stage 1 (one block, free of any network) and the judgement of a sub-MIN's rays (all that a tile holds). Its
result is the accepted rays, the released cameras, and the state at which to linearise; never a dense covariance of ground points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.blunders import bad_cameras, image_statistics, reject_blunders, residuals, robust_weights
from submin.adjustment.elimination import LinearRays, eliminate, ground_corrections, linearise, moved_rays, point_factors
from submin.adjustment.estimation import ImageEstimate, estimate_images
from submin.adjustment.explained import explained_metres
from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays
from submin.errors import NumericalError

Array = NDArray[np.float64]

ROBUST_ITERATIONS = 6
SETTLED_WEIGHT = 0.02
"""Robust weights that change less have done their work."""
MAX_ITERATIONS = 40
FREE_DECISIONS = 12
"""Iterations in which a rejected ray may come back; after them rays only go, so that the adjustment ends."""
REACH_METRES = 5000.0
"""A point is linearised no farther than this, or than its cameras explain, from where it was registered. The estimate of a weak point (rays
of one viewpoint) may lie anywhere along its rays, out of the range in which a camera model means anything; where it is linearised is ours
to choose."""
CONVERGED_SIGMAS = 2e-6
"""A step that moves no ray by more than this, in sigmas of its measurement, is none."""
CONVERGED_METRES = 1e-5


@dataclass(frozen=True)
class Adjustment:
    """Result of adjusting a bundle of rays.

    Attributes
    ----------
    theta : (m, p) corrections of the images
    ground : (n, 3) geocentric positions, metres (a point that is not determined stays where it was)
    accepted : (r,) False for blunders
    statistic : (r,) test statistic of each ray when it was last judged
    released : (m,) True for images whose a priori model was released because their camera is bad
    image_statistic : (m,) largest test statistic of each image against its a priori model, when it was judged bad, else the last one
    residuals : (r, 2) of the accepted rays, in sigmas, each point at its best place; NaN for rejected rays
    converged : False when the iterations ran out
    iterations : how many there were
    """

    theta: Array
    ground: Array
    accepted: NDArray[np.bool_]
    statistic: Array
    released: NDArray[np.bool_]
    image_statistic: Array
    residuals: Array
    converged: bool
    iterations: int


def adjust(images: ImageSet, rays: Rays, start: Array, registered: Array | None = None) -> Adjustment:
    """Adjust m images and n ground points by their rays, from ground positions ``start`` (n, 3) and unadjusted cameras.

    ``registered`` (n, 3), by default the start, is where the points were registered; they are linearised within reach of it.

    Raises
    ------
    NumericalError
        When a position is not finite, or the rays' information is not finite or not positive definite.
    """
    if not np.isfinite(start).all():
        raise NumericalError(f"the positions of {int((~np.isfinite(start)).any(axis=1).sum())} of {len(start)} points are not finite")
    theta = np.zeros((len(images), images.parameters))
    ground, anchor = start.copy(), start if registered is None else registered
    reach = _reach(images, rays, anchor)
    # round-off of normal equations goes with the square of how much worse cameras are known than rays are measured
    round_off = (reach.max(initial=REACH_METRES) / REACH_METRES) ** 2
    candidates = rays.accepted.astype(np.float64)
    weight = candidates.copy()
    iteration = 0
    while iteration < ROBUST_ITERATIONS:
        iteration += 1
        linear, estimate, ground = _step(images, rays, theta, ground, anchor, reach, weight)
        theta = estimate.theta
        before, weight = weight, robust_weights(linear, np.where(_seen(linear), candidates, 0.0), theta)
        if np.abs(weight - before).max(initial=0.0) < SETTLED_WEIGHT:
            break

    weight = (weight > 0.05).astype(np.float64)
    released = np.zeros(len(images), dtype=bool)
    image_statistic = np.zeros(len(images))
    statistic = np.zeros(len(rays))
    converged, judgements = False, 0
    while not converged and judgements < MAX_ITERATIONS:
        judgements += 1
        linear, estimate, reached = _step(images, rays, theta, ground, anchor, reach, weight)
        step = np.abs(moved_rays(linear, estimate.theta - theta)[_seen(linear)]).max(initial=0.0)
        step_m = np.abs(reached - ground).max(initial=0.0)
        theta, ground = estimate.theta, reached
        judgeable = np.where(_seen(linear), candidates if judgements <= FREE_DECISIONS else weight, 0.0)
        judged, statistic = reject_blunders(linear, judgeable, theta, estimate.covariance)
        worst = image_statistics(theta, estimate.covariance, images.prior_variance)
        # images are judged once the rays have been: a blunder must not be blamed on its camera
        bad = bad_cameras(worst, linear) & ~released & np.array_equal(judged, weight)
        image_statistic = np.where(released, image_statistic, worst.max(axis=1, initial=0.0))
        converged = (
            max(step / CONVERGED_SIGMAS, step_m / CONVERGED_METRES) < round_off and not bad.any() and bool(np.array_equal(judged, weight))
        )  # fmt: skip
        weight, released = judged, released | bad
        images = images.release(bad) if bad.any() else images

    final = linearise(images, rays, theta, ground, ground)
    return Adjustment(
        theta, ground, weight > 0.0, statistic, released, image_statistic, residuals(final, weight, theta), converged,
        iteration + judgements,
    )  # fmt: skip


def _step(
    images: ImageSet, rays: Rays, theta: Array, ground: Array, anchor: Array, reach: Array, weight: Array
) -> tuple[LinearRays, ImageEstimate, Array]:
    """One Gauss-Newton step.

    Returns the linearised rays, the images' new estimate, and the points' new positions (n, 3), within reach (n,) of their anchors. A ray
    of a point that its camera does not see where both are now is left out of this step.
    """
    linear = linearise(images, rays, theta, ground, ground)
    weight = np.where(_seen(linear), weight, 0.0)
    estimate = estimate_images(eliminate(linear, weight, len(images)), images.prior, images.parameters)
    offset = ground + ground_corrections(point_factors(linear, weight), linear, estimate.theta) - anchor
    distance = np.linalg.norm(offset, axis=1)
    offset *= (reach / np.maximum(distance, reach))[:, None]
    return linear, estimate, anchor + offset


def _reach(images: ImageSet, rays: Rays, anchor: Array) -> Array:
    """Metres (n,) from its anchor within which each point is linearised: `REACH_METRES`, or what its cameras explain."""
    projection = images.project(np.zeros((len(images), images.parameters)), images.ground(anchor), rays.image, rays.point)
    reach = np.full(len(anchor), REACH_METRES)
    np.maximum.at(reach, rays.point, explained_metres(projection, images.prior_variance[rays.image], rays.sigma))
    return reach


def _seen(linear: LinearRays) -> NDArray[np.bool_]:
    """True (r,) for rays whose camera sees the point where both were linearised."""
    return np.asarray(np.isfinite(linear.y).all(axis=1))
