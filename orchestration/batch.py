"""One batch of blocks into the network: adjusted by themselves already, they are tested, registered, summed, factored, and committed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
import zarr
from numpy.typing import NDArray

from orchestration.change import Move, finish, place, settle, take_points
from orchestration.executors import Executor
from orchestration.gate import Candidate, common_cells, tested
from orchestration.progress import Reporter
from orchestration.reading import Incoming
from orchestration.stage_one import BlockAdjustment, BlockRays, adjust_block
from orchestration.tasks import FlaggedImage
from submin.adjustment.surveyed_points import ContradictedPoint
from submin.errors import KilledTaskError
from submin.geodesy import Ellipsoid, geocentric_to_geodetic
from submin.network.innovation import REJECTED, BlockTest
from submin.network.registration import LooseRays, together
from submin.storage.catalogue_schema import Block
from submin.storage.check_points import enter_check_points
from submin.storage.commit import begin_change
from submin.storage.control_blocks import points_of
from submin.storage.directory import Directory
from submin.storage.ledger import UNTESTED, Entry, Ledger
from submin.storage.snapshot import Snapshot
from submin.tiling.cover import Cover

T = TypeVar("T")

TESTED_TOGETHER = 16
"""Blocks that a task tests by the network: neighbours ask for the same."""
KILLED = "killed every worker that tried it, one after the other; give workers more memory, or look into their logs for what crashes"


@dataclass(frozen=True)
class Rejected:
    """A block that was not fused, and why; ``points`` are those of a block of surveyed ones."""

    block_id: str
    reason: str
    kind: str = "images"
    points: tuple[str, ...] = ()

    @classmethod
    def of(cls, block: Block, reason: str) -> Rejected:
        """The rejection of a block."""
        return cls(block.block_id, reason, block.kind, points_of(block))


@dataclass(frozen=True)
class Doubtful:
    """A block that was fused though it agrees with the network as few good ones do, its test, and the number of the version."""

    block_id: str
    test: BlockTest
    against: int


@dataclass(frozen=True)
class BatchResult:
    """What a batch did.

    Attributes
    ----------
    version : number of the committed version
    fused : the fused blocks; rejected : the others; doubtful : fused ones that agree with the network as few good ones do
    flagged : images whose camera the judged tiles find bad
    contradicted : surveyed points that contradict the network, by judged tile
    tiles : that were judged; unsettled : tiles whose judgement did not come to rest (their rays are used as last judged)
    """

    version: int
    fused: tuple[Block, ...]
    rejected: tuple[Rejected, ...]
    doubtful: tuple[Doubtful, ...]
    flagged: tuple[FlaggedImage, ...]
    contradicted: dict[int, tuple[ContradictedPoint, ...]]
    tiles: tuple[int, ...]
    unsettled: tuple[int, ...]


def fuse_batch(
    where: str, version: int, batch: Sequence[Incoming], executor: Executor, reporter: Reporter, innovation: float = REJECTED,
    check_points: NDArray[np.str_] | None = None, known: Snapshot | None = None,
) -> BatchResult:  # fmt: skip
    """Fuse blocks that the ledger of a version does not refuse; those that cannot come in are entered in the ledger in the same commit.

    With the fused blocks go the ids of ``check_points``. A block that contradicts that version as a whole is rejected when one of fewer
    than ``innovation`` good blocks would (0: none is). ``known`` is that version where it is open already.

    Raises
    ------
    ConflictError
        When another run has committed meanwhile; nothing of the batch is in the network then.
    """
    session, base = begin_change(where, version, known)
    come, refused = _sorted_out(batch, base.metadata.ellipsoid, executor)
    directory = base.directory_of(_points_of(come))
    tests, against = _tests(come, base, directory, executor, reporter)
    against |= {name: test.reason(innovation, base.version) for name, test in tests.items() if test.rejected(innovation)}
    come, move = _register(come, against, base, directory, refused, executor)
    blocks = [one.block for one in come]
    unsaid = _unsaid(refused, base)
    if not blocks and not unsaid:
        return BatchResult(base.number, (), tuple(refused), (), (), {}, (), ())  # the same command again writes nothing
    settled = settle(session, base, move, executor, reporter)
    version += 1
    lost = settled.rejected[base.image_count() :]
    of_block = np.repeat(np.arange(len(blocks)), [len(block.images) for block in blocks])
    rejected_rays = np.bincount(of_block, weights=lost, minlength=len(blocks)).astype(np.int64).tolist()
    entries = [
        Entry(
            b.block_id, b.content_hash(), "fused", "", version, len(b.images), len(b), n,
            *_tested(tests.get(b.block_id), base.number), kind=b.kind,
        )
        for b, n in zip(blocks, rejected_rays, strict=True)
    ]  # fmt: skip
    entries += [
        Entry(r.block_id, "", "rejected", r.reason, version, 0, 0, 0, *_tested(tests.get(r.block_id), base.number), kind=r.kind)
        for r in unsaid
    ]
    if blocks and check_points is not None:
        enter_check_points(zarr.open_group(session.store, mode="r+"), base, check_points)
    records = [image for block in blocks for image in block.images]
    finish(session, base, move, settled, records, entries, f"{len(blocks)} blocks fused, {len(refused)} rejected")
    doubtful = tuple(
        Doubtful(b.block_id, tests[b.block_id], base.number) for b in blocks if b.block_id in tests and tests[b.block_id].doubtful
    )
    return BatchResult(
        version, tuple(blocks), tuple(refused), doubtful, settled.flagged, settled.contradicted,
        tuple(r.tile for r in settled.reports), tuple(r.tile for r in settled.reports if not r.converged),
    )  # fmt: skip


def _points_of(batch: Sequence[Incoming]) -> NDArray[np.str_]:
    """Ids of the points of all blocks, those of neighbours several times."""
    return np.concatenate([np.empty(0, dtype="U1"), *(come.block.points[0] for come in batch)])


def _unsaid(refused: Sequence[Rejected], base: Snapshot) -> list[Rejected]:
    """Rejections that the ledger does not have as its last word on the block."""
    if not refused:
        return []
    ledger = Ledger.of(base)
    return [r for r in refused if not ledger.said(r.block_id, r.reason)]


def _sorted_out(batch: Sequence[Incoming], ellipsoid: Ellipsoid, executor: Executor) -> tuple[list[Incoming], list[Rejected]]:
    """The blocks of a batch that stage 1 has accepted, and the rejections of the others. Those that it has not seen are adjusted now.

    Nearly always the workers of such a block were killed, its own one or that of others: each is adjusted with no other such block beside.
    """
    accepted, refused = [], []
    for come in batch:
        if come.reason is None and come.adjusted is None and come.block.kind == "images":
            come = replace(come, adjusted=_adjusted_alone(come.rays, ellipsoid, executor))
        reason = come.reason or (None if come.adjusted is None else come.adjusted.reason)
        if reason is None:
            accepted.append(come)
        else:
            refused.append(Rejected.of(come.block, reason))
    return accepted, refused


def _adjusted_alone(rays: BlockRays, ellipsoid: Ellipsoid, executor: Executor) -> BlockAdjustment:
    (outcome,) = executor.attempt_all(adjust_block, [(rays, ellipsoid)], "adjust", lambda: None)
    if isinstance(outcome, KilledTaskError):
        return BlockAdjustment(rays.block_id, np.zeros(len(rays.image), dtype=np.bool_), f"its adjustment {KILLED}")
    adjusted: BlockAdjustment = outcome
    return adjusted


def _tests(
    batch: Sequence[Incoming], base: Snapshot, directory: Directory, executor: Executor, reporter: Reporter
) -> tuple[dict[str, BlockTest], dict[str, str]]:
    """The tests of those blocks that have points in common with the last version, and why those stay out that cannot be tested."""
    of_images = [come for come in batch if come.adjusted is not None]
    cells = common_cells([come.block for come in of_images], directory)
    met = [(come, of_block) for come, of_block in zip(of_images, cells, strict=True) if of_block is not None]
    if not met:
        return {}, {}
    version = Snapshot(base.root, base.place, replace(base.cover))  # without what the cover has worked out: it travels
    shared = executor.share(version)

    def candidates(first: int, last: int) -> list[Candidate]:
        return [Candidate(come.rays, cast(BlockAdjustment, come.adjusted), of_block) for come, of_block in met[first:last]]

    groups = _OnDemand(lambda k: (candidates(k * TESTED_TOGETHER, (k + 1) * TESTED_TOGETHER), shared), -(-len(met) // TESTED_TOGETHER))
    outcomes = executor.attempt_all(tested, groups, "test", reporter.stage("testing blocks", len(groups)))
    tests: dict[str, BlockTest] = {}
    killed: dict[str, str] = {}
    for k, (come, _) in enumerate(met):
        outcome = outcomes[k // TESTED_TOGETHER]
        if isinstance(outcome, KilledTaskError):  # one of the group may be to blame: each by itself
            (alone,) = executor.attempt_all(tested, [(candidates(k, k + 1), version)], "test", lambda: None)
            if isinstance(alone, KilledTaskError):
                killed[come.block.block_id] = f"its test by the network {KILLED}"
                continue
            found = alone[0]
        else:
            found = outcome[k % TESTED_TOGETHER]
        if found is not None:
            tests[come.block.block_id] = found
    return tests, killed


class _OnDemand(Sequence[T]):
    """Values that are made when they are asked for, each time anew: what tasks are given, while others run already."""

    def __init__(self, make: Callable[[int], T], count: int) -> None:
        self._make, self._count = make, count

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[T]:
        return map(self._make, range(self._count))  # an IndexError of what makes them must not look like their end

    def __getitem__(self, k: Any) -> Any:
        if not 0 <= k < self._count:
            raise IndexError(k)
        return self._make(k)


def _tested(test: BlockTest | None, version: int) -> tuple[float, int, float, int, int]:
    """The last columns of a block's line in the ledger."""
    return UNTESTED if test is None else (test.d2, test.dof, test.probability, test.left_out, version)


