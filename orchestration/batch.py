"""One batch of blocks into the network: each adjusted by itself, then registered, summed, factored and committed together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, TypeVar

import numpy as np
import zarr
from numpy.typing import NDArray

from orchestration.change import Move, finish, place, settle, take_points
from orchestration.executors import Executor
from orchestration.progress import Reporter
from orchestration.tasks import BlockAdjustment, BlockRays, FlaggedImage, Gate, adjust_blocks
from submin.adjustment.surveyed_points import ContradictedPoint
from submin.errors import KilledTaskError
from submin.geodesy import Ellipsoid, geocentric_to_geodetic
from submin.network.innovation import REJECTED, BlockTest
from submin.network.network_image import NetworkImage
from submin.network.registration import LooseRays, together
from submin.storage.block_images import network_images
from submin.storage.catalogue_schema import Block
from submin.storage.check_points import enter_check_points
from submin.storage.control_blocks import points_of
from submin.storage.ledger import UNTESTED, Entry, Ledger
from submin.storage.network_store import Snapshot, begin_change
from submin.tiling.cover import Cover

T = TypeVar("T")
ImagesOf = Mapping[str, tuple[NetworkImage, ...]]

BLOCKS_A_TASK = 16
LEAST_AGREEING = 0.5
"""Part of a block's rays that its own adjustment must accept: fewer are no blunders in a good block."""


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
    where: str, version: int, blocks: Sequence[Block], rejected: Sequence[Rejected], executor: Executor, reporter: Reporter,
    images: ImagesOf, innovation: float = REJECTED, check_points: NDArray[np.str_] | None = None, known: Snapshot | None = None,
) -> BatchResult:  # fmt: skip
    """Fuse blocks that the ledger of a version has let through; ``rejected`` ones are entered in the ledger in the same commit.

    ``images`` are those of the blocks, by block, as the network will have them. In the same commit go the ids of ``check_points``, where
    blocks are fused. A block that contradicts that version as a whole is rejected when one of fewer than ``innovation`` good blocks would
    (0: none is). ``known`` is that version where it is open already.

    Raises
    ------
    ConflictError
        When another run has committed meanwhile; nothing of the batch is in the network then.
    """
    session, base = begin_change(where, version, known)
    refused = list(rejected)
    accepted, tests = _stage_one(blocks, images, base, executor, reporter, refused)
    against = {name: test.reason(innovation, base.version) for name, test in tests.items() if test.rejected(innovation)}
    blocks, move = _register([block for block in blocks if block.block_id in accepted], images, accepted, against, base, refused, executor)
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


def _unsaid(refused: Sequence[Rejected], base: Snapshot) -> list[Rejected]:
    """Rejections that the ledger does not have as its last word on the block."""
    if not refused:
        return []
    ledger = Ledger.of(base)
    return [r for r in refused if not ledger.said(r.block_id, r.reason)]


def _stage_one(
    blocks: Sequence[Block], images: ImagesOf, base: Snapshot, executor: Executor, reporter: Reporter, refused: list[Rejected]
) -> tuple[dict[str, NDArray[np.bool_]], dict[str, BlockTest]]:
    """Adjust each block of images by itself: the accepted rays of the blocks that succeed, and all of surveyed points.

    Beside it the tests of blocks, also of rejected ones, that have points in common with the last version.
    """
    of_images = [block for block in blocks if block.kind == "images"]
    groups = [of_images[k : k + BLOCKS_A_TASK] for k in range(0, len(of_images), BLOCKS_A_TASK)]
    gates = _gates(groups, base)
    arguments: Sequence[tuple[list[BlockRays], Ellipsoid, Gate | None]] = _OnDemand(
        lambda k: ([block_rays(b, images[b.block_id]) for b in groups[k]], base.metadata.ellipsoid, gates[k]), len(groups)
    )
    outcomes = executor.attempt_all(adjust_blocks, arguments, "adjust", reporter.stage("adjusting blocks", len(arguments)))
    for k, outcome in enumerate(outcomes):
        if isinstance(outcome, KilledTaskError):
            outcomes[k] = _one_at_a_time(arguments[k], executor)
    accepted = {b.block_id: np.ones(len(b), dtype=np.bool_) for b in blocks if b.kind != "images"}
    tests: dict[str, BlockTest] = {}
    for outcome in (outcome for group in outcomes for outcome in group):
        reason = outcome.reason or disagreement(outcome.accepted)
        if reason is None and outcome.test is not None:
            tests[outcome.block_id] = outcome.test
        if reason is None:
            accepted[outcome.block_id] = outcome.accepted
        else:
            refused.append(Rejected(outcome.block_id, reason))
    return accepted, tests


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


