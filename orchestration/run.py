"""A run: every block of a catalogue into a network, batch by batch, each block exactly once."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from orchestration.batch import BatchResult, Rejected, fuse_batch
from orchestration.executors import Executor
from orchestration.progress import Reporter, Silent
from orchestration.tasks import FlaggedImage
from submin.errors import InputError
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, defects
from submin.storage.network_store import Snapshot
from submin.storage.writer_lock import writing

DEFAULT_BATCH_BLOCKS = 500


@dataclass(frozen=True)
class RunResult:
    """What a run did; the keys of ``submin run --json``.

    Attributes
    ----------
    version : of the network afterwards; fused, skipped : numbers of blocks; rejected, flagged : with reasons
    rays_used, rays_rejected : rays in the network afterwards; ray_rms_px : residual of the used ones, per coordinate
    """

    version: str
    fused: int
    skipped: int
    rejected: tuple[Rejected, ...]
    flagged: tuple[FlaggedImage, ...]
    ray_rms_px: float
    rays_used: int
    rays_rejected: int
    unsettled_tiles: tuple[str, ...]
    seconds: float
    peak_memory_mb: float

    def to_json(self) -> dict[str, Any]:
        """Plain values, as programs rely on them."""
        return {
            "version": self.version,
            "blocks_fused": self.fused,
            "blocks_skipped": self.skipped,
            "blocks_rejected": [{"block_id": r.block_id, "reason": r.reason} for r in self.rejected],
            "images_flagged": [{"image_id": f.image_id, "reason": f.reason} for f in self.flagged],
            "ray_rms_px": self.ray_rms_px,
            "rays_used": self.rays_used,
            "rays_rejected": self.rays_rejected,
            "unsettled_tiles": list(self.unsettled_tiles),
            "seconds": self.seconds,
            "peak_memory_mb": self.peak_memory_mb,
        }


@dataclass
class Ledger:
    """What is already in the network, as the run needs it: content of fused blocks, block of each image."""

    content: dict[str, str]
    block_of_image: dict[str, str]

    @classmethod
    def of(cls, snapshot: Snapshot) -> Ledger:
        """The ledger of a version."""
        table = snapshot.ledger(["block_id", "content", "status"])
        content = {
            str(b): str(c) for b, c, s in zip(table["block_id"], table["content"], table["status"], strict=True) if s == "fused"
        }  # fmt: skip
        images = snapshot.image_columns(["image_id", "block_id"])
        return cls(content, dict(zip(images["image_id"].tolist(), images["block_id"].tolist(), strict=True)))

    def refusal(self, block: Block) -> str | None:
        """Why a block that is not the same as before cannot come in, or None."""
        if block.block_id in self.content:
            return f"block {block.block_id} is already in the network with other content; withdraw it first, or give the new one another id"
        for image in block.images:
            if image.image_id in self.block_of_image:
                return f"image {image.image_id} already came in block {self.block_of_image[image.image_id]}; an image counts once"
        return defects(block)

    def enter(self, block: Block) -> None:
        """A block is on its way in: nothing later in the run may bring it or its images again."""
        self.content[block.block_id] = block.content_hash()
        self.block_of_image.update((image.image_id, block.block_id) for image in block.images)


@dataclass
class _Tally:
    rejected: list[Rejected] = field(default_factory=list)
    flagged: dict[int, FlaggedImage] = field(default_factory=dict)
    unsettled: set[int] = field(default_factory=set)
    fused: int = 0
    skipped: int = 0

    def add(self, batch: BatchResult) -> None:
        self.rejected.extend(batch.rejected)
        self.flagged.update({f.row: f for f in batch.flagged})
        self.unsettled = (self.unsettled - set(batch.tiles)) | set(batch.unsettled)
        self.fused += len(batch.fused)


def run(
    catalogue: Catalogue, place: str, executor: Executor, *, batch_blocks: int = DEFAULT_BATCH_BLOCKS, reporter: Reporter | None = None
) -> RunResult:
    """Fuse every block of a catalogue that the network does not have yet.

    Raises
    ------
    InputError
        When the catalogue breaks its contract, or its frame is not the network's: found before anything is written.
    BusyError
        When another process is writing to the network.
    """
    with writing(place):
        return _run(catalogue, place, executor, batch_blocks, reporter or Silent())


def _run(catalogue: Catalogue, place: str, executor: Executor, batch_blocks: int, reporter: Reporter) -> RunResult:
    started = time.monotonic()
    snapshot = Snapshot.open(place)
    check_frames(catalogue, snapshot)
    summary = catalogue.validate()
    ledger, tally = Ledger.of(snapshot), _Tally()
    reporter.begin(summary.blocks)
    blocks = _new_blocks(catalogue, ledger, tally, reporter)
    while batch := list(islice(blocks, max(batch_blocks, 1))):
        good = [block for block, reason in batch if reason is None]
        refused = [Rejected(block.block_id, reason) for block, reason in batch if reason is not None]
        tally.add(fuse_batch(place, good, refused, executor, reporter))
        reporter.fused(len(batch))

    after = Snapshot.open(place)
    released = {row for _, row in after.flags()} - {row for _, row in snapshot.flags()}
    cells = [after.cell_attributes(number) for number in after.cell_numbers()]
    used = sum(cell["accepted"] for cell in cells)
    square = sum(cell["square_px"] for cell in cells)
    return RunResult(
        after.version, tally.fused, tally.skipped, tuple(tally.rejected), tuple(tally.flagged[row] for row in sorted(released)),
        float(np.sqrt(square / (2.0 * used))) if used else 0.0, used, sum(cell["rays"] for cell in cells) - used,
        tuple(after.cover.tile_name(t) for t in sorted(tally.unsettled)), time.monotonic() - started, executor.peak_memory_mb(),
    )  # fmt: skip


def _new_blocks(catalogue: Catalogue, ledger: Ledger, tally: _Tally, reporter: Reporter) -> Iterator[tuple[Block, str | None]]:
    """Blocks that the network does not have, each with the reason for which it cannot come in, if any."""
    for block in catalogue.blocks():
        if ledger.content.get(block.block_id) == block.content_hash():
            tally.skipped += 1
            reporter.fused(1)
            continue
        reason = ledger.refusal(block)
        if reason is None:
            ledger.enter(block)
        yield block, reason


def check_frames(catalogue: Catalogue, snapshot: Snapshot) -> None:
    """Refuse a catalogue whose body, frame or epoch is not the network's."""
    ours, theirs = snapshot.metadata, catalogue.metadata
    for name in ("body", "frame", "epoch", "semimajor_axis", "flattening"):
        if getattr(ours, name) != getattr(theirs, name):
            raise InputError(
                f"{catalogue.path}/catalogue.json: {name} is {getattr(theirs, name)!r}, but the network's is {getattr(ours, name)!r}; "
                "transform the catalogue to the network's frame first"
            )
