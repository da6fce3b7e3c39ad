"""Every merge policy on a small simulated region, against the exact error covariance of its estimate (exact_covariance.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from networks import SMALL, area_of, fuse
from numpy.typing import NDArray
from property.exact_covariance import (
    Equations,
    adjusted_together,
    equations,
    fitted,
    information,
    intersected,
    largest_ratio,
    located,
    monolithic,
    weighted_sum,
)
from shapely.geometry.base import BaseGeometry

import submin
from submin.adjustment.priors import APriori
from submin.query import covariance_intersection
from submin.query.control_set import ControlSet
from submin.query.covariance_intersection import intersection_weights
from submin.query.planner import POLICIES
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.network import Network
from submin.storage.simulated import write_region

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

CONSISTENT = 1.0 + 1e-6
CLEAN = replace(SMALL, blunder_rate=0.0, bad_cameras=0)


@dataclass(frozen=True)
class Case:
    """A network: the design of its region, tiles and overlap in kilometres, blocks a batch."""

    design: RegionDesign
    tile_km: float
    overlap_km: float
    batch_blocks: int = 500


CASES = {
    "overlap": Case(replace(CLEAN, seed=5, priors=APriori(correlation="exponential", correlation_parameter=20.0)), 60.0, 20.0),
    "no overlap": Case(replace(CLEAN, seed=8), 40.0, 0.0, batch_blocks=5),
    "released camera": Case(
        replace(CLEAN, seed=1, bad_cameras=1, priors=APriori(correlation="exponential", correlation_parameter=60.0)), 60.0, 20.0
    ),
}

ONE_TILE = ("one cell", "overlap of two", "overlap of four")
SEVERAL_TILES = (*ONE_TILE, "border", "corner")


@dataclass(frozen=True)
class Row:
    """A policy: what it makes of the tiles' information (see exact_covariance.py), and the queries that it can answer."""

    images: Callable[[Equations, Sequence[int], Array], Array]
    answers: tuple[str, ...]


TABLE = {
    "tile": Row(adjusted_together, ONE_TILE),
    "ci": Row(intersected, SEVERAL_TILES),
    "rigorous": Row(adjusted_together, SEVERAL_TILES),
}
"""Every policy of `submin.query.planner.POLICIES`."""


@dataclass(frozen=True, eq=False)
class Made:
    """A network that was made, its linear problem, the whole area, and the points of each kind of query that it has."""

    network: Network
    problem: Equations
    area: BaseGeometry
    places: dict[str, Ids]


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Made]:
    return cache(lambda name: make(CASES[name], tmp_path_factory.mktemp("policies")))


@pytest.fixture(scope="module", params=CASES)
def made(request: pytest.FixtureRequest, networks: Callable[[str], Made]) -> Made:
    return networks(request.param)


@pytest.fixture
def overlapping(networks: Callable[[str], Made]) -> Made:
    return networks("overlap")


def make(case: Case, folder: Path) -> Made:
    region = simulate_region(case.design)
    write_region(region, folder / "catalogue")
    result = fuse(
        folder / "catalogue", folder / "network", area_of(region),
        tile_km=case.tile_km, overlap_km=case.overlap_km, batch_blocks=case.batch_blocks,
    )  # fmt: skip
    assert not result.rejected
    assert set(region.bad_cameras) <= {image.image_id for image in result.flagged}
    network = submin.open(folder / "network")
    problem = equations(network)
    assert len(problem.point_ids) == len(region.point_ids)
    return Made(network, problem, area_of(region).buffer(0.1), places(problem))


def places(problem: Equations) -> dict[str, Ids]:
    """Points of the most populous single cell, overlaps, border of two cores and corner of four; overlaps only where there are any."""
    cover, cell = problem.cover, problem.point_cell
    held_by = np.array([len(cover.holders(c)) for c in cell])
    found = {}
    for name, holders in (("one cell", 1), ("overlap of two", 2), ("overlap of four", 4)):
        if (held_by == holders).any():
            found[name] = cell == np.bincount(cell[held_by == holders]).argmax()
    tile = cell // 9
    row, column = (cover.rows - 1) // 2, (cover.columns - 1) // 2
    first = row * cover.columns + column
    found["border"] = np.isin(tile, [first, first + 1])
    found["corner"] = np.isin(tile, [first, first + 1, first + cover.columns, first + cover.columns + 1])
    return {name: problem.point_ids[chosen] for name, chosen in found.items()}


