"""Ours, GTSAM and a sparse simultaneous adjustment on the same rays: time, memory and results, on a ladder of sizes.

Every contender runs in a process of its own, one after another. Peers are given the product's linearised rays, its blunders already found:
their ``build`` and ``solve`` are one linear solution, while ours begins with a catalogue, finds cameras, points and blunders, iterates, and
commits to disk. Ours is asked after it has answered for other points, as peers are that have their solution in memory; what opening the
network on disk for every question adds is said below the table.
"""

from __future__ import annotations

import importlib
import importlib.util
import multiprocessing
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.comparison import DATA, below, data
from benchmarks.peers_ours import Besides, adjust, write_catalogues
from benchmarks.peers_outcome import Difference, Outcome
from benchmarks.peers_problem import Problem
from benchmarks.record import write_record
from orchestration.commands.simulate import COUNTRIES
from orchestration.executors import executor_for
from orchestration.simulate import shared_data
from submin.formats.outlines import named_polygons
from submin.simulation.china import TRIPLETS, china
from submin.simulation.five_blocks import five_blocks
from submin.simulation.scene import realise
from submin.simulation.worldview import worldview
from submin.storage.catalogue_schema import Block
from submin.storage.simulated import campaign_part, scene_blocks

T = TypeVar("T")
PEERS = {"GTSAM": ("gtsam", "gtsam"), "sparse (CHOLMOD)": ("cvxopt", "sparse")}
"""Package that each needs, and its module here."""
STEPS = {"all 3x3, s": "all_3x3", "100 near, s": "joint_near", "100 far, s": "joint_far", "one block, s": "one_block"}
SINGLES_SECONDS, JOINT_SECONDS, AGREE = 1.0, 0.5, 1e-6


@dataclass(frozen=True)
class Rung:
    """Blocks of about so many points."""

    points: int
    name: str
    blocks: Callable[[], Sequence[Block]]


def _china(triplets: int) -> Callable[[], Sequence[Block]]:
    def blocks() -> Sequence[Block]:
        outline = named_polygons(shared_data(COUNTRIES), "name")["China"]
        campaign = china(outline, triplets / TRIPLETS)
        return campaign_part(campaign.design, campaign.scenes).blocks

    return blocks


LADDER = (
    Rung(62, "five blocks", lambda: scene_blocks(realise(five_blocks(), 0))),
    Rung(1_347, "WorldView", lambda: scene_blocks(realise(worldview(), 0))),
    Rung(5_000, "10 triplets of China", _china(10)),
    Rung(15_000, "35 triplets of China", _china(35)),
    Rung(60_000, "153 triplets of China", _china(153)),
)


def measure(scale: float, workers: int, out: Path | None = None) -> list[dict[str, Any]]:
    """Rows of the contenders on each rung, then what is asked of ours; ``scale``: the largest rung, as a part of 60,000 points.

    ``out``: folder for ``peers.json``. Peers that are not installed are left out, and the table says so.
    """
    table: list[dict[str, Any]] = []
    claims: list[dict[str, Any]] = []
    for rung in LADDER:
        if rung is LADDER[0] or rung.points <= scale * LADDER[-1].points:
            rows, asked = _rung(rung, workers)
            table, claims = table + rows, claims + asked
    every = [*table, *claims, *_versions()]
    if out is not None:
        write_record(out, "peers", scale, workers, every, {row["package"]: row["version"] for row in every if "package" in row})
    return every


