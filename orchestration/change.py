"""One change of a network: points are taken out of their cells and put back with other rays, tiles follow, and one commit ends it.

Fusing blocks and withdrawing them differ only in the rays that come or go. The coordinator decides and commits; workers compute and
write to forks of its session (docs/architecture.md). A crash anywhere before the commit leaves the last version as it is.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import icechunk
import numpy as np
import zarr
from numpy.typing import NDArray

from orchestration.executors import Executor
from orchestration.progress import Reporter
from orchestration.tasks import Cameras, CellReport, FlaggedImage, TileReport, factor_tile, locate_part, update_tile
from submin.adjustment.surveyed_points import ContradictedPoint
from submin.network.id_numbers import numbered
from submin.network.network_image import NetworkImage
from submin.network.registration import (
    LooseRays,
    Registration,
    arranged,
    by_points,
    contradictions,
    joined,
    register,
    taken_out,
    together,
)
from submin.sensors import width_of
from submin.storage.arrays import append_table, group_of, hash_ids, replace_table, set_rows
from submin.storage.catalogue_schema import ImageRecord
from submin.storage.commit import commit
from submin.storage.ledger import Entry, append_entries
from submin.storage.ray_totals import summed_cells
from submin.storage.reconciled import EVERYWHERE, TILE_STATES, Changes, note_changes
from submin.storage.schema import image_columns, write_joint
from submin.storage.snapshot import Snapshot
from submin.tiling.cover import Cover

Ids = NDArray[np.str_]
Index = NDArray[np.int32]

RAYS_A_TASK = 100_000
"""Rays whose points one task registers."""


@dataclass(frozen=True)
class TakenOut:
    """Points that leave their cells, to be put back with the rays that they then have.

    Attributes
    ----------
    rays : all rays that they keep; lost : number of those that they do not
    departures : ids of the points by cell
    dissolved : names of cells that vanish with all their points, because a tile that held them was split
    bereft : tiles that held such a cell and are still there
    """

    rays: LooseRays
    departures: dict[int, Ids]
    lost: int = 0
    dissolved: frozenset[str] = frozenset()
    bereft: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Relocations:
    """Where points come from and go that were taken out of their cells.

    Attributes
    ----------
    left : (n,) the cell that each of them has left; goes : (n,) the one to which it goes, -1 where it goes nowhere
    before : (k,) the cell that each point of a registration's directory has left, -1 for those that were not taken out of one
    """

    left: NDArray[np.int64]
    goes: NDArray[np.int64]
    before: NDArray[np.int64]

    @classmethod
    def of(cls, out: TakenOut, registration: Registration) -> Relocations:
        """Those of some points by where they were registered."""
        ids, at = registration.directory
        left = np.repeat(np.array(list(out.departures), dtype=np.int64), [len(of_cell) for of_cell in out.departures.values()])
        if not len(left):
            return cls(left, left, np.full(len(ids), -1, dtype=np.int64))
        known, number = numbered(np.concatenate([ids, *out.departures.values()]))
        arriving, leaving = number[: len(ids)], number[len(ids) :]
        to, come_from = np.full(len(known), -1, dtype=np.int64), np.full(len(known), -1, dtype=np.int64)
        to[arriving], come_from[leaving] = at, left
        return cls(left, to[leaving], come_from[arriving])


@dataclass(frozen=True)
class Move:
    """Where every touched point goes.

    Attributes
    ----------
    cover : tiles of the new version; parameters : adjustable parameters that it keeps for each image
    out : points taken out; registration : where they and the arriving ones go, rays of these first
    contradictions : blocks that measure a point elsewhere than what came before them, see `registration.contradictions`
    images : images that are new with this change, in the order of their rows
    """

    cover: Cover
    parameters: int
    out: TakenOut
    registration: Registration
    contradictions: dict[int, tuple[str, float]]
    images: tuple[NetworkImage, ...]

    @cached_property
    def relocations(self) -> Relocations:
        """Where the points come from and go that were taken out."""
        return Relocations.of(self.out, self.registration)


@dataclass(frozen=True)
class Settled:
    """What the tiles made of a move.

    Attributes
    ----------
    reports : of the judged tiles
    changes : what becomes of the states that tiles were reconciled to
    flags : pairs of tile and image row: the tile finds the image's camera bad
    gone : cells and tiles to be deleted, because nothing is left of them
    rejected : rays (m,) by image row, in the cells that were judged
    """

    reports: tuple[TileReport, ...]
    changes: Changes
    flags: frozenset[tuple[int, int]]
    gone: tuple[str, ...]
    rejected: NDArray[np.int64]

    @property
    def contradicted(self) -> dict[int, tuple[ContradictedPoint, ...]]:
        """Surveyed points by the judged tile that finds that they contradict it."""
        return {report.tile: report.contradicted for report in self.reports}

    @property
    def flagged(self) -> tuple[FlaggedImage, ...]:
        """Images whose camera a judged tile finds bad."""
        return tuple(image for report in self.reports for image in report.flagged)


def take_points(base: Snapshot, ids: Ids, known: NDArray[np.int64]) -> TakenOut:
    """Take those of some points that the network has out of their cells, which the directory knows (-1: none)."""
    rays, departures = [], {}
    for number in np.unique(known[known >= 0]).tolist():
        cell = base.cell(number, with_sums=False)
        chosen = np.isin(cell.point_ids, ids[known == number])
        if chosen.any():
            rays.append(taken_out(cell, chosen))
            departures[number] = cell.point_ids[chosen]
    return TakenOut(together(rays), departures)


def take_points_seen(base: Snapshot, images: Index) -> TakenOut:
    """Take all points that some images (rows) see out of their cells, and leave the rays of these images away."""
    seeing = [tile for tile in base.tile_numbers() if np.isin(images, base.tile_images(tile)).any()]
    rays, departures = [], {}
    for number in sorted({cell for tile in seeing for cell in base.cover.cells_owned(tile)} & set(base.cell_numbers())):
        cell = base.cell(number, with_sums=False)
        seen = np.zeros(len(cell), dtype=np.bool_)
        seen[cell.rays.point[np.isin(cell.images[cell.rays.image], images)]] = True
        if seen.any():
            rays.append(taken_out(cell, seen))
            departures[number] = cell.point_ids[seen]
    loose = together(rays)
    stays = ~np.isin(loose.image, images)
    return TakenOut(loose.take(stays), departures, int((~stays).sum()))


def place(base: Snapshot, out: TakenOut, arriving: LooseRays, new_images: Sequence[NetworkImage], executor: Executor) -> Move:
    """Register the points taken out with their remaining and arriving rays; split the tiles that would then hold too many images."""
    cover, stored = base.cover, Stored(base)
    parameters = max(base.metadata.parameters, width_of(image.sensor for image in new_images))
    while True:
        rays = together([arriving, out.rays])
        first = base.image_count()
        old = np.unique(rays.image[rays.image < first]).astype(np.int32)
        rows = np.concatenate([old, np.arange(first, first + len(new_images), dtype=np.int32)])
        cameras = Cameras([*base.images(old), *new_images], rows, base.metadata.ellipsoid, parameters)
        registration = _registered(rays, cameras, cover, executor)
        full = [tile for tile in _touched_tiles(cover, out, registration) if _overfull(stored, cover, parameters, tile, out, registration)]
        if not full:
            doubtful = cameras.seeing(rays.take(registration.doubtful(rays)))
            return Move(cover, parameters, out, registration, contradictions(rays, registration, *doubtful, cover), tuple(new_images))
        for tile in full:
            if tile not in cover.splits:  # not yet, as the larger neighbour of another one
                cover = cover.split(tile)
        out = _dissolve(base, cover, out)


def _registered(rays: LooseRays, cameras: Cameras, cover: Cover, executor: Executor) -> Registration:
    """The points of some rays, a part of them a task: where a point goes depends on its own rays alone."""
    parts = by_points(rays, max(1, len(rays) // RAYS_A_TASK))
    if len(parts) == 1:
        return register(rays, *cameras.seeing(rays), cover)
    known = executor.share((cameras, replace(cover)))  # without what the cover has worked out: it travels
    handles = executor.submit_all(locate_part, [(rays.take(part), known) for part in parts], "register", lambda: None)
    return arranged(rays, joined(executor.results(handles), parts))


def _touched_tiles(cover: Cover, out: TakenOut, registration: Registration) -> list[int]:
    return sorted({*out.bereft, *(tile for cell in {*registration.arrivals, *out.departures} for tile in cover.holders(cell))})


@dataclass(frozen=True)
class Stored:
    """What a version has, listed when first asked for, and once: its cells by name."""

    base: Snapshot

    @cached_property
    def cells(self) -> dict[str, int]:
        """Cells that hold points."""
        return {self.base.cover.cell_name(c): c for c in self.base.cell_numbers()}


def _overfull(stored: Stored, cover: Cover, parameters: int, tile: int, out: TakenOut, registration: Registration) -> bool:
    """True when a tile would hold more image parameters than it may, and can be split."""
    if not cover.can_split(tile):
        return False
    base = stored.base
    limit = base.metadata.max_parameters // parameters
    arriving = {c: registration.arrivals[c].image for c in cover.cells_held(tile) if c in registration.arrivals}
    seen = [np.empty(0, dtype=np.int32), *arriving.values()]
    if base.has_tile(tile):
        at_most = len(np.unique(np.concatenate([*seen, base.tile_images(tile)])))
        if at_most <= limit:
            return False
    for number in cover.cells_held(tile):
        name = cover.cell_name(number)
        if name in stored.cells and name not in out.dissolved:
            cell = base.cell(stored.cells[name], with_sums=False)
            gone = np.isin(cell.point_ids, out.departures.get(number, np.empty(0, dtype="U1")))
            seen.append(cell.images[np.unique(cell.rays.image[~gone[cell.rays.point]])])
    return len(np.unique(np.concatenate(seen))) > limit


def _dissolve(base: Snapshot, cover: Cover, out: TakenOut) -> TakenOut:
    """Take out all points of the cells that are none of a refined cover; they are named by tiles that are split now."""
    split = {*cover.splits} - {*base.cover.splits}
    rays, departures, dissolved, bereft = [], dict(out.departures), set(out.dissolved), set(out.bereft)
    taken = out.rays.ids
    for number in base.cell_numbers():
        name = base.cover.cell_name(number)
        if name not in dissolved and split.intersection(base.cover.holders(number)):
            cell = base.cell(number, with_sums=False)
            gone = np.isin(cell.point_ids, departures.pop(number, np.empty(0, dtype="U1"))) | np.isin(cell.point_ids, taken)
            rays.append(taken_out(cell, ~gone))
            dissolved.add(name)
            bereft.update(base.cover.holders(number))
    return TakenOut(together([out.rays, *rays]), departures, out.lost, frozenset(dissolved), frozenset(bereft - {*cover.splits}))


def settle(session: icechunk.Session, base: Snapshot, move: Move, executor: Executor, reporter: Reporter) -> Settled:
    """Update and factor every tile that a move touches, and write cells and tiles into the session."""
    cover = replace(move.cover, area=b"")  # without the area and what it has worked out so far: it travels with every task
    arrivals, departures = move.registration.arrivals, move.out.departures
    tiles = _touched_tiles(cover, move.out, move.registration)
    shared = executor.share(list(move.images))
    relocated = move.relocations
    origins = _origins(relocated.left, relocated.goes)
    arguments = []
    # the largest first: at the end no worker is left with much to do while others wait
    for tile in sorted(tiles, key=lambda tile: -sum(len(arrivals[c].image) for c in move.cover.cells_held(tile) if c in arrivals)):
        held = move.cover.cells_held(tile)
        arguments.append((
            session.fork(), tile, cover,  # a fork each: a task must see the last version, not what another task writes
            {c: arrivals[c] for c in held if c in arrivals}, {c: departures[c] for c in held if c in departures},
            {c: origins[c] for c in move.cover.cells_owned(tile) if c in origins}, shared,
        ))  # fmt: skip
    handles = executor.submit_all(update_tile, arguments, "update-tile", reporter.stage("summing tiles", len(tiles)))
    reports: list[TileReport] = sorted(executor.results(handles), key=lambda report: report.tile)
    by_tile = {report.tile: report for report in reports}

    before = base.flags()
    split = {*move.cover.splits}
    flags = {(tile, row) for tile, row in before if tile not in by_tile and tile not in split}
    flags |= {(report.tile, image.row) for report in reports for image in report.flagged}
    released = sorted({row for _, row in flags})
    reconsidered = {*released} ^ {row for _, row in before}
    changed = {cell for report in reports for cell in report.changed}
    again = {tile for cell in changed for tile in move.cover.holders(cell)} | _tiles_that_see(base, reconsidered) | move.out.bereft
    emptied = frozenset(c for report in reports for c, cell in report.cells.items() if not len(cell.images))
    to_factor = []
    for tile in sorted(again - split):
        sources = sorted({Cover.owner(c) for c in move.cover.cells_held(tile)} & set(by_tile))
        to_factor.append((
            session.fork(), session.fork(), tile, cover, [by_tile[t].writes for t in sources], emptied, shared, released
        ))  # fmt: skip
    handles = executor.submit_all(factor_tile, to_factor, "factor-tile", reporter.stage("factoring tiles", len(to_factor)))
    factored = executor.results(handles)
    if reports or factored:
        session.merge(*(report.writes for report in reports), *(done.writes for done in factored))
    gone = [f"cells/{move.cover.cell_name(c)}" for c in sorted(emptied)]
    gone += [f"cells/{name}" for name in sorted(move.out.dissolved)]
    no_more = {done.tile for done in factored if not done.images} | (split - {*base.cover.splits})
    gone += [f"{group}/{base.cover.tile_name(tile)}" for tile in sorted(no_more) for group in ("tiles", TILE_STATES)]
    rejected = _rejected_rays((c for r in reports for c in r.cells.values()), base.image_count() + len(move.images))
    changes = _changes(base, move, reports, origins, relocated.left[relocated.goes < 0])
    return Settled(tuple(reports), changes, frozenset(flags), tuple(gone), rejected)


def _origins(before: NDArray[np.int64], after: NDArray[np.int64]) -> dict[int, tuple[int, ...]]:
    """For each cell at which points arrive from other cells that are still there: these cells. Arguments as `Relocations` has them."""
    moved = (after >= 0) & (after != before)
    found: dict[int, tuple[int, ...]] = {}
    for to, origin in np.unique(np.column_stack([after[moved], before[moved]]), axis=0).tolist():
        found[to] = (*found.get(to, ()), origin)
    return found


def _changes(
    base: Snapshot, move: Move, reports: Sequence[TileReport], origins: Mapping[int, Sequence[int]], bereaved: NDArray[np.int64]
) -> Changes:
    """What a move does to reconciled states (decision 014); ``bereaved`` are cells of points that have gone for good.

    A point that moves to a cell which a tile holds, from one that it does not, is in the tile's state already.
    """
    cover = move.cover
    lost = {report.tile for report in reports if report.lost}
    if move.out.dissolved:
        lost |= {base.cover.owner(c) for c in base.cell_numbers() if base.cover.cell_name(c) in move.out.dissolved}
    lost |= {cover.owner(c) for c in np.unique(bereaved).tolist()}
    if any(report.lost_elsewhere for report in reports):
        lost.add(EVERYWHERE)
    stale = {tile for to, cells in origins.items() for c in cells for tile in set(cover.holders(to)) - set(cover.holders(c))}
    return Changes(frozenset(report.tile for report in reports if report.changed), frozenset(lost), frozenset(stale))


def finish(
    session: icechunk.Session, base: Snapshot, move: Move, settled: Settled, records: Sequence[ImageRecord], entries: Sequence[Entry],
    message: str, withdrawn: Sequence[int] = (),
) -> None:  # fmt: skip
    """Write what the coordinator keeps, and commit.

    Parameters
    ----------
    records : catalogue records of the move's new images; entries : new lines of the ledger; withdrawn : rows of images that leave

    Raises
    ------
    ConflictError
        When another coordinator has committed meanwhile; nothing of the change is in the network then.
    """
    root, version = zarr.open_group(session.store, mode="r+"), base.number + 1
    for name in settled.gone:
        if name in root:
            del root[name]
    append_table(group_of(root, "images"), image_columns(move.images, records))
    write_joint(root, move.images)
    set_rows(group_of(root, "images"), "withdrawn", np.array(withdrawn, dtype=np.int64), np.ones(len(withdrawn), dtype=np.uint8))
    _write_flags(root, settled.flags, base.flags())
    note_changes(root, base, version, settled.changes)
    append_entries(group_of(root, "ledger"), entries)
    ids, at = move.registration.directory
    # what is withdrawn is found by a look into cells, so a wrong entry is mended; what comes was found by the directory itself
    entered = base.candidate_cells(ids) if len(withdrawn) else move.relocations.before
    listed = (at >= 0) & (entered != at)
    append_table(group_of(root, "directory"), {"hash": hash_ids(ids[listed]), "cell": at[listed]})
    metadata = replace(base.metadata, cover=move.cover.to_mapping(), parameters=move.parameters)
    if metadata != base.metadata:
        root.attrs.update(metadata.to_attributes())
    touched = {move.cover.cell_name(cell) for report in settled.reports for cell in report.changed}
    touched |= {name.removeprefix("cells/") for name in settled.gone if name.startswith("cells/")}
    totals = base.ray_totals().changed(summed_cells(base.root, touched), summed_cells(root, touched))
    root.attrs.update({"version": version, "rays": asdict(totals) | {"version": version}})
    commit(session, version, message)


def _tiles_that_see(base: Snapshot, rows: Collection[int]) -> set[int]:
    """Tiles of the last version that hold any of these images: their a priori model has changed."""
    old = np.array(sorted(row for row in rows if row < base.image_count()), dtype=np.int32)
    return {tile for tile in base.tile_numbers() if np.isin(old, base.tile_images(tile)).any()} if len(old) else set()


def _rejected_rays(cells: Iterable[CellReport], images: int) -> NDArray[np.int64]:
    rejected = np.zeros(images, dtype=np.int64)
    for cell in cells:
        np.add.at(rejected, cell.images, cell.rejected)
    return rejected


def _write_flags(root: zarr.Group, flags: Collection[tuple[int, int]], before: Collection[tuple[int, int]]) -> None:
    """Write which tile finds which camera bad, and mark the images concerned; images that are new are in the table already."""
    released = {row for _, row in flags}
    reconsidered = np.array(sorted(released ^ {row for _, row in before}), dtype=np.int64)
    set_rows(group_of(root, "images"), "released", reconsidered, np.isin(reconsidered, sorted(released)).astype(np.uint8))
    tile_and_image = np.array(sorted(flags), dtype=np.int64).reshape(-1, 2)
    replace_table(group_of(root, "flags"), {"tile": tile_and_image[:, 0], "image": tile_and_image[:, 1]})
