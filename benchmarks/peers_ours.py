"""Ours among its peers: the product's own commands, from a catalogue to a reconciled network, questions to it, and one block more."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

import submin
from benchmarks.peers_outcome import Outcome, Times, relative_difference
from benchmarks.peers_problem import Problem, around, problem_of, spread
from benchmarks.sparse_adjustment import SparseAdjustment, adjusted_points, located
from orchestration.create import create, fit_catalogue
from orchestration.executors import Executor
from orchestration.reconcile import reconcile
from orchestration.run import run
from submin.geodesy import geodetic_to_geocentric, local_axes, rotate_covariance
from submin.query.planner import all_points
from submin.storage.accuracy_map import PointAccuracy
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, CatalogueMetadata
from submin.storage.catalogue_writer import CatalogueWriter

Rows = NDArray[np.int64]

TILE_KM, OVERLAP_KM = 100.0, 50.0
ASKED_TIMES = 5
SAMPLED = 1000
"""Points whose covariances are held against the network's own system, solved once by a sparse direct solver."""


def write_catalogues(blocks: Sequence[Block], folder: Path) -> None:
    """All blocks, all but the last, and the last, each as a catalogue."""
    for name, some in (("all", blocks), ("others", blocks[:-1]), ("last", blocks[-1:])):
        priors = [block.a_priori for block in some if block.a_priori is not None]
        most = max(priors, key=priors.count)
        with CatalogueWriter(folder / name, CatalogueMetadata(name=f"blocks of a benchmark: {name}")) as writer:
            writer.write_images(chain.from_iterable(block.images for block in some))
            for block in some:
                writer.write_block(block)
            writer.write_priors(most, {b.block_id: b.a_priori for b in some if b.a_priori not in (None, most)})


@dataclass(frozen=True)
class Besides:
    """What is said of ours alone.

    Attributes
    ----------
    sampled, metres, covariance, seconds : from the network's own system solved once the largest differences of all coordinates (metres) and
        of so many points' covariances (over their sigmas), and how long that solution takes
    anew_3x3, anew_near, anew_far : seconds of the questions when the network on disk is opened anew for each
    """

    sampled: int
    metres: float
    covariance: float
    seconds: float
    anew_3x3: float
    anew_near: float
    anew_far: float


def adjust(folder: Path, executor: Executor) -> tuple[Outcome, Problem, Besides]:
    """Everything that is asked of a contender, by the product's own commands; the problem that peers are given; and what else is known."""
    place, catalogue = str(folder / "network"), Catalogue.open(folder / "all")
    area, _, _ = fit_catalogue(catalogue)
    create(place, area, catalogue.metadata, TILE_KM, OVERLAP_KM)
    others, last = Catalogue.open(folder / "others"), Catalogue.open(folder / "last")
    first_run = _seconds(lambda: run(others, place, executor))
    first_reconcile = _seconds(lambda: reconcile(place, executor))
    one_block = _seconds(lambda: run(last, place, executor)) + _seconds(lambda: reconcile(place, executor))

    network = submin.open(place)
    every = network.accuracy()
    peak = executor.peak_memory_mb()
    problem = problem_of(network, frozenset(image.image_id for block in last.blocks() for image in block.images))
    near, far = (network.query(points=problem.ids[rows]) for rows in (problem.near, problem.far))
    again = _again(place, problem)
    times = Times(first_run, first_reconcile, again[0], "", again[1], again[2], one_block)
    at, order = geodetic_to_geocentric(every.geodetic), _order(problem, every)
    covariance = rotate_covariance(every.local_covariance, local_axes(every.geodetic).transpose(0, 2, 1))
    outcome = Outcome(times, peak, at[order], np.arange(len(problem)), covariance[order], near.covariance, far.covariance)
    return outcome, problem, Besides(*against_own_system(network, problem, outcome), *_anew(place, problem))


def against_own_system(network: submin.Network, problem: Problem, outcome: Outcome) -> tuple[int, float, float, float]:
    """The first four of `Besides`."""
    clock = time.perf_counter()
    solution = SparseAdjustment.of(network.snapshot)
    seconds = time.perf_counter() - clock
    rows = np.sort(np.random.default_rng(2).choice(len(problem), min(SAMPLED, len(problem)), replace=False))
    direct = adjusted_points(network, solution, network.named(problem.ids[rows]))
    metres = np.abs(outcome.coordinates - located(network, solution, all_points(network))[1]).max()
    return len(rows), float(metres), relative_difference(outcome.covariance[rows], direct.covariance), seconds


def _again(place: str, problem: Problem) -> tuple[float, float, float]:
    """Seconds of all 3x3, and of joint covariances near and far, from a network that has answered for other points before."""
    network = submin.open(place)
    network.accuracy()
    rng, found = np.random.default_rng(3), [[_seconds(network.accuracy) for _ in range(ASKED_TIMES)]]
    for rows in (problem.near, problem.far):
        others = [around(problem, rng) if rows is problem.near else spread(problem, rng) for _ in range(ASKED_TIMES)]
        network.query(points=problem.ids[rows])
        found.append([_seconds(lambda rows=rows: network.query(points=problem.ids[rows])) for rows in others])  # type: ignore[misc]
    return median(found[0]), median(found[1]), median(found[2])


def _anew(place: str, problem: Problem) -> tuple[float, float, float]:
    """The same from a network that is opened for each question."""
    questions: list[Callable[[submin.Network], object]] = [
        lambda network: network.accuracy(),
        lambda network: network.query(points=problem.ids[problem.near]),
        lambda network: network.query(points=problem.ids[problem.far]),
    ]
    singles, near, far = ([_seconds(lambda ask=ask: ask(submin.open(place))) for _ in range(ASKED_TIMES)] for ask in questions)  # type: ignore[misc]
    return median(singles), median(near), median(far)


def _order(problem: Problem, every: PointAccuracy) -> Rows:
    """Places of the problem's points in an answer for all."""
    order = np.argsort(every.ids)
    if not np.array_equal(every.ids[order], problem.ids):
        raise RuntimeError(f"two rays see {len(problem):,} points, and {len(every):,} are determined: contenders would not have the same")
    return order


def _seconds(work: Callable[[], object]) -> float:
    clock = time.perf_counter()
    work()
    return time.perf_counter() - clock
