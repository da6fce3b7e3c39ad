"""A change of a network: it starts from one version, and is the next one or nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
import zarr
from stores import COVER, image_columns, new, random_cell, write

from submin.errors import ConflictError, StoreError
from submin.storage.arrays import append_table, group_of
from submin.storage.commit import begin_change, commit, unread
from submin.storage.repository import versions
from submin.storage.schema import write_cell
from submin.storage.snapshot import Snapshot


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


def test_a_fork_without_what_was_read_has_all_that_was_written(tmp_path: Path) -> None:
    place, number = new(tmp_path), COVER.cells_owned(1)[2]
    session, _ = begin_change(place, Snapshot.open(place).number)
    given = session.fork()
    fork = unread(given)
    write_cell(zarr.open_group(fork.store, mode="r+"), COVER.cell_name(number), random_cell(number), 0.0, 0)
    assert fork.has_uncommitted_changes and not given.has_uncommitted_changes
    session.merge(unread(fork))
    zarr.open_group(session.store, mode="r+").attrs["version"] = 1
    commit(session, 1, "one cell")
    assert Snapshot.open(place).cell_numbers() == (number,)


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
