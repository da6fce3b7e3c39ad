"""What a network cut into tiles answers about its borders, beside what is true and what the monolithic network answers.

The numbers of `benchmarks.continuity`; what they mean: docs/continuity.md.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import submin
from benchmarks.border import (
    RECONCILED,
    RIGOROUS,
    TILE,
    Answer,
    Question,
    Sheets,
    answers,
    borders,
    largest_eigenvalue,
    monolithic,
    own_blocks,
    question,
    radii,
    relative,
    sheets,
    steps,
)
from benchmarks.comparison import verdict
from benchmarks.continuity_scenes import Scene, truth
from orchestration.create import create
from orchestration.executors import Executor
from orchestration.reconcile import reconcile
from orchestration.run import run
from submin.accuracy import nees_per_dof
from submin.geodesy import geocentric_to_geodetic, local_axes, rotate_covariance
from submin.network.sub_min import SubMin
from submin.query.bounded_inflation import inflation, seen_point
from submin.query.covariance_intersection import intersection_weights
from submin.query.padded_tiles import padded_tiles
from submin.query.planner import determined_parts, points_named
from submin.storage.network import Network
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

BORDERS = 3
"""Borders of a network that are looked at: those with most straddling pairs."""
SINGLE_POINTS = 6
CONSISTENT = 1.0 + 1e-6
STEPPED = (TILE, "ci", RECONCILED)
"""Policies of which two neighbours' answers are compared: each tile alone, each with its own weights, each with what lies outside of it."""
UNLIMITED = 10**6
"""Parameters of a tile, so that none is split."""


@dataclass
class Collected:
    """What the borders of a network add up to for one policy."""

    step: list[Array] = field(default_factory=list)
    step_sigmas: list[Array] = field(default_factory=list)
    straddling: list[Array] = field(default_factory=list)
    inside: list[Array] = field(default_factory=list)
    relative_ce: list[Array] = field(default_factory=list)
    difference: list[Array] = field(default_factory=list)
    ce: list[Array] = field(default_factory=list)
    le: list[Array] = field(default_factory=list)
    eigenvalue: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    error: list[Array] = field(default_factory=list)
    covariance: list[Array] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    @property
    def straddle_quotient(self) -> float:
        """RMS relative error of straddling pairs over that of pairs inside a tile."""
        return float(np.sqrt(np.concatenate(self.straddling).mean() / np.concatenate(self.inside).mean()))


class Profile(NamedTuple):
    """What figures show of a border, metres.

    Attributes
    ----------
    offset : (n,) of the points from the border
    ce, difference : by policy CE90 as stated (n,), and the distance (n,) from the monolithic position
    step_offset, step : (k,) of the points that both tiles hold, and the distance between the two tiles' answers, each alone
    """

    offset: Array
    ce: dict[str, Array]
    difference: dict[str, Array]
    step_offset: Array
    step: Array


@dataclass(frozen=True, eq=False)
class Measured:
    """A scene at one overlap, in widths.

    Attributes
    ----------
    collected : by policy, with ``monolithic`` and ``naive``
    sheets : all points tile by tile, by policy ``tile`` and ``rigorous``
    profiles : one a border
    rows : of single points and other claims
    """

    scene: Scene
    overlap: float
    cover: Cover
    collected: dict[str, Collected]
    sheets: dict[str, list[Sheets]]
    profiles: list[Profile]
    singles: list[dict[str, Any]]


def of_scene(scene: Scene, folder: Path, scale: float, executor: Executor) -> Iterator[Measured]:
    """A scene cut into tiles, at every overlap."""
    catalogue = scene.catalogue(folder / "catalogue", scale)
    for overlap in scene.overlaps:
        place = folder / f"network-{overlap:g}"
        create(str(place), scene.area(scale), catalogue.metadata, scene.core_km, overlap * scene.width_km, max_parameters=UNLIMITED)
        result = run(catalogue, str(place), executor)
        if result.rejected:
            raise RuntimeError(f"{scene.name}: rejected: {result.rejected[0].block_id}: {result.rejected[0].reason}")
        network = submin.open(place)
        reconcile(str(place), executor)
        yield at_overlap(scene, overlap, network, submin.open(place), truth(catalogue))


def at_overlap(scene: Scene, overlap: float, network: Network, reconciled: Network, true: tuple[Ids, Array] | None) -> Measured:
    """Everything of one network, before and after it is reconciled. ``true``: ids, ascending, and true positions, where they are known."""
    whole = monolithic(network)
    asked = questions(scene, network)
    if not asked:
        raise RuntimeError(f"{scene.name}, overlap {overlap:g}: no border has pairs of points across it; expected a larger --scale")
    collected = defaultdict[str, Collected](Collected)
    profiles = [collect(network, reconciled, about, whole, true, collected) for about in asked]
    singles = [] if overlap != 1.0 else list(single_points(scene, overlap, network, asked[0]))
    return Measured(
        scene, overlap, network.cover, dict(collected), {
            TILE: list(sheets(network, whole, TILE)), RIGOROUS: list(sheets(network, whole, RIGOROUS)),
            "tile, reconciled": list(sheets(reconciled, whole, TILE)),
        }, profiles, singles,
    )  # fmt: skip


