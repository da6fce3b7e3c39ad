"""The store of a network: what is created, written and read back, version by version, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import icechunk
import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from registering import assert_same
from shapely.geometry import box

import submin
from submin.adjustment.elimination import Sums
from submin.adjustment.rays import Rays
from submin.errors import ConflictError, QueryError, StoreError
from submin.geodesy import Ellipsoid
from submin.network.cell import Cell
from submin.network.sub_min import SubMin
from submin.storage import network_store
from submin.storage.arrays import append_table, group_of, hash_ids
from submin.storage.network_store import Snapshot, begin_change, commit, create_network, find_version, tag_version, versions
from submin.storage.schema import (
    FORMAT_VERSION,
    IMAGE_COLUMNS,
    LEDGER_COLUMNS,
    NetworkMetadata,
    write_cell,
    write_sub_min,
)
from submin.tiling.area import cover_area

Array = NDArray[np.float64]

COVER = cover_area(box(5.0, 43.0, 5.5, 43.4), 20e3, 4e3)
METADATA = NetworkMetadata("provence", "Earth", "ITRF2014", "2010.0", 6378137.0, 1.0 / 298.257223563, COVER.to_mapping())


def new(tmp_path: Path) -> str:
    place = str(tmp_path / "network")
    create_network(place, METADATA)
    return place


def write(place: str, version: int, change: Any) -> None:
    """Commit one version: ``change`` gets the root."""
    session, _ = begin_change(place, Snapshot.open(place).number)
    root = zarr.open_group(session.store, mode="r+")
    change(root)
    root.attrs["version"] = version
    commit(session, version, f"batch {version}")


def random_cell(number: int, seed: int = 1, points: int = 5) -> Cell:
    rng = np.random.default_rng(seed)
    images = np.sort(rng.choice(50, 4, replace=False)).astype(np.int32)
    point = np.repeat(np.arange(points, dtype=np.int32), 3)
    rays = Rays(
        point, rng.integers(0, 4, len(point)).astype(np.int32), rng.normal(5e3, 1e3, (len(point), 2)),
        rng.uniform(0.3, 1.0, (len(point), 2)), rng.uniform(size=len(point)) < 0.7,
    )  # fmt: skip
    return Cell(
        number, np.array([f"SET/点{i}" for i in range(points)]), rng.normal(0.0, 4e6, (points, 3)), rng.normal(0.0, 4e6, (points, 3)),
        images, rng.normal(size=(4, 6)), rays,
        Sums(np.tril(rng.normal(size=(24, 24))), rng.normal(size=24), 12.5, 17),
    )  # fmt: skip


def image_columns(count: int, first: int = 0) -> dict[str, NDArray[Any]]:
    kinds: dict[str, NDArray[Any]] = {}
    for name, kind in IMAGE_COLUMNS.items():
        if kind == "text":
            kinds[name] = np.array([f"{name} {first + k}" for k in range(count)])
        else:
            kinds[name] = np.arange(first, first + count).astype(kind)
    return kinds | {"licence": np.full(count, ""), "released": (np.arange(first, first + count) % 2).astype(np.uint8)}


# Creating and opening


def test_new_network_is_version_zero_and_empty(tmp_path: Path) -> None:
    place = str(tmp_path / "network")
    version = create_network(place, METADATA)
    assert (version.name, version.message) == ("v0", "created")
    snapshot = Snapshot.open(place)
    assert snapshot.version == "v0"
    assert snapshot.metadata == METADATA
    assert snapshot.cover == COVER
    assert (snapshot.cell_numbers(), snapshot.tile_numbers(), snapshot.image_count(), snapshot.flags()) == ((), (), 0, set())
    assert snapshot.images() == [] and len(snapshot.ledger()["block_id"]) == 0
    number = COVER.cells_owned(1)[2]
    assert len(snapshot.cell(number)) == 0 and snapshot.cell(number).number == number
    np.testing.assert_array_equal(snapshot.candidate_cells(np.array(["a", "b"])), [-1, -1])
    assert len(snapshot.candidate_cells(np.empty(0, dtype="U1"))) == 0


def test_metadata_come_back_with_their_body(tmp_path: Path) -> None:
    moon = replace(METADATA, body="Moon", semimajor_axis=1737400.0, flattening=0.0)
    create_network(str(tmp_path / "moon"), moon)
    assert Snapshot.open(str(tmp_path / "moon")).metadata.ellipsoid == Ellipsoid(1737400.0, 0.0)


def test_empty_folder_will_do(tmp_path: Path) -> None:
    (tmp_path / "network").mkdir()
    assert create_network(str(tmp_path / "network"), METADATA).number == 0


def test_what_is_there_is_not_overwritten(tmp_path: Path) -> None:
    place = new(tmp_path)
    with pytest.raises(StoreError, match="network: already exists; choose another place"):
        create_network(place, METADATA)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StoreError, match="file: already exists"):
        create_network(str(tmp_path / "file"), METADATA)
    assert (tmp_path / "file").read_text() == "mine"
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter").write_text("mine")
    with pytest.raises(StoreError, match="folder: already exists"):
        create_network(str(tmp_path / "folder"), METADATA)
    assert [p.name for p in (tmp_path / "folder").iterdir()] == ["letter"]
    assert Snapshot.open(place).version == "v0"


def test_place_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StoreError, match="network: "):
        create_network(str(tmp_path / "file" / "network"), METADATA)


def test_an_empty_folder_becomes_a_network_and_keeps_nothing_of_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "network").mkdir()

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device")

    for place in ("network", "other"):
        with monkeypatch.context() as patch, pytest.raises(StoreError, match=rf"{place}: cannot be written \(No space left on device\)"):
            patch.setattr("submin.storage.network_store.create_table", full)
            create_network(str(tmp_path / place), METADATA)
    assert [path.name for path in tmp_path.rglob("*")] == ["network"]
    assert Snapshot.open(new(tmp_path)).version == "v0"


def test_what_is_not_a_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="nowhere: no such network; make one with 'submin create'"):
        Snapshot.open(str(tmp_path / "nowhere"))
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StoreError, match="file: is a file; expected the folder of a network"):
        Snapshot.open(str(tmp_path / "file"))
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "letter").write_text("mine")
    for opening in (Snapshot.open, submin.open, versions):
        with pytest.raises(StoreError, match="folder: not a network .*; make one with 'submin create'"):
            opening(str(tmp_path / "folder"))


def test_repository_of_something_else_is_refused(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    icechunk.Repository.create(icechunk.local_filesystem_storage(str(empty)))
    with pytest.raises(StoreError, match="empty: holds a repository but no network"):
        Snapshot.open(str(empty))
    other = tmp_path / "other"
    session = icechunk.Repository.create(icechunk.local_filesystem_storage(str(other))).writable_session("main")
    zarr.create_group(session.store, attributes={"title": "temperatures"})
    session.commit("a data cube")
    with pytest.raises(StoreError, match="other: not a network .its root has no 'submin' attributes"):
        Snapshot.open(str(other))


@pytest.mark.parametrize("format_version", [FORMAT_VERSION + 1, 0, None])
def test_other_format_versions_are_refused(tmp_path: Path, format_version: int | None) -> None:
    place = new(tmp_path)

    def change(root: zarr.Group) -> None:
        root.attrs["submin"] = METADATA.to_attributes()["submin"] | {"format_version": format_version}

    write(place, 1, change)
    with pytest.raises(StoreError, match=f"format version {format_version}; this program reads {FORMAT_VERSION}"):
        Snapshot.open(place)
    assert Snapshot.open(place, "v0").version == "v0"


# Versions


def test_versions_are_listed_the_newest_first_and_each_can_be_opened(tmp_path: Path) -> None:
    place = new(tmp_path)
    for number in (1, 2):
        write(place, number, lambda root, number=number: append_table(group_of(root, "images"), image_columns(3, 3 * number)))
    listed = versions(place)
    assert [v.name for v in listed] == ["v2", "v1", "v0"]
    assert [v.message for v in listed] == ["batch 2", "batch 1", "created"]
    assert listed[0].written > listed[1].written > listed[2].written
    assert [Snapshot.open(place, v.name).image_count() for v in listed] == [6, 3, 0]
    assert Snapshot.open(place).version == "v2"


def test_reader_keeps_its_version_while_another_is_written(tmp_path: Path) -> None:
    place = new(tmp_path)
    before = Snapshot.open(place)
    write(place, 1, lambda root: append_table(group_of(root, "images"), image_columns(3)))
    assert (before.version, before.image_count()) == ("v0", 0)
    network = submin.open(place)
    assert network.version == "v1"
    assert network.at("v0").version == "v0"
    assert network.at("v0").at("v1").version == "v1"


@pytest.mark.parametrize("version", ["v2", "2", "newest", "v-1", ""])
def test_unknown_version_is_named_with_those_there_are(tmp_path: Path, version: str) -> None:
    place = new(tmp_path)
    write(place, 1, lambda root: None)
    with pytest.raises(QueryError, match=f"version is '{version}'; expected one of v0 to v1"):
        Snapshot.open(place, version)
    with pytest.raises(QueryError, match="expected one of v0 to v1"):
        submin.open(place).at(version)


def test_of_two_writers_one_is_turned_away_and_leaves_nothing(tmp_path: Path) -> None:
    place = new(tmp_path)
    sessions = [begin_change(place, Snapshot.open(place).number)[0] for _ in range(2)]
    for k, session in enumerate(sessions):
        root = zarr.open_group(session.store, mode="r+")
        append_table(group_of(root, "images"), image_columns(k + 1))
        root.attrs["version"] = 1
    commit(sessions[0], 1, "first")
    with pytest.raises(ConflictError, match="another run committed to this network meanwhile; nothing of this batch was written"):
        commit(sessions[1], 1, "second")
    assert [v.message for v in versions(place)] == ["first", "created"]
    assert Snapshot.open(place).image_count() == 1


def test_a_change_starts_from_a_version_that_it_does_not_alter(tmp_path: Path) -> None:
    place = new(tmp_path)
    write(place, 1, lambda root: append_table(group_of(root, "images"), image_columns(3)))
    session, base = begin_change(place, Snapshot.open(place).number)
    root = zarr.open_group(session.store, mode="r+")
    append_table(group_of(root, "images"), image_columns(2, 3))
    number = COVER.cells_owned(1)[2]
    write_cell(root, COVER.cell_name(number), random_cell(number), 0.0, 0)
    root.attrs["version"] = 2
    for reader in (base, Snapshot.open(place)):
        assert (reader.version, reader.image_count(), reader.cell_numbers()) == ("v1", 3, ())
    commit(session, 2, "batch 2")
    assert (base.version, base.image_count(), len(base.images()), base.cell_numbers()) == ("v1", 3, 3, ())
    after = Snapshot.open(place)
    assert (after.version, after.image_count(), after.cell_numbers()) == ("v2", 5, (number,))


def test_a_change_that_is_given_up_leaves_nothing(tmp_path: Path) -> None:
    place = new(tmp_path)
    session, _ = begin_change(place, Snapshot.open(place).number)
    append_table(group_of(zarr.open_group(session.store, mode="r+"), "images"), image_columns(2))
    del session
    assert Snapshot.open(place).image_count() == 0
    assert [v.name for v in versions(place)] == ["v0"]
    with pytest.raises(StoreError, match="nowhere: no such network"):
        begin_change(str(tmp_path / "nowhere"), 0)


# Tags


def with_versions(tmp_path: Path, last: int) -> str:
    """A network of versions 0 to ``last``, each with one image more."""
    place = new(tmp_path)
    for number in range(1, last + 1):
        write(place, number, lambda root, number=number: append_table(group_of(root, "images"), image_columns(1, number - 1)))
    return place


def test_tag_names_the_newest_version_or_the_one_that_is_named(tmp_path: Path) -> None:
    place = with_versions(tmp_path, 2)
    tagged = tag_version(place, "delivery")
    assert (tagged.name, tagged.tags) == ("v2", ("delivery",))
    assert tag_version(place, "Q3-2026_first.draft", "v1").name == "v1"
    # by another tag
    again = tag_version(place, "accepted", "delivery")
    assert (again.name, sorted(again.tags)) == ("v2", ["accepted", "delivery"])
    listed = versions(place)
    assert [(v.name, v.tags) for v in listed] == [("v2", ("accepted", "delivery")), ("v1", ("Q3-2026_first.draft",)), ("v0", ())]
    for name, number in (("delivery", 2), ("accepted", 2), ("v2", 2), ("Q3-2026_first.draft", 1), ("v1", 1), ("v0", 0)):
        assert find_version(place, name) == listed[2 - number]
        assert (Snapshot.open(place, name).number, Snapshot.open(place, name).image_count()) == (number, number)
    # giving a tag makes no version
    assert [v.number for v in listed] == [2, 1, 0]


def test_tag_survives_what_comes_later(tmp_path: Path) -> None:
    place = with_versions(tmp_path, 1)
    number = COVER.cells_owned(1)[2]
    cell = random_cell(number, seed=1)
    write(place, 2, lambda root: write_cell(root, COVER.cell_name(number), cell, 0.0, 0))
    tagged = tag_version(place, "delivery")

    def clear(root: zarr.Group) -> None:
        del group_of(root, "cells")[COVER.cell_name(number)]
        append_table(group_of(root, "images"), image_columns(4, 1))

    write(place, 3, clear)
    write(place, 4, lambda root: write_cell(root, COVER.cell_name(number), random_cell(number, seed=2), 0.0, 0))
    assert find_version(place, "delivery") == tagged
    assert {v.name: v.tags for v in versions(place)} == {"v4": (), "v3": (), "v2": ("delivery",), "v1": (), "v0": ()}
    snapshot = Snapshot.open(place, "delivery")
    assert (snapshot.version, snapshot.image_count()) == ("v2", 1)
    assert_same(snapshot.cell(number), cell)
    network = submin.open(place)
    assert (network.version, network.at("delivery").version, network.at("delivery").at("v4").version) == ("v4", "v2", "v4")
    assert Snapshot.open(place).image_count() == 5


def test_tag_is_given_once(tmp_path: Path) -> None:
    place = with_versions(tmp_path, 2)
    tag_version(place, "delivery", "v1")
    for version in ("v1", "v2", None):
        with pytest.raises(StoreError, match="network: tag 'delivery' is that of v1; expected a new one: a tag is given once"):
            tag_version(place, "delivery", version)
    assert find_version(place, "delivery").name == "v1"
    assert [v.tags for v in versions(place)] == [(), ("delivery",), ()]


@pytest.mark.parametrize("tag", ["v3", "v0", "v12", "v007", "", "two words", "a/b", "../a", "größe", "tag\n", "a,b", "a:b"])
def test_tag_that_is_no_word_or_hides_a_version_is_refused(tmp_path: Path, tag: str) -> None:
    place = with_versions(tmp_path, 1)
    with pytest.raises(StoreError, match=re.escape(f"tag is {tag!r}; expected a word of letters, digits, '.', '_' and '-'")):
        tag_version(place, tag)
    assert [v.tags for v in versions(place)] == [(), ()]


@pytest.mark.parametrize("tag", ["v", "v3.1", "V3", "v3-final", "3", "v3v", "main", "-x", ".hidden"])
def test_tag_that_only_resembles_a_version_is_a_tag(tmp_path: Path, tag: str) -> None:
    place = with_versions(tmp_path, 1)
    tag_version(place, tag, "v0")
    assert find_version(place, tag).name == Snapshot.open(place, tag).version == "v0"
    assert Snapshot.open(place).version == "v1"


def test_unknown_version_is_named_with_the_tags_there_are(tmp_path: Path) -> None:
    place = with_versions(tmp_path, 2)
    tag_version(place, "delivery", "v1")
    tag_version(place, "draft", "v0")
    message = "version is 'nothing'; expected one of v0 to v2, delivery, draft .see 'submin history'"
    for opening in (find_version, Snapshot.open, lambda place, name: tag_version(place, "other", name)):
        with pytest.raises(QueryError, match=message):
            opening(place, "nothing")
    assert sorted(tag for v in versions(place) for tag in v.tags) == ["delivery", "draft"]
    with pytest.raises(StoreError, match="nowhere: no such network"):
        tag_version(str(tmp_path / "nowhere"), "delivery")


# Content


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


def sub_min(images: int, seed: int = 1) -> SubMin:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6 * images, 6 * images))
    rows = np.sort(rng.choice(10 * images, images, replace=False)).astype(np.int32)
    return SubMin(rows, rng.normal(size=(images, 6)), root @ root.T, 101.5, 99)


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
    monkeypatch.setattr(network_store, "DIRECTORY_PIECE", entries_at_a_time)
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


def test_ledger_comes_back(tmp_path: Path) -> None:
    place = new(tmp_path)
    content: dict[str, NDArray[Any]] = {
        name: np.array(["fused", "rejected"]) if kind == "text" else np.array([3, 4]) for name, kind in LEDGER_COLUMNS.items()
    }
    write(place, 1, lambda root: append_table(group_of(root, "ledger"), content))
    found = Snapshot.open(place).ledger(["status", "rays"])
    assert {name: values.tolist() for name, values in found.items()} == {"status": ["fused", "rejected"], "rays": [3, 4]}


def test_a_change_starts_from_the_version_that_its_ledger_was_read_from(tmp_path: Path) -> None:
    """Where nothing keeps a second writer out, what it decided by an older ledger is refused before it computes anything."""
    place = new(tmp_path)
    write(place, 1, lambda root: None)
    with pytest.raises(ConflictError, match=r"\(v1 after v0\); nothing of this change was written"):
        begin_change(place, 0)


def test_a_version_that_is_open_already_is_used_where_it_is_the_newest(tmp_path: Path) -> None:
    place = new(tmp_path)
    known = Snapshot.open(place)
    assert begin_change(place, 0, known)[1] is known
    write(place, 1, lambda root: None)
    with pytest.raises(ConflictError, match=r"\(v1 after v0\); nothing of this change was written"):
        begin_change(place, 0, known)
    assert begin_change(place, 1, known)[1].number == 1
