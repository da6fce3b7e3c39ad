"""CE90 and LE90 of points, each by itself: from the tile whose core holds it, or from one tile, without any joint covariance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from datetime import date
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from submin import accuracy
from submin.geodesy import geocentric_to_geodetic, local_axes, rotate_covariance
from submin.network.sub_min import covariances_of, locate
from submin.query.planner import Rows, Selection, determined_parts, points_of_tile, ray_counts
from submin.query.tile import tile_state
from submin.storage.dense_reader import DenseReader

if TYPE_CHECKING:
    from submin.storage.network import Network

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointAccuracy:
    """Accuracy of points, tile after tile.

    Attributes
    ----------
    ids : (n,) ids of the points
    geodetic : (n, 3) longitude and latitude in degrees, height in metres above the ellipsoid
    local_covariance : (n, 3, 3) of each point by itself, square metres, in its local axes east, north, up
    ce90, le90 : (n,) metres
    tile : (n,) name of the tile that answers for each point
    rays : (n,) accepted rays of each
    thinned, retired : (n,) points that answers for areas leave out: because one a square is reported, because of their dates
    """

    ids: NDArray[np.str_]
    geodetic: Array
    local_covariance: Array
    ce90: Array
    le90: Array
    tile: NDArray[np.str_]
    rays: NDArray[np.int64]
    thinned: NDArray[np.bool_]
    retired: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: Rows | NDArray[np.bool_]) -> PointAccuracy:
        """The points of these rows."""
        return PointAccuracy(*(getattr(self, field.name)[rows] for field in fields(self)))


def accuracy_of_all(network: Network, day: date) -> PointAccuracy:
    """Every determined point, thinned and retired ones too, as policy ``tile`` has it from the tile whose core holds the point.

    Points whose rays determine no position are left out. Memory is that of one tile's sub-MIN and of its own points.
    """
    if network.dense is not None:
        return accuracy_of_dense(network.dense)
    owned = (points_of_tile(network, tile, core=True) for tile in network.snapshot.tile_numbers())
    return _joined(_of_tile(network, network.cover.owner(found[0].cell.number), found, day) for found in owned if found)


def accuracy_of(network: Network, selections: Sequence[Selection], day: date, tile: int | None = None) -> PointAccuracy:
    """Some points of a factored network, each from the tile whose core holds it, or all from one tile that holds them all."""
    by_tile: dict[int, list[Selection]] = {}
    for selection in selections:
        by_tile.setdefault(network.cover.owner(selection.cell.number) if tile is None else tile, []).append(selection)
    return _joined(_of_tile(network, number, by_tile[number], day) for number in sorted(by_tile))


def accuracy_of_dense(dense: DenseReader, rows: Rows | None = None) -> PointAccuracy:
    """All points of a dense network, or those at some places."""
    ids, none = dense.points.ids, np.zeros(len(dense.points.ids), dtype=np.bool_)
    tile = np.full(len(ids), dense.snapshot.cover.tile_name(0))
    found = PointAccuracy(
        ids, dense.geodetic, dense.local_covariance, dense.ce90(), dense.le90(), tile, dense.observation_counts, none, none
    )  # fmt: skip
    return found if rows is None else found.take(rows)


def _of_tile(network: Network, tile: int, selections: Sequence[Selection], day: date) -> PointAccuracy:
    """Accuracy of some points from one tile that holds them."""
    kept, parts = determined_parts(network, selections)
    if not parts:
        return _joined([])
    images = np.unique(np.concatenate([part.linear.image for part in parts])).astype(np.int32)
    state = tile_state(network, tile, images)
    geodetic = geocentric_to_geodetic(np.concatenate([locate(part, state) for part in parts]), network.cover.ellipsoid)
    local = rotate_covariance(np.concatenate([covariances_of(part, state) for part in parts]), local_axes(geodetic))
    return PointAccuracy(
        ids=np.concatenate([s.cell.point_ids[s.rows] for s in kept]),
        geodetic=geodetic,
        local_covariance=local,
        ce90=accuracy.ce90(local[:, :2, :2]),
        le90=accuracy.le90(local[:, 2, 2]),
        tile=np.full(len(geodetic), network.cover.tile_name(tile)),
        rays=np.concatenate([ray_counts(s.cell)[s.rows] for s in kept]),
        thinned=np.concatenate([~network.left_by_thinning(s.cell)[s.rows] for s in kept]),
        retired=np.concatenate([~network.validity.valid(s.cell.point_ids[s.rows], day) for s in kept]),
    )


def _joined(parts: Iterable[PointAccuracy]) -> PointAccuracy:
    none = PointAccuracy(
        np.empty(0, dtype="U1"), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0), np.empty(0, dtype="U1"),
        np.empty(0, dtype=np.int64), np.empty(0, dtype=np.bool_), np.empty(0, dtype=np.bool_),
    )  # fmt: skip
    every = [none, *parts]
    return PointAccuracy(*(np.concatenate([getattr(part, field.name) for part in every]) for field in fields(none)))
