"""Import of images with RPCs and measured tie points into a catalogue.

Three inputs: a table of images, a folder of RPC files, and tracks, a row a ray: ``track_id, image_id, col, row`` in the pixel frame of
the image's RPC.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from submin.adjustment.priors import APriori
from submin.adjustment.stated_accuracy import stated_a_priori
from submin.errors import CatalogueError, InputError
from submin.formats.columns import integer, number, read_table, text
from submin.formats.rpc_files import read_rpc
from submin.geodesy import WGS84
from submin.sensors import sensor_named
from submin.sensors.footprint import footprints, ground_pixels
from submin.storage.catalogue_schema import (
    DEFAULT_SIGMA_PX,
    Array,
    Block,
    CatalogueMetadata,
    Ids,
    ImageRecord,
    Index,
    first_repeated,
    parse_utc,
    utc_text,
)
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.imports import ImportSummary, Taken, named, passes

BLOCKINGS = ("pass", "image", "all")

_IMAGES = (
    text("image_id"), text("acquisition_utc", False, blank=True), integer("width", False), integer("height", False),
    number("col0", False), number("row0", False), text("rpc", False, blank=True), text("platform", False, blank=True),
    text("pass_id", False, blank=True), text("licence", False, blank=True),
)  # fmt: skip
_TRACKS = (text("track_id"), text("image_id"), number("col"), number("row"))


@dataclass(frozen=True)
class _Listed:
    """A row of the table of images; None for what it does not say."""

    row: int
    image_id: str
    time: datetime | None
    width: int | None
    height: int | None
    origin: tuple[float, float]
    rpc: str
    platform: str
    pass_id: str
    licence: str


@dataclass(frozen=True)
class _Tracks:
    """Rays (r,): track, index of the image in the table of images, and image coordinates in the RPC's pixel frame."""

    track_ids: Ids
    image: Index
    col: Array
    row: Array

    def extent(self, images: int) -> tuple[Array, Array]:
        """Least and greatest col and row (images, 2) in each image; not finite in one without rays."""
        low, high = np.full((images, 2), np.inf), np.full((images, 2), -np.inf)
        for k, values in enumerate((self.col, self.row)):
            np.minimum.at(low[:, k], self.image, values)
            np.maximum.at(high[:, k], self.image, values)
        return low, high


