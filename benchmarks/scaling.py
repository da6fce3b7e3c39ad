"""What more workers and more area do to a run: blocks per second for one and for two workers, and for parts of China up to three of it.

Time and memory of a run must follow the number of blocks and nothing else: batches are of one size, and what is kept of the catalogue
while one is worked on is one batch more.

Two cores do not always do twice what one does: memory and caches are shared, and on a rented machine perhaps the core itself. What they
do is found with two runs at once that have nothing to do with each other, a core each, against one of them alone.

The parts take an hour, in which a machine that others use too is not always as fast. Stage 1 of a block is the same work in every part:
the processor time that it took tells how fast the machine was meanwhile, and times a block are compared at the speed of the first part too.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.china import OVERLAP_KM
from benchmarks.comparison import DATA, verdict
from benchmarks.product import submin_json
from benchmarks.record import write_record

Rows = list[dict[str, Any]]

PARTS = (0.1, 1.0 / 3.0, 1.0, 3.0)
SPEED_UP, TIME_SPREAD, MEMORY_SPREAD = 1.8, 1.15, 1.20
BATCH_BLOCKS = 220
"""Blocks of a commit: four batches in the smallest part. Tiles on the rim of a batch are judged again; one or two batches have less rim."""
STAGE_ONE = "stage 1, ms of a processor a block"
ALL = "all"
"""Cores of the machine."""
ALONE = PARTS[1]
"""The part that one worker does too: minutes of work, so that what it takes to start does not count."""


def measure(scale: float, workers: int, out: Path | None = None) -> Rows:
    """Rows of each part of China (times ``scale``) on so many workers, of `ALONE` on one too, and of what is asked for.

    One worker has all cores, of which the coordinator then takes a second one, and once a single core for both. Runs on several workers
    come before and after, since the machine changes. Every reconciliation has all cores. Of the first part so many runs are also made at
    once, a core each, and one alone. ``out``: folder for ``scaling.json``.

    Raises
    ------
    ValueError
        When there are no several workers to compare with one, or no core for each.
    """
    cores = len(os.sched_getaffinity(0))
    if not 2 <= workers <= cores:
        raise ValueError(f"workers is {workers}; expected two or more, to compare with one, and no more than the {cores} cores")
    ran: dict[float, Rows] = {}
    side_by_side = 0.0
    for part in PARTS:
        with tempfile.TemporaryDirectory() as folder:
            catalogue = Path(folder) / "catalogue"
            submin_json("simulate", "china", "--out", catalogue, "--scale", part * scale, "--workers", workers)
            ways = ((workers, None), (1, None), (1, 1), (workers, None)) if part == ALONE else ((workers, None),)
            ran[part] = [_ran(catalogue, Path(folder) / f"network-{k}", part, *way) for k, way in enumerate(ways)]
            side_by_side = side_by_side or _side_by_side(catalogue, Path(folder), workers)
    several, one, one_core, several_again = (row["seconds"] for row in ran[ALONE])
    by_part = [of_part[0] for of_part in ran.values()]
    times, stage_one, memory = ([row[column] for row in by_part] for column in ("ms a block", STAGE_ONE, "peak, MB"))
    at_one_speed = [time * stage_one[0] / taken for time, taken in zip(times, stage_one, strict=True)]
    every = [
        *(row for of_part in ran.values() for row in of_part),
        _claim(f"{workers} workers against one, {ALONE:.2f} of China", one / fmean([several, several_again]), SPEED_UP, above=True),
        _claim(f"{workers} workers against one that shares a core with the coordinator", one_core / fmean([several, several_again]), None),
        _claim(f"{workers} runs at once, a core each, against one: what the machine gives", side_by_side, None),
        _claim("time a block, most to least", max(times) / min(times), TIME_SPREAD),
        _claim("the same, as fast as the machine was in the first part", max(at_one_speed) / min(at_one_speed), TIME_SPREAD),
        _claim("peak memory, most to least", max(memory) / min(memory), MEMORY_SPREAD),
    ]
    if out is not None:
        write_record(out, "scaling", scale, workers, every)
    return every


def _side_by_side(catalogue: Path, folder: Path, runs: int) -> float:
    """How many times what one run does on a core so many do that have a core each, at once."""

    def seconds(core: int) -> float:
        network = folder / f"network-of-core-{core}"
        submin_json("create", network, "--fit", catalogue, "--overlap-km", OVERLAP_KM)
        ran = submin_json(*_run(catalogue, network, 1), cores=[core])
        shutil.rmtree(network)
        return float(ran["seconds"])

    alone = seconds(0)
    with ThreadPoolExecutor(runs) as pool:
        return sum(alone / one for one in pool.map(seconds, range(runs)))


def _run(catalogue: Path, network: Path, workers: int) -> tuple[object, ...]:
    return "run", catalogue, network, "--workers", workers, "--batch-blocks", BATCH_BLOCKS, "--no-reconcile"


def _ran(catalogue: Path, network: Path, part: float, workers: int, cores: int | None) -> dict[str, Any]:
    submin_json("create", network, "--fit", catalogue, "--overlap-km", OVERLAP_KM)
    ran = submin_json(*_run(catalogue, network, workers), cores=None if cores is None else range(cores))
    outside = submin_json("reconcile", network, "--workers", workers)
    shutil.rmtree(network)  # three Chinas take 30 GB
    blocks = ran["blocks_fused"]
    stage_one, judged = ran["tasks"]["adjust"]["processor_seconds"], ran["tasks"]["update-tile"]
    return {
        "part of China": part, "blocks": blocks, "workers": workers, "cores": cores or ALL, "seconds": ran["seconds"],
        "blocks/s": blocks / ran["seconds"],
        "ms a block": 1e3 * ran["seconds"] / blocks, STAGE_ONE: 1e3 * stage_one / blocks,
        "tiles judged a block": judged["tasks"] / blocks, "judging, ms of a processor a block": 1e3 * judged["processor_seconds"] / blocks,
        "peak, MB": ran["peak_memory_mb"],
        "of it the largest worker": max(task["peak_memory_mb"] for task in ran["tasks"].values()),
        "reconcile, s": outside["seconds"], "reconcile, ms a block": 1e3 * outside["seconds"] / blocks,
        "its peak, MB": outside["peak_memory_mb"], "largest front": outside["largest_front"],
    }  # fmt: skip


def _claim(what: str, ratio: float, limit: float | None, *, above: bool = False) -> dict[str, Any]:
    if limit is None:
        return {"ratio": what, "wanted": "", "found": ratio, "verdict": DATA}
    met = ratio >= limit if above else ratio <= limit
    return {"ratio": what, "wanted": f"{'at least' if above else 'at most'} {limit:g}", "found": ratio, "verdict": verdict(met)}
