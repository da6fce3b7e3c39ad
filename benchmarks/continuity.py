"""Continuity: what a tile border does to the result, by merge policy and overlap, against the monolithic network of the same blocks.

Points about the borders are asked of the network by every policy. What is stated comes from the product; what is true of it is computed in
closed form from the network's own factors (`benchmarks.linear_estimates`), not from samples. ``naive`` merges tiles as if they were
independent: it is no policy of submin, and is there to be seen as inconsistent. What the rows mean: docs/continuity.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.border import (
    RECONCILED,
    RIGOROUS,
    TILE,
    Sheets,
    borders,
    radii,
)
from benchmarks.comparison import DATA, statement, verdict
from benchmarks.continuity_figures import plot
from benchmarks.continuity_measures import CONSISTENT, Measured, in_sigmas, of_scene
from benchmarks.continuity_scenes import JACKSONVILLE, SCENES, ZY3_AUSTRALIA
from benchmarks.record import write_record
from orchestration.executors import executor_for
from submin.accuracy import accuracy_against_truth
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

STRADDLE = {RIGOROUS: 1.01, RECONCILED: 1.0 + 1e-6}
"""Largest straddle ratio wanted of a policy."""
CONSISTENT_POLICIES = (TILE, "ci", "bci", "split", RIGOROUS, RECONCILED)
INCONSISTENT = 1.5
"""A naive merge must show at least so large an eigenvalue."""
SAME_METRES = 1e-6
PROFILES = ((ZY3_AUSTRALIA, 0.0), (ZY3_AUSTRALIA, 1.0))
MAPS = ((ZY3_AUSTRALIA, 0.0, TILE), (ZY3_AUSTRALIA, 1.0, TILE), (ZY3_AUSTRALIA, 1.0, RIGOROUS), (JACKSONVILLE, 0.25, TILE))
"""What figures show: scene, overlap in widths, and of maps the policy."""


def measure(scale: float, workers: int, out: Path | None = None) -> list[dict[str, Any]]:
    """Rows of all tables; ``scale`` is the part of each simulated area, ``out`` a folder for ``continuity.json`` and figures."""
    with tempfile.TemporaryDirectory() as folder, executor_for(workers) as executor:
        measured = [m for k, scene in enumerate(SCENES) for m in of_scene(scene, Path(folder) / str(k), scale, executor)]
        rows = [
            *(row for m in measured for row in border_rows(m)),
            *(row for m in measured for row in accuracy_rows(m)),
            *(row for m in measured for row in sheet_rows(m)),
            *(row for m in measured for row in m.singles),
            *claims(measured),
        ]
        if out is not None:
            plot(measured, PROFILES, MAPS, out)
            write_record(out, "continuity", scale, workers, rows)
        return rows


def border_rows(m: Measured) -> Iterator[dict[str, Any]]:
    """Steps and straddling pairs, by policy."""
    best = m.collected["monolithic"].straddle_quotient
    for policy, of in m.collected.items():
        ratio = of.straddle_quotient / best
        yield {
            "scene": m.scene.name, "overlap": m.overlap, "policy": policy, "pairs across": sum(map(len, of.straddling)),
            "step, m": _rms(of.step), "step, sigmas": _root_mean(of.step_sigmas), "straddle ratio": ratio,
            "relative CE stated / true": float(np.median(np.concatenate(of.relative_ce))),
            "difference, m RMS": _rms(of.difference), "largest": float(np.concatenate(of.difference).max()),
            "seconds": _known(np.median(of.seconds)),
            "verdict": verdict(ratio <= STRADDLE[policy]) if policy in STRADDLE else DATA,
        }  # fmt: skip


def accuracy_rows(m: Measured) -> Iterator[dict[str, Any]]:
    """Loss of accuracy and consistency, by policy."""
    for policy, of in m.collected.items():
        ce, le = np.concatenate(of.ce), np.concatenate(of.le)
        within = accuracy_against_truth(np.concatenate(of.error), np.concatenate(of.covariance)) if of.error else None
        largest = max(of.eigenvalue)
        yield {
            "scene": m.scene.name, "overlap": m.overlap, "policy": policy, "points": len(ce),
            "CE / monolithic, median": float(np.median(ce)), "CE 95 %": float(np.percentile(ce, 95)),
            "LE / monolithic, median": float(np.median(le)), "LE 95 %": float(np.percentile(le, 95)),
            "largest eigenvalue": largest, "NEES / dof": float(np.mean(of.nees)) if of.nees else "",
            "% in CE90": within.per_cent_within_ce90 if within else "", "% in LE90": within.per_cent_within_le90 if within else "",
            "verdict": verdict(largest <= CONSISTENT) if policy in CONSISTENT_POLICIES else DATA,
        }  # fmt: skip


def sheet_rows(m: Measured) -> Iterator[dict[str, Any]]:
    """All points tile by tile, each by its owner alone or merged rigorously with the tiles that hold some of the owner's points."""
    for policy, of in m.sheets.items():
        owned = [(s, s.owned) for s in of if s.owned.any()]
        ratios = [[a / b for a, b in zip(radii(s.covariance[o], s.geocentric[o]), radii(s.of_whole[o], s.whole[o]), strict=True)]
                  for s, o in owned]  # fmt: skip
        ce, le = (np.concatenate([r[k] for r in ratios]) for k in range(2))
        difference = [np.linalg.norm((s.geocentric - s.whole)[o], axis=1) for s, o in owned]
        step, sigmas = [], []
        for one, other in neighbouring(m.cover, of):
            _, i, j = np.intersect1d(one.ids, other.ids, return_indices=True)
            apart = one.geocentric[i] - other.geocentric[j]
            step.append(np.linalg.norm(apart, axis=1))
            sigmas.append(in_sigmas(apart, one.covariance[i]))
        yield {
            "scene": m.scene.name, "overlap": m.overlap, "all points by": policy, "tiles": len(of), "points": len(ce),
            "step, m": _rms(step), "step, sigmas": _root_mean(sigmas),
            "CE / monolithic, median": float(np.median(ce)), "CE 95 %": float(np.percentile(ce, 95)),
            "LE / monolithic, median": float(np.median(le)), "LE 95 %": float(np.percentile(le, 95)),
            "difference, m RMS": _rms(difference), "largest": float(np.concatenate(difference).max()), "verdict": DATA,
        }  # fmt: skip


