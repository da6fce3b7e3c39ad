"""The repository of a network: what is created and opened, version by version, with tags, and what is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import icechunk
import numpy as np
import pytest
import zarr
from registering import assert_same
from stores import COVER, METADATA, image_columns, new, random_cell, with_versions, write

import submin
from submin.errors import QueryError, StoreError
from submin.geodesy import Ellipsoid
from submin.storage.arrays import append_table, group_of
from submin.storage.repository import create_network, find_version, tag_version, versions
from submin.storage.schema import FORMAT_VERSION, write_cell
from submin.storage.snapshot import Snapshot


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

    def full(*args: Any, **chunks: int) -> None:
        raise OSError(28, "No space left on device")

    for place in ("network", "other"):
        with monkeypatch.context() as patch, pytest.raises(StoreError, match=rf"{place}: cannot be written \(No space left on device\)"):
            patch.setattr("submin.storage.repository.create_table", full)
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


@pytest.mark.parametrize("version", ["v2", "2", "newest", "v-1", ""])
def test_unknown_version_is_named_with_those_there_are(tmp_path: Path, version: str) -> None:
    place = new(tmp_path)
    write(place, 1, lambda root: None)
    with pytest.raises(QueryError, match=f"version is '{version}'; expected one of v0 to v1"):
        Snapshot.open(place, version)
    with pytest.raises(QueryError, match="expected one of v0 to v1"):
        submin.open(place).at(version)


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
