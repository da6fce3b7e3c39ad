"""verify finds damage of a dense network, whatever was damaged, and passes a sound one with waiting blocks and withdrawals behind it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from dense_networks import mixed_cluster, position_cluster, truth

from orchestration.cli import main
from orchestration.create import create, fit_points
from orchestration.dense_run import run_dense, withdraw_dense
from orchestration.executors import SerialExecutor
from orchestration.verify import verify
from submin.network.observations import Cluster
from submin.storage.arrays import append_table, array_of, attributes_of, group_of, read_record, read_table, write_record
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import CatalogueMetadata
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.commit import begin_change, commit
from submin.storage.snapshot import Snapshot

Root = zarr.Group


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of 40 points in two batches, with a block that waits and one withdrawn."""
    folder = tmp_path_factory.mktemp("dense")
    rng = np.random.default_rng(5)
    at = truth(rng, 40)
    ids = list(at)
    clusters = [mixed_cluster(rng, at, f"cluster {k:02d}", 0.1) for k in range(20)]
    clusters += [position_cluster(rng, at, f"positions {k}", ids[k::3]) for k in range(3)]
    lost = Cluster("waits", np.array(["nowhere"]), np.array(["elsewhere"]), np.ones((1, 3)), np.eye(3))
    with CatalogueWriter(folder / "catalogue", CatalogueMetadata("survey")) as writer:
        for cluster in [*clusters, lost]:
            writer.write_observations(cluster)
    catalogue, place = Catalogue.open(folder / "catalogue"), folder / "network"
    create(str(place), fit_points(catalogue), catalogue.metadata, None, None, "dense")
    run_dense(catalogue, str(place), batch_blocks=12)
    withdraw_dense(str(place), block="cluster 07")
    return place


def points(change: Callable[[dict[str, np.ndarray]], None]) -> Callable[[Root], None]:
    def damage(root: Root) -> None:
        group = group_of(group_of(root, "dense"), "points")
        attributes = {key: value for key, value in attributes_of(group).items() if key != "layout"}
        record, covariance = read_record(group), np.asarray(array_of(group, "covariance")[:, :])
        change(record)
        written = write_record(group_of(root, "dense"), "points", record, attributes)
        written.create_array("covariance", data=covariance, chunks=(len(covariance), len(covariance)))

    return damage


def covariance(change: Callable[[np.ndarray], Any]) -> Callable[[Root], None]:
    def damage(root: Root) -> None:
        array = array_of(group_of(group_of(root, "dense"), "points"), "covariance")
        values = np.asarray(array[:, :])
        change(values)
        array[:, :] = values

    return damage


def column(table: str, name: str, row: int, change: Callable[[Any], Any]) -> Callable[[Root], None]:
    def damage(root: Root) -> None:
        group = group_of(root, table)
        columns = read_table(group)
        values = columns[name].astype(object)
        values[row] = change(values[row])
        columns[name] = values.astype(columns[name].dtype if columns[name].dtype.kind != "U" else np.str_)
        for key in group.array_keys():
            array_of(group, key).resize((0,))
        append_table(group, columns)

    return damage


def ledger_twice(root: Root) -> None:
    table = group_of(root, "ledger")
    append_table(table, {name: values[:1] for name, values in read_table(table).items()})


def chi_square(root: Root) -> None:
    group = group_of(group_of(root, "dense"), "points")
    group.attrs["whole_square"] = 0.5 * float(attributes_of(group)["whole_square"])


DAMAGE: dict[str, tuple[str, Callable[[Root], None]]] = {
    "variance of a point made smaller": ("not-symmetric", covariance(lambda p: p.__setitem__((0, 0), 0.9 * p[0, 0]))),
    "covariance of two points changed": ("stale-factor", covariance(lambda p: p.__setitem__((60, 3), p[60, 3] + 1e-5 * p[3, 3]))),
    "covariance not positive definite": ("not-positive-definite", covariance(lambda p: p.__setitem__((60, 3), 5.0 * p[3, 3]))),
    "covariance not a number": ("not-finite", covariance(lambda p: p.__setitem__((60, 3), np.nan))),
    "point moved": ("stale-factor", points(lambda r: r["adjustments"].__setitem__(5, r["adjustments"][5] + 1e-3))),
    "origin moved": ("stale-factor", points(lambda r: r["origins"].__setitem__((2, 0), r["origins"][2, 0] + 1e-3))),
    "block forgotten by the state": ("stale-factor", points(lambda r: r.__setitem__("blocks", r["blocks"][1:]))),
    "block twice in the state": ("block-twice", points(lambda r: r["blocks"].__setitem__(0, r["blocks"][1]))),
    "point lost its name": ("stale-factor", points(lambda r: r["ids"].__setitem__(0, "zz"))),
    "observed value changed": ("ledger", column("dense/observations", "x", 3, lambda x: x + 1e-3)),
    "covariance of an observation changed": ("ledger", column("dense/covariances", "value", 0, lambda v: 1.01 * v)),
    "line of the ledger twice": ("block-twice", ledger_twice),
    "line of the ledger renamed": ("rays-missing", column("ledger", "block_id", 0, lambda name: "cluster 99")),
    "observations fewer than came": ("rays-missing", column("ledger", "rays", 0, lambda n: n + 1)),
    "version from the future": ("ledger", column("ledger", "version", 0, lambda v: 77)),
    "chi-square halved": ("stale-factor", chi_square),
}


def test_a_sound_network_passes(sound: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    found = verify(str(sound), SerialExecutor())
    assert found.ok, found.problems
    assert found.worst("replay_error") < 1e-9
    assert found.tiles[0].parameters == 120
    monkeypatch.setattr("sys.argv", ["submin", "verify", str(sound), "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert json.loads(capsys.readouterr().out)["ok"]


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found(name: str, sound: Path, tmp_path: Path) -> None:
    kind, damage = DAMAGE[name]
    place = str(shutil.copytree(sound, tmp_path / "network"))
    session, base = begin_change(place, Snapshot.open(place).number)
    root = zarr.open_group(session.store, mode="r+")
    damage(root)
    root.attrs["version"] = base.number + 1
    commit(session, base.number + 1, "damaged")
    found = verify(place, SerialExecutor())
    assert (kind, "r000c000") in {(problem.kind, problem.tile) for problem in found.problems}, found.problems
