"""The pushbroom sensor on a simulated orbit, against the orbit itself, light traced through time and air, and differences.

The orbit is a circle in inertial axes, seen from a body that turns; the camera scans off nadir at a steady rate, as WorldView-1 does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from submin.errors import InputError
from submin.geodesy import WGS84, Ellipsoid, geodetic_to_geocentric, local_axes
from submin.sensors import Ground, sensor_named
from submin.sensors.pushbroom_camera import MARGIN, MARGIN_PIXELS, SPEED_OF_LIGHT

Array = NDArray[np.float64]

SENSOR = sensor_named("pushbroom")
WIDTH, HEIGHT = 36000.0, 200000.0
SCAN = 16.0
LINE_RATE = HEIGHT / SCAN
FOCAL, PITCH = 8800.0, 0.008
RADIUS = 6371e3 + 496e3
GM = 3.986004418e14
MOTION = np.sqrt(GM / RADIUS**3)
TURN = 7.292115e-5
MOON = Ellipsoid(1737400.0, 0.0)
EFFECTS = {"aberration": {"rotation_rate": TURN}, "refraction": {"zenith_path": 2.33, "scale_height": 8400.0}}
CORRECTION = np.array([[2e-5, -3e-5, 4e-5, 2e-6, -1e-6, 3e-6]])


def orbit(t: Array, turn: float = TURN) -> tuple[Array, Array]:
    """Positions and velocities (n, 3) in body-fixed axes; mid scan is at t = 0."""
    angle = 0.6 + MOTION * t
    tilt = np.radians(97.0)
    inertial = RADIUS * np.stack([np.cos(angle), np.sin(angle) * np.cos(tilt), np.sin(angle) * np.sin(tilt)], axis=-1)
    speed = RADIUS * MOTION * np.stack([-np.sin(angle), np.cos(angle) * np.cos(tilt), np.cos(angle) * np.sin(tilt)], axis=-1)
    back = Rotation.from_rotvec(np.multiply.outer(-turn * t, [0.0, 0.0, 1.0]))
    return back.apply(inertial), back.apply(speed - np.cross([0.0, 0.0, turn], inertial))


def attitude(t: Array, roll: float = 0.25, pitch: float = 0.15, pitch_rate: float = -2e-3) -> Rotation:
    """Camera axes to body-fixed axes: off nadir, pitching slowly while it scans."""
    position, velocity = orbit(t)
    z = -position / np.linalg.norm(position, axis=1)[:, None]
    y = np.cross(z, velocity)
    y /= np.linalg.norm(y, axis=1)[:, None]
    level = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=-1))
    tilts = Rotation.from_euler("yx", np.stack([pitch + pitch_rate * t, np.full(len(t), roll)], axis=1))
    return level * tilts


def description(samples: int = 25, reach: float = 12.0, effects: Mapping[str, Any] = EFFECTS) -> dict[str, Any]:
    times = np.linspace(-reach, reach, samples)
    position, velocity = orbit(times)
    return {
        "position": {"times": times, "values": position, "velocities": velocity},
        "attitude": {"times": times, "values": attitude(times).as_quat()},
        "lines": {"times": np.array([-0.5, 0.5]) * (HEIGHT - 1.0) / LINE_RATE, "values": [0.0, HEIGHT - 1.0]},
        "focal_length": FOCAL,
        "detector": {"origin": [-0.3, 0.5 * WIDTH * PITCH], "step": [0.0, -PITCH]},
        "mean_height": 300.0,
        **effects,
    }  # fmt: skip


def packed(camera: Mapping[str, Any] | None = None) -> Array:
    return SENSOR.pack(description() if camera is None else camera, WIDTH, HEIGHT)[None]


def rows(count: int) -> NDArray[np.int32]:
    return np.zeros(count, dtype=np.int32)


def pixels(count: int = 300, seed: int = 5) -> Array:
    return np.random.default_rng(seed).uniform([0.0, 0.0], [WIDTH - 1.0, HEIGHT - 1.0], (count, 2))


def places(cameras: Array, image: Array, seed: int = 6) -> Array:
    """Geodetic coordinates (n, 3) that the unadjusted camera sees there, at heights from 0 to 2 km."""
    heights = np.random.default_rng(seed).uniform(0.0, 2000.0, len(image))
    return SENSOR.localise(cameras, rows(len(image)), image[:, 0], image[:, 1], heights, WGS84)


def project(cameras: Array, geocentric: Array, theta: Array | None = None, at: Array | None = None) -> Any:
    theta = np.zeros((1, 6)) if theta is None else theta
    return SENSOR.project(cameras, theta, Ground.at(geocentric), rows(len(geocentric)), np.arange(len(geocentric), dtype=np.int32), at)


def focal_plane(t: Array, direction: Array) -> Array:
    """Sample, and pixels off the detector line, of directions (n, 3) in body-fixed axes."""
    b = attitude(t).inv().apply(direction)
    x, y = FOCAL * b[:, 0] / b[:, 2], FOCAL * b[:, 1] / b[:, 2]
    return np.stack([(0.5 * WIDTH * PITCH - y) / PITCH, (x + 0.3) / PITCH], axis=1)


def swept(direction_at: Any) -> Array:
    """Sample and line at which the exact orbit sees a point, whose direction is a function of time, by bisection."""
    t = brentq(lambda t: focal_plane(np.array([t]), direction_at(t)[None])[0, 1], -10.0, 10.0, xtol=1e-12, rtol=1e-14)
    return np.array([focal_plane(np.array([t]), direction_at(t)[None])[0, 0], 0.5 * (HEIGHT - 1.0) + LINE_RATE * t])


@pytest.mark.parametrize(("samples", "tolerance"), [(4, 1e-3), (7, 1e-5), (13, 1e-6), (25, 1e-7), (2401, 1e-7)])
def test_few_samples_of_an_orbit_are_the_orbit(samples: int, tolerance: float) -> None:
    cameras = packed(description(samples, effects={}))
    ground = geodetic_to_geocentric(places(cameras, pixels(40)))
    exact = np.array([swept(lambda t, x=x: x - orbit(np.array([t]))[0][0]) for x in ground])
    np.testing.assert_allclose(project(cameras, ground).image, exact, rtol=0.0, atol=tolerance)


def test_aberration_and_the_turn_of_the_body_are_those_of_light_that_travels_between_turning_axes() -> None:
    cameras = packed(description(241, effects={"aberration": {"rotation_rate": TURN}}))
    ground = geodetic_to_geocentric(places(cameras, pixels(40)))

    def arriving(x: Array, t: float) -> Array:
        """Direction in the camera's own rest frame, in body-fixed axes of the moment: light left the point earlier, where it then was."""
        position, speed = (v[0] for v in orbit(np.array([t])))
        speed = speed + np.cross([0.0, 0.0, TURN], position)
        delay = 0.0
        for _ in range(6):
            sight = Rotation.from_rotvec([0.0, 0.0, -TURN * delay]).apply(x) - position
            delay = np.linalg.norm(sight) / SPEED_OF_LIGHT
        u, beta = sight / np.linalg.norm(sight), speed / SPEED_OF_LIGHT
        gamma = 1.0 / np.sqrt(1.0 - beta @ beta)
        return np.asarray(u / gamma + beta + gamma / (1.0 + gamma) * (beta @ u) * beta)

    exact = np.array([swept(lambda t, x=x: arriving(x, t)) for x in ground])
    image = project(cameras, ground).image
    np.testing.assert_allclose(image, exact, rtol=0.0, atol=1e-3)
    # it is large, and the turn of the body has its part in it
    still = packed(description(241, effects={"aberration": {"rotation_rate": 0.0}}))
    assert np.abs(image - project(packed(description(241, effects={})), ground).image).max() > 20.0
    assert np.abs(image - project(still, ground).image).max() > 0.1


