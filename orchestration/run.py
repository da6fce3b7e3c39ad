"""A run: every block of a catalogue into a network, batch by batch, each block exactly once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from orchestration.batch import BatchResult, Doubtful, Rejected, fuse_batch
from orchestration.executors import Executor
from orchestration.progress import Reporter, Silent
from orchestration.read_ahead import batches_ahead
from orchestration.reading import Incoming, read_catalogue, ready
from orchestration.task_record import TaskRecord
from orchestration.tasks import FlaggedImage
from submin.adjustment.surveyed_points import ContradictedPoint
from submin.errors import InputError
from submin.network.innovation import REJECTED
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.control_blocks import control_blocks, observed_positions, points_of
from submin.storage.ledger import Ledger, blocks_in
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import writing

T = TypeVar("T")

DEFAULT_BATCH_BLOCKS = 2000


@dataclass(frozen=True)
class RunResult:
    """What a run did; the keys of ``submin run --json``.

    Attributes
    ----------
    version : of the network afterwards; fused, skipped : numbers of blocks; rejected, flagged : with reasons
    doubtful : fused blocks that agree with the network as few good ones do
    control_fused : number of control points; observations_fused : of clusters of observations
    contradicted : surveyed points that contradict the network, with reasons
    tasks : what tasks took, by their names
    rays_used, rays_rejected : rays in the network afterwards; ray_rms_px : residual of the used ones, per coordinate
    """

    version: str
    fused: int
    skipped: int
    control_fused: int
    observations_fused: int
    rejected: tuple[Rejected, ...]
    doubtful: tuple[Doubtful, ...]
    flagged: tuple[FlaggedImage, ...]
    contradicted: tuple[ContradictedPoint, ...]
    ray_rms_px: float
    rays_used: int
    rays_rejected: int
    unsettled_tiles: tuple[str, ...]
    seconds: float
    peak_memory_mb: float
    tasks: Mapping[str, TaskRecord]

    def to_json(self) -> dict[str, Any]:
        """Plain values, as programs rely on them."""
        return {
            "version": self.version,
            "blocks_fused": self.fused,
            "blocks_skipped": self.skipped,
            "control_fused": self.control_fused,
            "observations_fused": self.observations_fused,
            "blocks_rejected": [{"block_id": r.block_id, "reason": r.reason} for r in self.rejected],
            "blocks_doubtful": [
                {
                    "block_id": d.block_id,
                    "d2": d.test.d2,
                    "dof": d.test.dof,
                    "probability": d.test.probability,
                    "points": d.test.points,
                    "points_left_out": d.test.left_out,
                    "against": f"v{d.against}",
                }
                for d in self.doubtful
            ],
            "images_flagged": [{"image_id": f.image_id, "reason": f.reason} for f in self.flagged],
            "control_flagged": [{"point_id": c.point_id, "reason": c.reason} for c in self.contradicted],
            "ray_rms_px": self.ray_rms_px,
            "rays_used": self.rays_used,
            "rays_rejected": self.rays_rejected,
            "unsettled_tiles": list(self.unsettled_tiles),
            "seconds": self.seconds,
            "peak_memory_mb": self.peak_memory_mb,
            "tasks": {name: record.to_json() for name, record in sorted(self.tasks.items())},
        }


@dataclass
class Tally:
    """What has become of the blocks so far: ``version`` is the last one known, ``released`` the bad cameras that were known before."""

    version: int
    released: set[int]
    rejected: list[Rejected] = field(default_factory=list)
    doubtful: list[Doubtful] = field(default_factory=list)
    flagged: dict[int, FlaggedImage] = field(default_factory=dict)
    by_tile: dict[int, tuple[ContradictedPoint, ...]] = field(default_factory=dict)
    unsettled: set[int] = field(default_factory=set)
    fused: int = 0
    control: int = 0
    observations: int = 0
    skipped: int = 0

    def add(self, batch: BatchResult) -> None:
        """Count a batch."""
        self.version = batch.version
        self.rejected.extend(batch.rejected)
        self.doubtful.extend(batch.doubtful)
        self.flagged.update({f.row: f for f in batch.flagged})
        self.unsettled = (self.unsettled - set(batch.tiles)) | set(batch.unsettled)
        self.by_tile.update(batch.contradicted)
        self.control += sum(len(points_of(block)) for block in batch.fused if block.kind == "control")
        self.observations += sum(block.kind == "observations" for block in batch.fused)
        self.fused += sum(block.kind == "images" for block in batch.fused)

    @property
    def contradicted(self) -> tuple[ContradictedPoint, ...]:
        """Surveyed points that contradict the network as their tiles have judged them last."""
        return tuple(sorted((point for points in self.by_tile.values() for point in points), key=lambda point: point.point_id))


def run(
    catalogue: Catalogue, place: str, executor: Executor, *, batch_blocks: int = DEFAULT_BATCH_BLOCKS, reporter: Reporter | None = None,
    innovation: float = REJECTED,
) -> RunResult:  # fmt: skip
    """Fuse every block of a catalogue that the network does not have yet.

    A block that contradicts the network as a whole, as one of fewer than ``innovation`` good blocks would, is rejected; 0 rejects none.

    Raises
    ------
    InputError
        When the catalogue breaks its contract, or its frame is not the network's: found before anything is written.
    BusyError, ConflictError
        When another process is writing to the network.
    """
    started, reporter = time.monotonic(), reporter or Silent()
    before = Snapshot.open(place)
    check_frames(catalogue, before)
    here = blocks_in(before)
    del before
    validated = _validation(catalogue, executor)
    control = catalogue.points("control")
    observed = observation_blocks(catalogue)
    clusters = sum(1 for _ in catalogue.observations())
    reporter.begin(catalogue.block_count + (0 if control is None else len(control)) + clusters)
    surveyed = () if control is None else control_blocks(control, catalogue.metadata.ellipsoid, f"{catalogue.path}/control")
    every = chain(read_catalogue(catalogue, executor, batch_blocks, here), ready(chain(surveyed, observed)))
    check = catalogue.points("check")
    tally = fuse_blocks(
        every, place, executor, batch_blocks, reporter, innovation, np.empty(0, dtype="U1") if check is None else check.point_ids, validated
    )
    after = Snapshot.open(place)
    # another run may have gone on meanwhile
    return _result(after if after.number == tally.version else Snapshot.open(place, f"v{tally.version}"), tally, started, executor)


def _validation(catalogue: Catalogue, executor: Executor) -> Callable[[], object]:
    """Look for structural errors through all that a run reads of a catalogue; what is returned waits for that, and raises what was found.

    A worker that sees the same files does it, while the first blocks are read here.
    """
    if not executor.beside:
        catalogue.validate(truth=False)
        return lambda: None
    handle = executor.submit(_validate, (catalogue.path,), "validate")
    return lambda: executor.results([handle])


def _validate(path: Path) -> None:
    Catalogue.open(path).validate(truth=False)


def observation_blocks(catalogue: Catalogue) -> Iterator[Block]:
    """Blocks of a catalogue's clusters of positions, one after the other.

    Raises
    ------
    InputError
        At once, when a cluster cannot enter a factored network: it holds baselines, or its covariance is as good as singular.
    """

    def blocks() -> Iterator[Block]:
        source = f"{catalogue.path}/observations"
        return (observed_positions(cluster, catalogue.metadata.ellipsoid, source) for cluster in catalogue.observations())

    for _ in blocks():  # all of them before anything is written
        pass
    return blocks()


def fuse_blocks(
    blocks: Iterable[Incoming], place: str, executor: Executor, batch_blocks: int, reporter: Reporter, innovation: float = REJECTED,
    check_points: NDArray[np.str_] | None = None, validated: Callable[[], object] = lambda: None,
) -> Tally:  # fmt: skip
    """Fuse those of some blocks that the network does not have yet, so many to a commit; it remembers ``check_points`` with them.

    ``validated`` is called before anything is written: what it raises ends the run.

    Raises
    ------
    BusyError
        When another process is writing to the network.
    ConflictError
        When one has written to it since the ledger was read, where there is no lock to keep it out.
    """
    with writing(place), ThreadPoolExecutor(1, thread_name_prefix="directory") as beside:
        known: Snapshot | None
        before = known = Snapshot.open(place)
        directory = beside.submit(before.read_ahead)  # while the ledger and the first blocks are read
        tally = Tally(before.number, {row for _, row in before.flags()})
        new = _new_blocks(blocks, Ledger.of(before), tally, reporter)
        del before
        for number, batch in enumerate(_once(validated, batches_ahead(new, max(batch_blocks, 1)))):
            if number:
                executor.give_back()
            directory.result()
            tally.add(fuse_batch(place, tally.version, batch, executor, reporter, innovation, check_points, known))
            known = None  # with all that it has read
            reporter.fused(len(batch))
    return tally


def _once(validated: Callable[[], object], batches: Iterator[T]) -> Iterator[T]:
    """Batches, none of them before all is known to be sound. Where the first cannot even be read, validation says better why."""
    first: list[T] = []
    try:
        first += islice(batches, 1)
    finally:
        validated()
    while first:
        yield first.pop()  # kept here no longer than where it is used
    yield from batches


def _result(after: Snapshot, tally: Tally, started: float, executor: Executor) -> RunResult:
    released = {row for _, row in after.flags()} - tally.released
    totals = after.ray_totals()
    return RunResult(
        after.version, tally.fused, tally.skipped, tally.control, tally.observations,
        tuple(tally.rejected), tuple(tally.doubtful), tuple(tally.flagged[row] for row in sorted(released)), tally.contradicted,
        totals.rms_px, totals.accepted, totals.rays - totals.accepted,
        tuple(after.cover.tile_name(t) for t in sorted(tally.unsettled)), time.monotonic() - started, executor.peak_memory_mb(),
        executor.task_records(),
    )  # fmt: skip


def _new_blocks(blocks: Iterable[Incoming], ledger: Ledger, tally: Tally, reporter: Reporter) -> Iterator[Incoming]:
    """Blocks that the network does not have."""
    for come in blocks:
        reporter.read(1)
        if ledger.holds(come.block):
            tally.skipped += come.block.kind == "images"
            reporter.fused(1)
            continue
        refusal = ledger.refusal(come.block)  # it comes before what is wrong with the block
        if refusal is None and come.reason is None:
            ledger.enter(come.block)
        yield come if refusal is None else come.refused(refusal)


def check_frames(catalogue: Catalogue, snapshot: Snapshot) -> None:
    """Refuse a catalogue whose body, frame or epoch is not the network's."""
    ours, theirs = snapshot.metadata, catalogue.metadata
    for name in ("body", "frame", "epoch", "semimajor_axis", "flattening"):
        if getattr(ours, name) != getattr(theirs, name):
            raise InputError(
                f"{catalogue.path}/catalogue.json: {name} is {getattr(theirs, name)!r}, but the network's is {getattr(ours, name)!r}; "
                "transform the catalogue to the network's frame first"
            )
