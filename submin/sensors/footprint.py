"""Footprints: the outline of what an image sees of the ground, and the size of its pixels there, for any sensor."""

from __future__ import annotations

import numpy as np
import shapely

from submin.geodesy import Ellipsoid, geodetic_to_geocentric, local_axes
from submin.sensors.base import Array, Ground, Sensor

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


def ground_pixels(sensor: Sensor, cameras: Array, centres: Array, ellipsoid: Ellipsoid) -> Array:
    """Size (m,) in metres of a pixel on level ground in the middle of each image, the smaller of its sides; NaN where it sees no ground.

    Parameters
    ----------
    cameras : (m, c), packed, all of one sensor; centres : (m, 2), sample and line of the middle of each image
    """
    image = np.arange(len(cameras), dtype=np.int32)
    samples, lines = np.ascontiguousarray(centres[:, 0]), np.ascontiguousarray(centres[:, 1])
    geodetic = sensor.localise(cameras, image, samples, lines, sensor.mean_height(cameras), ellipsoid)
    seen = np.isfinite(geodetic).all(axis=1)
    at = geodetic[seen]
    parameters = np.zeros((len(cameras), len(sensor.parameters)))
    rows = np.arange(len(at), dtype=np.int32)
    projection = sensor.project(cameras, parameters, Ground.at(geodetic_to_geocentric(at, ellipsoid), ellipsoid), image[seen], rows)
    per_metre = projection.by_ground @ local_axes(at)[:, :2].transpose(0, 2, 1)
    sizes = np.full(len(cameras), np.nan)
    sizes[seen] = 1.0 / np.linalg.norm(per_metre, ord=2, axis=(1, 2))
    return sizes