@pytest.mark.parametrize("zenith_distance", [10.0, 30.0, 50.0])
def test_refraction_is_that_of_a_ray_traced_through_round_layers(zenith_distance: float) -> None:
    """A point seen from 496 km: the ray that reaches it, bent, leaves the camera as if the point lay higher."""
    radius, scale, path, height = 6371e3, 8400.0, 2.33, 400.0

    def index(r: float) -> float:
        return 1.0 + path / scale * np.exp(-(r - radius) / scale)

    z = np.radians(zenith_distance)
    start = radius + height
    invariant = index(start) * start * np.sin(z)

    def polar_angle(r: float, _: Array) -> list[float]:
        sine = invariant / (index(r) * r)
        return [sine / np.sqrt(1.0 - sine**2) / r]

    angle = solve_ivp(polar_angle, (start, RADIUS), [0.0], rtol=1e-13, atol=1e-16, max_step=2000.0).y[0, -1]
    traced = np.arcsin(invariant / (index(RADIUS) * RADIUS))
    straight = np.arctan2(start * np.sin(angle), RADIUS - start * np.cos(angle))
    slope = np.arctan2(RADIUS * np.sin(angle), RADIUS * np.cos(angle) - start)
    raised = start + path * np.exp(-height / scale) / np.cos(slope) ** 2
    modelled = np.arctan2(raised * np.sin(angle), RADIUS - raised * np.cos(angle))
    assert traced - straight > 5e-7
    # a hundredth of the effect: 0.1 pixel at 50 degrees
    np.testing.assert_allclose(modelled - straight, traced - straight, rtol=0.01)


