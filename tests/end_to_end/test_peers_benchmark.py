"""`python -m benchmarks peers` on its smallest blocks: contenders agree; a network's own system solved once is its one factorisation."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from networks import SMALL, area_of, fuse
from whole_network import points as points_of_state
from whole_network import truth

import submin
from benchmarks import peers, sparse_adjustment
from benchmarks.comparison import DATA, MET
from benchmarks.sparse_adjustment import SparseAdjustment, adjusted_points, located
from orchestration.create import create, fit_catalogue
from orchestration.executors import SerialExecutor
from orchestration.run import run
from submin.query.planner import all_points
from submin.simulation.five_blocks import five_blocks
from submin.simulation.region import simulate_region
from submin.simulation.scene import realise
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import write_region, write_scene

INSTALLED = [peer for peer, (package, _) in peers.PEERS.items() if importlib.util.find_spec(package)]


def test_contenders_agree_on_the_smallest_blocks(tmp_path: Path) -> None:
    rows = peers.measure(0.001, 0, tmp_path)
    table = [row for row in rows if "contender" in row]
    assert [row["contender"] for row in table] == ["ours", *INSTALLED]
    assert {(row["points"], row["rays"], row["images"]) for row in table} == {(62, 240, 18)}
    assert all(row["peak, MB"] > 0.0 and row["there in, s"] > 0.0 and row["3x3"] == "computed" for row in table)
    agreement = [row for row in rows if row.get("verdict", DATA) != DATA]
    assert len(agreement) == 2 + 3 * len(INSTALLED)
    assert [row for row in agreement if row["verdict"] != MET] == []
    assert len([row for row in rows if "not compared" in str(row.get("wanted"))]) == len(peers.PEERS) - len(INSTALLED)
    assert json.loads((tmp_path / "peers.json").read_text(encoding="utf-8"))["rows"][0]["contender"] == "ours"


def region_network(folder: Path) -> Path:
    """Errors common to passes, and a bad camera whose prior is released."""
    region = simulate_region(SMALL)
    write_region(region, folder / "catalogue")
    fuse(folder / "catalogue", folder / "network", area_of(region))
    return folder / "network"


def correlated_network(folder: Path) -> Path:
    """Errors of a block's images that are correlated up to a factor as good as singular."""
    write_scene(realise(five_blocks(), 0), folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    area, _, _ = fit_catalogue(catalogue)
    create(str(folder / "network"), area, catalogue.metadata, 100.0, 50.0)
    run(catalogue, str(folder / "network"), SerialExecutor())
    return folder / "network"


@pytest.mark.parametrize("make", [region_network, correlated_network])
def test_own_system_solved_once_is_the_one_factorisation(
    make: Callable[[Path], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = submin.open(make(tmp_path))
    monkeypatch.setattr(sparse_adjustment, "CELLS_AT_ONCE", 3)
    monkeypatch.setattr(sparse_adjustment, "POINTS_AT_ONCE", 10)
    ids, at, joint = points_of_state(network, network.snapshot.tile_numbers(), truth(network))
    single = joint.reshape(len(ids), 3, len(ids), 3)[np.arange(len(ids)), :, np.arange(len(ids)), :]
    chosen = np.arange(0, len(ids), 2)
    for solver in ("superlu", *(["cholmod"] if "sparse (CHOLMOD)" in INSTALLED else [])):
        solution = SparseAdjustment.of(network.snapshot, solver)
        found = adjusted_points(network, solution, network.named(ids[chosen]))
        assert solution.factor.solver == solver
        assert found.ids.tolist() == ids[chosen].tolist()
        assert np.abs(found.geocentric - at[chosen]).max() < 1e-6
        every, places = located(network, solution, all_points(network))
        assert every.tolist() == ids.tolist()
        assert np.abs(places - at).max() < 1e-6
        np.testing.assert_allclose(found.covariance, single[chosen], rtol=0.0, atol=1e-8 * np.abs(single).max())
