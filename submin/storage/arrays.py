"""Records and growing tables as Zarr arrays (docs/decisions/002-store-layout.md)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import zarr
from numpy.typing import NDArray

from submin.errors import StoreError
from submin.network.id_hash import hash_ids as hash_ids  # by which the directory finds points

AnyArray = NDArray[Any]

REALS_CHUNK = 1 << 17
TABLE_CHUNK = 1 << 16


def group_of(parent: zarr.Group, name: str) -> zarr.Group:
    """A group inside another; raises `StoreError` when the store is damaged."""
    found = parent.get(name)
    if not isinstance(found, zarr.Group):
        raise StoreError(f"the store has no group {name!r}; it is damaged, or not a network")
    return found


def array_of(group: zarr.Group, name: str) -> zarr.Array[Any]:
    """An array of a group; raises `StoreError` when the store is damaged."""
    found = group.get(name)
    if not isinstance(found, zarr.Array):
        raise StoreError(f"the store has no array {name!r} in {group.path!r}; it is damaged")
    return found


def attributes_of(group: zarr.Group) -> dict[str, Any]:
    """All attributes of a group."""
    return dict(group.attrs.asdict())


def encode_text(values: AnyArray) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """UTF-8 bytes of all texts, one after another, and the end of each."""
    text = pa.array(values, type=pa.large_string())
    _, offsets, data = text.buffers()
    ends = np.frombuffer(offsets, dtype=np.int64)[1 : len(values) + 1] if len(values) else np.empty(0, dtype=np.int64)
    return np.frombuffer(data, dtype=np.uint8)[: ends[-1]] if len(ends) else np.empty(0, dtype=np.uint8), ends


def decode_text(data: NDArray[np.uint8], ends: NDArray[np.int64]) -> NDArray[np.str_]:
    """Inverse of `encode_text`."""
    if not len(ends):
        return np.empty(0, dtype="U1")
    offsets = np.concatenate([np.zeros(1, dtype=np.int64), ends])
    buffers = [None, pa.py_buffer(offsets), pa.py_buffer(np.ascontiguousarray(data, dtype=np.uint8))]
    return np.asarray(pa.Array.from_buffers(pa.large_string(), len(ends), buffers).to_numpy(zero_copy_only=False), dtype=np.str_)


def write_record(parent: zarr.Group, name: str, parts: Mapping[str, AnyArray], attributes: Mapping[str, Any] | None = None) -> zarr.Group:
    """Write a record of named arrays, replacing any record of that name. Booleans and integers become int64, floats float64."""
    kinds: dict[str, list[AnyArray]] = {"reals": [], "integers": [], "bytes": []}
    layout: list[list[Any]] = []

    def put(part: str, kind: str, values: AnyArray) -> None:
        start = sum(a.size for a in kinds[kind])
        kinds[kind].append(values.ravel())
        layout.append([part, kind, start, list(values.shape)])

    for part, values in parts.items():
        if values.dtype.kind == "U":
            data, ends = encode_text(values)
            put(part, "bytes", data)
            put(part + ".ends", "integers", ends)
        elif values.dtype.kind == "f":
            put(part, "reals", values.astype(np.float64, copy=False))
        else:
            put(part, "integers", values.astype(np.int64, copy=False))
    # attributes at creation: each later change of one costs as much as an array
    group = parent.create_group(name, overwrite=True, attributes={"layout": layout, **(attributes or {})})
    for kind, arrays in kinds.items():
        if arrays:
            data = np.concatenate(arrays)
            if data.size:
                options: dict[str, Any] = {"compressors": None} if kind == "reals" else {}
                group.create_array(kind, data=data, chunks=(min(REALS_CHUNK, data.size),), **options)
    return group


def read_record(group: zarr.Group, wanted: Iterable[str] | None = None) -> dict[str, AnyArray]:
    """Named arrays of a record: all, or only those wanted."""
    names = None if wanted is None else set(wanted)
    chosen = [entry for entry in attributes_of(group)["layout"] if names is None or str(entry[0]).removesuffix(".ends") in names]
    spans: dict[str, tuple[int, int]] = {}
    for _, kind, start, shape in chosen:
        stop = start + int(np.prod(shape))
        low, high = spans.get(kind, (start, stop))
        spans[kind] = (min(low, start), max(high, stop))
    data = {kind: np.asarray(array_of(group, kind)[low:high]) if high > low else np.empty(0) for kind, (low, high) in spans.items()}
    parts: dict[str, AnyArray] = {}
    for part, kind, start, shape in chosen:
        at = start - spans[kind][0]
        parts[part] = data[kind][at : at + int(np.prod(shape))].reshape(shape)
    for part in [p for p in parts if p.endswith(".ends")]:
        ends = parts.pop(part)
        parts[part.removesuffix(".ends")] = decode_text(parts[part.removesuffix(".ends")], ends.astype(np.int64))
    return parts


def create_table(parent: zarr.Group, name: str, columns: Mapping[str, str]) -> zarr.Group:
    """An empty table; ``columns`` gives each column's type: a numpy name, or ``text``."""
    group = parent.create_group(name)
    for column, kind in columns.items():
        if kind == "text":
            group.create_array(column, shape=(0,), chunks=(1 << 20,), dtype="uint8")
            group.create_array(column + ".ends", shape=(0,), chunks=(TABLE_CHUNK,), dtype="int64")
        else:
            group.create_array(column, shape=(0,), chunks=(TABLE_CHUNK,), dtype=kind)
    group.attrs["columns"] = dict(columns)
    return group


