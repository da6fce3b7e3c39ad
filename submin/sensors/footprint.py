"""Footprints: the outline of what an image sees of the ground, for any sensor."""

from __future__ import annotations

import numpy as np
import shapely

from submin.geodesy import Ellipsoid
from submin.sensors.base import Array, Sensor

_ROUND = np.array([(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.0, 0.5), (1.0, 1.0), (0.5, 1.0), (0.0, 1.0), (0.0, 0.5)])
"""Corners and middles of the edges, as parts of the image."""


def footprints(sensor: Sensor, cameras: Array, first: Array, size: Array, heights: Array, ellipsoid: Ellipsoid) -> list[bytes]:
    """Polygons (WKB, longitude and latitude in degrees) of the outer pixel edges of m images; empty where there is no ground.

    Parameters
    ----------
    cameras : (m, c), packed, all of one sensor
    first : (m, 2), sample and line of each image's first pixel; size : (m, 2), pixels
    heights : (m,), of the ground, metres above the ellipsoid
    """
    edge = first[:, None] - 0.5 + size[:, None] * _ROUND
    image = np.repeat(np.arange(len(cameras), dtype=np.int32), len(_ROUND))
    samples, lines = np.ascontiguousarray(edge[..., 0].ravel()), np.ascontiguousarray(edge[..., 1].ravel())
    ground = sensor.localise(cameras, image, samples, lines, heights[image], ellipsoid)[:, :2].reshape(-1, len(_ROUND), 2)
    # on the antimeridian the longitudes of an outline run on beyond 180
    ground[..., 0] = ground[:, :1, 0] + (ground[..., 0] - ground[:, :1, 0] + 180.0) % 360.0 - 180.0
    reached = np.asarray(np.isfinite(ground).all(axis=(1, 2)))
    polygons = iter(shapely.to_wkb(shapely.polygons(ground[reached])))
    return [next(polygons) if r else b"" for r in reached]