def test_the_sensor_sees_a_point_where_its_refracted_place_would_be_without_air() -> None:
    bent, clear = packed(description(effects={"refraction": EFFECTS["refraction"]})), packed(description(effects={}))
    geodetic = places(clear, pixels(50))
    ground, up = geodetic_to_geocentric(geodetic), local_axes(geodetic)[:, 2]
    image = project(bent, ground).image
    t = (image[:, 1] - 0.5 * (HEIGHT - 1.0)) / LINE_RATE
    sight = orbit(t)[0] - ground
    cosine = np.sum(sight * up, axis=1) / np.linalg.norm(sight, axis=1)
    raised = ground + up * (2.33 * np.exp(-geodetic[:, 2] / 8400.0) / cosine**2)[:, None]
    np.testing.assert_allclose(project(clear, raised).image, image, rtol=0.0, atol=1e-6)
    assert np.abs(image - project(clear, ground).image).max() > 0.5


@pytest.mark.parametrize("effects", [{}, EFFECTS], ids=["straight", "bent"])
def test_localise_is_the_inverse_of_the_unadjusted_camera(effects: Mapping[str, Any]) -> None:
    cameras, image = packed(description(effects=effects)), pixels()
    geodetic = places(cameras, image)
    np.testing.assert_allclose(project(cameras, geodetic_to_geocentric(geodetic)).image, image, rtol=0.0, atol=1e-7)


