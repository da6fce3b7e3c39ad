"""Thinning chooses by ids and registered positions alone, and changes nothing but what is reported."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import area_of, rewrite
from numpy.typing import NDArray

import submin
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.info import describe
from orchestration.run import run
from submin.errors import InputError
from submin.network.id_hash import hash_ids
from submin.network.thinning import one_a_square, reported_points
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.simulated import write_region
from submin.storage.snapshot import Snapshot

EVERYWHERE = (90.0, 30.0, 110.0, 40.0)
SIDE = 14_000.0
"""Points lie 6.5 km apart: some five to a square."""
HERE = SerialExecutor()
EXAMPLES = settings(max_examples=25, deadline=None)


@st.composite
def points(draw: st.DrawFn) -> tuple[NDArray[np.str_], NDArray[np.float64], NDArray[np.float64]]:
    seed, n = draw(st.integers(0, 2**31)), draw(st.integers(1, 120))
    random = np.random.default_rng(seed)
    place = random.uniform(-3000.0, 3000.0, (n, 2))
    place[random.random(n) < 0.2] = np.round(place[0], -3)  # some at one place, on a border
    return np.array([f"P{k}" for k in random.permutation(10 * n)[:n]]), place[:, 0].copy(), place[:, 1].copy()


@EXAMPLES
@given(points(), st.sampled_from([10.0, 333.0, 1000.0, 1e5]))
def test_one_of_each_square_and_it_is_the_one_of_least_hash(given: tuple, side: float) -> None:
    ids, east, north = given
    chosen = one_a_square(ids, east, north, side)
    squares: dict[tuple[int, int], list[int]] = {}
    for k in range(len(ids)):
        squares.setdefault((int(east[k] // side), int(north[k] // side)), []).append(k)
    hashes = hash_ids(ids)
    expected = {min(rows, key=lambda k: (hashes[k], ids[k])) for rows in squares.values()}
    assert set(np.flatnonzero(chosen).tolist()) == expected


@EXAMPLES
@given(points(), st.integers(0, 2**31))
def test_neither_order_nor_what_lies_in_other_squares_matters(given: tuple, seed: int) -> None:
    ids, east, north = given
    chosen = one_a_square(ids, east, north, 500.0)
    order = np.random.default_rng(seed).permutation(len(ids))
    np.testing.assert_array_equal(one_a_square(ids[order], east[order], north[order], 500.0), chosen[order])
    west = east < 0.0
    np.testing.assert_array_equal(one_a_square(ids[west], east[west], north[west], 500.0), chosen[west])


def test_no_points_are_no_points() -> None:
    assert len(one_a_square(np.empty(0, dtype="U1"), np.empty(0), np.empty(0), 1.0)) == 0


class Case:
    """A simulated region in four blocks, and a network of each order and thinning."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.region: SimulatedRegion = simulate_region(RegionDesign(width_km=60, height_km=60, point_spacing_km=6.5, bad_cameras=0, seed=7))
        write_region(self.region, folder / "catalogue")
        self.blocks = list(Catalogue.open(folder / "catalogue").blocks())

    def network(self, name: str, batches: list[list[Block]], thin_metres: float | None) -> Path:
        place = self.folder / name
        for batch in batches:
            catalogue = Catalogue.open(rewrite(self.folder / "catalogue", self.folder / f"{name}-{batch[0].block_id}", batch))
            if not place.exists():
                create(str(place), area_of(self.region), catalogue.metadata, 40.0, 15.0, thin_metres=thin_metres)
            assert run(catalogue, str(place), HERE).fused == len(batch)
        return place


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return Case(tmp_path_factory.mktemp("thinning"))


