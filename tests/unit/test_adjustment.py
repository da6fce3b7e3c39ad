"""Adjustment of a simulated triplet: back to the truth as closely as it says, whatever the order of its rays, and rid of blunders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from submin.adjustment import blunders
from submin.adjustment.adjustment import REACH_METRES, Adjustment, adjust
from submin.adjustment.elimination import eliminate, linearise, point_factors
from submin.adjustment.estimation import estimate_images
from submin.adjustment.explained import EXPLAINED_SIGMAS, explained_metres
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import Rays, sorted_rays
from submin.errors import NumericalError
from submin.geodesy import WGS84, geocentric_to_geodetic, geodetic_to_geocentric, local_axes
from submin.network.sub_min import GroundPart, joint_covariance, loadings
from submin.sensors import Ground, sensor_named
from submin.sensors.frame import quaternion_rotation

Array = NDArray[np.float64]

P = 6
WIDTH = HEIGHT = 10000.0
CENTRE = np.array([5.4, 43.3, 500.0])
SIGMA_PX = 0.3
TRIPLET = ((-0.45, 0.1), (0.0, -0.05), (0.4, 0.15))
"""Tangents of the views to the east and north: images forward, down and backward."""


def camera(tangent_east: float, tangent_north: float) -> dict[str, Any]:
    """RPC of half-metre pixels about the centre, its view leaning by these tangents, bent a little as real ones are."""
    metres = np.array([0.0315 * 81000.0, 0.0225 * 111100.0, 500.0])
    sample = np.zeros(20)
    line = np.zeros(20)
    # numerators over 5,000 pixels of 0.5 m: constant, longitude, latitude, height, then quadratic terms
    sample[1], sample[2], sample[3] = metres[0] / 2500.0, 0.05, tangent_east * metres[2] / 2500.0
    line[1], line[2], line[3] = 0.05, -metres[1] / 2500.0, -tangent_north * metres[2] / 2500.0
    sample[4], sample[7], line[5], line[8] = 2e-4, 3e-4, -2e-4, 1e-4
    denominator = [1.0, 1e-4, -1e-4, 2e-3, *([0.0] * 16)]
    return {
        "LINE_OFF": 4999.5, "SAMP_OFF": 4999.5, "LAT_OFF": CENTRE[1], "LONG_OFF": CENTRE[0], "HEIGHT_OFF": CENTRE[2],
        "LINE_SCALE": 5000.0, "SAMP_SCALE": 5000.0, "LAT_SCALE": 0.0225, "LONG_SCALE": 0.0315, "HEIGHT_SCALE": 500.0,
        "SAMP_NUM_COEFF": sample.tolist(), "LINE_NUM_COEFF": line.tolist(), "SAMP_DEN_COEFF": denominator, "LINE_DEN_COEFF": denominator,
    }  # fmt: skip


def image_set(views: tuple[tuple[float, float], ...] = TRIPLET, a_priori: APriori = APriori(10.0, 1.0, 0.5)) -> ImageSet:  # noqa: B008
    sensor = sensor_named("rpc")
    cameras = np.stack([sensor.pack(camera(*view), WIDTH, HEIGHT) for view in views])
    priors = tuple(ImagePrior("block", "pass", 30.0 * i, a_priori, sensor.parameters) for i in range(len(views)))
    return ImageSet(tuple(f"image {i}" for i in range(len(views))), ("rpc",) * len(views), cameras, priors, len(sensor.parameters))


@dataclass(frozen=True)
class Simulated:
    """A block with known truth."""

    images: ImageSet
    rays: Rays
    ground: Array
    theta: Array


def simulate(seed: int, points: int = 60, images: ImageSet | None = None, theta: Array | None = None, sigma: float = SIGMA_PX) -> Simulated:
    """Points all over the block, each seen by two or more of its images, corrections from the a priori model unless given."""
    images = images or image_set()
    rng, m = np.random.default_rng(seed), len(images)
    geodetic = CENTRE + rng.uniform(-0.9, 0.9, (points, 3)) * [0.028, 0.02, 400.0]
    ground = geodetic_to_geocentric(geodetic)
    if theta is None:
        theta = np.asarray(images.prior @ rng.normal(size=images.prior.shape[1])).reshape(m, P)
    seen = rng.uniform(size=(points, m)) < 0.8
    seen[np.arange(points), rng.integers(0, m, points)] = True
    short = seen.sum(axis=1) < 2
    seen[short] = True
    point, image = (index.astype(np.int32) for index in np.nonzero(seen))
    exact = images.project(theta, images.ground(ground), image, point).image
    observed = exact + rng.normal(0.0, sigma, exact.shape)
    rays = sorted_rays(point, image, observed, np.full(exact.shape, sigma), np.ones(len(point), dtype=np.bool_))
    return Simulated(images, rays, ground, theta)


def adjusted(block: Simulated) -> Adjustment:
    return adjust(block.images, block.rays, intersect(block.images, block.rays, len(block.ground)))


def covariances(block: Simulated, result: Adjustment) -> tuple[Array, Array]:
    """Covariance of the images' corrections (m p, m p) and joint covariance of the points (3n, 3n) at the result."""
    linear = linearise(block.images, block.rays, result.theta, result.ground, result.ground)
    weight = result.accepted.astype(np.float64)
    images = block.images.release(result.released)
    m = estimate_images(eliminate(linear, weight, len(images)), images.prior, P).covariance
    factors = point_factors(linear, weight)
    loading = loadings([GroundPart(result.ground, linear, factors)], np.arange(len(images), dtype=np.int32), P)
    return m, joint_covariance(loading, factors.own, m)


