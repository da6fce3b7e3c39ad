"""Blunders: planted ones are found and nothing else, and without any the tests reject as seldom as their critical values say."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.stats import binom, norm

from submin.adjustment.blunders import (
    CRITICAL_RAY,
    ROBUST_SCALE,
    bad_cameras,
    critical_image,
    image_statistics,
    reject_blunders,
    residuals,
    robust_weights,
)
from submin.adjustment.elimination import LinearRays, eliminate
from submin.adjustment.estimation import ImageEstimate, estimate_images
from submin.adjustment.priors import APriori, ImagePrior, prior_factor, prior_variance
from submin.sensors import sensor_named

Array = NDArray[np.float64]
RPC = sensor_named("rpc")

P = 6


@dataclass(frozen=True)
class Simulation:
    """Rays of a network with known truth: ``y = A theta + B x + v``, ``v ~ N(0, I)``."""

    linear: LinearRays
    theta: Array
    prior: sp.csr_array
    priors: tuple[ImagePrior, ...]

    @property
    def images(self) -> int:
        return len(self.priors)

    def ray(self, point: int, place: int = 0) -> int:
        """Row of a ray of a point."""
        return int(self.linear.first[point]) + place

    def moved(self, shifts: dict[int, tuple[float, float]]) -> Simulation:
        """The same with some rays (by row) moved by so many sigmas in sample and line."""
        y = self.linear.y.copy()
        for row, shift in shifts.items():
            y[row] += shift
        return replace(self, linear=replace(self.linear, y=y))


def simulate(seed: int, counts: NDArray[np.int64], images: int = 6, theta: Array | None = None, span: int | None = None) -> Simulation:
    """Points seen by ``counts`` (n,) images each, from six directions; of ``span`` neighbouring images when that is given."""
    rng = np.random.default_rng(seed)
    tilt = np.array([[0.5, 0.0], [-0.5, 0.1], [0.0, 0.5], [0.1, -0.5], [0.4, 0.4], [-0.4, -0.3]])
    image = []
    for count in counts:
        start = 0 if span is None else rng.integers(0, images - span + 1)
        image.append(start + np.sort(rng.choice(images if span is None else span, count, replace=False)))
    rows = np.concatenate(image).astype(np.int32)
    rays = len(rows)
    direction = tilt[rows % 6] + rng.normal(0.0, 0.03, (rays, 2))
    # two metres a sigma: half a pixel of sigma, a metre of pixel; height moves a ray by its tilt
    by_ground = np.zeros((rays, 2, 3))
    by_ground[:, 0, 0] = by_ground[:, 1, 1] = 2.0
    by_ground[:, :, 2] = -2.0 * direction
    by_parameters = np.zeros((rays, 2, P))
    place = rng.uniform(-1.0, 1.0, (len(counts), 2))[np.repeat(np.arange(len(counts)), counts)]
    for c in range(2):
        by_parameters[:, c, 3 * c] = 2.0
        by_parameters[:, c, 3 * c + 1 : 3 * c + 3] = 2.0 * (place + 0.1 * rng.normal(size=(rays, 2)))
    priors = tuple(ImagePrior(f"b{i}", f"p{i}", 0.0, APriori(10.0, 1.0, 0.0), RPC.parameters) for i in range(images))
    factor = prior_factor(priors, P)
    if theta is None:
        theta = np.asarray(factor @ rng.normal(size=factor.shape[1])).reshape(images, P)
    ground = rng.normal(0.0, 30.0, (len(counts), 3))
    y = np.einsum("rcp,rp->rc", by_parameters, theta[rows]) + rng.normal(size=(rays, 2))
    y += np.einsum("rck,rk->rc", by_ground, np.repeat(ground, counts, axis=0))
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Simulation(LinearRays(first, rows, by_ground, by_parameters, y), theta, factor, priors)


def estimate(simulation: Simulation, weight: Array | None = None) -> ImageEstimate:
    weight = np.ones(len(simulation.linear.image)) if weight is None else weight
    return estimate_images(eliminate(simulation.linear, weight, simulation.images), simulation.prior, P)


def judged(simulation: Simulation) -> tuple[Array, Array]:
    """Weights and statistics of all rays, judged at a robust estimate of the images as the adjustment does it."""
    every = np.ones(len(simulation.linear.image))
    weight = every
    for _ in range(5):
        weight = robust_weights(simulation.linear, every, estimate(simulation, weight).theta)
    found = estimate(simulation, (weight > 0.05).astype(np.float64))
    return reject_blunders(simulation.linear, every, found.theta, found.covariance)


def judged_together(simulation: Simulation) -> tuple[Array, Array]:
    """The same at the estimate of all rays, as it is without blunders."""
    found = estimate(simulation)
    return reject_blunders(simulation.linear, np.ones(len(simulation.linear.image)), found.theta, found.covariance)


def points(*numbers_of_rays: int, of_each: int = 60) -> NDArray[np.int64]:
    return np.tile(np.array(numbers_of_rays, dtype=np.int64), of_each)


# Rays


@pytest.mark.parametrize("shift", [(40.0, 0.0), (0.0, -40.0)])
@pytest.mark.parametrize("rays", [3, 4, 6])
def test_a_planted_blunder_is_found_and_only_it(rays: int, shift: tuple[float, float]) -> None:
    simulation = simulate(1, points(3, 4, 6))
    assert judged(simulation)[0].all()
    point = int(np.flatnonzero(np.diff(simulation.linear.first) == rays)[7])
    for place in range(rays):
        planted = simulation.ray(point, place)
        weight, statistic = judged(simulation.moved({planted: shift}))
        assert np.flatnonzero(weight == 0.0).tolist() == [planted]
        assert statistic[planted] > CRITICAL_RAY


@pytest.mark.parametrize(("rays", "share"), [(3, 0.84), (4, 0.99), (6, 0.99)])
def test_a_blunder_is_located_or_takes_its_point_along(rays: int, share: float) -> None:
    # One blunder of 40 sigmas in every point, in any direction, at the images' true corrections. Two rays' blunders look alike when they
    # are along the epipolar line that the two share: with three rays that is 15 of 100 directions, and there no ray is blamed for another.
    simulation = simulate(18, points(rays, of_each=600))
    rng = np.random.default_rng(1)
    planted = simulation.linear.first[:-1] + rng.integers(0, rays, 600)
    angle = rng.uniform(0.0, 2.0 * np.pi, 600)
    moved = simulation.moved({int(row): (40.0 * np.cos(a), 40.0 * np.sin(a)) for row, a in zip(planted, angle, strict=True)})
    covariance = estimate(simulation).covariance
    weight, _ = reject_blunders(moved.linear, np.ones(len(moved.linear.image)), simulation.theta, covariance)
    is_planted = np.isin(np.arange(len(weight)), planted)
    assert (weight[planted] == 0.0).all()
    assert ((weight == 0.0) == is_planted).reshape(600, rays).all(axis=1).mean() > share


def one_orbit(seed: int, count: int) -> Simulation:
    """Points of three rays of one orbit plane: forward, down and backward along the track."""
    simulation = simulate(seed, points(3, of_each=count), images=3)
    by_ground = simulation.linear.by_ground.copy()
    by_ground[:, :, 2] = -2.0 * np.array([[0.0, 0.5], [0.0, 0.02], [0.0, -0.45]])[simulation.linear.image]
    linear = replace(simulation.linear, by_ground=by_ground, y=np.random.default_rng(seed).normal(size=simulation.linear.y.shape))
    return replace(simulation, linear=linear, theta=np.zeros((3, P)))


def squares_without(simulation: Simulation, point: int, out: tuple[int, ...]) -> float:
    """Squares of the residuals of a point's rays at its best place, some left out, the images without error."""
    rows = np.delete(np.arange(simulation.linear.first[point], simulation.linear.first[point + 1]), out)
    b, y = simulation.linear.by_ground[rows].reshape(-1, 3), simulation.linear.y[rows].ravel()
    left = y - b @ np.linalg.lstsq(b, y, rcond=None)[0]
    return float(left @ left)


