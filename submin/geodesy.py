"""Geocentric and geodetic coordinates, local axes, and the Jacobians between them, on any ellipsoid.

Conventions (docs/conventions.md): geocentric coordinates are metres in the body-fixed frame; geodetic coordinates are
``(longitude, latitude, height)`` in degrees, degrees and metres above the ellipsoid; local axes are east, north, up.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
import pyproj
from numpy.typing import NDArray

from submin.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid of revolution of a body.

    Parameters
    ----------
    semimajor_axis : float
        Equatorial radius in metres.
    flattening : float
        Flattening, 0 for a sphere.

    Examples
    --------
    >>> round(WGS84.semiminor_axis, 4)
    6356752.3142
    """

    semimajor_axis: float
    flattening: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.semimajor_axis) and self.semimajor_axis > 0):
            raise InputError(f"semimajor_axis is {self.semimajor_axis}; expected a positive number of metres")
        if not 0.0 <= self.flattening < 1.0:
            raise InputError(f"flattening is {self.flattening}; expected a number from 0 (sphere) to below 1")

    @property
    def semiminor_axis(self) -> float:
        """Polar radius in metres."""
        return self.semimajor_axis * (1.0 - self.flattening)

    @property
    def eccentricity_squared(self) -> float:
        """First eccentricity squared."""
        return self.flattening * (2.0 - self.flattening)


WGS84 = Ellipsoid(6378137.0, 1.0 / 298.257223563)
"""WGS 84 (NIMA TR8350.2, third edition)."""


@lru_cache(maxsize=32)
def _cartesian(ellipsoid: Ellipsoid) -> pyproj.Transformer:
    return pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +a={ellipsoid.semimajor_axis!r} +b={ellipsoid.semiminor_axis!r}"
    )


def geodetic_to_geocentric(geodetic: Array, ellipsoid: Ellipsoid = WGS84) -> Array:
    """Geocentric coordinates (n, 3) in metres of geodetic ones (n, 3) in degrees, degrees, metres.

    Examples
    --------
    >>> geodetic_to_geocentric(np.array([[0.0, 0.0, 10.0]])).round(3).tolist()
    [[6378147.0, 0.0, 0.0]]
    """
    g = np.asarray(geodetic, dtype=np.float64)
    x, y, z = _cartesian(ellipsoid).transform(np.radians(g[:, 0]), np.radians(g[:, 1]), g[:, 2], radians=True)
    return np.stack([x, y, z], axis=1)


def geocentric_to_geodetic(geocentric: Array, ellipsoid: Ellipsoid = WGS84) -> Array:
    """Geodetic coordinates (n, 3) in degrees, degrees, metres of geocentric ones (n, 3) in metres."""
    return geodetic_with_jacobian(geocentric, ellipsoid)[0]


def geodetic_with_jacobian(geocentric: Array, ellipsoid: Ellipsoid = WGS84) -> tuple[Array, Array]:
    """Geodetic coordinates (n, 3) of geocentric ones (n, 3), and their partials (n, 3, 3) by geocentric metres.

    The radii of curvature are those of the meridian and the prime vertical at each point. Bowring's closed form (1976) is good to a
    micrometre near the ellipsoid, and one Newton step brings the round trip to the spacing of float64 (a few nanometres).
    """
    x = np.ascontiguousarray(geocentric, dtype=np.float64)
    return _geodetic(x, ellipsoid.semimajor_axis, ellipsoid.eccentricity_squared)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _geodetic(geocentric: Array, a: float, e2: float) -> tuple[Array, Array]:
    n, degree, b = len(geocentric), np.pi / 180.0, a * np.sqrt(1.0 - e2)
    geodetic, jacobian = np.empty((n, 3)), np.empty((n, 3, 3))
    for j in range(n):
        aside, z = np.hypot(geocentric[j, 0], geocentric[j, 1]), geocentric[j, 2]
        reduced = np.arctan2(z * a, aside * b)
        longitude = np.arctan2(geocentric[j, 1], geocentric[j, 0])
        latitude = np.arctan2(z + e2 / (1.0 - e2) * b * np.sin(reduced) ** 3, aside - e2 * a * np.cos(reduced) ** 3)
        sin_lon, cos_lon, sin_lat, cos_lat = np.sin(longitude), np.cos(longitude), np.sin(latitude), np.cos(latitude)
        root = np.sqrt(1.0 - e2 * sin_lat * sin_lat)
        height = aside * cos_lat + z * sin_lat - a * root
        vertical = a / root
        meridian = vertical * (1.0 - e2) / (root * root)
        axes = jacobian[j]
        axes[0, 0], axes[0, 1], axes[0, 2] = -sin_lon, cos_lon, 0.0
        axes[1, 0], axes[1, 1], axes[1, 2] = -sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat
        axes[2, 0], axes[2, 1], axes[2, 2] = cos_lat * cos_lon, cos_lat * sin_lon, sin_lat
        for k in range(3):
            axes[0, k] /= degree * (vertical + height) * cos_lat
            axes[1, k] /= degree * (meridian + height)
        across = (vertical + height) * cos_lat
        dx = geocentric[j, 0] - across * cos_lon
        dy = geocentric[j, 1] - across * sin_lon
        dz = geocentric[j, 2] - (vertical * (1.0 - e2) + height) * sin_lat
        for k, value in enumerate((longitude / degree, latitude / degree, height)):
            geodetic[j, k] = value + axes[k, 0] * dx + axes[k, 1] * dy + axes[k, 2] * dz
    return geodetic, jacobian


def local_axes(geodetic: Array) -> Array:
    """Rotations (n, 3, 3) from geocentric to local axes: rows are the unit vectors east, north and up at each point."""
    lon, lat = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    sin_lon, cos_lon, sin_lat, cos_lat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    rotation = np.empty((len(lon), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 0, 2] = -sin_lon, cos_lon, 0.0
    rotation[:, 1, 0], rotation[:, 1, 1], rotation[:, 1, 2] = -sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat
    rotation[:, 2, 0], rotation[:, 2, 1], rotation[:, 2, 2] = cos_lat * cos_lon, cos_lat * sin_lon, sin_lat
    return rotation


def common_axes(geocentric: Array, ellipsoid: Ellipsoid = WGS84) -> Array:
    """Axes (3, 3) that points (n, 3) share: rows east, north and up in their middle, or the geocentric ones all around a body."""
    middle = geocentric.mean(axis=0) if len(geocentric) else np.zeros(3)
    if np.linalg.norm(middle) < 0.5 * ellipsoid.semiminor_axis:
        return np.eye(3)
    return np.asarray(local_axes(geocentric_to_geodetic(middle[None], ellipsoid))[0])


def rotate_covariance(covariance: Array, rotation: Array) -> Array:
    """``R P R'`` for stacks of 3 x 3 matrices (n, 3, 3)."""
    return np.asarray(rotation @ covariance @ np.swapaxes(rotation, -1, -2))
