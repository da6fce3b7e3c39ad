"""Cases of a block that rejects itself and no other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import shapely

from bad_input.world import World, case, simply
from orchestration.create import create
from submin.storage.catalogue import Catalogue


def in_block(name: str, change: Callable[[World], Any], k: int = 0) -> None:
    """Enter a case in which one block of the catalogue is rejected."""

    def words(w: World) -> list[Any]:
        change(w)
        return w.run(rejected=w.block(k))

    case(name)(words)


in_block("measurement that is not a number", lambda w: w.set("measurements", "sample", float("nan"), row=4))
in_block("measurement that is missing", lambda w: w.set("measurements", "sample", None, row=4))
in_block("measurement that is infinite", lambda w: w.set("measurements", "line", float("inf"), row=4))
in_block("sigma of zero", lambda w: w.set("measurements", "sigma_sample", 0.0, row=4))
in_block("negative sigma", lambda w: w.set("measurements", "sigma_line", -0.5, row=4))
in_block("ray given twice", lambda w: w.put("measurements", {k: [v[0], *v] for k, v in w.columns("measurements").items()}))
in_block("image without measurements", lambda w: w.rows("measurements", lambda row: row["image_id"] != w.columns("images")["image_id"][1]))
in_block("block without measurements", lambda w: w.rows("measurements", lambda row: row["block_id"] != w.block(0)))


@case("block of two rays")
def _(w: World) -> list[Any]:
    images = pq.read_table(w.catalogue / "images.parquet")
    first, block = images["image_id"][0].as_py(), w.block(0)
    w.rows("images", lambda row: row["block_id"] != block or row["image_id"] == first)
    points = iter(range(1000))
    w.rows("measurements", lambda row: row["block_id"] != block or (row["image_id"] == first and next(points) < 2))
    return w.run(rejected=block)


@case("prior correlation in time, and an image without one")
def _(w: World) -> list[Any]:
    w.priors({"blocks": {w.block(0): {"correlation": "gaussian", "correlation_parameter": 60}}})
    w.set("images", "acquired", "")
    return w.run(rejected=w.block(0))


def all_cameras(w: World, block: str, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the cameras of a block."""
    for row, of in enumerate(w.columns("images")["block_id"]):
        if of == block:
            w.camera(change, row)


def elsewhere(w: World, longitude: float, latitude: float) -> list[Any]:
    """The first block lies at another place, and shares no point with the others."""
    block = w.block(0)
    all_cameras(w, block, lambda c: c.update(LONG_OFF=longitude + c["LONG_OFF"] - 100.0, LAT_OFF=latitude + c["LAT_OFF"] - 35.0))
    rays = w.columns("measurements")
    rays["point_id"] = [f"away-{p}" if b == block else p for p, b in zip(rays["point_id"], rays["block_id"], strict=True)]
    w.put("measurements", rays)
    return w.run(rejected=block)


simply("block wholly outside the area", lambda w: elsewhere(w, 20.0, 50.0))


@case("block outside an area with swapped axes")
def _(w: World) -> list[Any]:
    catalogue = w.catalogue
    for row in range(len(w.columns("images")["image_id"])):
        w.camera(lambda c: c.update(LONG_OFF=c["LONG_OFF"] - 70.0), row)
    w.rows("images", lambda row: row["block_id"] in (w.block(0), w.block(1)))
    kept = set(Catalogue.open(catalogue).block_ids)
    w.rows("measurements", lambda row: row["block_id"] in kept)
    create(str(w.new), shapely.box(34.0, 29.0, 36.0, 31.0), Catalogue.open(catalogue).metadata, 60.0, 20.0)
    w.rejected = tuple(sorted(kept))
    return ["run", catalogue, w.new]


