"""RPCs fitted to known cameras: the fit is judged by the sensor that will use it, at places that are not nodes of the grid."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from submin.errors import InputError, NumericalError
from submin.geodesy import geodetic_to_geocentric, local_axes
from submin.sensors import Ground, sensor_named
from submin.simulation.rpc_fit import cubic_terms, fit_rpc

Array = NDArray[np.float64]

CENTRE = np.array([[12.3, 47.1, 0.0]])
LONGITUDES, LATITUDES, HEIGHTS = (11.95, 12.65), (46.85, 47.35), (-200.0, 2200.0)
PIXELS = 14286


def linear_array(geodetic: Array, pitch_deg: float = 22.0) -> Array:
    """Pushbroom camera in straight flight northwards, 506 km above the tangent plane of the centre, 3.5 m pixels."""
    local = (geodetic_to_geocentric(geodetic) - geodetic_to_geocentric(CENTRE)) @ local_axes(CENTRE)[0].T
    below, tangent = 506e3 - local[:, 2], np.tan(np.radians(pitch_deg))
    line = (local[:, 1] - below * tangent + 506e3 * tangent) / 3.5
    slant = below / np.cos(np.radians(pitch_deg))
    sample = local[:, 0] / slant * (506e3 / np.cos(np.radians(pitch_deg)) / 3.5)
    return np.stack([sample, line], axis=1) + 0.5 * (PIXELS - 1)


def project(camera: dict[str, object], geodetic: Array) -> Array:
    sensor = sensor_named("rpc")
    packed = sensor.pack(camera, PIXELS, PIXELS)[None]
    places = np.arange(len(geodetic), dtype=np.int32)
    ground = Ground.at(geodetic_to_geocentric(geodetic))
    return sensor.project(packed, np.zeros((1, 6)), ground, np.zeros_like(places), places).image


def places(count: int = 2000) -> Array:
    rng = np.random.default_rng(5)
    low, high = np.array([LONGITUDES, LATITUDES, HEIGHTS]).T
    return np.asarray(rng.uniform(low, high, (count, 3)))


@pytest.mark.parametrize("pitch_deg", [22.0, 0.0, -22.0])
def test_linear_array_is_reproduced_to_a_hundredth_of_a_pixel(pitch_deg: float) -> None:
    camera, rms_px = fit_rpc(lambda g: linear_array(g, pitch_deg), LONGITUDES, LATITUDES, HEIGHTS)
    misfit = project(camera, places()) - linear_array(places(), pitch_deg)
    assert np.abs(misfit).max() < 0.01
    assert rms_px < 0.005
    assert np.sqrt(np.mean(misfit**2)) < 2.0 * rms_px + 1e-6


def test_denominators_stay_near_one() -> None:
    camera, _ = fit_rpc(linear_array, LONGITUDES, LATITUDES, HEIGHTS)
    corners = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3), axis=-1).reshape(-1, 3)
    for name in ("LINE_DEN_COEFF", "SAMP_DEN_COEFF"):
        assert camera[name][0] == 1.0
        assert np.abs(cubic_terms(corners) @ np.array(camera[name]) - 1.0).max() < 0.02


def test_terms_are_in_the_order_of_the_sensor() -> None:
    rng = np.random.default_rng(1)
    numerators = rng.normal(size=(2, 20))
    one = [1.0] + [0.0] * 19
    camera = {
        "LINE_OFF": 0.0, "SAMP_OFF": 0.0, "LAT_OFF": 0.0, "LONG_OFF": 0.0, "HEIGHT_OFF": 0.0,
        "LINE_SCALE": 1.0, "SAMP_SCALE": 1.0, "LAT_SCALE": 1.0, "LONG_SCALE": 1.0, "HEIGHT_SCALE": 1.0,
        "LINE_NUM_COEFF": numerators[1].tolist(), "LINE_DEN_COEFF": one, "SAMP_NUM_COEFF": numerators[0].tolist(), "SAMP_DEN_COEFF": one,
    }  # fmt: skip
    geodetic = rng.uniform(-1.0, 1.0, (50, 3))
    # Heights of a metre come back from geocentric coordinates with the spacing of float64 at the Earth's radius.
    np.testing.assert_allclose(project(camera, geodetic), cubic_terms(geodetic) @ numerators.T, rtol=0.0, atol=1e-6)


def test_known_rational_function_is_followed() -> None:
    scale = np.array([0.35, 0.25, 1200.0])

    def rational(geodetic: Array) -> Array:
        n = (geodetic - [12.3, 47.1, 1000.0]) / scale
        return np.stack([5000.0 * (n[:, 0] + 0.03 * n[:, 2]) / (1.0 + 0.1 * n[:, 2]), 6000.0 * n[:, 1] + n[:, 1] ** 3], axis=1)

    camera, rms_px = fit_rpc(rational, LONGITUDES, LATITUDES, HEIGHTS)
    assert rms_px < 1e-3
    np.testing.assert_allclose(project(camera, places()), rational(places()), rtol=0.0, atol=0.01)


def test_box_across_the_antimeridian() -> None:
    def plane(geodetic: Array) -> Array:
        return np.stack([(geodetic[:, 0] - 180.0) * 3e4, geodetic[:, 1] * 4e4], axis=1)

    camera, _ = fit_rpc(plane, (179.8, 180.2), (0.1, 0.5), HEIGHTS)
    beyond = np.array([[-179.9, 0.3, 0.0]])
    np.testing.assert_allclose(project(camera, beyond), [[3000.0, 12000.0]], rtol=0.0, atol=0.01)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"longitude_range": (12.0, 12.0)}, "longitude_range"),
        ({"height_range": (2200.0, -200.0)}, "height_range"),
        ({"latitude_range": (46.0, np.nan)}, "latitude_range"),
        ({"grid": (12, 12, 3)}, "grid"),
        ({"project": lambda g: g}, "shape"),
        ({"project": lambda g: np.where(g[:, 2:] > 2000.0, np.nan, g[:, :2])}, "height 2200"),
        ({"project": lambda g: 0.0 * g[:, :2]}, "the same"),
    ],
)
def test_unusable_input_is_named(change: dict[str, object], words: str) -> None:
    arguments: dict[str, object] = {
        "project": linear_array, "longitude_range": LONGITUDES, "latitude_range": LATITUDES, "height_range": HEIGHTS,
    } | change  # fmt: skip
    with pytest.raises(InputError, match=words):
        fit_rpc(**arguments)  # type: ignore[arg-type]


def test_function_with_a_pole_is_refused() -> None:
    with pytest.raises(NumericalError, match="denominator"):
        fit_rpc(lambda g: np.stack([1.0 / (g[:, 0] - 12.31), g[:, 1]], axis=1), LONGITUDES, LATITUDES, HEIGHTS)
