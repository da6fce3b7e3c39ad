"""The frame sensor against its equations written out again, its partials against complex steps, and every bad description by its message.

The equations are evaluated for one ray in complex numbers: ``Im f(x + ih) / h`` with h = 1e-30 is the derivative to the last digit.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from submin.errors import InputError
from submin.geodesy import WGS84, Ellipsoid, geodetic_to_geocentric, local_axes
from submin.sensors import Ground, Projection, sensor_named
from submin.sensors.frame import quaternion_rotation

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FRAME = sensor_named("frame")
MOON = Ellipsoid(1737400.0, 0.0)
SIZE = 5725
STEP = 1e-30
RADIAL, DECENTERING = [-1.3361854e-06, 5.2261757e-10, -5.0728336e-14], [-5.4958195e-07, -4.608942e-11, 2.965907]
"""Of the Apollo 15 Metric Camera, as its instrument description (ISD) has them."""
CORRECTION = np.array([130.0, -90.0, 210.0, 0.004, -0.007, 0.02, 0.31])
"""Large enough that every product with a partial, and the order of the rotations, can be seen."""
DIRECTIONS = ("measured to ideal", "ideal to measured")


def camera(ellipsoid: Ellipsoid = MOON, **changes: Any) -> dict[str, Any]:
    """A metric camera 110 km up that looks 20 degrees ahead of straight down, flying to the north-west, tops of images ahead."""
    place = np.array([[26.0, -37.0, 110_000.0]])
    east, north, up = local_axes(place)[0]
    ahead, right = (north - east) / np.sqrt(2.0), (north + east) / np.sqrt(2.0)
    tilt = np.radians(20.0)
    sight = np.sin(tilt) * ahead - np.cos(tilt) * up
    return {
        "position": geodetic_to_geocentric(place, ellipsoid)[0].tolist(),
        "rotation": [right.tolist(), np.cross(sight, right).tolist(), sight.tolist()],  # x right, y down, z ahead
        "focal_length": 76.054, "principal_point": [-0.006, -0.002], "mm_to_pixel": [[2862.0, 50.0, 0.3], [2861.0, -0.2, 49.0]],
        "distortion": {"radial": RADIAL, "decentering": DECENTERING, "direction": "measured to ideal"},
        "velocity": (1600.0 * ahead + 3.0 * up).tolist(), "height": -1500.0,
    } | changes  # fmt: skip


def packed(description: dict[str, Any]) -> Array:
    return np.asarray(FRAME.pack(description, SIZE, SIZE))[None]


def targets(description: dict[str, Any], ellipsoid: Ellipsoid = MOON, count: int = 60, seed: int = 5) -> tuple[Array, Array]:
    """Image coordinates (n, 2) all over the format and the ground (n, 3) there at heights of some kilometres."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.0, SIZE - 1.0, (count, 2))
    zero = np.zeros(count, dtype=np.int32)
    ground = FRAME.localise(packed(description), zero, image[:, 0].copy(), image[:, 1].copy(), rng.uniform(-3e3, 3e3, count), ellipsoid)
    return image, geodetic_to_geocentric(ground, ellipsoid)


def project(cameras: Array, geocentric: Array, theta: Array | None = None) -> Projection:
    rows = np.arange(len(geocentric), dtype=np.int32)
    theta = np.zeros(7) if theta is None else theta
    return FRAME.project(cameras, theta[None], Ground.at(geocentric, MOON), np.zeros_like(rows), rows)


def turn(axis: Array, angle: complex, vector: Complex) -> Complex:
    """Rodrigues' formula."""
    return np.asarray(vector * np.cos(angle) + np.cross(axis, vector) * np.sin(angle) + axis * (axis @ vector) * (1.0 - np.cos(angle)))


def lens(distortion: dict[str, Any], at: Complex) -> Complex:
    k1, k2, k3 = distortion["radial"]
    j1, j2, phi = distortion["decentering"]
    rr = at @ at
    return np.asarray(at * (1 + k1 * rr + k2 * rr**2 + k3 * rr**3) + (j1 * rr + j2 * rr**2) * np.array([-np.sin(phi), np.cos(phi)]))


def equations(description: dict[str, Any], axes: Array, theta: Complex, ground: Complex) -> Complex:
    """Sample and line of one ray, by the equations of the module's description."""
    rotation = np.array(description["rotation"])
    d = ground - (np.array(description["position"]) + theta[:3] @ axes)
    d = turn(axes[0], -theta[3], d)
    d = turn(axes[1], -theta[4], d)
    d = turn(rotation[2] * (1 if description.get("looks_along", "+z") == "+z" else -1), -theta[5], d)
    u = rotation @ d
    depth = u[2] if description.get("looks_along", "+z") == "+z" else -u[2]
    ideal = (description["focal_length"] + theta[6]) * u[:2] / depth
    measured = ideal
    if description["distortion"]["direction"] == "ideal to measured":
        measured = lens(description["distortion"], ideal)
    else:
        for _ in range(200):  # a fixed point: slow, and independent of Newton's method and its partials
            measured = measured + ideal - lens(description["distortion"], measured)
    to_pixel = np.array(description["mm_to_pixel"])
    return np.asarray(to_pixel[:, 0] + to_pixel[:, 1:] @ (measured + np.array(description["principal_point"])))


