"""Adjustment of a bundle of rays: damped Gauss-Newton with a robust start, blunders rejected, bad cameras named.

The same function serves stage 1 (one block, free of any network) and the judgement of a sub-MIN's rays (all that a tile holds). Its
result is the accepted rays, the released cameras, and the state at which to linearise; never a dense covariance of ground points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.blunders import (
    TESTABLE,
    bad_cameras,
    deserted_image,
    image_statistics,
    noise_bound,
    reject_blunders,
    residuals,
    robust_weights,
    worst_of_sets,
)
from submin.adjustment.elimination import (
    LinearRays,
    eliminate,
    linearise,
    moved_by_ground,
    moved_rays,
    placed,
    residuals_of,
)
from submin.adjustment.estimation import ImageEstimate, estimate_images
from submin.adjustment.explained import explained_metres
from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays
from submin.adjustment.status import Cause, Status, diagnose, unseen_image
from submin.errors import NumericalError

Array = NDArray[np.float64]

ROBUST_ITERATIONS = 6
SETTLED_WEIGHT = 0.1
"""Robust weights that change less have done their work: they only have to find the neighbourhood in which rays are judged."""
HONEST_WEIGHT = 0.24
"""Where all robust weights are larger they have nothing to do: no ray is six sigmas off, or 4.3 where it is checked in one direction."""
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
NEAR_ENOUGH_SIGMAS = 1e-2
"""A step that moves images and points by less changes no decision that was sure, and is the last one where it was linear to
`CONVERGED_SIGMAS`: another one would find nothing."""
PATIENCE = 4
RESTLESS = 0.05
"""When after so many iterations decisions still change about this part of the rays, images are judged: a bad camera may be why."""
NEAR_SIGMAS = 0.3
"""Images whose last step moved no ray by more are near enough to their solution to tell how sure a decision about a ray is. Where no ray is
far off (`HONEST_WEIGHT`) so are those whose step was linear to `NEAR_ENOUGH_SIGMAS`: weakly determined images move far, their points along
with them, and what is still to be rejected will not move them far."""
HALVINGS = 10
"""A step that makes matters worse is halved so many times before it is taken as it is, or not at all."""
RUNAWAY = 4.0
"""Factor by which a point's weighted squares, and `SLACK` of them, may exceed what a step promised before the point runs away."""
SLACK = 100.0
CURVED = 1.01
"""Factor by which they may exceed what a straight step would leave, or no step of the point at all: by more the step was not straight."""
PROMISED = 1.1
"""Factor by which the weighted squares may exceed what a step promised, when they do not fall: points that are not determined, and the a
priori model, have their part in what it does."""
UNSEEN = 1e200
"""Squares of a residual that is no number."""
RISE = 1e-6
"""Part of the weighted squares by which they may rise in a step: round-off."""


@dataclass(frozen=True)
class BundleEstimate:
    """Where an adjustment has put cameras and points.

    Attributes
    ----------
    theta : (m, p) corrections of the images; ground : (n, 3) geocentric positions, metres; released : (m,), all as in `Adjustment`
    """

    theta: Array
    ground: Array
    released: NDArray[np.bool_]

    def widened(self, parameters: int) -> BundleEstimate:
        """The same with zeros for parameters up to so many an image."""
        theta = np.zeros((len(self.theta), parameters))
        theta[:, : self.theta.shape[1]] = self.theta
        return BundleEstimate(theta, self.ground, self.released)


