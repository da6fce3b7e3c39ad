"""`submin readjust`: what is written for the blocks of a network, through the product's own path."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from networks import area_of, fuse, rewrite
from numpy.typing import NDArray

from orchestration.cli import main
from orchestration.control import add_control
from orchestration.executors import SerialExecutor
from orchestration.readjust import readjust_network
from orchestration.withdraw import withdraw
from submin.errors import CatalogueError
from submin.simulation.region import SimulatedRegion
from submin.storage.adjusted import AdjustedWriter
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import PointTable

Array = NDArray[np.float64]


def cameras(folder: Path) -> dict[str, tuple[Array, Array]]:
    """Corrections and their covariance by image."""
    found: dict[str, tuple[Array, Array]] = {}
    rows = pq.read_table(folder / "cameras.parquet").to_pylist()
    for name in dict.fromkeys(row["image_id"] for row in rows):
        mine = [row for row in rows if row["image_id"] == name]
        with np.load(folder / mine[0]["covariance_file"]) as stored:
            at = [row["covariance_row"] for row in mine]
            assert stored["image_id"][at].tolist() == [name] * len(at)
            found[name] = np.array([row["correction"] for row in mine]), stored["covariance"][np.ix_(at, at)]
        np.testing.assert_allclose([row["sigma"] for row in mine], np.sqrt(np.diag(found[name][1])))
    return found


def test_every_camera_of_a_network_is_written(catalogue: Path, complete: Path, region: SimulatedRegion, tmp_path: Path) -> None:
    result = readjust_network(Catalogue.open(catalogue), str(complete), tmp_path / "out", policy="rigorous")
    assert (result.blocks, result.images, result.blocks_missing) == (12, 36, ())
    assert set(region.bad_cameras) <= set(result.images_released)
    found = cameras(tmp_path / "out")
    assert set(found) == {image.image_id for image in region.images}
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["version"], report["status"]) == ("v1", "resection")
    assert (result.policies, report["policies"], report["policy_asked"]) == (("rigorous",), ["rigorous"], "rigorous")
    assert report["tiles"] == list(result.tiles) and len(result.tiles) > 1
    assert b"never enter it into a network" in pq.read_schema(tmp_path / "out" / "cameras.parquet").metadata[b"use"]
    # against the truth: every component by its sigma
    rows = {image.image_id: k for k, image in enumerate(region.images)}
    tests = np.concatenate([(theta - region.theta[rows[name]]) / np.sqrt(np.diag(m)) for name, (theta, m) in found.items()])
    assert np.abs(tests).max() < 4.5
    assert 0.7 < np.sqrt(np.mean(tests**2)) < 1.3


def test_one_block_is_the_same_alone(catalogue: Path, complete: Path, tmp_path: Path) -> None:
    opened = Catalogue.open(catalogue)
    readjust_network(opened, str(complete), tmp_path / "all", policy="rigorous")
    result = readjust_network(opened, str(complete), tmp_path / "one", block="T001-001", policy="rigorous")
    assert (result.blocks, result.images) == (1, 3)
    every, one = cameras(tmp_path / "all"), cameras(tmp_path / "one")
    assert set(one) == {name for name in every if name.startswith("T001-001")}
    for name, (theta, covariance) in one.items():
        np.testing.assert_array_equal(theta, every[name][0])
        np.testing.assert_array_equal(covariance, every[name][1])


def test_withdrawn_images_and_control_are_not_readjusted(
    catalogue: Path, base: Path, region: SimulatedRegion, tmp_path: Path
) -> None:  # fmt: skip
    ids = region.point_ids[[3, 40]]
    truth = PointTable(ids, region.truth[[3, 40]], np.tile(0.01 * np.eye(3), (2, 1, 1)), np.array(["", ""]))
    opened = Catalogue.open(catalogue)
    readjust_network(opened, str(base), tmp_path / "before")
    assert add_control(truth, "test", str(base), SerialExecutor()).fused == 2
    withdraw(str(base), SerialExecutor(), image="T001-001-NAD")
    result = readjust_network(opened, str(base), tmp_path / "after")
    before, after = cameras(tmp_path / "before"), cameras(tmp_path / "after")
    assert set(before) - set(after) == {"T001-001-NAD"} and result.images == 35
    kept = [name for name in after if name not in result.images_released]
    assert np.median([after[name][1][0, 0] / before[name][1][0, 0] for name in kept]) < 0.9  # control tells the cameras too


def test_the_policy_and_the_tiles_that_were_used_are_said(catalogue: Path, complete: Path, tmp_path: Path) -> None:
    """``auto`` is no policy that gives points."""
    result = readjust_network(Catalogue.open(catalogue), str(complete), tmp_path / "out")
    assert set(result.policies) and set(result.policies) <= {"tile", "rigorous"}
    names = {f"r{row:03d}c{column:03d}" for row in range(9) for column in range(9)}
    assert result.tiles and set(result.tiles) <= names
    assert result.to_json()["policies"] == list(result.policies)


def test_released_cameras_are_said_to_people(
    catalogue: Path,
    complete: Path,
    region: SimulatedRegion,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["submin", "readjust", str(catalogue), str(complete), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().out
    assert not ended.value.code and said.startswith("36 images of 12 blocks, from the points of ")
    for name in region.bad_cameras:
        assert f"camera {name}: its a priori model was given up" in said


def test_an_unknown_block_is_answered_with_some_that_there_are(catalogue: Path, tmp_path: Path) -> None:
    opened = Catalogue.open(catalogue)
    with pytest.raises(CatalogueError, match=rf"no block 'B'; expected one of {', '.join(opened.block_ids[:5])} and 7 more$"):
        opened.block("B")
    one = rewrite(catalogue, tmp_path / "one", list(opened.blocks())[:1])
    with pytest.raises(CatalogueError, match=rf"no block 'B'; expected {opened.block_ids[0]}$"):
        Catalogue.open(one).block("B")


def test_a_result_that_fails_leaves_no_folder(tmp_path: Path) -> None:
    """Folders above it that were there, or that have got something else, stay."""
    (tmp_path / "mine").mkdir()
    with pytest.raises(RuntimeError), AdjustedWriter(tmp_path / "mine" / "a" / "b" / "out", True, {}):
        assert (tmp_path / "mine" / "a" / "b").is_dir()
        raise RuntimeError
    assert [path.name for path in tmp_path.rglob("*")] == ["mine"]
    with pytest.raises(RuntimeError), AdjustedWriter(tmp_path / "mine" / "a" / "b" / "out", True, {}):
        (tmp_path / "mine" / "a" / "other").write_text("mine")
        raise RuntimeError
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "mine", "other"]


def test_deweighted_cameras_say_so(catalogue: Path, complete: Path, tmp_path: Path) -> None:
    result = readjust_network(Catalogue.open(catalogue), str(complete), tmp_path / "out", block="T001-001", deweight=10.0)
    assert result.to_json()["status"] == "de-weighted"
    assert pq.read_schema(tmp_path / "out" / "cameras.parquet").metadata[b"deweight"] == b"10"


def test_blocks_that_are_missing_are_named(catalogue: Path, complete: Path, region: SimulatedRegion, tmp_path: Path) -> None:
    opened = Catalogue.open(catalogue)
    blocks = list(opened.blocks())
    part = rewrite(catalogue, tmp_path / "part", blocks[:3])
    fuse(part, tmp_path / "network", area_of(region))
    result = readjust_network(opened, str(tmp_path / "network"), tmp_path / "out")
    assert (result.blocks, result.images) == (3, 9)
    assert result.blocks_missing == tuple(block.block_id for block in blocks[3:])
