"""A height model as a sensor: what it "sees" of a ground point is its height above the ellipsoid, in metres.

One view serves all points, and has nothing to adjust. A height is an observation along one axis: the second image coordinate is always
zero, does not depend on the point, and observes nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from submin.errors import InputError
from submin.geodesy import Ellipsoid
from submin.sensors.base import Array, Ground, Index, Parameter, Projection


class HeightSensor:
    """A view of the heights of points. The camera is a mapping with ``height``, metres, near which they are expected."""

    name = "height"
    unit = "metre"
    parameters: tuple[Parameter, ...] = ()

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        """See `Sensor.pack`."""
        try:
            expected = float(camera["height"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"height: {error}; expected a number for height") from None
        if not np.isfinite(expected):
            raise InputError(f"height: height is {expected}; expected a finite number of metres")
        return np.array([expected])

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """See `Sensor.project`."""
        along, up = np.zeros((len(image), 2)), np.zeros((len(image), 2, 3))
        along[:, 0], up[:, 0] = ground.geodetic[point, 2], ground.jacobian[point, 2]
        return Projection(along, up, np.zeros((len(image), 2, 0)))

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """NaN: a height alone is no place."""
        return np.full((len(image), 3), np.nan)

    def mean_height(self, cameras: Array) -> Array:
        """See `Sensor.mean_height`."""
        return np.asarray(cameras[:, 0])