@dataclass(frozen=True)
class Adjustment:
    """Result of adjusting a bundle of rays.

    Attributes
    ----------
    theta : (m, p) corrections of the images
    ground : (n, 3) geocentric positions, metres: a point with fewer than two accepted rays is placed by all its rays, and one that these do
        not determine stays where it was
    accepted : (r,) False for blunders
    statistic : (r,) test statistic of each ray when it was last judged
    released : (m,) True for images whose a priori model was released because their camera is bad
    image_statistic : (m,) largest test statistic of each image against its a priori model, when it was judged bad, else the last one
    residuals : (r, 2) of the accepted rays, in sigmas, each point at its best place; NaN for rejected rays
    status : whether it converged, in how many iterations, and why not
    """

    theta: Array
    ground: Array
    accepted: NDArray[np.bool_]
    statistic: Array
    released: NDArray[np.bool_]
    image_statistic: Array
    residuals: Array
    status: Status

    @property
    def estimate(self) -> BundleEstimate:
        """Where cameras and points are."""
        return BundleEstimate(self.theta, self.ground, self.released)

    @property
    def converged(self) -> bool:
        """True when all decisions stood and nothing was left to be moved, see `adjust`."""
        return self.status.converged

    @property
    def iterations(self) -> int:
        """Steps taken."""
        return self.status.iterations


@dataclass(frozen=True)
class _State:
    """Where an adjustment is: corrections, positions, and the rays linearised there.

    ``whitened`` are the corrections' whitened vectors, None when the a priori model has changed since; ``squares`` (r,) those of the
    residuals, in sigmas, `UNSEEN` where a camera does not see its point.
    """

    theta: Array
    whitened: Array | None
    ground: Array
    linear: LinearRays
    squares: Array

    @classmethod
    def at(cls, images: ImageSet, rays: Rays, theta: Array, whitened: Array | None, ground: Array) -> _State:
        linear = linearise(images, rays, theta, ground, ground)
        residual = linear.y - moved_rays(linear, theta)
        return cls(theta, whitened, ground, linear, np.fmin(np.einsum("rc,rc->r", residual, residual), UNSEEN))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """True (r,) for rays whose camera sees the point where both are."""
        return self.squares < UNSEEN

    @property
    def prior_squares(self) -> float:
        return 0.0 if self.whitened is None else float(self.whitened @ self.whitened)


@dataclass(frozen=True)
class _Step:
    """A step: the state that it reached, the estimate that it follows, the noise found on the way, and whether it had to be shortened."""

    state: _State
    estimate: ImageEstimate
    noise: float
    shortened: bool


