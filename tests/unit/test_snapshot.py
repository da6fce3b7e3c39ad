"""One version of a network: what was written comes back from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from registering import assert_same
from stores import COVER, METADATA, image_columns, new, random_cell, sub_min, write

import submin
from submin.errors import QueryError
from submin.storage.arrays import append_table, group_of, hash_ids, read_table
from submin.storage.schema import LEDGER_COLUMNS, write_cell, write_sub_min
from submin.storage.snapshot import Snapshot


def test_cell_comes_back(tmp_path: Path) -> None:
    place = new(tmp_path)
    number = COVER.cells_owned(1)[2]
    cell = random_cell(number)
    write(place, 1, lambda root: write_cell(root, COVER.cell_name(number), cell, 3.5, 9))
    snapshot = Snapshot.open(place)
    assert snapshot.cell_numbers() == (number,)
    found = snapshot.cell(number)
    assert_same(found, cell)
    np.testing.assert_array_equal(found.sums.information, cell.sums.information)
    np.testing.assert_array_equal(found.sums.vector, cell.sums.vector)
    assert (found.sums.misclosure, found.sums.redundancy) == (12.5, 17)
    without = snapshot.cell(number, with_sums=False)
    assert_same(without, cell)
    assert without.sums.information.size == 0
    attributes = snapshot.cell_counts([number])[0]
    accepted = [int(cell.rays.accepted[cell.rays.point == j].sum()) for j in range(len(cell))]
    assert (attributes["points"], attributes["rays"], attributes["accepted"]) == (5, 15, sum(accepted))
    assert attributes["determined"] == sum(count >= 2 for count in accepted)
    assert (attributes["square_px"], attributes["pixel_rays"]) == (3.5, 9)
    network = submin.open(place)
    images, sums = network.cell_sums(number)
    np.testing.assert_array_equal(images, cell.images)
    np.testing.assert_array_equal(sums.information, cell.sums.information)


def test_cell_is_replaced_whole_and_its_past_stays(tmp_path: Path) -> None:
    place = new(tmp_path)
    number = COVER.cells_owned(1)[2]
    name = COVER.cell_name(number)
    old, later = random_cell(number, seed=1, points=6), random_cell(number, seed=2, points=2)
    write(place, 1, lambda root: write_cell(root, name, old, 0.0, 0))
    write(place, 2, lambda root: write_cell(root, name, later, 0.0, 0))
    assert_same(Snapshot.open(place).cell(number), later)
    assert_same(Snapshot.open(place, "v1").cell(number), old)


def test_finer_cover_finds_the_cells_that_it_has_in_common(tmp_path: Path) -> None:
    place = new(tmp_path)
    finer = COVER.split(0)
    (part, *_), same = finer.cells_owned(finer.quarters(0)[0]), COVER.cells_owned(COVER.rows * COVER.columns - 1)[-1]
    assert 0 not in COVER.holders(same)
    cells = [random_cell(same, seed=1), random_cell(part, seed=2)]

    def refine(root: zarr.Group) -> None:
        write_cell(root, finer.cell_name(part), cells[1], 0.0, 0)
        write_sub_min(root, finer.tile_name(finer.quarters(0)[0]), sub_min(2), [part])
        root.attrs.update(replace(METADATA, cover=finer.to_mapping()).to_attributes())

    write(place, 1, lambda root: write_cell(root, COVER.cell_name(same), cells[0], 0.0, 0))
    write(place, 2, refine)
    assert (Snapshot.open(place, "v1").cover, Snapshot.open(place).cover) == (COVER, finer)
    assert Snapshot.open(place, "v1").cell_numbers() == (same,)
    snapshot = Snapshot.open(place)
    assert snapshot.cell_numbers() == (same, part)
    assert snapshot.tile_numbers() == (finer.quarters(0)[0],)
    for cell in cells:
        assert_same(snapshot.cell(cell.number), cell)
    # a change sees the version that it starts from with the tiles that it makes
    base = Snapshot.open(place, "v1")
    making = Snapshot(base.root, place, finer)
    assert making.cover == finer and making.number == 1
    assert making.cell_numbers() == (same,)
    assert_same(making.cell(same), cells[0])
    assert len(making.cell(part)) == 0


@pytest.mark.parametrize("images", [1, 5, 60])
def test_sub_min_comes_back_and_so_do_its_marginals(tmp_path: Path, images: int) -> None:
    # 60 images are 360 parameters: more than one chunk of 256
    place, expected = new(tmp_path), sub_min(images)
    write(place, 1, lambda root: write_sub_min(root, COVER.tile_name(2), expected, [4, 9]))
    snapshot = Snapshot.open(place)
    assert snapshot.tile_numbers() == (2,)
    np.testing.assert_array_equal(snapshot.tile_images(2), expected.images)
    found = snapshot.sub_min(2)
    np.testing.assert_array_equal(found.images, expected.images)
    np.testing.assert_array_equal(found.theta, expected.theta)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert (found.chi_square, found.redundancy) == (101.5, 99)
    some = np.union1d(expected.images[::3], [2**20]).astype(np.int32)
    marginal = snapshot.sub_min(2, some)
    at = np.flatnonzero(np.isin(expected.images, some))
    rows = (6 * at[:, None] + np.arange(6)).ravel()
    np.testing.assert_array_equal(marginal.images, expected.images[at])
    np.testing.assert_array_equal(marginal.theta, expected.theta[at])
    np.testing.assert_array_equal(marginal.covariance, expected.covariance[np.ix_(rows, rows)])


def test_tile_without_sub_min_is_named(tmp_path: Path) -> None:
    with pytest.raises(QueryError, match=f"tile {COVER.tile_name(3)} holds nothing yet"):
        submin.open(new(tmp_path)).sub_min(3, None)


def test_images_come_back_by_row(tmp_path: Path) -> None:
    place = new(tmp_path)
    write(place, 1, lambda root: append_table(group_of(root, "images"), image_columns(4)))
    write(place, 2, lambda root: append_table(group_of(root, "images"), image_columns(5, 4)))
    snapshot = Snapshot.open(place)
    every = snapshot.images()
    assert [i.image_id for i in every] == [f"image_id {k}" for k in range(9)]
    assert (every[7].camera, every[7].width, every[7].height, every[7].seconds) == ("camera 7", 7, 7, 7.0)
    assert [i.released for i in every] == [k % 2 == 1 for k in range(9)]
    assert snapshot.images([2, 3, 8]) == [every[2], every[3], every[8]]
    assert snapshot.images(np.array([5], dtype=np.int32)) == [every[5]]
    assert snapshot.images([]) == []
    assert snapshot.image_columns(["block_id"])["block_id"].tolist() == [f"block_id {k}" for k in range(9)]


@pytest.mark.parametrize("entries_at_a_time", [1, 3, 4, 100])
def test_directory_finds_the_last_cell_of_a_point(tmp_path: Path, entries_at_a_time: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("submin.storage.snapshot.DIRECTORY_PIECE", entries_at_a_time)
    place = new(tmp_path)

    def enter(root: zarr.Group, points: list[str], cells: list[int]) -> None:
        append_table(group_of(root, "directory"), {"hash": hash_ids(np.array(points)), "cell": np.array(cells)})

    write(place, 1, lambda root: enter(root, ["a", "b", "点", "moved"], [1, 2, 3, 4]))
    write(place, 2, lambda root: enter(root, ["moved", "c", "moved"], [40, 5, 44]))
    wanted = np.array(["moved", "none", "点", "a", "moved", "c"])
    np.testing.assert_array_equal(Snapshot.open(place).candidate_cells(wanted), [44, -1, 3, 1, 44, 5])
    np.testing.assert_array_equal(Snapshot.open(place, "v1").candidate_cells(wanted), [4, -1, 3, 1, 4, -1])
    whole = Snapshot.open(place)
    np.testing.assert_array_equal(whole.directory().cells_of(wanted), [44, -1, 3, 1, 44, 5])
    assert len(whole.directory()) == 7
    some = whole.directory_of(wanted[:2])
    assert len(some) == 1
    np.testing.assert_array_equal(some.cells_of(wanted[:2]), [44, -1])


@pytest.mark.parametrize(("entries", "kept"), [(3, True), (2, False)])
def test_a_large_directory_is_not_read_ahead(tmp_path: Path, entries: int, kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    place, ids = new(tmp_path), np.array(["a", "b", "c"])
    write(place, 1, lambda root: append_table(group_of(root, "directory"), {"hash": hash_ids(ids), "cell": np.arange(3)}))
    monkeypatch.setattr("submin.storage.snapshot.DIRECTORY_AHEAD", entries)
    snapshot = Snapshot.open(place)
    snapshot.read_ahead()
    read: list[Any] = []
    monkeypatch.setattr("submin.storage.snapshot.read_table", lambda *asked: read.append(asked) or read_table(*asked))
    np.testing.assert_array_equal(snapshot.candidate_cells(ids), [0, 1, 2])
    assert (not read) == kept


def test_ledger_comes_back(tmp_path: Path) -> None:
    place = new(tmp_path)
    content: dict[str, NDArray[Any]] = {
        name: np.array(["fused", "rejected"]) if kind == "text" else np.array([3, 4]) for name, kind in LEDGER_COLUMNS.items()
    }
    write(place, 1, lambda root: append_table(group_of(root, "ledger"), content))
    found = Snapshot.open(place).ledger(["status", "rays"])
    assert {name: values.tolist() for name, values in found.items()} == {"status": ["fused", "rejected"], "rays": [3, 4]}


def test_reader_keeps_its_version_while_another_is_written(tmp_path: Path) -> None:
    place = new(tmp_path)
    before = Snapshot.open(place)
    write(place, 1, lambda root: append_table(group_of(root, "images"), image_columns(3)))
    assert (before.version, before.image_count()) == ("v0", 0)
    network = submin.open(place)
    assert network.version == "v1"
    assert network.at("v0").version == "v0"
    assert network.at("v0").at("v1").version == "v1"