def neighbouring(cover: Cover, of: Sequence[Sheets]) -> Iterator[tuple[Sheets, Sheets]]:
    """Tiles that share a border and points."""
    by_tile = {s.tile: s for s in of}
    for border in borders(cover):
        pair = [by_tile[t] for t in border[:2] if t in by_tile]
        if len(pair) == 2 and np.isin(pair[0].ids, pair[1].ids).any():
            yield pair[0], pair[1]


def claims(measured: Sequence[Measured]) -> Iterator[dict[str, Any]]:
    """What must hold over all scenes and overlaps."""
    for policy, wanted in STRADDLE.items():
        ratio = max(m.collected[policy].straddle_quotient / m.collected["monolithic"].straddle_quotient for m in measured)
        yield at_most(f"straddle ratio of {policy}, largest", wanted, ratio)
    far = max(float(np.concatenate(m.collected[RECONCILED].difference).max()) for m in measured)
    yield at_most("coordinates of the reconciled network - monolithic, m", SAME_METRES, far)
    worst = max(max(m.collected[policy].eigenvalue) for m in measured for policy in CONSISTENT_POLICIES)
    yield at_most("largest eigenvalue of tile, ci, bci, split, rigorous and reconciled", CONSISTENT, worst)
    naive = [max(m.collected["naive"].eigenvalue) for m in measured]
    yield statement(
        "largest eigenvalue of naive, least of all networks", f"{INCONSISTENT:g} or more", min(naive), min(naive) >= INCONSISTENT
    )
    yield statement("the same, largest of all networks", "2 or less", max(naive), max(naive) <= 2.0 * CONSISTENT)


def at_most(claim: str, limit: float, found: float) -> dict[str, Any]:
    """A row for a number that must not exceed a limit, to as many digits as limits near 1 need."""
    return statement(claim, f"{limit:.8g} or less", found, bool(found <= limit))


def _rms(lengths: Sequence[Array]) -> float | str:
    return float(np.sqrt(np.square(np.concatenate(lengths)).mean())) if lengths else ""


def _root_mean(squares: Sequence[Array]) -> float | str:
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else ""


def _known(value: float | np.floating[Any]) -> float | str:
    return float(value) if np.isfinite(value) else ""
