"""Cover of an area by overlapping tiles, and the cells that their outlines cut.

The area is laid out in metres in a Lambert azimuthal equal-area frame about its middle. *Cores* of one size tile the whole plane: those
on the rim of
the grid reach to infinity, so every position has exactly one owner. A tile is its core, widened on each side by half the overlap. The
outlines cut the plane into *cells*: all positions with the same owner and the same set of tiles that hold them. With an overlap below the
core's side a core has nine: its interior, four edges, four corners (docs/mathematics.md, "Cells").

Tiles are named ``r003c007`` (row from the south, column from the west), cells ``r003c007-ne``: the owner and the part of its core.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.errors import InputError
from submin.geodesy import WGS84, Ellipsoid

Array = NDArray[np.float64]
Codes = NDArray[np.int64]

MAX_TILES = 1_000_000
PARTS = ("sw", "s", "se", "w", "c", "e", "nw", "n", "ne")
"""Parts of a core, by (north-south, west-east) place: index 3 * i + j with i, j = 0, 1, 2 from the south-west."""

_TILE_NAME = re.compile(r"r(\d{3,})c(\d{3,})")


@dataclass(frozen=True)
class Cover:
    """Overlapping tiles over an area.

    Attributes
    ----------
    centre : longitude and latitude (degrees) of the origin of the equal-area frame
    origin : easting and northing (metres) of the south-west corner of the first core
    rows, columns : number of cores to the north and to the east
    core : side of a core, metres
    overlap : width that two neighbours share, metres, half on each side of the border of their cores
    ellipsoid : of the body

    Raises
    ------
    InputError
        When the overlap is not smaller than the core, a size is not positive, or there would be more than a million tiles.
    """

    centre: tuple[float, float]
    origin: tuple[float, float]
    rows: int
    columns: int
    core: float
    overlap: float
    ellipsoid: Ellipsoid = WGS84

    def __post_init__(self) -> None:
        if not (np.isfinite(self.core) and self.core > 0.0):
            raise InputError(f"the side of a core is {self.core} m; expected a positive length (--tile-km)")
        if not 0.0 <= self.overlap < self.core:
            raise InputError(
                f"the overlap is {self.overlap:g} m; expected 0 or more and less than the core's {self.core:g} m "
                "(--overlap-km below --tile-km)"
            )
        if self.rows < 1 or self.columns < 1:
            raise InputError(f"the area has {self.rows} x {self.columns} tiles; expected at least one")
        if self.rows * self.columns > MAX_TILES:
            raise InputError(
                f"the area would have {self.rows * self.columns:,} tiles; expected at most {MAX_TILES:,}: choose a larger --tile-km"
            )

    @cached_property
    def _frame(self) -> pyproj.Transformer:
        a, b = self.ellipsoid.semimajor_axis, self.ellipsoid.semiminor_axis
        lon, lat = self.centre
        return pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f"+step +proj=laea +lat_0={lat!r} +lon_0={lon!r} +a={a!r} +b={b!r}"
        )

    def plane(self, longitude: Array, latitude: Array) -> tuple[Array, Array]:
        """Easting and northing, metres, of longitudes and latitudes, degrees."""
        east, north = self._frame.transform(longitude, latitude)
        return np.asarray(east, dtype=np.float64), np.asarray(north, dtype=np.float64)

    def geographic(self, easting: Array, northing: Array) -> tuple[Array, Array]:
        """Longitude and latitude, degrees, of eastings and northings, metres."""
        lon, lat = self._frame.transform(easting, northing, direction=pyproj.enums.TransformDirection.INVERSE)
        return np.asarray(lon, dtype=np.float64), np.asarray(lat, dtype=np.float64)

    def cells_of(self, longitude: Array, latitude: Array) -> Codes:
        """Code (n,) of the cell of each position: ``9 * tile + part``. A position outside the area belongs to the nearest core."""
        east, north = self.plane(longitude, latitude)
        row, i = self._place(north - self.origin[1], self.rows)
        column, j = self._place(east - self.origin[0], self.columns)
        return 9 * (row * self.columns + column) + 3 * i + j

    def _place(self, distance: Array, count: int) -> tuple[Codes, Codes]:
        """Core along one axis, and 0, 1, 2 for the part shared with the core before it, with none, with the next."""
        core = np.clip(np.floor(distance / self.core), 0, count - 1).astype(np.int64)
        into, half = distance - core * self.core, 0.5 * self.overlap
        part = np.ones(len(core), dtype=np.int64)
        part[(into < half) & (core > 0)] = 0
        part[(into >= self.core - half) & (core < count - 1)] = 2
        return core, part

    def outside(self, longitude: Array, latitude: Array) -> NDArray[np.bool_]:
        """True (n,) for positions outside the rectangle of the cores."""
        east, north = self.plane(longitude, latitude)
        x, y = (east - self.origin[0]) / self.core, (north - self.origin[1]) / self.core
        return np.asarray((x < 0) | (y < 0) | (x >= self.columns) | (y >= self.rows))

    def holders(self, cell: int) -> tuple[int, ...]:
        """Tiles that hold a cell, ascending; the cell's owner among them."""
        tile, part = divmod(int(cell), 9)
        row, column = divmod(tile, self.columns)
        i, j = divmod(part, 3)
        rows, columns = {row, row + i - 1}, {column, column + j - 1}
        return tuple(sorted(r * self.columns + c for r in rows for c in columns))

    def cells_held(self, tile: int) -> tuple[int, ...]:
        """Cells that a tile holds: its own nine (fewer on the rim) and its neighbours' shared with it, ascending."""
        row, column = divmod(int(tile), self.columns)
        held = set()
        for r in range(max(row - 1, 0), min(row + 2, self.rows)):
            for c in range(max(column - 1, 0), min(column + 2, self.columns)):
                for cell in self.cells_owned(r * self.columns + c):
                    if tile in self.holders(cell):
                        held.add(cell)
        return tuple(sorted(held))

    def cells_owned(self, tile: int) -> tuple[int, ...]:
        """Cells of a tile's core that can hold a point: those whose neighbours exist, and whose overlap is not empty."""
        row, column = divmod(int(tile), self.columns)
        cells = []
        for part in range(9):
            i, j = divmod(part, 3)
            inside = 0 <= row + i - 1 < self.rows and 0 <= column + j - 1 < self.columns
            if inside and (part == 4 or self.overlap > 0.0):
                cells.append(9 * int(tile) + part)
        return tuple(cells)

    @staticmethod
    def owner(cell: int) -> int:
        """The tile whose core holds a cell."""
        return int(cell) // 9

    def tile_name(self, tile: int) -> str:
        """Name of a tile."""
        row, column = divmod(int(tile), self.columns)
        return f"r{row:03d}c{column:03d}"

    def tile_number(self, name: str) -> int:
        """Tile of a name; raises `InputError` when there is none."""
        match = _TILE_NAME.fullmatch(name)
        if match:
            row, column = int(match[1]), int(match[2])
            if row < self.rows and column < self.columns:
                return row * self.columns + column
        raise InputError(
            f"tile is {name!r}; expected a name from r000c000 to {self.tile_name(self.rows * self.columns - 1)}"
        )  # fmt: skip

    def cell_name(self, cell: int) -> str:
        """Name of a cell."""
        return f"{self.tile_name(int(cell) // 9)}-{PARTS[int(cell) % 9]}"

    def cell_number(self, name: str) -> int:
        """Cell of a name."""
        tile, part = name.split("-")
        return 9 * self.tile_number(tile) + PARTS.index(part)

    def depth(self, tile: int, longitude: Array, latitude: Array) -> Array:
        """Distance (n,) in metres from positions to the tile's outline, positive inside; rim sides are infinitely far."""
        west, south, east, north = self._bounds(tile, 0.5 * self.overlap, open_rim=True)
        x, y = self.plane(longitude, latitude)
        return np.asarray(np.minimum.reduce([x - west, east - x, y - south, north - y]))

    def _bounds(self, tile: int, widen: float, *, open_rim: bool = False) -> tuple[float, float, float, float]:
        row, column = divmod(int(tile), self.columns)
        west, south = self.origin[0] + column * self.core, self.origin[1] + row * self.core
        bounds = [west - widen, south - widen, west + self.core + widen, south + self.core + widen]
        if open_rim:
            for k, rim in enumerate((column == 0, row == 0, column == self.columns - 1, row == self.rows - 1)):
                if rim:
                    bounds[k] = -np.inf if k < 2 else np.inf
        return bounds[0], bounds[1], bounds[2], bounds[3]

    def core_bounds(self, tile: int) -> tuple[float, float, float, float]:
        """West, south, east, north of a core in the plane, metres; cores on the rim reach to infinity."""
        return self._bounds(tile, 0.0, open_rim=True)

    def core_outline(self, tile: int) -> Array:
        """Outline (5, 2) of a core in the plane, metres, closed."""
        return _ring(*self._bounds(tile, 0.0))

    def tile_outline(self, tile: int) -> Array:
        """Outline (5, 2) of a tile in the plane, metres, closed."""
        return _ring(*self._bounds(tile, 0.5 * self.overlap))

    def tiles(self) -> Iterator[int]:
        """All tiles."""
        return iter(range(self.rows * self.columns))

    def to_mapping(self) -> dict[str, Any]:
        """Plain values that describe the cover."""
        return {
            "kind": "grid",
            "centre": list(self.centre),
            "origin": list(self.origin),
            "rows": self.rows,
            "columns": self.columns,
            "core": self.core,
            "overlap": self.overlap,
            "semimajor_axis": self.ellipsoid.semimajor_axis,
            "flattening": self.ellipsoid.flattening,
        }

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Cover:
        """The cover described by `to_mapping`."""
        return cls(
            (values["centre"][0], values["centre"][1]), (values["origin"][0], values["origin"][1]),
            values["rows"], values["columns"], values["core"], values["overlap"],
            Ellipsoid(values["semimajor_axis"], values["flattening"]),
        )  # fmt: skip


