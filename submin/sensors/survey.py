"""Surveyed control as a sensor: what it "sees" of a ground point is its coordinates along two axes, in metres.

A control point is one more observation of a ground point, with no image parameters (docs/mathematics.md, "Sources"). Its three
coordinates, along the principal axes of their covariance and thereby uncorrelated, are two views of two axes each; the second axis of
the second view is zero and observes nothing.
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


class SurveySensor:
    """A view of a surveyed point.

    The camera is a mapping with ``origin`` (3 geocentric coordinates, metres), ``axes`` (two rows of 3, geocentric) and ``place``
    (longitude and latitude in degrees, height in metres).
    """

    name = "survey"
    unit = "metre"
    parameters: tuple[Parameter, ...] = ()

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
        return Projection(along, axes, np.zeros((len(image), 2, 0)))

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """The surveyed place of each view, whatever the height."""
        return np.asarray(cameras[image, _PLACE])

    def mean_height(self, cameras: Array) -> Array:
        """See `Sensor.mean_height`."""
        return np.asarray(cameras[:, _PLACE.stop - 1])