def adjust(images: ImageSet, rays: Rays, start: Array, registered: Array | None = None, *, to_rest: bool = True) -> Adjustment:
    """Adjust m images and n ground points by their rays, from ground positions ``start`` (n, 3) and unadjusted cameras.

    ``registered`` (n, 3), by default the start, is where the points were registered; they are linearised within reach of it.
    Without ``to_rest``, where only decisions count, it ends once they stand near the solution and the last step was linear: where another
    one would leave images and points is then known to thousandths of a sigma of their rays, not to millionths.

    Raises
    ------
    NumericalError
        When a position is not finite, or the rays' information is not finite or not positive definite.
    """
    if not np.isfinite(start).all():
        raise NumericalError(f"the positions of {int((~np.isfinite(start)).any(axis=1).sum())} of {len(start)} points are not finite")
    anchor = start if registered is None else registered
    candidates = rays.accepted.astype(np.float64)
    weight = candidates.copy()
    state = _State.at(images, rays, np.zeros((len(images), images.parameters)), np.zeros(images.prior.shape[1]), start)
    reach = reach_metres(images, rays, state.linear)
    tolerance = round_off(reach)
    iteration, robust, honest = 0, 0, False
    while robust < ROBUST_ITERATIONS and iteration < MAX_ITERATIONS:
        iteration += 1
        step = _advance(images, rays, state, anchor, reach, weight)
        state, robust = step.state, 0 if step.shortened else robust + 1
        before, weight = weight, robust_weights(state.linear, np.where(state.seen, candidates, 0.0), state.theta)
        honest = bool(weight[before > 0.0].min(initial=1.0) > HONEST_WEIGHT)
        if not step.shortened and (honest or np.abs(weight - before).max(initial=0.0) < SETTLED_WEIGHT):
            break

    weight = (weight > 0.05).astype(np.float64)
    # correlated control has shifts and no camera: a shift that is wrong is one of its rays, and these are tested
    camera = np.array([prior.a_priori is not None for prior in images.priors], dtype=np.bool_)
    released, adjustable = np.zeros(len(images), dtype=bool), camera & (images.prior_variance > 0.0).any(axis=1)
    of_set = _sets(images)[rays.image]
    testable = TESTABLE * np.array([1.0 if prior.joint is None else prior.joint.part for prior in images.priors])[rays.image]
    image_statistic, statistic = np.zeros(len(images)), np.zeros(len(rays))
    converged, judgements, last, before, judged, sure, variance = False, 0, state, weight, weight, False, images.prior_variance
    while not converged and judgements < MAX_ITERATIONS:
        judgements += 1
        step = _advance(images, rays, state, anchor, reach, weight)
        last, before, state = state, weight, step.state
        if step.shortened:  # far from the solution nothing can be judged
            sure = False
            continue
        theta = state.theta
        moved = np.abs(moved_rays(state.linear, theta - last.theta)[state.seen]).max(initial=0.0)
        strayed = _strayed(last, state, weight)
        near = moved < NEAR_SIGMAS or (honest and strayed < NEAR_ENOUGH_SIGMAS)
        # while images move, what contradicts a point may be their doing: then only the likeliest blunder goes, with no doubt about it
        judgeable = np.where(state.seen, candidates if judgements <= FREE_DECISIONS else weight, 0.0)
        # what was decided near the solution will not be decided otherwise a hundredth of a sigma on
        if not (sure and moved < NEAR_ENOUGH_SIGMAS and _farthest(last, state, weight) < NEAR_ENOUGH_SIGMAS):
            doubt = step.noise if near else 0.0
            judged, statistic = reject_blunders(state.linear, judgeable, theta, step.estimate.covariance, doubt, weight, testable)
            judged = worst_of_sets(judged, weight, statistic, of_set, rays.point)
            variance = step.estimate.variance
        worst = image_statistics(theta, variance, np.where(camera[:, None], images.prior_variance, 0.0))
        decided = bool(np.array_equal(judged, weight))
        # images are judged once the rays have been: a blunder must not be blamed on its camera
        restless = judgements % PATIENCE == 0 and np.count_nonzero(judged != weight) > RESTLESS * len(rays)
        free = adjustable & ~released
        bad = _to_release(worst, state.linear, judgeable, judged, free, int(adjustable.sum())) & (decided or restless)
        image_statistic = np.where(released, image_statistic, worst.max(axis=1, initial=0.0))
        rests = moved < tolerance * CONVERGED_SIGMAS and _points_stand(last, state, weight, tolerance)
        linear = strayed < CONVERGED_SIGMAS and (moved < NEAR_ENOUGH_SIGMAS or (near and not to_rest))
        converged = decided and not bad.any() and (rests or linear)
        weight, released = judged, released | bad
        sure = decided and not bad.any() and near
        if bad.any():
            images, state, honest = images.release(bad), replace(state, whitened=None), False

    iteration += judgements
    weight = np.where(state.seen, weight, 0.0)
    blind = unseen_image(state.linear, rays.accepted, state.seen)
    adrift = _adrift(rays, weight, np.linalg.norm(state.ground - anchor, axis=1), reach)
    if blind is not None:
        status = Status(Cause.UNSEEN, converged, iteration, *blind)
    elif adrift is not None:
        status = Status(Cause.ADRIFT, False, iteration, point=adrift)
    elif converged:
        status = Status(Cause.CONVERGED, True, iteration)
    else:
        shift = state.theta - last.theta, state.ground - last.ground
        status = diagnose(state.linear, weight, shift, weight != before, iteration, tolerance * CONVERGED_SIGMAS)
    final = residuals(state.linear, weight, state.theta)
    return Adjustment(state.theta, state.ground, weight > 0.0, statistic, released, image_statistic, final, status)


