"""A network to ask for control: the Python face of submin."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.adjustment.elimination import Sums
from submin.adjustment.images import ImageSet
from submin.correlation.compact import AUTO, check_asked, check_size
from submin.errors import QueryError
from submin.network.cell import Cell, widened_sums
from submin.network.network_image import NetworkImage, image_set
from submin.network.sub_min import GroundPart, SubMin
from submin.network.thinning import reported_points
from submin.query.control_set import ControlSet
from submin.query.cross_covariance import cross_covariance
from submin.query.planner import (
    Answer,
    Selection,
    all_points,
    answer,
    determined_parts,
    points_in_area,
    points_named,
    points_of_tile,
    well_spread,
)
from submin.query.point_metadata import PointMetadata, metadata_of_points
from submin.storage.arrays import group_of, read_record
from submin.storage.check_points import check_points
from submin.storage.compact_table import CompactControl, check_suffix, write_compact
from submin.storage.image_facts import image_facts
from submin.storage.network_store import Snapshot
from submin.storage.schema import read_sums_of
from submin.storage.validity import Validity, today
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Index = NDArray[np.int32]
CACHED_CELLS = 64


class Network:
    """One version of a network, read only. It does not change while later versions are written; open it again to see them.

    Examples
    --------
    ``network = submin.open("network"); control = network.query(bbox=(west, south, east, north))``
    """

    def __init__(self, place: str, version: str | None = None, parameters: int = 0) -> None:
        """``parameters``: least number of adjustable parameters to keep for each image, for images that are to be joined to it."""
        self._snapshot = Snapshot.open(place, version, parameters)
        self._cells: OrderedDict[int, Cell] = OrderedDict()
        self._images: dict[int, NetworkImage] = {}
        self._numbers: tuple[int, ...] | None = None

    @property
    def version(self) -> str:
        """Name of the version, such as ``v12``."""
        return self._snapshot.version

    @property
    def snapshot(self) -> Snapshot:
        """The version in the store."""
        return self._snapshot

    def at(self, version: str) -> Network:
        """The same network at another version.

        Raises
        ------
        QueryError
            When there is no such version.
        """
        return Network(self._snapshot.place, version)

    def query(
        self,
        *,
        bbox: tuple[float, float, float, float] | None = None,
        area: BaseGeometry | None = None,
        points: Sequence[str] | NDArray[np.str_] | None = None,
        tile: str | None = None,
        policy: str = "auto",
        max_points: int | None = None,
        on: date | None = None,
    ) -> ControlSet:
        """Control points with their joint covariance.

        Parameters
        ----------
        bbox : west, south, east, north in degrees (west above east: across the antimeridian)
        area : polygon or polygons, longitude and latitude in degrees
        points : ids of points
        tile : name of a tile; alone, all points that it holds
        policy : ``auto``, ``tile``, ``ci``, ``bci``, ``split`` or ``rigorous`` (docs/accuracy.md)
        max_points : at most so many, well spread and well determined
        on : day on which points must be valid; default: today (UTC)

        An area or a tile is answered by the points that the network reports: those that thinning leaves, and that are valid on the day.
        Points that are asked for by their ids are answered whether it reports them or not (docs/points.md).

        Raises
        ------
        QueryError
            When nothing or too much is asked, a policy, tile or point is unknown, a box is not one, or ``max_points`` is below 1.
        """
        selections, number = self._selected(bbox, area, points, tile, max_points, today() if on is None else on)
        return self._control_set(answer(self, selections, policy, number))

    def export(
        self,
        path: str | Path,
        *,
        bbox: tuple[float, float, float, float] | None = None,
        area: BaseGeometry | None = None,
        tile: str | None = None,
        policy: str = "auto",
        max_points: int | None = None,
        family: str = AUTO,
        rank: int = 0,
        floor: float | None = None,
    ) -> CompactControl:
        """Write control points with a compact joint covariance: 3 x 3 blocks and correlation functions (docs/correlation.md).

        Parameters
        ----------
        path : file to write, ``.parquet``
        bbox, area, tile, policy, max_points : which points, as in `query`; without any of the first three all points
        family, rank, floor : as in `ControlSet.compact`

        Returns
        -------
        CompactControl
            What `read_compact` reads from the file.

        Raises
        ------
        QueryError
            As `query` does.
        InputError
            When the family is unknown, there are too few or too many points, rank or floor are out of range, or the file cannot be
            written; nothing is written then.
        """
        check_suffix(path)
        check_asked(family, rank, floor)
        if bbox is None and area is None and tile is None:
            selections, number = self._reported(all_points(self), today()), None
            if max_points is not None:
                selections = well_spread(self, selections, max_points)
        else:
            selections, number = self._selected(bbox, area, None, tile, max_points, today())
        check_size(sum(len(s.rows) for s in selections))  # before a joint covariance of that size is made
        control = self._control_set(answer(self, selections, policy, number))
        return write_compact(path, control, control.compact(family, rank, floor))

    def _selected(
        self, bbox: tuple[float, float, float, float] | None, area: BaseGeometry | None, points: Sequence[str] | NDArray[np.str_] | None,
        tile: str | None, max_points: int | None, on: date,
    ) -> tuple[list[Selection], int | None]:  # fmt: skip
        """Points that are asked for, and the number of the tile that is named."""
        asked = [name for name, value in (("bbox", bbox), ("area", area), ("points", points)) if value is not None]
        if len(asked) > 1 or (not asked and tile is None):
            raise QueryError(f"asked by {' and '.join(asked) or 'nothing'}; expected one of bbox, area, points, or a tile")
        number = None if tile is None else self.cover.tile_number(tile)
        if bbox is not None:
            area = box_area(bbox)
        if area is not None:
            selections = points_in_area(self, area)
            if not selections and _inside_when_swapped(area, self.cover):
                raise QueryError(
                    "the area queried is outside the network, and inside it with its axes swapped; expected longitude first, then latitude"
                )
        elif points is not None:
            ids = np.unique(np.asarray(points, dtype=np.str_))
            selections, missing = points_named(self, ids, self._snapshot.candidate_cells(ids))
            if len(missing):
                raise QueryError(
                    f"{len(missing)} of {len(ids)} points are not in the network or not yet determined by two rays: "
                    f"{', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''}"
                )
        else:
            assert number is not None
            selections = points_of_tile(self, number)
        if number is not None:
            held = set(self.cover.cells_held(number))
            selections = [s for s in selections if s.cell.number in held]
        if points is None:
            selections = self._reported(selections, on)
        if max_points is not None:
            selections = well_spread(self, selections, max_points)
        return selections, number

    def points(
        self,
        *,
        bbox: tuple[float, float, float, float] | None = None,
        area: BaseGeometry | None = None,
        points: Sequence[str] | NDArray[np.str_] | None = None,
        tile: str | None = None,
    ) -> PointMetadata:
        """What is known of points beside their coordinates: pending, thinned and retired ones too. Columns and units: docs/points.md.

        Parameters
        ----------
        bbox, area, points, tile : exactly one of them, as of `query`; a point that its rays do not determine is where it is registered

        Raises
        ------
        QueryError
            When nothing or too much is asked, a tile or point is unknown, or a box is not one.
        """
        asked = [n for n, value in (("bbox", bbox), ("area", area), ("points", points), ("tile", tile)) if value is not None]
        if len(asked) != 1:
            raise QueryError(f"asked by {' and '.join(asked) or 'nothing'}; expected one of bbox, area, points, tile")
        area = area if bbox is None else box_area(bbox)
        if area is not None:
            selections = points_in_area(self, area, every=True)
        elif points is not None:
            selections = self.named(points)
        else:
            assert tile is not None
            selections = points_of_tile(self, self.cover.tile_number(tile), every=True)
        snapshot = self._snapshot
        found = metadata_of_points(self, selections, image_facts(snapshot), check_points(snapshot), snapshot.metadata.thinning)
        if area is not None:
            found = found.take(np.asarray(shapely.intersects_xy(area, found.geodetic[:, 0], found.geodetic[:, 1]), dtype=bool))
        valid_from, valid_to, reason = self.validity.rows_of(found.ids)
        return replace(
            found, valid_from=valid_from, valid_to=valid_to, reason=reason, epoch=snapshot.metadata.epoch, version=self.version
        )  # fmt: skip

    def named(self, points: Sequence[str] | NDArray[np.str_]) -> list[Selection]:
        """Points by their ids, determined or not.

        Raises
        ------
        QueryError
            When the network does not have one of them.
        """
        ids = np.unique(np.asarray(points, dtype=np.str_))
        selections, missing = points_named(self, ids, self._snapshot.candidate_cells(ids), every=True)
        if len(missing):
            shown = f"{', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''}"
            raise QueryError(f"{len(missing)} of {len(ids)} points are not in the network: {shown}; expected ids of its points")
        return selections

    @cached_property
    def validity(self) -> Validity:
        """From when to when points are valid."""
        return Validity.of(self._snapshot)

    def left_by_thinning(self, cell: Cell) -> NDArray[np.bool_]:
        """True (n,) for the points of a cell that thinning leaves in answers for areas and tiles."""
        return reported_points(cell, self.cover, self._snapshot.metadata.thinning)

    def _reported(self, selections: Sequence[Selection], on: date) -> list[Selection]:
        """Those of some points that are not thinned, and valid on a day."""
        if not self._snapshot.metadata.thinning and not len(self.validity):
            return list(selections)
        kept = []
        for s in selections:
            reported = self.left_by_thinning(s.cell) & self.validity.valid(s.cell.point_ids, on)
            kept.append(Selection(s.cell, s.rows[reported[s.rows]]))
        return [s for s in kept if len(s.rows)]

    def cells_of_points(self, points: Sequence[str] | NDArray[np.str_]) -> dict[int, NDArray[np.str_]]:
        """Those of some points that the network can answer for, by their cell."""
        ids = np.unique(np.asarray(points, dtype=np.str_))
        selections, _ = points_named(self, ids, self._snapshot.candidate_cells(ids))
        return {s.cell.number: s.cell.point_ids[s.rows] for s in selections}

    def cross_covariance(
        self, one: str, other: str, ids_one: Sequence[str] | NDArray[np.str_], ids_other: Sequence[str] | NDArray[np.str_]
    ) -> Array:
        """Covariance of the answers of two tiles, each by itself.

        Parameters
        ----------
        one, other : names of the tiles
        ids_one, ids_other : n points that the one holds, and k that the other does, in any order; points of both overlap

        Returns
        -------
        (3n, 3k), geocentric square metres, in the order of the ids: ``Cov(x of one, x of other)``.

        Raises
        ------
        QueryError
            When a tile does not hold a point, or a point is not determined.
        """
        tiles = self.cover.tile_number(one), self.cover.tile_number(other)
        found = [self._parts_of_tile(tile, np.asarray(ids, dtype=np.str_)) for tile, ids in zip(tiles, (ids_one, ids_other), strict=True)]
        (names, parts, places), (names_other, parts_other, places_other) = found
        whole = cross_covariance(self, tiles, (names, names_other), (parts, parts_other))
        axes = np.arange(3)
        return np.asarray(whole[np.ix_((3 * places[:, None] + axes).ravel(), (3 * places_other[:, None] + axes).ravel())])

    def _parts_of_tile(self, tile: int, ids: NDArray[np.str_]) -> tuple[NDArray[np.str_], list[GroundPart], NDArray[np.int64]]:
        """Ground parts of named points that a tile holds, the names in their order, and the place of each id asked for."""
        unique = np.unique(ids)
        cells = self._snapshot.candidate_cells(unique)
        selections, missing = points_named(self, unique, np.where(np.isin(cells, self.cover.cells_held(tile)), cells, -1))
        kept, parts = determined_parts(self, selections)
        names = np.concatenate([np.empty(0, dtype="U1"), *(s.cell.point_ids[s.rows] for s in kept)])
        missing = np.unique(np.concatenate([missing, np.setdiff1d(unique, names)]))
        if len(missing):
            raise QueryError(
                f"tile {self.cover.tile_name(tile)} does not hold {len(missing)} of {len(unique)} points, or they are not yet determined: "
                f"{', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''}"
            )
        order = np.argsort(names)
        return names, parts, order[np.searchsorted(names[order], ids)]

    def tile(self, name: str) -> TileView:
        """One sub-MIN alone."""
        return TileView(self, self.cover.tile_number(name))

    @property
    def cover(self) -> Cover:
        """Tiles and cells."""
        return self._snapshot.cover

    def cell_numbers(self) -> tuple[int, ...]:
        """Cells that hold points, ascending."""
        if self._numbers is None:
            self._numbers = self._snapshot.cell_numbers()
        return self._numbers

    def cell(self, number: int) -> Cell:
        """A cell without its sums; the latest used ones are kept in memory."""
        if number not in self._cells:
            self._cells[number] = self._snapshot.cell(number, with_sums=False)
            if len(self._cells) > CACHED_CELLS:
                self._cells.popitem(last=False)
        self._cells.move_to_end(number)
        return self._cells[number]

    def cell_sums(self, number: int) -> tuple[Index, Sums]:
        """A cell's images and sums."""
        group = group_of(self._snapshot.root, "cells/" + self.cover.cell_name(number))
        parts = read_record(group, ["images", "vector", "information"])
        images = parts["images"].astype(np.int32)
        return images, widened_sums(read_sums_of(group, parts), len(images), self._snapshot.metadata.parameters)

    def sub_min(self, tile: int, images: Index | None) -> SubMin:
        """A tile's sub-MIN, or its marginal on some images."""
        if tile not in self._snapshot.tile_numbers():
            raise QueryError(f"tile {self.cover.tile_name(tile)} holds nothing yet; see 'submin info'")
        return self._snapshot.sub_min(tile, images)

    def image_set(self, rows: Sequence[int] | Index) -> ImageSet:
        """Images of these rows; every image is read once."""
        unread = [int(row) for row in rows if int(row) not in self._images]
        self._images.update(zip(unread, self._snapshot.images(unread), strict=True))
        return image_set([self._images[int(row)] for row in rows], self._snapshot.metadata.ellipsoid, self._snapshot.metadata.parameters)

    def _control_set(self, found: Answer) -> ControlSet:
        metadata, cover = self._snapshot.metadata, self.cover
        blocks = self._snapshot.image_columns(["block_id"])["block_id"] if len(found.images) else np.empty(0, dtype="U1")
        return ControlSet(
            ids=found.ids,
            geocentric=found.geocentric,
            covariance=found.covariance,
            ellipsoid=metadata.ellipsoid,
            frame=metadata.frame,
            epoch=metadata.epoch,
            policy=found.policy,
            tiles=tuple(cover.tile_name(t) for t in found.tiles),
            tile_of_point=np.array([cover.tile_name(t) for t in found.owner], dtype=np.str_),
            rays=found.rays,
            version=self.version,
            blocks=tuple(np.unique(blocks[found.images]).tolist()) if len(found.images) else (),
            scope="network" if found.network_wide else "tiles",
            validity=self.validity.intervals(found.ids),
        )