def import_rpc(
    images_csv: str | Path,
    rpc_folder: str | Path,
    tracks_csv: str | Path,
    out: str | Path,
    blocks: Literal["pass", "image", "all"] = "pass",
    dataset: str | None = None,
    shared_ids: bool = False,
    a_priori: APriori | None = None,
    overwrite: bool = False,
) -> ImportSummary:
    """Write a catalogue of images with RPCs and their tie points.

    Parameters
    ----------
    images_csv
        Table with ``image_id`` and, where known, ``acquisition_utc`` (20141005160138 or ISO 8601), ``width``, ``height`` (pixels; else the
        extent of the tracks), ``col0``, ``row0`` (first pixel of the image in the RPC's pixel frame; else 0, 0), ``rpc`` (file name; else
        ``IMAGE_ID.json``), ``platform``, ``pass_id``, ``licence``.
    rpc_folder
        Folder of the RPC files, see `submin.formats.rpc_files.read_rpc`.
    tracks_csv
        Table with ``track_id``, ``image_id``, ``col``, ``row`` in the RPC's own pixel frame.
    out
        Folder of the catalogue.
    blocks
        What is adjusted together: the images of a ``pass``, every ``image`` by itself, or ``all``.
    dataset
        Name of the catalogue; else that of the folder of ``images_csv``. Point ids are ``DATASET/track_id``.
    shared_ids
        Leave point ids as the tracks have them: the same id in another catalogue is the same ground point.
    a_priori
        What is believed of the cameras; by default what the RPC files of a block state (see `submin.adjustment.stated_accuracy`), and
        where they do not, 10 pixels of shift and 1 pixel of drift, half of the shift's variance common to a pass.
    overwrite
        Take the place of a catalogue in ``out``.

    Raises
    ------
    InputError
        When a table or an RPC cannot be used: file, row, value, what was expected. Nothing is written then.
    """
    if blocks not in BLOCKINGS:
        raise CatalogueError(f"blocks is {blocks!r}; expected one of {', '.join(BLOCKINGS)}")
    images_file = Path(images_csv)
    name = dataset or images_file.resolve().parent.name
    writer = CatalogueWriter(out, CatalogueMetadata(name), overwrite)
    listed = _read_images(images_file)
    tracks = _read_tracks(Path(tracks_csv), images_file, listed)

    notes: list[str] = []
    seen = np.bincount(tracks.image, minlength=len(listed)) > 0
    if not seen.all():
        notes.append(f"left out, because no track names them: {named(i.image_id for i, s in zip(listed, seen, strict=True) if not s)}")
    kept = [i for i, s in zip(listed, seen, strict=True) if s]
    image_of = (np.cumsum(seen) - 1).astype(np.int32)
    tracks = replace(tracks, image=image_of[tracks.image])

    pass_ids = passes([Taken(i.platform, i.time, i.pass_id) for i in kept], name, notes)
    block_ids = {"pass": pass_ids, "image": [i.image_id for i in kept], "all": [name] * len(kept)}[blocks]
    records = _records(images_file, Path(rpc_folder), kept, pass_ids, block_ids, tracks, notes)
    prefix = "" if shared_ids else f"{name}/"
    members = _members(records)
    priors = _priors(members, records) if a_priori is None else _Priors(a_priori, {})
    if priors.by_block:
        notes.append(f"a priori sigmas of {len(priors.by_block)} of {len(members)} blocks are those that their RPC files state")
    with writer:
        writer.write_images(records[i] for rows in members.values() for i in rows)
        writer.write_priors(priors.default, priors.by_block)
        for block in _blocks(members, records, tracks, prefix, priors):
            writer.write_block(block)
    return ImportSummary(
        catalogue=Path(out),
        dataset=name,
        blocks=len(members),
        passes=len(set(pass_ids)),
        images=len(records),
        points=len(np.unique(tracks.track_ids)),
        rays=len(tracks.image),
        notes=tuple(notes),
    )


def _read_images(path: Path) -> list[_Listed]:
    table = read_table(path, _IMAGES)
    if not table.num_rows:
        raise CatalogueError(f"{path}: holds no images; expected at least one row")
    columns = {c.name: table[c.name].to_pylist() if c.name in table.schema.names else [None] * table.num_rows for c in _IMAGES}
    listed: list[_Listed] = []
    first_row: dict[str, int] = {}
    for row, values in enumerate(zip(*columns.values(), strict=True), start=1):
        entry = dict(zip(columns, values, strict=True))
        image_id = entry["image_id"]
        if image_id in first_row:
            raise CatalogueError(f"{path}: row {row}: image_id {image_id!r} is that of row {first_row[image_id]} too; expected it once")
        first_row[image_id] = row
        listed.append(_listed(path, row, entry))
    return listed


def _listed(path: Path, row: int, entry: Mapping[str, Any]) -> _Listed:
    for name in ("width", "height"):
        if entry[name] is not None and entry[name] <= 0:
            raise CatalogueError(f"{path}: row {row}: {name} is {entry[name]}; expected a positive number of pixels")
    origin = (entry["col0"] or 0.0, entry["row0"] or 0.0)
    if not np.isfinite(origin).all():
        raise CatalogueError(f"{path}: row {row}: col0, row0 are {origin[0]}, {origin[1]}; expected finite numbers of pixels")
    try:
        time = parse_utc(entry["acquisition_utc"]) if entry["acquisition_utc"] else None
    except InputError as error:
        raise CatalogueError(f"{path}: row {row}: acquisition_utc: {error}") from None
    texts = {name: entry[name] or "" for name in ("rpc", "platform", "pass_id", "licence")}
    return _Listed(row, entry["image_id"], time, entry["width"], entry["height"], origin, **texts)


