"""The commands of interface and README, as a user gives them."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from networks import rewrite

from orchestration.cli import main
from submin.storage.catalogue import Catalogue


class Shell:
    """Runs commands in this process and keeps what they print."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._patch, self._capture = monkeypatch, capsys

    def __call__(self, *words: object, code: int = 0) -> tuple[str, str]:
        """Standard output and standard error of ``submin WORDS``; its exit code must be ``code``."""
        self._patch.setattr(sys, "argv", ["submin", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
            raise SystemExit(0)
        printed = self._capture.readouterr()
        assert (ended.value.code or 0) == code, printed.err + printed.out
        return printed.out, printed.err

    def json(self, *words: object, code: int = 0) -> dict[str, Any]:
        """The one JSON object of ``submin WORDS --json``."""
        out, _ = self(*words, "--json", code=code)
        values = json.loads(out)
        assert isinstance(values, dict)
        return values


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(monkeypatch, capsys)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("commands")


def test_the_main_job(shell: Shell, place: Path) -> None:
    """Simulate, create, run, run again, query, check, map, info, history: the way of the README."""
    catalogue, network = place / "catalogue", place / "network"
    made = shell.json("simulate", "region", "--out", catalogue, "--scale", 0.09)
    assert made["simulated"] is True
    created = shell.json("create", network, "--fit", catalogue, "--tile-km", 60, "--overlap-km", 20)
    assert (created["tile_km"], created["overlap_km"]) == (60.0, 20.0)

    first = shell.json("run", catalogue, network)
    assert first["version"] == "v2"  # the blocks, and then what lies outside of each tile
    assert first["reconciled"]["tiles"] == created["tiles"]
    assert first["blocks_fused"] == made["blocks"]
    assert first["blocks_rejected"] == []
    assert [flag["image_id"] for flag in first["images_flagged"]] == made["bad_cameras"]
    assert first["rays_used"] + first["rays_rejected"] == made["rays"]
    assert 0.3 < first["ray_rms_px"] < 0.5
    assert first["peak_memory_mb"] > 0
    again = shell.json("run", catalogue, network)
    assert (again["blocks_fused"], again["blocks_skipped"], again["version"]) == (0, made["blocks"], "v2")
    assert "reconciled" not in again
    assert again["ray_rms_px"] == first["ray_rms_px"]
    assert "nothing is left to do" in shell("run", catalogue, network)[0]

    asked = shell.json("query", network, "--bbox", 99, 34, 101, 36, "--policy", "rigorous", "--out", place / "control.npz")
    assert asked["policy"] == "rigorous"
    assert asked["scope"] == "network"
    control = np.load(place / "control.npz")
    assert control["covariance"].shape == (3 * asked["points"], 3 * asked["points"])
    np.linalg.cholesky(control["covariance"])
    auto = ["query", network, "--bbox", 99, 34, 101, 36]
    assert "policy rigorous (chosen by auto) over" in shell(*auto)[0]
    chosen = shell.json(*auto)
    assert (chosen["policy_asked"], chosen["policy"], chosen["tiles"]) == ("auto", "rigorous", asked["tiles"])
    near = ["query", network, "--points", place / "near.txt"]
    (place / "near.txt").write_text(str(control["ids"][0]))
    assert "policy tile (chosen by auto) over 1 tile" in shell(*near)[0]
    assert shell.json(*near)["policy"] == "tile"
    joined = shell.json(*near, "--join", place / "control.npz", "--out", place / "joined.npz")
    assert (joined["policy"], joined["policy_of_network"], joined["points"]) == ("ci", "tile", asked["points"])
    both = np.load(place / "joined.npz")
    np.testing.assert_array_equal(both["ids"], control["ids"])
    assert np.trace(both["covariance"]) <= np.trace(control["covariance"]) * (1.0 + 1e-5)
    assert f"joined with {place / 'control.npz'} by ci" in shell(*near, "--join", place / "control.npz")[0]
    for suffix in ("parquet", "geojson", "csv"):
        shell("query", network, "--tile", asked["tiles"][0], "--out", place / f"control.{suffix}")
        assert (place / f"control.{suffix}").stat().st_size > 1000
    (place / "some.txt").write_text("\n".join(control["ids"][:5]))
    assert shell.json("query", network, "--points", place / "some.txt")["points"] == 5
    assert shell.json("query", network, "--bbox", 99, 34, 101, 36, "--max-points", 30)["points"] <= 30

    checked = shell.json("check", network, catalogue / "check.parquet")
    assert checked["points"] == asked["points"]
    assert set(checked["areas"]) == {"NE", "NW", "SE", "SW"}
    assert checked["horizontal"]["p50"] < checked["horizontal"]["mean_ce90"]
    shell("map", network, "--out", place / "network.png")
    assert (place / "network.png").read_bytes().startswith(b"\x89PNG")
    described = shell.json("info", network)
    assert described["points"] == asked["points"]
    assert described["blocks"] == made["blocks"]
    assert [v["version"] for v in shell.json("history", network)["versions"]] == ["v2", "v1", "v0"]


def test_reconciling_and_leaving_it_out(shell: Shell, place: Path) -> None:
    """A tile of a reconciled network is the whole network's; without, it says that it is not; what is done is not done again."""
    network = shutil.copytree(place / "network", place / "unreconciled")
    tile = shell.json("query", network, "--bbox", 99, 34, 101, 36)["tiles"][0]
    assert shell.json("query", network, "--tile", tile)["scope"] == "network"
    assert shell.json("query", network, "--tile", tile, "--at", "v1")["scope"] == "tiles"
    assert "nothing has changed since it was reconciled" in shell("reconcile", network)[0]
    assert shell.json("withdraw", network, "--block", "T000-000", "--no-reconcile")["version"] == "v3"
    assert shell.json("query", network, "--tile", tile)["scope"] == "tiles"
    done = shell.json("reconcile", network)
    assert (done["version"], done["parts"]) == ("v4", 1)
    assert shell.json("query", network, "--tile", tile)["scope"] == "network"
    out, _ = shell("run", place / "catalogue", network)
    assert "v5: 1 blocks fused" in out
    assert "v6: " in out
    assert "reconciled with what lies outside" in out
    assert shell.json("info", network)["reconciled"] == "v6"


def test_a_query_outside_is_empty_and_says_so(shell: Shell, place: Path) -> None:
    out, _ = shell("query", place / "network", "--bbox", 10, 10, 11, 11)
    assert "no determined points there" in out
    assert shell.json("query", place / "network", "--bbox", 10, 10, 11, 11)["points"] == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["query", "nowhere", "--bbox", 0, 0, 1, 1], "nowhere: no such network; make one with 'submin create'"),
        (["query", "{network}", "--bbox", 34, 99, 36, 101], "longitude and latitude look swapped"),
        (["query", "{network}", "--bbox", 99, 34, 101, 36, "--policy", "best"], "policy is 'best'; expected one of auto, tile, ci"),
        (["query", "{network}", "--bbox", 99, 34, 101, 36, "--at", "v9"], "version is 'v9'; expected one of v0 to v2"),
        (["query", "{network}", "--tile", "r9"], "tile is 'r9'"),
        (["query", "{network}"], "expected one of bbox, area, points, or a tile"),
        (["query", "{network}", "--bbox", 99, 34, 101, 36, "--out", "{network}/../x.xls"], ".parquet"),
        (["create", "{network}", "--bbox", 99, 34, 101, 36], "already exists"),
        (["create", "{new}", "--bbox", 99, 34, 101, 36, "--tile-km", 50, "--overlap-km", 50], "less than the core's"),
        (["create", "{new}", "--bbox", 99, 34, 101, 36, "--tile-km", 0.001, "--overlap-km", 0], "choose a larger --tile-km"),
        (["create", "{new}"], "exactly one of --bbox, --aoi and --fit"),
        (["run", "nocatalogue", "{network}"], "nocatalogue: no such folder"),
        (["run", "{catalogue}", "nowhere"], "nowhere: no such network"),
    ],
)
def test_bad_input_is_one_clear_line_and_writes_nothing(shell: Shell, place: Path, words: list[object], said: str) -> None:
    names = {"network": place / "network", "catalogue": place / "catalogue", "new": place / "new"}
    filled = [word.format(**names) if isinstance(word, str) else word for word in words]
    _, err = shell(*filled, code=2)
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert not (place / "new").exists()
    assert json.loads(shell(*filled, "--json", code=2)[0])["error"]