def _register(
    batch: list[Incoming], against: Mapping[str, str], base: Snapshot, directory: Directory, refused: list[Rejected], executor: Executor
) -> tuple[list[Incoming], Move]:
    """Register the rays of the batch; a block that measures a known point elsewhere, or nothing inside the area, is rejected.

    So are then those that contradict the network as a whole (``against``: reason by block): where one point tells more, it is said.
    """
    while True:
        blocks, rays = [come.block for come in batch], _arriving(batch, base.image_count())
        out = take_points(base, rays.ids, directory.cells_of(rays.ids))
        move = place(base, out, rays, [image for come in batch for image in come.images], executor)
        bad = _misplaced(blocks, rays, move) or {k: against[b.block_id] for k, b in enumerate(blocks) if b.block_id in against}
        if not bad:
            return batch, move
        refused.extend(Rejected.of(blocks[k], bad[k]) for k in sorted(bad))
        batch = [come for k, come in enumerate(batch) if k not in bad]


def _misplaced(blocks: Sequence[Block], arriving: LooseRays, move: Move) -> dict[int, str]:
    """Blocks of the batch that cannot be registered, with the reason."""
    outside = move.registration.outside[: len(arriving)]  # the arriving rays are the first of those that were registered
    inside = np.bincount(arriving.block[~outside], minlength=len(blocks))
    bad = {
        int(k): wholly_outside(_registered_at(arriving.point_ids[arriving.block == k], move), move.cover)
        for k in np.flatnonzero(inside == 0)
    }
    for k, (point, metres) in move.contradictions.items():
        bad.setdefault(
            k,
            f"point {point} is measured {metres / 1000.0:.1f} km from where other rays place it; one id must be one place: "
            "use other point ids (imports prefix them unless --shared-ids), or remove the ray if it is a gross blunder"
            if np.isfinite(metres)
            else f"point {point}: a camera does not reach the ground there; check the camera models and the axis order",
        )
    return bad


