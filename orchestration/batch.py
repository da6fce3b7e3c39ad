"""One batch of blocks into the network: register, adjust, sum, factor, and one commit.

The coordinator decides and commits; workers compute and write to forks of its session (docs/architecture.md). A crash anywhere before the
commit leaves the last version as it is.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import icechunk
import numpy as np
import zarr
from numpy.typing import NDArray

from orchestration.executors import Executor
from orchestration.progress import Reporter
from orchestration.tasks import (
    BlockRays,
    CellReport,
    FlaggedImage,
    TileReport,
    adjust_blocks,
    factor_tile,
    report_of,
    update_tile,
)
from submin.geodesy import geocentric_to_geodetic
from submin.network.network_image import NetworkImage, image_set
from submin.network.registration import SAME_POINT_METRES, ArrivingRays, Registration, register
from submin.storage.arrays import append_table, group_of, hash_ids, replace_table, set_rows
from submin.storage.catalogue_schema import Block
from submin.storage.network_store import Snapshot, commit, writable_session
from submin.tiling.cover import Cover

BLOCKS_A_TASK = 8
LEAST_AGREEING = 0.5
"""Part of a block's rays that its own adjustment must accept: fewer are no blunders in a good block."""


@dataclass(frozen=True)
class Rejected:
    """A block that was not fused, and why."""

    block_id: str
    reason: str


@dataclass(frozen=True)
class BatchResult:
    """What a batch did.

    Attributes
    ----------
    version : number of the committed version
    fused : ids of the fused blocks; rejected : the others
    flagged : images whose camera the judged tiles find bad
    tiles : that were judged; unsettled : tiles whose judgement did not come to rest (their rays are used as last judged)
    """

    version: int
    fused: tuple[str, ...]
    rejected: tuple[Rejected, ...]
    flagged: tuple[FlaggedImage, ...]
    tiles: tuple[int, ...]
    unsettled: tuple[int, ...]


def fuse_batch(place: str, blocks: Sequence[Block], rejected: Sequence[Rejected], executor: Executor, reporter: Reporter) -> BatchResult:
    """Fuse blocks that the ledger has let through; ``rejected`` blocks of the batch are entered in the ledger in the same commit.

    Raises
    ------
    ConflictError
        When another run has committed meanwhile; nothing of the batch is in the network then.
    """
    session = writable_session(place)
    base = Snapshot(zarr.open_group(session.store, mode="r"), place)
    refused = list(rejected)
    blocks, accepted = _stage_one(blocks, base, executor, reporter, refused)
    first_image = base.image_count()
    blocks, images, registration = _register(blocks, accepted, base, first_image, refused)

    reports: list[TileReport] = []
    flags = base.flags()
    if blocks:
        reports, flags, writes = _fuse(session, base, registration, images, executor, reporter)
        session.merge(*writes)
    elif _already_entered(base, refused):
        return BatchResult(base.number, (), tuple(refused), (), (), ())
    cells = {number: report for tile in reports for number, report in tile.cells.items()}
    version = base.number + 1
    _enter(session, base, version, blocks, refused, images, registration, flags, cells)
    fused = tuple(block.block_id for block in blocks)
    commit(session, version, f"{len(fused)} blocks fused, {len(refused)} rejected")
    return BatchResult(
        version, fused, tuple(refused), tuple(image for report in reports for image in report.flagged),
        tuple(r.tile for r in reports), tuple(r.tile for r in reports if not r.converged),
    )  # fmt: skip


def _already_entered(base: Snapshot, refused: Sequence[Rejected]) -> bool:
    """True when the ledger's last word on each of these blocks is the same rejection: the same command again then writes nothing."""
    ledger = base.ledger(["block_id", "status", "reason"])
    last = {str(b): (str(s), str(r)) for b, s, r in zip(ledger["block_id"], ledger["status"], ledger["reason"], strict=True)}
    return all(last.get(r.block_id) == ("rejected", r.reason) for r in refused)


