"""verify finds every kind of seeded damage, names the tile, and finds nothing in a sound network, whatever has happened to it."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from networks import area_of, by_image, fuse, rewrite

from orchestration.cli import main
from orchestration.control import add_control
from orchestration.create import create
from orchestration.executors import SerialExecutor, executor_for
from orchestration.reconcile import reconcile
from orchestration.run import run
from orchestration.verify import Verified, verify
from orchestration.withdraw import withdraw
from submin.errors import StoreError
from submin.network.cell import summed
from submin.network.network_image import image_set
from submin.simulation.region import SimulatedRegion
from submin.storage.arrays import (
    append_table,
    array_of,
    attributes_of,
    group_of,
    read_matrix,
    read_record,
    read_table,
    set_rows,
    write_record,
)
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import PointTable
from submin.storage.network_store import Snapshot, begin_change, commit
from submin.storage.problems import KINDS
from submin.storage.schema import write_cell

HERE = SerialExecutor()
Root = zarr.Group
Found = tuple[str, str]
"""Kind of a problem, and the tile that must be named."""


class Store:
    """A network's store, to be damaged as no command would: one version more, of whatever is written into ``root``."""

    def __init__(self, place: Path) -> None:
        self.place = str(place)
        before = Snapshot.open(self.place)
        self.session, self.base = begin_change(self.place, before.number)
        self.root = zarr.open_group(self.session.store, mode="r+")
        self.busiest = max(self.base.cell_numbers(), key=lambda number: self.base.cell_counts([number])[0]["rays"])
        self.cell_name = self.base.cover.cell_name(self.busiest)
        self.owner = self.base.cover.tile_name(self.base.cover.owner(self.busiest))

    def commit(self) -> None:
        self.root.attrs["version"] = self.base.number + 1
        commit(self.session, self.base.number + 1, "damaged")

    def edit(self, name: str, **parts: Callable[[np.ndarray], Any]) -> None:
        """Change parts of a record in place."""
        group = group_of(self.root, name)
        attributes = {key: value for key, value in attributes_of(group).items() if key != "layout"}
        record = read_record(group)
        for part, change in parts.items():
            change(record[part])
        others = {key: array_of(group, key)[...] for key in group.array_keys() if key not in ("data",)}
        path, _, last = name.rpartition("/")
        written = write_record(group_of(self.root, path), last, record, attributes)
        for key, values in others.items():
            written.create_array(key, data=np.asarray(values))

    def edit_cell(self, **parts: Callable[[np.ndarray], Any]) -> None:
        self.edit("cells/" + self.cell_name, **parts)

    def edit_covariance(self, change: Callable[[np.ndarray], Any]) -> None:
        array = array_of(group_of(self.root, "tiles/" + self.owner), "covariance")
        values = np.asarray(array[:, :])
        change(values)
        array[:, :] = values

    def edit_text(self, table: str, column: str, row: int, change: Callable[[str], str]) -> None:
        """Change one text of a table."""
        group = group_of(self.root, table)
        columns = read_table(group)
        texts = columns[column].astype(object)
        texts[row] = change(texts[row])
        columns[column] = texts.astype(np.str_)
        for name in group.array_keys():
            array_of(group, name).resize((0,))
        append_table(group, columns)


def scaled(at: Any, factor: float) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[at] *= factor

    return change


def put(at: Any, value: Any) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[at] = value

    return change


def shifted(at: Any, by: float) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[at] += by

    return change


def tampered_information(store: Store) -> list[Found]:
    store.edit_cell(information=scaled(2, 1.0 + 1e-6))  # the second element of the diagonal
    return [("cell-sums", store.owner), ("stale-factor", store.owner)]


def tampered_vector(store: Store) -> list[Found]:
    store.edit_cell(vector=scaled(1, 1.0 + 1e-4))
    return [("cell-sums", store.owner)]


def tampered_observation(store: Store) -> list[Found]:
    store.edit_cell(observed=shifted((3, 0), 0.01))
    return [("cell-sums", store.owner)]


def tampered_corrections(store: Store) -> list[Found]:
    store.edit("tiles/" + store.owner, theta=shifted((0, 0), 1e-4))
    return [("stale-factor", store.owner)]