def with_ray_moved(block: Simulated, row: int, shift: tuple[float, float]) -> Simulated:
    observed = block.rays.observed.copy()
    observed[row] += shift
    return replace(block, rays=replace(block.rays, observed=observed))


@pytest.fixture
def no_alarms(monkeypatch: pytest.MonkeyPatch) -> None:
    """One set of good images in twenty has one that is called bad: not in tests about other things."""
    monkeypatch.setattr(blunders, "IMAGE_FAMILY", 1e-9)


@pytest.mark.usefixtures("no_alarms")
def test_triplet_comes_back_to_the_truth_within_its_covariance() -> None:
    images_nees, ground_nees, dimension = [], [], 0
    for seed in range(8):
        block = simulate(seed)
        result = adjusted(block)
        assert result.converged and result.accepted.all() and not result.released.any()
        m, joint = covariances(block, result)
        error = (result.theta - block.theta).ravel()
        images_nees.append(error @ np.linalg.solve(m, error))
        error = (result.ground - block.ground).ravel()
        ground_nees.append(error @ np.linalg.solve(joint, error))
        dimension = len(error)
    # chi-square of 18 and of 3n degrees of freedom, eight times: within four standard deviations
    assert abs(np.mean(images_nees) - 18.0) < 4.0 * np.sqrt(2.0 * 18.0 / 8.0)
    assert abs(np.mean(ground_nees) - dimension) < 4.0 * np.sqrt(2.0 * dimension / 8.0)


@pytest.mark.usefixtures("no_alarms")
def test_covariance_is_no_larger_than_it_must_be() -> None:
    block = simulate(1)
    result = adjusted(block)
    m, joint = covariances(block, result)
    error = result.ground - block.ground
    # the shift that all images share cannot be seen: metres; what they do not share is known to decimetres
    assert 1.0 < np.abs(error).max() < 30.0
    relative = (error - error.mean(axis=0)) @ local_axes(CENTRE[None])[0].T
    assert np.abs(relative[:, :2]).std() < 1.0
    sigma = np.sqrt(np.diag(joint))
    assert 0.2 < np.abs(error.ravel() / sigma).max() < 5.0
    assert np.sqrt(np.diag(m)).max() < 10.5