def flight_axes(description: dict[str, Any]) -> Array:
    radial = np.array(description["position"]) / np.linalg.norm(description["position"])
    velocity = np.array(description["velocity"])
    in_track = velocity - (velocity @ radial) * radial
    in_track /= np.linalg.norm(in_track)
    return np.stack([in_track, np.cross(radial, in_track), radial])


def variants() -> list[dict[str, Any]]:
    """Both directions of the distortion, and both ways to look along z."""
    plain = camera()
    turned = (np.diag([1.0, -1.0, -1.0]) @ np.array(plain["rotation"])).tolist()
    backwards = {"rotation": turned, "looks_along": "-z", "mm_to_pixel": [[2862.0, 50.0, 0.3], [2861.0, -0.2, -49.0]]}
    lenses = [plain["distortion"] | {"direction": direction} for direction in DIRECTIONS]
    return [plain | {"distortion": of} | view for of in lenses for view in ({}, backwards)]


@pytest.mark.parametrize("description", variants())
def test_image_is_that_of_the_equations(description: dict[str, Any]) -> None:
    _, ground = targets(description)
    axes = flight_axes(description)
    found = project(packed(description), ground, CORRECTION).image
    expected = np.stack([equations(description, axes, CORRECTION.astype(complex), g.astype(complex)).real for g in ground])
    assert np.ptp(expected, axis=0).min() > 4000.0
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("description", variants())
def test_partials_are_those_of_the_equations(description: dict[str, Any]) -> None:
    _, ground = targets(description, count=12)
    axes, theta = flight_axes(description), CORRECTION.astype(complex)
    found = project(packed(description), ground, CORRECTION)
    for r, place in enumerate(ground.astype(complex)):
        by_ground = np.stack([equations(description, axes, theta, place + 1j * STEP * e).imag / STEP for e in np.eye(3)], axis=1)
        by_theta = np.stack([equations(description, axes, theta + 1j * STEP * e, place).imag / STEP for e in np.eye(7)], axis=1)
        np.testing.assert_allclose(found.by_ground[r], by_ground, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.by_parameters[r], by_theta, rtol=1e-9, atol=1e-9)


def test_partials_are_the_limit_of_differences() -> None:
    """Of the product's own function, by fourth-order differences: what the equations above may have in common with it is no excuse."""
    cameras = packed(camera())
    _, ground = targets(camera())
    found = project(cameras, ground, CORRECTION)
    steps = np.array([20.0, 20.0, 20.0, 2e-4, 2e-4, 2e-4, 0.02])
    for k in range(7):
        shift = steps[k] * np.eye(7)[k]
        one = project(cameras, ground, CORRECTION + shift).image - project(cameras, ground, CORRECTION - shift).image
        two = project(cameras, ground, CORRECTION + 2 * shift).image - project(cameras, ground, CORRECTION - 2 * shift).image
        np.testing.assert_allclose(found.by_parameters[:, :, k] * steps[k], (8.0 * one - two) / 12.0, rtol=0.0, atol=2e-9)


def test_signs_of_the_corrections() -> None:
    """A camera that looks straight down, tops of images ahead: what every parameter does to the image of a point below."""
    place = np.array([[10.0, 40.0, 100_000.0]])
    east, north, up = local_axes(place)[0]
    position = geodetic_to_geocentric(place, MOON)[0]
    down = camera(
        position=position.tolist(), rotation=[east.tolist(), (-north).tolist(), (-up).tolist()], velocity=north.tolist(),
        distortion=None, principal_point=[0.0, 0.0], mm_to_pixel=[[0.0, 50.0, 0.0], [0.0, 0.0, 50.0]],
    )  # fmt: skip
    by = project(FRAME.pack(down, SIZE, SIZE)[None], (position - 100_000.0 * up)[None]).by_parameters[0]
    scale = 50.0 * 76.054 / 100_000.0
    expected = np.zeros((2, 7))
    expected[1, 0] = scale  # ahead: the point falls behind, down in the image
    expected[0, 1] = scale  # cross track is left of the flight: the point falls to the right
    expected[0, 3] = 50.0 * 76.054  # about the direction of flight, right-handed: the camera looks to the left
    expected[1, 4] = -50.0 * 76.054  # about the axis to the left: it looks back
    np.testing.assert_allclose(by, expected, rtol=0.0, atol=1e-9)
    aside = project(FRAME.pack(down, SIZE, SIZE)[None], (position - 100_000.0 * up + 1000.0 * east)[None]).by_parameters[0]
    assert aside[0, 2] < 0.0 < aside[0, 6]  # farther away is smaller, a longer focal length is larger
    np.testing.assert_allclose(aside[:, 5], [0.0, -scale * 1000.0], atol=1e-9)  # turned clockwise as it looks: the right goes up


