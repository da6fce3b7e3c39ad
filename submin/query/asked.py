"""What a user asks for: the points of a box, an area, a list of ids, or a tile."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.errors import QueryError
from submin.tiling.cover import Cover

Ids = NDArray[np.str_]

NAMED = 5
"""Ids that a message names."""


@dataclass(frozen=True, eq=False)
class Asked:
    """Which points are asked for; without anything all.

    Attributes
    ----------
    area : polygon or polygons, longitude and latitude in degrees
    points : (k,) ids, ascending, each once
    tile : name of a tile: all that it holds, or those of the area or the points that it does
    """

    area: BaseGeometry | None = None
    points: Ids | None = None
    tile: str | None = None

    @classmethod
    def of(
        cls, bbox: tuple[float, float, float, float] | None = None, area: BaseGeometry | None = None,
        points: Sequence[str] | Ids | None = None, tile: str | None = None, *, one: bool = False,
    ) -> Asked:  # fmt: skip
        """What a user gave: one of box, area and points, a tile, or both; with ``one`` never both.

        Raises
        ------
        QueryError
            When nothing or too much is given, or the box is not one.
        """
        given = [name for name, value in (("bbox", bbox), ("area", area), ("points", points), ("tile", tile)) if value is not None]
        if not given or len(given) - (tile is not None and not one) > 1:
            expected = "bbox, area, points, tile" if one else "bbox, area, points, or a tile"
            raise QueryError(f"asked by {' and '.join(given) or 'nothing'}; expected one of {expected}")
        return cls(area if bbox is None else box_area(bbox), None if points is None else np.unique(np.asarray(points, dtype=np.str_)), tile)

    def refuse_swapped(self, cover: Cover) -> None:
        """Raise `QueryError` when the middle of the area is outside a cover, and inside it with longitude and latitude exchanged."""
        if self.area is None or self.area.is_empty:
            return
        middle = shapely.box(*self.area.bounds).centroid
        longitude, latitude = np.array([middle.x]), np.array([middle.y])
        if abs(middle.x) <= 90.0 and cover.outside(longitude, latitude)[0] and not cover.outside(latitude, longitude)[0]:
            raise QueryError(
                "the area queried is outside the network, and inside it with its axes swapped; expected longitude first, then latitude"
            )


def box_area(bbox: tuple[float, float, float, float]) -> BaseGeometry:
    """Area of a box: west, south, east, north in degrees; west above east means across the antimeridian.

    Raises
    ------
    QueryError
        When the numbers are no box on a globe.
    """
    west, south, east, north = bbox
    globe = -90.0 <= south < north <= 90.0 and -180.0 <= west <= 180.0 and -180.0 <= east <= 180.0
    if not (np.isfinite(bbox).all() and globe and west != east):
        swapped = -90.0 <= west < east <= 90.0 and abs(south) > 90.0
        raise QueryError(
            f"bbox is {west:g} {south:g} {east:g} {north:g}; expected west south east north in degrees"
            + ("; longitude and latitude look swapped" if swapped else "")
        )
    if west > east:
        return shapely.union_all([shapely.box(west, south, 180.0, north), shapely.box(-180.0, south, east, north)])
    return shapely.box(west, south, east, north)


def few(ids: Iterable[str]) -> str:
    """The first of some ids, for a message."""
    names = list(ids)
    return ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")
