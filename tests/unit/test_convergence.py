"""How an adjustment gets to its solution from far away, and what it says when there is none."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from unit.test_adjustment import CENTRE, FIVE, Array, P, Simulated, adjusted, image_set, simulate

from submin.adjustment import adjustment, blunders
from submin.adjustment.adjustment import Adjustment, adjust
from submin.adjustment.elimination import linearise
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import Rays, sorted_rays
from submin.adjustment.status import Cause, diagnose
from submin.geodesy import Ellipsoid, geodetic_to_geocentric, local_axes
from submin.sensors import SENSORS, Ground, Parameter, Projection

FOCAL = 1000.0


class ScanSensor:
    """A panoramic camera in an aircraft: image coordinates are angles, so what is far aside hardly moves. Nothing behind it is seen."""

    name = "scan"
    unit = "pixel"
    parameters = (Parameter("sample bias", "px", "bias", 2.0), Parameter("line bias", "px", "bias", 2.0))

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        return np.concatenate([camera["position"], np.ravel(camera["axes"])])

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Any, point: Any, at: Array | None = None) -> Projection:
        axes = cameras[image, 3:].reshape(-1, 3, 3)
        x, y, depth = np.einsum("rck,rk->cr", axes, ground.geocentric[point] - cameras[image, :3])
        predicted, by_ground = np.empty((len(image), 2)), np.empty((len(image), 2, 3))
        with np.errstate(invalid="ignore"):
            depth = np.where(depth > 0.0, depth, np.nan)
        for c, aside in enumerate((x, y)):
            predicted[:, c] = FOCAL * np.arctan(aside / depth) + parameters[image, c]
            by_ground[:, c] = FOCAL * (axes[:, c] * depth[:, None] - axes[:, 2] * aside[:, None]) / (depth**2 + aside**2)[:, None]
        return Projection(predicted, by_ground, np.tile(np.eye(2), (len(image), 1, 1)))

    def localise(self, cameras: Array, image: Any, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        return np.full((len(image), 3), np.nan)

    def mean_height(self, cameras: Array) -> Array:
        return np.zeros(len(cameras))


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch) -> Simulated:
    """Four panoramic images 300 m above 30 points."""
    monkeypatch.setitem(SENSORS, "scan", ScanSensor())
    monkeypatch.setattr(blunders, "IMAGE_FAMILY", 1e-9)
    rng, origin = np.random.default_rng(1), geodetic_to_geocentric(CENTRE[None])[0]
    east, north, up = local_axes(CENTRE[None])[0]
    places = [origin + 300.0 * up + a * east + b * north for a, b in ((-150, -100), (150, -100), (-150, 100), (150, 100))]
    cameras = np.stack([ScanSensor().pack({"position": place, "axes": [east, -north, -up]}, 1, 1) for place in places])
    priors = tuple(ImagePrior(f"b{i}", f"p{i}", 0.0, APriori(bias_px=2.0, common_to_pass=0.0), ScanSensor.parameters) for i in range(4))
    images = ImageSet(tuple("abcd"), ("scan",) * 4, cameras, priors, 2)
    ground = origin + rng.uniform(-200.0, 200.0, (30, 2)) @ np.stack([east, north]) + rng.uniform(-20.0, 20.0, (30, 1)) * up
    point, image = np.repeat(np.arange(30, dtype=np.int32), 4), np.tile(np.arange(4, dtype=np.int32), 30)
    theta = rng.normal(0.0, 1.0, (4, 2))
    observed = images.project(theta, images.ground(ground), image, point).image + rng.normal(0.0, 0.3, (120, 2))
    rays = sorted_rays(point, image, observed, np.full((120, 2), 0.3), np.ones(120, dtype=np.bool_))
    return Simulated(images, rays, ground, theta)


def started_aside(flight: Simulated, metres: float) -> Adjustment:
    east = local_axes(CENTRE[None])[0, 0]
    return adjust(flight.images, flight.rays, flight.ground + metres * east)


def test_near_the_solution_no_step_is_shortened(flight: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    near = started_aside(flight, 1.0)
    monkeypatch.setattr(adjustment, "HALVINGS", 0)
    assert near.converged and near.iterations == started_aside(flight, 1.0).iterations < 12
    assert near.accepted.all() and np.abs(near.ground - flight.ground).max() < 3.0


def with_blunders(part: float) -> Simulated:
    """Five images of 60 points, of whose rays such a part is off by 10 to 100 sigmas."""
    block, rng = simulate(5, images=image_set(FIVE)), np.random.default_rng(4)
    bad = rng.random(len(block.rays.image)) < part
    away = rng.uniform(10.0, 100.0, (len(bad), 2)) * rng.choice([-1.0, 1.0], (len(bad), 2)) * block.rays.sigma
    return replace(block, rays=replace(block.rays, observed=block.rays.observed + away * bad[:, None]))


def test_without_a_ray_far_off_rays_are_judged_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two robust steps less, and the same comes out; with blunders nothing is different."""
    clean, spoiled = adjusted(with_blunders(0.0)), adjusted(with_blunders(0.1))
    monkeypatch.setattr(adjustment, "HONEST_WEIGHT", 1.0)
    robust, same = adjusted(with_blunders(0.0)), adjusted(with_blunders(0.1))
    assert clean.iterations < robust.iterations and clean.accepted.all() and robust.accepted.all()
    np.testing.assert_allclose(clean.theta, robust.theta, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(clean.ground, robust.ground, rtol=0.0, atol=1e-5)
    assert not spoiled.accepted.all() and spoiled.iterations == same.iterations
    assert np.array_equal(spoiled.accepted, same.accepted) and np.array_equal(spoiled.theta, same.theta)


@pytest.mark.parametrize("part", [0.0, 0.02])
def test_where_decisions_count_another_step_would_hardly_move_anything(part: float) -> None:
    block = with_blunders(part)
    start = intersect(block.images, block.rays, len(block.ground))
    rested, decided = (adjust(block.images, block.rays, start, to_rest=to_rest) for to_rest in (True, False))
    assert rested.converged and decided.converged and decided.iterations <= rested.iterations
    assert np.array_equal(rested.accepted, decided.accepted) and np.array_equal(rested.released, decided.released)
    assert np.nanmax(np.abs(rested.residuals - decided.residuals)) < 1e-3
    if not part:
        assert decided.iterations == 2 < rested.iterations


@pytest.mark.parametrize("metres", [600.0, 1500.0])
def test_a_bad_start_is_overcome(flight: Simulated, metres: float, monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = started_aside(flight, 1.0), started_aside(flight, metres)
    assert far.status.cause is Cause.CONVERGED and far.accepted.all()
    np.testing.assert_allclose(far.ground, near.ground, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(far.theta, near.theta, rtol=0.0, atol=1e-5)
    # where whole steps are taken as they come there is no way back
    monkeypatch.setattr(adjustment, "_shortened", whole)
    lost = started_aside(flight, metres)
    assert not lost.converged or lost.accepted.mean() < 0.1


def whole(images: ImageSet, rays: Rays, old: Any, moves: Array, free: Array, estimate: Any, ground: Array) -> tuple[Any, bool]:
    """Gauss-Newton as it is."""
    return adjustment._State.at(images, rays, estimate.theta, estimate.whitened, ground), False


def test_one_wild_point_does_not_hold_up_the_others(flight: Simulated) -> None:
    start = flight.ground.copy()
    start[4] += 1500.0 * local_axes(CENTRE[None])[0, 0]
    result = adjust(flight.images, flight.rays, start)
    assert result.converged and result.iterations < 20
    assert np.abs(result.ground - flight.ground).max() < 3.0


def test_a_point_that_no_camera_sees_is_left_out(flight: Simulated) -> None:
    start = flight.ground.copy()
    start[7] += 400.0 * local_axes(CENTRE[None])[0, 2]
    result = adjust(flight.images, flight.rays, start)
    assert result.converged and np.flatnonzero(~result.accepted).tolist() == [28, 29, 30, 31]
    assert finite(result)
    np.testing.assert_array_equal(result.ground[7], start[7])


def test_a_camera_that_points_away_is_named(flight: Simulated) -> None:
    cameras = flight.images.cameras.copy()
    cameras[2, 9:] *= -1.0
    result = adjust(replace(flight.images, cameras=cameras), flight.rays, flight.ground)
    assert result.converged and result.status.cause is Cause.UNSEEN and finite(result)
    message = result.status.message(flight.images.ids, [f"P{j}" for j in range(30)])
    assert message == "image c: its camera does not see the ground at point P0; check the camera model and the axis order"
    assert result.accepted[flight.rays.image != 2].all()


def finite(result: Adjustment) -> bool:
    numbers = (result.theta, result.ground, result.statistic, result.image_statistic, result.residuals[result.accepted])
    return all(bool(np.isfinite(x).all()) for x in numbers)


def named(block: Simulated, result: Adjustment) -> str:
    return result.status.message(block.images.ids, [f"P{j}" for j in range(len(block.ground))])


def test_a_good_block_converges() -> None:
    block = simulate(1)
    result = adjusted(block)
    assert result.status.cause is Cause.CONVERGED
    assert named(block, result) == f"converged in {result.iterations} iterations"


def test_rays_of_nothing_agree_on_nothing() -> None:
    block = simulate(2, images=image_set(FIVE))
    rng = np.random.default_rng(1)
    nonsense = replace(block, rays=replace(block.rays, observed=rng.uniform(0.0, 10000.0, block.rays.observed.shape)))
    result = adjusted(nonsense)
    assert finite(result)
    assert result.accepted.mean() < 0.5
    assert result.converged or result.status.cause is Cause.FEW_AGREE


@pytest.mark.parametrize("apart", [0.0, 1e-9, 1e-6, 1e-4])
def test_two_images_of_one_viewpoint_give_no_nonsense(apart: float) -> None:
    block = simulate(3, images=image_set(((0.2, 0.1), (0.2 + apart, 0.1)), APriori(2.0, 1.0, 0.0)))
    result = adjusted(block)
    assert finite(result)
    assert result.converged, named(block, result)
    start = intersect(block.images, block.rays, len(block.ground))
    assert np.linalg.norm(result.ground - start, axis=1).max() < adjustment.REACH_METRES + 1.0


def test_a_camera_gone_mad_is_named() -> None:
    """Whatever the last step was, the message names an image or a point, and what to do."""
    block = simulate(4)
    observed = block.rays.observed.copy()
    observed[block.rays.image == 1] = observed[block.rays.image == 1][::-1]
    result = adjusted(replace(block, rays=replace(block.rays, observed=observed)))
    assert finite(result)
    if not result.converged:
        assert any(word in named(block, result) for word in ("check", "remove", "add"))


@pytest.mark.parametrize(
    ("cause", "apart", "theta", "metres", "rejected", "message"),
    [
        (Cause.FEW_AGREE, 0.5, 0.0, 0.0, 0.6, "only 4.% of the rays agree with each other; check the order of sample and line"),
        (Cause.DECISIONS, 0.5, 0.0, 0.0, 0.0, "a ray of point P1 in image image 0 is rejected and taken back in turn; remove it, or give"),
        (
            Cause.SINGULAR,
            1e-5,
            0.0,
            9.0,
            0.0,
            r"point P.* is seen from one direction only .its rays meet at 0.000.* degrees.; add",
        ),
        (Cause.CAMERA, 0.5, 4.0, 0.0, 0.0, "the correction of image image 1 still moves its rays by .* sigmas; check its camera"),
        (Cause.POINT, 0.5, 0.0, 9.0, 0.0, "point P3 still moves by 9 m; check its measurements, or remove it"),
    ],
)
def test_what_did_not_converge_is_named(cause: Cause, apart: float, theta: float, metres: float, rejected: float, message: str) -> None:
    block = simulate(6, images=image_set(((0.2, 0.1), (0.2 + apart, 0.1))), theta=np.zeros((2, P)))
    linear = linearise(block.images, block.rays, block.theta, block.ground, block.ground)
    weight = (np.random.default_rng(1).uniform(size=len(block.rays)) >= rejected).astype(np.float64)
    step, shift = np.zeros((2, P)), np.zeros((60, 3))
    step[1, 0], shift[3, 0] = theta, metres
    decided = np.arange(len(block.rays)) == 2
    status = diagnose(linear, weight, (step, shift), decided, 40, 1e-6)
    assert status.cause is cause and not status.converged and status.iterations == 40
    said = status.message(block.images.ids, [f"P{j}" for j in range(60)])
    assert re.match(f"the adjustment did not converge in 40 iterations: {message}", said), said


def test_most_images_keep_their_priors() -> None:
    # cameras that are all three wrong: with all of them released every residual would vanish, and all points fall into one
    images = image_set(a_priori=APriori(0.5, 0.02, 0.0))
    theta = np.random.default_rng(3).normal(size=(3, P)) * [20.0, 5.0, 5.0, 20.0, 5.0, 5.0]
    block = simulate(5, images=images, theta=theta)
    result = adjusted(block)
    assert result.converged and np.count_nonzero(result.released) <= 1
    assert np.abs(result.theta[:, [1, 2, 4, 5]]).max() < 30.0
