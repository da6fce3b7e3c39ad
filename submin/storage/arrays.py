"""Records and growing tables as Zarr arrays (docs/decisions/002-store-layout.md)."""

from __future__ import annotations

import asyncio
import json
import math
from bisect import bisect_right
from collections.abc import Awaitable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.array_spec import ArrayConfigLike
from zarr.core.sync import sync

from submin.errors import StoreError
from submin.network.id_hash import hash_ids as hash_ids  # by which the directory finds points

AnyArray = NDArray[Any]
T = TypeVar("T")
Places = slice | NDArray[np.int64]
EVERY = slice(None)

RECORD_CHUNK = 1 << 20
"""Bytes of a chunk of a record."""
ALIGNED = 8
"""Parts of a record begin at multiples of so many bytes."""
TABLE_CHUNK = 1 << 16
"""Rows of a chunk of a table, where it says nothing else."""
LETTERS_CHUNK = 1 << 20
"""Bytes of a chunk of a column of texts, likewise."""
PLAIN = (Crc32cCodec(),)
"""Chunks as they are, each with a checksum: numbers do not compress, and what was damaged must not be read as another number."""
WRITTEN_WHOLE: ArrayConfigLike = {"write_empty_chunks": True}
"""Chunks are not searched for a value other than zero before they are written: there always is one."""
PACKED = (ZstdCodec(level=0), Crc32cCodec())
"""Compressed chunks, each with a checksum: of tables."""


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


@contextmanager
def sound_chunks(where: str) -> Iterator[None]:
    """Say in one line that a chunk of an array is not what was written.

    Raises
    ------
    StoreError
        In place of what decoding raised: a checksum or a length that does not fit.
    """
    try:
        yield
    except (ValueError, RuntimeError) as error:
        raise StoreError(
            f"the store has a damaged chunk in {where!r} ({error}); 'submin verify' tells which tiles it concerns: "
            "go on from a copy of the network, or make it again from its catalogue"
        ) from error


def read_matrix(group: zarr.Group, name: str, rows: Places = EVERY, columns: Places = EVERY) -> AnyArray:
    """A matrix of a group: all of it, spans of its rows and columns, or those at some places (ascending)."""
    array = array_of(group, name)
    with sound_chunks(array.path):
        if isinstance(rows, slice) or len(rows) == array.shape[0]:  # places one by one take much longer
            return np.asarray(array[rows if isinstance(rows, slice) else EVERY, columns if isinstance(columns, slice) else EVERY])
        return np.asarray(array.oindex[rows, columns])


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
    """Write a record of named arrays, replacing any record of that name. Booleans and integers come back as int64, floats as float64.

    All parts are one array of bytes: opening an array costs more than reading most of them. What is read together should be given together.
    """
    pieces: list[AnyArray] = []
    layout: list[list[Any]] = []
    size = 0

    def put(part: str, values: AnyArray) -> None:
        nonlocal size
        values = np.ascontiguousarray(values, dtype=np.float64 if values.dtype.kind == "f" else values.dtype.newbyteorder("<"))
        layout.append([part, values.dtype.str, size, list(values.shape)])
        pieces.append(values.reshape(-1).view(np.uint8))
        pieces.append(np.zeros(-values.nbytes % ALIGNED, dtype=np.uint8))
        size += values.nbytes + pieces[-1].size

    for part, values in parts.items():
        if values.dtype.kind == "U":
            data, ends = encode_text(values)
            put(part, data)
            put(part + ".ends", ends)
        else:
            put(part, values)
    # attributes at creation: each later change of one costs as much as an array
    group = parent.create_group(name, overwrite=True, attributes={"layout": layout, **(attributes or {})})
    if size:
        group.create_array("data", data=np.concatenate(pieces), chunks=(min(RECORD_CHUNK, size),), compressors=PLAIN, config=WRITTEN_WHOLE)
    return group


@dataclass(frozen=True, eq=False)
class Record:
    """A record as it was read: its attributes, and named arrays of it."""

    attributes: Mapping[str, Any]
    parts: Mapping[str, AnyArray]


def read_record(group: zarr.Group, wanted: Iterable[str] | None = None) -> dict[str, AnyArray]:
    """Named arrays of a record: all, or only those wanted."""
    return sync(_parts(group._async_group, None if wanted is None else frozenset(wanted)))


