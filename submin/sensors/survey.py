"""Surveyed control as a sensor: what it "sees" of a ground point is its coordinates along two axes, in metres.

A control point is one more observation of a ground point, with no image parameters (docs/mathematics.md, "Sources"). Its three
coordinates, along the principal axes of their covariance and thereby uncorrelated, are two views of two axes each; the second axis of
the second view is zero and observes nothing. A point whose errors are correlated with those of others has shifts along these axes, which
are parameters of its views (docs/mathematics.md, "Points with a full covariance").
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.geodesy import Ellipsoid
from submin.sensors.base import Ground, Parameter, Projection

Array = NDArray[np.float64]
Index = NDArray[np.int32]

_ORIGIN, _AXES, _PLACE = slice(0, 3), slice(3, 9), slice(9, 12)

SHIFTS = tuple(Parameter(f"shift along the {which} axis", "m", "shift", 0.0) for which in ("first", "second"))
"""Errors of a surveyed point that others share; what is believed of them is stated for a set of points, not by a sigma."""


class SurveySensor:
    """A view of a surveyed point, by itself (no parameters) or of a set of correlated ones (`SHIFTS`).

    The camera is a mapping with ``origin`` (3 geocentric coordinates, metres), ``axes`` (two rows of 3, geocentric) and ``place``
    (longitude and latitude in degrees, height in metres).
    """

    unit = "metre"

    def __init__(self, name: str = "survey", parameters: tuple[Parameter, ...] = ()) -> None:
        self.name = name
        self.parameters = parameters

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        """See `Sensor.pack`."""
        try:
            parts = [np.asarray(camera[name], dtype=np.float64) for name in ("origin", "axes", "place")]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"survey: {error}; expected numbers for origin, axes and place") from None
        if [part.shape for part in parts] != [(3,), (2, 3), (3,)] or not all(np.isfinite(part).all() for part in parts):
            raise InputError("survey: expected 3 finite numbers for origin and place, 2 x 3 for axes")
        return np.concatenate([part.ravel() for part in parts])

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """See `Sensor.project`."""
        axes = np.ascontiguousarray(cameras[image, _AXES]).reshape(-1, 2, 3)
        along = np.einsum("rck,rk->rc", axes, ground.geocentric[point] - cameras[image, _ORIGIN])
        by_parameters = np.zeros((len(image), 2, len(self.parameters)))
        for k in range(len(self.parameters)):
            by_parameters[:, k, k] = axes[:, k].any(axis=1)  # an axis of zeros observes no shift
            along[:, k] += by_parameters[:, k, k] * parameters[image, k]
        return Projection(along, axes, by_parameters)

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """The surveyed place of each view, whatever the height."""
        return np.asarray(cameras[image, _PLACE])

    def mean_height(self, cameras: Array) -> Array:
        """See `Sensor.mean_height`."""
        return np.asarray(cameras[:, _PLACE.stop - 1])


def surveyed_axes(cameras: Array) -> Array:
    """Axes (m, 2, 3) of packed views (m, c), geocentric; an axis of zeros observes nothing."""
    return np.ascontiguousarray(cameras[:, _AXES]).reshape(-1, 2, 3)


def surveyed_place(cameras: Array) -> tuple[Array, Array]:
    """Geocentric and geodetic coordinates (m, 3) of the points of packed views (m, c), as surveyed."""
    return np.asarray(cameras[:, _ORIGIN]), np.asarray(cameras[:, _PLACE])