def test_three_rays_of_one_orbit_plane_cannot_tell_whose_a_blunder_along_the_track_is() -> None:
    """What decision 004 proves: whichever ray goes, the squares of the others are those of noise, and the same for all blunders."""
    for shift in (0.0, 20.0, 200.0):
        simulation = one_orbit(19, 200).moved({3 * j + j % 3: (0.0, shift) for j in range(200)})
        squares = np.array([[squares_without(simulation, j, (a,)) for a in range(3)] for j in range(200)])
        if shift == 0.0:
            noise = squares
        np.testing.assert_allclose(squares, noise, rtol=0.0, atol=1e-9)
        assert np.mean(squares) == pytest.approx(1.0, abs=0.3), "chi-square of one degree of freedom"
    found = estimate(simulation)
    weight, _ = reject_blunders(simulation.linear, np.ones(600), np.zeros((3, P)), 1e-6 * found.covariance)
    assert not weight.any(), "so no ray of them stays"


def test_the_second_of_two_blunders_of_three_rays_can_hide() -> None:
    """One across and one along the track: once the first ray has gone, the other two meet as well as good ones do."""
    simulation = one_orbit(20, 100).moved({3 * j: (60.0, 0.0) for j in range(100)} | {3 * j + 2: (0.0, 60.0) for j in range(100)})
    clean = one_orbit(20, 100)
    for j in range(100):
        assert squares_without(simulation, j, (0,)) == pytest.approx(squares_without(clean, j, (0,)), abs=1e-9)
    weight, _ = reject_blunders(simulation.linear, np.ones(300), np.zeros((3, P)), 1e-6 * estimate(simulation).covariance)
    weight = weight.reshape(-1, 3)
    assert not weight[:, 0].any() and (weight[:, 2] == 1.0).mean() > 0.9


