"""One sub-MIN as a piece of numerical work: what it weighs, what a batch costs, and when one block is cheaper as a low-rank update.

Seconds are of processor time on one thread, the best of a few repetitions. Rates are beside LAPACK and BLAS alone, of the same size, in the
same run.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from benchmarks.comparison import MET, NOT_MET
from benchmarks.factored_drift import drift
from benchmarks.tile_scene import PER_TRIPLET, TileScene, tile_scene
from submin.adjustment.elimination import Sums
from submin.network.cell import Cell, factors, summed
from submin.network.low_rank import fuse, new_rays, refactored, update
from submin.network.sub_min import GroundPart, SubMin, add_sums, covariances_of, factor, loadings

Array = NDArray[np.float64]

POINTS, TRIPLETS, ARRIVING = 37_500, 117, 100
"""Of which 30,000 points are seen, by 351 images, 8 rays each; then come 300 images."""
ALLOWED_MB, ALLOWED_SECONDS, ALLOWED_DRIFT = 400.0, 3.0, 1e-8
SIZES = (1000, 2000, 3500)
BATCHES = (1, 2, 4, 8, 16)


class Timed(NamedTuple):
    """What came out, processor seconds, and the peak of memory above what there was, bytes."""

    result: Any
    seconds: float
    peak: int


def measure(scale: float, workers: int) -> list[dict[str, Any]]:
    """Tables of the batch, of the crossover, and of the drift."""
    return [*_batch(scale), *_crossover(scale), *_drift(scale)]


def _timed(work: Callable[[], Any], repeats: int = 3) -> Timed:
    tracemalloc.start()
    result = work()  # compiled and warm
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    del result
    result = work()
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    best = np.inf
    for _ in range(repeats):
        started = time.process_time()
        work()
        best = min(best, time.process_time() - started)
    return Timed(result, float(best), peak)


def _row(what: str, size: int, timed: Timed, gigaflop: float | None = None) -> dict[str, Any]:
    return {
        "what": what, "size": size, "seconds": timed.seconds, "peak MB": timed.peak / 1e6,
        "Gflop/s": "" if gigaflop is None else gigaflop / timed.seconds,
    }  # fmt: skip


def _lapack(size: int) -> Timed:
    matrix = np.asfortranarray(np.eye(size) * size + 1.0)

    def work() -> None:
        lower, _ = la.lapack.dpotrf(matrix, lower=1, clean=0)
        la.lapack.dpotri(lower, lower=1, overwrite_c=1)

    return _timed(work)


def _product(size: int) -> Timed:
    one, other = np.ones((size, size)), np.ones((size, size))
    return _timed(lambda: one @ other)


def _factored(cell: Cell, scene: TileScene) -> SubMin:
    return factor(_sums(cell), cell.images, scene.images.take(cell.images))


def _sums(cell: Cell) -> Sums:
    return add_sums([(cell.images, cell.sums)], cell.images, cell.theta.shape[1])


def _ground(cell: Cell, scene: TileScene, points: NDArray[np.int64]) -> GroundPart:
    linear, found = factors(cell, scene.images.take(cell.images), points)
    return GroundPart(cell.origin[points], replace(linear, image=cell.images[linear.image]), found)


def _every_covariance(cell: Cell, scene: TileScene, state: SubMin) -> Array:
    """Covariance of each determined point of a cell by itself."""
    part = _ground(cell, scene, np.flatnonzero(_determined(cell)))
    return covariances_of(part, state)


def _determined(cell: Cell) -> NDArray[np.bool_]:
    return np.bincount(cell.rays.point, minlength=len(cell)) >= 2


def _weight(*things: object) -> float:
    """Bytes of all arrays in some values and the values in them."""
    total = 0.0
    for thing in things:
        if isinstance(thing, np.ndarray):
            total += thing.nbytes
        elif isinstance(thing, sp.csr_array):
            total += thing.data.nbytes + thing.indices.nbytes + thing.indptr.nbytes
        elif is_dataclass(thing):
            total += _weight(*(getattr(thing, field.name) for field in fields(thing)))
    return total


def _batch(scale: float) -> list[dict[str, Any]]:
    """A tile of 30,000 points, and a batch of 100 triplets that is fused into it."""
    earlier, arriving = max(4, round(TRIPLETS * scale)), max(2, round(ARRIVING * scale))
    scene = tile_scene(max(400, round(POINTS * scale)), earlier, arriving, 7.6)
    started = scene.cell(scene.earlier)
    cell = summed(started, scene.images.take(started.images))
    state = _factored(cell, scene)
    part = _ground(cell, scene, np.arange(len(cell)))
    kept = _weight(cell, state, loadings([part], state.images, state.theta.shape[1]), part.factors.own, part.factors.offset)
    size = len(state.covariance)
    rows = [
        _row("factor: sums to covariance", size, _timed(lambda: _factored(cell, scene)), size**3 / 1e9),
        _row("  LAPACK potrf + potri alone", size, _lapack(size), size**3 / 1e9),
        _row("  dgemm", size, _product(size), 2.0 * size**3 / 1e9),
    ]
    grown = _timed(lambda: scene.grown(cell, scene.earlier, len(scene.images)))
    again = _timed(lambda: summed(grown.result, scene.images.take(grown.result.images)))
    total = _timed(lambda: _sums(again.result))
    whole = _timed(lambda: factor(total.result, again.result.images, scene.images.take(again.result.images)), 2)
    each = _timed(lambda: _every_covariance(again.result, scene, whole.result))
    larger = len(whole.result.covariance)
    rows += [
        _row(f"batch of {arriving} triplets: points out and in", len(grown.result.rays), grown),
        _row("batch: linearise and sum all rays", len(again.result.rays), again),
        _row("batch: add cells", larger, total),
        _row("batch: factor", larger, whole, larger**3 / 1e9),
        _row("  LAPACK potrf + potri alone", larger, _lapack(larger), larger**3 / 1e9),
        _row("batch: all 3x3 covariances", len(each.result), each),
    ]
    seconds = sum(step.seconds for step in (grown, again, total, whole, each))
    peak = max(step.peak for step in (grown, again, total, whole, each))
    held = f"cell, sub-MIN and loadings of {len(cell):,} points, {len(cell.rays) / len(cell):.1f} rays each, {len(cell.images)} images"
    came = f"batch of {arriving} triplets, {len(grown.result.rays) - len(cell.rays):,} rays, with all 3x3 covariances"
    return [
        *rows,
        _claim(held, "MB", kept / 1e6, ALLOWED_MB),
        _claim(came, "s", seconds, ALLOWED_SECONDS),
        _claim("  peak above the state before it", "MB", peak / 1e6, None),
    ]


def _claim(what: str, unit: str, found: float, allowed: float | None) -> dict[str, Any]:
    verdict = "" if allowed is None else MET if found <= allowed else NOT_MET
    return {"claim": what, "unit": unit, "found": found, "allowed": "" if allowed is None else allowed, "verdict": verdict}


def _crossover(scale: float) -> list[dict[str, Any]]:
    """Low-rank update against one factorisation, by parameters and rank."""
    rows = []
    for size in SIZES:
        earlier = max(4, round(size * scale / 6 / PER_TRIPLET))
        scene = tile_scene(max(400, 320 * earlier), earlier, max(BATCHES), 7.6)
        started = scene.cell(scene.earlier)
        cell = summed(started, scene.images.take(started.images))
        state = _factored(cell, scene)
        for triplets in BATCHES:
            grown = scene.grown(cell, scene.earlier, scene.earlier + PER_TRIPLET * triplets)
            images = scene.images.take(grown.images)
            rays = new_rays(grown, images, grown.images >= scene.earlier)
            arguments = rays, grown.images, images
            low = _timed(partial(update, state, *arguments))
            anew = _timed(partial(refactored, state, *arguments, partial(_sums, cell)))
            chosen = fuse(state, *arguments, partial(_sums, cell))
            sigma = np.sqrt(np.diagonal(anew.result.sub_min.covariance))
            difference = (low.result.sub_min.covariance - anew.result.sub_min.covariance) / sigma / sigma[:, None]
            rows.append({
                "parameters": len(sigma), "triplets": triplets, "new rays": int(rays.coming.sum()), "rank": low.result.rank,
                "rank / parameters": low.result.rank / len(sigma), "low-rank ms": 1e3 * low.seconds, "factor ms": 1e3 * anew.seconds,
                "ratio": low.seconds / anew.seconds, "chosen": "low-rank" if chosen.low_rank else "factor",
                "difference": float(np.abs(difference).max()),
            })  # fmt: skip
    return rows


def _drift(scale: float) -> list[dict[str, Any]]:
    """1,000 blocks fused one after another on 1,000 points."""
    blocks = max(10, round(1000 * scale))
    found = drift(blocks, blocks)
    what = f"{blocks:,} blocks one after another on {blocks:,} points"
    rows = [
        _claim(f"{what}: {name}", "relative", value, ALLOWED_DRIFT)
        for name, value in (("corrections", found.theta), ("covariance", found.covariance), ("chi-square", found.chi_square))
    ]
    sound = found.symmetric and found.definite == found.steps
    return [*rows, {**_claim(f"{what}: positive definite", "steps", found.definite, None), "verdict": MET if sound else NOT_MET}]