@pytest.mark.parametrize("ellipsoid", [MOON, WGS84])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_localise_is_the_inverse_of_the_unadjusted_camera(ellipsoid: Ellipsoid, direction: str) -> None:
    description = camera(ellipsoid)
    description["distortion"]["direction"] = direction
    image, ground = targets(description, ellipsoid)
    np.testing.assert_allclose(project(packed(description), ground).image, image, rtol=0.0, atol=1e-6)


def test_localise_gives_the_heights_asked_for() -> None:
    heights = np.array([-8000.0, 0.0, 9000.0])
    found = FRAME.localise(packed(camera(WGS84)), np.zeros(3, dtype=np.int32), np.full(3, 100.0), np.full(3, 5000.0), heights, WGS84)
    np.testing.assert_array_equal(found[:, 2], heights)
    assert len(np.unique(found[:, 1])) == 3


def test_what_is_behind_the_camera_or_out_of_its_field_is_not_seen() -> None:
    description = camera()
    cameras, position = packed(description), np.array(description["position"])
    sight, right = np.array(description["rotation"])[2], np.array(description["rotation"])[0]
    places = np.stack([position + 1e5 * sight, position - 1e5 * sight, position + 1e5 * right, position + 1e4 * (sight + 3.0 * right)])
    found = project(cameras, places)
    assert np.isfinite(found.image[0]).all()
    # straight behind, at a right angle, and 72 degrees off, where the polynomial of the distortion has turned back
    assert np.isnan(found.image[1:]).all()
    assert np.isnan(found.by_parameters[1:]).all()


def test_a_ray_that_misses_the_ground_is_nan() -> None:
    place = np.array([[0.0, 0.0, 100_000.0]])
    east, north, up = local_axes(place)[0]
    rotation, position = [north.tolist(), (-up).tolist(), (-east).tolist()], geodetic_to_geocentric(place, MOON)[0].tolist()
    level = packed(camera(rotation=rotation, position=position))
    samples, lines = np.full(3, 2862.0), np.array([0.0, 2861.0, 5700.0])
    found = FRAME.localise(level, np.zeros(3, dtype=np.int32), samples, lines, np.zeros(3), MOON)
    assert np.isnan(found[:2]).all()
    assert np.isfinite(found[2]).all()


def test_a_camera_below_the_height_reaches_nothing() -> None:
    found = FRAME.localise(packed(camera()), np.zeros(1, dtype=np.int32), np.array([2862.0]), np.array([2861.0]), np.array([2e5]), MOON)
    assert np.isnan(found).all()


def test_quaternion_and_matrix_are_the_same_camera() -> None:
    q = np.array([0.36, -0.48, 0.64, 0.48])
    of_matrix, of_quaternion = (packed(camera(rotation=r)) for r in (quaternion_rotation(q).tolist(), q.tolist()))
    np.testing.assert_allclose(of_quaternion, of_matrix, rtol=1e-14, atol=1e-15)


def test_axes_may_be_given() -> None:
    description = camera()
    given = {k: v for k, v in description.items() if k != "velocity"} | {"axes": flight_axes(description).tolist()}
    np.testing.assert_allclose(packed(given), packed(description), rtol=1e-14, atol=1e-14)


def test_a_still_camera_has_sensible_axes() -> None:
    """Without velocity: the top of an image that looks down, the line of sight of one that looks along the ground."""
    description = camera()
    ahead = flight_axes(description)
    del description["velocity"]
    np.testing.assert_allclose(packed(description)[0, 12:21].reshape(3, 3), ahead, atol=0.01)  # rows of this sensor are slightly skew
    place = np.array([[0.0, 0.0, 100.0]])
    east, north, up = local_axes(place)[0]
    level = description | {
        "position": geodetic_to_geocentric(place, MOON)[0].tolist(), "rotation": [north.tolist(), (-up).tolist(), (-east).tolist()],
    }  # fmt: skip
    np.testing.assert_allclose(packed(level)[0, 12:21].reshape(3, 3), [-east, -north, up], atol=1e-12)


