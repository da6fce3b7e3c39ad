"""Typed tables from outside: Parquet, CSV or gzipped CSV with the same columns, in bounded memory, every error with its place.

Rows are counted from 1; a header is no row. What the tables mean is not known here.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import shapely
from numpy.typing import NDArray

from submin.errors import CatalogueError

Array = NDArray[np.float64]

SUFFIXES = (".parquet", ".csv", ".csv.gz")
BATCH_ROWS = 1 << 16
_CSV_READING = pcsv.ReadOptions(use_threads=False, block_size=1 << 24)
_CSV_PARSING = pcsv.ParseOptions(newlines_in_values=True)
_BROKEN_CSV_ROW = re.compile(r"Row #(\d+): (Expected .*)")
_NOT_UTF8 = re.compile(r"Row #(\d+): .*invalid UTF8")


@dataclass(frozen=True)
class Column:
    """A column that a table must or may have, and the type to read it as; ``blank`` allows empty text."""

    name: str
    type: pa.DataType
    required: bool = True
    blank: bool = False


def text(name: str, required: bool = True, blank: bool = False) -> Column:
    """A column of text."""
    return Column(name, pa.string(), required, blank)


def number(name: str, required: bool = True) -> Column:
    """A column of numbers; an empty place is null."""
    return Column(name, pa.float64(), required)


def integer(name: str, required: bool = True) -> Column:
    """A column of whole numbers; an empty place is null."""
    return Column(name, pa.int64(), required)


def table_path(folder: Path, stem: str) -> Path | None:
    """The file that holds a table, Parquet or CSV, or None; two of them are an error."""
    found = [folder / (stem + suffix) for suffix in SUFFIXES if (folder / (stem + suffix)).is_file()]
    if len(found) > 1:
        raise CatalogueError(f"{folder}: {found[0].name} and {found[1].name} hold the same table; expected one of them: remove the other")
    return found[0] if found else None


def numbers(name: str, required: bool = True) -> Column:
    """A column of lists of numbers; in CSV a text of numbers with blanks between them."""
    return Column(name, pa.list_(pa.float64()), required)


def table_batches(path: Path, columns: Collection[Column], batch_rows: int = BATCH_ROWS) -> Iterator[tuple[int, pa.RecordBatch]]:
    """Batches of rows of a Parquet or CSV file with the number of their first row, in bounded memory.

    A batch of a Parquet file has ``batch_rows`` rows at most: fewer for tables whose rows hold much.

    A batch holds those of ``columns`` that the file has, in their types. Texts that must be given are neither null nor empty.

    Raises
    ------
    CatalogueError
        When the file cannot be read, lacks a column, or holds a value of another type: file, column or row, value, what was expected.
    """
    if not path.is_file():
        raise CatalogueError(f"{path}: no such file; expected a table with columns {_listed(columns)}")
    try:
        row = 1
        for batch in _parquet_batches(path, columns, batch_rows) if path.suffix == ".parquet" else _csv_batches(path, columns):
            present = [c for c in columns if c.name in batch.schema.names]
            arrays = [_typed(batch.column(c.name), c, path, row) for c in present]
            yield row, pa.RecordBatch.from_arrays(arrays, schema=pa.schema([(c.name, c.type) for c in present]))
            row += batch.num_rows
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        broken = _BROKEN_CSV_ROW.search(reason)
        if broken:  # there the header is a row
            raise CatalogueError(f"{path}: row {int(broken[1]) - 1}: {broken[2]}; mend the row") from None
        foreign = _NOT_UTF8.search(reason)
        if foreign:
            raise CatalogueError(f"{path}: row {int(foreign[1]) - 1}: text is not UTF-8; save the file in that encoding") from None
        raise CatalogueError(f"{path}: cannot be read as a table ({reason.rstrip('.')}); write or copy it again") from None


def table_runs(
    path: Path, columns: Collection[Column], key: str, what: str, batch_rows: int = BATCH_ROWS
) -> Iterator[tuple[str, int, pa.Table]]:
    """The rows of each value of the column ``key`` with the number of their first row; memory is bounded by them and one batch.

    Raises
    ------
    CatalogueError
        As `table_batches`, and when a value comes back after another one: the table is not sorted by ``what``.
    """
    seen: set[str] = set()
    current, first_row, pieces = "", 1, list[pa.RecordBatch]()
    for row, batch in table_batches(path, columns, batch_rows):
        runs = pc.run_end_encode(batch[key])
        start = 0
        for value, stop in zip(runs.values.to_pylist(), runs.run_ends.to_pylist(), strict=True):
            if value != current:
                if pieces:
                    yield current, first_row, pa.Table.from_batches(pieces)
                if value in seen:
                    raise CatalogueError(
                        f"{path}: row {row + start}: {key} {value!r} comes back after {current!r}; expected rows sorted by {what}"
                    )
                seen.add(value)
                current, first_row, pieces = value, row + start, []
            pieces.append(batch.slice(start, stop - start))
            start = stop
    if pieces:
        yield current, first_row, pa.Table.from_batches(pieces)


def column_names(path: Path) -> tuple[str, ...]:
    """All columns that a Parquet or CSV file has; none when it cannot be read: whoever reads it says what is wrong with it."""
    try:
        if path.suffix == ".parquet":
            return tuple(pq.read_schema(path).names)
        with pcsv.open_csv(path, read_options=_CSV_READING, parse_options=_CSV_PARSING) as header:
            return tuple(header.schema.names)
    except (pa.ArrowException, OSError):
        return ()


def read_table(path: Path, columns: Collection[Column]) -> pa.Table:
    """A whole small table; see `table_batches`. Optional columns that the file lacks are absent."""
    batches = [batch for _, batch in table_batches(path, columns)]
    return pa.Table.from_batches(batches) if batches else empty_table(columns)


def empty_table(columns: Collection[Column]) -> pa.Table:
    """A table without rows that has the required columns."""
    return pa.schema([(c.name, c.type) for c in columns if c.required]).empty_table()


def required_path(folder: Path, stem: str) -> Path:
    """The file that holds a table; raises `CatalogueError` when there is none. See `table_path`."""
    path = table_path(folder, stem)
    if path is None:
        raise CatalogueError(f"{folder}: no table {stem!r}; expected one of {', '.join(stem + suffix for suffix in SUFFIXES)}")
    return path


def refuse(bad: pa.Array, values: pa.Array, name: str, path: Path, first_row: int, expected: str) -> None:
    """Raise `CatalogueError` for the first place where ``bad`` is true: its row (``first_row`` at place 0) and what ``name`` is there."""
    flags = bad.to_numpy(zero_copy_only=False).astype(bool)
    if flags.any():
        k = int(np.argmax(flags))
        raise CatalogueError(f"{path}: row {first_row + k}: {name} is {values[k].as_py()!r}; expected {expected}")


def number_values(table: pa.Table | pa.RecordBatch, name: str, default: float = np.nan) -> Array:
    """A column as float64, nulls (and an absent column) as ``default``."""
    if name not in table.schema.names:
        return np.full(table.num_rows, default)
    return np.asarray(pc.fill_null(table[name], default).to_numpy(), dtype=np.float64)


def text_values(table: pa.Table, name: str) -> NDArray[np.str_]:
    """A column of text; an absent one gives empty texts."""
    if name not in table.schema.names:
        return np.zeros(table.num_rows, dtype=np.str_)
    return np.asarray(table[name].to_numpy(), dtype=np.str_)


def _listed(columns: Collection[Column]) -> str:
    optional = [c.name for c in columns if not c.required]
    required = ", ".join(c.name for c in columns if c.required)
    return required + (f" (optional: {', '.join(optional)})" if optional else "")


def _present(path: Path, names: Collection[str], columns: Collection[Column]) -> list[str]:
    for column in columns:
        if column.required and column.name not in names:
            raise CatalogueError(f"{path}: column {column.name!r} is missing; expected {_listed(columns)}")
    return [c.name for c in columns if c.name in names]


def _parquet_batches(path: Path, columns: Collection[Column], batch_rows: int) -> Iterator[pa.RecordBatch]:
    with pq.ParquetFile(path, pre_buffer=False) as file:
        names = _present(path, file.schema_arrow.names, columns)
        yield from file.iter_batches(batch_size=batch_rows, columns=names, use_threads=False)


def _csv_batches(path: Path, columns: Collection[Column]) -> Iterator[pa.RecordBatch]:
    with pcsv.open_csv(path, read_options=_CSV_READING, parse_options=_CSV_PARSING) as header:
        names = _present(path, header.schema.names, columns)
    converting = pcsv.ConvertOptions(include_columns=names, column_types=dict.fromkeys(names, pa.string()))
    with pcsv.open_csv(path, read_options=_CSV_READING, parse_options=_CSV_PARSING, convert_options=converting) as reader:
        yield from reader


def _typed(array: pa.Array, column: Column, path: Path, first_row: int) -> pa.Array:
    """The values of a column in its type, checked."""
    if pa.types.is_dictionary(array.type):
        array = array.dictionary_decode()
    is_text = pa.types.is_string(array.type) or pa.types.is_large_string(array.type)
    if column.type == pa.string():
        if not (is_text or pa.types.is_timestamp(array.type) or pa.types.is_null(array.type)):
            raise CatalogueError(f"{path}: column {column.name!r} holds {array.type}; expected text")
        array = array.cast(pa.string())
        if column.blank:
            return pc.fill_null(array, "")
        refuse(pc.fill_null(pc.equal(array, ""), True), array, column.name, path, first_row, "a text that is not empty")
        return array
    if column.type == pa.binary():
        return _well_known_binary(array, path, first_row) if is_text else _cast(array, column, path, first_row)
    if is_text and path.suffix != ".parquet" and pa.types.is_list(column.type):
        return _lists(array, column, path, first_row)
    if is_text and path.suffix != ".parquet":
        array = pc.utf8_trim_whitespace(array)
        array = pc.if_else(pc.equal(array, ""), pa.scalar(None, pa.string()), array)
    elif is_text or pa.types.is_boolean(array.type) or pa.types.is_temporal(array.type):
        raise CatalogueError(f"{path}: column {column.name!r} holds {array.type}; expected {_meaning(column)}s")
    return _cast(array, column, path, first_row)


def _meaning(column: Column) -> str:
    return {pa.int64(): "whole number", pa.float64(): "number", pa.binary(): "WKB polygon"}.get(column.type, str(column.type))


def _cast(array: pa.Array, column: Column, path: Path, first_row: int) -> pa.Array:
    try:
        return array.cast(column.type)
    except pa.ArrowNotImplementedError:
        raise CatalogueError(f"{path}: column {column.name!r} holds {array.type}; expected {_meaning(column)}s") from None
    except pa.ArrowInvalid:
        low, high = 0, len(array)  # the first value that cannot be converted lies in [low, high)
        while high - low > 1:
            middle = (low + high) // 2
            try:
                array[low:middle].cast(column.type)
                low = middle
            except pa.ArrowInvalid:
                high = middle
        raise CatalogueError(
            f"{path}: row {first_row + low}: {column.name} is {array[low].as_py()!r}; expected a {_meaning(column)}"
        ) from None


def _lists(array: pa.Array, column: Column, path: Path, first_row: int) -> pa.Array:
    """Lists of numbers from the texts of a CSV file; an empty text is null."""
    lists: list[list[float] | None] = []
    for k, value in enumerate(array.to_pylist()):
        try:
            lists.append([float(v) for v in value.split()] if value and value.strip() else None)
        except ValueError:
            raise CatalogueError(
                f"{path}: row {first_row + k}: {column.name} is {value[:60]!r}; expected numbers with blanks between them"
            ) from None
    return pa.array(lists, column.type)


def _well_known_binary(array: pa.Array, path: Path, first_row: int) -> pa.Array:
    """WKB from the texts that a CSV file may hold, well-known text or hexadecimal WKB; empty ones become null."""
    texts = array.to_numpy(zero_copy_only=False)
    binary: list[bytes | None] = []
    for k, value in enumerate(texts):
        try:
            geometry = None if not value else shapely.from_wkt(value) if "(" in value else shapely.from_wkb(value)
        except shapely.GEOSException:
            raise CatalogueError(f"{path}: row {first_row + k}: geometry is {value[:60]!r}; expected a polygon as WKT or WKB") from None
        binary.append(None if geometry is None else shapely.to_wkb(geometry))
    return pa.array(binary, pa.binary())