def _read_tracks(path: Path, images_file: Path, listed: Sequence[_Listed]) -> _Tracks:
    table = read_table(path, _TRACKS)
    if not table.num_rows:
        raise CatalogueError(f"{path}: holds no tracks; expected at least one row")
    image_ids = pa.array([image.image_id for image in listed], pa.string())
    index = pc.index_in(table["image_id"], value_set=image_ids)
    if index.null_count:
        k = int(np.argmax(pc.is_null(index).to_numpy()))
        raise CatalogueError(f"{path}: row {k + 1}: image_id is {table['image_id'][k].as_py()!r}; expected an image of {images_file}")
    col, row = (np.asarray(pc.fill_null(table[name], np.nan).to_numpy(), dtype=np.float64) for name in ("col", "row"))
    for name, values in (("col", col), ("row", row)):
        if not np.isfinite(values).all():
            k = int(np.argmin(np.isfinite(values)))
            raise CatalogueError(f"{path}: row {k + 1}: {name} is {table[name][k].as_py()!r}; expected a finite number of pixels")
    image = np.asarray(index.to_numpy(), dtype=np.int32)
    track_ids = np.asarray(table["track_id"].to_numpy(), dtype=np.str_)
    repeated = first_repeated(np.unique(track_ids, return_inverse=True)[1], image)
    if repeated is not None:
        earlier, k = repeated
        raise CatalogueError(
            f"{path}: row {k + 1}: track {str(track_ids[k])!r} is in image {listed[image[k]].image_id!r} as in row {earlier + 1}; "
            "expected one ray"
        )
    return _Tracks(track_ids, image, col, row)


def _records(
    images_file: Path,
    rpc_folder: Path,
    listed: Sequence[_Listed],
    pass_ids: Sequence[str],
    block_ids: Sequence[str],
    tracks: _Tracks,
    notes: list[str],
) -> list[ImageRecord]:
    """Rows of the catalogue's table of images."""
    low, high = tracks.extent(len(listed))
    records: list[ImageRecord] = []
    guessed, outside = list[str](), list[str]()
    for i, image in enumerate(listed):
        first = np.array(image.origin)
        # The pixel that holds the outermost track is the last one.
        held = np.floor(high[i] - first + 0.5).astype(int) + 1
        width, height = image.width or int(held[0]), image.height or int(held[1])
        if image.width is None or image.height is None:
            guessed.append(image.image_id)
        if width <= 0 or height <= 0:
            raise CatalogueError(
                f"{images_file}: row {image.row}: size of image {image.image_id} is not given, and its tracks end at col {high[i, 0]:g}, "
                f"row {high[i, 1]:g}, before its first pixel {image.origin}; expected width, height, or col0, row0 in the tracks' frame"
            )
        if (low[i] < first - 1.0).any() or (high[i] > first + np.array([width, height])).any():
            outside.append(image.image_id)
        camera = read_rpc(_rpc_path(images_file, rpc_folder, image)) | {"origin": list(image.origin)}
        acquired = utc_text(image.time) if image.time else ""
        records.append(
            ImageRecord(
                image.image_id, block_ids[i], pass_ids[i], image.platform, "rpc", json.dumps(camera), width, height, acquired,
                licence=image.licence,
            )
        )  # fmt: skip
    if guessed:
        notes.append(f"width or height is not known; the extent of the tracks stands for it: {named(guessed)}")
    if outside:
        notes.append(f"some tracks lie outside the image, so check col0, row0, width, height: {named(outside)}")
    footprints = _footprints(records)
    if b"" in footprints:
        without = (record.image_id for record, footprint in zip(records, footprints, strict=True) if not footprint)
        notes.append(f"no footprint, because the RPC cannot be inverted: {named(without)}")
    return [replace(record, footprint=footprint) for record, footprint in zip(records, footprints, strict=True)]


