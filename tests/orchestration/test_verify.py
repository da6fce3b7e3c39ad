"""verify finds every kind of seeded damage, names the tile, and finds nothing in a sound network, whatever has happened to it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from damages import DAMAGES, Found, Store, lost_tile, scaled, tampered_information
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
from submin.simulation.region import SimulatedRegion
from submin.storage.arrays import array_of, group_of, read_matrix, read_record
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import PointTable
from submin.storage.commit import commit
from submin.storage.problems import KINDS
from submin.storage.snapshot import Snapshot

HERE = SerialExecutor()


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
