"""Tables of points with their joint covariance: Parquet, NumPy archive, GeoJSON, CSV and GCP (layout: docs/interface.md, "Query output").

One row a point with the columns `POINT_COLUMNS`: geocentric metres, degrees and ellipsoidal height, the covariance of the point in its
local axes (m2), CE90 and LE90 (m), owner tile and number of rays. The joint covariance is geocentric, m2, point-major.

============  ======================================================  =====================================
file          joint covariance                                        metadata
============  ======================================================  =====================================
``.parquet``  column ``covariance_row``: for point i the rows of the  in the schema; lists as JSON
              lower triangle, 3 x 3(i+1) values, row-major
``.npz``      array ``covariance`` (3n, 3n)                           arrays without dimension, lists (k,)
``.geojson``  no                                                      member ``metadata``
``.csv``      no                                                      no
``.gcp``      no                                                      no
============  ======================================================  =====================================

A file is written under a temporary name in its folder and then renamed: a write that fails leaves what was there before.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from submin.errors import InputError, QueryError
from submin.formats.replacing import replacing

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]
Metadata = Mapping[str, str | float | tuple[str, ...]]

GEOCENTRIC = ("x", "y", "z")

POINT_COLUMNS = (
    "point_id", *GEOCENTRIC, "longitude", "latitude", "height",
    "cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu", "ce90", "le90", "tile", "rays",
)  # fmt: skip

TEXTS = ("policy", "version", "frame", "epoch", "scope")
NUMBERS = ("semimajor_axis", "flattening")
LISTS = ("tiles", "blocks", "validity")

_GROUP_VALUES = 2**23
"""Values of the triangle in one row group of a Parquet file: 64 MiB, so that a large covariance is never held twice."""


@dataclass(frozen=True)
class ControlTable:
    """Points, their joint covariance, and where they come from, as plain values.

    Attributes
    ----------
    columns : the arrays (n,) named in `POINT_COLUMNS`, and after them others that describe the points
    covariance : (3n, 3n), m2, joint, geocentric axes, point-major, symmetric
    metadata : the texts, numbers and lists of texts named in `TEXTS`, `NUMBERS` and `LISTS`
    """

    columns: Mapping[str, NDArray[Any]]
    covariance: Array
    metadata: Metadata

    def __post_init__(self) -> None:
        if tuple(self.columns)[: len(POINT_COLUMNS)] != POINT_COLUMNS:
            raise InputError(f"table: columns are {', '.join(self.columns)}; expected {', '.join(POINT_COLUMNS)}")
        n = len(self.columns["point_id"])
        if self.covariance.shape != (3 * n, 3 * n):
            raise InputError(f"table: covariance has shape {self.covariance.shape}; expected {(3 * n, 3 * n)} for {n} points")


def write_table(path: str | Path, table: ControlTable) -> None:
    """Write a table in the format that the suffix of the path names: ``.parquet``, ``.npz``, ``.geojson``, ``.csv`` or ``.gcp``.

    Raises
    ------
    QueryError
        When the suffix is another.
    InputError
        When the folder does not exist.
    """
    writer = _WRITERS.get(Path(path).suffix.lower())
    if writer is None:
        raise QueryError(f"{path}: unknown suffix {Path(path).suffix!r}; expected one of {', '.join(_WRITERS)}")
    writer(path, table)


def write_parquet(path: str | Path, table: ControlTable) -> None:
    """Write points, joint covariance and metadata; `read_parquet` gives the same numbers to the last bit.

    The lower triangle is written, which is all of a symmetric matrix.
    """
    points = _point_columns(table)
    metadata = {k: v if isinstance(v, str) else json.dumps(v, ensure_ascii=False) for k, v in table.metadata.items()}
    schema = points.schema.append(pa.field("covariance_row", pa.list_(pa.float64()))).with_metadata(metadata)
    # A dictionary pays for tile names only; tried on a covariance it costs time and gains nothing.
    with replacing(path) as temporary, pq.ParquetWriter(temporary, schema, use_dictionary=["tile"]) as writer:
        for first, last in row_groups(points.num_rows):
            rows = covariance_rows(table.covariance, first, last)
            group = points.slice(first, last - first).append_column("covariance_row", rows)
            writer.write_table(group.cast(schema))


def write_npz(path: str | Path, table: ControlTable) -> None:
    """Write ``ids`` (n,), ``geocentric`` (n, 3), ``covariance`` (3n, 3n), the other point columns and the metadata as arrays.

    Nothing in it is pickled. `read_npz` reads it, and so does ``numpy.load``.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        arrays: dict[str, Any] = _arrays(table.columns, table.covariance, table.metadata)
        np.savez(file, **arrays)


