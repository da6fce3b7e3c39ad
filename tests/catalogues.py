"""A small catalogue of two blocks that mean nothing, and ways to change its tables."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import shapely

from submin.adjustment.priors import APriori
from submin.storage.catalogue import Block, ImageRecord, PointTable

FOOTPRINT = shapely.to_wkb(shapely.box(10.0, 50.0, 10.1, 50.1))


def camera(**changes: Any) -> dict[str, Any]:
    zeros = [0.0] * 20
    return {
        "LINE_OFF": 500.0, "SAMP_OFF": 500.0, "LAT_OFF": 50.0, "LONG_OFF": 10.0, "HEIGHT_OFF": 100.0,
        "LINE_SCALE": 500.0, "SAMP_SCALE": 500.0, "LAT_SCALE": 0.01, "LONG_SCALE": 0.01, "HEIGHT_SCALE": 500.0,
        "LINE_NUM_COEFF": [0.0, 0.0, -1.0, 0.1, *zeros[4:]], "LINE_DEN_COEFF": [1.0, *zeros[1:]],
        "SAMP_NUM_COEFF": [0.0, 1.0, 0.0, 0.1, *zeros[4:]], "SAMP_DEN_COEFF": [1.0, *zeros[1:]],
    } | changes  # fmt: skip


def image(image_id: str, block_id: str, **changes: Any) -> ImageRecord:
    record = ImageRecord(
        image_id, block_id, f"{block_id}-pass", "WV", "rpc", json.dumps(camera()), 1000, 800, "2020-01-01T10:00:00Z", FOOTPRINT, "free"
    )
    return replace(record, **changes)


IMAGES = (image("a1", "A"), image("a2", "A", acquired="2020-01-01T10:00:10.5Z"), image("b1", "B", acquired="", footprint=b"", licence=""))


def block(block_id: str, points: int = 4, a_priori: APriori | None = None) -> Block:
    """Every image of a block sees every point, somewhere else."""
    members = tuple(i for i in IMAGES if i.block_id == block_id)
    m = len(members)
    index = np.tile(np.arange(m, dtype=np.int32), points)
    point = np.repeat(np.arange(points), m)
    sample = np.asarray(10.0 * point + index + 0.25, dtype=np.float64)
    line = np.asarray(2.0 * sample, dtype=np.float64)
    return Block(
        block_id, members, a_priori or APriori(), np.array([f"D/p{k}" for k in point]), index,
        sample, line, np.full(m * points, 0.5), np.full(m * points, 0.4),
    )  # fmt: skip


def points(n: int = 3) -> PointTable:
    covariance = np.array([[4.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 9.0]]) * (1.0 + np.arange(n))[:, None, None]
    geodetic = np.stack([10.0 + 0.01 * np.arange(n), np.full(n, 50.0), np.full(n, 100.0)], axis=1)
    return PointTable(np.array([f"c{k}" for k in range(n)]), geodetic, covariance, np.array(["west"] * n))


def same_rays(a: Block, b: Block) -> bool:
    arrays = ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")
    return all(np.array_equal(getattr(a, n), getattr(b, n)) and getattr(a, n).dtype.kind == getattr(b, n).dtype.kind for n in arrays)


def rewrite(folder: Path, stem: str, change: Any) -> None:
    """Replace a table by what ``change`` makes of it."""
    path = folder / f"{stem}.parquet"
    pq.write_table(change(pq.read_table(path)), path)


def put(table: pa.Table, name: str, values: list[Any] | pa.Array) -> pa.Table:
    array = values if isinstance(values, pa.Array) else pa.array(values)
    if name not in table.schema.names:
        return table.append_column(name, array)
    return table.set_column(table.schema.get_field_index(name), name, array)


def put_one(table: pa.Table, name: str, row: int, value: Any) -> pa.Table:
    """A value in a row, counted from 1."""
    values = table[name].to_pylist()
    return put(table, name, [*values[: row - 1], value, *values[row:]])


def as_csv(folder: Path, compressed: bool) -> None:
    for path in list(folder.glob("*.parquet")):
        table = pq.read_table(path)
        if "geometry" in table.schema.names:
            table = put(table, "geometry", [None if g is None else g.hex() for g in table["geometry"].to_pylist()])
        name = path.with_suffix(".csv.gz" if compressed else ".csv")
        path.unlink()
        with gzip.open(name, "wb") if compressed else name.open("wb") as file:
            pcsv.write_csv(table, file)