def test_localise_on_another_body() -> None:
    """A camera 50 km above the Moon, on a straight way; its ellipsoid is a sphere."""
    times = np.linspace(-12.0, 12.0, 9)
    ahead = np.stack([np.full(9, MOON.semimajor_axis + 50e3), np.zeros(9), 1600.0 * times], axis=1)
    down = Rotation.from_matrix(np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
    camera = description(effects={}) | {
        "position": {"times": times, "values": ahead, "velocities": np.tile([0.0, 0.0, 1600.0], (9, 1))},
        "attitude": {"times": times, "values": np.tile(down.as_quat(), (9, 1))},
    }  # fmt: skip
    cameras, image = packed(camera), pixels(30)
    heights = np.linspace(-2000.0, 3000.0, 30)
    geodetic = SENSOR.localise(cameras, rows(30), image[:, 0], image[:, 1], heights, MOON)
    ground = geodetic_to_geocentric(geodetic, MOON)
    np.testing.assert_allclose(np.linalg.norm(ground, axis=1), MOON.semimajor_axis + heights, rtol=0.0, atol=1e-6)
    seen = SENSOR.project(cameras, np.zeros((1, 6)), Ground.at(ground, MOON), rows(30), np.arange(30, dtype=np.int32))
    np.testing.assert_allclose(seen.image, image, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("effects", [{}, EFFECTS], ids=["straight", "bent"])
@pytest.mark.parametrize("measured", [False, True], ids=["predicted", "measured"])
def test_partials_are_the_limit_of_differences(effects: Mapping[str, Any], measured: bool) -> None:
    cameras, image = packed(description(effects=effects)), pixels(60)
    geocentric = geodetic_to_geocentric(places(cameras, image))
    at = image + 7.0 if measured else None
    whole = project(cameras, geocentric, CORRECTION, at)

    def difference(shifted: Any, step: float) -> Array:
        one, two = shifted(step) - shifted(-step), shifted(2.0 * step) - shifted(-2.0 * step)
        return np.asarray((8.0 * one - two) / (12.0 * step))

    for k in range(3):
        direction = np.eye(3)[k]
        found = difference(lambda s, d=direction: project(cameras, geocentric + s * d, CORRECTION, at).image, 20.0)
        np.testing.assert_allclose(whole.by_ground[:, :, k], found, rtol=0.0, atol=1e-8)
    for k in range(6):
        direction = np.eye(6)[k]
        found = difference(lambda s, d=direction: project(cameras, geocentric, CORRECTION + s * d, at).image, 2e-5)
        np.testing.assert_allclose(whole.by_parameters[:, :, k], found, rtol=1e-7, atol=1e-8 * np.abs(found).max())
    assert np.abs(whole.by_ground).max() > 1.0
    assert np.abs(whole.by_parameters[:, :, :3]).max(axis=(0, 1)).min() > 1e4


def test_corrections_are_small_rotations_of_the_camera_about_its_own_axes_that_grow_from_mid_scan() -> None:
    camera = description(241)
    cameras, image = packed(camera), pixels(50)
    ground = geodetic_to_geocentric(places(cameras, image))
    times = camera["attitude"]["times"]
    turned = attitude(times) * Rotation.from_rotvec(CORRECTION[:, :3] + times[:, None] * CORRECTION[:, 3:])
    exact = project(packed(camera | {"attitude": {"times": times, "values": turned.as_quat()}}), ground).image
    # of second order in 1e-4 rad: 1e-8 rad, 0.01 pixel
    np.testing.assert_allclose(project(cameras, ground, CORRECTION).image, exact, rtol=0.0, atol=0.02)
    assert np.abs(exact - image).max(axis=0).min() > 10.0


def test_with_measured_coordinates_a_rate_is_the_rotation_at_the_measured_line() -> None:
    cameras, image = packed(), pixels(20)
    ground = geodetic_to_geocentric(places(cameras, image))
    at = image + np.random.default_rng(3).normal(0.0, 2000.0, image.shape)
    by_rate = project(cameras, ground, CORRECTION, at).image
    since = (at[:, 1] - 0.5 * (HEIGHT - 1.0)) / LINE_RATE
    for r in range(20):
        still = np.zeros((1, 6))
        still[0, :3] = CORRECTION[0, :3] + since[r] * CORRECTION[0, 3:]
        np.testing.assert_allclose(by_rate[r], project(cameras, ground[r : r + 1], still).image[0], rtol=0.0, atol=1e-8)


def test_the_factor_of_a_rate_grows_with_the_lines_as_it_says() -> None:
    cameras, image = packed(), pixels(20)
    ground = geodetic_to_geocentric(places(cameras, image))
    here, later = (project(cameras, ground, at=image + np.array([0.0, lines])).by_parameters for lines in (0.0, 100.0))
    by_pixel = SENSOR.drift_by_pixel(cameras)[0]
    assert by_pixel[0] == 0.0
    for k, parameter in enumerate(SENSOR.parameters):
        if parameter.drift is None:
            assert k < 3
            np.testing.assert_allclose(later[:, :, k], here[:, :, k], rtol=1e-9, atol=1e-6)
        else:
            grown = 100.0 * by_pixel[parameter.drift.axis] * here[:, :, parameter.drift.of]
            np.testing.assert_allclose(later[:, :, k] - here[:, :, k], grown, rtol=1e-6, atol=1e-6)


def test_roll_moves_along_the_detector_pitch_across_it_and_yaw_about_the_line_of_sight() -> None:
    cameras = packed(description(effects={}))
    middle = np.array([[0.5 * (WIDTH - 1.0), 0.5 * (HEIGHT - 1.0)]])
    radian = FOCAL / PITCH
    by = project(cameras, geodetic_to_geocentric(places(cameras, middle))).by_parameters[0]
    # samples run against y; the camera moves over the ground by about a line in the time of a line
    np.testing.assert_allclose(by[0, 0], -radian, rtol=0.01)
    np.testing.assert_allclose(np.abs(by[1, 1]), radian, rtol=0.3)
    assert np.abs(by[:, 2]).max() < 0.01 * radian
    np.testing.assert_allclose(by[:, 3:], 0.0, rtol=0.0, atol=radian * 1e-6)


def test_a_reverse_scan_numbers_the_same_lines_from_the_other_end() -> None:
    camera = description()
    lines = camera["lines"]
    backward = packed(camera | {"lines": {"times": lines["times"][::-1], "values": lines["values"]}})
    cameras, image = packed(camera), pixels(30)
    ground = geodetic_to_geocentric(places(cameras, image))
    forward = project(cameras, ground, CORRECTION)
    reverse = project(backward, ground, CORRECTION)
    np.testing.assert_allclose(reverse.image[:, 0], forward.image[:, 0], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(reverse.image[:, 1], HEIGHT - 1.0 - forward.image[:, 1], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(reverse.by_ground[:, 1], -forward.by_ground[:, 1], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(places(backward, reverse.image), places(cameras, forward.image), rtol=0.0, atol=1e-10)


def test_line_times_are_linear_between_the_entries_of_their_table() -> None:
    camera = description()
    lines, times = np.array([0.0, 50000.0, 150000.0, HEIGHT - 1.0]), np.array([-8.0, -5.0, 4.5, 8.0])
    cameras, image = packed(camera | {"lines": {"times": times, "values": lines}}), pixels()
    geodetic = places(cameras, image)
    np.testing.assert_allclose(project(cameras, geodetic_to_geocentric(geodetic)).image, image, rtol=0.0, atol=1e-7)
    # the same places by the even table, at the lines of the same times
    even = 0.5 * (HEIGHT - 1.0) + LINE_RATE * np.interp(image[:, 1], lines, times)
    expected = places(packed(camera), np.stack([image[:, 0], even], axis=1))
    np.testing.assert_allclose(geodetic, expected, rtol=0.0, atol=1e-10)


def test_signs_of_quaternions_and_the_spacing_of_samples_mean_nothing() -> None:
    camera = description(241)
    rng = np.random.default_rng(9)
    flipped = camera["attitude"]["values"] * rng.choice([-1.0, 1.0], (241, 1))
    times = np.sort(np.concatenate([[-12.0, 12.0], rng.uniform(-12.0, 12.0, 200)]))
    position, velocity = orbit(times)
    uneven = camera | {
        "position": {"times": times, "values": position, "velocities": velocity},
        "attitude": {"times": times, "values": attitude(times).as_quat()},
    }
    cameras = packed(camera)
    ground = geodetic_to_geocentric(places(cameras, pixels(100)))
    image = project(cameras, ground).image
    other = project(packed(camera | {"attitude": camera["attitude"] | {"values": flipped}}), ground).image
    np.testing.assert_array_equal(other, image)
    np.testing.assert_allclose(project(packed(uneven), ground).image, image, rtol=0.0, atol=1e-5)


def test_every_ray_takes_its_own_camera_correction_and_point() -> None:
    one, two = packed()[0], packed(description(9))[0]
    cameras = np.full((2, len(one)), np.nan)
    cameras[0], cameras[1, : len(two)] = one, two
    theta = np.random.default_rng(2).normal(0.0, 2e-5, (2, 9))
    geocentric = geodetic_to_geocentric(places(packed(), pixels(12)))
    image, point = np.arange(24, dtype=np.int32) % 2, np.arange(24, dtype=np.int32) // 2
    together = SENSOR.project(cameras, theta, Ground.at(geocentric), image, point)
    for r in range(24):
        alone = project(cameras[image[r]][None], geocentric[point[r]][None], theta[image[r]][None])
        np.testing.assert_array_equal(together.image[r], alone.image[0])
        np.testing.assert_array_equal(together.by_ground[r], alone.by_ground[0])
        np.testing.assert_array_equal(together.by_parameters[r], alone.by_parameters[0])
    assert together.by_parameters.shape == (24, 2, 6)


def test_what_the_camera_does_not_see_is_nan() -> None:
    cameras = packed()
    beyond = np.array([WIDTH * MARGIN + 1.0, HEIGHT * MARGIN + 1.0])
    # the samples reach 12 s, to 50 000 lines beyond the image; the margin there is 50 000 lines
    outside = np.array([[-beyond[0], 100.0], [WIDTH - 1.0 + beyond[0], 100.0], [100.0, -beyond[1]], [100.0, HEIGHT - 1.0 + beyond[1]]])
    assert np.isnan(places(cameras, outside)[:, :2]).all()
    inside = np.array([[-8000.0, 100.0], [WIDTH + 8000.0, 100.0], [100.0, -45000.0], [100.0, HEIGHT + 45000.0]])
    seen = geodetic_to_geocentric(places(cameras, inside))
    np.testing.assert_allclose(project(cameras, seen).image, inside, rtol=0.0, atol=1e-6)
    # the other side of the body, the zenith, and places that the scan does not reach
    camera = orbit(np.array([0.0]))[0][0]
    middle = geodetic_to_geocentric(places(cameras, np.array([[0.5 * WIDTH, 0.5 * HEIGHT]])))[0]
    along = orbit(np.array([0.0]))[1][0] / 7600.0
    across = np.cross(along, camera / np.linalg.norm(camera))
    unseen = np.array([-middle, 1.3 * camera, middle + 2e5 * along, middle - 2e5 * along, middle + 4e4 * across, middle - 4e4 * across])
    for at in (None, np.tile([0.5 * WIDTH, 0.5 * HEIGHT], (6, 1)), np.tile([0.0, 3.0 * HEIGHT], (6, 1))):
        result = project(cameras, unseen, at=at)
        assert np.isnan(result.image).all()
        assert np.isnan(result.by_ground).all() and np.isnan(result.by_parameters).all()


@pytest.mark.parametrize("roll", [0.25, 1.15, 1.3, 3.0])
def test_a_pixel_that_looks_past_the_ground_is_nan(roll: float) -> None:
    """Off nadir by 15 degrees, 66 (grazing, the ground ends at 68), 74 and 172: to space."""
    camera = description()
    times = camera["attitude"]["times"]
    camera["attitude"] = {"times": times, "values": attitude(times, roll, 0.0, 0.0).as_quat()}
    image = np.concatenate([pixels(20), [[np.nan, 10.0], [10.0, np.nan]]])
    geodetic = SENSOR.localise(packed(camera), rows(22), image[:, 0], image[:, 1], np.full(22, 100.0), WGS84)
    seen = np.isfinite(geodetic).all(axis=1)
    np.testing.assert_array_equal(seen, np.append(np.full(20, roll < 1.2), [False, False]))
    np.testing.assert_allclose(project(packed(camera), geodetic_to_geocentric(geodetic[seen])).image, image[seen], rtol=0.0, atol=1e-6)


def test_nothing_is_seen_outside_of_the_sampled_times() -> None:
    whole, short = packed(), packed(description(25, reach=8.1))
    image = np.array([[100.0, 50.0], [100.0, -1000.0], [100.0, -1400.0], [100.0, HEIGHT + 1000.0], [100.0, HEIGHT + 1400.0]])
    seen = np.array([True, True, False, True, False])
    ground = geodetic_to_geocentric(places(whole, image))
    np.testing.assert_array_equal(np.isfinite(project(short, ground).image).all(axis=1), seen)
    np.testing.assert_array_equal(np.isfinite(places(short, image)).all(axis=1), seen)
    np.testing.assert_array_equal(np.isfinite(project(whole, ground).image).all(axis=1), True)


def test_a_small_image_has_a_margin_in_pixels() -> None:
    camera = description() | {
        "lines": {"times": [0.0, 0.1], "values": [0.0, 1249.0]},
        "detector": {"origin": [0.0, 4.0], "step": [0.0, -PITCH]},
    }
    cameras = SENSOR.pack(camera, 1000, 1250)[None]
    edges = np.array([[-MARGIN_PIXELS + 1.0, 0.0], [0.0, 1249.0 + MARGIN_PIXELS - 1.0], [-MARGIN_PIXELS - 1.0, 0.0]])
    np.testing.assert_array_equal(np.isfinite(places(cameras, edges)).all(axis=1), [True, True, False])


def test_parameters_are_those_of_the_paper() -> None:
    assert [p.unit for p in SENSOR.parameters] == ["rad"] * 3 + ["rad/s"] * 3
    assert [p.group for p in SENSOR.parameters] == ["attitude"] * 3 + ["rate"] * 3
    assert [p.sigma for p in SENSOR.parameters] == [5e-6] * 3 + [5e-7] * 3
    assert not any(p.shared for p in SENSOR.parameters)


def changed(*path: str, to: Any) -> dict[str, Any]:
    camera = description(9)
    inner: Any = camera
    for name in path[:-1]:
        inner[name] = dict(inner[name])
        inner = inner[name]
    if to is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = to
    return camera


BAD: list[tuple[tuple[str, ...], Any, str]] = [
    (("focal_length",), None, "focal_length is missing; expected one number"),
    (("focal_length",), -1.0, "focal_length is -1; expected a positive number"),
    (("focal_length",), "long", "focal_length is not numbers; expected one number"),
    (("mean_height",), None, "mean_height is missing"),
    (("mean_height",), np.nan, "mean_height holds a value that is not finite"),
    (("position",), None, "position, times is missing; expected any numbers"),
    (("position", "velocities"), None, "position, velocities is missing; expected 9 x 3 numbers"),
    (("position", "values"), np.ones((8, 3)), r"position, values has the shape \(8, 3\); expected 9 x 3 numbers"),
    (("position", "times"), np.zeros(9), "position, times: entry 2 .* is not beyond entry 1"),
    (("attitude", "values"), np.ones((9, 3)), r"attitude, values has the shape \(9, 3\); expected 9 x 4 numbers"),
    (("attitude", "values"), np.tile([0.0, 0.0, 0.0, 1.1], (9, 1)), "quaternion 1 has the length 1.1; expected 1"),
    (("attitude", "values"), np.array([[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]] * 4 + [[0.0, 0.0, 0.0, 1.0]]), "180.0 degrees apart"),
    (("attitude", "times"), np.linspace(-7.0, 12.0, 9), "attitude is sampled from -7.0.* expected samples that cover all lines"),
    (("lines", "times"), [0.0], "lines has 1 times; expected 2 or more"),
    (("lines", "values"), [5.0, 5.0], "lines, values: entry 2 .* is not beyond entry 1"),
    (("lines", "times"), [1e9, 1e9 + 16.0], "times run to 1e.09 s, where float64 resolves .* expected seconds from an epoch near the scan"),
    (("detector",), None, "detector, origin is missing; expected 2 numbers"),
    (("detector", "step"), [0.0, 0.0], "detector, step is 0, 0"),
    (("detector", "step"), [0.0, "x"], "detector, step is not numbers"),
    (("aberration", "rotation_rate"), None, "aberration, rotation_rate is missing"),
    (("refraction", "zenith_path"), [1.0], r"refraction, zenith_path has the shape \(1,\); expected one number"),
    (("refraction", "scale_height"), 0.0, "refraction, scale_height is 0; expected a positive number"),
]


@pytest.mark.parametrize(("path", "value", "message"), BAD, ids=[f"{', '.join(path)} {k}" for k, (path, _, _) in enumerate(BAD)])
def test_a_bad_entry_is_named(path: tuple[str, ...], value: Any, message: str) -> None:
    with pytest.raises(InputError, match=f"^pushbroom: .*{message}"):
        SENSOR.pack(changed(*path, to=value), WIDTH, HEIGHT)


@pytest.mark.parametrize(("width", "height"), [(0.0, 10.0), (10.0, -1.0), (np.nan, 10.0), (10.0, np.inf)])
def test_a_bad_image_size_is_named(width: float, height: float) -> None:
    with pytest.raises(InputError, match=r"image size is .* expected positive numbers of pixels"):
        SENSOR.pack(description(), width, height)