def write_geojson(path: str | Path, table: ControlTable) -> None:
    """Write a FeatureCollection of 3-D points (longitude, latitude, height) with the point columns as properties.

    The joint covariance is not in it: each point carries its own 3 x 3 covariance only.
    """
    write_features(path, _point_columns(table), table.metadata)


def write_features(path: str | Path, points: pa.Table, metadata: Metadata) -> None:
    """Write the rows of a table as features at its longitude, latitude and height, with its columns as properties."""
    places = np.column_stack([points[c].to_numpy() for c in ("longitude", "latitude", "height")])
    n = points.num_rows
    coordinates = pa.FixedSizeListArray.from_arrays(pa.array(places.ravel(), pa.float64()), 3)
    features = pa.table(
        {
            "type": pa.repeat("Feature", n),
            "geometry": pa.StructArray.from_arrays([pa.repeat("Point", n), coordinates], ["type", "coordinates"]),
            "properties": points.to_struct_array().combine_chunks() if n else pa.array([], pa.struct(list(points.schema))),
        }
    )
    collection = {"type": "FeatureCollection", "metadata": dict(metadata), "features": features.to_pylist()}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(collection, ensure_ascii=False, allow_nan=False), encoding="utf-8")


def write_csv(path: str | Path, table: ControlTable) -> None:
    """Write the point columns, decimals long enough to give back the same numbers.

    Neither the joint covariance nor the metadata is in it: for relative accuracy, or to control new images, write Parquet or ``.npz``.
    """
    with replacing(path) as temporary:
        pa_csv.write_csv(_point_columns(table), str(temporary))


def write_gcp(path: str | Path, table: ControlTable) -> None:
    """Write ground control points as text, as the bundle adjustment of the Ames Stereo Pipeline takes them.

    A line a point: number, latitude, longitude (degrees), ellipsoidal height, and the standard deviations of geocentric x, y, z (m), with
    blanks between them. Whoever measures a point in an image appends name, column, row and their sigmas. The numbers are the point ids
    where all of these are whole numbers, else 1, 2, ... in the order of the table.

    The format takes x, y and z as independent. So that they claim no more accuracy than the covariance P of the point, they are those of
    ``lambda diag(P)``, lambda the greatest eigenvalue of its correlations (1 to 3): no combination of them is below that of P. What is
    correlated between points is not in the file.
    """
    ids = [str(v) for v in table.columns["point_id"]]
    whole = all(v.isdecimal() and v.isascii() and v == str(int(v)) for v in ids)
    n = len(ids)
    own = table.covariance.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
    sigma = np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    greatest = np.linalg.eigvalsh(own / (sigma[:, :, None] * sigma[:, None, :]))[:, -1]
    sigma = sigma * np.sqrt(greatest)[:, None] * (1.0 + 5e-6)  # six digits are printed, none of them below
    places = np.column_stack([table.columns[c] for c in ("latitude", "longitude", "height")])
    rows = zip(ids if whole else range(1, n + 1), places.tolist(), sigma.tolist(), strict=True)
    lines = [f"{number} {a:.11f} {b:.11f} {h:.5f} {x:.6g} {y:.6g} {z:.6g}" for number, (a, b, h), (x, y, z) in rows]
    with replacing(path) as temporary:
        temporary.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")


_WRITERS = {".parquet": write_parquet, ".npz": write_npz, ".geojson": write_geojson, ".csv": write_csv, ".gcp": write_gcp}


