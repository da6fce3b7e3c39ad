"""The papers' experiments through the product: catalogue, runs, queries, control, check. Tolerances are those of docs/experiments.md.

Predicted accuracies depend on the layout, hardly on the errors that are drawn: one seed says it all.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import submin
from benchmarks import __main__ as main
from benchmarks import five_blocks, worldview
from benchmarks.bundle import solve
from benchmarks.comparison import DATA, MET, NOT_MET, network_of, rejections_allowed, widened
from orchestration.check import check
from orchestration.control import add_control
from orchestration.executors import SerialExecutor
from submin.accuracy import nees_band
from submin.simulation.scene import SimulatedScene, realise
from submin.simulation.worldview import MIDDLE
from submin.storage.catalogue import Catalogue
from submin.storage.point_table import read_point_table
from submin.storage.simulated import scene_blocks, write_scene


@pytest.fixture(scope="module")
def five() -> SimulatedScene:
    return realise(five_blocks.five_blocks(), five_blocks.SEED)


@pytest.fixture(scope="module")
def networks(five: SimulatedScene, tmp_path_factory: pytest.TempPathFactory) -> five_blocks.Networks:
    return five_blocks.fuse(five, tmp_path_factory.mktemp("five-blocks"))


def test_tables_of_the_five_blocks(five: SimulatedScene, networks: five_blocks.Networks) -> None:
    steps = [five_blocks.extraction(five.layout), *networks.steps]
    rows = [*five_blocks.table_2(steps), *five_blocks.table_3(networks.control)]
    assert len(rows) == 25
    assert [row for row in rows if row["verdict"] != MET] == []


def test_claims_of_the_five_blocks(five: SimulatedScene, networks: five_blocks.Networks) -> None:
    rows = list(five_blocks.claims([five_blocks.extraction(five.layout), *networks.steps], networks))
    assert sum(row["claim"].startswith("sequential") for row in rows) == 4
    assert [row for row in rows if row["verdict"] not in (MET, "data")] == []


def test_a_bundle_in_memory_is_the_network(five: SimulatedScene, networks: five_blocks.Networks) -> None:
    whole = solve(scene_blocks(five))
    np.testing.assert_allclose(whole.geocentric, networks.sequential.geocentric, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(whole.joint_covariance(np.arange(62)), networks.sequential.covariance, rtol=1e-7, atol=1e-7)


def test_five_blocks_are_consistent(five: SimulatedScene) -> None:
    """A few of the benchmark's 200 runs, against the band of so few."""
    found = {row["claim"].split(",")[0]: row["found"] for row in five_blocks.consistency(five.layout, 0.1)}
    low, high = nees_band(20 * 3 * 62, 0.999)
    assert low < found["NEES per degree of freedom"] < high


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatedScene, Catalogue]:
    scene = realise(worldview.worldview(), 1)
    folder = tmp_path_factory.mktemp("worldview") / "catalogue"
    write_scene(scene, folder)
    return scene, Catalogue.open(folder)


def test_tables_of_worldview(pairs: tuple[SimulatedScene, Catalogue], tmp_path: Path) -> None:
    """All pairs in one commit, check points, sparse control."""
    scene, catalogue = pairs
    layout, blocks = scene.layout, list(catalogue.blocks())
    place = network_of(catalogue, tmp_path / "network", [blocks])
    network = submin.open(place)
    fused = network.query(points=layout.point_ids)
    points = catalogue.points("check")
    assert points is not None
    result = check(network, points, "rigorous")
    assert result.accuracy.points == 101 and result.by_area[MIDDLE].points == 25 and not result.missing
    assert result.nees_band[0] < result.nees_per_dof < result.nees_band[1]

    added = add_control(read_point_table(catalogue.path / "control-external.parquet"), "control-external", place, SerialExecutor())
    assert added.fused == 9
    predicted = worldview.predictions(layout, fused, submin.open(place).query(points=layout.point_ids), blocks)
    for name, ours in predicted.items():
        for k, lines in enumerate(worldview.TABLES[name]):
            assert ours[k] == pytest.approx(lines.predicted, rel=worldview.ALLOWED[name][k]), name


def test_pair_cell_and_simultaneous_are_one(pairs: tuple[SimulatedScene, Catalogue], tmp_path: Path) -> None:
    """On the first cell and its neighbour: a commit a pair, a commit a cell, one commit; and all their images as one block."""
    catalogue = pairs[1]
    blocks = list(catalogue.blocks())[:8]
    ways = {"pairs": [[block] for block in blocks], "cells": [blocks[:5], blocks[5:]], "simultaneous": [blocks]}
    ways["one block"] = [[worldview.joined(blocks, "one block")]]
    answers = {
        name: submin.open(network_of(catalogue, tmp_path / name, batches)).query(points=np.unique(blocks[0].point_ids))
        for name, batches in ways.items()
    }
    for name, limit_mm in (("cells", 1e-6), ("simultaneous", 1e-6), ("one block", 1e-4)):
        assert 1e3 * np.abs(answers["pairs"].geocentric - answers[name].geocentric).max() <= limit_mm


def test_tiles_that_judge_alike_must_agree_and_others_stay_within_what_is_stated() -> None:
    alike = worldview.Tiling(1, (), 1.2e-5, 4e-6)
    otherwise = worldview.Tiling(0, ("image 3",), 0.86, 0.5)
    assert [row["verdict"] for row in worldview.tiles([alike, otherwise])] == [MET, DATA, MET]
    assert [row["verdict"] for row in worldview.tiles([replace(alike, metres=0.002)])] == [NOT_MET]
    assert [row["verdict"] for row in worldview.tiles([replace(otherwise, of_ce90=1.1)])] == [NOT_MET, DATA, NOT_MET]  # none is alike


def test_bands_fit_the_number_of_runs() -> None:
    assert (widened(3.0, 200, 200), widened(3.0, 400, 200), widened(3.0, 50, 200)) == (3.0, 3.0, 6.0)
    assert rejections_allowed(0.001, 48000, 200, 200) == 0.001
    assert rejections_allowed(0.001, 480, 2, 200) == 4 / 480  # of half a ray expected, four are one in a thousand at most
    assert rejections_allowed(0.001, 480, 2, 200) < 0.01


def test_what_is_not_met_ends_with_exit_code_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for verdict, code in ((MET, 0), (DATA, 0), ("", 0), (NOT_MET, 1)):
        rows = [{"claim": "a claim " * 40, "verdict": verdict}]
        monkeypatch.setitem(main.BENCHMARKS, "worldview", ("", lambda scale, workers, rows=rows: rows))
        app = typer.Typer()
        app.command()(main.command)
        said = CliRunner().invoke(app, ["worldview"])
        assert said.exit_code == code
        assert ("a claim " * 40).strip() in said.output and "…" not in said.output