def test_a_good_ray_is_not_taken_for_one_of_two_blunders() -> None:
    # the ray whose loss drops the squares most can be a good one that two blunders pull away from
    simulation = simulate(21, points(5, of_each=400))
    rng = np.random.default_rng(2)
    moved, planted = {}, np.zeros((400, 5), dtype=bool)
    for j in range(400):
        for place in rng.choice(5, 2, replace=False):
            angle = rng.uniform(0.0, 2.0 * np.pi)
            moved[simulation.ray(j, int(place))] = (40.0 * np.cos(angle), 40.0 * np.sin(angle))
            planted[j, place] = True
    covariance = estimate(simulation).covariance
    weight, _ = reject_blunders(simulation.moved(moved).linear, np.ones(2000), simulation.theta, covariance)
    gone = weight.reshape(400, 5) == 0.0
    assert (gone[planted].mean(), gone[~planted].mean()) == (1.0, pytest.approx(0.0, abs=0.05))


def test_rays_of_many_images_are_told_one_after_another() -> None:
    # more sets of two of 24 rays than are tried
    simulation = simulate(22, np.full(40, 24, dtype=np.int64), images=24)
    rng = np.random.default_rng(3)
    planted = [simulation.ray(j, int(place)) for j in range(40) for place in np.sort(rng.choice(24, 3, replace=False))]
    moved = simulation.moved({row: tuple(40.0 * rng.choice([-1.0, 1.0], 2)) for row in planted})
    weight, _ = reject_blunders(moved.linear, np.ones(960), simulation.theta, estimate(simulation).covariance)
    assert np.flatnonzero(weight == 0.0).tolist() == planted