def _rpc_path(images_file: Path, rpc_folder: Path, image: _Listed) -> Path:
    name = Path(image.rpc or f"{image.image_id}.json")
    tried = list(dict.fromkeys((rpc_folder / name, rpc_folder / name.name)))
    for path in tried:
        if path.is_file():
            return path
    raise CatalogueError(f"{images_file}: row {image.row}: no RPC of image {image.image_id!r}; expected {' or '.join(map(str, tried))}")


def _places(records: Sequence[ImageRecord]) -> tuple[Array, Array]:
    """First pixels and sizes (m, 2), sample and line, in the RPCs' pixel frames."""
    first = np.array([json.loads(record.camera)["origin"] for record in records], dtype=np.float64)
    return first, np.array([(record.width, record.height) for record in records], dtype=np.float64)


def _footprints(records: Sequence[ImageRecord]) -> list[bytes]:
    """Polygons (WKB, degrees) of the images' outer pixel edges at each camera's mean height; empty where there is no ground."""
    sensor = sensor_named("rpc")
    cameras = np.stack([record.pack() for record in records])
    first, size = _places(records)
    return footprints(sensor, cameras, first, size, sensor.mean_height(cameras), WGS84)


@dataclass(frozen=True)
class _Priors:
    """What is believed of the cameras of all blocks but some, and of these."""

    default: APriori
    by_block: Mapping[str, APriori]

    def of(self, block_id: str) -> APriori:
        return self.by_block.get(block_id, self.default)


def _priors(members: Mapping[str, Sequence[int]], records: Sequence[ImageRecord]) -> _Priors:
    """What the RPC files of each block state, where they do."""
    default, by_block = APriori(), dict[str, APriori]()
    cameras = [json.loads(record.camera) for record in records]
    first, size = _places(records)
    packed = np.stack([record.pack() for record in records])
    pixels = ground_pixels(sensor_named("rpc"), packed, first + 0.5 * (size - 1.0), WGS84)
    for block_id, rows in members.items():
        stated = stated_a_priori([cameras[i] for i in rows], pixels[list(rows)], default)
        if stated is not None:
            by_block[block_id] = stated
    return _Priors(default, by_block)


def _members(records: Sequence[ImageRecord]) -> dict[str, list[int]]:
    """Images of each block, blocks and images in order of time; those without a time last."""
    never = datetime.max.replace(tzinfo=UTC)
    times = [parse_utc(record.acquired) if record.acquired else never for record in records]
    members: dict[str, list[int]] = {}
    for i in sorted(range(len(records)), key=lambda i: (times[i], i)):
        members.setdefault(records[i].block_id, []).append(i)
    return members


def _blocks(
    members: Mapping[str, Sequence[int]], records: Sequence[ImageRecord], tracks: _Tracks, prefix: str, priors: _Priors
) -> list[Block]:
    """Blocks with their rays, in the order of the tracks."""
    block_of, index_in_block = np.empty(len(records), dtype=np.int64), np.empty(len(records), dtype=np.int32)
    for k, rows in enumerate(members.values()):
        block_of[rows], index_in_block[rows] = k, np.arange(len(rows))
    of_ray = block_of[tracks.image]
    order = np.argsort(of_ray, kind="stable")
    bounds = np.searchsorted(of_ray[order], np.arange(len(members) + 1))
    point_ids = np.char.add(prefix, tracks.track_ids)
    blocks: list[Block] = []
    for k, (block_id, rows) in enumerate(members.items()):
        rays = order[bounds[k] : bounds[k + 1]]
        sigma = np.full(len(rays), DEFAULT_SIGMA_PX)
        blocks.append(
            Block(
                block_id, tuple(records[i] for i in rows), priors.of(block_id), point_ids[rays], index_in_block[tracks.image[rays]],
                tracks.col[rays], tracks.row[rays], sigma, sigma,
            )
        )  # fmt: skip
    return blocks


__all__ = ["import_rpc"]
