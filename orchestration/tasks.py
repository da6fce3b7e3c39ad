"""What workers do in stage 2: pure functions of their arguments and of one version of the network, safe to run again after a loss.

They live in an importable module, so that Dask sends their names and not their code.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import icechunk
import numpy as np
import zarr
from numpy.typing import NDArray

from submin.adjustment.adjustment import Adjustment, adjust
from submin.adjustment.images import ImageSet
from submin.adjustment.surveyed_points import ContradictedPoint, contradicted_points
from submin.geodesy import Ellipsoid
from submin.network.cell import Cell, RegisteredPoints, bundle, loses, summed, union_of_images, with_points, without_points
from submin.network.network_image import NetworkImage, image_set
from submin.network.registration import Located, LooseRays, locate
from submin.network.sub_min import add_sums, factor
from submin.sensors import sensor_named, width_of
from submin.storage.commit import unread
from submin.storage.schema import write_cell, write_sub_min
from submin.storage.snapshot import Snapshot
from submin.tiling.cover import Cover

LEAST_STATISTIC = 3.0
"""An image found to be bad with less has lost most of its rays instead."""


@dataclass(frozen=True)
class FlaggedImage:
    """An image whose camera was found to be bad."""

    row: int
    image_id: str
    reason: str


@dataclass(frozen=True)
class CellReport:
    """Counts of a cell after a batch: rejected rays by image row."""

    images: NDArray[np.int32]
    rejected: NDArray[np.int64]

    @classmethod
    def empty(cls) -> CellReport:
        """Of a cell without rays."""
        none = np.empty(0, dtype=np.int64)
        return cls(none.astype(np.int32), none)


@dataclass(frozen=True)
class TileReport:
    """What a tile's update has found; its cells are in ``writes``, so that no sums wait in memory for their factorisation.

    Attributes
    ----------
    changed : own cells that are summed anew; cells : counts of all own cells
    lost : True when a ray that gave information in an own cell does not any more; lost_elsewhere : so did one of a point that came from
        another cell
    """

    tile: int
    changed: tuple[int, ...]
    cells: dict[int, CellReport]
    lost: bool
    lost_elsewhere: bool
    flagged: tuple[FlaggedImage, ...]
    contradicted: tuple[ContradictedPoint, ...]
    converged: bool
    writes: icechunk.ForkSession


@dataclass(frozen=True)
class TileFactored:
    """A tile's sub-MIN has been written; without images there is none any more."""

    tile: int
    images: int
    writes: icechunk.ForkSession


@dataclass(frozen=True)
class Cameras:
    """Images (m,) by which points are registered, and their rows (m,) of the network, ascending; ``parameters`` are kept for each."""

    images: Sequence[NetworkImage]
    rows: NDArray[np.int32]
    ellipsoid: Ellipsoid
    parameters: int

    def seeing(self, rays: LooseRays) -> tuple[ImageSet, NDArray[np.int32]]:
        """Those that some rays have, and their rows."""
        seen = np.flatnonzero(np.bincount(np.searchsorted(self.rows, rays.image), minlength=len(self.rows)))
        return image_set([self.images[k] for k in seen.tolist()], self.ellipsoid, self.parameters), self.rows[seen]


def locate_part(rays: LooseRays, known: tuple[Cameras, Cover]) -> Located:
    """`locate` with cameras and a cover that all parts of the rays share."""
    cameras, cover = known
    return locate(rays, *cameras.seeing(rays), cover)