def tampered_covariance(store: Store) -> list[Found]:
    store.edit_covariance(scaled((7, 2), 1.0 + 1e-4))
    return [("stale-factor", store.owner)]


def asymmetric_covariance(store: Store) -> list[Found]:
    store.edit_covariance(scaled((2, 7), 1.0 + 1e-4))
    return [("not-symmetric", store.owner)]


def indefinite_covariance(store: Store) -> list[Found]:
    store.edit_covariance(scaled((4, 4), 0.5))
    return [("not-positive-definite", store.owner)]


def indefinite_information(store: Store) -> list[Found]:
    store.edit_cell(information=put(2, -1e9))
    return [("cell-sums", store.owner), ("not-positive-definite", store.owner)]


def flipped_flag(store: Store) -> list[Found]:
    accepted = np.flatnonzero(store.base.cell(store.busiest).rays.accepted)[5]
    store.edit_cell(accepted=put(accepted, 0))
    return [("cell-sums", store.owner), ("damaged-cell", store.owner)]


def stale_factor(store: Store) -> list[Found]:
    """A ray is changed and its cell summed again, as it should be; the tiles that hold it are not factored."""
    cell = store.base.cell(store.busiest)
    cell.rays.observed[3, 1] += 0.5
    images = image_set(store.base.images(cell.images), store.base.metadata.ellipsoid, store.base.metadata.parameters)
    counts = store.base.cell_counts([store.busiest])[0]
    write_cell(store.root, store.cell_name, summed(cell, images), counts["square_px"], counts["pixel_rays"])
    return [("stale-factor", store.base.cover.tile_name(tile)) for tile in store.base.cover.holders(store.busiest)]


def nan_in_a_cell(store: Store) -> list[Found]:
    store.edit_cell(observed=put((3, 0), np.nan))
    return [("not-finite", store.owner)]


def nan_in_a_covariance(store: Store) -> list[Found]:
    store.edit_covariance(put((9, 3), np.nan))
    return [("not-finite", store.owner)]


def ids_out_of_order(store: Store) -> list[Found]:
    cell = store.base.cell(store.busiest)
    store.edit_cell(point_ids=put([0, 1], cell.point_ids[[1, 0]]))
    return [("damaged-cell", store.owner)]


def image_out_of_range(store: Store) -> list[Found]:
    store.edit_cell(ray_image=put(0, 10**6))
    return [("damaged-cell", store.owner)]


def ray_twice(store: Store) -> list[Found]:
    cell = store.base.cell(store.busiest)
    k = int(np.flatnonzero(np.diff(cell.rays.point) == 0)[0])
    store.edit_cell(ray_image=put(k + 1, cell.rays.image[k]))
    return [("duplicate-ray", store.owner), ("cell-sums", store.owner)]


def misplaced_point(store: Store) -> list[Found]:
    """A registered position moves by two tiles; sums do not depend on it."""
    store.edit_cell(origin=shifted((0, slice(None)), 90e3))
    return [("misplaced-point", store.owner)]


def block_in_two_cells(store: Store) -> list[Found]:
    """All rays of a cell once more in another one, both as they should be."""
    cell = store.base.cell(store.busiest)
    cover, numbers = store.base.cover, store.base.cell_numbers()
    other = next(c for tile in cover.tiles() for c in cover.cells_owned(tile) if c != cell.number)
    assert other in numbers  # it is replaced
    write_cell(store.root, cover.cell_name(other), dataclasses.replace(cell, number=other), 0.0, len(cell.rays))
    owner = cover.tile_name(cover.owner(other))
    return [("point-in-two-cells", store.owner), ("point-in-two-cells", owner), ("block-twice", ""), ("misplaced-point", owner),
            ("stale-factor", owner)]  # fmt: skip


def ledger_line_twice(store: Store) -> list[Found]:
    ledger = group_of(store.root, "ledger")
    append_table(ledger, read_table(ledger, start=4, stop=5))
    return [("block-twice", "")]


def image_row_twice(store: Store) -> list[Found]:
    images = group_of(store.root, "images")
    append_table(images, read_table(images, start=4, stop=5))
    return [("block-twice", ""), ("ledger", "")]


