"""Cases of withdrawal, control and tags, and of the metadata, thinning and dates of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from bad_input.world import BOX, World, case, put, simply
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.run import run
from submin.formats.tables import covariance_rows
from submin.storage.catalogue import Catalogue

# --- withdrawal, control and tags -------------------------------------------------------------------------------------------------------

HEADER = "point_id,longitude,latitude,height"


def surveyed(w: World, header: str, *rows: str) -> list[Any]:
    """Control points in a file, and the command that adds them."""
    return ["control", "add", w.fused, w.write("survey.csv", "\n".join([header, *rows]))]


simply("nothing named to be withdrawn", lambda w: ["withdraw", w.fused])
simply("two things named to be withdrawn", lambda w: ["withdraw", w.fused, "--block", w.block(), "--control", "P"])
simply("withdrawal of a block that is not there", lambda w: ["withdraw", w.network, "--block", w.block()])
simply("withdrawal of a control point that is not there", lambda w: ["withdraw", w.fused, "--control", "P"])
simply("added control without covariance", lambda w: surveyed(w, HEADER, "P,100,35,0"))
simply(
    "added control with a negative variance",
    lambda w: surveyed(w, f"{HEADER},cov_ee,cov_en,cov_eu,cov_nn,cov_nu,cov_uu", "P,100,35,0,-1,0,0,1,0,1"),
)
simply("added control with a negative sigma", lambda w: surveyed(w, f"{HEADER},sigma_e,sigma_n,sigma_u", "P,100,35,0,-1,1,1"))
simply("added control with a sigma of zero", lambda w: surveyed(w, f"{HEADER},sigma_e,sigma_n,sigma_u", "P,100,35,0,1,0,1"))
simply("tag that is taken", lambda w: ["tag", w.tagged(), "mine"])
simply("details of points that join from elsewhere", lambda w: [*w.joining(lambda a: None), "--details", "--out", w.folder / "points.csv"])
simply("control to join in another format", lambda w: ["query", w.fused, *BOX, "--join", w.write("other.csv", "point_id\n")])
simply("control to join that does not say where it is", lambda w: w.joining(lambda a: a.pop("frame")))
simply("control to join with a point twice", lambda w: w.joining(lambda a: put(a["ids"], 1, a["ids"][0])))
simply("control to join in another frame, epoch or ellipsoid", lambda w: w.joining(lambda a: a.update(frame=np.array("PZ-90"))))
simply("control to join without a common point", lambda w: w.joining(lambda a: a.update(ids=np.char.add("X", a["ids"]))))
simply("control to join with an id elsewhere", lambda w: w.joining(lambda a: a.update(geocentric=a["geocentric"] + 1e5)))
simply("tag like a version", lambda w: ["tag", w.fused, "v1"])
simply("difference to an unknown version", lambda w: ["diff", w.fused, "v0", "v8"])

# --- points: metadata, thinning, dates --------------------------------------------------------------------------------------------------


def listing(w: World, *words: Any, out: str = "points.csv") -> list[Any]:
    return ["points", w.fused, *words, "--out", w.folder / out]


def retiring(w: World, *words: Any, ids: str = "P000000\n") -> list[Any]:
    return ["retire", w.fused, "--points", w.write("ids.txt", ids), *words]


simply("thinning to squares without a side", lambda w: ["create", w.new, *BOX, "--thin-metres", 0])
simply("details of an answer that is not written", lambda w: ["query", w.fused, *BOX, "--details"])
simply("query on a day that is none", lambda w: ["query", w.fused, *BOX, "--on", "31.5.2026"])
simply("metadata of no points", lambda w: listing(w))
simply("metadata asked for in two ways", lambda w: listing(w, *BOX, "--tile", "r000c000"))
simply("metadata of unknown points", lambda w: listing(w, "--points", w.write("ids.txt", "P000000\nP1\n")))
simply("metadata of an unknown status", lambda w: listing(w, *BOX, "--status", "good"))
simply("metadata of unknown format", lambda w: listing(w, *BOX, out="points.npz"))
simply("metadata to a folder that does not exist", lambda w: listing(w, *BOX, out="nowhere/points.csv"))
simply("retirement of unknown points", lambda w: retiring(w, "--valid-to", "2026-05-31", ids="P000000\nP1\n"))
simply("retirement on a day that is none", lambda w: retiring(w, "--valid-to", "2026-02-30"))
simply("retirement without a day", lambda w: retiring(w, "--reason", "quarry"))
simply("retirement before the first day", lambda w: retiring(w, "--valid-from", "2026-06-01", "--valid-to", "2026-05-31"))


def _correlated(w: World, covariance: Any, variance: float = 1.0) -> list[Any]:
    """Two points with this joint covariance, and a variance beside it for the coordinates of each."""
    points = Catalogue.open(w.catalogue).points("check")
    columns = {"point_id": points.point_ids[:2]}  # type: ignore[union-attr]
    columns |= {name: points.geodetic[:2, k] for k, name in enumerate(("longitude", "latitude", "height"))}  # type: ignore[union-attr]
    columns |= {f"sigma_{axis}": np.full(2, np.sqrt(variance)) for axis in "enu"}
    pq.write_table(pa.table(columns | {"covariance_row": covariance_rows(covariance, 0, 2)}), w.folder / "joint.parquet")
    return ["control", "add", w.fused, w.folder / "joint.parquet"]


@case("correlated control with a negative variance")
def _(w: World) -> list[Any]:
    return _correlated(w, np.kron([[1.0, 2.0], [2.0, 1.0]], np.eye(3)))


@case("correlated control without a datum")
def _(w: World) -> list[Any]:
    return _correlated(w, np.kron(np.full((2, 2), 1e12) + np.eye(2), np.eye(3)), 1e12)


@case("correlated control whose covariances contradict each other")
def _(w: World) -> list[Any]:
    return _correlated(w, np.eye(6), 2.0)


@case("image id of a control point")
def _(w: World) -> list[Any]:
    w.set("images", "image_id", "control:P:0")
    return w.run()


@case("tile that was split")
def _(w: World) -> list[Any]:
    catalogue = Catalogue.open(w.catalogue)
    area = shapely.box(99.5, 34.5, 100.5, 35.5)
    create(str(w.new), area, catalogue.metadata, 200.0, 20.0, max_parameters=60)
    run(catalogue, str(w.new), SerialExecutor())
    return ["query", w.new, "--tile", "r000c000"]
