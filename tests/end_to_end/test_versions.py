"""Versions: looked at, named, compared; readable while new ones are written, and from one Python to another."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from end_to_end.test_command_line import Shell
from networks import SMALL, area_of, fuse, rewrite

import submin
from orchestration.diff import difference
from submin.accuracy import ce90
from submin.simulation.region import simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import write_region


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(monkeypatch, capsys)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of two versions beside the empty one: half of the blocks, and all."""
    folder = tmp_path_factory.mktemp("versions")
    region = simulate_region(SMALL)
    write_region(region, folder / "catalogue")
    half = rewrite(folder / "catalogue", folder / "half", list(Catalogue.open(folder / "catalogue").blocks())[:6])
    fuse(half, folder / "network", area_of(region))
    fuse(folder / "catalogue", folder / "network", area_of(region))
    return folder


def test_tags_name_versions_and_stay(shell: Shell, place: Path) -> None:
    network = place / "network"
    assert shell.json("tag", network, "delivered", "--at", "v1") == {"version": "v1", "tags": ["delivered"]}
    first = shell.json("query", network, "--bbox", 99, 34, 101, 36, "--at", "delivered")
    assert first["version"] == "v1"
    shell("withdraw", network, "--block", "T000-000", "--no-reconcile")
    shell("run", place / "catalogue", network, "--no-reconcile")
    assert shell.json("info", network)["version"] == "v4"
    again = shell.json("query", network, "--bbox", 99, 34, 101, 36, "--at", "delivered")
    assert (again["version"], again["ce90_median"]) == ("v1", first["ce90_median"])
    assert "(delivered)" in shell("history", network)[0]
    assert "a tag is given once" in shell("tag", network, "delivered", code=2)[1]
    assert "no version's own name" in shell("tag", network, "v7", code=2)[1]
    assert "expected one of v0 to v4, delivered" in shell("info", network, "--at", "nothing", code=2)[1]


def test_a_difference_is_that_of_the_two_answers(place: Path) -> None:
    before, after = submin.open(place / "network", "v1"), submin.open(place / "network", "v2")
    found = difference(before, after)
    tile = before.cover.tile_name(before.snapshot.tile_numbers()[0])
    a, b = before.query(tile=tile), after.query(tile=tile)
    # points in the tile's own core, which the difference takes from this tile in both versions
    common = [p for p, owner in zip(a.ids, a.tile_of_point, strict=True) if owner == tile and p in set(b.ids)]
    assert len(common) > 5
    for point in common:
        i, j, k = (int(np.flatnonzero(ids == point)[0]) for ids in (a.ids, b.ids, found.ids))
        moved = b.geocentric[j] - a.geocentric[i]
        assert np.linalg.norm(found.moved[k]) == pytest.approx(np.linalg.norm(moved), abs=1e-8)
        assert found.ce90[0][k] == pytest.approx(float(ce90(a.local_covariance[i : i + 1, :2, :2])[0]), rel=1e-9)
        assert found.le90[1][k] == pytest.approx(b.le90[j], rel=1e-9)
    assert set(found.new) == set(after.query(bbox=(90, 30, 110, 40)).ids) - set(before.query(bbox=(90, 30, 110, 40)).ids)
    assert not len(found.gone)


def test_differences_on_the_command_line(shell: Shell, place: Path) -> None:
    network = place / "network"
    values = shell.json("diff", network, "v1", "v2")
    assert (values["before"], values["after"], values["points_gone"]) == ("v1", "v2", 0)
    assert values["points"] > 50
    assert values["points_new"] > 20
    assert values["horizontal"]["p50"] <= values["horizontal"]["p90"] <= values["horizontal"]["max"]
    assert values["ce90_median"][1] < values["ce90_median"][0]
    assert values["beyond_stated"] < 0.2 * values["points"]
    turned = shell.json("diff", network, "v2", "v1")
    assert (turned["points_new"], turned["points_gone"]) == (0, values["points_new"])
    assert turned["horizontal"]["max"] == pytest.approx(values["horizontal"]["max"], rel=1e-3)  # axes of the other place
    text, _ = shell("diff", network, "v1", "v2")
    assert "moved by more than the CE90 or LE90 stated in v1" in text
    same = shell.json("diff", network, "v2", "v2")
    assert same["horizontal"]["max"] == same["vertical"]["max"] == 0.0
    assert "expected one of v0 to" in shell("diff", network, "v1", "v99", code=2)[1]
    assert "none in common" in shell("diff", network, "v0", "v1")[0]


def test_control_and_withdrawal_on_the_command_line(shell: Shell, place: Path) -> None:
    network = place / "network"
    answer = submin.open(network).query(bbox=(99, 34, 101, 36), max_points=3)
    rows = ["point_id,longitude,latitude,height,sigma_e,sigma_n,sigma_u"]
    rows += [f"{p},{lon:.9f},{lat:.9f},{h:.4f},0.1,0.1,0.2" for p, (lon, lat, h) in zip(answer.ids, answer.geodetic, strict=True)]
    (place / "control.csv").write_text("\n".join(rows))
    shell("reconcile", network)
    before = shell.json("info", network)
    added = shell.json("control", "add", network, place / "control.csv")
    assert added["control_fused"] == len(answer)
    now = shell.json("info", network)
    assert (now["control_points"], now["blocks"], now["images"]) == (len(answer), before["blocks"], before["images"])
    assert now["ce90_median"] < before["ce90_median"]
    assert shell.json("control", "add", network, place / "control.csv")["control_skipped"] == len(answer)
    for point in answer.ids:
        assert shell.json("withdraw", network, "--control", point)["withdrawn"] == f"control point {point}"
    assert shell.json("info", network)["ce90_median"] == pytest.approx(before["ce90_median"], rel=1e-9)
    assert "control point 'P-none' is not in the network" in shell("withdraw", network, "--control", "P-none", code=2)[1]
    assert json.loads(shell("withdraw", network, "--json", code=2)[0])["error"].startswith("give exactly one of")