def lost_cell(store: Store) -> list[Found]:
    del store.root["cells/" + store.cell_name]
    return [("lost-cell", store.owner), ("rays-missing", "")]


def lost_tile(store: Store) -> list[Found]:
    del store.root["tiles/" + store.owner]
    return [("lost-tile", store.owner)]


def unknown_tile(store: Store) -> list[Found]:
    group_of(store.root, "tiles").create_group("r099c000")
    return [("unknown-name", "")]


def wrong_directory(store: Store) -> list[Found]:
    directory = group_of(store.root, "directory")
    rows = np.flatnonzero(read_table(directory)["cell"] == store.busiest)[:1]
    set_rows(directory, "cell", rows, np.array([store.busiest + 1]))
    return [("directory", store.owner)]


def withdrawn_image(store: Store) -> list[Found]:
    row = int(store.base.cell(store.busiest).images[0])
    set_rows(group_of(store.root, "images"), "withdrawn", np.array([row]), np.array([1]))
    return [("withdrawn-rays", store.owner), ("ledger", "")]


def withdrawn_block(store: Store) -> list[Found]:
    store.edit_text("ledger", "status", 2, lambda _: "withdrawn")
    return [("ledger", "")]


def dropped_release(store: Store) -> list[Found]:
    tile, row = sorted(store.base.flags())[0]
    set_rows(group_of(store.root, "images"), "released", np.array([row]), np.array([0]))
    name = store.base.cover.tile_name(tile)
    return [("released-flag", name), ("stale-factor", name)]


def changed_prior(store: Store) -> list[Found]:
    row = int(store.base.cell(store.busiest).images[0])

    def tighter(text: str) -> str:
        model = json.loads(text)
        return json.dumps(model | {"bias_px": 0.5 * model["bias_px"]}, sort_keys=True)

    store.edit_text("images", "a_priori", row, tighter)
    return [("stale-factor", store.owner)]


def broken_camera(store: Store) -> list[Found]:
    row = int(store.base.cell(store.busiest).images[0])
    store.edit_text("images", "camera", row, lambda text: text[:-20])
    return [("image-table", ""), ("image-table", store.owner)]


def missing_array(store: Store) -> list[Found]:
    del store.root[f"cells/{store.cell_name}/data"]
    return [("unreadable", store.owner)]


def ragged_table(store: Store) -> list[Found]:
    array_of(group_of(store.root, "images"), "seconds").resize((3,))
    return [("image-table", "")]


DAMAGES = [
    tampered_information, tampered_vector, tampered_observation, tampered_corrections, tampered_covariance, asymmetric_covariance,
    indefinite_covariance, indefinite_information, flipped_flag, stale_factor, nan_in_a_cell, nan_in_a_covariance, ids_out_of_order,
    image_out_of_range, ray_twice, misplaced_point, block_in_two_cells, ledger_line_twice, image_row_twice, lost_cell, lost_tile,
    unknown_tile, wrong_directory, withdrawn_image, withdrawn_block, dropped_release, changed_prior, broken_camera, missing_array,
    ragged_table,
]  # fmt: skip


def pairs(found: Verified) -> set[Found]:
    return {(problem.kind, problem.tile) for problem in found.problems}


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_damage_is_found_and_its_tile_named(damage: Callable[[Store], list[Found]], base: Path) -> None:
    store = Store(base)
    expected = damage(store)
    store.commit()
    found = verify(str(base), HERE)
    assert not found.ok
    assert set(expected) <= pairs(found), [(p.tile, p.kind, p.detail) for p in found.problems]
    assert all(problem.detail for problem in found.problems)
    assert verify(str(base), HERE, version="v1").ok  # the version before is what it was


def test_a_version_that_the_history_does_not_have(base: Path) -> None:
    store = Store(base)
    store.root.attrs["version"] = 7
    commit(store.session, 2, "damaged")
    assert pairs(verify(str(base), HERE)) == {("metadata", "")}


