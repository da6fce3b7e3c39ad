"""Coordinates: against the textbook formulas in extended precision, there and back, and their Jacobians against differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.errors import InputError
from submin.geodesy import (
    WGS84,
    Ellipsoid,
    geocentric_to_geodetic,
    geodetic_to_geocentric,
    geodetic_with_jacobian,
    local_axes,
    rotate_covariance,
)

Array = NDArray[np.float64]

MOON = Ellipsoid(1737400.0, 0.0)
MARS = Ellipsoid(3396190.0, 1.0 / 169.8944472236118)
BODIES = pytest.mark.parametrize("body", [WGS84, MOON, MARS], ids=["earth", "moon", "mars"])

NANOMETRES = 5e-9
"""Some spacings of float64 at the Earth's radius (0.9 nm)."""


def places(seed: int = 3, count: int = 300) -> Array:
    """Places all over a body, poles, equator, date line and prime meridian among them."""
    rng = np.random.default_rng(seed)
    heights = np.array([-11e3, 0.0, 8.8e3, 700e3])
    meridians, parallels = (-180.0, -90.0, 0.0, 90.0, 179.999999999, 180.0), (-90.0, -89.9999999, 0.0, 89.9999999, 90.0)
    special = np.array([[lon, lat] for lon in meridians for lat in parallels])
    special = np.column_stack([np.repeat(special, len(heights), axis=0), np.tile(heights, len(special))])
    somewhere = np.column_stack([rng.uniform(-180.0, 180.0, count), rng.uniform(-90.0, 90.0, count), rng.uniform(-11e3, 700e3, count)])
    return np.concatenate([special, somewhere])


def textbook(geodetic: Array, body: Ellipsoid) -> Array:
    """``X = (N + h) cos(lat) cos(lon)``, ... in extended precision (Heiskanen and Moritz 1967, 5-27)."""
    radians = np.arctan(np.longdouble(1.0)) / 45
    lon, lat, h = (geodetic.astype(np.longdouble) * [radians, radians, np.longdouble(1.0)]).T
    e2 = np.longdouble(body.flattening) * (2 - np.longdouble(body.flattening))
    n = np.longdouble(body.semimajor_axis) / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    exact = [(n + h) * np.cos(lat) * np.cos(lon), (n + h) * np.cos(lat) * np.sin(lon), (n * (1 - e2) + h) * np.sin(lat)]
    return np.stack(exact, axis=1).astype(np.float64)


@BODIES
def test_geocentric_coordinates_are_those_of_the_textbook(body: Ellipsoid) -> None:
    np.testing.assert_allclose(geodetic_to_geocentric(places(), body), textbook(places(), body), rtol=0.0, atol=NANOMETRES)


@BODIES
def test_there_and_back_to_nanometres_poles_and_date_line_included(body: Ellipsoid) -> None:
    geocentric = textbook(places(), body)
    geodetic = geocentric_to_geodetic(geocentric, body)
    np.testing.assert_allclose(textbook(geodetic, body), geocentric, rtol=0.0, atol=NANOMETRES)
    np.testing.assert_allclose(geodetic[:, 2], places()[:, 2], rtol=0.0, atol=NANOMETRES)
    np.testing.assert_allclose(geodetic[:, 1], places()[:, 1], rtol=0.0, atol=1e-13)


@BODIES
def test_longitudes_come_back_within_half_a_turn(body: Ellipsoid) -> None:
    away = np.abs(places()[:, 1]) < 89.9
    geodetic = geocentric_to_geodetic(textbook(places(), body), body)[away]
    turns = (geodetic[:, 0] - places()[away, 0]) / 360.0
    assert np.abs(geodetic[:, 0]).max() <= 180.0 + 1e-12
    np.testing.assert_allclose(turns, np.round(turns), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("z", [6356752.3142, -6356752.3142, 6.4e6])
def test_points_on_the_axis_stay_finite(z: float) -> None:
    geodetic = geocentric_to_geodetic(np.array([[0.0, 0.0, z]]))
    assert np.isfinite(geodetic).all()
    assert geodetic[0, 1] == pytest.approx(np.copysign(90.0, z), abs=1e-12)
    assert geodetic[0, 2] == pytest.approx(abs(z) - WGS84.semiminor_axis, abs=NANOMETRES)


def test_no_points_are_no_trouble() -> None:
    assert geodetic_to_geocentric(np.empty((0, 3))).shape == (0, 3)
    assert geocentric_to_geodetic(np.empty((0, 3))).shape == (0, 3)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.floats(-180.0, 180.0), st.floats(-90.0, 90.0), st.floats(-0.02, 0.12), st.floats(1e5, 1e8), st.floats(0.0, 0.006))
