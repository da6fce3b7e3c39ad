"""Small questions: which cells are read, what is kept in memory, and that neither changes an answer."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import SMALL, area_of, fuse

import submin
from submin.network.cell import Cell
from submin.query.control_set import ControlSet
from submin.simulation.region import simulate_region
from submin.storage import accuracy_map, version_reader
from submin.storage.simulated import write_region
from submin.storage.snapshot import Snapshot

EVERYWHERE = (90.0, 30.0, 110.0, 40.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of 16 tiles."""
    folder = tmp_path_factory.mktemp("small")
    region = simulate_region(SMALL)
    write_region(region, folder / "catalogue")
    fuse(folder / "catalogue", folder / "network", area_of(region), tile_km=40.0, overlap_km=12.0)
    return folder / "network"


class Reads:
    """Numbers of the cells that snapshots read, without and with their sums."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.cells: list[int] = []
        self.sums: list[int] = []
        cells, sums = Snapshot.cells, Snapshot.some_sums

        def read_cells(snapshot: Snapshot, numbers: Sequence[int], *, with_sums: bool = True) -> list[Cell]:
            self.cells += numbers
            return cells(snapshot, numbers, with_sums=with_sums)

        def read_sums(snapshot: Snapshot, numbers: Sequence[int]) -> Any:
            self.sums += numbers
            return sums(snapshot, numbers)

        monkeypatch.setattr(Snapshot, "cells", read_cells)
        monkeypatch.setattr(Snapshot, "some_sums", read_sums)


def inner_box(network: submin.Network) -> tuple[float, float, float, float]:
    """A box of 20 km around the middle of a core of 40 km, where one tile alone holds the points."""
    west, south, east, north = network.cover.core_bounds(network.cover.tile_number("r001c001"))
    x, y = 0.5 * (west + east), 0.5 * (south + north)
    lon, lat = network.cover.geographic(np.array([x - 1e4, x + 1e4]), np.array([y - 1e4, y + 1e4]))
    return float(lon[0]), float(lat[0]), float(lon[1]), float(lat[1])


def same(one: ControlSet, other: ControlSet) -> None:
    np.testing.assert_array_equal(one.ids, other.ids)
    np.testing.assert_array_equal(one.geocentric, other.geocentric)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert (one.policy, one.tiles, one.blocks, one.scope) == (other.policy, other.tiles, other.blocks, other.scope)


def test_a_box_inside_a_cell_reads_this_cell_alone_and_once(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network, reads = submin.open(place), Reads(monkeypatch)
    box = inner_box(network)
    found = network.query(bbox=box)
    assert len(found) >= 1 and found.tiles == ("r001c001",) and found.scope == "tiles"
    assert [network.cover.holders(cell) for cell in reads.cells] == [(network.cover.tile_number("r001c001"),)]
    same(network.query(bbox=box), found)
    same(network.query(points=found.ids), found)
    assert len(reads.cells) == 1 and not reads.sums


def test_a_box_has_the_points_that_all_cells_together_have_in_it(place: Path) -> None:
    network = submin.open(place)
    every, rng = network.points(bbox=EVERYWHERE), np.random.default_rng(1)
    every = every.take(np.isin(every.ids, network.accuracy().ids))
    low, high = every.geodetic[:, :2].min(axis=0), every.geodetic[:, :2].max(axis=0)
    counts = []
    for _ in range(20):
        (west, east), (south, north) = np.sort(rng.uniform(low - 0.05, high + 0.05, (2, 2)), axis=0).T
        inside = ((every.geodetic[:, :2] > [west, south]) & (every.geodetic[:, :2] < [east, north])).all(axis=1)
        found = submin.open(place).accuracy(bbox=(west, south, east, north))
        assert set(found.ids) == set(every.ids[inside])
        counts.append(len(found))
    assert min(counts) < 5 and max(counts) > 30


@pytest.mark.parametrize("policy", ["ci", "rigorous"])
def test_merged_tiles_are_kept_for_the_next_question(place: Path, policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    network, reads = submin.open(place), Reads(monkeypatch)
    pair = [network.cover.tile_number(name) for name in ("r001c001", "r001c002")]
    alone = [
        cell.point_ids for tile in pair for number in network.existing(network.cover.cells_owned(tile))
        if network.cover.holders(number) == (tile,) for cell in network.some_cells([number])
    ]  # fmt: skip
    ids = np.concatenate(alone)
    first = network.query(points=ids, policy=policy)
    assert first.tiles == ("r001c001", "r001c002") and len(first) == len(ids)
    assert sorted(reads.sums) == sorted(set(reads.sums)) != []
    count = len(reads.sums)
    part = network.query(points=ids[::2], policy=policy)
    assert len(reads.sums) == count
    anew = submin.open(place).query(points=ids[::2], policy=policy)
    same(part, anew)
    assert part.blocks == first.blocks


@pytest.mark.parametrize("name", ["KEPT_CELLS", "KEPT_MERGES", "KEPT_IMAGES", "PROBED"])
def test_what_is_kept_does_not_change_an_answer(place: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = submin.open(place)
    monkeypatch.setattr(version_reader, name, 0)
    without = submin.open(place)
    questions: list[dict[str, Any]] = [
        {"bbox": inner_box(usual)}, {"bbox": EVERYWHERE, "policy": "rigorous"}, {"tile": "r001c001"},
        {"bbox": EVERYWHERE, "max_points": 7, "policy": "rigorous"},
    ]  # fmt: skip
    for question in questions * 2:
        one, other = usual.query(**question), without.query(**question)
        np.testing.assert_array_equal(one.ids, other.ids)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12, atol=1e-12)
        assert (one.tiles, one.blocks, one.scope) == (other.tiles, other.blocks, other.scope)
    one, other = usual.accuracy(), without.accuracy()
    np.testing.assert_array_equal(one.ids, other.ids)
    np.testing.assert_allclose(one.ce90, other.ce90, rtol=1e-12)


def test_only_all_tiles_are_the_network(place: Path) -> None:
    network = submin.open(place)
    assert network.query(bbox=EVERYWHERE, policy="rigorous").scope == "network"
    tiles = [network.query(tile=network.cover.tile_name(tile)) for tile in network.snapshot.tile_numbers()]
    assert {answer.scope for answer in tiles if len(answer)} == {"tiles"}


@pytest.mark.parametrize("policy", ["tile", "ci", "rigorous"])
def test_a_network_that_nobody_uses_any_more_is_gone_at_once(place: Path, policy: str) -> None:
    """It keeps up to a gigabyte, which must not wait for a garbage collection that looks for cycles."""
    network = submin.open(place)
    network.query(bbox=inner_box(network), policy=policy)
    network.accuracy(bbox=inner_box(network))
    used = weakref.ref(network)
    gc.disable()
    try:
        del network
        assert used() is None
    finally:
        gc.enable()


def test_accuracy_by_many_threads_is_that_by_one(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for threads in (1, 5):
        monkeypatch.setattr(accuracy_map, "THREADS", threads)
        found.append(submin.open(place).accuracy())
    assert len(np.unique(found[0].tile)) == 16
    for field in fields(found[0]):
        np.testing.assert_array_equal(getattr(found[0], field.name), getattr(found[1], field.name))
    network = submin.open(place)
    for name in ("r000c000", "r002c001"):
        asked = network.query(points=found[0].ids[found[0].tile == name][::9], tile=name)
        row = np.flatnonzero(np.isin(found[0].ids, asked.ids))
        row = row[np.argsort(found[0].ids[row])]
        np.testing.assert_allclose(found[0].local_covariance[row], asked.local_covariance, rtol=1e-9)
        np.testing.assert_allclose(found[0].geodetic[row], asked.geodetic, rtol=0.0, atol=1e-9)
