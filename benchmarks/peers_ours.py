"""Ours among its peers: the product's own commands, from a catalogue to a reconciled network, questions to it, and one block more."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

import submin
from benchmarks.peers_outcome import Outcome, Times
from benchmarks.peers_problem import Problem, problem_of
from benchmarks.sparse_adjustment import SparseAdjustment, adjusted_points
from orchestration.create import create, fit_catalogue
from orchestration.executors import executor_for, own_peak_memory_mb
from orchestration.reconcile import reconcile
from orchestration.run import run
from submin.geodesy import geodetic_to_geocentric, local_axes, rotate_covariance
from submin.storage.accuracy_map import PointAccuracy
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, CatalogueMetadata
from submin.storage.catalogue_writer import CatalogueWriter

Array = NDArray[np.float64]

TILE_KM, OVERLAP_KM = 100.0, 50.0
ASKED_TIMES = 5
SAMPLED = 1000
"""Points whose covariances are held against the network's own system, solved once by a sparse direct solver."""


def write_catalogues(blocks: Sequence[Block], folder: Path) -> None:
    """All blocks, all but the last, and the last, each as a catalogue."""
    for name, some in (("all", blocks), ("others", blocks[:-1]), ("last", blocks[-1:])):
        priors = [block.a_priori for block in some]
        most = max(priors, key=priors.count)
        with CatalogueWriter(folder / name, CatalogueMetadata(name=f"blocks of a benchmark: {name}")) as writer:
            writer.write_images(chain.from_iterable(block.images for block in some))
            for block in some:
                writer.write_block(block)
            writer.write_priors(most, {block.block_id: block.a_priori for block in some if block.a_priori != most})


def adjust(folder: Path, workers: int) -> tuple[Outcome, dict[str, float]]:
    """Everything that is asked of a contender, and how far the network is from its own system solved once.

    The problem that peers are given is written to ``problem.npz``.
    """
    place, catalogue = str(folder / "network"), Catalogue.open(folder / "all")
    area, _, _ = fit_catalogue(catalogue)
    create(place, area, catalogue.metadata, TILE_KM, OVERLAP_KM)
    others, last = Catalogue.open(folder / "others"), Catalogue.open(folder / "last")
    with executor_for(workers) as executor:
        first_run = _seconds(lambda: run(others, place, executor))
        first_reconcile = _seconds(lambda: reconcile(place, executor))
        one_block = _seconds(lambda: run(last, place, executor)) + _seconds(lambda: reconcile(place, executor))
        peak = executor.peak_memory_mb()

    every = submin.open(place).accuracy()
    all_3x3 = _asked(lambda: submin.open(place).accuracy())
    peak = max(peak, own_peak_memory_mb())
    problem = problem_of(submin.open(place), _images(last))
    problem.save(folder / "problem.npz")
    determined = _answered(problem, every)
    near, far = (
        (submin.open(place).query(points=problem.ids[rows]).covariance, _asked(lambda rows=rows: submin.open(place).query(points=problem.ids[rows])))  # type: ignore[misc]
        for rows in (problem.near, problem.far)
    )
    times = Times(first_run, first_reconcile, all_3x3, "", near[1], far[1], one_block)
    at = geodetic_to_geocentric(every.geodetic)[determined]
    covariance = rotate_covariance(every.local_covariance, local_axes(every.geodetic).transpose(0, 2, 1))[determined]
    outcome = Outcome(times, peak, at, np.arange(len(problem)), covariance, near[0], far[0])
    return outcome, against_own_system(place, problem, outcome)


def against_own_system(place: str, problem: Problem, outcome: Outcome) -> dict[str, float]:
    """Differences from the system of all cells solved once: metres of all coordinates, covariances of points over their sigmas."""
    network = submin.open(place)
    clock = time.perf_counter()
    solution = SparseAdjustment.of(network.snapshot)
    seconds = time.perf_counter() - clock
    rows = np.sort(np.random.default_rng(2).choice(len(problem), min(SAMPLED, len(problem)), replace=False))
    direct = adjusted_points(network, solution, network.named(problem.ids[rows]))
    sigma = np.sqrt(np.diagonal(direct.covariance, axis1=1, axis2=2))
    relative = np.abs(outcome.covariance[rows] - direct.covariance) / (sigma[:, :, None] * sigma[:, None, :])
    return {
        "points": len(rows), "metres": float(np.abs(outcome.coordinates[rows] - direct.geocentric).max()),
        "covariance": float(relative.max()), "seconds": seconds,
    }  # fmt: skip


def _answered(problem: Problem, every: PointAccuracy) -> NDArray[np.int64]:
    """Places of the problem's points in an answer for all."""
    order = np.argsort(every.ids)
    if not np.array_equal(every.ids[order], problem.ids):
        raise RuntimeError(f"{len(problem) - len(every)} points are seen by two rays and not determined; the contenders' points differ")
    return order


def _images(catalogue: Catalogue) -> frozenset[str]:
    return frozenset(image.image_id for block in catalogue.blocks() for image in block.images)


def _asked(question: Callable[[], object]) -> float:
    """Seconds of a question to a network that is opened anew for each; median, the first (which loads kernels) left out."""
    return median([_seconds(question) for _ in range(ASKED_TIMES + 1)][1:])


def _seconds(work: Callable[[], object]) -> float:
    clock = time.perf_counter()
    work()
    return time.perf_counter() - clock
