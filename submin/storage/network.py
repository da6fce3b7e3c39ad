"""A network to ask for control: the Python face of submin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.correlation.compact import AUTO, check_asked, check_size
from submin.errors import QueryError
from submin.network.cell import Cell
from submin.network.thinning import reported_points
from submin.query.asked import Asked, few
from submin.query.control_set import ControlSet
from submin.query.cross_covariance import PointsOfTile, cross_covariance, points_of_one_tile
from submin.query.planner import (
    Answer,
    Selection,
    all_points,
    answer,
    points_in_area,
    points_named,
    points_of_tile,
    well_spread,
)
from submin.query.point_metadata import PointMetadata, metadata_of_points
from submin.storage.accuracy_map import PointAccuracy, accuracy_of, accuracy_of_all, accuracy_of_dense
from submin.storage.check_points import check_points
from submin.storage.compact_table import CompactControl, check_suffix, write_compact
from submin.storage.dense_reader import DenseReader, is_dense, refuse_dense
from submin.storage.image_facts import image_facts
from submin.storage.snapshot import Snapshot
from submin.storage.tile_view import TileView
from submin.storage.validity import Validity, today
from submin.storage.version_reader import VersionReader

Array = NDArray[np.float64]


class Network(VersionReader):
    """One version of a network, read only. It does not change while later versions are written; open it again to see them.

    Examples
    --------
    ``network = submin.open("network"); control = network.query(bbox=(west, south, east, north))``
    """

    def __init__(self, place: str, version: str | None = None, parameters: int = 0) -> None:
        """``parameters``: least number of adjustable parameters to keep for each image, for images that are to be joined to it."""
        self._begin(Snapshot.open(place, version, parameters))

    @classmethod
    def over(cls, snapshot: Snapshot) -> Network:
        """The network of a version that is open already."""
        network = cls.__new__(cls)
        network._begin(snapshot)
        return network

    def _begin(self, snapshot: Snapshot) -> None:
        super().__init__(snapshot)
        self._dense = DenseReader(snapshot) if is_dense(snapshot) else None

    @property
    def dense(self) -> DenseReader | None:
        """What only a dense network has; None for a factored one."""
        return self._dense

    def at(self, version: str, parameters: int = 0) -> Network:
        """The same network at another version; ``parameters`` as for a new one.

        Raises
        ------
        QueryError
            When there is no such version.
        """
        return Network(self.snapshot.place, version, parameters)

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
        asked = Asked.of(bbox, area, points, tile)
        if self._dense is not None:
            return self._query_dense(self._dense, asked, policy, max_points)
        selections, tile_number = self._selected(asked, max_points, today() if on is None else on)
        return self.control_set(answer(self, selections, policy, tile_number))

    def accuracy(
        self,
        *,
        bbox: tuple[float, float, float, float] | None = None,
        area: BaseGeometry | None = None,
        points: Sequence[str] | NDArray[np.str_] | None = None,
        tile: str | None = None,
        on: date | None = None,
    ) -> PointAccuracy:
        """Position and accuracy of points, each by itself: no joint covariance is formed, so the points may be as many as there are.

        Each point is answered for by the tile whose core holds it, or by the tile that is named.

        Parameters
        ----------
        bbox, area, points, tile : which points, as of `query`; without any all that the network reports
        on : day on which points must be valid; default: today (UTC)

        Returns
        -------
        PointAccuracy
            Tile after tile. Points whose rays determine no position are left out.

        Raises
        ------
        QueryError
            When too much is asked, a tile or point is unknown, or a box is not one.
        """
        day = today() if on is None else on
        everything = bbox is None and area is None and points is None and tile is None
        asked = Asked() if everything else Asked.of(bbox, area, points, tile)
        if self._dense is not None:
            return accuracy_of_dense(self._dense, self._dense_rows(self._dense, asked))
        if not everything:
            selections, number = self._selected(asked, None, day)
            return accuracy_of(self, selections, day, number)
        every = accuracy_of_all(self, day)
        reported = ~every.thinned & ~every.retired
        return every if reported.all() else every.take(reported)

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
        asked = Asked() if bbox is None and area is None and tile is None else Asked.of(bbox, area, tile=tile)
        if self._dense is not None:
            control = self._query_dense(self._dense, asked, policy, max_points)
            check_size(len(control))
        else:
            selections, tile_number = self._selected(asked, max_points, today())
            check_size(sum(len(s.rows) for s in selections))  # before a joint covariance of that size is made
            control = self.control_set(answer(self, selections, policy, tile_number))
        return write_compact(path, control, control.compact(family, rank, floor))

    def _selected(self, asked: Asked, max_points: int | None, on: date) -> tuple[list[Selection], int | None]:
        """Points that are asked for, and the number of the tile that is named."""
        number = None if asked.tile is None else self.cover.tile_number(asked.tile)
        if asked.area is not None:
            selections = points_in_area(self, asked.area)
            if not selections:
                asked.refuse_swapped(self.cover)
        elif asked.points is not None:
            selections, missing = points_named(self, asked.points, self.directory.cells_of(asked.points))
            if len(missing):
                raise QueryError(
                    f"{len(missing)} of {len(asked.points)} points are not in the network or not yet determined by two rays: {few(missing)}"
                )
        else:
            selections = all_points(self) if number is None else points_of_tile(self, number)
        if number is not None:
            held = set(self.cover.cells_held(number))
            selections = [s for s in selections if s.cell.number in held]
        if asked.points is None:
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
        refuse_dense(self.snapshot, "metadata of points")
        asked = Asked.of(bbox, area, points, tile, one=True)
        if asked.area is not None:
            selections = points_in_area(self, asked.area, every=True)
        elif asked.points is not None:
            selections = self.named(asked.points)
        else:
            assert asked.tile is not None
            selections = points_of_tile(self, self.cover.tile_number(asked.tile), every=True)
        snapshot = self.snapshot
        found = metadata_of_points(self, selections, image_facts(snapshot), check_points(snapshot), snapshot.metadata.thinning)
        if asked.area is not None:
            found = found.take(np.asarray(shapely.intersects_xy(asked.area, found.geodetic[:, 0], found.geodetic[:, 1]), dtype=bool))
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
        refuse_dense(self.snapshot, "what is known of single points")
        ids = np.unique(np.asarray(points, dtype=np.str_))
        selections, missing = points_named(self, ids, self.directory.cells_of(ids), every=True)
        if len(missing):
            raise QueryError(f"{len(missing)} of {len(ids)} points are not in the network: {few(missing)}; expected ids of its points")
        return selections

    @cached_property
    def validity(self) -> Validity:
        """From when to when points are valid."""
        return Validity.of(self.snapshot)

    def left_by_thinning(self, cell: Cell) -> NDArray[np.bool_]:
        """True (n,) for the points of a cell that thinning leaves in answers for areas and tiles."""
        return reported_points(cell, self.cover, self.snapshot.metadata.thinning)

    def _reported(self, selections: Sequence[Selection], on: date) -> list[Selection]:
        """Those of some points that are not thinned, and valid on a day."""
        if not self.snapshot.metadata.thinning and not len(self.validity):
            return list(selections)
        kept = []
        for s in selections:
            reported = self.left_by_thinning(s.cell) & self.validity.valid(s.cell.point_ids, on)
            kept.append(Selection(s.cell, s.rows[reported[s.rows]]))
        return [s for s in kept if len(s.rows)]

    def _query_dense(self, dense: DenseReader, asked: Asked, policy: str, max_points: int | None) -> ControlSet:
        """Answer of a dense network."""
        return dense.answer(self._dense_rows(dense, asked), policy, max_points)

    def _dense_rows(self, dense: DenseReader, asked: Asked) -> NDArray[np.int64]:
        """Places of the points that are asked of a dense network; its one tile holds every point."""
        if asked.tile is not None:
            self.cover.tile_number(asked.tile)  # an unknown one is refused
        if asked.area is None:
            return np.arange(len(dense.points.ids)) if asked.points is None else dense.named(asked.points)
        rows = dense.in_area(asked.area)
        if not len(rows):
            asked.refuse_swapped(self.cover)
        return rows

    def cells_of_points(self, points: Sequence[str] | NDArray[np.str_]) -> dict[int, NDArray[np.str_]]:
        """Those of some points that the network can answer for, by their cell."""
        ids = np.unique(np.asarray(points, dtype=np.str_))
        if self._dense is not None:
            held = self._dense.held(ids)
            return {0: held} if len(held) else {}
        selections, _ = points_named(self, ids, self.directory.cells_of(ids))
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
        refuse_dense(self.snapshot, "a covariance between tiles")
        first, second = (
            self._points_of_tile(self.cover.tile_number(tile), np.asarray(ids, dtype=np.str_))
            for tile, ids in ((one, ids_one), (other, ids_other))
        )
        return cross_covariance(self, first, second)

    def _points_of_tile(self, tile: int, ids: NDArray[np.str_]) -> PointsOfTile:
        return points_of_one_tile(self, tile, ids, self.directory.cells_of(np.unique(ids)))

    def tile(self, name: str) -> TileView:
        """One sub-MIN alone."""
        return TileView(self, self.cover.tile_number(name))

    def control_set(self, found: Answer) -> ControlSet:
        """An answer as users get it; images behind it that are not in the network have no block there."""
        metadata, cover = self.snapshot.metadata, self.cover
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
            blocks=self.blocks_of(found.images),
            scope="network" if found.network_wide else "tiles",
            validity=self.validity.intervals(found.ids),
        )


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