def _one_at_a_time(task: tuple[list[BlockRays], Ellipsoid, Gate | None], executor: Executor) -> list[BlockAdjustment]:
    """Stage 1 of blocks whose task killed its workers, each with nothing beside it: what kills them then is that block."""
    blocks, ellipsoid, gate = task
    done = []
    for k, block in enumerate(blocks):
        alone = None if gate is None else Gate(gate.snapshot, gate.cells[k : k + 1])
        (outcome,) = executor.attempt_all(adjust_blocks, [([block], ellipsoid, alone)], "adjust", lambda: None)
        if isinstance(outcome, KilledTaskError):
            reason = (
                f"its adjustment killed {outcome.workers} workers, one after the other; give workers more memory, "
                "or look into their logs for what crashes"
            )
            outcome = [BlockAdjustment(block.block_id, np.zeros(len(block.image), dtype=np.bool_), reason)]
        done.extend(outcome)
    return done


def _gates(groups: Sequence[Sequence[Block]], base: Snapshot) -> list[Gate | None]:
    """What the blocks of each group are tested by; None where the network has none of their points. The directory is read once."""
    if not base.image_count() or not groups:
        return [None] * len(groups)
    shared = Snapshot(base.root, base.place, replace(base.cover))  # without what the cover has worked out: it travels
    of_blocks = [block.points[0] for block in chain(*groups)]
    cells = iter(np.split(base.candidate_cells(np.concatenate(of_blocks)), np.cumsum([len(ids) for ids in of_blocks])[:-1]))
    of_groups = [tuple(next(cells) for _ in group) for group in groups]
    return [Gate(shared, of_group) if any((cell >= 0).any() for cell in of_group) else None for of_group in of_groups]


def _tested(test: BlockTest | None, version: int) -> tuple[float, int, float, int, int]:
    """The last columns of a block's line in the ledger."""
    return UNTESTED if test is None else (test.d2, test.dof, test.probability, test.left_out, version)


def disagreement(accepted: NDArray[np.bool_]) -> str | None:
    """Why a block whose rays contradict each other stays out: its points would be registered where they are not, against good blocks."""
    if accepted.sum() >= LEAST_AGREEING * len(accepted):
        return None
    return (
        f"only {accepted.sum()} of the block's {len(accepted)} rays agree with each other; "
        "check the order of sample and line, the point ids and the cameras"
    )


def _register(
    blocks: list[Block],
    images: ImagesOf,
    accepted: dict[str, NDArray[np.bool_]],
    against: Mapping[str, str],
    base: Snapshot,
    refused: list[Rejected],
    executor: Executor,
) -> tuple[list[Block], Move]:
    """Register the rays of the batch; a block that measures a known point elsewhere, or nothing inside the area, is rejected.

    So are then those that contradict the network as a whole (``against``: reason by block): where one point tells more, it is said.
    """
    while True:
        rays = _arriving(blocks, accepted, base.image_count())
        move = place(
            base, take_points(base, rays.ids), rays,
            [image for block in blocks for image in images[block.block_id]], executor,
        )  # fmt: skip
        bad = _misplaced(blocks, rays, move) or {k: against[b.block_id] for k, b in enumerate(blocks) if b.block_id in against}
        if not bad:
            return blocks, move
        refused.extend(Rejected.of(blocks[k], bad[k]) for k in sorted(bad))
        blocks = [block for k, block in enumerate(blocks) if k not in bad]


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


def block_rays(block: Block, images: tuple[NetworkImage, ...] | None = None) -> BlockRays:
    """A block of a catalogue as stage 1 sees it; ``images`` where they are known already, as the network will have them."""
    return BlockRays(
        block.block_id, network_images(block) if images is None else images, *block.points, block.image, block.observed, block.sigma
    )


def _arriving(blocks: Sequence[Block], accepted: dict[str, NDArray[np.bool_]], first_image: int) -> LooseRays:
    starts = first_image + np.cumsum([0, *(len(b.images) for b in blocks)])
    return together([
        LooseRays(
            *b.points, (b.image + start).astype(np.int32), b.observed, b.sigma, accepted[b.block_id],
            np.full(len(b), k, dtype=np.int32),
        )
        for k, (b, start) in enumerate(zip(blocks, starts, strict=False))
    ])  # fmt: skip