@case("one id at two places")
def _(w: World) -> list[Any]:
    block = w.block(3)
    rays = w.columns("measurements")
    theirs = {p for p, b in zip(rays["point_id"], rays["block_id"], strict=True) if b != block}
    mine = next(p for p, b in zip(rays["point_id"], rays["block_id"], strict=True) if b == block)
    far = next(p for p in sorted(theirs, reverse=True) if (block, p) not in set(zip(rays["block_id"], rays["point_id"], strict=True)))
    rays["point_id"] = [far if b == block and p == mine else p for p, b in zip(rays["point_id"], rays["block_id"], strict=True)]
    w.put("measurements", rays)
    return w.run(rejected=block)


@case("one id at another place than in the network")
def _(w: World) -> list[Any]:
    block = w.block(0)
    all_cameras(w, block, lambda c: c.update(LONG_OFF=c["LONG_OFF"] + 0.2))
    for stem in ("images", "measurements"):
        columns = w.columns(stem)
        moved = [b == block for b in columns["block_id"]]
        for name in ("block_id", "image_id"):
            columns[name] = [f"again-{value}" if m else value for value, m in zip(columns[name], moved, strict=True)]
        w.put(stem, columns)
    w.rejected = (f"again-{block}",)
    return ["run", w.catalogue, w.fused]


@case("camera that looks away from the ground")
def _(w: World) -> list[Any]:
    w.camera(lambda c: c.update(SAMP_NUM_COEFF=[0.0] * 20))
    return w.run(rejected=w.block(0))


@case("points of a block measured all at one place")
def _(w: World) -> list[Any]:
    block = w.block(0)
    rays = w.columns("measurements")
    for name in ("sample", "line"):  # every point in the middle of every image
        rays[name] = [5000.0 if b == block else v for v, b in zip(rays[name], rays["block_id"], strict=True)]
    w.put("measurements", rays)
    return w.run(rejected=block)


def measured_elsewhere(w: World, block: str, lines: float, rows: slice = slice(None)) -> list[Any]:
    """The rays of a block, or some of them, are measured so many lines off."""
    rays = w.columns("measurements")
    for k in np.flatnonzero([b == block for b in rays["block_id"]])[rows]:
        rays["line"][k] += lines
    w.put("measurements", rays)
    return w.run(rejected=block)


simply("block measured far outside its images", lambda w: measured_elsewhere(w, w.block(0), 3e5))
simply("line far out of range", lambda w: measured_elsewhere(w, w.block(0), 1e9, slice(5, 6)))


@case("camera on the other side of the Earth")
def _(w: World) -> list[Any]:
    w.camera(lambda c: c.update(LONG_OFF=c["LONG_OFF"] - 180.0))
    return w.run(rejected=w.block(0))


@case("line upside down in a camera")
def _(w: World) -> list[Any]:
    w.camera(lambda c: c.update(LINE_NUM_COEFF=[-value for value in c["LINE_NUM_COEFF"]]))
    return w.run(rejected=w.block(0))


@case("sample and line exchanged in a block")
def _(w: World) -> list[Any]:
    block = w.block(0)
    rays = w.columns("measurements")
    pairs = list(zip(rays["sample"], rays["line"], rays["block_id"], strict=True))
    rays["sample"] = [line if b == block else sample for sample, line, b in pairs]
    rays["line"] = [sample if b == block else line for sample, line, b in pairs]
    w.put("measurements", rays)
    return w.run(rejected=block)


@case("block known with other content")
def _(w: World) -> list[Any]:
    w.set("measurements", "sample", w.columns("measurements")["sample"][0] + 1.0)
    w.rejected = (w.block(0),)
    return ["run", w.catalogue, w.fused]


@case("image that came in another block")
def _(w: World) -> list[Any]:
    block = w.block(0)
    for stem in ("images", "measurements"):
        columns = w.columns(stem)
        w.put(stem, columns | {"block_id": ["again" if b == block else b for b in columns["block_id"]]})
    w.rejected = ("again",)
    return ["run", w.catalogue, w.fused]
