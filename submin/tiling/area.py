"""The area of a network: any polygons on the globe, and the smallest cover of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from submin.errors import InputError
from submin.geodesy import WGS84, Ellipsoid
from submin.tiling.cover import Cover

MAX_OUTLINE = 10_000
"""Corners of an area's outline that a cover keeps, at most; it travels with the cover, and tiles need no finer one."""
STEP_DEGREES = 0.25
"""An edge that is straight in longitude and latitude bends in the plane: by 30 m from one corner to the next at 70 degrees north."""


def cover_area(area: BaseGeometry, core: float, overlap: float, ellipsoid: Ellipsoid = WGS84) -> Cover:
    """The smallest grid of cores over an area, its middle in the middle.

    The frame is centred on the centroid of the area on the sphere, or on the middle of a box in longitude and latitude that is not
    wider than a right angle and touches no pole. The cover keeps the area unless it is a box that every tile meets.

    Parameters
    ----------
    area : polygon or polygons in longitude and latitude, degrees; across the antimeridian cut there, or with longitudes beyond 180
    core, overlap : metres

    Raises
    ------
    InputError
        When the area is empty, crosses itself, or has coordinates that cannot be longitudes and latitudes; or when it holds the place
        opposite its centroid, or has none.
    """
    if not area.is_valid:
        raise InputError(f"the area is not a valid polygon: {shapely.is_valid_reason(area)}; mend it and try again")
    check_on_globe(area)
    area = _unwrapped(area)
    centre = _centre(area)
    frame = Cover(centre, (0.0, 0.0), 1, 1, core, overlap, ellipsoid)
    west, south, east, north = area.bounds
    fine = shapely.segmentize(area, min(max(0.01 * max(east - west, north - south), 1e-9), STEP_DEGREES))
    outline = shapely.get_coordinates(fine)
    x, y = frame.plane(outline[:, 0], outline[:, 1])
    opposite = centre[0] + 180.0 + np.array([-720.0, -360.0, 0.0, 360.0])
    if not (np.isfinite(x).all() and np.isfinite(y).all()) or shapely.intersects_xy(area, opposite, -centre[1]).any():
        raise InputError(
            "the area reaches to the point opposite its middle, where no equal-area plane reaches; take less than a hemisphere"
        )
    # A touch of tolerance: an area of exactly three cores is three cores, not four.
    columns, rows = (max(int(np.ceil(min(float(np.ptp(v)) / core, 1e12) - 1e-3)), 1) for v in (x, y))
    origin = (0.5 * (x.max() + x.min()) - 0.5 * columns * core, 0.5 * (y.max() + y.min()) - 0.5 * rows * core)
    grid = Cover(centre, origin, rows, columns, core, overlap, ellipsoid)
    shape = _in_plane(fine, grid)
    cover = grid if shape.is_empty else replace(grid, area=shapely.to_wkb(shape))
    return grid if _is_box(area) and cover.tile_count == grid.tile_count else cover


def polygons_of(shape: BaseGeometry) -> BaseGeometry:
    """The polygons of a shape, without its lines and points."""
    parts = shapely.get_parts(shapely.get_parts(shape))  # a collection may hold polygons in parts
    return shapely.multipolygons([part for part in parts if part.geom_type == "Polygon"])


def _is_box(area: BaseGeometry) -> bool:
    return bool(area.equals(shapely.box(*area.bounds)))


def _centre(area: BaseGeometry) -> tuple[float, float]:
    """Longitude and latitude of the middle of an area; raises `InputError` for one that has none, such as the whole globe."""
    west, south, east, north = area.bounds
    if _is_box(area) and east - west <= 90.0 and south > -90.0 and north < 90.0:
        return 0.5 * (west + east), 0.5 * (south + north)
    # twice the integral of the unit normal over an area on the sphere is that of r x dr around it, with the area on the left
    parts = [orient(part) for part in shapely.get_parts(shapely.segmentize(area, STEP_DEGREES))]
    rings = [ring for part in parts for ring in (part.exterior, *part.interiors)]
    total = np.zeros(3)
    for ring in rings:
        lon, lat = np.radians(shapely.get_coordinates(ring)).T
        r = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        total += np.cross(r[:-1], np.diff(r, axis=0)).sum(axis=0)
    if np.linalg.norm(total) < 1e-12:
        raise InputError("the area has no middle on the globe; take less than a hemisphere")
    return float(np.degrees(np.arctan2(total[1], total[0]))), float(np.degrees(np.arctan2(total[2], np.hypot(total[0], total[1]))))


def _in_plane(area: BaseGeometry, cover: Cover) -> BaseGeometry:
    """An area in longitude and latitude, with corners enough, in the plane of a cover: one piece across the antimeridian and the poles."""
    flat = shapely.transform(shapely.get_parts(area), lambda at: np.column_stack(cover.plane(at[:, 0], at[:, 1])))
    # what ends at a pole or at the antimeridian has edges on both sides of one line: snapped to a centimetre, they go
    shape, tolerance = polygons_of(shapely.union_all(shapely.make_valid(flat), grid_size=0.01)), 1e-3 * cover.core
    while shapely.get_num_coordinates(shape) > MAX_OUTLINE:
        # widened first: the simpler area holds all of the finer one
        shape, tolerance = shapely.simplify(shapely.buffer(shape, tolerance, join_style="mitre"), tolerance), 2.0 * tolerance
    return shape


def check_on_globe(area: BaseGeometry) -> None:
    """Raise `InputError` for an area that is empty, or whose coordinates cannot be longitudes and latitudes, in this order."""
    if area.is_empty:
        raise InputError("the area is empty; expected a polygon in longitude and latitude")
    west, south, east, north = area.bounds
    if not (-90.0 <= south <= north <= 90.0 and -360.0 <= west <= east <= 360.0):
        swapped = -90.0 <= west <= east <= 90.0
        raise InputError(
            f"the area spans longitudes {west:g} to {east:g} and latitudes {south:g} to {north:g}, which is not on a globe"
            + ("; its axes look swapped: expected longitude first, then latitude" if swapped else "")
        )


def _unwrapped(area: BaseGeometry) -> BaseGeometry:
    """The area in one piece where it was cut at the antimeridian: its western parts at longitudes beyond 180."""
    parts = shapely.get_parts(area)
    west_of_zero = shapely.bounds(parts)[:, 2] <= 0.0
    turned = np.where(west_of_zero, shapely.transform(parts, lambda at: at + np.array([360.0, 0.0])), parts)
    whole = shapely.union_all(turned)
    return whole if whole.bounds[2] - whole.bounds[0] < area.bounds[2] - area.bounds[0] else area
