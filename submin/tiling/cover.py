"""Cover of an area by overlapping tiles, and the cells that their outlines cut.

The area is laid out in metres in a Lambert azimuthal equal-area frame about its middle. *Cores* of one size tile the whole plane: those
on the rim of the grid reach to infinity, so every position has exactly one owner. A core that has to hold too much is split into four
(decision 008). A tile is its core, widened on each side by half the overlap. The outlines cut the plane into *cells*: all positions with
the same owner and the same set of tiles that hold them. Among cores of one size, with an overlap below their side, a core has nine: its
interior, four edges, four corners (docs/mathematics.md, "Cells").

Tiles are named ``r003c007`` (row from the south, column from the west), quarters of a split core ``r003c007q0`` to ``q3`` (south-west,
south-east, north-west, north-east), their quarters ``r003c007q02``. A cell is named by the tiles that hold it, its owner first:
``r003c007+r003c008``.

The area itself may be any polygon. Cores tile all of its bounding rectangle, but only tiles whose outline meets the area are counted as
tiles of the cover; the others come to be when a position outside the area falls to them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
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
MAX_LEVEL = 12
"""A core may be halved so often: to a four-thousandth of its side."""
ZONES = 5
"""Strips of a core along one axis, between its sides, half an overlap inside them, and half an overlap around its middle, where smaller
neighbours meet: no outline of another tile crosses a zone."""

_TILE_NAME = re.compile(r"r(\d{3,})c(\d{3,})(?:q([0-3]+))?")


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
    splits : tiles that were split into four, ascending; a tile that is listed here is none any more
    area : the area in the plane, metres, as WKB; empty when it is the rectangle of the cores

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
    splits: tuple[int, ...] = ()
    area: bytes = b""

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
        """Code (n,) of the cell of each position: its owner, and the zone of the owner's core. Outside the area the nearest core owns."""
        east, north = self.plane(longitude, latitude)
        owner, west, south, side = self._leaves_at(east, north)
        zone = ZONES * self._strip(north - south, side) + self._strip(east - west, side)
        codes, inverse = np.unique(ZONES**2 * owner + zone, return_inverse=True)
        cells = [ZONES**2 * tile + self._zones(tile)[0][at] for tile, at in (divmod(int(code), ZONES**2) for code in codes)]
        return np.array(cells, dtype=np.int64)[inverse]

    def _strip(self, into: Array, side: Array) -> Codes:
        """Zone along one axis at a distance into cores of this side."""
        return np.asarray((into >= np.stack(self._lines(side))).sum(axis=0), dtype=np.int64)

    def _lines(self, side: Array | float) -> tuple[Array, Array, Array, Array]:
        """Where the strips of cores of this side end, but the last. Half-size neighbours need quarters as wide as the overlap."""
        half = np.full(np.shape(side), 0.5 * self.overlap)
        can_meet = 0.5 * np.asarray(side) >= self.overlap
        return half, np.where(can_meet, 0.5 * side - half, half), np.where(can_meet, 0.5 * side + half, half), side - half

    def _leaves_at(self, east: Array, north: Array) -> tuple[Codes, Array, Array, Array]:
        """Tile whose core holds each position (n,) of the plane, with the core's western and southern border and its side."""
        row = np.clip(np.floor((north - self.origin[1]) / self.core), 0, self.rows - 1).astype(np.int64)
        column = np.clip(np.floor((east - self.origin[0]) / self.core), 0, self.columns - 1).astype(np.int64)
        tile, side = row * self.columns + column, np.full(row.shape, self.core, dtype=np.float64)
        west = np.asarray(self.origin[0] + column * self.core, dtype=np.float64)
        south = np.asarray(self.origin[1] + row * self.core, dtype=np.float64)
        inside = np.flatnonzero(np.isin(tile, self.splits))
        while len(inside):
            side[inside] *= 0.5
            right, up = east[inside] >= west[inside] + side[inside], north[inside] >= south[inside] + side[inside]
            west[inside] += right * side[inside]
            south[inside] += up * side[inside]
            tile[inside] = self._base + 4 * tile[inside] + 2 * up + right
            inside = inside[np.isin(tile[inside], self.splits)]
        return tile, west, south, side

    @property
    def _base(self) -> int:
        return self.rows * self.columns

    @cached_property
    def _zone_memory(self) -> dict[int, tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]]:
        return {}

    def _zones(self, tile: int) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
        """For each zone of a core, the first zone with the same holders (they are one cell), and the holders, ascending.

        Cores are at least as wide as the overlap. So a tile holds a position when its core holds one of the corners of the square of
        half an overlap around it.
        """
        if tile not in self._zone_memory:
            level, row, column = self._address(tile)
            side, half = self.core / 2**level, 0.5 * self.overlap
            lines = np.array([0.0, *self._lines(side), side], dtype=np.float64)
            middle = 0.5 * (lines[:-1] + lines[1:])
            y, x = np.meshgrid(self.origin[1] + row * side + middle, self.origin[0] + column * side + middle, indexing="ij")
            corners = [self._leaves_at((x + dx).ravel(), (y + dy).ravel())[0] for dx in (-half, half) for dy in (-half, half)]
            holders = tuple(tuple(sorted(set(at))) for at in zip(*(c.tolist() for c in corners), strict=True))
            # a strip without width is no place, but what lies beyond the rim falls into the first or the last: its neighbour stands for it
            wide = [k for k in range(ZONES) if lines[k + 1] > lines[k]]
            stand = [min(wide, key=lambda w, k=k: abs(w - k)) for k in range(ZONES)]  # type: ignore[misc]
            first: dict[tuple[int, ...], int] = {}
            for z in (ZONES * i + j for i in wide for j in wide):
                first.setdefault(holders[z], z)
            of_zone = tuple(first[holders[ZONES * stand[i] + stand[j]]] for i in range(ZONES) for j in range(ZONES))
            self._zone_memory[tile] = of_zone, holders
        return self._zone_memory[tile]

    def outside(self, longitude: Array, latitude: Array) -> NDArray[np.bool_]:
        """True (n,) for positions outside the cores of all tiles of the cover; the nearest core owns them."""
        east, north = self.plane(longitude, latitude)
        x, y = (east - self.origin[0]) / self.core, (north - self.origin[1]) / self.core
        beyond = np.asarray((x < 0) | (y < 0) | (x >= self.columns) | (y >= self.rows))
        if self.area:
            owners, of = np.unique(self._leaves_at(east, north)[0], return_inverse=True)
            beyond |= ~self.meets_area(owners)[of]
        return beyond

    def outside_area(self, longitude: Array, latitude: Array) -> NDArray[np.bool_]:
        """True (n,) for positions outside the area itself."""
        if not self.area:
            return self.outside(longitude, latitude)
        return np.asarray(~shapely.intersects_xy(self._shape, *self.plane(longitude, latitude)))

    @cached_property
    def _shape(self) -> BaseGeometry:
        shape = shapely.from_wkb(self.area)
        shapely.prepare(shape)
        return shape

    def meets_area(self, tiles: Codes) -> NDArray[np.bool_]:
        """True (n,) for tiles of the cover: their outline meets the area."""
        if not self.area or not len(tiles):
            return np.ones(len(tiles), dtype=np.bool_)
        level, row, column = np.array([self._address(tile) for tile in tiles.tolist()]).T
        side, half = self.core / 2.0**level, 0.5 * self.overlap
        west, south = self.origin[0] + column * side, self.origin[1] + row * side
        outlines = shapely.box(west - half, south - half, west + side + half, south + side + half)
        return np.asarray(shapely.intersects(self._shape, outlines))

    def holders(self, cell: int) -> tuple[int, ...]:
        """Tiles that hold a cell, ascending; the cell's owner among them."""
        tile, zone = divmod(int(cell), ZONES**2)
        return self._zones(tile)[1][zone]

    def cells_held(self, tile: int) -> tuple[int, ...]:
        """Cells that a tile holds: its own and its neighbours' shared with it, ascending."""
        tile = int(tile)
        held = [c for t in (tile, *self.neighbours(tile)) for c in self.cells_owned(t) if tile in self.holders(c)]
        return tuple(sorted(held))

    def cells_owned(self, tile: int) -> tuple[int, ...]:
        """Cells of a tile's core, ascending."""
        return tuple(ZONES**2 * int(tile) + zone for zone in sorted(set(self._zones(int(tile))[0])))

    def neighbours(self, tile: int) -> tuple[int, ...]:
        """Tiles that share a cell with a tile, ascending."""
        tile = int(tile)
        return tuple(sorted({t for cell in self.cells_owned(tile) for t in self.holders(cell)} - {tile}))

    @staticmethod
    def owner(cell: int) -> int:
        """The tile whose core holds a cell."""
        return int(cell) // ZONES**2

    def _address(self, tile: int) -> tuple[int, int, int]:
        """Level (0: never split), row and column of a core on the grid of its size."""
        if tile < self._base:
            return (0, *divmod(tile, self.columns))
        parent, quarter = divmod(tile - self._base, 4)
        level, row, column = self._address(parent)
        return level + 1, 2 * row + quarter // 2, 2 * column + quarter % 2

    def side(self, tile: int) -> float:
        """Side of a tile's core, metres."""
        return float(self.core / 2 ** self._address(int(tile))[0])

    def _is_tile(self, tile: int) -> bool:
        whole = tile
        while whole >= self._base:
            whole = (whole - self._base) // 4
            if whole not in self.splits:
                return False
        return whole >= 0 and tile not in self.splits

    def can_split(self, tile: int) -> bool:
        """True when the quarters of a core are still as wide as the overlap."""
        level = self._address(int(tile))[0]
        return level < MAX_LEVEL and self.core / 2 ** (level + 1) >= self.overlap

    def split(self, tile: int) -> Cover:
        """The cover with a tile's core cut into four; larger neighbours are cut first, so that neighbours differ by one halving at most.

        Raises
        ------
        InputError
            When the tile is none of the cover, or its quarters would be narrower than the overlap.
        """
        tile, cover = int(tile), self
        if not self._is_tile(tile):
            raise InputError(f"tile is {tile}, which is none of the cover; expected one of its {self.tile_count} tiles")
        if not self.can_split(tile):
            raise InputError(f"tile {self.tile_name(tile)} cannot be split: its quarters would be narrower than the overlap, or too many")
        level = self._address(tile)[0]
        while larger := [t for t in cover.neighbours(tile) if cover._address(t)[0] < level]:
            cover = cover.split(larger[0])
        return replace(cover, splits=tuple(sorted({*cover.splits, tile})))

    def quarters(self, tile: int) -> tuple[int, int, int, int]:
        """Tiles into which a tile was or would be split: south-west, south-east, north-west, north-east."""
        first = self._base + 4 * int(tile)
        return first, first + 1, first + 2, first + 3

    def tile_name(self, tile: int) -> str:
        """Name of a tile."""
        if tile >= self._base:
            parent, quarter = divmod(int(tile) - self._base, 4)
            name = self.tile_name(parent)
            return f"{name}{quarter}" if "q" in name else f"{name}q{quarter}"
        row, column = divmod(int(tile), self.columns)
        return f"r{row:03d}c{column:03d}"

    def tile_number(self, name: str) -> int:
        """Tile of a name; raises `InputError` when there is none."""
        match = _TILE_NAME.fullmatch(name)
        if match and int(match[1]) < self.rows and int(match[2]) < self.columns:
            tile, quarters = int(match[1]) * self.columns + int(match[2]), match[3] or ""
            for quarter in quarters:
                if tile not in self.splits:
                    break
                tile = self.quarters(tile)[int(quarter)]
            if tile in self.splits:
                parts = ", ".join(self.tile_name(t) for t in self.quarters(tile))
                raise InputError(f"tile is {name!r}, which was split; expected one of its parts {parts}")
            if self.tile_name(tile) == name:
                return tile
        raise InputError(
            f"tile is {name!r}; expected a name from r000c000 to r{self.rows - 1:03d}c{self.columns - 1:03d}, or of a part of a split one"
        )

    def cell_name(self, cell: int) -> str:
        """Name of a cell: the tiles that hold it, its owner first."""
        owner = self.owner(cell)
        return "+".join(self.tile_name(t) for t in (owner, *(t for t in self.holders(cell) if t != owner)))

    def cell_number(self, name: str) -> int:
        """Cell of a name; raises `InputError` when there is none."""
        first = name.split("+")[0]
        if first not in self._cell_memory:
            self._cell_memory[first] = {self.cell_name(cell): cell for cell in self.cells_owned(self.tile_number(first))}
        if name not in self._cell_memory[first]:
            raise InputError(f"cell is {name!r}; expected one of {', '.join(self._cell_memory[first])}")
        return self._cell_memory[first][name]

    @cached_property
    def _cell_memory(self) -> dict[str, dict[str, int]]:
        return {}

    def depth(self, tile: int, longitude: Array, latitude: Array) -> Array:
        """Distance (n,) in metres from positions to the tile's outline, positive inside; rim sides are infinitely far."""
        west, south, east, north = self.tile_bounds(tile)
        x, y = self.plane(longitude, latitude)
        return np.asarray(np.minimum.reduce([x - west, east - x, y - south, north - y]))

    def _bounds(self, tile: int, widen: float, *, open_rim: bool = False) -> tuple[float, float, float, float]:
        level, row, column = self._address(int(tile))
        side = self.core / 2**level
        west, south = self.origin[0] + column * side, self.origin[1] + row * side
        bounds = [west - widen, south - widen, west + side + widen, south + side + widen]
        if open_rim:
            last_row, last_column = self.rows * 2**level - 1, self.columns * 2**level - 1
            for k, rim in enumerate((column == 0, row == 0, column == last_column, row == last_row)):
                if rim:
                    bounds[k] = -np.inf if k < 2 else np.inf
        return bounds[0], bounds[1], bounds[2], bounds[3]

    def core_bounds(self, tile: int) -> tuple[float, float, float, float]:
        """West, south, east, north of a core in the plane, metres; cores on the rim reach to infinity."""
        return self._bounds(tile, 0.0, open_rim=True)

    def tile_bounds(self, tile: int) -> tuple[float, float, float, float]:
        """West, south, east, north of a tile in the plane, metres; tiles on the rim reach to infinity."""
        return self._bounds(tile, 0.5 * self.overlap, open_rim=True)

    def cell_bounds(self, cell: int) -> tuple[float, float, float, float]:
        """West, south, east, north of the box around a cell in the plane, metres; cells on the rim reach to infinity."""
        tile, zone = divmod(int(cell), ZONES**2)
        first = np.array(self._zones(tile)[0]).reshape(ZONES, ZONES) == zone
        rows, columns = np.flatnonzero(first.any(axis=1)), np.flatnonzero(first.any(axis=0))
        west, south, east, north = self.core_bounds(tile)
        x, y, _, _ = self._bounds(tile, 0.0)
        into = [0.0, *map(float, self._lines(self.side(tile)))]
        # the first and the last strip end where the core does, which may be nowhere
        return (
            west if columns[0] == 0 else x + into[columns[0]],
            south if rows[0] == 0 else y + into[rows[0]],
            east if columns[-1] == ZONES - 1 else x + into[columns[-1] + 1],
            north if rows[-1] == ZONES - 1 else y + into[rows[-1] + 1],
        )

    def tiles_meeting(self, west: float, south: float, east: float, north: float) -> Iterator[int]:
        """Tiles whose core meets a box in the plane, metres."""
        rows = self._range(south, north, self.origin[1], self.rows)
        columns = self._range(west, east, self.origin[0], self.columns)
        for tile in (row * self.columns + column for row in rows for column in columns):
            for leaf in self.leaves_of(tile):
                w, s, e, n = self.core_bounds(leaf)
                if w <= east and e >= west and s <= north and n >= south:
                    yield leaf

    def _range(self, low: float, high: float, origin: float, count: int) -> range:
        """Rows or columns of cores that meet an interval; those on the rim reach to infinity."""
        first, last = np.clip(np.floor((np.array([low, high]) - origin) / self.core), 0, count - 1)
        return range(int(first), int(last) + 1)

    def core_outline(self, tile: int) -> Array:
        """Outline (5, 2) of a core in the plane, metres, closed."""
        return _ring(*self._bounds(tile, 0.0))

    def tile_outline(self, tile: int) -> Array:
        """Outline (5, 2) of a tile in the plane, metres, closed."""
        return _ring(*self._bounds(tile, 0.5 * self.overlap))

    def tiles(self) -> Iterator[int]:
        """Tiles whose outline meets the area, those of one core together."""
        return iter(self._of_area.tolist()) if self.area else self.leaves()

    def leaves(self) -> Iterator[int]:
        """Tiles of all cores, those whose outline does not meet the area too."""
        return (leaf for tile in range(self._base) for leaf in self.leaves_of(tile))

    def leaves_of(self, tile: int) -> Iterator[int]:
        """The tile, or the tiles into which it was split."""
        if tile not in self._split:
            yield tile
        else:
            for quarter in self.quarters(tile):
                yield from self.leaves_of(quarter)

    @cached_property
    def _split(self) -> frozenset[int]:
        return frozenset(self.splits)

    @cached_property
    def _of_area(self) -> Codes:
        every = np.fromiter(self.leaves(), dtype=np.int64)
        return every[self.meets_area(every)]

    @property
    def tile_count(self) -> int:
        """Number of tiles whose outline meets the area."""
        return len(self._of_area) if self.area else self._base + 3 * len(self.splits)

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
            "splits": list(self.splits),
        } | ({"area": self.area.hex()} if self.area else {})

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Cover:
        """The cover described by `to_mapping`."""
        return cls(
            (values["centre"][0], values["centre"][1]), (values["origin"][0], values["origin"][1]),
            values["rows"], values["columns"], values["core"], values["overlap"],
            Ellipsoid(values["semimajor_axis"], values["flattening"]), tuple(values["splits"]),
            bytes.fromhex(values.get("area", "")),
        )  # fmt: skip


def _ring(west: float, south: float, east: float, north: float) -> Array:
    return np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