def test_each_ray_takes_its_own_camera_correction_and_point() -> None:
    cameras = np.concatenate([packed(c) for c in variants()])
    rng = np.random.default_rng(4)
    theta = CORRECTION * rng.uniform(-1.0, 1.0, (4, 7))
    _, ground = targets(camera(), count=20)
    image, point = rng.integers(0, 4, 50).astype(np.int32), rng.integers(0, 20, 50).astype(np.int32)
    # a column more than the sensor has parameters, and cameras padded to the width of a wider sensor
    wide = np.column_stack([theta, np.full(4, np.nan)])
    padded = np.column_stack([cameras, np.full((4, 5), np.nan)])
    together = FRAME.project(padded, wide, Ground.at(ground, MOON), image, point)
    assert together.by_parameters.shape == (50, 2, 7)
    for r in range(50):
        alone = project(cameras[image[r]][None], ground[point[r]][None], theta[image[r]])
        np.testing.assert_array_equal(together.image[r], alone.image[0])
        np.testing.assert_array_equal(together.by_ground[r], alone.by_ground[0])
        np.testing.assert_array_equal(together.by_parameters[r], alone.by_parameters[0])


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_million_rays_take_seconds_at_most(direction: str) -> None:
    """A guard against a loop that fell out of compiled code (a hundred times slower), on however busy a machine."""
    description = camera()
    description["distortion"]["direction"] = direction
    cameras = np.repeat(packed(description), 50, axis=0)
    _, ground = targets(description, count=1000)
    rng = np.random.default_rng(1)
    image, point = rng.integers(0, 50, 200_000).astype(np.int32), rng.integers(0, 1000, 200_000).astype(np.int32)
    theta, at = np.tile(CORRECTION, (50, 1)), Ground.at(ground, MOON)
    FRAME.project(cameras, theta, at, image[:10], point[:10])
    started = time.perf_counter()
    FRAME.project(cameras, theta, at, image, point)
    assert time.perf_counter() - started < 2.0


def test_mean_height_is_as_described() -> None:
    assert FRAME.mean_height(packed(camera())).tolist() == [-1500.0]


NO_ROTATION = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.1, 1.0]]
LENS = camera()["distortion"]
BAD: list[tuple[dict[str, Any], str]] = [
    ({"position": None}, "position is None; expected 3 numbers"),
    ({"position": [0.0, 0.0, 0.0]}, "position is the centre of the body"),
    ({"position": [1.0, float("nan"), 2.0]}, "all finite"),
    ({"position": [1.0, 2.0]}, "position is [1.0, 2.0]; expected 3 numbers (geocentric metres)"),
    ({"rotation": NO_ROTATION}, "rotation has determinant 1 and stretches by 0.951"),
    ({"rotation": np.diag([1.0, 1.0, -1.0]).tolist()}, "rotation has determinant -1"),
    ({"rotation": [1.0, 1.0, 0.0, 0.0]}, "rotation is a quaternion of length 1.41421; expected a unit quaternion, scalar first"),
    ({"rotation": "north"}, "rotation is 'north'; expected 3 x 3 numbers"),
    ({"looks_along": "z"}, "looks_along is 'z'; expected '+z' or '-z'"),
    ({"focal_length": 0.0}, "focal_length is 0; expected a positive number of millimetres"),
    ({"focal_length": "76 mm"}, "focal_length is '76 mm'; expected one number (millimetres)"),
    ({"mm_to_pixel": [[0.0, 50.0, 50.0], [0.0, 50.0, 50.0]]}, "expected x and y of the focal plane to go different ways"),
    ({"height": float("inf")}, "height is inf; expected one number (metres above the ellipsoid)"),
    ({"velocity": camera()["position"]}, "straight up or down; expected a direction of flight, or 'axes'"),
    ({"axes": NO_ROTATION}, "axes has determinant"),
    ({"distortion": 3}, "distortion is 3; expected an object with radial, decentering and direction"),
    ({"distortion": {"radial": RADIAL}}, "direction of the distortion is None; expected 'measured to ideal' or 'ideal to measured'"),
    ({"distortion": LENS | {"radial": [1e-6]}}, "radial is [1e-06]; expected 3 numbers (k1, k2, k3"),
    ({"distortion": LENS | {"radial": [-1e-3, 0.0, 0.0]}}, "not one-to-one at the corner of the image (sample -0.5, line -0.5)"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_bad_description_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as refused:
        packed(camera(**changes))
    assert str(refused.value).startswith("frame: ")
    assert message in str(refused.value)


@pytest.mark.parametrize("name", ["position", "rotation", "focal_length", "mm_to_pixel", "height"])
def test_missing_value_is_named(name: str) -> None:
    description = camera()
    del description[name]
    with pytest.raises(InputError, match=f"frame: {name} is missing; expected"):
        packed(description)


def test_size_must_be_positive() -> None:
    with pytest.raises(InputError, match="frame: image size is 0 x 100; expected positive numbers of pixels"):
        FRAME.pack(camera(), 0, 100)