def table_length(group: zarr.Group) -> int:
    """Number of rows."""
    column, kind = next(iter(attributes_of(group)["columns"].items()))
    return array_of(group, column + ".ends" if kind == "text" else column).shape[0]


def append_table(group: zarr.Group, columns: Mapping[str, AnyArray]) -> None:
    """Append rows; every column of the table must be given."""
    kinds = attributes_of(group)["columns"]
    if set(kinds) != set(columns):
        raise ValueError(f"columns are {sorted(columns)}; expected {sorted(kinds)}")
    for column, values in columns.items():
        if not len(values):
            continue
        if kinds[column] == "text":
            data, ends = encode_text(values)
            base = array_of(group, column).shape[0]
            if data.size:
                array_of(group, column).append(data)
            array_of(group, column + ".ends").append(ends + base)
        else:
            array_of(group, column).append(values.astype(kinds[column]))


def read_table(group: zarr.Group, wanted: Iterable[str] | None = None, start: int = 0, stop: int | None = None) -> dict[str, AnyArray]:
    """Columns of the rows from ``start`` to before ``stop``."""
    kinds = attributes_of(group)["columns"]
    columns: dict[str, AnyArray] = {}
    for column in kinds if wanted is None else wanted:
        if kinds[column] != "text":
            columns[column] = np.asarray(array_of(group, column)[start:stop])
            continue
        ends = np.asarray(array_of(group, column + ".ends")[max(start - 1, 0) : stop])
        base = int(ends[0]) if start > 0 and len(ends) else 0
        ends = ends[1:] if start > 0 else ends
        data = np.asarray(array_of(group, column)[base : int(ends[-1])]) if len(ends) else np.empty(0, dtype=np.uint8)
        columns[column] = decode_text(data, ends - base)
    return columns


def replace_table(group: zarr.Group, columns: Mapping[str, AnyArray]) -> None:
    """Replace all rows of a (small) table without text columns."""
    for column, values in columns.items():
        array = array_of(group, column)
        array.resize((len(values),))
        if len(values):
            array[:] = values


def set_rows(group: zarr.Group, column: str, rows: NDArray[np.int64], values: AnyArray) -> None:
    """Change some rows of a column that is not text."""
    if len(rows):
        array_of(group, column).oindex[rows] = values