def asked(made: Made, policy: str, monkeypatch: pytest.MonkeyPatch, **question: object) -> tuple[ControlSet, Array]:
    """An answer, and the weights that Covariance Intersection found for it (1 where it looked for none)."""
    weights = [np.ones(1)]

    def recorded(information: Array, functionals: Array) -> Array:
        weights.append(intersection_weights(information, functionals))
        return weights[-1]

    monkeypatch.setattr(covariance_intersection, "intersection_weights", recorded)
    return made.network.query(policy=policy, **question), weights[-1]  # type: ignore[arg-type]


def exact(made: Made, control: ControlSet, weights: Array) -> tuple[Array, Array]:
    """Positions (n, 3) and true error covariance of the policy's estimate for the points of an answer."""
    problem, tiles = made.problem, [made.network.cover.tile_number(name) for name in control.tiles]
    linear_map = located(problem, TABLE[control.policy].images(problem, tiles, weights), control.ids)
    corrections = (linear_map @ problem.data).reshape(-1, 3)
    return problem.origin[np.isin(problem.point_ids, control.ids)] + corrections, linear_map @ linear_map.T


def test_every_policy_has_a_row() -> None:
    assert set(TABLE) == set(POLICIES)


@pytest.mark.parametrize(("policy", "place"), [(policy, place) for policy, row in TABLE.items() for place in row.answers])
def test_the_answer_is_consistent(made: Made, policy: str, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if place not in made.places:
        assert made.network.cover.overlap == 0.0
        return
    control, weights = asked(made, policy, monkeypatch, points=made.places[place])
    positions, true = exact(made, control, weights)
    np.testing.assert_array_equal(control.ids, made.places[place])
    np.testing.assert_allclose(control.geocentric, positions, rtol=0.0, atol=1e-7)
    assert largest_ratio(true, control.covariance) <= CONSISTENT
    if policy != "ci":
        assert largest_ratio(control.covariance, true) <= CONSISTENT


def test_a_tile_alone_is_consistent_for_all_its_points(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    assert made.network.cover.rows >= 3
    assert made.network.cover.columns >= 3
    for tile in range(made.network.cover.columns + 2):  # corner, rim and inside
        control, weights = asked(made, "tile", monkeypatch, tile=made.network.cover.tile_name(tile))
        positions, true = exact(made, control, weights)
        np.testing.assert_array_equal(control.ids, made.problem.point_ids[np.isin(made.problem.point_cell, made.problem.held([tile]))])
        np.testing.assert_allclose(control.geocentric, positions, rtol=0.0, atol=1e-7)
        assert largest_ratio(true, control.covariance) <= CONSISTENT
        assert largest_ratio(control.covariance, true) <= CONSISTENT


def test_rigorous_over_all_tiles_is_the_monolithic_adjustment(made: Made) -> None:
    control = made.network.query(area=made.area, policy="rigorous")
    positions, covariance = monolithic(made.problem)
    assert control.scope == "network"
    np.testing.assert_array_equal(control.ids, made.problem.point_ids)
    corrections = np.abs(positions - made.problem.origin).max()
    np.testing.assert_allclose(control.geocentric, positions, rtol=0.0, atol=1e-9 * corrections + 4.0 * np.spacing(6.4e6))
    np.testing.assert_allclose(control.covariance, covariance, rtol=0.0, atol=1e-9 * np.abs(covariance).max())


@pytest.mark.parametrize("merge", ["points", "images"])
def test_a_naive_independent_merge_is_not_consistent(overlapping: Made, merge: str) -> None:
    """Negative control: two neighbours merged as if nothing were common to them. It is no policy, and the check above must refuse it."""
    problem = overlapping.problem
    held = {tile: problem.held([tile]) for tile in problem.cover.tiles()}
    pair = max(combinations(held, 2), key=lambda p: int(np.isin(problem.point_cell, np.intersect1d(held[p[0]], held[p[1]])).sum()))
    of_tiles = [information(problem, held[tile]) for tile in pair]
    ids = [problem.point_ids[np.isin(problem.point_cell, held[tile])] for tile in pair]
    union = np.union1d(*ids)
    if merge == "images":
        own, loading = fitted(problem, union)
        linear_map = own + loading @ weighted_sum(of_tiles, [1.0, 1.0])
        believed = np.linalg.inv(sum(part.root.T @ part.root for part in of_tiles))
        reported = np.asarray(own @ own.T + loading @ believed @ loading.T)
    else:
        total = np.zeros((3 * len(union), 3 * len(union)))
        right = np.zeros((3 * len(union), len(problem.data)))
        for part, of_tile in zip(of_tiles, ids, strict=True):
            alone = located(problem, weighted_sum([part], [1.0]), of_tile)
            weight = np.linalg.inv(alone @ alone.T)
            at = np.flatnonzero(np.repeat(np.isin(union, of_tile), 3))
            total[np.ix_(at, at)] += weight
            right[at] += weight @ alone
        reported = np.asarray(np.linalg.inv(total))
        linear_map = reported @ right
    ratio = largest_ratio(linear_map @ linear_map.T, reported)
    assert 1.5 < ratio <= 2.0 + 1e-6


def test_intersection_is_never_worse_than_its_best_tile(overlapping: Made) -> None:
    ids = overlapping.places["overlap of four"]
    merged = overlapping.network.query(points=ids, policy="ci")
    assert len(merged.tiles) == 4
    alone = [np.trace(overlapping.network.query(points=ids, tile=tile).covariance) for tile in merged.tiles]
    everything = np.trace(overlapping.network.query(points=ids, policy="rigorous").covariance)
    assert everything <= np.trace(merged.covariance) <= min(alone) * (1.0 + 1e-6)


def test_intersection_of_one_tile_is_the_tile(overlapping: Made) -> None:
    ids = overlapping.places["one cell"]
    merged, alone = (overlapping.network.query(points=ids, policy=policy) for policy in ("ci", "tile"))
    assert merged.tiles == alone.tiles and len(merged.tiles) == 1
    np.testing.assert_allclose(merged.geocentric, alone.geocentric, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(merged.covariance, alone.covariance, rtol=0.0, atol=1e-9 * np.abs(alone.covariance).max())


def random_information(rng: np.random.Generator, tiles: int, size: int) -> Array:
    """Information of some estimates, each with the a priori I, that know different directions to very different precision."""
    factors = rng.normal(size=(tiles, size, size)) * 10.0 ** rng.uniform(-3.0, 2.0, (tiles, size, 1))
    factors *= rng.random((tiles, size, 1)) < 0.6
    return np.asarray(np.eye(size) + np.swapaxes(factors, 1, 2) @ factors)


def random_functionals(rng: np.random.Generator, size: int) -> Array:
    seen = rng.normal(size=(int(rng.integers(1, 2 * size)), size))
    return np.asarray(seen.T @ seen)


def trace_of(weights: Array, information: Array, functionals: Array) -> float:
    return float(np.trace(np.linalg.solve(np.tensordot(weights, information, axes=1), functionals)))


@pytest.mark.parametrize("seed", range(40))
def test_weights_meet_the_optimality_condition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    information = random_information(rng, int(rng.integers(2, 8)), int(rng.integers(3, 25)))
    functionals = random_functionals(rng, information.shape[1])
    weights = intersection_weights(information, functionals)
    assert (weights >= 0.0).all()
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    covariance = np.linalg.inv(np.tensordot(weights, information, axes=1))
    spread = covariance @ functionals @ covariance
    shares = np.einsum("ij,tji->t", spread, information)
    assert shares.max() <= (1.0 + 1e-6) * np.trace(covariance @ functionals)


@pytest.mark.parametrize("seed", range(20))
def test_weights_of_two_tiles_are_those_of_a_search(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    information = random_information(rng, 2, 12)
    functionals = random_functionals(rng, 12)
    weights = intersection_weights(information, functionals)
    grid = np.linspace(0.0, 1.0, 2001)
    traces = np.array([trace_of(np.array([w, 1.0 - w]), information, functionals) for w in grid])
    best = traces.argmin()
    assert trace_of(weights, information, functionals) <= traces[best] * (1.0 + 1e-9)
    assert abs(weights[0] - grid[best]) <= 2e-3


@pytest.mark.parametrize("seed", range(10))
def test_a_tile_that_knows_less_in_every_direction_has_no_weight(seed: int) -> None:
    rng = np.random.default_rng(200 + seed)
    better = random_information(rng, 3, 10)
    lost = rng.normal(size=(10, 10))
    worse = np.eye(10) + 0.5 * (better[1] - np.eye(10))
    dominated = np.stack([better[0], better[1] + lost @ lost.T, worse, better[2]])
    weights = intersection_weights(dominated, np.eye(10))
    assert weights[2] <= 1e-9
    np.testing.assert_allclose(weights[[0, 1, 3]], intersection_weights(dominated[[0, 1, 3]], np.eye(10)), rtol=0.0, atol=1e-3)
