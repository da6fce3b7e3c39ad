"""Every merge policy on a small simulated region, against the exact error covariance of its estimate (exact_covariance.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, pairwise
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
    inflated,
    inflated_point,
    information,
    intersected,
    largest_ratio,
    located,
    monolithic,
    split,
    weighted_sum,
)
from property.random_information import random_functionals, random_information, trace_of
from shapely.geometry.base import BaseGeometry

import submin
from submin.adjustment.priors import APriori
from submin.errors import QueryError
from submin.network.sub_min import marginal
from submin.query import bounded_inflation, covariance_intersection, split_intersection
from submin.query.bounded_inflation import inflation
from submin.query.control_set import ControlSet
from submin.query.covariance_intersection import intersection_weights
from submin.query.padded_tiles import padded_tiles
from submin.query.planner import POLICIES, determined_parts, points_in_area
from submin.query.source import existing_cells
from submin.query.tile_pair import TilePair
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
    "bci": Row(inflated, SEVERAL_TILES),
    "split": Row(split, SEVERAL_TILES),
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


CHOICES: dict[str, list[tuple[object, str]]] = {
    "ci": [(covariance_intersection, "intersection_weights"), (TilePair, "weights")],
    "bci": [(bounded_inflation, "inflation")],
    "split": [(split_intersection, "split_weights")],
}
"""What a policy chooses for a query, and where; of two tiles `ci` chooses by itself."""


def asked(made: Made, policy: str, monkeypatch: pytest.MonkeyPatch, **question: object) -> tuple[ControlSet, Array]:
    """An answer, and the weights or scales that the policy chose for it (1 where it chose none)."""
    chosen = [np.ones(1)]
    for module, name in CHOICES.get(policy, []):
        choose = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *arguments, choose=choose: chosen.append(choose(*arguments)) or chosen[-1])
    return made.network.query(policy=policy, **question), chosen[-1]  # type: ignore[arg-type]


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
    if policy not in CHOICES:
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


@pytest.mark.parametrize("name", ["overlap", "released camera"])
def test_a_point_by_itself_is_inflated_by_what_its_tiles_share(
    name: str, networks: Callable[[str], Made], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, gained = networks(name), []
    for place in ("overlap of two", "overlap of four"):
        for point in made.places[place][:4]:
            scales: list[Array] = []
            fused: list[tuple[Array, Array, Array]] = []
            with monkeypatch.context() as patch:

                def recorded(*what: Array, scales: list[Array] = scales, fused: list[tuple[Array, ...]] = fused) -> Array:
                    fused.append(what)
                    scales.append(inflation(*what))
                    return scales[-1]

                patch.setattr(bounded_inflation, "inflation", recorded)
                control = made.network.query(points=[point], policy="bci")
            tiles = [made.network.cover.tile_number(tile) for tile in control.tiles]
            maps = [
                located(made.problem, inflated(made.problem, tiles, scales[0]), control.ids),
                inflated_point(made.problem, tiles, scales[1], control.ids),
            ]
            origin = made.problem.origin[made.problem.point_ids == point]
            linear_map = min(maps, key=lambda m: np.abs(origin + (m @ made.problem.data).reshape(-1, 3) - control.geocentric).max())
            np.testing.assert_allclose(control.geocentric, origin + (linear_map @ made.problem.data).reshape(-1, 3), rtol=0.0, atol=1e-7)
            assert largest_ratio(linear_map @ linear_map.T, control.covariance) <= CONSISTENT
            intersected, rigorous = (made.network.query(points=[point], policy=policy).covariance for policy in ("ci", "rigorous"))
            assert np.trace(rigorous) <= np.trace(control.covariance) * (1.0 + 1e-9) <= np.trace(intersected) * (1.0 + 2e-9)
            information, _, trace_of_point = fused[1]
            unbounded = trace_of(intersection_weights(information, trace_of_point), information, trace_of_point)
            gained.append(trace_of(1.0 / scales[1], information, trace_of_point) / unbounded)
    assert max(gained) <= 1.0 + 1e-9


@pytest.mark.parametrize("place", ["overlap of two", "overlap of four", "border"])
def test_what_is_known_to_be_independent_is_used(overlapping: Made, place: str) -> None:
    """The more is known of what tiles share, the tighter the claim."""
    trace = {
        policy: np.trace(overlapping.network.query(points=overlapping.places[place], policy=policy).covariance) for policy in
        ("rigorous", "split", "bci", "ci")
    }  # fmt: skip
    assert trace["rigorous"] < trace["split"] < trace["ci"]
    assert trace["rigorous"] < trace["bci"] <= trace["ci"] * (1.0 + 1e-9)


def test_intersection_is_never_worse_than_its_best_tile(overlapping: Made) -> None:
    ids = overlapping.places["overlap of four"]
    merged = overlapping.network.query(points=ids, policy="ci")
    assert len(merged.tiles) == 4
    alone = [np.trace(overlapping.network.query(points=ids, tile=tile).covariance) for tile in merged.tiles]
    everything = np.trace(overlapping.network.query(points=ids, policy="rigorous").covariance)
    assert everything <= np.trace(merged.covariance) <= min(alone) * (1.0 + 1e-6)


@pytest.mark.parametrize("second", [0.0, 0.3, 1.0])
def test_a_pair_of_tiles_is_what_its_weights_make_of_both(made: Made, second: float) -> None:
    network, tiles = made.network, (0, 1)
    padded = padded_tiles(network, tiles)
    pair, weights = TilePair.of(padded), np.array([1.0 - second, second])
    _, parts = determined_parts(network, points_in_area(network, made.area)[:2])
    images = np.unique(np.concatenate([part.linear.image for part in parts]))[1:].astype(np.int32)
    found, expected = pair.state(weights, images), marginal(padded.weighted(padded.holds @ weights, 1.0), images)
    np.testing.assert_array_equal(found.images, expected.images)
    np.testing.assert_array_equal(found.behind, padded.rows)
    sigma = np.sqrt(np.diag(expected.covariance))
    assert (np.abs(found.covariance - expected.covariance) / sigma / sigma[:, None]).max() < 1e-9
    assert (np.abs(found.theta - expected.theta).ravel() / sigma).max() < 1e-9
    squares, functionals = pair.squares(parts), padded.functionals(parts)
    assert (squares / pair.information(weights)).sum() == pytest.approx(trace_of(weights, padded.of_tiles, functionals), rel=1e-9)
    best = pair.weights(squares)
    searched = intersection_weights(padded.of_tiles, functionals)
    assert best.sum() == 1.0 and best.min() >= 0.0
    assert trace_of(best, padded.of_tiles, functionals) <= trace_of(searched, padded.of_tiles, functionals) * (1.0 + 1e-9)


def test_few_and_many_points_have_the_same_squares(overlapping: Made) -> None:
    network, pair = overlapping.network, TilePair.of(padded_tiles(overlapping.network, (0, 1)))
    held = existing_cells(network, (0, 1))
    _, parts = determined_parts(network, [s for s in points_in_area(network, overlapping.area) if s.cell.number in held])
    one_by_one = [pair.squares([part]) for part in parts]
    assert 3 * sum(len(part.origin) for part in parts) > len(pair.reach) > 3 * len(parts[0].origin)
    np.testing.assert_allclose(pair.squares(parts), np.sum(one_by_one, axis=0), rtol=1e-9)


def test_intersection_of_one_tile_is_the_tile(overlapping: Made) -> None:
    ids = overlapping.places["one cell"]
    merged, alone = (overlapping.network.query(points=ids, policy=policy) for policy in ("ci", "tile"))
    assert merged.tiles == alone.tiles and len(merged.tiles) == 1
    np.testing.assert_allclose(merged.geocentric, alone.geocentric, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(merged.covariance, alone.covariance, rtol=0.0, atol=1e-9 * np.abs(alone.covariance).max())


@pytest.mark.parametrize(("one", "other"), [((1, 0), (1, 1)), ((0, 0), (1, 1)), ((1, 1), (1, 1)), ((0, 0), (2, 2))])
def test_the_cross_covariance_of_two_tiles_is_exact(made: Made, one: tuple[int, int], other: tuple[int, int]) -> None:
    problem, cover = made.problem, made.network.cover
    tiles = [row * cover.columns + column for row, column in (one, other)]
    ids = [problem.point_ids[np.isin(problem.point_cell, problem.held([tile]))][::3] for tile in tiles]
    maps = [located(problem, adjusted_together(problem, [t], np.ones(1)), i) for t, i in zip(tiles, ids, strict=True)]
    found = made.network.cross_covariance(cover.tile_name(tiles[0]), cover.tile_name(tiles[1]), ids[0], ids[1])
    expected = maps[0] @ maps[1].T
    scale = np.sqrt(np.outer(np.square(maps[0]).sum(axis=1), np.square(maps[1]).sum(axis=1)))
    assert (np.abs(found - expected) / scale).max() < 1e-9


def test_the_cross_covariance_keeps_the_order_of_the_ids(overlapping: Made) -> None:
    cover, problem = overlapping.network.cover, overlapping.problem
    names = [cover.tile_name(tile) for tile in (0, 1)]
    ids = [problem.point_ids[np.isin(problem.point_cell, problem.held([tile]))][:4] for tile in (0, 1)]
    one = overlapping.network.cross_covariance(*names, *ids)
    turned = overlapping.network.cross_covariance(*names, ids[0][::-1], ids[1])
    np.testing.assert_array_equal(turned.reshape(4, 3, 12), one.reshape(4, 3, 12)[::-1])
    np.testing.assert_allclose(overlapping.network.cross_covariance(*names[::-1], *ids[::-1]), one.T, rtol=0.0, atol=1e-9)
    with pytest.raises(QueryError, match=r"tile r000c000 does not hold 1 of 2 points.*elsewhere"):
        overlapping.network.cross_covariance(*names, ["elsewhere", str(ids[0][0])], ids[1])


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


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("tiles", [2, 3, 5])
def test_inflation_lies_between_independence_and_intersection(seed: int, tiles: int) -> None:
    rng = np.random.default_rng(300 + seed)
    information = random_information(rng, tiles, 9)
    functionals = random_functionals(rng, 9)

    def trace(bound: float) -> float:
        scale = bounded_inflation.inflation(information, np.full((tiles, tiles), bound), functionals)
        return trace_of(1.0 / scale, information, functionals)

    independent = trace_of(np.ones(tiles), information, functionals)
    intersected = trace_of(intersection_weights(information, functionals), information, functionals)
    assert trace(0.0) == pytest.approx(independent, rel=1e-12)
    assert trace(1.0) == pytest.approx(intersected, rel=1e-9)
    bounds = [trace(bound) for bound in (0.0, 0.3, 0.7, 0.95, 1.0)]
    assert all(tighter <= looser * (1.0 + 1e-4) for tighter, looser in pairwise(bounds))


@pytest.mark.parametrize("seed", range(10))
def test_scaled_covariances_bound_whatever_is_correlated_within_the_bound(seed: int) -> None:
    """Three estimates of random cross-correlations, fused with the scales of the policy: the true covariance is below the claim."""
    rng = np.random.default_rng(400 + seed)
    size, count = 4, 3
    common, own = rng.normal(size=(count, size, 6)), rng.normal(size=(count, size, 5))
    covariance = np.stack([c @ c.T + o @ o.T for c, o in zip(common, own, strict=True)])
    roots = [np.linalg.inv(np.linalg.cholesky(p)) for p in covariance]
    bound = np.array([[np.linalg.norm(roots[s] @ common[s] @ common[t].T @ roots[t].T, 2) for t in range(count)] for s in range(count)])
    information = np.linalg.inv(covariance)
    scale = bounded_inflation.inflation(information, bound, np.eye(size))
    claimed = np.linalg.inv(sum(j / c for j, c in zip(information, scale, strict=True)))
    gains = [claimed @ j / c for j, c in zip(information, scale, strict=True)]
    shared = sum(g @ c for g, c in zip(gains, common, strict=True))
    true = shared @ shared.T + sum(g @ o @ o.T @ g.T for g, o in zip(gains, own, strict=True))
    assert largest_ratio(true, claimed) <= 1.0 + 1e-9


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
