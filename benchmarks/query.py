"""Small questions to a large network: how long a joint covariance of 100 points takes, in one tile and across two, and the map of all.

The network is a simulated region (`submin.simulation.region`), made by the product's own `create` and `run`: at full scale 144 tiles and
510,000 points with seven rays each. What the columns mean:

warm : the network is open and has answered for *other* points of the same tiles; the median of all questions asked, and the slowest
cold : a network opened anew (`submin.open`) for one question, opening included. Nothing else is dropped: modules are imported, compiled
    kernels are loaded, and the files may be in the system's cache
new process : the same as the first question of a process, after its imports: kernels that were compiled before are loaded from their cache
CPU : milliseconds of the processor, all threads together; on a machine that does other things beside they say more than the clock
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import submin
from benchmarks.comparison import verdict
from benchmarks.record import write_record
from orchestration.create import create, fit_catalogue
from orchestration.executors import executor_for
from orchestration.reconcile import reconcile
from orchestration.run import run
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.accuracy_map import PointAccuracy
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import write_region

Ids = NDArray[np.str_]
Times = tuple[float, float]

SIDE_KM = 1000.0
SPACING_KM = 1.4
TILE_KM, OVERLAP_KM = 100.0, 50.0
ASKED = 100
"""Points of a small question."""
MAPPED = 100_000
THINNED = 14_400
PLACES = 4
QUESTIONS = 8
"""Warm questions at each place."""


@dataclass(frozen=True)
class Case:
    """Points by their ids, one array a question, that are asked for in one way."""

    what: str
    policy: str
    places: list[list[Ids]]
    warm_ms: float | None
    cold_ms: float | None


def measure(scale: float, workers: int, network: Path | None = None, out: Path | None = None) -> list[dict[str, Any]]:
    """Rows of the network and of the questions; ``network``: one that is there already, in place of a new one.

    It is asked as it is, and once more after it has been reconciled, which is done here where it was not. ``out``: folder for
    ``query.json``.
    """
    rows = _rows(scale, workers, network)
    if out is not None:
        write_record(out, "query", scale, workers, rows)
    return rows


def _rows(scale: float, workers: int, network: Path | None) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        place, seconds = (str(network), float("nan")) if network is not None else _made(Path(folder), scale, workers)
        opened = submin.open(place)
        every = opened.accuracy()
        cells = opened.cell_numbers()
        rng = np.random.default_rng(0)
        rows: list[dict[str, Any]] = [{
            "network": "simulated region" if network is None else network.name, "points": len(every), "rays": int(every.rays.sum()),
            "images": opened.snapshot.image_count(), "tiles": len(opened.snapshot.tile_numbers()), "cells": len(cells),
            "made in, s": seconds,
        }]  # fmt: skip
        rows += [_asked(place, case) for case in _cases(opened, rng)]
        rows += _of_many(place, opened)
        with executor_for(workers) as executor:
            done = reconcile(place, executor)
        if not done.tiles:
            return rows
        again = [case for case in _cases(submin.open(place), np.random.default_rng(0)) if case.policy in ("tile", "rigorous")]
        rows += [_asked(place, replace(case, what=f"{case.what}, reconciled")) for case in again]
        return [*rows, _accuracy_of_many(place, submin.open(place)), {
            "reconciled": done.version, "tiles": done.tiles, "largest front": done.largest_front, "s": done.seconds,
            "peak, MB": done.peak_memory_mb,
        }]  # fmt: skip


def _made(folder: Path, scale: float, workers: int) -> tuple[str, float]:
    """A network of a part of the full area, and the seconds that simulation and run took."""
    started = time.perf_counter()
    side = SIDE_KM * scale**0.5
    region = simulate_region(RegionDesign(width_km=side, height_km=side, point_spacing_km=SPACING_KM, bad_cameras=0))
    write_region(region, folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    area, _, _ = fit_catalogue(catalogue)
    create(str(folder / "network"), area, catalogue.metadata, TILE_KM, OVERLAP_KM)
    with executor_for(workers) as executor:
        run(catalogue, str(folder / "network"), executor)
    return str(folder / "network"), time.perf_counter() - started


def _cases(network: submin.Network, rng: np.random.Generator) -> list[Case]:
    """Small questions: near each other and spread, in one tile and in two."""
    cover, existing = network.cover, set(network.cell_numbers())
    inner = [
        t for t in network.snapshot.tile_numbers()
        if {t, *cover.neighbours(t)} <= set(network.snapshot.tile_numbers()) and len(cover.neighbours(t)) == 8
    ]  # fmt: skip
    tiles = inner or list(network.snapshot.tile_numbers())
    tiles = [tiles[k] for k in np.linspace(0, len(tiles) - 1, min(PLACES, len(tiles))).astype(int)]
    pairs = [(t, t + 1 if t + 1 in cover.neighbours(t) else cover.neighbours(t)[0]) for t in tiles]

    def points_of(cells: Sequence[int]) -> tuple[Ids, NDArray[np.float64]]:
        found = [network.cell(cell) for cell in cells if cell in existing]
        ids = np.concatenate([np.empty(0, dtype="U1"), *(cell.point_ids for cell in found)])
        known = network.cells_of_points(ids)
        answered = np.isin(ids, np.concatenate([np.empty(0, dtype="U1"), *known.values()]))
        return ids[answered], np.concatenate([np.empty((0, 3)), *(cell.linearised_at for cell in found)])[answered]

    def near(ids: Ids, at: NDArray[np.float64], count: int) -> Ids:
        """Points around one of them."""
        distance = np.linalg.norm(at - at[rng.integers(len(at))], axis=1)
        return ids[np.argsort(distance)[:count]]

    def alone(tile: int) -> tuple[Ids, NDArray[np.float64]]:
        """Points that no other tile holds: those of two tiles concern these two, and no one tile holds them."""
        return points_of([cell for cell in cover.cells_owned(tile) if cover.holders(cell) == (tile,)])

    one_near, one_spread, two_near, two_spread = [], [], [], []
    for tile, other in pairs:
        ids, at = points_of(cover.cells_owned(tile))
        one_near.append([near(ids, at, ASKED) for _ in range(QUESTIONS + 1)])
        one_spread.append([rng.choice(ids, min(ASKED, len(ids)), replace=False) for _ in range(QUESTIONS + 1)])
        both = [alone(tile), alone(other)]
        if min(len(ids) for ids, _ in both) < ASKED:
            continue
        half = ASKED // 2
        two_near.append([np.concatenate([near(ids, at, half) for ids, at in both]) for _ in range(QUESTIONS + 1)])
        two_spread.append([np.concatenate([rng.choice(ids, half, replace=False) for ids, _ in both]) for _ in range(QUESTIONS + 1)])
    cases = [
        Case("in one tile, near each other", "tile", one_near, 50.0, 200.0),
        Case("in one tile, over all of its core", "tile", one_spread, 50.0, 200.0),
    ]
    for policy, warm, cold in (("ci", 100.0, 5000.0), ("rigorous", 300.0, None)):
        cases += [
            Case("in two tiles, near each other in each", policy, two_near, warm, cold),
            Case("in two tiles, over all of both", policy, two_spread, warm, cold),
        ]
    return [case for case in cases if case.places]


def _asked(place: str, case: Case) -> dict[str, Any]:
    """Times of one kind of question."""
    cold: list[Times] = []
    warm: list[Times] = []
    tiles = 0
    for first, second, *others in case.places:
        _anew(place, first, case.policy)
        cold.append(_milliseconds(_anew, place, first, case.policy))
        network = submin.open(place)
        tiles = max(tiles, len(_answer(network, first, case.policy).tiles))
        _answer(network, second, case.policy)
        warm += [_milliseconds(_answer, network, ids, case.policy) for ids in others]
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        new = process.submit(_milliseconds, _anew, place, case.places[0][0], case.policy).result()
    return _row(f"{ASKED} points {case.what}", case.policy, ASKED, tiles, warm, case.warm_ms, cold, case.cold_ms, new)


def _answer(network: submin.Network, ids: Ids, policy: str) -> submin.ControlSet:
    return network.query(points=ids, policy=policy)


def _anew(place: str, ids: Ids, policy: str) -> submin.ControlSet:
    return _answer(submin.open(place), ids, policy)


def _box(network: submin.Network, points: int) -> tuple[float, float, float, float]:
    """About so many points around the middle."""
    cover = network.cover
    low = np.asarray(cover.origin)
    middle = low + 0.5 * cover.core * np.array([cover.columns, cover.rows])
    half = 0.5 * 1e3 * SPACING_KM * points**0.5
    lon, lat = cover.geographic(middle[0] + np.array([-half, half]), middle[1] + np.array([-half, half]))
    return float(lon[0]), float(lat[0]), float(lon[1]), float(lat[1])


def _accuracy_of_many(place: str, network: submin.Network) -> dict[str, Any]:
    """Accuracy point by point."""
    ask = partial(submin.Network.accuracy, bbox=_box(network, MAPPED))
    return _repeated(place, "CE90 and LE90 point by point", "tile", 500.0, ask)


def _of_many(place: str, network: submin.Network) -> list[dict[str, Any]]:
    """A few points out of many, and accuracy point by point."""
    thinned = _box(network, THINNED)
    few = f"--max-points {ASKED} of {len(network.accuracy(bbox=thinned)):,}"
    return [
        _repeated(place, few, "rigorous", None, partial(submin.Network.query, bbox=thinned, max_points=ASKED, policy="rigorous")),
        _accuracy_of_many(place, network),
        _repeated(place, "CE90 and LE90 of all points", "tile", None, submin.Network.accuracy),
    ]


def _repeated(
    place: str, what: str, policy: str, allowed: float | None, ask: Callable[[submin.Network], submin.ControlSet | PointAccuracy]
) -> dict[str, Any]:  # fmt: skip
    """Times of one question, asked again and again."""
    cold = [_milliseconds(lambda: ask(submin.open(place)))]
    network = submin.open(place)
    count = len(ask(network))
    ask(network)  # a tile that is asked for again is kept
    return _row(what, policy, count, 0, [_milliseconds(ask, network) for _ in range(3)], allowed, cold, None, None)


def _row(
    what: str, policy: str, points: int, tiles: int, warm: list[Times], warm_ms: float | None, cold: list[Times], cold_ms: float | None,
    new: Times | None,
) -> dict[str, Any]:  # fmt: skip
    of_warm, of_cold = np.median(warm, axis=0).tolist(), np.median(cold, axis=0).tolist()
    met = (warm_ms is None or of_warm[0] < warm_ms) and (cold_ms is None or of_cold[0] < cold_ms)
    return {
        "question": what, "policy": policy, "points": points, "tiles": tiles or "",
        "warm, ms": of_warm[0], "slowest": max(warm)[0], "CPU": of_warm[1], "wanted": "" if warm_ms is None else warm_ms,
        "cold, ms": of_cold[0], "CPU, cold": of_cold[1], "wanted, cold": "" if cold_ms is None else cold_ms,
        "new process, ms": "" if new is None else new[0], "CPU, new": "" if new is None else new[1],
        "verdict": "" if warm_ms is None and cold_ms is None else verdict(met),
    }  # fmt: skip


def _milliseconds(work: Callable[..., object], *arguments: object) -> Times:
    """Milliseconds by the clock, and of the processor for all threads of this process."""
    clock, processor = time.perf_counter(), time.process_time()
    work(*arguments)
    return 1e3 * (time.perf_counter() - clock), 1e3 * (time.process_time() - processor)