class TileView:
    """One sub-MIN of a network, by itself."""

    def __init__(self, network: Network, number: int) -> None:
        self._network, self._number = network, number

    @property
    def name(self) -> str:
        """Name of the tile."""
        return self._network.cover.tile_name(self._number)

    def query(self, ids: Sequence[str] | None = None) -> ControlSet:
        """Control points of this sub-MIN alone: those named, or all that it holds."""
        return self._network.query(points=ids, tile=self.name, policy="tile")

    def covariance(self, ids: Sequence[str]) -> Array:
        """Joint covariance (3n, 3n) of points, geocentric square metres, in the order of their ids ascending, from this sub-MIN alone."""
        return self.query(ids).covariance


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


def _inside_when_swapped(area: BaseGeometry, cover: Cover) -> bool:
    """True when the middle of an area is outside the cover, and inside it with longitude and latitude exchanged."""
    middle = shapely.box(*area.bounds).centroid
    longitude, latitude = np.array([middle.x]), np.array([middle.y])
    if area.is_empty or abs(middle.x) > 90.0:
        return False
    return bool(cover.outside(longitude, latitude)[0] and not cover.outside(latitude, longitude)[0])


def open_network(path: str | Path, version: str | None = None) -> Network:
    """Open a network, read only: its newest version, or the one named.

    Raises
    ------
    StoreError
        When there is no network at the path or URL.
    QueryError
        When there is no such version.
    """
    return Network(str(path), version)
