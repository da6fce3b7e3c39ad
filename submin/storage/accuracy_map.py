"""CE90 and LE90 of points, each by itself: from the tile whose core holds it, or from one tile, without any joint covariance."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields
from datetime import date
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from submin import accuracy
from submin.adjustment.images import ImageSet
from submin.geodesy import Ellipsoid, geocentric_to_geodetic, local_axes, rotate_covariance
from submin.network.sub_min import SubMin, covariances_of, locate
from submin.query.planner import Rows, Selection, ground_parts, points_of_tile, ray_counts
from submin.query.tile import tile_state
from submin.storage.dense_reader import DenseReader

if TYPE_CHECKING:
    from submin.storage.network import Network

Array = NDArray[np.float64]
Index = NDArray[np.int32]

THREADS = min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 8)
"""Tiles that are worked on side by side. As many more wait or are read: each has its images' covariance and its points in memory."""


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

    Points whose rays determine no position are left out. Memory is that of twice `THREADS` tiles: their sub-MINs and own points.
    """
    if network.dense is not None:
        return accuracy_of_dense(network.dense)
    owned = (points_of_tile(network, tile, core=True) for tile in network.snapshot.tile_numbers())
    return _of_tiles(network, ((network.cover.owner(found[0].cell.number), found) for found in owned if found), day)


def accuracy_of(network: Network, selections: Sequence[Selection], day: date, tile: int | None = None) -> PointAccuracy:
    """Some points of a factored network, each from the tile whose core holds it, or all from one tile that holds them all."""
    by_tile: dict[int, list[Selection]] = {}
    for selection in selections:
        by_tile.setdefault(network.cover.owner(selection.cell.number) if tile is None else tile, []).append(selection)
    return _of_tiles(network, sorted(by_tile.items()), day)


def accuracy_of_dense(dense: DenseReader, rows: Rows | None = None) -> PointAccuracy:
    """All points of a dense network, or those at some places."""
    ids, none = dense.points.ids, np.zeros(len(dense.points.ids), dtype=np.bool_)
    tile = np.full(len(ids), dense.snapshot.cover.tile_name(0))
    found = PointAccuracy(
        ids, dense.geodetic, dense.local_covariance, dense.ce90(), dense.le90(), tile, dense.observation_counts, none, none
    )  # fmt: skip
    return found if rows is None else found.take(rows)


@dataclass(frozen=True, eq=False)
class _Asked:
    """Points of one tile, and all that their accuracy follows from.

    Attributes
    ----------
    tile : its name; selections : the points
    rows : (m,) of the images of their cells in the network; images : these
    state : of the images that see the points
    thinned, retired : (n,) of each cell
    """

    tile: str
    selections: Sequence[Selection]
    rows: Index
    images: ImageSet
    state: SubMin
    thinned: Sequence[NDArray[np.bool_]]
    retired: Sequence[NDArray[np.bool_]]


def _read(network: Network, tile: int, selections: Sequence[Selection], day: date) -> _Asked:
    """What the network has of some points that a tile holds."""
    rows = np.unique(np.concatenate([s.cell.images for s in selections])).astype(np.int32)
    images = network.image_set(rows)
    return _Asked(
        network.cover.tile_name(tile), selections, rows, images, tile_state(network, tile, _seeing(selections)),
        [~network.left_by_thinning(s.cell) for s in selections], [~network.validity.valid(s.cell.point_ids, day) for s in selections],
    )  # fmt: skip


def _seeing(selections: Sequence[Selection]) -> Index:
    """Rows of the images with a ray, accepted or not, of any of the points."""
    found = []
    for s in selections:
        chosen = np.zeros(len(s.cell), dtype=np.bool_)
        chosen[s.rows] = True
        seen = np.zeros(len(s.cell.images), dtype=np.bool_)
        seen[s.cell.rays.image[chosen[s.cell.rays.point]]] = True
        found.append(s.cell.images[seen])
    return np.unique(np.concatenate(found)).astype(np.int32)


def _computed(asked: _Asked, ellipsoid: Ellipsoid) -> PointAccuracy:
    """Accuracy of the points that their rays determine. Nothing is read, nor anything used that threads may not share."""
    kept, parts = ground_parts(asked.selections, asked.rows, asked.images)
    if not parts:
        return _joined([])
    geodetic = geocentric_to_geodetic(np.concatenate([locate(part, asked.state) for part in parts]), ellipsoid)
    local = rotate_covariance(np.concatenate([covariances_of(part, asked.state) for part in parts]), local_axes(geodetic))
    place = {s.cell.number: k for k, s in enumerate(asked.selections)}
    return PointAccuracy(
        ids=np.concatenate([s.cell.point_ids[s.rows] for s in kept]),
        geodetic=geodetic,
        local_covariance=local,
        ce90=accuracy.ce90(local[:, :2, :2]),
        le90=accuracy.le90(local[:, 2, 2]),
        tile=np.full(len(geodetic), asked.tile),
        rays=np.concatenate([ray_counts(s.cell)[s.rows] for s in kept]),
        thinned=np.concatenate([asked.thinned[place[s.cell.number]][s.rows] for s in kept]),
        retired=np.concatenate([asked.retired[place[s.cell.number]][s.rows] for s in kept]),
    )


def _of_tiles(network: Network, by_tile: Iterable[tuple[int, Sequence[Selection]]], day: date) -> PointAccuracy:
    """Accuracy of points by tile: this thread reads, others compute; at most twice `THREADS` tiles are in memory."""
    with ThreadPoolExecutor(THREADS, thread_name_prefix="accuracy") as pool:
        waiting: deque[Future[PointAccuracy]] = deque()
        done = []
        for tile, selections in by_tile:
            waiting.append(pool.submit(_computed, _read(network, tile, selections, day), network.cover.ellipsoid))
            if len(waiting) >= 2 * THREADS:
                done.append(waiting.popleft().result())
        return _joined([*done, *(one.result() for one in waiting)])


def _joined(parts: Iterable[PointAccuracy]) -> PointAccuracy:
    none = PointAccuracy(
        np.empty(0, dtype="U1"), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0), np.empty(0, dtype="U1"),
        np.empty(0, dtype=np.int64), np.empty(0, dtype=np.bool_), np.empty(0, dtype=np.bool_),
    )  # fmt: skip
    every = [none, *parts]
    return PointAccuracy(*(np.concatenate([getattr(part, field.name) for part in every]) for field in fields(none)))