def test_less_noise_leaves_less_doubt() -> None:
    simulation = simulate(23, points(3, of_each=600))
    rng = np.random.default_rng(4)
    angle = rng.uniform(0.0, 2.0 * np.pi, 600)
    quiet = replace(simulation.linear, y=np.zeros_like(simulation.linear.y))
    moved = replace(simulation, linear=quiet).moved({3 * j: (40.0 * np.cos(a), 40.0 * np.sin(a)) for j, a in enumerate(angle)})
    covariance = estimate(simulation).covariance
    every, truth = np.ones(1800), np.zeros((6, P))
    weights = [reject_blunders(moved.linear, every, truth, covariance, noise)[0].reshape(600, 3) for noise in (1.0, 0.1, 0.01)]
    located = [(weight == [0.0, 1.0, 1.0]).all(axis=1).mean() for weight in weights]
    assert located[0] < 0.9 < located[1] < located[2]


def test_two_blunders_of_a_point_both_go() -> None:
    simulation = simulate(2, points(3, 6))
    planted = [simulation.ray(11, 1), simulation.ray(11, 4)]
    weight, _ = judged(simulation.moved({planted[0]: (40.0, 0.0), planted[1]: (0.0, 30.0)}))
    assert np.flatnonzero(weight == 0.0).tolist() == planted


def test_two_rays_that_contradict_each_other_both_go() -> None:
    simulation = simulate(3, points(2, 4))
    point = 10
    assert np.diff(simulation.linear.first)[point] == 2
    # across the plane that the two rays span: along it a shift is a change of height, which no third ray denies
    height = simulation.linear.by_ground[simulation.ray(point), :, 2] - simulation.linear.by_ground[simulation.ray(point, 1), :, 2]
    along = height / np.linalg.norm(height)
    across = np.array([-along[1], along[0]])
    for place in (0, 1):
        weight, statistic = judged(simulation.moved({simulation.ray(point, place): tuple(25.0 * across)}))
        assert np.flatnonzero(weight == 0.0).tolist() == [simulation.ray(point, 0), simulation.ray(point, 1)]
        assert (statistic[[simulation.ray(point, 0), simulation.ray(point, 1)]] > CRITICAL_RAY).all()
        assert judged(simulation.moved({simulation.ray(point, place): tuple(25.0 * along)}))[0].all()


def test_three_rays_of_which_two_go_leave_a_single_one() -> None:
    simulation = simulate(4, points(3))
    rows = [simulation.ray(5, place) for place in range(3)]
    weight, _ = judged(simulation.moved({rows[0]: (60.0, 0.0), rows[1]: (0.0, 60.0), rows[2]: (-60.0, -60.0)}))
    assert weight[rows].sum() <= 1.0
    assert np.delete(weight, rows).all()


def test_single_rays_are_not_judged() -> None:
    simulation = simulate(5, points(1, 4))
    single = simulation.ray(0)
    weight, statistic = judged(simulation.moved({single: (1000.0, 0.0)}))
    assert weight.all() and statistic[single] == 0.0


def test_rays_rejected_before_stay_out() -> None:
    simulation = simulate(6, points(4))
    before = np.ones(len(simulation.linear.image))
    before[[3, 10, 11]] = 0.0
    found = estimate(simulation, before)
    weight, statistic = reject_blunders(simulation.linear, before, found.theta, found.covariance)
    np.testing.assert_array_equal(weight, before)
    assert not statistic[[3, 10, 11]].any()
    assert before.sum() == len(before) - 3


def test_order_of_rejection_does_not_touch_other_points() -> None:
    simulation = simulate(7, points(2, 3, 5))
    alone = simulation.moved({simulation.ray(1): (30.0, 10.0)})
    found = estimate(alone)
    weight = np.ones(len(alone.linear.image))
    both = alone.moved({simulation.ray(5): (-20.0, 30.0)})
    one, _ = reject_blunders(alone.linear, weight, found.theta, found.covariance)
    other, _ = reject_blunders(both.linear, weight, found.theta, found.covariance)
    rest = np.ones(len(weight), dtype=bool)
    rest[simulation.linear.first[5] : simulation.linear.first[6]] = False
    np.testing.assert_array_equal(one[rest], other[rest])