def read_records(parent: zarr.Group, names: Iterable[str], wanted: Iterable[str] | None = None) -> list[Record | None]:
    """Records of these names, read side by side: all arrays of each, or only those wanted; None where there is none of the name."""
    chosen = None if wanted is None else frozenset(wanted)

    async def one(name: str) -> Record | None:
        try:
            group = await parent._async_group.getitem(name)
        except KeyError:
            return None
        if not isinstance(group, zarr.AsyncGroup):
            raise StoreError(f"the store has an array {name!r} in {parent.path!r} where a group is expected; it is damaged")
        return Record(dict(group.attrs), await _parts(group, chosen))

    async def every() -> list[Record | None]:
        return await _side_by_side(one(name) for name in names)

    return sync(every())


def read_attributes(parent: zarr.Group, names: Iterable[str]) -> list[dict[str, Any] | None]:
    """Attributes of groups of these names, side by side; None where there is none. Their documents alone are read, no array is opened."""

    async def one(name: str) -> dict[str, Any] | None:
        document = await (parent._async_group.store_path / name / "zarr.json").get()
        return None if document is None else dict(json.loads(document.to_bytes())["attributes"])

    async def every() -> list[dict[str, Any] | None]:
        return await _side_by_side(one(name) for name in names)

    return sync(every())


def existing_groups(parent: zarr.Group, names: Iterable[str]) -> list[bool]:
    """Whether a group has members of these names."""

    async def one(name: str) -> bool:
        return bool(await parent._async_group.contains(name))

    async def every() -> list[bool]:
        return await _side_by_side(one(name) for name in names)

    return sync(every())


def member_names(group: zarr.Group) -> list[str]:
    """Names of the members of a group, ascending; none of them is opened."""

    async def every() -> list[str]:
        return [name async for name in group.store.list_dir(group.path)]

    return sorted(name for name in sync(every()) if name != "zarr.json")


async def _side_by_side(reads: Iterable[Awaitable[T]]) -> list[T]:
    """What some reads, or writes, give. An error is raised once all are done: the event loop would print those that nobody waits for."""
    done = await asyncio.gather(*reads, return_exceptions=True)
    found: list[T] = []
    for value in done:
        if isinstance(value, BaseException):
            raise value
        found.append(value)
    return found


async def _array(group: zarr.AsyncGroup, name: str) -> zarr.AsyncArray[Any]:
    try:
        found = await group.getitem(name)
    except KeyError:
        found = None
    if not isinstance(found, zarr.AsyncArray):
        raise StoreError(f"the store has no array {name!r} in {group.path!r}; it is damaged")
    return found


async def _span(group: zarr.AsyncGroup, name: str, start: int, stop: int | None) -> AnyArray:
    """Entries of an array of one dimension, from ``start`` to before ``stop``."""
    array = await _array(group, name)
    stop = array.shape[0] if stop is None else min(stop, array.shape[0])
    if stop <= start:
        return np.empty(0, dtype=array.dtype)
    with sound_chunks(array.path):
        return np.asarray(await array.getitem(slice(start, stop)))


async def _spans(group: zarr.AsyncGroup, name: str, spans: Sequence[tuple[int, int | None]]) -> list[AnyArray]:
    """Several spans of an array of one dimension. Neighbours that meet in a chunk are one read: a chunk is decoded whole for each."""
    array = await _array(group, name)
    length, chunk = array.shape[0], array.chunks[0]
    clipped = [(min(start, length), length if stop is None else min(stop, length)) for start, stop in spans]
    reads: list[tuple[int, int]] = []
    for start, stop in sorted(span for span in clipped if span[1] > span[0]):
        if reads and start // chunk <= (reads[-1][1] - 1) // chunk:
            reads[-1] = reads[-1][0], max(reads[-1][1], stop)
        else:
            reads.append((start, stop))
    with sound_chunks(array.path):
        found = await _side_by_side(array.getitem(slice(start, stop)) for start, stop in reads)
    firsts = [start for start, _ in reads]
    values = []
    for start, stop in clipped:
        if stop <= start:
            values.append(np.empty(0, dtype=array.dtype))
            continue
        read = bisect_right(firsts, start) - 1
        values.append(np.asarray(found[read])[start - firsts[read] : stop - firsts[read]])
    return values