def read_parquet(path: str | Path) -> Arrays:
    """Arrays of a file of `write_parquet`, under the names that `write_npz` gives them.

    Returns
    -------
    dict
        ``ids`` (n,), ``geocentric`` (n, 3) m, ``covariance`` (3n, 3n) m2 symmetric, the other point columns (n,), and the metadata
        as arrays without dimension, lists as arrays (k,).

    Raises
    ------
    InputError
        When the file is not Parquet, a column is missing or of another type, a value is null, or a covariance row has another length
        than its place asks for (rows taken out or sorted differently) or holds a value that is not finite.
    """
    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            missing = [c for c in (*POINT_COLUMNS, "covariance_row") if c not in names]
            if missing:
                raise InputError(f"{path}: column {missing[0]!r} is missing; expected the columns of a query written as .parquet")
            points = file.read(columns=list(POINT_COLUMNS))
            groups = (file.read_row_group(g, columns=["covariance_row"]) for g in range(file.num_row_groups))
            chunks = (chunk for group in groups for chunk in group.column("covariance_row").chunks)
            covariance = covariance_of_rows(chunks, points.num_rows, str(path))
            texts = {k.decode(): v.decode() for k, v in (file.schema_arrow.metadata or {}).items()}
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: cannot be read as Parquet ({error}); expected a query written as .parquet") from None
    columns = {name: _column(points, name, path) for name in POINT_COLUMNS}
    return _arrays(columns, covariance, _metadata(texts, path))