def test_without_errors_the_truth_comes_back_exactly() -> None:
    block = simulate(2, theta=np.zeros((3, P)), sigma=1e-6)
    block = replace(block, rays=replace(block.rays, sigma=np.full_like(block.rays.sigma, 0.3)))
    result = adjusted(block)
    np.testing.assert_allclose(result.theta, 0.0, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(result.ground, block.ground, rtol=0.0, atol=1e-4)


def test_result_is_a_minimum_of_the_weighted_squares() -> None:
    block = simulate(3)
    result, rays = adjusted(block), block.rays
    fitted = block.images.project(result.theta, block.images.ground(result.ground), rays.image, rays.point, rays.observed).image

    def squares(theta: Array, ground: Array) -> float:
        predicted = block.images.project(theta, block.images.ground(ground), rays.image, rays.point, fitted).image
        u = np.linalg.pinv(block.images.prior.toarray()) @ theta.ravel()
        return float((((block.rays.observed - predicted) / block.rays.sigma) ** 2).sum() + u @ u)

    least = squares(result.theta, result.ground)
    rng = np.random.default_rng(1)
    for size in (1e-3, 1e-1):
        for _ in range(20):
            theta, ground = (at + size * rng.normal(size=at.shape) for at in (result.theta, result.ground))
            assert squares(theta, ground) > least
    # residuals are those of this minimum, in sigmas
    np.testing.assert_allclose(np.nansum(result.residuals**2), squares(result.theta, result.ground) - _prior_part(block, result), rtol=1e-6)


def _prior_part(block: Simulated, result: Adjustment) -> float:
    u = np.linalg.pinv(block.images.prior.toarray()) @ result.theta.ravel()
    return float(u @ u)


def test_order_of_arrival_leaves_no_trace() -> None:
    block = with_ray_moved(simulate(4), 17, (12.0, -9.0))
    order = np.random.default_rng(2).permutation(len(block.rays))
    rays = block.rays
    arrived = sorted_rays(rays.point[order], rays.image[order], rays.observed[order], rays.sigma[order], rays.accepted[order])
    one, other = adjusted(block), adjusted(replace(block, rays=arrived))
    for name in ("theta", "ground", "accepted", "statistic", "residuals", "image_statistic"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_order_of_rays_within_points_is_free() -> None:
    block = with_ray_moved(simulate(5), 17, (12.0, -9.0))
    rays = block.rays
    order = np.lexsort((-rays.image, rays.point))
    one, other = adjusted(block), adjusted(replace(block, rays=rays.take(order)))
    np.testing.assert_array_equal(one.accepted[order], other.accepted)
    np.testing.assert_allclose(other.theta, one.theta, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(other.ground, one.ground, rtol=0.0, atol=1e-7)


def test_order_of_images_is_free() -> None:
    block = simulate(6)
    rays = block.rays
    turned = sorted_rays(rays.point, (2 - rays.image).astype(np.int32), rays.observed, rays.sigma, rays.accepted)
    one, other = adjusted(block), adjusted(replace(block, images=block.images.take([2, 1, 0]), rays=turned))
    np.testing.assert_allclose(other.theta[::-1], one.theta, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(other.ground, one.ground, rtol=0.0, atol=1e-7)


def test_blunders_are_rejected_and_the_rest_is_as_without_them() -> None:
    block = simulate(7, points=80)
    counts = np.bincount(block.rays.point)
    first = block.rays.first(80)
    planted = [int(first[j]) + 1 for j in np.flatnonzero(counts == 3)[[0, 5, 9]]]
    spoilt = block
    for row, shift in zip(planted, ((30.0, 0.0), (0.0, -25.0), (-40.0, 0.0)), strict=True):
        spoilt = with_ray_moved(spoilt, row, shift)
    result = adjusted(spoilt)
    assert result.converged
    assert np.flatnonzero(~result.accepted).tolist() == planted
    assert (result.statistic[planted] > 4.0).all()
    assert np.isnan(result.residuals[planted]).all()
    fewer = replace(block, rays=block.rays.with_accepted(result.accepted))
    expected = adjusted(fewer)
    np.testing.assert_allclose(result.theta, expected.theta, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(result.ground, expected.ground, rtol=0.0, atol=1e-4)


def test_rays_rejected_before_are_not_taken_back() -> None:
    block = simulate(8)
    out = np.ones(len(block.rays), dtype=np.bool_)
    out[[0, 20, 41]] = False
    result = adjusted(replace(block, rays=block.rays.with_accepted(out)))
    np.testing.assert_array_equal(result.accepted, out)


FIVE = (*TRIPLET, (0.1, 0.45), (-0.1, -0.4))


def test_bad_camera_is_released_and_its_neighbours_keep_theirs() -> None:
    images = image_set(FIVE, APriori(10.0, 1.0, 0.0))
    rng = np.random.default_rng(9)
    theta = rng.normal(size=(5, P)) * [6.0, 1.0, 1.0, 6.0, 1.0, 1.0]
    theta[3, 0] = 90.0
    block = simulate(9, images=images, theta=theta)
    result = adjusted(block)
    assert result.converged
    assert np.flatnonzero(result.released).tolist() == [3]
    assert result.image_statistic[3] > 4.0 > result.image_statistic[[0, 1, 2, 4]].max()
    assert result.accepted.mean() > 0.98
    # the shift common to all images apart, its correction is that of the truth
    error = result.theta - theta
    assert abs(error[3, 0] - error[[0, 1, 2, 4], 0].mean()) < 12.0
    m, joint = covariances(block, result)
    ground = (result.ground - block.ground).ravel()
    assert ground @ np.linalg.solve(joint, ground) < len(ground) + 5.0 * np.sqrt(2.0 * len(ground))
    assert error.ravel() @ np.linalg.solve(m, error.ravel()) < 30.0 + 5.0 * np.sqrt(60.0)


@pytest.mark.parametrize("seconds", [60.0, 100.0])
def test_bad_camera_in_a_correlated_block_does_not_drag_its_neighbours(seconds: float) -> None:
    # images half a minute apart are nearly equally wrong, but for one: what it says, once released, must not be believed of the others
    images = image_set(FIVE, APriori(10.0, 1.0, 0.0, "gaussian", seconds))
    nees = []
    for seed in range(6):
        rng = np.random.default_rng(50 + seed)
        theta = np.asarray(images.prior @ rng.normal(size=images.prior.shape[1])).reshape(5, P)
        theta[3, 0] += 90.0
        block = simulate(50 + seed, images=images, theta=theta)
        result = adjusted(block)
        assert result.released[3]
        m, _ = covariances(block, result)
        others = np.delete(np.arange(5 * P), np.arange(3 * P, 4 * P))
        error = (result.theta - theta).ravel()[others]
        nees.append(error @ np.linalg.solve(m[np.ix_(others, others)], error))
    assert np.mean(nees) < 24.0 + 4.0 * np.sqrt(2.0 * 24.0 / 6.0)


def test_weak_points_are_linearised_near_where_they_were_registered() -> None:
    # two images from one viewpoint: rays that meet anywhere
    images = image_set(((0.2, 0.1), (0.2 + 1e-5, 0.1)), APriori(10.0, 1.0, 0.0))
    block = simulate(10, images=images)
    start = intersect(block.images, block.rays, len(block.ground))
    result = adjust(block.images, block.rays, start)
    assert np.linalg.norm(result.ground - start, axis=1).max() <= REACH_METRES + 1e-6
    assert np.isfinite(result.theta).all()
    elsewhere = start + 100.0
    anchored = adjust(block.images, block.rays, start, elsewhere)
    assert np.linalg.norm(anchored.ground - elsewhere, axis=1).max() <= REACH_METRES + 1e-6


def test_points_that_one_ray_sees_stay_where_they_are() -> None:
    block = simulate(11)
    first = block.rays.first(len(block.ground))
    keep = np.ones(len(block.rays), dtype=np.bool_)
    keep[first[4] + 1 : first[5]] = False
    rays = block.rays.take(keep)
    start = intersect(block.images, rays, len(block.ground))
    result = adjust(block.images, rays, start)
    assert result.accepted.all()
    np.testing.assert_array_equal(result.ground[4], start[4])
    assert np.linalg.norm(result.ground - start, axis=1).max() > 0.1


def test_ground_that_is_not_a_number_is_an_error() -> None:
    block = simulate(12)
    start = intersect(block.images, block.rays, len(block.ground))
    start[3] = np.nan
    with pytest.raises(NumericalError):
        adjust(block.images, block.rays, start)


# Cameras known to kilometres only


def frame_camera(position: Array, look_at: Array) -> dict[str, Any]:
    """A frame camera of 100 mm and 10 micrometre pixels that looks at a place."""
    sight = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(sight, position / np.linalg.norm(position))
    right /= np.linalg.norm(right)
    return {
        "position": position.tolist(), "rotation": [right.tolist(), np.cross(sight, right).tolist(), sight.tolist()], "focal_length": 100.0,
        "mm_to_pixel": [[2000.0, 100.0, 0.0], [2000.0, 0.0, 100.0]], "height": 500.0,
    }  # fmt: skip


@dataclass(frozen=True)
class FrameBlock:
    """Four frame images from 100 km up of points around the centre, and where their cameras are said to be."""

    images: ImageSet
    rays: Rays
    ground: Array


def frame_block(off_m: float, off_rad: float, seed: int = 3, **sigmas: float) -> FrameBlock:
    """Images whose stated cameras are off by so much; a priori sigmas by group of parameters, and ground that they share."""
    rng, sensor = np.random.default_rng(seed), sensor_named("frame")
    geodetic = CENTRE + rng.uniform(-1.0, 1.0, (40, 3)) * np.array([0.12, 0.09, 400.0])
    ground, middle = geodetic_to_geocentric(geodetic), geodetic_to_geocentric(CENTRE[None])[0]
    places = geodetic_to_geocentric(
        np.array([[*(CENTRE[:2] + move), 100_500.0] for move in ((-0.5, 0.0), (0.0, -0.3), (0.1, 0.3), (0.5, 0.0))])
    )
    true = np.stack([sensor.pack(frame_camera(place, middle), 4000, 4000) for place in places])
    stated = []
    for place in places:
        camera = frame_camera(place + rng.normal(0.0, off_m, 3), middle)
        turn = quaternion_rotation(np.array([1.0, *(0.5 * rng.normal(0.0, off_rad, 3))]))
        stated.append(sensor.pack(camera | {"rotation": (np.array(camera["rotation"]) @ turn).tolist()}, 4000, 4000))
    image, point = np.tile(np.arange(4, dtype=np.int32), 40), np.repeat(np.arange(40, dtype=np.int32), 4)
    seen = sensor.project(true, np.zeros((4, 7)), Ground.at(ground), image, point).image
    measured = seen + rng.normal(0.0, SIGMA_PX, seen.shape)
    rays = sorted_rays(point, image, measured, np.full(seen.shape, SIGMA_PX), np.ones(len(image), dtype=np.bool_))
    a_priori = APriori(parameters={group: {"sigma": sigma, "common_to_pass": 0.0} for group, sigma in sigmas.items()})
    priors = tuple(ImagePrior("block", "pass", float(k), a_priori, sensor.parameters) for k in range(4))
    names = tuple(f"image {k}" for k in range(4))
    return FrameBlock(ImageSet(names, ("frame",) * 4, np.stack(stated), priors, 7), rays, ground)


def test_points_may_move_as_far_as_their_cameras_explain() -> None:
    """Cameras off by kilometres, and known to be: the start is tens of kilometres off, and the points arrive all the same."""
    block = frame_block(1000.0, 0.1, position=1000.0, attitude=0.1, **{"focal length": 0.0})
    start = intersect(block.images, block.rays, 40)
    result = adjust(block.images, block.rays, start)
    assert result.converged and result.accepted.all() and not result.released.any()
    moved = np.linalg.norm(result.ground - start, axis=1)
    assert moved.max() > 1.5 * REACH_METRES
    assert np.sqrt(np.nanmean(result.residuals**2)) < 1.0
    assert np.linalg.norm(result.ground - block.ground, axis=1).max() < 4.0 * 10_000.0


def whitened(block: FrameBlock) -> tuple[Array, Array]:
    """Partials of the rays at unadjusted cameras, in sigmas."""
    linear = linearise(block.images, block.rays, np.zeros((4, 7)), block.ground, block.ground)
    return linear.by_ground, linear.by_parameters


def test_what_cameras_explain_is_their_a_priori_sigma_on_the_ground() -> None:
    block = frame_block(0.0, 0.0, position=0.0, attitude=0.01, **{"focal length": 0.0})
    explained = explained_metres(*whitened(block), block.images.prior_variance[block.rays.image])
    distance = np.linalg.norm(block.ground[block.rays.point] - block.images.cameras[block.rays.image, :3], axis=1)
    # two angles across the line of sight; the image is stretched away from its middle, where rays are
    np.testing.assert_allclose(explained, EXPLAINED_SIGMAS * np.sqrt(2.0) * 0.01 * distance, rtol=0.1)
    held = frame_block(0.0, 0.0, position=0.0, attitude=0.0, **{"focal length": 0.0})
    by_measurement = explained_metres(*whitened(held), held.images.prior_variance[held.rays.image])
    np.testing.assert_allclose(by_measurement, EXPLAINED_SIGMAS * np.sqrt(2.0) * SIGMA_PX * distance / 10_000.0, rtol=0.1)


def test_a_ray_that_its_camera_does_not_see_is_rejected_and_nothing_else() -> None:
    """A point behind one camera: the measurement is a mistake, and what the other images measure stands."""
    block = frame_block(0.0, 0.0, position=10.0, attitude=1e-4, **{"focal length": 0.0})
    backwards = block.images.cameras.copy()
    backwards[3, 3:12] *= -1.0
    images = replace(block.images, cameras=backwards)
    result = adjust(images, block.rays, block.ground)
    assert result.converged
    np.testing.assert_array_equal(result.accepted, block.rays.image != 3)
    np.testing.assert_array_equal(result.theta[3], 0.0)
    assert np.isfinite(result.ground).all() and np.isfinite(result.theta).all()


# Approximate positions


def test_intersection_of_exact_rays_is_the_point() -> None:
    block = simulate(13, theta=np.zeros((3, P)), sigma=1e-9)
    block = replace(block, rays=replace(block.rays, sigma=np.full_like(block.rays.sigma, 0.5)))
    found = intersect(block.images, block.rays, len(block.ground))
    # the loose hold on the mean height pulls by (pixel / 2 km)^2 of the distance
    np.testing.assert_allclose(found, block.ground, rtol=0.0, atol=1e-3)


def test_single_ray_is_cut_at_the_mean_height() -> None:
    block = simulate(15, theta=np.zeros((3, P)))
    rays = block.rays.take(block.rays.first(len(block.ground))[:-1])
    found = intersect(block.images, rays, len(block.ground))
    expected = geodetic_to_geocentric(block.images.localise(rays.image, rays.observed), WGS84)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-3)


def test_nearly_parallel_rays_stay_near_the_mean_height() -> None:
    # a micro-radian apart and a pixel's third off each other: they meet 150 km up
    images = image_set(((0.2, 0.0), (0.2 + 1e-6, 0.0)))
    ground = geodetic_to_geocentric(np.array([CENTRE]))
    both = np.zeros(2, dtype=np.int32)
    image = np.arange(2, dtype=np.int32)
    exact = images.project(np.zeros((2, P)), images.ground(ground), image, both).image
    rays = Rays(both, image, exact + np.array([[0.0, 0.0], [0.3, 0.0]]), np.full((2, 2), 0.3), np.ones(2, dtype=np.bool_))
    found = intersect(images, rays, 1)
    height = geocentric_to_geodetic(found)[0, 2] - CENTRE[2]
    assert 1.0 < abs(height) < 50.0


def test_point_that_its_camera_does_not_reach_is_nan_and_the_others_are_not() -> None:
    block = simulate(16, theta=np.zeros((3, P)))
    broken = block.images.cameras.copy()
    # sample = L - L^2 turns back
    broken[0, 10 + 4 * 1 + 2], broken[0, 10 + 4 * 7 + 2] = 1.0, -1.0
    images = replace(block.images, cameras=broken)
    point, image = np.arange(3, dtype=np.int32), np.array([1, 0, 2], dtype=np.int32)
    observed = np.array([[5000.0, 5000.0], [4999.5 + 4000.0, 5000.0], [5000.0, 5000.0]])
    rays = Rays(point, image, observed, np.full((3, 2), 0.5), np.ones(3, dtype=np.bool_))
    found = intersect(images, rays, 3)
    assert np.isnan(found[1]).all()
    alone = intersect(images, rays.take(np.array([0])), 1)
    np.testing.assert_allclose(found[0], alone[0], rtol=0.0, atol=1e-6)
    assert np.isfinite(found[2]).all()
