"""CE90 and LE90 of every point of a network: each from the tile whose core holds it, without any joint covariance."""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import date

import numpy as np
from numpy.typing import NDArray

from submin import accuracy
from submin.geodesy import geocentric_to_geodetic, local_axes, rotate_covariance
from submin.network.sub_min import GroundPart, loadings, locate, point_covariances
from submin.query.planner import Selection, ground_part, ray_counts
from submin.query.tile import tile_state
from submin.storage.network import Network
from submin.storage.schema import determined
from submin.storage.validity import today

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointAccuracy:
    """Accuracy of points, tile after tile.

    Attributes
    ----------
    ids : (n,) ids of the points
    geodetic : (n, 3) longitude and latitude in degrees, height in metres above the ellipsoid
    ce90, le90 : (n,) metres
    tile : (n,) name of the tile whose core holds each point
    rays : (n,) accepted rays of each
    thinned, retired : (n,) points that answers for areas leave out: because one a square is reported, because of their dates
    """

    ids: NDArray[np.str_]
    geodetic: Array
    ce90: Array
    le90: Array
    tile: NDArray[np.str_]
    rays: NDArray[np.int64]
    thinned: NDArray[np.bool_]
    retired: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.ids)


def accuracy_map(network: Network, on: date | None = None) -> PointAccuracy:
    """Position and accuracy of every point that the network reports on a day (default: today, UTC); see `accuracy_of_all`."""
    every = accuracy_of_all(network, on)
    reported = ~every.thinned & ~every.retired
    return every if reported.all() else PointAccuracy(*(getattr(every, field.name)[reported] for field in fields(every)))


def accuracy_of_all(network: Network, on: date | None = None) -> PointAccuracy:
    """Position and accuracy of every determined point, as policy ``tile`` has them from the tile whose core holds the point.

    Points whose rays determine no position are left out. Memory is that of one tile's sub-MIN and of its own points.
    """
    if network.dense is not None:
        dense, tile = network.dense, network.cover.tile_name(0)
        ids, none = dense.points.ids, np.zeros(len(dense.points.ids), dtype=np.bool_)
        tiles = np.full(len(ids), tile)
        return PointAccuracy(ids, dense.geodetic, dense.ce90(), dense.le90(), tiles, dense.observation_counts, none, none)
    day = today() if on is None else on
    return _joined([_of_tile(network, tile, day) for tile in network.snapshot.tile_numbers()])


def _of_tile(network: Network, tile: int, day: date) -> PointAccuracy:
    """Accuracy of the points in a tile's own core."""
    existing = set(network.cell_numbers())
    kept: list[Selection] = []
    parts: list[GroundPart] = []
    for number in network.cover.cells_owned(tile):
        if number in existing:
            cell = network.cell(number)
            selection, part = ground_part(network, Selection(cell, np.flatnonzero(determined(cell))))
            if len(selection.rows):
                kept.append(selection)
                parts.append(part)
    if not parts:
        return _joined([])
    images = np.unique(np.concatenate([part.linear.image for part in parts])).astype(np.int32)
    state = tile_state(network, tile, images)
    geodetic = geocentric_to_geodetic(np.concatenate([locate(part, state) for part in parts]), network.cover.ellipsoid)
    own = np.concatenate([part.factors.own for part in parts])
    covariance = point_covariances(loadings(parts, state.images, state.theta.shape[1]), own, state.covariance)
    local = rotate_covariance(covariance, local_axes(geodetic))
    return PointAccuracy(
        ids=np.concatenate([s.cell.point_ids[s.rows] for s in kept]),
        geodetic=geodetic,
        ce90=accuracy.ce90(local[:, :2, :2]),
        le90=accuracy.le90(local[:, 2, 2]),
        tile=np.full(len(geodetic), network.cover.tile_name(tile)),
        rays=np.concatenate([ray_counts(s.cell)[s.rows] for s in kept]),
        thinned=np.concatenate([~network.left_by_thinning(s.cell)[s.rows] for s in kept]),
        retired=np.concatenate([~network.validity.valid(s.cell.point_ids[s.rows], day) for s in kept]),
    )


def _joined(parts: list[PointAccuracy]) -> PointAccuracy:
    none = PointAccuracy(
        np.empty(0, dtype="U1"), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0, dtype="U1"), np.empty(0, dtype=np.int64),
        np.empty(0, dtype=np.bool_), np.empty(0, dtype=np.bool_),
    )  # fmt: skip
    return PointAccuracy(*(np.concatenate([getattr(part, field.name) for part in (none, *parts)]) for field in fields(none)))