def _sets(images: ImageSet) -> NDArray[np.int64]:
    """Number (m,) of the set of correlated control that each image is a view of; -1 for all others."""
    names: dict[str, int] = {}
    return np.array([-1 if p.joint is None else names.setdefault(p.block_id, len(names)) for p in images.priors], dtype=np.int64)


def _to_release(
    worst: Array, linear: LinearRays, tested: Array, judged: Array, free: NDArray[np.bool_], adjustable: int
) -> NDArray[np.bool_]:
    """Images (m,) whose prior is given up now, of those that have one (``free``): never more than half of all that can be adjusted.

    Without most of their priors images could say anything.
    """
    suspected = np.where(free[:, None], worst, 0.0)
    bad = (bad_cameras(suspected, linear) | deserted_image(linear, tested, judged, free)) & free
    room = max(adjustable // 2 - (adjustable - int(free.sum())), 0)
    least = np.argsort(np.where(bad, suspected.max(axis=1, initial=0.0), np.inf), kind="stable")
    bad[least[: max(int(bad.sum()) - room, 0)]] = False
    return bad


def _strayed(last: _State, state: _State, weight: Array) -> float:
    """How far the residuals of accepted rays after a step are from those that it promised, in sigmas: how far it was from linear."""
    promised = residuals_of(last.linear, state.theta, state.ground - last.ground)
    found = state.linear.y - moved_rays(state.linear, state.theta)
    return float(np.abs(promised - found)[weight > 0.0].max(initial=0.0))


def _points_stand(last: _State, state: _State, weight: Array, tolerance: float) -> bool:
    """True when a step has moved no point in any way that its rays would show; bounds grow with ``tolerance``."""
    shift = np.abs(state.ground - last.ground).max(initial=0.0)
    return bool(shift < tolerance * CONVERGED_METRES or _farthest(last, state, weight) < tolerance * CONVERGED_SIGMAS)


def _farthest(last: _State, state: _State, weight: Array) -> float:
    """The farthest that points' moves have moved an accepted ray, in sigmas."""
    return float(np.abs(moved_by_ground(state.linear, state.ground - last.ground)[weight > 0.0]).max(initial=0.0))


def _advance(images: ImageSet, rays: Rays, state: _State, anchor: Array, reach: Array, weight: Array) -> _Step:
    """One Gauss-Newton step, points within reach (n,) of their anchors; shortened when it would make matters worse.

    A ray of a point that its camera does not see where both now are is left out of this step.
    """
    linear, weight = state.linear, np.where(state.seen, weight, 0.0)
    sums = eliminate(linear, weight, len(images))
    estimate = estimate_images(sums, images.prior, images.parameters)
    placing = _placing(rays, weight, state.seen)
    determined, correction = placed(linear, placing, estimate.theta)
    offset = state.ground + correction - anchor
    distance = np.linalg.norm(offset, axis=1)
    offset *= (reach / np.maximum(distance, reach))[:, None]
    # a point that stays, or is held back, is not where its rays want it: it does not tell whether the step was good
    moves = placing * determined[rays.point]
    free = weight * (moves > 0.0) * (distance <= reach)[rays.point]
    reached, shortened = _shortened(images, rays, state, moves, free, estimate, anchor + offset)
    return _Step(reached, estimate, noise_bound(estimate.chi_square, sums.redundancy), shortened)


def _adrift(rays: Rays, weight: Array, distance: Array, reach: Array) -> int | None:
    """The first of the points that end where they are held back, when these are most, and cameras known to kilometres only; else None.

    Cameras known to metres are linear as far as points may run along weak rays. Others are not: what a linearisation so far from the
    solution says of its accuracy is not true.
    """
    if 2 * np.count_nonzero(weight) < np.count_nonzero(rays.accepted):
        return None  # rays that contradict each other are another cause
    used = np.bincount(rays.point[weight > 0.0], minlength=len(distance)) >= 2
    held = used & (reach > REACH_METRES) & (distance > (1.0 - 1e-9) * reach)
    return int(np.argmax(held)) if 2 * np.count_nonzero(held) > np.count_nonzero(used) else None


def _placing(rays: Rays, weight: Array, seen: NDArray[np.bool_]) -> Array:
    """Weights (r,) of the rays that say where points are: the accepted ones, and all of a point that has fewer than two of these.

    Whether its rays are blunders can only be told where they would have the point.
    """
    lost = np.bincount(rays.point[weight > 0.0], minlength=int(rays.point.max(initial=-1)) + 1)[rays.point] < 2
    return np.where(lost, (rays.accepted & seen).astype(np.float64), weight)


def _shortened(
    images: ImageSet, rays: Rays, old: _State, moves: Array, free: Array, estimate: ImageEstimate, ground: Array
) -> tuple[_State, bool]:
    """The state that a step reaches, halved until the weighted squares fall: for points that run away, else for everything.

    ``moves`` (r,) are the weights of the rays whose points move, ``free`` those of the rays whose squares are to fall together. Returns
    also whether the step was shortened.
    """
    theta, whitened = estimate.theta, estimate.whitened
    # after a change of the a priori model its squares cannot be compared: then the rays alone must fit better
    prior_weight = 0.0 if old.whitened is None else 1.0
    total = (1.0 + RISE) * (float(free @ old.squares) + old.prior_squares) + RISE

    def by_point(squares: Array) -> Array:
        return np.asarray(np.bincount(rays.point, moves * squares, len(ground)), dtype=np.float64)

    before = by_point(old.squares)
    for halvings in range(HALVINGS + 1):
        new = _State.at(images, rays, theta, whitened, ground)
        after, left = by_point(new.squares), float(free @ new.squares)
        away, falls = after > before + SLACK, left + prior_weight * new.prior_squares <= total
        if away.any() or not falls:  # because of what the step has promised, or because the promise does not hold?
            promised, staying = (
                np.fmin(np.square(residuals_of(old.linear, theta, shift)).sum(axis=1), UNSEEN)
                for shift in (ground - old.ground, 0.0 * ground)
            )
            # a point that is worse off than it would be had it stayed, and than it was promised
            worse = np.maximum(by_point(promised), by_point(staying))
            away = after > np.minimum(RUNAWAY * (by_point(promised) + SLACK), CURVED * worse + SLACK)
            falls = falls or left <= PROMISED * float(free @ promised) + RISE
        if falls and not away.any():
            return new, halvings > 0
        if away.any() and 2 * np.count_nonzero(away) < len(away):
            ground = np.where(away[:, None], 0.5 * (old.ground + ground), ground)
        else:
            theta, ground = 0.5 * (old.theta + theta), 0.5 * (old.ground + ground)
            whitened = whitened if old.whitened is None else 0.5 * (old.whitened + whitened)
    return (new if not ((moves > 0.0) & (new.squares >= UNSEEN)).any() else old), True


def reach_metres(images: ImageSet, rays: Rays, linear: LinearRays) -> Array:
    """Metres (n,) within which each point is linearised, of where it was registered: `REACH_METRES`, or what its cameras explain.

    ``linear`` are the rays linearised at unadjusted cameras.
    """
    reach = np.full(len(linear.first) - 1, REACH_METRES)
    np.maximum.at(reach, rays.point, explained_metres(linear.by_ground, linear.by_parameters, images.prior_variance[rays.image]))
    return reach


def round_off(reach: Array) -> float:
    """By how much round-off lets an adjustment move on: with the square of how much worse its cameras are known than usual."""
    return float(reach.max(initial=REACH_METRES) / REACH_METRES) ** 2
