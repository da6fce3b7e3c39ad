"""What workers do: pure functions of their arguments and of one version of the network, safe to run again after a loss.

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
from submin.adjustment.intersection import blind_image, intersect
from submin.adjustment.rays import Rays, canonical_order
from submin.adjustment.status import Cause, Status
from submin.adjustment.surveyed_points import ContradictedPoint, contradicted_points
from submin.errors import NumericalError, SubminError
from submin.geodesy import Ellipsoid
from submin.network.cell import Cell, RegisteredPoints, bundle, loses, summed, union_of_images, with_points, without_points
from submin.network.innovation import BlockTest
from submin.network.network_image import NetworkImage, image_set
from submin.network.registration import Located, LooseRays, locate
from submin.network.sub_min import SubMin, add_sums, factor
from submin.query.block_innovation import block_test, common_points
from submin.sensors import sensor_named, width_of
from submin.storage.network import Network
from submin.storage.network_store import Snapshot
from submin.storage.schema import write_cell, write_sub_min
from submin.tiling.cover import Cover

LEAST_STATISTIC = 3.0
"""An image found to be bad with less has lost most of its rays instead."""
Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class BlockRays:
    """A block as stage 1 sees it: its images, the ids of its points (ascending), and its rays by point and image."""

    block_id: str
    images: tuple[NetworkImage, ...]
    ids: NDArray[np.str_]
    point: NDArray[np.int32]
    image: NDArray[np.int32]
    observed: Array
    sigma: Array


@dataclass(frozen=True)
class BlockAdjustment:
    """Stage 1 of one block: which rays (in the block's order) are accepted, or why the whole block is not; and its test by the network."""

    block_id: str
    accepted: Flags
    reason: str | None
    test: BlockTest | None = None


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
class Gate:
    """The version of the network by which blocks are tested, and the cell (n,) of each of a block's n points (ids ascending) in it."""

    snapshot: Snapshot
    cells: tuple[NDArray[np.int64], ...]


def adjust_blocks(blocks: Sequence[BlockRays], ellipsoid: Ellipsoid, gate: Gate | None = None) -> list[BlockAdjustment]:
    """Stage 1: adjust each block by itself, free of the network, reject its blunders; a block that fails gets its reason.

    With a gate each block that succeeds is then tested against what the network says of their common points.
    """
    if gate is None:
        return [adjust_block(block, ellipsoid) for block in blocks]
    network = BlockGate(gate)
    return [adjust_block(block, ellipsoid, network, cells) for block, cells in zip(blocks, gate.cells, strict=True)]


def adjust_block(
    block: BlockRays, ellipsoid: Ellipsoid, gate: BlockGate | None = None, cells: NDArray[np.int64] | None = None
) -> BlockAdjustment:
    """Stage 1 of one block, and its test by the network where there is a gate (``cells`` as in `Gate`)."""
    accepted = np.ones(len(block.image), dtype=np.bool_)
    try:
        images = image_set(block.images, ellipsoid, width_of(image.sensor for image in block.images))
        ids, point = block.ids, block.point
        order = canonical_order(point, block.image, block.observed)
        rays = Rays(point[order], block.image[order], block.observed[order], block.sigma[order], accepted)
        start = intersect(images, rays, len(ids))
        lost = np.flatnonzero(~np.isfinite(start).all(axis=1))
        blind = (int(rays.image[np.searchsorted(rays.point, lost[0])]), int(lost[0])) if len(lost) else blind_image(images, rays)
        if blind is not None:
            return BlockAdjustment(block.block_id, accepted, Status(Cause.UNSEEN, False, 0, *blind).message(images.ids, ids))
        if np.bincount(rays.point).max() < 2:
            return BlockAdjustment(block.block_id, accepted, None)
        result = adjust(images, rays, start)
        if result.status.cause not in (Cause.CONVERGED, Cause.FEW_AGREE):  # that few agree is told from the rays, settled or not
            return BlockAdjustment(block.block_id, accepted, result.status.message(images.ids, ids))
        accepted = np.empty(len(accepted), dtype=np.bool_)
        accepted[order] = result.accepted
        test = None if gate is None or cells is None else gate.test(block.images, ids, cells, rays, result, start)
        return BlockAdjustment(block.block_id, accepted, None, test)
    except SubminError as error:
        return BlockAdjustment(block.block_id, accepted, str(error))


class BlockGate:
    """Tests blocks by one version of a network; what several blocks ask for is read once."""

    def __init__(self, gate: Gate) -> None:
        self._snapshot = gate.snapshot
        self._cells = np.unique(np.concatenate(gate.cells))
        self._networks: dict[int, Network] = {}
        self._passes: NDArray[np.str_] | None = None
        self._tile_images: dict[int, NDArray[np.int32]] = {}
        self._latest: tuple[tuple[int, int], SubMin] | None = None

    def _sub_min(self, parameters: int, tile: int) -> SubMin:
        """A tile's sub-MIN; the latest one is kept, since neighbouring blocks ask for the same."""
        if self._latest is None or self._latest[0] != (parameters, tile):
            self._latest = None  # never two in memory
            self._latest = (parameters, tile), self._network(parameters).sub_min(tile, None)
        return self._latest[1]

    def _network(self, parameters: int) -> Network:
        """The network with so many parameters an image; the images of all cells that are asked for are read at once."""
        if parameters not in self._networks:
            base = self._snapshot
            network = Network.over(Snapshot(base.root, base.place, base.cover, parameters))
            network.image_set(union_of_images([network.cell(int(number)) for number in self._cells[self._cells >= 0]]))
            self._networks[parameters] = network
        return self._networks[parameters]

    def test(
        self, block: Sequence[NetworkImage], ids: NDArray[np.str_], cells: NDArray[np.int64], rays: Rays, adjusted: Adjustment, start: Array
    ) -> BlockTest | None:
        """Test a block whose stage 1 is done; None where nothing can be compared."""
        if not (cells >= 0).any():
            return None
        base = self._snapshot
        p = max(base.metadata.parameters, width_of(image.sensor for image in block))
        images = image_set(block, base.metadata.ellipsoid, p)
        theta = np.zeros((len(images), p))
        theta[:, : adjusted.theta.shape[1]] = adjusted.theta
        try:
            common = common_points(
                self._network(p), ids, cells, images, lambda tile: self._mates(tile, block), lambda tile: self._sub_min(p, tile)
            )
            return None if common is None else block_test(common, images, ids, rays, replace(adjusted, theta=theta), start)
        except NumericalError:  # what cannot be computed is no reason against the block
            return None

    def _mates(self, tile: int, block: Sequence[NetworkImage]) -> NDArray[np.int32]:
        """Rows of the tile's images that share a pass with an image of a block."""
        if self._passes is None:
            self._passes = self._snapshot.image_columns(["pass_id"])["pass_id"]
        if tile not in self._tile_images:
            self._tile_images[tile] = self._snapshot.tile_images(tile)
        rows = self._tile_images[tile]
        return rows[np.isin(self._passes[rows], [image.pass_id for image in block])]


def locate_part(rays: LooseRays, known: tuple[ImageSet, NDArray[np.int32], Cover]) -> Located:
    """`locate` with images, their rows and a cover that all parts of the rays share."""
    return locate(rays, *known)


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
        return TileReport(tile, tuple(emptied), emptied, True, False, (), (), True, writes)
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
    return TileReport(tile, tuple(changed), reports, lost, lost_elsewhere, flagged, contradicted, result.converged, writes)


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
    return TileFactored(tile, len(rows), writes)


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
