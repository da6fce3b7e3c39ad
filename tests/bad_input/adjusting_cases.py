"""Cases of blocks that are adjusted and readjusted."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.csv as pcsv
import pyarrow.parquet as pq

import submin
from bad_input.disks import read_only
from bad_input.world import World, case, simply
from orchestration.adjust import adjust, write
from orchestration.executors import SerialExecutor
from orchestration.run import run
from submin.storage.catalogue import Catalogue


def adjusting(w: World, *options: Any, network: bool = False) -> list[Any]:
    """The command that adjusts the first block, by the network that has none of them or by itself."""
    control = ["--network", w.network] if network else []
    return ["adjust", w.catalogue, "--block", w.block(), *control, "--out", w.new, *options]


simply("adjustment of a block that is in the network", lambda w: [*adjusting(w), "--network", w.fused])
simply("adjustment of an unknown block", lambda w: ["adjust", w.catalogue, "--block", "B", "--out", w.new])
simply("adjustment by an unknown policy", lambda w: [*adjusting(w), "--network", halfway(w), "--policy", "best"])
simply("adjustment with no point at most", lambda w: adjusting(w, "--max-points", 0))
simply("virtual control beside a network", lambda w: adjusting(w, "--virtual-control", 3, network=True))
simply("virtual control of unknown weight", lambda w: adjusting(w, "--virtual-control", 3, "--virtual-weight", "heavy"))
simply("virtual control of too few points", lambda w: adjusting(w, "--virtual-control", 1))
simply("virtual control out of reach", lambda w: adjusting(w, "--virtual-control", 3, "--virtual-height", 1e12))
simply("virtual control at no height", lambda w: adjusting(w, "--virtual-control", 3, "--virtual-height", "nan"))
for option, value in (("sigma", 5), ("weight", "plain"), ("height", 0)):
    simply(
        f"adjustment with --virtual-{option} and no --virtual-control",
        lambda w, words=(f"--virtual-{option}", value): adjusting(w, *words, network=True),
    )
simply("adjustment with --policy and no --network", lambda w: adjusting(w, "--policy", "auto"))
simply("adjustment with --at and no --network", lambda w: adjusting(w, "--at", "v1"))
simply("readjustment by an unknown policy", lambda w: ["readjust", w.catalogue, w.fused, "--out", w.new / "a" / "b", "--policy", "best"])
simply("readjustment of a block that is not in the network", lambda w: [*readjusting(w, w.network), "--block", w.block()])
simply("readjustment of a catalogue that is not in the network", lambda w: readjusting(w, w.network))
simply("de-weighting that gives weight", lambda w: [*readjusting(w, w.fused), "--deweight", 0.5])


def readjusting(w: World, network: Path) -> list[Any]:
    return ["readjust", w.catalogue, network, "--out", w.new]


def halfway(w: World) -> Path:
    """A network of all blocks but the first."""
    part = shutil.copytree(w.catalogue, w.folder / "part")
    for stem in ("images", "measurements"):
        table = pq.read_table(part / f"{stem}.parquet")
        pq.write_table(table.filter(pc.not_equal(table["block_id"], w.block())), part / f"{stem}.parquet")
    run(Catalogue.open(part), str(w.network), SerialExecutor())
    return w.network


@case("adjustment of a block with a ray twice")
def _(w: World) -> list[Any]:
    columns = w.columns("measurements")
    w.put("measurements", {name: [values[0], *values] for name, values in columns.items()})
    return adjusting(w)


@case("adjustment by a network of another frame")
def _(w: World) -> list[Any]:
    w.metadata(frame="ITRF2014")
    return adjusting(w, network=True)


@case("control of an adjustment with an impossible joint covariance")
def _(w: World) -> list[Any]:
    ids = w.columns("measurements")["point_id"][:2]
    at = {name: [value, value] for name, value in (("longitude", 100.0), ("latitude", 35.0), ("height", 0.0))}
    rows = [np.eye(3).ravel().tolist(), np.hstack([5.0 * np.eye(3), np.eye(3)]).ravel().tolist()]
    w.put("control", {"point_id": sorted(set(ids)) if len(set(ids)) == 2 else [ids[0], "other"], **at, "covariance_row": rows})
    return adjusting(w)


@case("result of an adjustment where something is")
def _(w: World) -> list[Any]:
    w.new.mkdir()
    (w.new / "mine").write_text("mine")
    return adjusting(w)


@case("result of a readjustment where a file is")
def _(w: World) -> list[Any]:
    return ["readjust", w.catalogue, w.fused, "--out", w.write("file", "mine")]


@case("result of an adjustment in a folder that is read only")
def _(w: World) -> list[Any]:
    folder = w.folder / "closed"
    folder.mkdir()
    w.around = lambda: read_only(folder)
    return ["adjust", w.catalogue, "--block", w.block(), "--out", folder / "result"]


@case("adjusted points added as control")
def _(w: World) -> list[Any]:
    catalogue = Catalogue.open(w.catalogue)
    write(adjust(catalogue, w.block()), w.new)
    return ["control", "add", w.fused, w.new / "points.parquet"]


def answered(w: World, path: Path) -> Path:
    """What the network answers of all its points, as a file."""
    submin.open(str(w.fused)).query(bbox=(-180.0, -90.0, 180.0, 90.0)).write(path)
    return path


for suffix in ("csv", "parquet"):

    @case(f"answer of a network added as control, {suffix}")
    def _(w: World, suffix: str = suffix) -> list[Any]:
        return ["control", "add", w.fused, answered(w, w.folder / f"answer.{suffix}")]

    @case(f"answer of a network as control of a run, {suffix}")
    def _(w: World, suffix: str = suffix) -> list[Any]:
        answered(w, w.catalogue / f"control.{suffix}")
        return ["run", w.catalogue, w.network]

    @case(f"answer of a network as control of an adjustment, {suffix}")
    def _(w: World, suffix: str = suffix) -> list[Any]:
        answered(w, w.catalogue / f"control.{suffix}")
        return adjusting(w)


@case("one column of an answer left in control")
def _(w: World) -> list[Any]:
    table = pcsv.read_csv(answered(w, w.folder / "answer.csv")).drop_columns(["tile", "ce90", "le90"])
    pcsv.write_csv(table, w.folder / "few.csv")
    return ["control", "add", w.fused, w.folder / "few.csv"]
