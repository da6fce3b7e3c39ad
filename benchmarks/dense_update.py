"""One update of a dense network against BLAS's own symmetric update of that size; and the digits that a thousand updates leave."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from benchmarks.comparison import below, data
from submin.network.dense_sub_min import DenseSubMin
from submin.network.observations import Cluster
from submin.network.triangle import Triangle

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

POINTS, ELEMENTS, ROUNDS = 5000, 100, 7
PAPER_SECONDS = 1000.0
DRIFT_POINTS, DRIFT_BLOCKS, DRIFT_POINTS_A_BLOCK = 1000, 1000, 20


def measure(scale: float, workers: int) -> list[dict[str, Any]]:
    """Rows of the update against BLAS in the same run, and of the drift of many updates; ``scale``: part of the points and blocks."""
    return [*_update(max(int(POINTS * scale), 100)), *_drift(max(int(DRIFT_POINTS * scale), 40), max(int(DRIFT_BLOCKS * scale), 20))]


def _update(points: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    n = 3 * points
    state, ids = _state(rng, points), np.array([f"p{k:05d}" for k in range(points)])
    blocks = [_positions(rng, state, f"block {k}", np.sort(rng.choice(ids, -(-ELEMENTS // 3), replace=False))) for k in range(ROUNDS + 1)]
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    state.fuse(blocks.pop())
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()

    square = np.zeros((n, n), order="F")
    square[np.diag_indices(n)] = 1.0
    w = np.asfortranarray(1e-3 * rng.normal(size=(ELEMENTS, n)))
    syrk, fuse = [], []
    for block in blocks:  # side by side: what else the machine does concerns both alike
        syrk.append(_seconds(lambda: la.blas.dsyrk(-1.0, w, 1.0, square, trans=1, overwrite_c=1)))
        fuse.append(_seconds(lambda block=block: state.fuse(block)))  # type: ignore[misc]
    ratios = np.array(fuse) / np.array(syrk)
    plain = _seconds(lambda: _numpy_update(square, w))
    baselines = _seconds(lambda: state.fuse(_baselines(rng, state, "baselines", rng.choice(ids, 2 * -(-ELEMENTS // 3), replace=False))))
    triangle = 4.0 * n * (n + 1)
    stored = float(state.triangle.nbytes)
    size = f"{points:,} points, {ELEMENTS} elements"
    if points < POINTS:  # what is asked for is asked of the full size: a small update is all calls and panels
        return [data(f"whole update over in-place dsyrk, {size}, median of the rounds", "full size: 1.3 or less", float(np.median(ratios)))]
    return [
        below(f"whole update, {size}: seconds (the paper: {PAPER_SECONDS:,.0f})", PAPER_SECONDS, min(fuse)),
        data("in-place dsyrk of the same size, seconds", "best of the same rounds", min(syrk)),
        below("whole update over in-place dsyrk, median of the rounds", 1.3, float(np.median(ratios))),
        below("whole update over in-place dsyrk, best of each", 1.3, min(fuse) / min(syrk)),
        data("the same block as baselines (any linear observations), seconds", "for comparison", baselines),
        data("numpy P -= W.T @ W, seconds", "for comparison", plain),
        data("triangle of the covariance, MB", "n (n + 1) / 2 numbers", triangle / 1e6),
        below("stored over triangle", 1.15, stored / triangle),
        below("stored and made on the way, at the peak, over triangle", 1.15, (stored + peak) / triangle),
    ]  # fmt: skip


def _drift(points: int, blocks: int) -> list[dict[str, Any]]:
    """Blocks one after another against all at once: information summed over them, and one Cholesky factorisation."""
    rng = np.random.default_rng(1)
    state, ids = _state(rng, points), np.array([f"p{k:05d}" for k in range(points)])
    information = la.inv(state.covariance(np.arange(points)))
    vector = information @ state.adjustments
    origin, smallest, seconds = state.origins.copy(), np.inf, 0.0
    for k in range(blocks):
        block = _positions(rng, state, f"block {k}", np.sort(rng.choice(ids, min(DRIFT_POINTS_A_BLOCK, points), replace=False)))
        rows = state.rows_of(block.point_ids)
        at = (3 * rows[:, None] + np.arange(3)).ravel()
        weight = la.inv(block.covariance)
        information[np.ix_(at, at)] += weight
        vector[at] += weight @ (block.values - origin[rows]).ravel()
        seconds += _seconds(lambda block=block: state.fuse(block))  # type: ignore[misc]
        smallest = min(smallest, state.triangle.check_definite())  # raises where it fails
    factor = la.cho_factor(information, lower=True)
    covariance, x = la.cho_solve(factor, np.eye(len(vector))), la.cho_solve(factor, vector)
    sigma = np.sqrt(np.diag(covariance))
    difference = np.abs(state.covariance(np.arange(points)) - covariance) / np.outer(sigma, sigma)
    moved = np.abs(state.adjustments - x).max() / np.abs(x).max()
    size = f"{blocks:,} blocks of {DRIFT_POINTS_A_BLOCK} points one after another on {points:,} points"
    return [
        below(f"{size}: covariance against all at once, relative", 1e-8, float(difference.max())),
        below("positions against all at once, relative to their largest", 1e-8, float(moved)),
        data("Cholesky succeeded after every block; smallest pivot over round-off", "far above 1", smallest),
        data("milliseconds a block", "for comparison", 1e3 * seconds / blocks),
    ]  # fmt: skip


def _state(rng: np.random.Generator, points: int) -> DenseSubMin:
    """Points with errors in common (10 m, as of images) and of their own (1 m)."""
    n = 3 * points
    common = rng.normal(size=(n, 12)) * 10.0 / np.sqrt(12.0)
    triangle = Triangle()
    step = 300
    for low in range(0, n, step):
        rows = common[low : low + step]
        triangle.append(rows @ common[:low].T, rows @ rows.T + np.eye(len(rows)))
    origins = np.array([4e6, 1e6, 4.8e6]) + rng.uniform(-1e5, 1e5, (points, 3))
    ids = np.array([f"p{k:05d}" for k in range(points)])
    return DenseSubMin.restored(ids, origins, np.zeros(n), triangle, 0.0, 0, ())


def _covariance(rng: np.random.Generator, size: int) -> Array:
    root = rng.normal(size=(size, 6))
    return np.asarray(root @ root.T + np.eye(size))


def _positions(rng: np.random.Generator, state: DenseSubMin, name: str, ids: Ids) -> Cluster:
    values = state.origins[state.rows_of(ids)] + rng.normal(0.0, 2.0, (len(ids), 3))
    return Cluster(name, ids, np.full(len(ids), "", dtype="U1"), values, _covariance(rng, 3 * len(ids)))


def _baselines(rng: np.random.Generator, state: DenseSubMin, name: str, ids: Ids) -> Cluster:
    start, end = ids[::2], ids[1::2]
    values = state.origins[state.rows_of(end)] - state.origins[state.rows_of(start)] + rng.normal(0.0, 2.0, (len(start), 3))
    return Cluster(name, start, end, values, _covariance(rng, 3 * len(start)))


def _numpy_update(square: Array, w: Array) -> None:
    square -= w.T @ w


def _seconds(work: Callable[[], Any]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
