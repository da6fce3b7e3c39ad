"""Reading a catalogue: images in memory, measurements streamed block by block, and a full scan for structural errors.

Tables are Parquet, CSV or gzipped CSV with the same columns. Rows are counted from 1; a header is no row. Whatever is wrong with the structure of a
catalogue (columns, types, unknown images, order) raises `CatalogueError`; what is wrong inside one block is left to `defects`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import shapely
from numpy.typing import NDArray

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError, InputError
from submin.formats.tables import covariance_of_rows
from submin.geodesy import local_axes, rotate_covariance
from submin.storage.catalogue_schema import (
    COVARIANCE_COLUMNS,
    DEFAULT_SIGMA_PX,
    POINT_KINDS,
    SIGMA_COLUMNS,
    Array,
    Block,
    CatalogueMetadata,
    CatalogueSummary,
    ImageRecord,
    PointTable,
    defects,
    first_repeated,
)

T = TypeVar("T")

SUFFIXES = (".parquet", ".csv", ".csv.gz")
BATCH_ROWS = 1 << 16
_CSV_BLOCK_BYTES = 1 << 24
_BROKEN_CSV_ROW = re.compile(r"Row #(\d+): (Expected .*)")


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


IMAGE_COLUMNS = (
    text("image_id"), text("block_id"), text("pass_id"), text("platform", blank=True), text("sensor"), text("camera"),
    integer("width"), integer("height"), text("acquired", False, blank=True), Column("geometry", pa.binary(), False),
    text("licence", False, blank=True),
)  # fmt: skip
MEASUREMENT_COLUMNS = (
    text("block_id"), text("image_id"), text("point_id"), number("sample"), number("line"),
    number("sigma_sample", False), number("sigma_line", False),
)  # fmt: skip
POINT_COLUMNS = (
    text("point_id"), number("longitude"), number("latitude"), number("height"), text("area", False, blank=True),
    *(number(name, False) for name in (*COVARIANCE_COLUMNS, *SIGMA_COLUMNS)),
    Column("covariance_row", pa.list_(pa.float64()), False),
)  # fmt: skip


def table_path(folder: Path, stem: str) -> Path | None:
    """The file that holds a table, Parquet or CSV, or None; two of them are an error."""
    found = [folder / (stem + suffix) for suffix in SUFFIXES if (folder / (stem + suffix)).is_file()]
    if len(found) > 1:
        raise CatalogueError(f"{folder}: {found[0].name} and {found[1].name} hold the same table; expected one of them: remove the other")
    return found[0] if found else None


def table_batches(path: Path, columns: Collection[Column]) -> Iterator[tuple[int, pa.RecordBatch]]:
    """Batches of rows of a Parquet or CSV file with the number of their first row, in bounded memory.

    A batch holds those of ``columns`` that the file has, in their types. Texts that must be given are neither null nor empty.

    Raises
    ------
    CatalogueError
        When the file cannot be read, lacks a column, or holds a value of another type: file, column or row, value, what was expected.
    """
    if not path.is_file():
        raise CatalogueError(f"{path}: no such file; expected a table with columns {_listed(columns)}")
    reading = _parquet_batches if path.suffix == ".parquet" else _csv_batches
    try:
        row = 1
        for batch in reading(path, columns):
            present = [c for c in columns if c.name in batch.schema.names]
            arrays = [_typed(batch.column(c.name), c, path, row) for c in present]
            yield row, pa.RecordBatch.from_arrays(arrays, schema=pa.schema([(c.name, c.type) for c in present]))
            row += batch.num_rows
    except (pa.ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        broken = _BROKEN_CSV_ROW.search(reason)
        if broken:  # there the header is a row
            raise CatalogueError(f"{path}: row {int(broken[1]) - 1}: {broken[2]}") from None
        raise CatalogueError(f"{path}: cannot be read as a table ({reason})") from None


def read_table(path: Path, columns: Collection[Column]) -> pa.Table:
    """A whole small table; see `table_batches`. Optional columns that the file lacks are absent."""
    batches = [batch for _, batch in table_batches(path, columns)]
    return pa.Table.from_batches(batches) if batches else _empty(columns)


def _listed(columns: Collection[Column]) -> str:
    optional = [c.name for c in columns if not c.required]
    required = ", ".join(c.name for c in columns if c.required)
    return required + (f" (optional: {', '.join(optional)})" if optional else "")


def _present(path: Path, names: Collection[str], columns: Collection[Column]) -> list[str]:
    for column in columns:
        if column.required and column.name not in names:
            raise CatalogueError(f"{path}: column {column.name!r} is missing; expected {_listed(columns)}")
    return [c.name for c in columns if c.name in names]


def _parquet_batches(path: Path, columns: Collection[Column]) -> Iterator[pa.RecordBatch]:
    with pq.ParquetFile(path, pre_buffer=False) as file:
        names = _present(path, file.schema_arrow.names, columns)
        yield from file.iter_batches(batch_size=BATCH_ROWS, columns=names, use_threads=False)


def _csv_batches(path: Path, columns: Collection[Column]) -> Iterator[pa.RecordBatch]:
    reading = pcsv.ReadOptions(use_threads=False, block_size=_CSV_BLOCK_BYTES)
    parsing = pcsv.ParseOptions(newlines_in_values=True)
    with pcsv.open_csv(path, read_options=reading, parse_options=parsing) as header:
        names = _present(path, header.schema.names, columns)
    converting = pcsv.ConvertOptions(include_columns=names, column_types=dict.fromkeys(names, pa.string()))
    with pcsv.open_csv(path, read_options=reading, parse_options=parsing, convert_options=converting) as reader:
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
        _refuse(pc.fill_null(pc.equal(array, ""), True), array, column.name, path, first_row, "a text that is not empty")
        return array
    if column.type == pa.binary():
        return _well_known_binary(array, path, first_row) if is_text else _cast(array, column, path, first_row)
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


def _refuse(bad: pa.Array, values: pa.Array, name: str, path: Path, first_row: int, expected: str) -> None:
    """Raise for the first row where ``bad`` is true."""
    flags = bad.to_numpy(zero_copy_only=False).astype(bool)
    if flags.any():
        k = int(np.argmax(flags))
        raise CatalogueError(f"{path}: row {first_row + k}: {name} is {values[k].as_py()!r}; expected {expected}")


def _numbers(table: pa.Table | pa.RecordBatch, name: str, default: float = np.nan) -> Array:
    """A column as float64, nulls (and an absent column) as ``default``."""
    if name not in table.schema.names:
        return np.full(table.num_rows, default)
    return np.asarray(pc.fill_null(table[name], default).to_numpy(), dtype=np.float64)


def _texts(table: pa.Table, name: str) -> NDArray[np.str_]:
    if name not in table.schema.names:
        return np.zeros(table.num_rows, dtype=np.str_)
    return np.asarray(table[name].to_numpy(), dtype=np.str_)


@dataclass(frozen=True, eq=False)
class Catalogue:
    """A catalogue on disk: images and priors in memory, measurements read as they are needed.

    Attributes
    ----------
    path : its folder
    metadata : body, ellipsoid, frame
    images : all images, in catalogue order
    default_prior : a priori model of blocks without an entry of their own
    priors : a priori model by block
    """

    path: Path
    metadata: CatalogueMetadata
    images: tuple[ImageRecord, ...]
    default_prior: APriori
    priors: Mapping[str, APriori]

    @classmethod
    def open(cls, path: str | Path) -> Catalogue:
        """Open a catalogue and read all but its measurements and points.

        Raises
        ------
        CatalogueError
            When metadata, images or priors cannot be used: file, row, value, what was expected.
        """
        folder = Path(path)
        if not folder.is_dir():
            raise CatalogueError(f"{folder}: no such folder; expected a catalogue (a folder with catalogue.json)")
        metadata = _from_json(folder / "catalogue.json", CatalogueMetadata.from_mapping)
        images = _read_images(_required(folder, "images"))
        _required(folder, "measurements")
        default, priors = APriori(), dict[str, APriori]()
        if (folder / "priors.json").exists():
            default, priors = _from_json(folder / "priors.json", _priors)
            unknown = sorted(set(priors) - {image.block_id for image in images})
            if unknown:
                raise CatalogueError(f"{folder / 'priors.json'}: block {unknown[0]!r} has no image; expected blocks of the images table")
        return cls(folder, metadata, images, default, priors)

    @cached_property
    def _images_of(self) -> dict[str, tuple[ImageRecord, ...]]:
        members: dict[str, list[ImageRecord]] = {}
        for image in self.images:
            members.setdefault(image.block_id, []).append(image)
        return {block_id: tuple(images) for block_id, images in members.items()}

    @property
    def block_ids(self) -> tuple[str, ...]:
        """Blocks in the order in which the images table names them."""
        return tuple(self._images_of)

    @property
    def block_count(self) -> int:
        """Number of blocks."""
        return len(self._images_of)

    def a_priori(self, block_id: str) -> APriori:
        """What is believed of the cameras of a block."""
        return self.priors.get(block_id, self.default_prior)

    def blocks(self, skip: Collection[str] = frozenset()) -> Iterator[Block]:
        """Every block but those in ``skip``, once: in the order of the measurements, and last the blocks without any.

        Memory is bounded by one block and one batch of rows.

        Raises
        ------
        CatalogueError
            When a block comes back after another one, or a measurement names an image that is not of its block.
        """
        path = _required(self.path, "measurements")
        measured = set()
        for block_id, row, table in _runs(path):
            measured.add(block_id)
            if block_id not in skip:
                yield self._block(block_id, row, table, path)
        for block_id in self.block_ids:
            if block_id not in measured and block_id not in skip:
                yield self._block(block_id, 1, _empty(MEASUREMENT_COLUMNS), path)

    def block(self, block_id: str) -> Block:
        """One block; raises `CatalogueError` for an unknown one."""
        if block_id not in self._images_of:
            raise CatalogueError(f"{self.path}: no block {block_id!r}; expected one of its {self.block_count} blocks")
        path = _required(self.path, "measurements")
        for found, row, table in _runs(path):
            if found == block_id:
                return self._block(block_id, row, table, path)
        return self._block(block_id, 1, _empty(MEASUREMENT_COLUMNS), path)

    def points(self, kind: Literal["control", "check", "truth"]) -> PointTable | None:
        """Control points, check points or simulated truth; None when the catalogue has no such table."""
        if kind not in POINT_KINDS:
            raise CatalogueError(f"kind of points is {kind!r}; expected one of {', '.join(POINT_KINDS)}")
        path = table_path(self.path, kind)
        return None if path is None else read_point_table(path, _COVARIANCE_OF[kind])

    def validate(self) -> CatalogueSummary:
        """Scan the whole catalogue for structural errors.

        Raises
        ------
        CatalogueError
            The first one: file, row, value, what was expected.
        """
        path = _required(self.path, "images")
        for row, image in enumerate(self.images, start=1):
            try:
                image.pack()
            except InputError as error:
                raise CatalogueError(f"{path}: row {row}: {error}") from None
        path = _required(self.path, "measurements")
        rays = sum(len(self._image_index(block_id, row, table, path)) for block_id, row, table in _runs(path))
        for kind in _COVARIANCE_OF:
            self.points(kind)
        return CatalogueSummary(self.block_count, len(self.images), rays)

    def _image_index(self, block_id: str, row: int, table: pa.Table, path: Path) -> NDArray[np.int32]:
        """Index of each ray's image among the images of its block; ``row`` is the number of the table's first row in its file."""
        if block_id not in self._images_of:
            raise CatalogueError(f"{path}: row {row}: block_id is {block_id!r}; expected a block of the images table")
        image_ids = pa.array([image.image_id for image in self._images_of[block_id]], pa.string())
        index = pc.index_in(table["image_id"], value_set=image_ids)
        if index.null_count:
            k = int(np.argmax(pc.is_null(index).to_numpy()))
            image_id = table["image_id"][k].as_py()
            others = [image.block_id for image in self.images if image.image_id == image_id]
            found = f"an image of block {others[0]!r}" if others else "which the images table does not have"
            raise CatalogueError(f"{path}: row {row + k}: image_id is {image_id!r}, {found}; expected an image of block {block_id!r}")
        return np.asarray(index.to_numpy(), dtype=np.int32)

    def _block(self, block_id: str, row: int, table: pa.Table, path: Path) -> Block:
        image = self._image_index(block_id, row, table, path)
        return Block(
            block_id,
            self._images_of[block_id],
            self.a_priori(block_id),
            _texts(table, "point_id"),
            image,
            _numbers(table, "sample"),
            _numbers(table, "line"),
            _numbers(table, "sigma_sample", DEFAULT_SIGMA_PX),
            _numbers(table, "sigma_line", DEFAULT_SIGMA_PX),
        )


def _runs(path: Path) -> Iterator[tuple[str, int, pa.Table]]:
    """The rows of each block of a measurements table, with the number of their first row; a block that comes back is refused."""
    seen: set[str] = set()
    current, first_row, pieces = "", 1, list[pa.RecordBatch]()
    for row, batch in table_batches(path, MEASUREMENT_COLUMNS):
        runs = pc.run_end_encode(batch["block_id"])
        start = 0
        for block_id, stop in zip(runs.values.to_pylist(), runs.run_ends.to_pylist(), strict=True):
            if block_id != current:
                if pieces:
                    yield current, first_row, pa.Table.from_batches(pieces)
                if block_id in seen:
                    raise CatalogueError(
                        f"{path}: row {row + start}: block_id {block_id!r} comes back after {current!r}; expected rows sorted by block"
                    )
                seen.add(block_id)
                current, first_row, pieces = block_id, row + start, []
            pieces.append(batch.slice(start, stop - start))
            start = stop
    if pieces:
        yield current, first_row, pa.Table.from_batches(pieces)


def _empty(columns: Collection[Column]) -> pa.Table:
    return pa.schema([(c.name, c.type) for c in columns if c.required]).empty_table()


def _required(folder: Path, stem: str) -> Path:
    path = table_path(folder, stem)
    if path is None:
        raise CatalogueError(f"{folder}: no table {stem!r}; expected one of {', '.join(stem + suffix for suffix in SUFFIXES)}")
    return path


def _from_json(path: Path, parse: Callable[[Mapping[str, Any]], T]) -> T:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise InputError(f"holds {type(values).__name__}; expected a JSON object")
        return parse(values)
    except FileNotFoundError:
        raise CatalogueError(f"{path}: no such file; expected the metadata of a catalogue") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CatalogueError(f"{path}: is not JSON ({error})") from None
    except InputError as error:
        raise CatalogueError(f"{path}: {error}") from None


def _priors(values: Mapping[str, Any]) -> tuple[APriori, dict[str, APriori]]:
    """Default and by block of a ``priors.json``; what the entry of a block leaves out is as in the default."""
    unknown = sorted(set(values) - {"default", "blocks"})
    if unknown:
        raise CatalogueError(f"unknown key {unknown[0]!r}; expected 'default', 'blocks'")
    entries, by_block = values.get("default", {}), values.get("blocks", {})
    if not (isinstance(entries, dict) and isinstance(by_block, dict) and all(isinstance(e, dict) for e in by_block.values())):
        raise CatalogueError("'default' and every entry of 'blocks' must be JSON objects")
    default = APriori.from_mapping(entries)
    return default, {block_id: APriori.from_mapping({**default.to_mapping(), **entry}) for block_id, entry in by_block.items()}


def _read_images(path: Path) -> tuple[ImageRecord, ...]:
    table = read_table(path, IMAGE_COLUMNS)
    for name in ("width", "height"):
        _refuse(pc.is_null(table[name]), table[name], name, path, 1, "a number of pixels")
    optional = {"acquired": "", "geometry": b"", "licence": ""}
    names = [c.name for c in IMAGE_COLUMNS if c.name in table.schema.names]
    images: list[ImageRecord] = []
    first_row: dict[str, int] = {}
    for row, values in enumerate(zip(*(table[name].to_pylist() for name in names), strict=True), start=1):
        record = {**optional, **dict(zip(names, values, strict=True))}
        record["footprint"] = record.pop("geometry") or b""
        try:
            image = ImageRecord(**record)
        except InputError as error:
            raise CatalogueError(f"{path}: row {row}: {error}") from None
        if image.image_id in first_row:
            raise CatalogueError(
                f"{path}: row {row}: image_id {image.image_id!r} is that of row {first_row[image.image_id]} too; expected it once"
            )
        first_row[image.image_id] = row
        images.append(image)
    if not images:
        raise CatalogueError(f"{path}: holds no images; expected at least one row")
    return tuple(images)


Covariances = Literal["definite", "any", "none"]
_COVARIANCE_OF: dict[Literal["control", "check", "truth"], Covariances] = {"control": "definite", "check": "any", "truth": "none"}


def read_point_table(path: str | Path, covariance: Covariances = "any") -> PointTable:
    """Ground points of a Parquet or CSV file: the layout of ``control``, ``check`` and ``truth`` in a catalogue.

    Parameters
    ----------
    path : file with ``point_id``, ``longitude``, ``latitude``, ``height``, perhaps ``area``, and covariances as ``cov_ee`` ... ``cov_uu`` (m2) or
        as ``sigma_e``, ``sigma_n``, ``sigma_u`` (m), or as ``covariance_row`` (joint, geocentric axes, as query output has it)
    covariance : ``definite`` for points that control (no direction is known without error), ``any``, or ``none`` when it may be
        absent: zeros

    Raises
    ------
    CatalogueError
        When a column is missing, an id comes twice, coordinates are out of range, or a covariance is none.
    """
    file = Path(path)
    table = read_table(file, POINT_COLUMNS)
    point_ids, n = _texts(table, "point_id"), table.num_rows
    repeated = first_repeated(np.unique(point_ids, return_inverse=True)[1], np.zeros(n, dtype=np.int8))
    if repeated is not None:
        raise CatalogueError(
            f"{file}: row {repeated[1] + 1}: point_id {str(point_ids[repeated[1]])!r} is that of row {repeated[0] + 1} too; expected it once"
        )
    geodetic = np.stack([_numbers(table, name) for name in ("longitude", "latitude", "height")], axis=1)
    limits = (("longitude", 360.0, "degrees from -360 to 360"), ("latitude", 90.0, "degrees from -90 to 90"), ("height", 1e9, "metres"))
    for k, (name, limit, expected) in enumerate(limits):
        _refuse(pa.array(~(np.abs(geodetic[:, k]) <= limit)), table[name], name, file, 1, expected)
    enu, joint = _covariances(table, file, geodetic, covariance)
    return PointTable(point_ids, geodetic, enu, _texts(table, "area"), joint)


def _covariances(table: pa.Table, path: Path, geodetic: Array, kind: Covariances) -> tuple[Array, Array | None]:
    """Covariance of each point (n, 3, 3) in local axes, and the joint one where the table has it."""
    names, n = table.schema.names, table.num_rows
    joint = _joint_covariance(table, path) if "covariance_row" in names else None
    enu = np.zeros((n, 3, 3))
    if any(name in names for name in COVARIANCE_COLUMNS):
        for name, row, column in zip(COVARIANCE_COLUMNS, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2), strict=True):
            enu[:, row, column] = enu[:, column, row] = _finite(table, name, path)
    elif any(name in names for name in SIGMA_COLUMNS):
        for k, name in enumerate(SIGMA_COLUMNS):
            sigma = _finite(table, name, path)
            _refuse(pa.array(sigma < 0.0), table[name], name, path, 1, "metres, not negative")
            enu[:, k, k] = sigma**2
    elif joint is not None:
        own = joint.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
        enu = rotate_covariance(own, local_axes(geodetic))
    elif kind != "none":
        raise CatalogueError(
            f"{path}: columns of the covariance are missing; expected {', '.join(COVARIANCE_COLUMNS)}, or {', '.join(SIGMA_COLUMNS)}"
        )
    else:
        return enu, None
    values = np.linalg.eigvalsh(enu)
    floor = 1e-12 * np.abs(values[:, -1])  # round-off of the eigenvalues themselves
    bad = values[:, 0] <= 0.0 if kind == "definite" else values[:, 0] < -floor
    _refuse(
        pa.array(bad), pa.array(enu.reshape(n, 9).tolist()), "covariance", path, 1,
        "a positive definite matrix (m2)" if kind == "definite" else "a matrix without negative eigenvalues (m2)",
    )  # fmt: skip
    return enu, joint


def _finite(table: pa.Table, name: str, path: Path) -> Array:
    if name not in table.schema.names:
        raise CatalogueError(f"{path}: column {name!r} is missing; expected {', '.join(COVARIANCE_COLUMNS)}, or {', '.join(SIGMA_COLUMNS)}")
    values = _numbers(table, name)
    _refuse(pa.array(~np.isfinite(values)), table[name], name, path, 1, "a finite number")
    return values


def _joint_covariance(table: pa.Table, path: Path) -> Array:
    try:
        return covariance_of_rows(table["covariance_row"].chunks, table.num_rows, str(path))
    except InputError as error:
        raise CatalogueError(str(error)) from None


__all__ = [
    "IMAGE_COLUMNS", "MEASUREMENT_COLUMNS", "POINT_COLUMNS",
    "Block", "Catalogue", "CatalogueMetadata", "CatalogueSummary", "Column", "ImageRecord", "PointTable",
    "defects", "integer", "number", "read_point_table", "read_table", "table_batches", "table_path", "text",
]  # fmt: skip