@pytest.mark.parametrize(("part", "by"), [("rays", 1), ("accepted", -1), ("pixel_rays", 2), ("square_px", 0.5)])
def test_totals_that_are_not_those_of_the_cells(base: Path, part: str, by: float) -> None:
    store = Store(base)
    totals = dict(store.root.attrs.asdict()["rays"])
    assert totals["rays"] > totals["accepted"] > 0
    store.root.attrs["rays"] = totals | {part: totals[part] + by}
    store.commit()
    assert pairs(verify(str(base), HERE)) == {("metadata", "")}


def test_a_network_without_totals_is_sound(base: Path) -> None:
    """As it was written before they were kept."""
    store = Store(base)
    before = store.base.ray_totals()
    del store.root.attrs["rays"]
    store.commit()
    assert verify(str(base), HERE).ok
    found = Snapshot.open(str(base)).ray_totals()
    assert (found.rays, found.accepted, found.pixel_rays) == (before.rays, before.accepted, before.pixel_rays)
    assert found.square_px == pytest.approx(before.square_px, rel=1e-12)  # added up in another order


def test_a_cover_that_cannot_be_understood(base: Path) -> None:
    store = Store(base)
    values = dict(store.root.attrs.asdict()["submin"])
    del values["cover"]["rows"]
    store.root.attrs["submin"] = values
    store.commit()
    assert pairs(verify(str(base), HERE)) == {("metadata", "")}