def _stage_one(
    blocks: Sequence[Block], base: Snapshot, executor: Executor, reporter: Reporter, refused: list[Rejected]
) -> tuple[list[Block], dict[str, NDArray[np.bool_]]]:
    """Adjust each block by itself; the blocks that succeed, and the accepted rays of each."""
    groups = [blocks[k : k + BLOCKS_A_TASK] for k in range(0, len(blocks), BLOCKS_A_TASK)]
    arguments = [([_block_rays(b) for b in group], base.metadata.ellipsoid) for group in groups]
    handles = executor.submit_all(adjust_blocks, arguments, "adjust", reporter.stage("adjusting blocks", len(arguments)))
    outcomes = {outcome.block_id: outcome for group in executor.results(handles) for outcome in group}
    good = []
    for block in blocks:
        reason = outcomes[block.block_id].reason or _disagreement(outcomes[block.block_id].accepted)
        if reason is None:
            good.append(block)
        else:
            refused.append(Rejected(block.block_id, reason))
    return good, {block.block_id: outcomes[block.block_id].accepted for block in good}


def _disagreement(accepted: NDArray[np.bool_]) -> str | None:
    """Why a block whose rays contradict each other stays out: its points would be registered where they are not, against good blocks."""
    if accepted.sum() >= LEAST_AGREEING * len(accepted):
        return None
    return (
        f"only {accepted.sum()} of the block's {len(accepted)} rays agree with each other; "
        "check the order of sample and line, the point ids and the cameras"
    )


def _register(
    blocks: list[Block], accepted: dict[str, NDArray[np.bool_]], base: Snapshot, first_image: int, refused: list[Rejected]
) -> tuple[list[Block], list[NetworkImage], Registration]:
    """Register the rays of the batch; a block that measures a known point elsewhere, or nothing inside the area, is rejected."""
    while True:
        images = [image for block in blocks for image in _network_images(block)]
        rays = _arriving(blocks, accepted, first_image)
        ids = np.unique(rays.point_ids)
        known = base.candidate_cells(ids)
        cells = {int(n): base.cell(int(n), with_sums=False) for n in np.unique(known[known >= 0])}
        old = np.unique(np.concatenate([np.empty(0, dtype=np.int32), *(c.images for c in cells.values())])).astype(np.int32)
        rows = np.concatenate([old, np.arange(first_image, first_image + len(images), dtype=np.int32)])
        registration = register(
            rays, image_set([*base.images(old), *images], base.metadata.ellipsoid, base.metadata.parameters), rows, known, cells, base.cover
        )  # fmt: skip
        bad = _misplaced(blocks, rays, registration, base.cover)
        if not bad:
            return blocks, images, registration
        refused.extend(Rejected(blocks[k].block_id, reason) for k, reason in bad.items())
        blocks = [block for k, block in enumerate(blocks) if k not in bad]


def _misplaced(blocks: Sequence[Block], rays: ArrivingRays, registration: Registration, cover: Cover) -> dict[int, str]:
    """Blocks of the batch that cannot be registered, with the reason."""
    bad: dict[int, str] = {}
    inside = np.bincount(rays.block[~registration.outside], minlength=len(blocks))
    for empty in np.flatnonzero(inside == 0):
        bad[int(empty)] = (
            "the block lies wholly outside the area of the network; longitude and latitude look swapped, in the area or in its cameras"
            if _inside_when_swapped(rays.point_ids[rays.block == empty], registration, cover)
            else "the block lies wholly outside the area of the network; create a network whose area holds it"
        )
    far = np.flatnonzero(registration.misfit > SAME_POINT_METRES)
    if len(far):
        # two rays of one id that disagree: the later block is in error
        worst = far[np.argmax(rays.block[far])]
        k = int(rays.block[worst])
        bad.setdefault(
            k,
            f"point {rays.point_ids[worst]} is measured {registration.misfit[worst] / 1000.0:.1f} km from where other rays place it; "
            "one id must be one place: use other point ids (imports prefix them unless --shared-ids)",
        )
    return bad


