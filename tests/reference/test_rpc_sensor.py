"""The RPC sensor against GDAL on the vendors' own cameras, its partials against differences, and every bad description by its message."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer

from submin.errors import InputError
from submin.formats.rpc_files import read_rpc
from submin.geodesy import WGS84, geodetic_to_geocentric
from submin.sensors import Ground, sensor_named
from submin.sensors.rpc import POLYNOMIALS, SCALARS

Array = NDArray[np.float64]

RPC_SENSOR = sensor_named("rpc")
REAL = (
    "pleiades_provence_triplet/rpc/img_01.json", "pleiades_provence_triplet/rpc/img_02.json", "pleiades_provence_triplet/rpc/img_03.json",
    "pleiades_ventoux_pair/rpc/left_image.json", "pleiades_ventoux_pair/rpc/right_image.json",
    "wv3_jax068/rpc_raw/JAX_068_001_RGB.json", "wv3_jax068/rpc_raw/JAX_068_013_RGB.json", "wv3_jax068/rpc_raw/JAX_068_022_RGB.json",
)  # fmt: skip
CORRECTION = np.array([[7.0, -3.0, 4.0, -11.0, 2.5, -5.0]])
"""Pixels, every one of them large enough that its product with a partial can be seen."""
WIDTH, HEIGHT = 1024.0, 820.0


def real_camera(data: Path, name: str) -> dict[str, Any]:
    return read_rpc(data / name)


def simple_camera(**changes: Any) -> dict[str, Any]:
    """Affine camera of half-metre pixels on the equator, with one weak quadratic term and a denominator."""
    numerator, denominator = [0.0] * 20, [1.0] + [0.0] * 19
    camera: dict[str, Any] = dict.fromkeys(SCALARS, 0.0) | {
        "LINE_SCALE": 5000.0, "SAMP_SCALE": 5000.0, "LAT_SCALE": 0.0225, "LONG_SCALE": 0.0225, "HEIGHT_SCALE": 500.0,
        "SAMP_NUM_COEFF": [0.0, 1.0, 0.1, 0.08, *numerator[4:]], "LINE_NUM_COEFF": [0.0, 0.1, -1.0, 0.02, 1e-4, *numerator[5:]],
        "SAMP_DEN_COEFF": [1.0, 0.0, 0.0, 1e-3, *denominator[4:]], "LINE_DEN_COEFF": list(denominator),
    }  # fmt: skip
    return camera | changes


def packed(camera: dict[str, Any]) -> Array:
    return RPC_SENSOR.pack(camera, WIDTH, HEIGHT)[None]


def places(camera: dict[str, Any], count: int = 400, seed: int = 8, reach: float = 0.95) -> Array:
    """Longitudes, latitudes and heights (n, 3) within the camera's own box."""
    offset = np.array([camera["LONG_OFF"], camera["LAT_OFF"], camera["HEIGHT_OFF"]])
    scale = np.array([camera["LONG_SCALE"], camera["LAT_SCALE"], camera["HEIGHT_SCALE"]])
    return np.asarray(offset + scale * np.random.default_rng(seed).uniform(-reach, reach, (count, 3)))


def project(cameras: Array, geocentric: Array, theta: Array | None = None) -> Any:
    rows = np.arange(len(geocentric), dtype=np.int32)
    theta = np.zeros((1, 6)) if theta is None else theta
    return RPC_SENSOR.project(cameras, theta, Ground.at(geocentric), np.zeros_like(rows), rows)


def gdal(camera: dict[str, Any], geodetic: Array) -> Array:
    """Sample and line (n, 2) by GDAL, brought to our convention: the centre of the first pixel is (0, 0), not (0.5, 0.5)."""
    rpc = RPC(
        **{name.lower(): camera[name] for name in SCALARS},
        **{name.lower(): list(camera[name]) for name in POLYNOMIALS}, err_bias=None, err_rand=None,
    )  # fmt: skip
    with RPCTransformer(rpc) as transformer:
        rows, columns = transformer.rowcol(*(list(c) for c in geodetic.T), op=lambda x: x)
    return np.stack([np.asarray(columns), np.asarray(rows)], axis=1) - 0.5