def update_tile(
    writes: icechunk.ForkSession,
    tile: int,
    cover: Cover,
    arrivals: Mapping[int, RegisteredPoints],
    departures: Mapping[int, NDArray[np.str_]],
    origins: Mapping[int, Sequence[int]],
    new_images: Sequence[NetworkImage],
) -> TileReport:
    """Judge the rays that a tile holds, and sum its own cells.

    All rays that the tile holds are adjusted together (they include the neighbours' rays in shared cells); the tile decides only for the
    points of its own core. What comes out depends on the rays alone: every ray and image is judged afresh, also one rejected or released
    on less evidence, from the registered positions, images in the order of their ids (decision 006).

    ``origins`` are other cells from which points arrive, by the own cell to which they go.
    """
    writes = unread(writes)  # what a task was given stays in memory as long as what it gives
    root = zarr.open_group(writes.store, mode="r+")
    snapshot = Snapshot(root, "network", cover, width_of(image.sensor for image in new_images))
    numbers = cover.cells_held(tile)
    held, before = [], dict(zip(numbers, snapshot.cells(numbers, with_sums=False), strict=True))
    for number, cell in before.items():
        if number in departures:
            cell = without_points(cell, departures[number])
        if number in arrivals:
            cell = with_points(cell, arrivals[number])
        if len(cell) or number in departures:
            held.append(cell)
    seen = union_of_images(held)
    if not len(seen):  # the last ray has gone
        emptied = {cell.number: CellReport.empty() for cell in held if Cover.owner(cell.number) == tile}
        return TileReport(tile, tuple(emptied), emptied, True, False, (), (), True, unread(writes))
    members = sorted(zip(_images(snapshot, seen, new_images), seen.tolist(), strict=True), key=lambda member: member[0].image_id)
    rows = np.array([row for _, row in members], dtype=np.int32)
    images = image_set(
        [replace(image, released=False) for image, _ in members], snapshot.metadata.ellipsoid, snapshot.metadata.parameters
    )  # fmt: skip
    together = bundle(held, rows)
    result = adjust(images, together.rays, together.origin)
    accepted = np.empty(len(together.row), dtype=np.bool_)
    accepted[together.row] = result.accepted
    squares = np.zeros(len(together.row))
    squares[together.row] = np.nansum((result.residuals * together.rays.sigma) ** 2, axis=1) * images.in_pixels[together.rays.image]
    in_pixels = np.zeros(len(together.row), dtype=np.bool_)
    in_pixels[together.row] = images.in_pixels[together.rays.image]

    changed: list[int] = []
    reports: dict[int, CellReport] = {}
    lost = lost_elsewhere = False
    ray_at = np.cumsum([0, *(len(cell.rays) for cell in held)])
    point_at = np.cumsum([0, *(len(cell) for cell in held)])
    place = np.argsort(rows)
    for k, cell in enumerate(held):
        if Cover.owner(cell.number) != tile:
            continue
        own_rays, own_points = slice(ray_at[k], ray_at[k + 1]), slice(point_at[k], point_at[k + 1])
        own_images = place[np.searchsorted(rows, cell.images, sorter=place)]
        judged = replace(
            cell, rays=cell.rays.with_accepted(accepted[own_rays]), theta=result.theta[own_images], linearised_at=result.ground[own_points]
        )  # fmt: skip
        if cell.number in arrivals or cell.number in departures or not _same_state(judged, cell):
            new = summed(judged, images.take(own_images))
            if len(new):
                counted = int((in_pixels[own_rays] & accepted[own_rays]).sum())
                write_cell(root, cover.cell_name(cell.number), new, float(squares[own_rays].sum()), counted)
            changed.append(cell.number)
        reports[cell.number] = _report(judged)
        lost |= loses(before[cell.number], judged)
        lost_elsewhere |= any(loses(snapshot.cell(origin, with_sums=False), judged) for origin in origins.get(cell.number, ()))
    own = np.concatenate([np.full(len(cell), Cover.owner(cell.number) == tile) for cell in held])
    contradicted = contradicted_points(images, together.rays, result, np.concatenate([cell.point_ids for cell in held]), own)
    flagged = _flagged(result, images, rows)
    return TileReport(tile, tuple(changed), reports, lost, lost_elsewhere, flagged, contradicted, result.converged, unread(writes))