def only(block: Block, ids: NDArray[np.str_]) -> Block:
    """A block of which only the rays of some points were measured."""
    rows = np.isin(block.point_ids, ids)
    assert set(block.image[rows].tolist()) == set(range(len(block.images)))
    return dataclasses.replace(
        block, **{name: getattr(block, name)[rows] for name in ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")}
    )


@pytest.fixture(scope="module")
def pair(case: Case) -> tuple[submin.Network, submin.Network, NDArray[np.str_]]:
    """The same batches with and without thinning. The last batch sees only points that the thinned network does not report."""
    batches = [case.blocks[:2], case.blocks[2:3]]
    kept = submin.open(case.network("thinned", batches, SIDE)).query(bbox=EVERYWHERE, policy="rigorous").ids
    hidden = np.setdiff1d(case.region.point_ids, kept)
    last = [only(case.blocks[3], hidden)]
    return submin.open(case.network("thinned", [last], SIDE)), submin.open(case.network("whole", [*batches, last], None)), hidden


@pytest.mark.parametrize("version", ["v1", "v2", "v3"])
@pytest.mark.parametrize("policy", ["rigorous", "ci"])
def test_what_is_reported_is_as_without_thinning_whatever_comes_later(pair: tuple, version: str, policy: str) -> None:
    thinned, whole = pair[0].at(version), pair[1].at(version)
    answer = thinned.query(bbox=EVERYWHERE, policy=policy)
    every = whole.query(bbox=EVERYWHERE, policy="rigorous")
    assert 5 < len(answer) < 0.6 * len(every)
    same = whole.query(points=answer.ids, policy=policy)
    sigma = np.sqrt(np.diag(same.covariance))
    assert (np.abs(answer.geocentric - same.geocentric).ravel() / sigma).max() < 1e-12
    assert (np.abs(answer.covariance - same.covariance) / sigma / sigma[:, None]).max() < 1e-12
    for tile in thinned.snapshot.tile_numbers():
        name = thinned.cover.tile_name(tile)
        own = thinned.query(tile=name)
        np.testing.assert_array_equal(own.covariance, whole.query(points=own.ids, tile=name).covariance)
        assert set(own.ids) <= set(answer.ids)


def test_rays_on_points_that_are_not_reported_improve_those_that_are(pair: tuple) -> None:
    thinned, whole, hidden = pair
    before = thinned.at("v2").query(bbox=EVERYWHERE, policy="rigorous")
    after = thinned.query(points=before.ids, policy="rigorous")
    assert not np.isin(before.ids, hidden).any()
    np.testing.assert_array_equal(after.rays, before.rays)
    # no direction is less certain than before, but for what the new linearisation moves
    assert la.eigh(after.covariance, before.covariance, eigvals_only=True).max() < 1.0 + 1e-3
    assert np.median(after.ce90 / before.ce90) < 0.97
    np.testing.assert_allclose(after.covariance, whole.query(points=before.ids, policy="rigorous").covariance, rtol=1e-12, atol=1e-12)


def test_order_leaves_no_trace_in_the_selection(case: Case) -> None:
    together = submin.open(case.network("together", [case.blocks], SIDE))
    turned = submin.open(case.network("turned", [case.blocks[:0:-1], case.blocks[:1]], SIDE))
    ids = together.query(bbox=EVERYWHERE, policy="rigorous").ids
    assert len(ids) > 5
    np.testing.assert_array_equal(turned.query(bbox=EVERYWHERE, policy="rigorous").ids, ids)
    np.testing.assert_array_equal(np.sort(turned.accuracy().ids), ids)


def test_at_most_one_a_square_and_cell_and_none_without_a_reason(pair: tuple) -> None:
    network = pair[0]
    answer = network.query(bbox=EVERYWHERE, policy="rigorous")
    chosen = 0
    for number in network.cell_numbers():
        cell = network.cell(number)
        reported = reported_points(cell, network.cover, SIDE)
        metadata = network.points(points=cell.point_ids)
        np.testing.assert_array_equal(metadata.reported, reported)
        east, north = network.cover.plane(metadata.registered[:, 0], metadata.registered[:, 1])
        squares = set(zip(np.floor(east / SIDE).tolist(), np.floor(north / SIDE).tolist(), strict=True))
        assert reported.sum() == len(squares)
        determined = ~np.isin(metadata.status, ["pending", "undetermined"])
        # a chosen point without a position leaves its square empty: the rule reads ids and registered positions alone
        np.testing.assert_array_equal(np.isin(cell.point_ids, answer.ids), reported & determined)
        chosen += int((reported & determined).sum())
    assert chosen == len(answer)


def test_points_asked_for_by_name_are_answered(pair: tuple) -> None:
    thinned, whole, hidden = pair
    asked = np.intersect1d(hidden, whole.query(bbox=EVERYWHERE).ids)[:5]
    answer = thinned.query(points=asked, policy="rigorous")
    assert answer.ids.tolist() == asked.tolist()
    np.testing.assert_array_equal(answer.covariance, whole.query(points=asked, policy="rigorous").covariance)
    assert not thinned.points(points=asked).reported.any()


def test_info_counts_what_is_kept_and_what_is_reported(pair: tuple) -> None:
    thinned, whole, _ = pair
    values, plain = describe(thinned), describe(whole)
    assert values["points"] == plain["points"] == plain["points_reported"] == len(whole.query(bbox=EVERYWHERE, policy="rigorous"))
    assert values["points_reported"] == len(thinned.query(bbox=EVERYWHERE, policy="rigorous"))
    assert values["points_reported"] + values["points_thinned"] == values["points"]
    assert (values["thin_metres"], plain["thin_metres"]) == (SIDE, 0.0)
    assert values["rays"] == plain["rays"]


def test_the_side_is_a_length(case: Case, tmp_path: Path) -> None:
    metadata = Catalogue.open(case.folder / "catalogue").metadata
    for side in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="--thin-metres is .*; expected a positive length"):
            create(str(tmp_path / "network"), area_of(case.region), metadata, 40.0, 15.0, thin_metres=side)
    assert not (tmp_path / "network").exists()


def test_a_network_from_before_thinning_reports_every_point(case: Case, pair: tuple) -> None:
    """Its metadata do not say anything of it."""
    snapshot = Snapshot.open(pair[1].snapshot.place)
    values = snapshot.metadata.to_attributes()
    del values["submin"]["thinning"]
    assert type(snapshot.metadata).from_attributes(values, "old").thinning == 0.0