async def _parts(group: zarr.AsyncGroup, names: frozenset[str] | None) -> dict[str, AnyArray]:
    chosen = [
        (str(part), np.dtype(kind), int(start), tuple(shape))
        for part, kind, start, shape in group.attrs["layout"]
        if names is None or str(part).removesuffix(".ends") in names
    ]
    low = min((start for _, _, start, _ in chosen), default=0)
    high = max((start + kind.itemsize * math.prod(shape) for _, kind, start, shape in chosen), default=0)
    # an array without entries is not stored
    data = await _span(group, "data", low, high) if high > low else np.empty(0, dtype=np.uint8)
    parts: dict[str, AnyArray] = {}
    for part, kind, start, shape in chosen:
        at = start - low
        values = data[at : at + kind.itemsize * math.prod(shape)].view(kind).reshape(shape)
        parts[part] = values.astype(np.int64) if kind.kind in "bi" else values
    for part in [p for p in parts if p.endswith(".ends")]:
        ends = parts.pop(part)
        parts[part.removesuffix(".ends")] = decode_text(parts[part.removesuffix(".ends")], ends.astype(np.int64))
    return parts


def create_table(
    parent: zarr.Group, name: str, columns: Mapping[str, str], *, rows: int = TABLE_CHUNK, letters: int = LETTERS_CHUNK
) -> zarr.Group:
    """An empty table; ``columns`` gives each column's type: a numpy name, or ``text``.

    A chunk has so many ``rows``, or ``letters`` (bytes) of texts: whoever wants one row of it decodes all of them.
    """
    group = parent.create_group(name)
    for column, kind in columns.items():
        if kind == "text":
            group.create_array(column, shape=(0,), chunks=(letters,), dtype="uint8", compressors=PACKED)
            group.create_array(column + ".ends", shape=(0,), chunks=(rows,), dtype="int64", compressors=PACKED)
        else:
            group.create_array(column, shape=(0,), chunks=(rows,), dtype=kind, compressors=PACKED)
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

    async def one(column: str, values: AnyArray) -> None:
        if kinds[column] != "text":
            await _append(await _array(group._async_group, column), values.astype(kinds[column]))
            return
        data, ends = encode_text(values)
        letters = await _array(group._async_group, column)
        ends = ends + letters.shape[0]
        if data.size:
            await _append(letters, data)
        await _append(await _array(group._async_group, column + ".ends"), ends)

    async def every() -> None:
        await _side_by_side(one(column, values) for column, values in columns.items() if len(values))

    sync(every())


async def _append(array: zarr.AsyncArray[Any], values: AnyArray) -> None:
    with sound_chunks(array.path):  # the last chunk is read, and written with more in it
        await array.with_config(WRITTEN_WHOLE).append(values)


def read_table(group: zarr.Group, wanted: Iterable[str] | None = None, start: int = 0, stop: int | None = None) -> dict[str, AnyArray]:
    """Columns of the rows from ``start`` to before ``stop``."""
    return read_spans(group, wanted, [(start, stop)])[0]


def read_spans(group: zarr.Group, wanted: Iterable[str] | None, spans: Sequence[tuple[int, int | None]]) -> list[dict[str, AnyArray]]:
    """Columns of several spans of rows, each from its first to before its last, read side by side."""
    kinds = attributes_of(group)["columns"]
    columns = list(kinds if wanted is None else wanted)

    async def one(column: str) -> list[AnyArray]:
        if kinds[column] != "text":
            return await _spans(group._async_group, column, spans)
        # the end of the row before is where the first of a span begins
        ends = await _spans(group._async_group, column + ".ends", [(max(start - 1, 0), stop) for start, stop in spans])
        bases = [int(of[0]) if start > 0 and len(of) else 0 for (start, _), of in zip(spans, ends, strict=True)]
        ends = [of[1:] if start > 0 else of for (start, _), of in zip(spans, ends, strict=True)]
        bounds = [(base, int(of[-1]) if len(of) else base) for base, of in zip(bases, ends, strict=True)]
        data = await _spans(group._async_group, column, bounds)
        return [decode_text(text, of - base) for text, of, base in zip(data, ends, bases, strict=True)]

    async def every() -> list[list[AnyArray]]:
        return await _side_by_side(map(one, columns))

    read = sync(every())
    return [dict(zip(columns, of_span, strict=True)) for of_span in zip(*read, strict=True)] if columns else [{} for _ in spans]


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
        array = array_of(group, column)
        with sound_chunks(array.path):
            array.oindex[rows] = values