def _ring(west: float, south: float, east: float, north: float) -> Array:
    return np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])


def cover_area(area: BaseGeometry, core: float, overlap: float, ellipsoid: Ellipsoid = WGS84) -> Cover:
    """The smallest grid of cores over an area, its middle in the middle.

    Parameters
    ----------
    area : polygon or polygons in longitude and latitude, degrees
    core, overlap : metres

    Raises
    ------
    InputError
        When the area is empty, crosses itself, or has coordinates that cannot be longitudes and latitudes.
    """
    if not area.is_valid:
        raise InputError(f"the area is not a valid polygon: {shapely.is_valid_reason(area)}; mend it and try again")
    check_on_globe(area)
    area = _unwrapped(area)
    west, south, east, north = area.bounds
    centre = (0.5 * (west + east), 0.5 * (south + north))
    frame = Cover(centre, (0.0, 0.0), 1, 1, core, overlap, ellipsoid)
    outline = shapely.get_coordinates(shapely.segmentize(area, max(0.01 * max(east - west, north - south), 1e-9)))
    x, y = frame.plane(outline[:, 0], outline[:, 1])
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(
            "the area reaches to the point opposite its middle, where no equal-area plane reaches; take less than a hemisphere"
        )
    # A touch of tolerance: an area of exactly three cores is three cores, not four.
    columns, rows = (max(int(np.ceil(min(float(np.ptp(v)) / core, 1e12) - 1e-3)), 1) for v in (x, y))
    origin = (0.5 * (x.max() + x.min()) - 0.5 * columns * core, 0.5 * (y.max() + y.min()) - 0.5 * rows * core)
    return Cover(centre, origin, rows, columns, core, overlap, ellipsoid)


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