def _same_state(one: Cell, other: Cell) -> bool:
    """True when two states of a cell's rays are decided and linearised alike."""
    return (
        np.array_equal(one.rays.accepted, other.rays.accepted)
        and np.array_equal(one.theta, other.theta)
        and np.array_equal(one.linearised_at, other.linearised_at)
    )


def factor_tile(
    reads: icechunk.ForkSession,
    writes: icechunk.ForkSession,
    tile: int,
    cover: Cover,
    updates: Sequence[icechunk.ForkSession],
    emptied: Collection[int],
    new_images: Sequence[NetworkImage],
    released: Collection[int],
) -> TileFactored:
    """One factorisation: the tile's sub-MIN from the sums of all cells that it holds.

    Parameters
    ----------
    reads : fork in which ``updates``, those of tiles that own any of these cells, come together; nothing is written to it
    emptied : cells that have lost all points, which the store does not show yet
    released : rows of all images in the network whose prior is released
    """
    reads, writes = unread(reads), unread(writes)
    reads.merge(*updates)
    snapshot = Snapshot(zarr.open_group(reads.store, mode="r"), "network", cover, width_of(image.sensor for image in new_images))
    held = [number for number in cover.cells_held(tile) if number not in emptied]
    found = {number: part for number, part in zip(held, snapshot.some_sums(held), strict=True) if len(part[0])}
    if not found:
        return TileFactored(tile, 0, writes)
    rows = np.unique(np.concatenate([part[0] for part in found.values()])).astype(np.int32)
    gone = set(released)
    images = [replace(image, released=int(row) in gone) for row, image in zip(rows, _images(snapshot, rows, new_images), strict=True)]
    sub_min = factor(
        add_sums(list(found.values()), rows, snapshot.metadata.parameters),
        rows,
        image_set(images, snapshot.metadata.ellipsoid, snapshot.metadata.parameters),
    )
    write_sub_min(zarr.open_group(writes.store, mode="r+"), cover.tile_name(tile), sub_min, list(found))
    return TileFactored(tile, len(rows), unread(writes))


def _images(snapshot: Snapshot, rows: NDArray[np.int32], new: Sequence[NetworkImage]) -> list[NetworkImage]:
    """Images of these rows (ascending): those in the store, then those of the batch."""
    base = snapshot.image_count()
    known = rows[rows < base]
    return [*snapshot.images(known), *(new[int(row) - base] for row in rows[rows >= base])]


def _report(cell: Cell) -> CellReport:
    rays, m = cell.rays, len(cell.images)
    return CellReport(cell.images, np.bincount(rays.image[~rays.accepted], minlength=m))


def _flagged(result: Adjustment, images: ImageSet, rows: NDArray[np.int32]) -> tuple[FlaggedImage, ...]:
    flagged = []
    for k in np.flatnonzero(result.released):
        model, parameters = images.priors[k].a_priori, sensor_named(images.sensors[k]).parameters
        assert model is not None
        sigma = np.array([model.of(parameter).sigma for parameter in parameters])
        adjustable = np.flatnonzero(sigma > 0.0)
        worst = int(adjustable[np.argmax(np.abs(result.theta[k][adjustable]) / sigma[adjustable])])
        name, unit = parameters[worst].name, parameters[worst].unit
        correction = f"{name} of the camera is {_rounded(result.theta[k, worst], sigma[worst])} {unit}"
        found = result.image_statistic[k]
        why = f"test statistic {found:.1f}" if found > LEAST_STATISTIC else "most of its rays contradict the camera as it was"
        flagged.append(FlaggedImage(
            int(rows[k]), images.ids[k],
            f"{correction} where its a priori sigma is {sigma[worst]:g} {unit} ({why}); its prior is no longer used",
        ))  # fmt: skip
    return tuple(flagged)


def _rounded(value: float, sigma: float) -> str:
    """A value with one digit beyond the first of its sigma."""
    return f"{value:.{max(0, 1 - int(np.floor(np.log10(sigma))))}f}"