def test_there_and_back_on_any_solid_body(lon: float, lat: float, height_in_radii: float, axis: float, flattening: float) -> None:
    body = Ellipsoid(axis, flattening)
    geocentric = textbook(np.array([[lon, lat, height_in_radii * axis]]), body)
    back = textbook(geocentric_to_geodetic(geocentric, body), body)
    np.testing.assert_allclose(back, geocentric, rtol=0.0, atol=1e-15 * axis)


@BODIES
@pytest.mark.parametrize("latitude", [-89.9, -45.0, 0.0, 33.0, 89.9])
def test_jacobian_is_the_limit_of_differences(body: Ellipsoid, latitude: float) -> None:
    geodetic = np.array([[lon, latitude, h] for lon in (-180.0, -30.0, 0.0, 120.0) for h in (-5e3, 4e3)])
    geocentric = textbook(geodetic, body)
    jacobian = geodetic_with_jacobian(geocentric, body)[1]
    step = 10.0
    for k in range(3):
        shift = step * np.eye(3)[k]
        difference = geocentric_to_geodetic(geocentric + shift, body) - geocentric_to_geodetic(geocentric - shift, body)
        difference[:, 0] -= 360.0 * np.round(difference[:, 0] / 360.0)
        metres = np.abs(jacobian).max(axis=(0, 2))
        # second order: (step / distance from the axis)^2, 1e-5 at the highest latitude of the smallest body
        second_order = 2e-5 if abs(latitude) > 89.0 else 1e-9
        np.testing.assert_allclose(difference / (2.0 * step) / metres, jacobian[:, :, k] / metres, rtol=0.0, atol=second_order)


def test_local_axes_are_orthonormal_and_right_handed() -> None:
    rotation = local_axes(places())
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, rtol=0.0, atol=1e-14)


def test_local_axes_point_east_north_and_up() -> None:
    np.testing.assert_allclose(local_axes(np.array([[0.0, 0.0, 0.0]]))[0], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(local_axes(np.array([[90.0, 0.0, 0.0]]))[0], [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-15)
    geodetic = places()[np.abs(places()[:, 1]) < 80.0]
    for axis, step in enumerate(([1e-5, 0.0, 0.0], [0.0, 1e-5, 0.0], [0.0, 0.0, 1.0])):
        moved = textbook(geodetic + step, WGS84) - textbook(geodetic, WGS84)
        along = np.einsum("nij,nj->ni", local_axes(geodetic), moved) / np.linalg.norm(moved, axis=1)[:, None]
        np.testing.assert_allclose(along, np.broadcast_to(np.eye(3)[axis], along.shape), rtol=0.0, atol=1e-6)


def test_rotated_covariance_is_that_of_the_rotated_error() -> None:
    rng = np.random.default_rng(2)
    factor, rotation = rng.normal(size=(20, 3, 3)), local_axes(places(count=20)[-20:])
    rotated = rotate_covariance(factor @ factor.transpose(0, 2, 1), rotation)
    for k in range(20):
        turned = rotation[k] @ factor[k]
        np.testing.assert_allclose(rotated[k], turned @ turned.T, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("axis", "flattening", "words"),
    [
        (0.0, 0.0, "semimajor_axis is 0.0"),
        (-1.0, 0.0, "positive number of metres"),
        (np.nan, 0.0, "semimajor_axis is nan"),
        (np.inf, 0.0, "semimajor_axis is inf"),
        (1.0, 1.0, "flattening is 1.0"),
        (1.0, -0.1, "0 .sphere. to below 1"),
        (1.0, np.nan, "flattening is nan"),
        (6378137.0, 298.257223563, "flattening is 298"),
    ],
)
def test_impossible_bodies_are_refused(axis: float, flattening: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Ellipsoid(axis, flattening)


def test_radii_of_the_reference_ellipsoid() -> None:
    assert WGS84.semiminor_axis == pytest.approx(6356752.314245, abs=1e-6)
    assert WGS84.eccentricity_squared == pytest.approx(6.69437999014e-3, abs=1e-14)
    assert MOON.semiminor_axis == MOON.semimajor_axis