@pytest.mark.parametrize("how", ["gone", "cut", "other", "one bit"])
def test_a_chunk_that_is_lost_or_other_is_found(how: str, base: Path) -> None:
    """Files of the store itself: whatever was in them, there is a finding and no crash."""
    chunks = sorted(path for path in (base / "chunks").rglob("*") if path.is_file())
    for path in chunks[:: max(len(chunks) // 4, 1)]:
        kept = path.read_bytes()
        middle = len(kept) // 2
        if how == "gone":
            path.unlink()
        elif how == "cut":
            path.write_bytes(kept[:middle])
        else:
            mask = [255] * 8 if how == "other" else [4]
            turned = bytes(byte ^ flip for byte, flip in zip(kept[middle:], mask, strict=False))
            path.write_bytes(kept[:middle] + turned + kept[middle + len(turned) :])
        found = verify(str(base), HERE)
        path.write_bytes(kept)
        assert not found.ok, path.name
    assert verify(str(base), HERE).ok


def test_what_was_damaged_is_never_read_as_a_number(base: Path) -> None:
    """Cells and covariances are under a checksum: with one bit turned, reading them raises one line and gives nothing."""
    snapshot = Snapshot.open(str(base))
    cell = group_of(snapshot.root, "cells/" + snapshot.cover.cell_name(snapshot.cell_numbers()[0]))
    tile = group_of(snapshot.root, "tiles/" + snapshot.cover.tile_name(snapshot.tile_numbers()[0]))
    readers = (lambda: read_record(cell), lambda: read_matrix(tile, "covariance"))
    raised = set()
    for path in sorted(path for path in (base / "chunks").rglob("*") if path.is_file()):
        kept = path.read_bytes()
        path.write_bytes(kept[:40] + bytes([kept[40] ^ 1]) + kept[41:])
        for number, read in enumerate(readers):
            try:
                read()
            except StoreError as error:
                raised.add((number, "damaged chunk in" in str(error)))
        path.write_bytes(kept)
    assert raised == {(0, True), (1, True)}


def test_a_sound_network_is_sound_whatever_happens_to_it(region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())
    found = verify(str(base), HERE)
    assert found.ok, found.problems
    assert len(found.tiles) == len(Snapshot.open(str(base)).tile_numbers())
    assert found.worst("sums_error") < 1e-13
    assert found.worst("factor_error") < 1e-12
    assert found.worst("replay_error") < 1e-9
    ids = region.point_ids[[3, 40, 90]]
    control = PointTable(ids, region.truth[[3, 40, 90]], np.tile(0.01 * np.eye(3), (3, 1, 1)), np.full(3, ""))
    add_control(control, "control", str(base), HERE)
    withdraw(str(base), HERE, image=blocks[3].images[1].image_id)
    assert verify(str(base), HERE).ok
    withdraw(str(base), HERE, block=blocks[3].block_id)
    withdraw(str(base), HERE, control=str(ids[1]))
    assert verify(str(base), HERE).ok
    fuse(catalogue, base, area_of(region))
    assert verify(str(base), HERE).problems == ()
    withdraw(str(base), HERE, image=region.bad_cameras[0])
    assert verify(str(base), HERE).problems == ()


def test_a_network_of_split_tiles_and_pending_points_is_sound(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    network = str(tmp_path / "network")
    assert verify_empty(network, region, catalogue).ok
    parts = [part for block in Catalogue.open(catalogue).blocks() for part in by_image(block)]
    some = rewrite(catalogue, tmp_path / "some", [part for part in parts if part.images[0].image_id.endswith(("FWD", "NAD"))][:20])
    run(Catalogue.open(some), network, HERE, batch_blocks=9)
    assert verify(network, HERE).problems == ()
    run(Catalogue.open(catalogue), network, HERE)
    assert verify(network, HERE).problems == ()


def verify_empty(network: str, region: SimulatedRegion, catalogue: Path) -> Verified:
    create(network, area_of(region), Catalogue.open(catalogue).metadata, 60.0, 20.0, max_parameters=100)
    return verify(network, HERE)


def test_workers_find_the_same(base: Path) -> None:
    store = Store(base)
    tampered_information(store)
    store.commit()
    alone = verify(str(base), HERE)
    with executor_for(2) as executor:
        assert verify(str(base), executor).problems == alone.problems


def test_the_command(base: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def call(*words: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["submin", *words])
        with pytest.raises(SystemExit) as end:
            main()
        return int(end.value.code or 0), capsys.readouterr().out

    store = Store(base)
    lost_tile(store)
    store.commit()
    code, text = call("verify", str(base), "--json")
    values = json.loads(text)
    assert (code, values["ok"], values["version"]) == (1, False, "v2")
    assert [p["kind"] for p in values["problems"]] == ["lost-tile", "released-flag"][: len(values["problems"])]
    assert set(values["problems"][0]) == {"tile", "kind", "detail"}
    code, text = call("verify", str(base), "--at", "v1", "--json")
    assert (code, json.loads(text)["ok"]) == (0, True)
    code, text = call("verify", str(base))
    assert code == 1
    assert f"lost-tile: tile {store.owner}" in text


def test_a_form_that_is_not_known_is_refused(base: Path) -> None:
    store = Store(base)
    store.root.attrs["submin"] = dict(store.root.attrs.asdict()["submin"]) | {"form": "woven"}
    store.commit()
    with pytest.raises(StoreError, match="form is 'woven'"):
        verify(str(base), HERE)


def test_every_kind_is_explained() -> None:
    page = (Path(__file__).parents[2] / "docs" / "quality.md").read_text(encoding="utf-8")
    assert [kind for kind in KINDS if f"`{kind}`" not in page] == []


@pytest.mark.parametrize("part", ["covariance", "mean", "root", "prior_value"])
def test_what_was_reconciled_is_made_anew(base: Path, part: str) -> None:
    """A sound network is sound reconciled, and with a block less since; one number of what is kept changed is found."""
    reconcile(str(base), HERE)
    if part == "covariance":
        assert verify(str(base), HERE).ok
    blocks = list(Snapshot.open(str(base)).ledger(["block_id"])["block_id"])
    withdraw(str(base), HERE, block=blocks[3])
    assert verify(str(base), HERE).ok
    store = Store(base)
    states, trees = "reconciled/tiles/" + store.owner, group_of(store.root, "reconciled/trees")
    if part in ("mean", "prior_value"):
        store.edit(states, **{part: scaled(2, 1.001)})
    else:
        node = next(name for name in sorted(trees.group_keys()) if "root" in group_of(trees, name).array_keys())
        array = array_of(group_of(store.root, states) if part == "covariance" else group_of(trees, node), part)
        values = np.asarray(array[:, :])
        values[0, 0] *= 1.001
        array[:, :] = values
    store.commit()
    problems = verify(str(base), HERE).problems
    assert {problem.kind for problem in problems} == {"stale-state"}
    if part != "root":
        assert {problem.tile for problem in problems} == {store.owner}