def test_false_alarms_are_as_rare_as_the_critical_value_says() -> None:
    alarms, tested = 0, 0
    for seed in range(10):
        simulation = simulate(100 + seed, points(3, 4, 6, of_each=400))
        weight, _ = judged_together(simulation)
        alarms += int((weight == 0.0).sum())
        tested += 2 * len(weight)
    assert tested > 100_000
    # neither more, nor so few that the test must be blind: every coordinate of these points can be tested
    p = 2.0 * norm.sf(CRITICAL_RAY)
    assert binom.ppf(1e-3, tested // 2, p) <= alarms <= binom.ppf(1.0 - 1e-4, tested, p)


def test_statistics_of_good_rays_are_normal() -> None:
    # three-ray points: little redundancy, so a wrong variance of the residuals shows
    simulation = simulate(200, points(3, of_each=4000), images=3)
    _, statistic = judged_together(simulation)
    rays = len(statistic)
    for critical in (2.0, 2.5, 3.0):
        p = 2.0 * norm.sf(critical)
        # a ray counts the larger of two coordinates, and the rays of a point go up and down together
        spread = 4.0 * np.sqrt(6.0 * p * rays)
        assert p * rays - spread <= (statistic > critical).sum() <= 2.0 * p * rays + spread
    assert p * rays > spread / 4.0


def test_statistics_are_residuals_over_their_standard_deviations() -> None:
    simulation = simulate(201, points(2, 3, 5, of_each=4), images=5)
    linear, found = simulation.linear, estimate(simulation)
    weight, statistic = judged_together(simulation)
    assert weight.all()
    for j in range(len(linear.first) - 1):
        rows = np.arange(linear.first[j], linear.first[j + 1])
        by_image = np.zeros((len(rows), 2, simulation.images, P))
        by_image[np.arange(len(rows)), :, linear.image[rows]] = linear.by_parameters[rows]
        a, b = by_image.reshape(2 * len(rows), -1), linear.by_ground[rows].reshape(-1, 3)
        left = np.eye(len(b)) - b @ np.linalg.pinv(b)
        residual = left @ (linear.y[rows].ravel() - a @ found.theta.ravel())
        variance = np.diag(left - left @ a @ found.covariance @ a.T @ left)
        w = np.where(variance > 1e-3, np.abs(residual) / np.sqrt(np.maximum(variance, 1e-3)), 0.0)
        np.testing.assert_allclose(statistic[rows], w.reshape(-1, 2).max(axis=1), rtol=1e-6)


def test_statistics_allow_for_poorly_known_images() -> None:
    # two images with eight points in all: without the images' covariance the residuals would look far too small
    squares = []
    for seed in range(400):
        simulation = simulate(1000 + seed, points(2, of_each=8), images=2)
        _, statistic = judged_together(simulation)
        squares.append(statistic.reshape(-1, 2)[:, 0] ** 2)
    tested = np.concatenate(squares)
    # the two rays of a point share one residual: w^2 of a normal variable has a mean of 1
    assert np.mean(tested) == pytest.approx(1.0, abs=6.0 * np.sqrt(2.0 / 400 / 2))
    assert (tested > 0.0).mean() > 0.9


# Robust weights and residuals


def plain_residuals(simulation: Simulation, theta: Array, weight: Array) -> tuple[Array, Array]:
    """Residuals (r, 2) of every point's accepted rays at its best place, and their redundancy numbers (r, 2)."""
    linear = simulation.linear
    residual, free = np.full(linear.y.shape, np.nan), np.full(linear.y.shape, np.nan)
    for j in range(len(linear.first) - 1):
        rows = np.arange(linear.first[j], linear.first[j + 1])
        rows = rows[weight[rows] > 0.0]
        root = np.repeat(np.sqrt(weight[rows]), 2)
        b = root[:, None] * linear.by_ground[rows].reshape(-1, 3)
        y = root * (linear.y[rows] - np.einsum("rcp,rp->rc", linear.by_parameters[rows], theta[linear.image[rows]])).ravel()
        left = np.eye(len(b)) - b @ np.linalg.pinv(b)
        residual[rows] = (left @ y / root).reshape(-1, 2)
        free[rows] = np.diag(left).reshape(-1, 2)
    return residual, free


def test_residuals_are_those_of_each_point_at_its_best_place() -> None:
    simulation = simulate(8, points(1, 2, 3, 5, of_each=8))
    weight = np.ones(len(simulation.linear.image))
    weight[[4, 9, 30]] = 0.0
    theta = estimate(simulation, weight).theta
    found = residuals(simulation.linear, weight, theta)
    expected, _ = plain_residuals(simulation, theta, weight)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    assert np.isnan(found[[4, 9, 30]]).all() and np.isfinite(np.delete(found, [4, 9, 30], axis=0)).all()


def test_robust_weights_are_those_of_cauchy() -> None:
    simulation = simulate(9, points(3, 5, of_each=20)).moved({7: (30.0, 0.0), 40: (3.0, -4.0)})
    weight = np.random.default_rng(1).uniform(0.2, 1.0, len(simulation.linear.image))
    weight[[12, 13]] = 0.0
    theta = estimate(simulation, weight).theta
    found = robust_weights(simulation.linear, weight, theta)
    residual, free = plain_residuals(simulation, theta, weight)
    expected = 1.0 / (1.0 + (residual**2).sum(axis=1) / free.sum(axis=1) / ROBUST_SCALE**2)
    expected[[12, 13]] = 0.0
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert found[7] < 0.1 < 0.5 < np.median(found)


def test_rays_that_nothing_checks_keep_their_weight() -> None:
    simulation = simulate(10, points(1, 4, of_each=10))
    found = robust_weights(simulation.linear, np.ones(len(simulation.linear.image)), simulation.theta)
    np.testing.assert_array_equal(found[simulation.linear.first[:-1][np.diff(simulation.linear.first) == 1]], 1.0)


def test_robust_start_gets_near_the_truth_through_many_blunders() -> None:
    simulation = simulate(11, points(4, 5, of_each=50))
    rng = np.random.default_rng(3)
    planted = rng.choice(len(simulation.linear.image), 45, replace=False)
    simulation = simulation.moved({int(row): tuple(rng.choice([-1.0, 1.0], 2) * rng.uniform(20.0, 60.0, 2)) for row in planted})
    weight, candidates = np.ones(len(simulation.linear.image)), np.ones(len(simulation.linear.image))
    for _ in range(10):
        weight = robust_weights(simulation.linear, candidates, estimate(simulation, weight).theta) if weight.all() else weight
        weight = robust_weights(simulation.linear, weight, estimate(simulation, weight).theta)
    good = np.setdiff1d(np.arange(len(weight)), planted)
    assert np.median(weight[planted]) < 0.02
    assert np.median(weight[good]) > 0.8


# Images


def bad(simulation: Simulation) -> tuple[NDArray[np.bool_], Array]:
    found = estimate(simulation)
    statistics = image_statistics(found.theta, found.variance, prior_variance(simulation.prior, P))
    return bad_cameras(statistics, simulation.linear), statistics


def off_by(images: int, errors: dict[int, float], seed: int = 1) -> Array:
    """Corrections drawn from the a priori model, some images off by so many pixels in sample."""
    rng = np.random.default_rng(seed)
    theta: Array = rng.normal(size=(images, P)) * np.array([10.0, 1.0, 1.0, 10.0, 1.0, 1.0])
    for image, error in errors.items():
        theta[image, 0] = error
    return theta


@pytest.mark.parametrize("error", [80.0, -80.0])
@pytest.mark.parametrize("image", range(6))
def test_a_bad_camera_is_named_and_its_neighbours_are_not(image: int, error: float) -> None:
    found, statistics = bad(simulate(12, points(3, 4, 6), theta=off_by(6, {image: error})))
    assert np.flatnonzero(found).tolist() == [image]
    assert statistics[image, 0] > critical_image(6 * P)


def test_after_its_release_nobody_else_is_bad() -> None:
    simulation = simulate(13, points(3, 4, 6), theta=off_by(6, {2: 80.0}))
    assert np.flatnonzero(bad(simulation)[0]).tolist() == [2]
    priors = tuple(replace(p, released=i == 2) for i, p in enumerate(simulation.priors))
    released = replace(simulation, priors=priors, prior=prior_factor(priors, P))
    assert not bad(released)[0].any()
    # and its correction is now what the others say
    assert estimate(released).theta[2, 0] == pytest.approx(80.0, abs=4.0 * 10.0 / np.sqrt(5.0) + 1.0)


def test_bad_cameras_far_apart_are_named_at_once() -> None:
    simulation = simulate(14, points(3, of_each=400), images=18, span=4, theta=off_by(18, {2: 80.0, 15: -90.0}))
    assert np.flatnonzero(bad(simulation)[0]).tolist() == [2, 15]


def test_of_two_bad_cameras_that_share_points_the_worse_goes_first() -> None:
    simulation = simulate(15, points(4, 6), theta=off_by(6, {1: 120.0, 4: -75.0}))
    assert np.flatnonzero(bad(simulation)[0]).tolist() == [1]
    priors = tuple(replace(p, released=i == 1) for i, p in enumerate(simulation.priors))
    assert np.flatnonzero(bad(replace(simulation, prior=prior_factor(priors, P)))[0]).tolist() == [4]


def test_good_images_are_seldom_called_bad() -> None:
    statistics = np.concatenate([bad(simulate(300 + seed, points(3, 5, of_each=15)))[1].ravel() for seed in range(90)])
    tested = statistics[statistics > 0.0]
    assert len(tested) > 2500
    # parameters of one network are dependent: allow for some six of them going together
    for critical in (1.96, 2.58, 3.29):
        p = 2.0 * norm.sf(critical)
        assert abs((tested > critical).sum() - p * len(tested)) < 4.0 * np.sqrt(6.0 * p * len(tested))


def test_a_good_set_of_images_has_a_bad_one_once_in_twenty_times_at_most() -> None:
    named = sum(bool(bad(simulate(600 + seed, points(3, 5, of_each=15)))[0].any()) for seed in range(100))
    assert named <= binom.ppf(1.0 - 1e-3, 100, 0.05)


def test_images_that_nothing_checks_are_not_judged() -> None:
    simulation = simulate(16, points(3, of_each=20), images=7, span=3)
    alone = 7
    theta = np.vstack([estimate(simulation).theta, np.full(P, 500.0)])
    variance = np.tile([100.0, 1.0, 1.0, 100.0, 1.0, 1.0], (8, 1))
    covariance = np.diag(np.concatenate([0.5 * variance[:alone].ravel(), 0.995 * variance[alone]]))
    statistics = image_statistics(theta, np.diag(covariance).reshape(theta.shape), variance)
    assert not statistics[alone].any()
    assert statistics[:alone].all()
    np.testing.assert_allclose(statistics[:alone], np.abs(theta[:alone]) / np.sqrt(0.5 * variance[:alone]), rtol=1e-12)


def test_no_suspects_no_bad_cameras() -> None:
    simulation = simulate(17, points(3, of_each=5))
    assert not bad_cameras(np.full((6, P), critical_image(6 * P)), simulation.linear).any()
    assert not bad_cameras(np.zeros((6, P)), simulation.linear).any()