def _rung(rung: Rung, workers: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows and claims of one size."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        besides = _in_its_own_process(_ours, LADDER.index(rung), folder, workers)
        ours, problem = Outcome.load(folder / "ours.npz"), Problem.load(folder / "problem.npz")
        size = {"points": len(problem), "rays": len(problem.image), "images": len(problem.added)}
        table = [_row(size, "ours", ours, None, None)]
        claims = _claims(rung, len(problem), ours, besides)
        for peer, (package, module) in PEERS.items():
            if importlib.util.find_spec(package) is None:
                reason = f"not compared: package {package} is not installed"
                claims.append({"claim": f"{len(problem):,} points: {peer}", "wanted": reason, "found": "", "verdict": DATA})
                continue
            _in_its_own_process(_peer, module, folder)
            found = Outcome.load(folder / f"{module}.npz")
            difference = Difference.of(found, ours)
            table.append(_row(size, peer, found, ours, difference))
            claims += [
                below(f"{len(problem):,} points: {peer} and ours, coordinates, m", AGREE, difference.metres),
                below(f"{len(problem):,} points: {peer} and ours, 3x3 covariances, relative", AGREE, difference.single),
                below(f"{len(problem):,} points: {peer} and ours, joint covariances, relative", AGREE, difference.joint),
            ]
        return table, claims


def _ours(rung: int, folder: Path, workers: int) -> Besides:
    """Ours, in a process that has done all of it on the smallest blocks before: compiled kernels are loaded."""
    for number, place, count in ((0, folder / "rehearsal", 0), (rung, folder, workers)):
        write_catalogues(LADDER[number].blocks(), place)
        with executor_for(count) as executor:
            outcome, problem, besides = adjust(place, executor)
    problem.save(folder / "problem.npz")
    outcome.save(folder / "ours.npz")
    return besides


def _peer(module: str, folder: Path) -> None:
    contender = importlib.import_module(f"benchmarks.peers_{module}")
    contender.adjust(Problem.load(folder / "problem.npz")).save(folder / f"{module}.npz")


def _claims(rung: Rung, points: int, ours: Outcome, besides: Besides) -> list[dict[str, Any]]:
    """What is asked of ours: agreement on every rung, times on the largest."""
    size, times = f"{points:,} points ({rung.name}): ours", ours.times
    slower, slower_anew = max(times.joint_near, times.joint_far), max(besides.anew_near, besides.anew_far)
    of_system = f"{size} and its own system solved once in {besides.seconds:.2g} s"
    timed = [
        (f"{size}, all 3x3 covariances once reconciled, s", SINGLES_SECONDS, times.all_3x3),
        (f"{size}, joint covariance of 100 points once reconciled, the slower of near and far, s", JOINT_SECONDS, slower),
    ]
    full = rung is LADDER[-1]
    return [
        below(f"{of_system}, all coordinates, m", AGREE, besides.metres),
        below(f"{of_system}, 3x3 covariances of {besides.sampled:,} points, relative", AGREE, besides.covariance),
        *(below(*claim) if full else data(claim[0], f"60,000 points: {claim[1]:g} or less", claim[2]) for claim in timed),
        data(f"{size}, all 3x3 covariances, network opened anew, s", "peers are asked in memory", besides.anew_3x3),
        data(f"{size}, joint covariance of 100 points, network opened anew, s", "peers are asked in memory", slower_anew),
    ]


def _row(size: dict[str, int], contender: str, found: Outcome, ours: Outcome | None, difference: Difference | None) -> dict[str, Any]:
    times = found.times
    steps = {title: getattr(times, field) for title, field in STEPS.items()}
    return {
        **size, "contender": contender, "build, s": times.build, "solve, s": times.solve, "there in, s": times.build + times.solve, **steps,
        "3x3": times.remark or "computed", "peak, MB": found.peak_mb,
        "coordinates, m": "" if difference is None else difference.metres, "3x3, relative": "" if difference is None else difference.single,
        "joint, relative": "" if difference is None else difference.joint,
        "faster than ours": "" if ours is None else ", ".join(_faster(found, ours)) or "nowhere",
    }  # fmt: skip


def _faster(found: Outcome, ours: Outcome) -> list[str]:
    """Steps in which a peer beats ours, memory included."""
    by_step = {"there": (found.times.build + found.times.solve, ours.times.build + ours.times.solve)}
    by_step |= {title.removesuffix(", s"): (getattr(found.times, field), getattr(ours.times, field)) for title, field in STEPS.items()}
    by_step["memory"] = (found.peak_mb, ours.peak_mb)
    return [step for step, (theirs, own) in by_step.items() if theirs < own]


def _versions() -> list[dict[str, Any]]:
    there = {peer: package for peer, (package, _) in PEERS.items() if importlib.util.find_spec(package)}
    return [{"peer": peer, "package": package, "version": version(package)} for peer, package in there.items()]


def _in_its_own_process(work: Callable[..., T], *arguments: object) -> T:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        return process.submit(work, *arguments).result()