def test_frames_that_do_not_match_are_refused(shell: Shell, place: Path) -> None:
    shell("create", place / "moon", "--bbox", 99, 34, 101, 36, "--frame", "ITRF2014")
    _, err = shell("run", place / "catalogue", place / "moon", code=2)
    assert "frame is 'WGS84', but the network's is 'ITRF2014'" in err
    assert shell.json("info", place / "moon")["version"] == "v0"


def test_the_papers_experiments(shell: Shell, tmp_path: Path) -> None:
    """Simulate, run block by block, check by block, add external control."""
    catalogue, network = tmp_path / "catalogue", tmp_path / "network"
    made = shell.json("simulate", "five-blocks", "--out", catalogue)
    assert (made["images"], made["blocks"], made["points"], made["simulated"]) == (18, 5, 62, True)
    shell("create", network, "--fit", catalogue, "--tile-km", 1000)
    assert shell.json("run", catalogue, network, "--sequential")["version"] == "v5"
    before = shell.json("check", network, catalogue / "check.parquet")
    assert sorted(before["areas"]) == [f"block {k}" for k in range(1, 6)]
    assert before["areas"]["block 1"]["points"] == 20 and before["missing"] == 0
    assert shell.json("control", "add", network, catalogue / "control-external.parquet")["control_fused"] == 4
    after = shell.json("check", network, catalogue / "check.parquet")
    assert after["horizontal"]["mean_ce90"] < 0.5 * before["horizontal"]["mean_ce90"]
    # what has become control does not check itself
    assert (before["control_left_out"], after["control_left_out"]) == (0, 4)
    assert (before["points"], after["points"], after["missing"]) == (62, 58, 0)
    assert sorted(after["areas"]) == [f"block {k}" for k in range(1, 5)]  # the points of block 5 alone are the control
    _, err = shell("check", network, catalogue / "control-external.parquet", code=2)
    assert "all 4 check points are control of the network" in err
    # no terminal, and areas with long names: nothing is cut off
    points = Catalogue.open(catalogue).points("check")
    assert points is not None
    long = "[a] " + "block " * 20
    pq.write_table(
        pa.table({
            "point_id": points.point_ids, "longitude": points.geodetic[:, 0], "latitude": points.geodetic[:, 1],
            "height": points.geodetic[:, 2], **dict.fromkeys(("sigma_e", "sigma_n", "sigma_u"), np.zeros(62)), "area": [long.strip()] * 62,
        }),
        tmp_path / "long.parquet",
    )  # fmt: skip
    out, _ = shell("check", network, tmp_path / "long.parquet", "--out", tmp_path / "long.txt")
    assert "4 are control of the network" in out
    for said in (out, (tmp_path / "long.txt").read_text(encoding="utf-8")):
        assert "…" not in said and long.strip() in said
        (row,) = (line for line in said.splitlines() if long.strip() in line)
        for value in (
            after["horizontal"]["p95"],
            after["horizontal"]["mean_ce90"],
            after["vertical"]["p50"],
            after["vertical"]["mean_le90"],
        ):
            assert f" {value:.2f} m" in row

    made = shell.json("simulate", "worldview", "--out", tmp_path / "worldview", "--seed", 5)
    assert (made["images"], made["blocks"], made["points"], made["check_points"]) == (100, 49, 1347, 101)
    assert len(made["external_control"]) == 9