def wholly_outside(at: NDArray[np.float64], cover: Cover) -> str:
    """Why a block stays out whose points, at these longitudes and latitudes (p, 2), are all outside the area."""
    possible = np.abs(at[:, 0]) <= 90.0
    inside_when_swapped = possible & ~cover.outside(at[:, 1], np.where(possible, at[:, 0], 0.0))
    return "the block lies wholly outside the area of the network; " + (
        "longitude and latitude look swapped, in the area or in its cameras"
        if 2 * int(inside_when_swapped.sum()) > len(at)
        else "create a network whose area holds it"
    )


def _registered_at(ids: NDArray[np.str_], move: Move) -> NDArray[np.float64]:
    """Longitude and latitude (p, 2) where some of the points that arrive are registered."""
    arrivals = move.registration.arrivals.values()
    origin = np.concatenate([np.empty((0, 3)), *(a.origin[np.isin(a.point_ids, ids)] for a in arrivals)])
    return geocentric_to_geodetic(origin, move.cover.ellipsoid)[:, :2]


def _arriving(batch: Sequence[Incoming], first_image: int) -> LooseRays:
    starts = first_image + np.cumsum([0, *(len(come.images) for come in batch)])
    return together([
        LooseRays(
            *b.points, (b.image + start).astype(np.int32), b.observed, b.sigma, come.accepted, np.full(len(b), k, dtype=np.int32),
        )
        for k, (come, b, start) in enumerate(zip(batch, (come.block for come in batch), starts, strict=False))
    ])  # fmt: skip
