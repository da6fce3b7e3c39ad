"""The images of a catalogue. Of many only names and sizes are in memory; their cameras and footprints wait in a file."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, overload

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from submin.errors import CatalogueError, InputError
from submin.formats.columns import Column, integer, refuse, table_batches, text
from submin.sensors import SENSORS, SURVEYS
from submin.storage.catalogue_schema import CONTROL_PREFIX, ImageRecord
from submin.storage.spilled import Spilled

IMAGE_COLUMNS = (
    text("image_id"), text("block_id"), text("pass_id"), text("platform", blank=True), text("sensor"), text("camera"),
    integer("width"), integer("height"), text("acquired", False, blank=True), Column("geometry", pa.binary(), False),
    text("licence", False, blank=True),
)  # fmt: skip
BATCH_IMAGES = 2048
_LONG = ("camera", "geometry")
"""Columns that are not kept in memory: a camera is a text of some kilobytes."""
_REPEATED = ("block_id", "pass_id", "platform", "sensor", "licence")
_OPTIONAL: Mapping[str, Any] = {"acquired": "", "geometry": b"", "licence": ""}


class ImageRows(Sequence[ImageRecord]):
    """Images in the order of their table; each is made when it is asked for.

    Attributes
    ----------
    ids : ids of all images; block_of : place (m,) of each image's block among ``blocks``
    blocks : ids of all blocks, in the order in which the table names them
    """

    def __init__(self, columns: pa.Table, ends: NDArray[np.int64], long_texts: Spilled) -> None:
        """``long_texts``: camera and footprint of one image after the other; ``ends`` (2 m + 1,): where each begins and the last ends."""
        self._columns, self._ends, self._long_texts = columns, ends, long_texts
        weakref.finalize(self, long_texts.close)
        self.ids: pa.ChunkedArray = columns["image_id"]
        of_block = columns["block_id"].combine_chunks()
        self.blocks = tuple(of_block.dictionary.to_pylist())
        self.block_of: NDArray[np.int32] = np.asarray(of_block.indices, dtype=np.int32)

    @classmethod
    def read(cls, path: Path) -> ImageRows:
        """The images of a table, in bounded memory but for names and sizes.

        Raises
        ------
        CatalogueError
            When the table, or one of its images, cannot be used: file, row, value, what was expected.
        """
        with ExitStack() as on_error:
            texts = Spilled("cameras")
            on_error.callback(texts.close)
            batches, ends = [], [np.zeros(1, dtype=np.int64)]
            first_row: dict[str, int] = {}
            for row, batch in table_batches(path, IMAGE_COLUMNS, BATCH_IMAGES):
                for name in ("width", "height"):
                    refuse(pc.is_null(batch[name]), batch[name], name, path, row, "a number of pixels")
                records = _records(batch, path, row)
                _check(records, first_row, path, row)
                pieces = [piece for image in records for piece in (image.camera.encode(), image.footprint)]
                texts.append(b"".join(pieces))
                ends.append(ends[-1][-1] + np.cumsum([len(piece) for piece in pieces], dtype=np.int64))
                batches.append(batch.drop_columns([name for name in _LONG if name in batch.schema.names]))
            if not first_row:
                raise CatalogueError(f"{path}: holds no images; expected at least one row")
            images = cls(_compact(batches), np.concatenate(ends), texts)
            on_error.pop_all()
            return images

    @classmethod
    def none(cls) -> ImageRows:
        """No images."""
        kinds = {c.name: pa.dictionary(pa.int32(), c.type) if c.name in _REPEATED else c.type for c in IMAGE_COLUMNS if c.name not in _LONG}
        return cls(pa.schema(list(kinds.items())).empty_table(), np.zeros(1, dtype=np.int64), Spilled("cameras"))

    def __len__(self) -> int:
        return len(self._columns)

    @overload
    def __getitem__(self, place: int) -> ImageRecord: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[ImageRecord, ...]: ...

    def __getitem__(self, place: int | slice) -> ImageRecord | tuple[ImageRecord, ...]:
        if isinstance(place, slice):
            return self.take(range(len(self))[place])
        return self.take([range(len(self))[place]])[0]

    def __iter__(self) -> Iterator[ImageRecord]:
        for start in range(0, len(self), BATCH_IMAGES):
            yield from self[start : start + BATCH_IMAGES]

    def take(self, rows: Sequence[int] | NDArray[np.int64]) -> tuple[ImageRecord, ...]:
        """The images at some places."""
        if not len(rows):
            return ()
        first, last = int(rows[0]), int(rows[-1])
        neighbours = last - first == len(rows) - 1 and all(row == first + k for k, row in enumerate(rows))
        # what lies side by side, as the images of a block do nearly always, is not gathered
        values = (self._columns.slice(first, len(rows)) if neighbours else self._columns.take(pa.array(rows, pa.int64()))).to_pydict()
        texts = [self._long(row) for row in rows]
        return tuple(
            ImageRecord(**dict(zip(values, of_image, strict=True)), camera=camera, footprint=footprint)
            for of_image, (camera, footprint) in zip(zip(*values.values(), strict=True), texts, strict=True)
        )

    def _long(self, row: int) -> tuple[str, bytes]:
        start, middle, end = self._ends[2 * row : 2 * row + 3].tolist()
        both = self._long_texts.read(start, end)
        return both[: middle - start].decode(), both[middle - start :]


def _compact(batches: Sequence[pa.RecordBatch]) -> pa.Table:
    """One table, in which texts that come again and again are numbers."""
    table = pa.Table.from_batches(batches)
    for name in _REPEATED:
        if name in table.schema.names:
            table = table.set_column(table.schema.get_field_index(name), name, table[name].combine_chunks().dictionary_encode())
    return table.combine_chunks()


def _records(batch: pa.RecordBatch, path: Path, first_row: int) -> list[ImageRecord]:
    names = batch.schema.names
    records = []
    for row, values in enumerate(zip(*(batch[name].to_pylist() for name in names), strict=True), start=first_row):
        record = {**_OPTIONAL, **dict(zip(names, values, strict=True))}
        record["footprint"] = record.pop("geometry") or b""
        try:
            records.append(ImageRecord(**record))
        except InputError as error:
            raise CatalogueError(f"{path}: row {row}: {error}") from None
    return records


def _check(records: Sequence[ImageRecord], first_row: dict[str, int], path: Path, start: int) -> None:
    """Refuse images of sensors that are none of images, and those that are there twice or take a name of control."""
    of_images = [name for name, sensor in SENSORS.items() if sensor.parameters and name not in SURVEYS]
    for row, image in enumerate(records, start=start):
        if image.sensor in SENSORS and image.sensor not in of_images:  # views that the program makes itself
            raise CatalogueError(
                f"{path}: row {row}: sensor is {image.sensor!r}, which is none of images; expected one of {', '.join(of_images)}"
            )
        if image.image_id in first_row:
            raise CatalogueError(
                f"{path}: row {row}: image_id {image.image_id!r} is that of row {first_row[image.image_id]} too; expected it once"
            )
        for name, value in (("image_id", image.image_id), ("block_id", image.block_id)):
            if value.startswith(CONTROL_PREFIX):
                raise CatalogueError(
                    f"{path}: row {row}: {name} is {value!r}; expected another one: {CONTROL_PREFIX!r} begins those of control points"
                )
        first_row[image.image_id] = row