def questions(scene: Scene, network: Network) -> list[Question]:
    """Questions about those borders that most pairs of points straddle."""
    lengths = (1e3 * scene.reach_km, 1e3 * scene.ends_km, 1e3 * scene.near_km)
    asked = [q for border in borders(network.cover) if (q := question(network, border, *lengths)) is not None]
    return sorted(asked, key=lambda q: -int(q.straddling.sum()))[:BORDERS]


def collect(
    network: Network,
    reconciled: Network,
    about: Question,
    whole: SubMin,
    true: tuple[Ids, Array] | None,
    collected: Mapping[str, Collected],
) -> Profile:
    """Add what one border shows."""
    ce, difference, step = dict[str, Array](), dict[str, Array](), np.empty(0)
    reference: Answer | None = None
    for policy, answer in answers(network, reconciled, about, whole):
        reference = reference or answer
        into = collected[policy]
        true_pairs, stated_pairs = (relative(p, about.pairs) for p in (answer.true, answer.reported))
        # what is true of a reconciled network is the monolithic answer: whether it states that is what is to be seen
        trace = np.trace(stated_pairs if policy == RECONCILED else true_pairs, axis1=1, axis2=2)
        into.straddling.append(trace[about.straddling])
        into.inside.append(trace[~about.straddling])
        middle = answer.geocentric[about.pairs[about.straddling]].mean(axis=1)
        stated, best_pairs = (radii(p[about.straddling], middle)[0] for p in (stated_pairs, true_pairs))
        into.relative_ce.append(stated / best_pairs)
        into.difference.append(np.linalg.norm(answer.geocentric - reference.geocentric, axis=1))
        mine, best = (radii(own_blocks(a.reported), a.geocentric) for a in (answer, reference))
        into.ce.append(mine[0] / best[0])
        into.le.append(mine[1] / best[1])
        into.seconds.append(answer.seconds)
        ce[policy], difference[policy] = mine[0], into.difference[-1]
        for points in answer.stated:
            rows = np.flatnonzero(points.repeat(3))
            reported, true_covariance = answer.reported[np.ix_(rows, rows)], answer.true[np.ix_(rows, rows)]
            into.eigenvalue.append(largest_eigenvalue(true_covariance, reported))
            if true is not None:
                error = (answer.geocentric - true[1][np.searchsorted(true[0], about.ids)])[points]
                into.nees.extend([nees_per_dof(error.ravel(), reported)] * len(error))
                axes = local_axes(geocentric_to_geodetic(answer.geocentric[points]))
                into.error.append(np.einsum("nij,nj->ni", axes, error))
                into.covariance.append(rotate_covariance(own_blocks(reported), axes))
        if policy in STEPPED and about.shared.any():
            apart, own = steps(reconciled, about, TILE) if policy == RECONCILED else steps(network, about, policy)
            into.step.append(np.linalg.norm(apart, axis=1))
            into.step_sigmas.append(in_sigmas(apart, own))
            step = into.step[-1] if policy == TILE else step
    return Profile(about.offset, ce, difference, about.offset[about.shared], step)


def in_sigmas(difference: Array, covariance: Array) -> Array:
    """``d'P^-1 d / 3`` (n,) of differences (n, 3): the mean square in sigmas."""
    solved = np.linalg.solve(covariance, difference[:, :, None])[:, :, 0]
    return np.asarray(np.einsum("ni,ni->n", difference, solved) / 3.0)


def single_points(scene: Scene, overlap: float, network: Network, about: Question) -> Iterator[dict[str, Any]]:
    """Bounded inflation of single points that both tiles hold, beside intersection and independent fusion: variances over those of ci."""
    shared = np.flatnonzero(about.shared)
    chosen = about.ids[shared[np.linspace(0, len(shared) - 1, SINGLE_POINTS).astype(np.int64)]]
    padded = padded_tiles(network, about.border[:2])
    of_images, of_points, independent, bound, gained = [], [], [], [], []
    for point in np.unique(chosen):
        trace = {policy: float(np.trace(network.query(points=[point], policy=policy).covariance)) for policy in ("ci", "bci", "rigorous")}
        of_images.append(trace["bci"] / trace["ci"])
        gained.append(trace["rigorous"] / trace["ci"])
        ids = np.array([point])
        _, parts = determined_parts(network, points_named(network, ids, network.snapshot.candidate_cells(ids))[0])
        _, information, correlation = seen_point(padded, parts)
        claims_of = [
            np.linalg.inv(np.tensordot(weight, information, axes=1)).trace()
            for weight in (
                intersection_weights(information, np.eye(3)), 1.0 / inflation(information, correlation, np.eye(3)), np.ones(2)
            )
        ]  # fmt: skip
        bound.append(float(correlation[0, 1]))
        of_points.append(claims_of[1] / claims_of[0])
        independent.append(claims_of[2] / claims_of[0])
    yield {
        "scene": scene.name, "overlap": overlap, "single points": len(bound), "correlation bound": float(np.median(bound)),
        "3-vector: independent / ci": float(np.median(independent)), "3-vector: bci / ci, median": float(np.median(of_points)),
        "3-vector: bci / ci, least": min(of_points), "policies: bci / ci, median": float(np.median(of_images)),
        "policies: rigorous / ci, median": float(np.median(gained)),
        "verdict": verdict(all(i <= p * CONSISTENT and p <= CONSISTENT for i, p in zip(independent, of_points, strict=True))
                           and max(of_images) <= CONSISTENT),
    }  # fmt: skip
