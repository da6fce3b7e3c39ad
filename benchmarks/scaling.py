"""What more workers and more area do to a run: blocks per second for one and for two workers, and for parts of China up to three of it.

Time and memory of a run must follow the number of blocks and nothing else: batches are of one size, and what is kept of the catalogue
while one is worked on is one batch more.
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
    times, memory = [row["ms a block"] for row in by_part], [row["peak, MB"] for row in by_part]
    every = [
        *rows,
        _claim(f"{workers} workers against one, {ALONE:.2f} of China", one["seconds"] / several["seconds"], SPEED_UP, above=True),
        _claim("time a block, most to least", max(times) / min(times), TIME_SPREAD),
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
    return {
        "part of China": part, "blocks": blocks, "workers": workers, "seconds": ran["seconds"], "blocks/s": blocks / ran["seconds"],
        "ms a block": 1e3 * ran["seconds"] / blocks, "peak, MB": ran["peak_memory_mb"], "reconcile, s": outside["seconds"],
        "reconcile, ms a block": 1e3 * outside["seconds"] / blocks, "its peak, MB": outside["peak_memory_mb"],
        "largest front": outside["largest_front"],
    }  # fmt: skip


def _claim(what: str, ratio: float, limit: float, *, above: bool = False) -> dict[str, Any]:
    met = ratio >= limit if above else ratio <= limit
    return {"ratio": what, "wanted": f"{'at least' if above else 'at most'} {limit:g}", "found": ratio, "verdict": verdict(met)}