def _inside_when_swapped(ids: NDArray[np.str_], registration: Registration, cover: Cover) -> bool:
    """True when most of some points outside the area would be inside it, were their longitudes latitudes."""
    origin = np.concatenate([np.empty((0, 3)), *(a.origin[np.isin(a.point_ids, ids)] for a in registration.arrivals.values())])
    geodetic = geocentric_to_geodetic(origin, cover.ellipsoid)
    possible = np.abs(geodetic[:, 0]) <= 90.0
    inside = possible & ~cover.outside(geodetic[:, 1], np.where(possible, geodetic[:, 0], 0.0))
    return 2 * int(inside.sum()) > len(inside)


def _fuse(
    session: icechunk.Session,
    base: Snapshot,
    registration: Registration,
    images: list[NetworkImage],
    executor: Executor,
    reporter: Reporter,
) -> tuple[list[TileReport], set[tuple[int, int]], list[icechunk.ForkSession]]:
    """Update and factor every tile that the batch touches; the reports of the tiles, all flags of images, and the writes."""
    cover = base.cover
    touched = sorted({*registration.arrivals, *registration.departures})
    tiles = sorted({tile for cell in touched for tile in cover.holders(cell)})
    shared = executor.share(images)
    arguments = []
    for tile in tiles:
        held = cover.cells_held(tile)
        arguments.append((
            session.fork(), tile,  # a fork each: a task must see the last version, not what another task writes
            {c: registration.arrivals[c] for c in held if c in registration.arrivals},
            {c: registration.departures[c] for c in held if c in registration.departures},
            shared,
        ))  # fmt: skip
    updates = executor.submit_all(update_tile, arguments, "update-tile", reporter.stage("summing tiles", len(tiles)))
    by_tile = dict(zip(tiles, updates, strict=True))
    quiet = reporter.stage("summing tiles", 0)
    reports: list[TileReport] = executor.results(executor.submit_all(report_of, [(u,) for u in updates], "report-of", quiet))

    before = base.flags()
    judged = {report.tile for report in reports if report.converged}
    flags = {(tile, row) for tile, row in before if tile not in judged}
    flags |= {(report.tile, image.row) for report in reports for image in report.flagged}
    released = sorted({row for _, row in flags})
    reconsidered = set(released) ^ {row for _, row in before}
    changed = {cell for report in reports for cell in report.changed}
    again = {tile for cell in changed for tile in cover.holders(cell)} | _tiles_that_see(base, reconsidered)
    to_factor = []
    for tile in sorted(again):
        sources = sorted({cover.owner(c) for c in cover.cells_held(tile)} & set(by_tile))
        to_factor.append((session.fork(), tile, [by_tile[t] for t in sources], shared, released))
    handles = executor.submit_all(factor_tile, to_factor, "factor-tile", reporter.stage("factoring tiles", len(to_factor)))
    writes = [report.writes for report in reports] + [done.writes for done in executor.results(handles)]
    return reports, flags, writes


def _tiles_that_see(base: Snapshot, rows: set[int]) -> set[int]:
    """Tiles of the last version that hold any of these images: their a priori model has changed."""
    old = np.array(sorted(row for row in rows if row < base.image_count()), dtype=np.int32)
    return {tile for tile in base.tile_numbers() if np.isin(old, base.tile_images(tile)).any()} if len(old) else set()


