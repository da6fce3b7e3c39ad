"""One version of a network, read: whole and unchanged, whatever is being written."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property, lru_cache
from typing import Any

import icechunk
import numpy as np
import zarr
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.priors import ImagePrior
from submin.errors import StoreError
from submin.network.cell import Cell, empty_cell, empty_sums, widened_sums
from submin.network.network_image import NetworkImage, image_priors
from submin.network.sub_min import SubMin
from submin.storage.arrays import (
    TABLE_CHUNK,
    attributes_of,
    existing_groups,
    group_of,
    member_names,
    read_attributes,
    read_record,
    read_records,
    read_spans,
    read_table,
    table_length,
)
from submin.storage.directory import Directory
from submin.storage.ray_totals import RayTotals, summed_cells
from submin.storage.repository import BRANCH, find_version, open_repository
from submin.storage.schema import (
    CELL_PARTS,
    DIRECTORY_COLUMNS,
    IMAGE_COLUMNS,
    SUMS_PARTS,
    NetworkMetadata,
    cell_of,
    network_images,
    read_sub_min,
    sums_of,
    with_joint,
)
from submin.tiling.cover import Cover

READ_OVER_ROWS = 32
DIRECTORY_PIECE = 16 * TABLE_CHUNK
"""Entries of the directory that are looked through at a time."""
DIRECTORY_AHEAD = 8 * DIRECTORY_PIECE
"""Entries, 128 MB, of the largest directory that is read before it is known what will be asked of it."""


@lru_cache(maxsize=4)
def _cover(text: str) -> Cover:
    """The cover of a description: versions share it, and with it what it has worked out of its cells."""
    return Cover.from_mapping(json.loads(text))


class Snapshot:
    """One version of a network, read only. Everything is read when asked for; only names, flags and what `directory` gives are kept."""

    def __init__(self, root: zarr.Group, place: str, cover: Cover | None = None, parameters: int = 0) -> None:
        """``cover`` and ``parameters`` are those of the version being made: its tiles may be finer, its images may need more parameters."""
        self.root = root
        self.place = place
        stored = NetworkMetadata.from_attributes(attributes_of(root), place)
        self.metadata = replace(stored, parameters=max(stored.parameters, parameters))
        self.cover = _cover(json.dumps(self.metadata.cover)) if cover is None else cover
        self.number = int(attributes_of(root)["version"])

    @classmethod
    def open(cls, place: str, version: str | None = None, parameters: int = 0) -> Snapshot:
        """Open the newest version, or the one named (``v12``, or a tag), with at least so many parameters an image.

        Raises
        ------
        StoreError, QueryError
            When there is no network, or no such version.
        """
        repository = open_repository(place)
        if version is None:
            session = repository.readonly_session(BRANCH)
        else:
            session = repository.readonly_session(snapshot_id=find_version(place, version).snapshot)
        try:
            return cls(root_of(session), place, parameters=parameters)
        except FileNotFoundError:
            raise StoreError(f"{place}: holds a repository but no network; make one with 'submin create'") from None

    @property
    def version(self) -> str:
        """``v12``."""
        return f"v{self.number}"

    @property
    def commit(self) -> str:
        """The snapshot of the repository that holds the version."""
        store = self.root.store
        assert isinstance(store, icechunk.IcechunkStore)
        return str(store.session.snapshot_id)

    def cell(self, number: int, *, with_sums: bool = True) -> Cell:
        """A cell, empty when it has no points yet."""
        return self.cells([number], with_sums=with_sums)[0]

    def cells(self, numbers: Sequence[int], *, with_sums: bool = True) -> list[Cell]:
        """Cells, those empty that have no points yet; they are read side by side."""
        names, parameters = map(self.cover.cell_name, numbers), self.metadata.parameters
        records = read_records(group_of(self.root, "cells"), names, None if with_sums else CELL_PARTS)
        return [
            empty_cell(number, parameters) if record is None else cell_of(record, parameters, with_sums=with_sums)
            for number, record in zip(numbers, records, strict=True)
        ]

    def cell_sums(self, number: int) -> tuple[NDArray[np.int32], Sums]:
        """A cell's images (rows of the network) and sums, without its points and rays; nothing of a cell that has no points."""
        return self.some_sums([number])[0]

    def some_sums(self, numbers: Sequence[int]) -> list[tuple[NDArray[np.int32], Sums]]:
        """Images and sums of cells as `cell_sums` has them, read side by side."""
        parameters, found = self.metadata.parameters, []
        for record in read_records(group_of(self.root, "cells"), map(self.cover.cell_name, numbers), SUMS_PARTS):
            if record is None:
                found.append((np.empty(0, dtype=np.int32), empty_sums(0, parameters)))
            else:
                images = record.parts["images"].astype(np.int32)
                found.append((images, widened_sums(sums_of(record), len(images), parameters)))
        return found

    def cell_numbers(self) -> tuple[int, ...]:
        """Cells that hold points or rays, ascending."""
        return self._cell_numbers

    @cached_property
    def _cell_numbers(self) -> tuple[int, ...]:
        return tuple(sorted(map(self.cover.cell_number, member_names(group_of(self.root, "cells")))))

    def existing_cells(self, numbers: Sequence[int]) -> tuple[int, ...]:
        """Those of some cells that hold points or rays, without a list of all."""
        there = existing_groups(group_of(self.root, "cells"), map(self.cover.cell_name, numbers))
        return tuple(number for number, exists in zip(numbers, there, strict=True) if exists)

    def cell_counts(self, numbers: Sequence[int]) -> list[Mapping[str, Any]]:
        """Counts of some cells that are there, without reading their arrays."""
        found = read_attributes(group_of(self.root, "cells"), map(self.cover.cell_name, numbers))
        return [attributes for attributes in found if attributes is not None]

    def ray_totals(self) -> RayTotals:
        """What the rays of all cells sum to."""
        stated = attributes_of(self.root).get("rays")
        changed = read_table(group_of(self.root, "changes"), ["changed"])["changed"]
        # where another release has changed cells since, they say nothing
        if stated is None or stated["version"] < changed.max(initial=0):
            return summed_cells(self.root)
        return RayTotals(*(stated[field.name] for field in fields(RayTotals)))

    def tile_numbers(self) -> tuple[int, ...]:
        """Tiles that have a sub-MIN, ascending."""
        return self._tile_numbers

    @cached_property
    def _tile_numbers(self) -> tuple[int, ...]:
        return tuple(sorted(map(self.cover.tile_number, member_names(group_of(self.root, "tiles")))))

    def has_tile(self, tile: int) -> bool:
        """Whether a tile has a sub-MIN."""
        return existing_groups(group_of(self.root, "tiles"), [self.cover.tile_name(tile)])[0]

    def sub_min(self, tile: int, images: NDArray[np.int32] | None = None) -> SubMin:
        """A tile's sub-MIN, or its marginal on some images."""
        return read_sub_min(group_of(self.root, "tiles/" + self.cover.tile_name(tile)), self.metadata.parameters, images)

    def tile_images(self, tile: int) -> NDArray[np.int32]:
        """Rows of the images that a tile sees."""
        return np.asarray(read_record(group_of(self.root, "tiles/" + self.cover.tile_name(tile)), ["images"])["images"], dtype=np.int32)

    def image_count(self) -> int:
        """Number of images in the network."""
        return table_length(group_of(self.root, "images"))

    def images(self, rows: Sequence[int] | NDArray[np.integer] | None = None) -> list[NetworkImage]:
        """Images of these rows (ascending), or all."""
        return with_joint(self.root, self.plain_images(np.arange(self.image_count()) if rows is None else rows))

    def plain_images(self, rows: Sequence[int] | NDArray[np.integer]) -> list[NetworkImage]:
        """Images of these rows (ascending), views of correlated control without their rows of the common factor (`with_joint`)."""
        wanted = [k for k in IMAGE_COLUMNS if k not in ("platform", "acquired", "footprint", "licence", "withdrawn")]
        return [image for columns in self.image_rows(rows, wanted) for image in network_images(columns)]

    def image_rows(self, rows: Sequence[int] | NDArray[np.integer], wanted: Sequence[str]) -> list[dict[str, NDArray[Any]]]:
        """Columns of some rows (ascending) of the image table, in runs of neighbours one after the other."""
        wanted_rows = np.asarray(rows, dtype=np.int64)
        if not len(wanted_rows):
            return []
        # rows of a long gap between neighbours are not decoded; runs that lie in one chunk are read together
        runs = np.split(wanted_rows, np.flatnonzero(np.diff(wanted_rows) > READ_OVER_ROWS) + 1)
        spans = read_spans(group_of(self.root, "images"), wanted, [(int(run[0]), int(run[-1]) + 1) for run in runs])
        return [{name: values[run - run[0]] for name, values in columns.items()} for run, columns in zip(runs, spans, strict=True)]

    def image_priors(self) -> tuple[ImagePrior, ...]:
        """What is believed a priori of every image, by row; cameras are not read."""
        columns = self.image_columns(["image_id", "block_id", "pass_id", "sensor", "width", "height", "seconds", "a_priori", "released"])
        columns["camera"] = np.full(len(columns["image_id"]), "")
        return image_priors(with_joint(self.root, network_images(columns)))

    def image_columns(self, wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Columns of the image table."""
        return read_table(group_of(self.root, "images"), wanted)

    def ledger(self, wanted: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
        """Columns of the ledger of blocks; a block's last row counts."""
        return read_table(group_of(self.root, "ledger"), wanted)

    def flags(self) -> frozenset[tuple[int, int]]:
        """Pairs of tile and image row: the tile finds the image's camera bad."""
        return self._flags

    @cached_property
    def _flags(self) -> frozenset[tuple[int, int]]:
        table = read_table(group_of(self.root, "flags"))
        return frozenset(zip(table["tile"].tolist(), table["image"].tolist(), strict=True))

    def candidate_cells(self, point_ids: NDArray[np.str_]) -> NDArray[np.int64]:
        """Cell (n,) in which each point would be, by the directory; -1 for points that are not in the network."""
        return self.directory_of(point_ids).cells_of(point_ids)

    def directory_of(self, point_ids: NDArray[np.str_]) -> Directory:
        """What the directory says of some points: it is looked through piece by piece, however many points the network has."""
        return Directory.of_points(self._directory_pieces(), point_ids)

    def _directory_pieces(self) -> Iterator[Directory]:
        if "_directory" in vars(self):
            yield self._directory
            return
        table = group_of(self.root, "directory")
        for start in range(0, table_length(table), DIRECTORY_PIECE):
            yield Directory(**read_table(table, DIRECTORY_COLUMNS, start, start + DIRECTORY_PIECE))

    def directory(self) -> Directory:
        """The directory of all points, 16 bytes each; it is kept."""
        return self._directory

    def read_ahead(self) -> None:
        """Read and keep the directory, where it is no more than `DIRECTORY_AHEAD` entries: whoever asks for points then need not wait."""
        if table_length(group_of(self.root, "directory")) <= DIRECTORY_AHEAD:
            self.directory()

    @cached_property
    def _directory(self) -> Directory:
        return Directory(**read_table(group_of(self.root, "directory"), DIRECTORY_COLUMNS))


def root_of(session: icechunk.Session) -> zarr.Group:
    """The root of a version. What Zarr would look for beside, an older format and metadata of all members in one place, is never there."""
    return zarr.open_group(session.store, mode="r", zarr_format=3, use_consolidated=False)