@pytest.mark.parametrize("name", REAL)
def test_sample_and_line_are_those_of_gdal(data: Path, name: str) -> None:
    camera = real_camera(data, name)
    geodetic = places(camera)
    image = project(packed(camera), geodetic_to_geocentric(geodetic)).image
    assert np.ptp(image, axis=0).min() > 500.0
    np.testing.assert_allclose(image, gdal(camera, geodetic), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("longitude", [180.0, -180.0, 179.995, -179.995])
def test_across_the_antimeridian_as_anywhere_else(longitude: float) -> None:
    camera = simple_camera(LONG_OFF=longitude)
    shift = places(simple_camera())
    geodetic = shift + np.array([longitude, 0.0, 0.0])
    geodetic[:, 0] -= 360.0 * np.round(geodetic[:, 0] / 360.0)
    assert (geodetic[:, 0] > 0.0).any() and (geodetic[:, 0] < 0.0).any()
    image = project(packed(camera), geodetic_to_geocentric(geodetic)).image
    elsewhere = project(packed(simple_camera()), geodetic_to_geocentric(shift)).image
    np.testing.assert_allclose(image, elsewhere, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(image, gdal(camera, geodetic), rtol=0.0, atol=1e-6)


def test_longitudes_that_run_to_360_are_the_same_places() -> None:
    west, east = simple_camera(LONG_OFF=-81.6), simple_camera(LONG_OFF=278.4)
    ground = geodetic_to_geocentric(places(west))
    np.testing.assert_allclose(project(packed(east), ground).image, project(packed(west), ground).image, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", REAL[::3])
def test_partials_by_ground_are_the_limit_of_differences(data: Path, name: str) -> None:
    camera = real_camera(data, name)
    cameras, ground = packed(camera), geodetic_to_geocentric(places(camera, 60))
    by_ground = project(cameras, ground, CORRECTION).by_ground
    step = 5.0
    for k in range(3):
        shift = step * np.eye(3)[k]
        one = project(cameras, ground + shift, CORRECTION).image - project(cameras, ground - shift, CORRECTION).image
        two = project(cameras, ground + 2.0 * shift, CORRECTION).image - project(cameras, ground - 2.0 * shift, CORRECTION).image
        np.testing.assert_allclose(by_ground[:, :, k], (8.0 * one - two) / (12.0 * step), rtol=0.0, atol=1e-8)
    assert np.abs(by_ground).max() > 1.0
    # the drift takes part: without it the partials are others
    assert np.abs(by_ground - project(cameras, ground).by_ground).max() > 1e-3


@pytest.mark.parametrize("name", REAL[::3])
def test_partials_by_parameters_are_the_limit_of_differences(data: Path, name: str) -> None:
    camera = real_camera(data, name)
    cameras, ground = packed(camera), geodetic_to_geocentric(places(camera, 60, reach=0.3))
    by_parameters = project(cameras, ground, CORRECTION).by_parameters
    for k in range(6):
        shift = 0.5 * np.eye(6)[k]
        difference = project(cameras, ground, CORRECTION + shift).image - project(cameras, ground, CORRECTION - shift).image
        np.testing.assert_allclose(by_parameters[:, :, k], difference, rtol=0.0, atol=1e-9)


def test_correction_acts_on_coordinates_scaled_to_the_image() -> None:
    # the corners of an image whose first pixel is at (300, -40) of the RPC's frame
    cameras = RPC_SENSOR.pack(simple_camera(origin=[300.0, -40.0]), WIDTH, HEIGHT)[None]
    corners = np.array([[299.5, -40.5], [299.5 + WIDTH, -40.5], [299.5, -40.5 + HEIGHT], [299.5 + WIDTH, -40.5 + HEIGHT]])
    zero = np.zeros(4, dtype=np.int32)
    ground = geodetic_to_geocentric(RPC_SENSOR.localise(cameras, zero, corners[:, 0], corners[:, 1], np.zeros(4), WGS84))
    a0, a1, a2, b0, b1, b2 = CORRECTION[0]
    expected = [
        [a0 - a1 - a2, b0 - b1 - b2],
        [a0 + a1 - a2, b0 + b1 - b2],
        [a0 - a1 + a2, b0 - b1 + b2],
        [a0 + a1 + a2, b0 + b1 + b2],
    ]  # fmt: skip
    np.testing.assert_allclose(project(cameras, ground, CORRECTION).image - corners, expected, rtol=0.0, atol=1e-5)


def test_bias_names_the_parameters_that_shift_the_whole_image() -> None:
    by_parameters = project(packed(simple_camera()), geodetic_to_geocentric(places(simple_camera()))).by_parameters
    np.testing.assert_array_equal(by_parameters[:, :, [0, 3]], np.broadcast_to(np.eye(2), (400, 2, 2)))


def test_the_factor_of_a_drift_grows_over_the_image_as_it_says() -> None:
    cameras, ground = packed(simple_camera()), geodetic_to_geocentric(places(simple_camera(), 20))
    every, measured = np.arange(20, dtype=np.int32), np.random.default_rng(2).uniform(0.0, 800.0, (20, 2))
    by_pixel = RPC_SENSOR.drift_by_pixel(cameras)[0]
    for axis in (0, 1):
        here, there = (
            RPC_SENSOR.project(cameras, CORRECTION, Ground.at(ground), 0 * every, every, measured + shift * np.eye(2)[axis]).by_parameters
            for shift in (0.0, 100.0)
        )
        grown = np.zeros_like(here)
        for k, parameter in enumerate(RPC_SENSOR.parameters):
            if parameter.drift is not None and parameter.drift.axis == axis:
                grown[:, :, k] = 100.0 * by_pixel[axis] * here[:, :, parameter.drift.of]
        np.testing.assert_allclose(there - here, grown, rtol=0.0, atol=1e-12)
        assert np.abs(grown).max() > 0.1


def test_each_ray_takes_its_own_camera_correction_and_point(data: Path) -> None:
    cameras = np.concatenate([packed(real_camera(data, name)) for name in REAL[:3]])
    rng = np.random.default_rng(4)
    theta = rng.normal(0.0, 5.0, (3, 6))
    geocentric = geodetic_to_geocentric(places(real_camera(data, REAL[0]), 20))
    image, point = rng.integers(0, 3, 50).astype(np.int32), rng.integers(0, 20, 50).astype(np.int32)
    together = RPC_SENSOR.project(cameras, theta, Ground.at(geocentric), image, point)
    for r in range(50):
        i, j = image[r], point[r]
        alone = project(cameras[i : i + 1], geocentric[j : j + 1], theta[i : i + 1])
        np.testing.assert_array_equal(together.image[r], alone.image[0])
        np.testing.assert_array_equal(together.by_ground[r], alone.by_ground[0])
        np.testing.assert_array_equal(together.by_parameters[r], alone.by_parameters[0])


@pytest.mark.parametrize("name", REAL)
def test_localise_is_the_inverse_of_the_unadjusted_camera(data: Path, name: str) -> None:
    camera = real_camera(data, name)
    geodetic = places(camera, reach=0.8)
    cameras, rows = packed(camera), np.zeros(len(geodetic), dtype=np.int32)
    image = project(cameras, geodetic_to_geocentric(geodetic)).image
    found = RPC_SENSOR.localise(cameras, rows, image[:, 0], image[:, 1], geodetic[:, 2], WGS84)
    np.testing.assert_array_equal(found[:, 2], geodetic[:, 2])
    # 1e-10 degrees are 11 micrometres
    np.testing.assert_allclose(found[:, :2], geodetic[:, :2], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(project(cameras, geodetic_to_geocentric(found)).image, image, rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("longitude", [180.0, -180.0, 179.995, -179.995])
def test_localise_across_the_antimeridian(longitude: float) -> None:
    cameras = packed(simple_camera(LONG_OFF=longitude))
    samples = np.linspace(-4000.0, 4000.0, 9)
    found = RPC_SENSOR.localise(cameras, np.zeros(9, dtype=np.int32), samples, np.zeros(9), np.zeros(9), WGS84)
    np.testing.assert_allclose(project(cameras, geodetic_to_geocentric(found)).image[:, 0], samples, rtol=0.0, atol=2e-6)


def test_place_that_cannot_be_reached_is_nan() -> None:
    # samples of this camera turn back at 2 500 pixels: sample = 5000 (L - L^2)
    camera = simple_camera(SAMP_NUM_COEFF=[0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0] + [0.0] * 12)
    samples = np.array([1000.0, 2000.0])
    found = RPC_SENSOR.localise(packed(camera), np.zeros(2, dtype=np.int32), samples, np.zeros(2), np.zeros(2), WGS84)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1, :2]).all()


def test_mean_height_is_the_height_offset(data: Path) -> None:
    cameras = np.concatenate([packed(real_camera(data, name)) for name in REAL])
    np.testing.assert_array_equal(RPC_SENSOR.mean_height(cameras), [real_camera(data, name)["HEIGHT_OFF"] for name in REAL])


def without(name: str) -> dict[str, Any]:
    return {key: value for key, value in simple_camera().items() if key != name}


@pytest.mark.parametrize("name", SCALARS + POLYNOMIALS)
def test_missing_entry_is_named(name: str) -> None:
    with pytest.raises(InputError, match=rf"{name} is missing; expected (one number|20 coefficients)"):
        RPC_SENSOR.pack(without(name), WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"LAT_OFF": "north"}, "LAT_OFF is 'north'; expected one number"),
        ({"LAT_OFF": None}, "LAT_OFF is None; expected one number"),
        ({"LONG_OFF": [1.0, 2.0]}, "LONG_OFF is .1.0, 2.0.; expected one number"),
        ({"HEIGHT_OFF": np.nan}, "HEIGHT_OFF is nan; expected a finite number"),
        ({"SAMP_OFF": np.inf}, "SAMP_OFF is inf; expected a finite number"),
        ({"LINE_SCALE": 0.0}, "LINE_SCALE is 0; expected a positive number"),
        ({"HEIGHT_SCALE": -500.0}, "HEIGHT_SCALE is -500; expected a positive number"),
        ({"LINE_NUM_COEFF": [1.0] * 19}, "LINE_NUM_COEFF has 19 coefficients; expected 20"),
        ({"SAMP_DEN_COEFF": [1.0] * 21}, "SAMP_DEN_COEFF has 21 coefficients; expected 20"),
        ({"SAMP_NUM_COEFF": 3.0}, "SAMP_NUM_COEFF has 1 coefficients; expected 20"),
        ({"SAMP_NUM_COEFF": [[1.0] * 20]}, "SAMP_NUM_COEFF has 20 coefficients"),
        ({"LINE_DEN_COEFF": [1.0] * 19 + ["x"]}, "LINE_DEN_COEFF holds something that is not a number"),
        ({"LINE_DEN_COEFF": [1.0] * 19 + [np.nan]}, "LINE_DEN_COEFF holds a value that is not finite"),
    ],
)  # fmt: skip
def test_bad_entry_is_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        RPC_SENSOR.pack(simple_camera(**change), WIDTH, HEIGHT)


@pytest.mark.parametrize("origin", ["corner", [1.0], [0.0, np.nan], [1.0, 2.0, 3.0], None, {"sample": 1.0}], ids=str)
def test_bad_origin_is_named(origin: Any) -> None:
    with pytest.raises(InputError, match="origin"):
        RPC_SENSOR.pack(simple_camera(origin=origin), WIDTH, HEIGHT)


@pytest.mark.parametrize(("width", "height"), [(0.0, 10.0), (10.0, -1.0), (np.nan, 10.0), (10.0, np.inf)])
def test_bad_image_size_is_named(width: float, height: float) -> None:
    with pytest.raises(InputError, match=r"image size is .* expected positive numbers of pixels"):
        RPC_SENSOR.pack(simple_camera(), width, height)


def test_unknown_sensor_is_named() -> None:
    with pytest.raises(InputError, match=r"sensor is 'sar'; expected one of .*rpc"):
        sensor_named("sar")
