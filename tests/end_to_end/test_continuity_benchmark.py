"""`python -m benchmarks continuity` on a small region: its truths are those of the dense adjustments, and its claims hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from networks import SMALL, area_of
from numpy.typing import NDArray
from property.exact_covariance import adjusted_together, equations, inflated, intersected, largest_ratio, located, split
from shapely.geometry.base import BaseGeometry

from benchmarks import border, continuity, continuity_measures
from benchmarks.border import RECONCILED, RIGOROUS, TILE, Answer
from benchmarks.comparison import NOT_MET
from benchmarks.continuity_scenes import Scene
from benchmarks.linear_estimates import MERGED, cross_covariance, together
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.reconcile import reconcile
from orchestration.run import run
from submin import Network
from submin import open as open_network
from submin.query.bounded_inflation import correlation_bounds, inflation
from submin.query.covariance_intersection import intersection_weights
from submin.query.padded_tiles import padded_tiles
from submin.query.split_intersection import split_weights
from submin.simulation.region import simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import write_region

Array = NDArray[np.float64]

REGION = simulate_region(replace(SMALL, blunder_rate=0.0, bad_cameras=0, seed=5))


def catalogue(folder: Path, scale: float) -> Catalogue:
    write_region(REGION, folder)
    return Catalogue.open(folder)


def area(scale: float) -> BaseGeometry:
    return area_of(REGION)


SCENE = Scene("small", 50.0, 60.0, (0.0, 0.4), 30.0, 10.0, 15.0, catalogue, area)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Network:
    """Cut into tiles with an overlap of 20 km, not reconciled."""
    folder = tmp_path_factory.mktemp("continuity")
    made = catalogue(folder / "catalogue", 1.0)
    create(str(folder / "network"), area(1.0), made.metadata, SCENE.core_km, 20.0)
    assert not run(made, str(folder / "network"), SerialExecutor()).rejected
    return open_network(folder / "network")


@pytest.fixture(scope="module")
def asked(network: Network) -> border.Question:
    return continuity_measures.questions(SCENE, network)[0]


@pytest.fixture(scope="module")
def answered(network: Network, asked: border.Question) -> dict[str, Answer]:
    before = network.snapshot.number
    reconcile(network.snapshot.place, SerialExecutor())
    after = open_network(network.snapshot.place)
    assert after.snapshot.number == before + 1
    return dict(border.answers(network, after, asked, border.monolithic(network)))


def test_borders_are_where_cores_meet(network: Network) -> None:
    cover = network.cover
    found = border.borders(cover)
    assert len(found) == cover.rows * (cover.columns - 1) + (cover.rows - 1) * cover.columns
    for one, other, axis, at, low, high in found:
        assert high - low == pytest.approx(cover.core)
        a, b = (0.5 * (cover.core_outline(tile).min(axis=0) + cover.core_outline(tile).max(axis=0)) for tile in (one, other))
        assert 0.5 * (a + b)[axis] == pytest.approx(at)
        assert a[axis] < at < b[axis]


def test_a_question_is_about_two_tiles(network: Network, asked: border.Question) -> None:
    held = [set(network.query(tile=network.cover.tile_name(tile)).ids.tolist()) for tile in asked.border[:2]]
    assert set(asked.ids[asked.shared].tolist()) == set(asked.ids.tolist()) & held[0] & held[1]
    assert set(asked.ids.tolist()) <= held[0] | held[1]
    assert (np.sign(asked.offset) == np.where(asked.owner == asked.border.other, 1.0, -1.0)).all()
    at = network.query(points=asked.ids, policy="rigorous").geocentric
    length = np.linalg.norm(at[:, None] - at, axis=2)
    assert np.count_nonzero(np.triu(length < 1e3 * SCENE.near_km, 1)) == pytest.approx(len(asked.pairs), abs=1)


def test_truth_is_that_of_the_dense_adjustments(network: Network, asked: border.Question, answered: dict[str, Answer]) -> None:
    problem, tiles = equations(network), list(asked.border[:2])
    padded = padded_tiles(network, tiles)
    functionals = padded.functionals(asked.parts)
    maps = {
        "ci": intersected(problem, tiles, intersection_weights(padded.of_tiles, functionals)),
        "bci": inflated(problem, tiles, inflation(padded.of_tiles, correlation_bounds(padded), functionals)),
        "naive": inflated(problem, tiles, np.ones(2)),
        "split": split(problem, tiles, split_weights(padded, functionals)),
        "rigorous": adjusted_together(problem, tiles, np.ones(1)),
        "monolithic": adjusted_together(problem, list(network.cover.tiles()), np.ones(1)),
    }
    assert set(MERGED) <= set(maps)
    for policy, of_images in maps.items():
        linear_map = located(problem, of_images, asked.ids)
        expected = linear_map @ linear_map.T
        sigma = np.sqrt(np.diagonal(expected))
        assert (np.abs(answered[policy].true - expected) / sigma / sigma[:, None]).max() < 1e-7, policy
        origin = problem.origin[np.isin(problem.point_ids, asked.ids)]
        positions = origin + (linear_map @ problem.data).reshape(-1, 3)
        np.testing.assert_allclose(answered[policy].geocentric, positions, rtol=0.0, atol=1e-6, err_msg=policy)


def test_truth_of_tiles_side_by_side_is_that_of_the_dense_adjustments(
    network: Network, asked: border.Question, answered: dict[str, Answer]
) -> None:
    problem = equations(network)
    maps = np.zeros((3 * len(asked.ids), len(problem.data)))
    for tile in asked.border[:2]:
        mine = (asked.owner == tile).repeat(3)
        maps[mine] = located(problem, adjusted_together(problem, [tile], np.ones(1)), asked.ids)[mine]
    expected = maps @ maps.T
    sigma = np.sqrt(np.diagonal(expected))
    assert (np.abs(answered[TILE].true - expected) / sigma / sigma[:, None]).max() < 1e-7
    for points in answered[TILE].stated:
        rows = np.flatnonzero(points.repeat(3))
        assert largest_ratio(expected[np.ix_(rows, rows)], answered[TILE].reported[np.ix_(rows, rows)]) <= 1.0 + 1e-6


def test_all_tiles_merged_are_the_monolithic_network(network: Network, asked: border.Question) -> None:
    whole = border.monolithic(network)
    padded = padded_tiles(network, list(network.cover.tiles()))
    estimate = together(padded, np.empty((0, 0)))
    for covariance in (estimate.claimed, cross_covariance(padded, estimate, estimate)):
        images = padded.prior @ covariance @ padded.prior.T
        np.testing.assert_allclose(images, whole.covariance, rtol=0.0, atol=1e-9 * np.abs(whole.covariance).max())


def test_what_is_consistent_and_what_is_not(answered: dict[str, Answer]) -> None:
    ratios = {policy: border.largest_eigenvalue(a.true, a.reported) for policy, a in answered.items() if policy != TILE}
    assert 1.5 < ratios.pop("naive") <= 2.0 + 1e-6
    assert max(ratios.values()) <= continuity.CONSISTENT
    # between tiles nothing is stated, and to take them for independent is too much
    assert border.largest_eigenvalue(answered[TILE].true, answered[TILE].reported) > 1.2
    assert border.largest_eigenvalue(answered[RECONCILED].reported, answered[RECONCILED].true) <= continuity.CONSISTENT


def test_rows_and_figures_of_a_small_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(continuity, "SCENES", (replace(SCENE, overlaps=(0.0, 1.0), width_km=20.0),))
    monkeypatch.setattr(continuity, "PROFILES", (("small", 0.0), ("small", 1.0)))
    monkeypatch.setattr(continuity, "MAPS", (("small", 0.0, TILE), ("small", 1.0, TILE), ("small", 1.0, RIGOROUS)))
    rows = continuity.measure(1.0, 0, tmp_path)
    assert [row for row in rows if row["verdict"] == NOT_MET] == []
    border_rows = {(row["overlap"], row["policy"]): row for row in rows if "straddle ratio" in row}
    for overlap in (0.0, 1.0):
        assert border_rows[overlap, "monolithic"]["straddle ratio"] == 1.0
        assert border_rows[overlap, TILE]["straddle ratio"] > 1.01
        assert abs(border_rows[overlap, RECONCILED]["straddle ratio"] - 1.0) < 1e-6
        assert border_rows[overlap, RECONCILED]["largest"] < 1e-6 < border_rows[overlap, TILE]["largest"]
    assert border_rows[0.0, TILE]["step, m"] == ""
    assert border_rows[1.0, TILE]["step, m"] > 1e-3 > 1e-6 > border_rows[1.0, RECONCILED]["step, m"]
    assert {row["single points"] for row in rows if "single points" in row} == {continuity_measures.SINGLE_POINTS}
    assert all(row["largest eigenvalue"] <= continuity.CONSISTENT for row in rows if row.get("policy") in continuity.CONSISTENT_POLICIES
               and "largest eigenvalue" in row)  # fmt: skip
    for name in ("continuity-profile.png", "continuity-map.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_a_scene_too_small_for_pairs_across_a_border_is_refused(network: Network) -> None:
    with pytest.raises(RuntimeError, match="no border has pairs of points across it; expected a larger --scale"):
        continuity_measures.at_overlap(replace(SCENE, near_km=1e-6), 0.4, network, network, None)


def test_areas_shrink_about_their_middle() -> None:
    from benchmarks.continuity_scenes import around

    assert shapely.equals_exact(around((10.0, 20.0, 14.0, 22.0), 0.25), shapely.box(11.0, 20.5, 13.0, 21.5), tolerance=1e-12)
