"""Footprints of images: as areas on the globe, how wide they are, and which tiles they meet.

The corners of a footprint are places on the ground; its edges, as seen from a satellite, are nearly straight there, and not in longitude
and latitude. So whatever is measured or compared is done in a plane, corner by corner, wherever on the globe it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.geodesy import Ellipsoid, geocentric_to_geodetic, geodetic_to_geocentric, local_axes
from submin.tiling.area import polygons_of
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Shapes = NDArray[np.object_]

EMPTY = shapely.Polygon()
BEYOND = 1e9
"""Metres: farther than any place of an equal-area plane."""


def corners(footprints: Shapes) -> tuple[Array, Rows]:
    """Longitude and latitude (c, 2) of the corners of all footprints, and the footprint (c,) of each."""
    at, of = shapely.get_coordinates(footprints, return_index=True)
    return np.asarray(at), np.asarray(of)


def middles(footprints: Shapes) -> Array:
    """Longitude and latitude (n, 2), degrees, of the mean of the corners of each footprint, which holds a pole or is cut wherever it is."""
    at, of = corners(footprints)
    lon, lat = np.radians(at).T
    unit = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    mean = np.stack([np.bincount(of, weights=column, minlength=len(footprints)) for column in unit.T], axis=1)
    lonlat = np.column_stack([np.arctan2(mean[:, 1], mean[:, 0]), np.arctan2(mean[:, 2], np.hypot(mean[:, 0], mean[:, 1]))])
    return np.asarray(np.degrees(lonlat))


def footprint_widths(footprints: Shapes, ellipsoid: Ellipsoid) -> Array:
    """Shorter side (n,), metres, of the smallest rectangle in any direction around each footprint, on the ground in its middle."""
    at, of = corners(footprints)
    ground = geodetic_to_geocentric(np.column_stack([at, np.zeros(len(at))]), ellipsoid)
    count = np.bincount(of, minlength=len(footprints))
    mean = np.stack([np.bincount(of, weights=column, minlength=len(footprints)) for column in ground.T], axis=1) / count[:, None]
    level = local_axes(geocentric_to_geodetic(mean, ellipsoid))[:, :2]
    flat = np.einsum("cij,cj->ci", level[of], ground - mean[of])
    around = shapely.oriented_envelope(shapely.multipoints(shapely.points(flat), indices=of))
    sides = [np.linalg.norm(np.diff(shapely.get_coordinates(shape)[:3], axis=0), axis=1) for shape in around]
    return np.array([side.min() if len(side) > 1 else 0.0 for side in sides])


def on_globe(footprint: BaseGeometry) -> BaseGeometry:
    """A footprint as an area in longitude and latitude, whose outline may run on beyond 180 degrees, jump there, or go around a pole."""
    return shapely.union_all([_region(part) for part in shapely.get_parts(footprint) if part.geom_type == "Polygon"])


def _region(polygon: BaseGeometry) -> BaseGeometry:
    at = shapely.get_coordinates(shapely.get_exterior_ring(polygon))
    lon, lat = at.T
    steps = (np.diff(lon) + 180.0) % 360.0 - 180.0
    lon = lon[0] + np.concatenate([[0.0], np.cumsum(steps)])
    turn = lon[-1] - lon[0]
    if abs(turn) > 180.0:  # once around: the area lies between its outline and the pole
        lon -= 360.0 * np.ceil(lon.min() / 360.0)  # begins west of Greenwich and ends east of it
        pole = 90.0 if lat.mean() > 0.0 else -90.0
        lon, lat = np.concatenate([lon, lon[[-1, 0]]]), np.concatenate([lat, [pole, pole]])
    else:
        lon -= 360.0 * np.round(0.5 * (lon.min() + lon.max()) / 360.0)
    shape = shapely.polygons(np.column_stack([lon, lat]))
    return shape if shape.is_valid else polygons_of(shapely.make_valid(shape))


def in_plane(footprints: Shapes, cover: Cover) -> Shapes:
    """Footprints in the plane of a cover, metres; empty ones, and those that reach the place opposite its middle, are empty."""
    flat = shapely.transform(footprints, lambda at: np.column_stack(cover.plane(at[:, 0], at[:, 1])))
    at, of = corners(flat)
    flat[np.unique(of[~np.isfinite(at).all(axis=1)])] = EMPTY
    broken = ~shapely.is_valid(flat)
    flat[broken] = [polygons_of(shape) for shape in shapely.make_valid(flat[broken])]
    return np.asarray(flat, dtype=np.object_)


@dataclass(frozen=True, eq=False)
class FootprintIndex:
    """Spatial index of footprints in the plane of a cover: which of them each tile meets."""

    tree: shapely.STRtree

    @classmethod
    def of(cls, footprints: Shapes, cover: Cover) -> FootprintIndex:
        """Index of footprints in longitude and latitude; one that is not known (None) meets every tile."""
        unknown = shapely.is_missing(footprints)
        flat = in_plane(np.where(unknown, EMPTY, footprints), cover)
        flat[unknown] = shapely.box(-BEYOND, -BEYOND, BEYOND, BEYOND)
        return cls(shapely.STRtree(flat))

    def met_by(self, tiles: Rows, cover: Cover) -> tuple[Rows, Rows]:
        """Pairs (p,) of tile and footprint that meet, by tile and then footprint; tiles on the rim reach to infinity, as their cores do."""
        if not len(tiles):
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        bounds = np.clip(np.array([cover.tile_bounds(tile) for tile in tiles.tolist()]), -BEYOND, BEYOND)
        tile, footprint = self.tree.query(shapely.box(*bounds.T), predicate="intersects")
        order = np.lexsort((footprint, tiles[tile]))
        return tiles[tile][order], footprint[order]

    def all_met(self, cover: Cover) -> tuple[Rows, Rows]:
        """Pairs of tile and footprint that meet, over all tiles of the grid, those outside the area too."""
        return self.met_by(np.fromiter(cover.leaves(), dtype=np.int64), cover)