def _enter(
    session: icechunk.Session,
    base: Snapshot,
    version: int,
    blocks: Sequence[Block],
    refused: Sequence[Rejected],
    images: Sequence[NetworkImage],
    registration: Registration,
    flags: set[tuple[int, int]],
    cells: dict[int, CellReport],
) -> None:
    """Write what the coordinator keeps: images, ledger, directory, version."""
    root = zarr.open_group(session.store, mode="r+")
    first = base.image_count()
    records = [image for block in blocks for image in block.images]
    append_table(group_of(root, "images"), {
        "image_id": _texts(i.image_id for i in images), "block_id": _texts(i.block_id for i in images),
        "pass_id": _texts(i.pass_id for i in images), "platform": _texts(r.platform for r in records),
        "sensor": _texts(i.sensor for i in images), "camera": _texts(i.camera for i in images),
        "width": np.array([i.width for i in images], dtype=np.int64), "height": np.array([i.height for i in images], dtype=np.int64),
        "acquired": _texts(r.acquired for r in records), "seconds": np.array([i.seconds for i in images], dtype=np.float64),
        "footprint": _texts(r.footprint.hex() for r in records), "licence": _texts(r.licence for r in records),
        "a_priori": _texts(i.a_priori for i in images), "released": np.zeros(len(images), dtype=np.uint8),
    })  # fmt: skip
    released, before = {row for _, row in flags}, {row for _, row in base.flags()}
    reconsidered = np.array(sorted(released ^ before), dtype=np.int64)
    set_rows(group_of(root, "images"), "released", reconsidered, np.isin(reconsidered, sorted(released)).astype(np.uint8))
    tile_and_image = np.array(sorted(flags), dtype=np.int64).reshape(-1, 2)
    replace_table(group_of(root, "flags"), {"tile": tile_and_image[:, 0], "image": tile_and_image[:, 1]})

    used = np.zeros(first + len(images), dtype=np.int64)
    rejected = np.zeros_like(used)
    for report in cells.values():
        np.add.at(used, report.images, report.used)
        np.add.at(rejected, report.images, report.rejected)
    of_block = np.repeat(np.arange(len(blocks)), [len(block.images) for block in blocks]) if blocks else np.empty(0, dtype=np.int64)
    lost = np.bincount(of_block, weights=rejected[first:], minlength=len(blocks)).astype(np.int64)
    append_table(group_of(root, "ledger"), {
        "block_id": _texts([*(b.block_id for b in blocks), *(r.block_id for r in refused)]),
        "content": _texts([*(b.content_hash() for b in blocks), *("" for _ in refused)]),
        "status": _texts([*("fused" for _ in blocks), *("rejected" for _ in refused)]),
        "reason": _texts([*("" for _ in blocks), *(r.reason for r in refused)]),
        "version": np.full(len(blocks) + len(refused), version, dtype=np.int64),
        "images": np.array([*(len(b.images) for b in blocks), *(0 for _ in refused)], dtype=np.int64),
        "rays": np.array([*(len(b) for b in blocks), *(0 for _ in refused)], dtype=np.int64),
        "rays_rejected": np.array([*lost, *(0 for _ in refused)], dtype=np.int64),
    })  # fmt: skip
    ids, at = registration.directory
    append_table(group_of(root, "directory"), {"hash": hash_ids(ids), "cell": at})
    root.attrs["version"] = version


def _texts(values: Iterable[str]) -> NDArray[np.str_]:
    listed = list(values)
    return np.array(listed, dtype=np.str_) if listed else np.empty(0, dtype="U1")


def _network_images(block: Block) -> tuple[NetworkImage, ...]:
    a_priori = json.dumps(block.a_priori.to_mapping(), sort_keys=True)
    return tuple(
        NetworkImage(i.image_id, i.block_id, i.pass_id, i.sensor, i.camera, i.width, i.height, i.seconds, a_priori) for i in block.images
    )


def _block_rays(block: Block) -> BlockRays:
    return BlockRays(
        block.block_id, _network_images(block), block.point_ids, block.image,
        np.column_stack([block.sample, block.line]), np.column_stack([block.sigma_sample, block.sigma_line]),
    )  # fmt: skip


def _arriving(blocks: Sequence[Block], accepted: dict[str, NDArray[np.bool_]], first_image: int) -> ArrivingRays:
    if not blocks:
        return ArrivingRays(
            np.empty(0, dtype="U1"), np.empty(0, dtype=np.int32), np.empty((0, 2)), np.empty((0, 2)),
            np.empty(0, dtype=np.bool_), np.empty(0, dtype=np.int32),
        )  # fmt: skip
    starts = first_image + np.cumsum([0, *(len(b.images) for b in blocks)])
    return ArrivingRays(
        np.concatenate([b.point_ids for b in blocks]),
        np.concatenate([b.image + start for b, start in zip(blocks, starts, strict=False)]).astype(np.int32),
        np.concatenate([np.column_stack([b.sample, b.line]) for b in blocks]),
        np.concatenate([np.column_stack([b.sigma_sample, b.sigma_line]) for b in blocks]),
        np.concatenate([accepted[b.block_id] for b in blocks]),
        np.concatenate([np.full(len(b), k, dtype=np.int32) for k, b in enumerate(blocks)]),
    )