def test_blocks_are_adjusted_and_readjusted(shell: Shell, place: Path, tmp_path: Path) -> None:
    """A new block by a network of the others; then the cameras of all of it. Nothing goes into the network."""
    source = Catalogue.open(place / "catalogue")
    new, *others = list(source.blocks())
    part, network = rewrite(source.path, tmp_path / "part", others), tmp_path / "network"
    shell("create", network, "--fit", place / "catalogue", "--tile-km", 60, "--overlap-km", 20)
    shell("run", part, network)

    adjusted = shell.json("adjust", source.path, "--block", new.block_id, "--network", network, "--out", tmp_path / "adjusted")
    assert (adjusted["block"], adjusted["images"], adjusted["status"]) == (new.block_id, 3, "controlled")
    assert adjusted["control_points"] > 5 and adjusted["redundancy"] > 30
    assert adjusted["variance_factor"] == pytest.approx(adjusted["chi_square"] / adjusted["redundancy"])
    for key in ("points", "rejected_rays", "control_rejected", "images_flagged", "innovation", "check", "version", "policy", "tiles"):
        assert key in adjusted
    assert adjusted["check"]["points"] > 5
    out, _ = shell("adjust", source.path, "--block", new.block_id, "--virtual-control", 3, "--out", tmp_path / "virtual")
    assert "no accuracy is stated" in out

    readjusted = shell.json("readjust", source.path, network, "--out", tmp_path / "cameras")
    assert (readjusted["version"], readjusted["blocks"], readjusted["blocks_missing"]) == ("v2", len(others), [new.block_id])
    assert shell.json("info", network)["version"] == "v2"
    out, _ = shell("readjust", source.path, network, "--block", others[0].block_id, "--out", tmp_path / "one")
    assert "3 images of 1 block, from" in out and "(resection; policy " in out
