"""Stage 1 with control, to convergence: Gauss-Newton, control that contradicts the block left out, bad cameras released."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.adjustment import CONVERGED_METRES, CONVERGED_SIGMAS, reach_metres, round_off
from submin.adjustment.blunders import bad_cameras, image_statistics
from submin.adjustment.control import ControlledEstimate, ControlledPrior, InnovationTest, estimate, innovation_test
from submin.adjustment.elimination import LinearRays, linearise, moved_rays
from submin.adjustment.explained import explained_metres
from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays
from submin.errors import NumericalError

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

MAX_ITERATIONS = 40
MAX_DECISIONS = 200
"""Rounds of leaving out control and releasing cameras; every round decides at least one for good."""
FAR_METRES = 1000.0
"""Control that all of the block's rays to it pass by more than this, and than unadjusted cameras explain, is of another place."""
COMPANY = 0.5
"""Control that contradicts the block half as much as the worst of it does is left out together with it."""


@dataclass(frozen=True)
class ControlledAdjustment:
    """A block adjusted with control.

    Attributes
    ----------
    estimate : images and points with their covariances, at the last linearisation
    prior : the state that it started from, with the cameras that were released
    active : (k,) False for control points that were left out because they contradict the block
    statistic, dof : (k,) test of each control point when it was last judged; infinite for one farther off than `FAR_METRES`
    released : (m,) images whose a priori model was given up because their camera is bad
    image_statistic : (m,) largest test statistic of each image against its a priori model when it was last judged
    test : of all active control points together
    iterations : linearisations
    linear : the rays at the last of them
    """

    estimate: ControlledEstimate
    prior: ControlledPrior
    active: Flags
    statistic: Array
    dof: NDArray[np.int64]
    released: Flags
    image_statistic: Array
    test: InnovationTest
    iterations: int
    linear: LinearRays


def adjust_controlled(images: ImageSet, rays: Rays, start: Array, prior_of: Callable[[ImageSet], ControlledPrior]) -> ControlledAdjustment:
    """Adjust m images and n points of a block by its accepted rays, with control.

    Parameters
    ----------
    images, rays : of the block; rays are taken or left as they have been judged (`submin.adjustment.adjustment.adjust`)
    start : (n, 3) registered positions, geocentric metres
    prior_of : control and images as they are known before the block's rays; asked again when a camera is released

    Raises
    ------
    NumericalError
        When it does not converge, or its information is not positive definite.
    """
    prior, weight = prior_of(images), rays.accepted.astype(np.float64)
    active = _near(images, rays, prior, len(start))
    released, image_statistic = np.zeros(len(images), dtype=np.bool_), np.zeros(len(images))
    statistic, dof = np.where(active, 0.0, np.inf), np.zeros(len(active), dtype=np.int64)
    origin = start.copy()
    origin[prior.point] = prior.position
    theta, ground, iterations, reach = (
        prior.theta,
        origin,
        0,
        reach_metres(images, rays, linearise(images, rays, prior.theta, origin, origin)),
    )
    for _ in range(MAX_DECISIONS):
        linear, found, ground, steps = _converged(images, rays, weight, prior, active, origin, reach, theta, ground)
        theta, iterations = found.theta, iterations + steps
        statistic, dof = np.where(active, found.statistic, statistic), np.where(active, found.dof, dof)
        contradicting = found.outliers() & active
        if contradicting.any():
            active &= ~(contradicting & (statistic >= COMPANY * statistic[contradicting].max()))
            continue
        variance = (prior.images**2).sum(axis=1).reshape(theta.shape)
        tests = image_statistics(theta - prior.theta, np.diag(found.covariance).reshape(theta.shape), variance)
        image_statistic = np.where(released, image_statistic, tests.max(axis=1, initial=0.0))
        bad = bad_cameras(tests, linear) & ~released
        if not bad.any():
            test = innovation_test(linear, weight, prior, active, found)
            return ControlledAdjustment(
                found, prior, active, statistic, dof, released, image_statistic, test, iterations, linear
            )  # fmt: skip
        released |= bad
        images = images.release(bad)
        prior = prior_of(images)
    raise NumericalError("the adjustment with control does not come to rest: too much of it contradicts the block; check its point ids")


def _near(images: ImageSet, rays: Rays, prior: ControlledPrior, points: int) -> Flags:
    """Control points (k,) that the rays to them do not pass by kilometres."""
    of_point = np.full(points, -1)
    of_point[prior.point] = np.arange(len(prior.point))
    control = of_point[rays.point]
    row = np.flatnonzero((control >= 0) & rays.accepted)
    near = np.ones(len(prior.point), dtype=np.bool_)
    if len(row):
        projection = images.project(
            prior.theta, images.ground(prior.position), rays.image[row], control[row].astype(np.int32), rays.observed[row]
        )  # fmt: skip
        pixel = np.linalg.norm(projection.by_ground, axis=(1, 2)) / np.sqrt(2.0)
        passing = np.linalg.norm(rays.observed[row] - projection.image, axis=1) / pixel
        closest = np.full(len(near), np.inf)
        np.minimum.at(closest, control[row], np.where(np.isfinite(passing), passing, np.inf))
        seen = np.bincount(control[row], minlength=len(near)) > 0
        variance = (prior.images**2).sum(axis=1).reshape(prior.theta.shape)
        explained = np.zeros(len(near))
        by_ground, by_parameters = (part / rays.sigma[row][:, :, None] for part in (projection.by_ground, projection.by_parameters))
        np.maximum.at(explained, control[row], explained_metres(by_ground, by_parameters, variance[rays.image[row]]))
        near = ~seen | (closest <= np.maximum(FAR_METRES, explained))
    return near


def _converged(
    images: ImageSet,
    rays: Rays,
    weight: Array,
    prior: ControlledPrior,
    active: Flags,
    origin: Array,
    reach: Array,
    theta: Array,
    ground: Array,
) -> tuple[LinearRays, ControlledEstimate, Array, int]:
    """Gauss-Newton: the last linearisation, the estimate there, where the points are linearised next, and the number of steps."""
    still = round_off(reach)
    for step in range(1, MAX_ITERATIONS + 1):
        linear = linearise(images, rays, theta, ground, origin)
        found = estimate(linear, weight, prior, active, origin)
        offset = np.where(np.isfinite(found.ground), found.ground - origin, ground - origin)
        distance = np.linalg.norm(offset, axis=1)
        offset *= (reach / np.maximum(distance, reach))[:, None]
        shift = origin + offset - ground
        by_ground = np.einsum("rck,rk->rc", linear.by_ground, shift[rays.point])[weight > 0.0]
        settled = np.abs(moved_rays(linear, found.theta - theta)).max(initial=0.0) < still * CONVERGED_SIGMAS and (
            np.abs(shift).max(initial=0.0) < still * CONVERGED_METRES or np.abs(by_ground).max(initial=0.0) < still * CONVERGED_SIGMAS
        )
        theta, ground = found.theta, origin + offset
        if settled:
            return linear, found, ground, step
    raise NumericalError(
        f"the adjustment of the block with its control did not converge in {MAX_ITERATIONS} iterations; check its cameras and measurements"
    )
