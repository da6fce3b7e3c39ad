"""A continent in one run: simulated ZY-3 over China (`submin.simulation.china`) through the product's own commands.

At full scale 26,406 images in 8,802 triplets, 3 million points, 17.6 million rays, with the honest prior: half of the variance of 15 m
common to a pass. From the catalogue to a committed network, then what lies outside of every tile, then some more triplets into the
finished network, one after another. The network's own linearised system is then solved once by a sparse direct solver, and compared. At
last other realisations at a tenth of the size: whether the stated accuracy is true.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import submin
from benchmarks.china_figure import plot
from benchmarks.comparison import below, between, data, verdict
from benchmarks.held_back import held_back
from benchmarks.peers_outcome import relative_difference
from benchmarks.product import submin_json
from benchmarks.record import write_record
from benchmarks.sparse_adjustment import SparseAdjustment, adjusted_points, located
from orchestration.executors import executor_for
from orchestration.run import run
from submin.geodesy import geodetic_to_geocentric, local_axes, rotate_covariance
from submin.query.planner import points_of_tile
from submin.query.warm_up import compile_kernels
from submin.storage.catalogue import Catalogue

Rows = list[dict[str, Any]]

RUN_SECONDS, RECONCILE_SECONDS, TRIPLET_SECONDS, MEMORY_MB = 240.0, 120.0, 2.0, 8192.0
AGREE, SAMPLED = 1e-6, 1000
STAGE_NAMES = ("catalogue simulated", "run, catalogue to committed network", "reconcile", "one more triplet, committed: median")
STREAMED = 5
"""Triplets that come one at a time, from all over the area: one alone says little where a stall of the disk can take seconds."""
OVERLAP_KM = 0.0
"""Once tiles are reconciled an overlap adds nothing, and it costs: its rays are judged by every tile that holds them."""
SEEDS = 20
"""Most points of an area share their error: drawn from the stated covariance itself, one has 89 % within CE90, plus or minus 13."""
TENTH = 0.1
WITHIN = (85.0, 95.0)
"""Per cent of check points within the stated CE90 and LE90, over all realisations."""


def measure(scale: float, workers: int, out: Path | None = None) -> Rows:
    """Rows of the stages, of the tasks, of what was found, and of the realisations; ``scale`` is the part of China.

    ``out``: folder for ``china.json`` and ``china.png``.
    """
    with tempfile.TemporaryDirectory() as folder:
        rows, tasks, found = whole(Path(folder), scale, workers)
    every = [*rows, *tasks, *found, *_realisations(scale * TENTH, workers)]
    if out is not None:
        write_record(out, "china", scale, workers, every)
        plot(every, workers, out)
    return every


def whole(folder: Path, scale: float, workers: int) -> tuple[Rows, Rows, Rows]:
    """Rows of the stages, of their tasks, and of what was found, of one part of China."""
    catalogue, network = folder / "catalogue", folder / "network"
    made = submin_json("simulate", "china", "--out", catalogue, "--scale", scale, "--workers", workers)
    places = np.unique((made["blocks"] * (np.arange(STREAMED) + 0.5) / STREAMED).astype(int)).tolist()
    singles = held_back(catalogue, places, folder / "rest", folder / "singles")
    submin_json("create", network, "--fit", catalogue, "--overlap-km", OVERLAP_KM)
    ran = submin_json("run", folder / "rest", network, "--workers", workers, "--no-reconcile")
    outside = submin_json("reconcile", network, "--workers", workers)
    checked = submin_json("check", network, catalogue / "check.parquet")
    solved = against_direct_solver(network)
    streamed = [one_more(single, network) for single in singles]
    full = scale >= 1.0
    blocks = ran["blocks_fused"]
    rows = [
        _stage(STAGE_NAMES[0], made["blocks"], made["seconds"], made["peak_memory_mb"], None),
        _stage(STAGE_NAMES[1], blocks, ran["seconds"], ran["peak_memory_mb"], RUN_SECONDS if full else None),
        _stage(STAGE_NAMES[2], blocks, outside["seconds"], outside["peak_memory_mb"], RECONCILE_SECONDS if full else None),
        _stage(STAGE_NAMES[3], 1, float(np.median(streamed)), None, TRIPLET_SECONDS),
    ]
    tasks = [*_tasks("run", ran["tasks"]), *_tasks("reconcile", outside["tasks"])]
    found = [
        *solved,
        *(data(f"one more triplet, number {k}, seconds", "", seconds) for k, seconds in enumerate(streamed, start=1)),
        below("mosaic discrepancy of two images, pixels", 1.0, ran["ray_rms_px"] * np.sqrt(2.0)),
        data("check points, plane: 90 % of errors below, metres", "", checked["horizontal"]["p90"]),
        data("check points, height: 90 % of errors below, metres", "", checked["vertical"]["p90"]),
        data("check points, NEES per degree of freedom (one realisation)", "", checked["nees_per_dof"]),
    ]
    return rows, tasks, found


def against_direct_solver(place: Path) -> Rows:
    """The network's own system solved once, against what tiles say: all coordinates, and covariances of some points."""
    network = submin.open(place)
    started = time.perf_counter()
    solution = SparseAdjustment.of(network.snapshot)
    seconds = time.perf_counter() - started
    every = network.accuracy()
    metres, tile_of = 0.0, {network.cover.tile_name(tile): tile for tile in network.snapshot.tile_numbers()}
    for name in np.unique(every.tile).tolist():
        told = every.take(np.flatnonzero(every.tile == name))
        ids, at = located(network, solution, points_of_tile(network, tile_of[name], core=True))
        order = np.argsort(told.ids)
        if not np.array_equal(told.ids[order], ids):
            raise RuntimeError(f"tile {name} answers for other points than its core holds")
        metres = max(metres, float(np.abs(geodetic_to_geocentric(told.geodetic[order]) - at).max()))
    some = every.take(np.sort(np.random.default_rng(2).choice(len(every), min(SAMPLED, len(every)), replace=False)))
    direct = adjusted_points(network, solution, network.named(some.ids))
    order = np.argsort(some.ids)
    covariance = rotate_covariance(some.local_covariance, local_axes(some.geodetic).transpose(0, 2, 1))[order]
    return [
        data(f"its own linear system solved once ({solution.factor.solver}), seconds", "", seconds),
        below("coordinates after reconciliation against it, all points, metres", AGREE, metres),
        below(f"3x3 covariances of {len(some):,} points against it, relative", AGREE, relative_difference(covariance, direct.covariance)),
    ]


