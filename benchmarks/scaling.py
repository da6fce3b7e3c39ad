"""What more workers and more area do to a run: blocks per second for one and for two workers, and for parts of China up to three of it.

Time and memory of a run must follow the number of blocks and nothing else: batches are of one size, and what is kept of the catalogue
while one is worked on is one batch more.

The parts take an hour, in which a machine that others use too is not always as fast. Stage 1 of a block is the same work in every part:
the processor time that it took tells how fast the machine was meanwhile, and times a block are compared at the speed of the first part too.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.china import OVERLAP_KM
from benchmarks.comparison import verdict
from benchmarks.product import submin_json
from benchmarks.record import write_record

Rows = list[dict[str, Any]]

PARTS = (0.1, 1.0 / 3.0, 1.0, 3.0)
SPEED_UP, TIME_SPREAD, MEMORY_SPREAD = 1.8, 1.15, 1.20
BATCH_BLOCKS = 220
"""Blocks of a commit: four batches in the smallest part. Tiles on the rim of a batch are judged again; one or two batches have less rim."""
STAGE_ONE = "stage 1, ms of a processor a block"
ALONE = PARTS[1]
"""The part that one worker does too: minutes of work, so that what it takes to start does not count."""


def measure(scale: float, workers: int, out: Path | None = None) -> Rows:
    """Rows of each part of China (times ``scale``) on so many workers, of `ALONE` on one too, and of what is asked for.

    ``out``: folder for ``scaling.json``.
    """
    rows = []
    for part in PARTS:
        with tempfile.TemporaryDirectory() as folder:
            catalogue = Path(folder) / "catalogue"
            submin_json("simulate", "china", "--out", catalogue, "--scale", part * scale, "--workers", workers)
            rows += [_ran(catalogue, Path(folder) / f"network-{n}", part, n) for n in ({1, workers} if part == ALONE else {workers})]
    by_part = [row for row in rows if row["workers"] == workers]
    one, several = (next(row for row in rows if row["part of China"] == ALONE and row["workers"] == n) for n in (1, workers))
    times, stage_one, memory = ([row[column] for row in by_part] for column in ("ms a block", STAGE_ONE, "peak, MB"))
    at_one_speed = [time * stage_one[0] / taken for time, taken in zip(times, stage_one, strict=True)]
    every = [
        *rows,
        _claim(f"{workers} workers against one, {ALONE:.2f} of China", one["seconds"] / several["seconds"], SPEED_UP, above=True),
        _claim("time a block, most to least", max(times) / min(times), TIME_SPREAD),
        _claim("the same, as fast as the machine was in the first part", max(at_one_speed) / min(at_one_speed), TIME_SPREAD),
        _claim("peak memory, most to least", max(memory) / min(memory), MEMORY_SPREAD),
    ]
    if out is not None:
        write_record(out, "scaling", scale, workers, every)
    return every


def _ran(catalogue: Path, network: Path, part: float, workers: int) -> dict[str, Any]:
    submin_json("create", network, "--fit", catalogue, "--overlap-km", OVERLAP_KM)
    ran = submin_json("run", catalogue, network, "--workers", workers, "--batch-blocks", BATCH_BLOCKS, "--no-reconcile")
    outside = submin_json("reconcile", network, "--workers", workers)
    blocks = ran["blocks_fused"]
    stage_one = ran["tasks"]["adjust"]["processor_seconds"]
    return {
        "part of China": part, "blocks": blocks, "workers": workers, "seconds": ran["seconds"], "blocks/s": blocks / ran["seconds"],
        "ms a block": 1e3 * ran["seconds"] / blocks, STAGE_ONE: 1e3 * stage_one / blocks, "peak, MB": ran["peak_memory_mb"],
        "reconcile, s": outside["seconds"], "reconcile, ms a block": 1e3 * outside["seconds"] / blocks,
        "its peak, MB": outside["peak_memory_mb"], "largest front": outside["largest_front"],
    }  # fmt: skip


def _claim(what: str, ratio: float, limit: float, *, above: bool = False) -> dict[str, Any]:
    met = ratio >= limit if above else ratio <= limit
    return {"ratio": what, "wanted": f"{'at least' if above else 'at most'} {limit:g}", "found": ratio, "verdict": verdict(met)}
