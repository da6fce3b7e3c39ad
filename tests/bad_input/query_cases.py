"""Cases of queries, checks and maps, and of exports."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest import mock

import submin
from bad_input.disks import limited, read_only
from bad_input.world import BOX, POINT, SIGMAS, World, case, simply

# --- queries, checks, maps --------------------------------------------------------------------------------------------------------------

simply("nothing queried", lambda w: ["query", w.fused])
simply("two things queried", lambda w: ["query", w.fused, *BOX, "--points", w.write("ids.txt", "P1")])
simply("scheduler that does not answer", lambda w: [*w.run(), "--scheduler", "carrier-pigeon://here"])
simply("unknown policy", lambda w: ["query", w.fused, *BOX, "--policy", "best"])
simply("unknown tile", lambda w: ["query", w.fused, "--tile", "r9"])
simply("unknown points", lambda w: ["query", w.fused, "--points", w.write("ids.txt", "P1\nP2\n")])
simply("no such list of points", lambda w: ["query", w.fused, "--points", w.folder / "nowhere.csv"])
simply("empty list of points", lambda w: ["query", w.fused, "--points", w.write("ids.txt", "\n")])
simply("list of points without a column of ids", lambda w: ["query", w.fused, "--points", w.write("ids.csv", "id\nP1\n")])
simply("list of points that is not UTF-8", lambda w: ["query", w.fused, "--points", w.write("ids.txt", b"Z\xfcrich\n")])
simply("output of unknown format", lambda w: ["query", w.fused, *BOX, "--out", w.folder / "control.xls"])
simply("output to a folder that does not exist", lambda w: ["query", w.fused, *BOX, "--out", w.folder / "nowhere" / "control.csv"])
simply("output where a folder is", lambda w: ["query", w.fused, *BOX, "--out", Path(f"{w.catalogue}").rename(w.folder / "c.csv")])
simply("check of no such table", lambda w: ["check", w.fused, w.folder / "nowhere.csv"])
simply(
    "check of points that are not in the network",
    lambda w: ["check", w.fused, w.write("c.csv", f"{','.join(POINT | SIGMAS)}\nZ,100,35,900,1,1,1\n")],
)
simply(
    "report of a check to a folder that does not exist",
    lambda w: ["check", w.fused, w.catalogue / "check.parquet", "--out", w.new / "c.txt"],
)
simply("map of another format", lambda w: ["map", w.fused, "--out", w.folder / "map.pdf"])
simply("map to a folder that does not exist", lambda w: ["map", w.fused, "--out", w.folder / "nowhere" / "map.png"])


@case("output to a folder that is read only")
def _(w: World) -> list[Any]:
    (w.folder / "closed").mkdir()
    w.around = lambda: read_only(w.folder / "closed")
    return ["query", w.fused, *BOX, "--out", w.folder / "closed" / "control.npz"]


@case("output on a full disk")
def _(w: World) -> list[Any]:
    w.around = lambda: limited(1000)
    return ["query", w.fused, *BOX, "--out", w.folder / "control.parquet"]


@case("map on a full disk")
def _(w: World) -> list[Any]:
    w.around = lambda: limited(1000)
    return ["map", w.fused, "--out", w.folder / "map.png"]


# --- export -----------------------------------------------------------------------------------------------------------------------------


def export(w: World, *words: Any, out: str = "compact.parquet", family: str = "exponential") -> list[Any]:
    return ["export", w.fused, "--out", w.folder / out, "--family", family, *words]


simply("unknown family of correlation functions", lambda w: export(w, family="sinc"))
simply("correlation function that is indefinite in the plane", lambda w: export(w, family="tent"))
simply("floor of a family that has none", lambda w: export(w, "--floor-km", 50))
simply("floor that is not positive", lambda w: export(w, "--floor-km", 0))
simply("more vectors than coordinates", lambda w: export(w, "--rank", 1000))
simply("negative number of vectors", lambda w: export(w, "--rank", -1))
simply("no points to condense", lambda w: export(w, "--bbox", 99, 34, 99.001, 34.001))
simply("export of unknown format", lambda w: export(w, out="compact.csv"))
simply("export to a folder that does not exist", lambda w: export(w, out="nowhere/compact.parquet"))


@case("too many points to condense")
def _(w: World) -> list[Any]:
    w.around = lambda: mock.patch("submin.correlation.compact.MOST_POINTS", 10)
    return export(w)


@case("export as control")
def _(w: World) -> list[Any]:
    submin.open(w.fused).export(w.folder / "compact.parquet", family="exponential", max_points=9)
    return ["control", "add", w.fused, w.folder / "compact.parquet"]