def one_more(catalogue: Path, network: Path) -> float:
    """Seconds from the measurements of one block to the committed version that holds it; without a cluster, kernels loaded."""
    compile_kernels()
    with executor_for() as executor:
        started = time.perf_counter()
        done = run(Catalogue.open(catalogue), str(network), executor)
        seconds = time.perf_counter() - started
    if done.fused != 1:
        raise RuntimeError(f"{done.fused} blocks fused; expected the one that was held back: {done.rejected}")
    return seconds


def _stage(what: str, blocks: int, seconds: float, peak_mb: float | None, wanted: float | None) -> dict[str, Any]:
    met = (wanted is None or seconds <= wanted) and (peak_mb is None or peak_mb <= MEMORY_MB)
    return {
        "stage": what, "blocks": blocks, "seconds": seconds, "wanted, s": "" if wanted is None else wanted,
        "ms a block": 1e3 * seconds / blocks, "peak, MB": "" if peak_mb is None else peak_mb,
        "verdict": "" if wanted is None else verdict(met),
    }  # fmt: skip


def _tasks(stage: str, tasks: Mapping[str, Mapping[str, Any]]) -> Rows:
    return [
        {
            "of": stage, "task": name, "tasks": of["tasks"], "seconds of all": of["seconds"], "processor, s": of["processor_seconds"],
            "longest, s": of["longest"], "peak of a process, MB": of["peak_memory_mb"],
        }
        for name, of in sorted(tasks.items(), key=lambda item: -item[1]["seconds"])
    ]  # fmt: skip


def _realisations(scale: float, workers: int) -> Rows:
    """Other seeds: per cent within the stated accuracy, and NEES, of each and of all."""
    every: list[Mapping[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(1, SEEDS + 1):
            catalogue, network = Path(folder) / f"catalogue-{seed}", Path(folder) / f"network-{seed}"
            submin_json("simulate", "china", "--out", catalogue, "--scale", scale, "--seed", seed, "--workers", workers)
            submin_json("create", network, "--fit", catalogue, "--overlap-km", OVERLAP_KM)
            submin_json("run", catalogue, network, "--workers", workers)
            every.append(submin_json("check", network, catalogue / "check.parquet"))
    rows = [
        {
            "seed": seed, "check points": of["points"], "plane, 90 %": of["horizontal"]["p90"], "mean CE90": of["horizontal"]["mean_ce90"],
            "within, %": of["horizontal"]["per_cent_within"], "height, 90 %": of["vertical"]["p90"],
            "mean LE90": of["vertical"]["mean_le90"], "within, % ": of["vertical"]["per_cent_within"], "NEES": of["nees_per_dof"],
        }
        for seed, of in enumerate(every, start=1)
    ]  # fmt: skip
    plane, height = (float(np.mean([of[axis]["per_cent_within"] for of in every])) for axis in ("horizontal", "vertical"))
    return [
        *rows,
        between("check points within CE90, mean of the seeds, %", *WITHIN, plane),
        between("check points within LE90, mean of the seeds, %", *WITHIN, height),
        data("NEES per degree of freedom, mean of the seeds", "1", float(np.mean([of["nees_per_dof"] for of in every]))),
    ]