def read_npz(path: str | Path) -> Arrays:
    """Arrays of a file of `write_npz`; nothing in it is unpickled.

    Raises
    ------
    InputError
        When the file is not a NumPy archive of a query.
    """
    try:
        # NumPy leaves a file open that it opened itself and found damaged.
        with Path(path).open("rb") as stored, np.load(stored, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, BadZipFile, AttributeError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as a NumPy archive ({error}); expected a query written as .npz") from None
    missing = [name for name in ("ids", "geocentric", "covariance") if name not in arrays]
    if missing:
        raise InputError(f"{path}: array {missing[0]!r} is missing; expected the arrays of a query written as .npz")
    return arrays


def covariance_rows(covariance: Array, first: int, last: int) -> pa.ListArray:
    """Column ``covariance_row`` of points first to last - 1: for point i the values ``covariance[3i:3i+3, :3i+3]``, row-major."""
    values = covariance[3 * first : 3 * last, : 3 * last][_lower(first, last)]
    offsets = np.concatenate([[0], np.cumsum(_lengths(first, last))]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(np.asarray(values, dtype=np.float64)))


def covariance_of_rows(chunks: Iterable[pa.Array], points: int, source: str, first_row: int = 0) -> Array:
    """Joint covariance (3n, 3n), symmetric, of the chunks of a column ``covariance_row`` of n points in their order.

    Parameters
    ----------
    chunks : iterable of list arrays
        One after the other they hold the rows of all points.
    points : int
        n.
    source : str
        File named in errors.
    first_row : int
        Its row of the first point, in errors.

    Raises
    ------
    InputError
        When the column is not a list of numbers, or a row has another length or holds a value that is not finite.
    """
    covariance = np.empty((3 * points, 3 * points))
    first = 0
    for chunk in chunks:
        last = first + len(chunk)
        lower, values = _lower(first, last), _row_values(chunk, first, source, first_row)
        rows = covariance[3 * first : 3 * last, : 3 * last]
        rows[lower] = values
        covariance[: 3 * first, 3 * first : 3 * last] = rows[:, : 3 * first].T
        square = rows[:, 3 * first :]
        square[~lower[:, 3 * first :]] = square.T[~lower[:, 3 * first :]]
        first = last
    return covariance


def _row_values(chunk: pa.Array, first: int, source: str, first_row: int) -> Array:
    """Values of consecutive covariance rows, checked, of which the first is that of point ``first``."""
    if not (pa.types.is_list(chunk.type) or pa.types.is_large_list(chunk.type)):
        raise InputError(f"{source}: column 'covariance_row' is of type {chunk.type}; expected lists of float64")
    expected = _lengths(first, first + len(chunk))
    lengths = chunk.value_lengths().fill_null(0).to_numpy(zero_copy_only=False)
    if (lengths != expected).any():
        i = int(np.argmax(lengths != expected))
        raise InputError(
            f"{source}: row {first_row + first + i}: covariance_row has {lengths[i]} values; expected {expected[i]} "
            "(3 x 3(i+1) for row i from 0). "
            "Rows that were taken out or sorted differently have lost their meaning: query again for other points"
        )
    try:
        values = np.asarray(chunk.flatten().cast(pa.float64()).to_numpy(zero_copy_only=False))
    except pa.ArrowException:
        raise InputError(f"{source}: column 'covariance_row' is of type {chunk.type}; expected lists of float64") from None
    bad = ~np.isfinite(values)
    if bad.any():
        i = int(np.searchsorted(np.cumsum(expected), np.argmax(bad), side="right"))
        raise InputError(f"{source}: row {first_row + first + i}: covariance_row holds a value that is null or not finite; expected m2")
    return values


def _lengths(first: int, last: int) -> NDArray[np.int64]:
    """Number of values in the covariance rows of points first to last - 1."""
    return 9 * np.arange(first + 1, last + 1, dtype=np.int64)


def _lower(first: int, last: int) -> NDArray[np.bool_]:
    """Mask of the rows of points first to last - 1, of columns up to 3 last: true up to the end of each point's own block."""
    end = np.repeat(3 * np.arange(first + 1, last + 1), 3)
    return np.asarray(np.arange(3 * last)[None, :] < end[:, None])


def row_groups(points: int) -> Iterator[tuple[int, int]]:
    """First and last (excluded) point of each row group; a group ends where it reaches `_GROUP_VALUES`."""
    group = np.cumsum(_lengths(0, points)) // _GROUP_VALUES
    edges = [0, *(np.flatnonzero(np.diff(group)) + 1).tolist(), points]
    return ((a, b) for a, b in pairwise(edges) if b > a)


def _point_columns(table: ControlTable) -> pa.Table:
    """The point columns as an Arrow table with the types of the layout."""
    types = dict.fromkeys(POINT_COLUMNS, pa.float64()) | {"point_id": pa.string(), "tile": pa.string(), "rays": pa.int64()}
    return arrow_table(table.columns, types)


def arrow_table(columns: Mapping[str, NDArray[Any]], types: Mapping[str, pa.DataType]) -> pa.Table:
    """Columns as an Arrow table. Those of a type keep what is not a number; in the others it is no value."""
    return pa.table({k: pa.array(v, types.get(k), from_pandas=k not in types) for k, v in columns.items()})


def _arrays(columns: Mapping[str, NDArray[Any]], covariance: Array, metadata: Metadata) -> Arrays:
    """The arrays of a NumPy archive."""
    rest = {k: v for k, v in columns.items() if k not in ("point_id", *GEOCENTRIC)}
    return {
        "ids": columns["point_id"],
        "geocentric": np.column_stack([columns[c] for c in GEOCENTRIC]),
        "covariance": covariance,
        **rest,
        # An empty list would become an array of numbers.
        **{k: np.array(v, dtype=str) if isinstance(v, tuple) else np.array(v) for k, v in metadata.items()},
    }


def _column(points: pa.Table, name: str, path: str | Path) -> NDArray[Any]:
    column = points.column(name)
    if column.null_count:
        row = int(np.argmax(column.is_null().to_numpy()))
        raise InputError(f"{path}: row {row}: column {name!r} is null; expected a value")
    text = name in ("point_id", "tile")
    wanted = pa.string() if text else pa.int64() if name == "rays" else pa.float64()
    if text != (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        raise InputError(f"{path}: column {name!r} is of type {column.type}; expected {wanted}")
    try:
        values = column.cast(wanted).to_numpy()
    except pa.ArrowException:
        raise InputError(f"{path}: column {name!r} is of type {column.type}; expected {wanted}") from None
    return values.astype(str) if text else np.asarray(values)


def _metadata(texts: Mapping[str, str], path: str | Path) -> Metadata:
    """Metadata of a schema, as far as it is there."""
    found: dict[str, str | float | tuple[str, ...]] = {k: texts[k] for k in TEXTS if k in texts}
    for key in (*NUMBERS, *LISTS):
        if key not in texts:
            continue
        try:
            value = json.loads(texts[key])
            found[key] = float(value) if key in NUMBERS else tuple(str(v) for v in value)
        except (ValueError, TypeError):
            raise InputError(f"{path}: metadata {key!r} is {texts[key]!r}; expected JSON as written by submin") from None
    return found
