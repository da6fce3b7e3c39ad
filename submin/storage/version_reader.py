"""One version of a network as questions read it: what is likely to be asked for again is kept in memory."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.images import ImageSet
from submin.errors import QueryError
from submin.network.cell import Cell
from submin.network.network_image import NetworkImage, image_set
from submin.network.sub_min import CombinedState, SubMin, marginal
from submin.query.increments import UnionState
from submin.query.kept import Kept
from submin.query.outside import combined_with_outside, tiles_with_outside
from submin.query.source import NetworkSource
from submin.storage.directory import Directory
from submin.storage.reconciled import ReconciledStore
from submin.storage.schema import with_joint
from submin.storage.snapshot import Snapshot
from submin.tiling.cover import Cover

Index = NDArray[np.int32]
T = TypeVar("T")
KEPT_CELLS = 256 << 20
"""Bytes of cells that are kept in memory."""
KEPT_MERGES = 512 << 20
"""Bytes of what was made of merged tiles that are kept in memory."""
IMAGE_PAGE = 64
"""So many neighbours in the image table are read together."""
KEPT_IMAGES = 10_000
PROBED = 200
"""Up to so many cells are looked for by their names; a list of all of them costs more."""


class VersionReader(NetworkSource):
    """One version of a network, read only, behind the questions that are put to it."""

    def __init__(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        self._cells: Kept[Cell] = Kept(KEPT_CELLS)
        self._merges: Kept[Any] = Kept(KEPT_MERGES)
        self._plain_images: dict[int, NetworkImage] = {}
        self._images: dict[int, NetworkImage] = {}
        self._exists: dict[int, bool] = {}
        self._tiles: set[int] = set()
        self._reconciled = ReconciledStore(snapshot, partial(_as_it_was, snapshot))  # not a method: it would keep this in memory
        self._unions: dict[tuple[int, ...], UnionState] = {}

    @property
    def snapshot(self) -> Snapshot:
        """The version in the store."""
        return self._snapshot

    @property
    def version(self) -> str:
        """Name of the version, such as ``v12``."""
        return self.snapshot.version

    @property
    def cover(self) -> Cover:
        """Tiles and cells."""
        return self.snapshot.cover

    def cell_numbers(self) -> tuple[int, ...]:
        """Cells that hold points, ascending."""
        return self._numbers

    @cached_property
    def _numbers(self) -> tuple[int, ...]:
        return self.snapshot.cell_numbers()

    def existing(self, numbers: Sequence[int]) -> tuple[int, ...]:
        """Those of some cells that hold points, in their order."""
        unknown = [number for number in numbers if number not in self._exists]
        there = set(self.snapshot.existing_cells(unknown) if len(unknown) <= PROBED else self.cell_numbers())
        self._exists.update((number, number in there) for number in unknown)
        return tuple(number for number in numbers if self._exists[number])

    def cell(self, number: int) -> Cell:
        """A cell without its sums; the latest used ones are kept in memory."""
        return self.some_cells([number])[0]

    def some_cells(self, numbers: Sequence[int]) -> list[Cell]:
        """Cells without their sums; those that are not in memory are read side by side."""
        found = {number: cell for number in numbers if (cell := self._cells.get(number)) is not None}
        unread = [number for number in numbers if number not in found]
        for number, cell in zip(unread, self.snapshot.cells(unread, with_sums=False) if unread else (), strict=True):
            found[number] = self._cells.put(number, cell)
        return [found[number] for number in numbers]

    def cell_sums(self, number: int) -> tuple[Index, Sums]:
        """A cell's images and sums."""
        return self.some_sums([number])[0]

    def some_sums(self, numbers: Sequence[int]) -> list[tuple[Index, Sums]]:
        """Images and sums of cells, read side by side."""
        return self.snapshot.some_sums(numbers)

    def kept(self, key: Hashable, make: Callable[[], T]) -> T:
        """What was made of this version under a key before, or else is made now; the latest used are kept in memory."""
        found: T | None = self._merges.get(key)
        return self._merges.put(key, make()) if found is None else found

    def sub_min(self, tile: int, images: Index | None) -> SubMin:
        """A tile's sub-MIN, or its marginal on some images; of a tile that is asked for again the whole is kept in memory."""
        whole: SubMin | None = self._merges.get(("tile", tile))
        if whole is None:
            if tile not in self._tiles and not self.snapshot.has_tile(tile):
                raise QueryError(f"tile {self.cover.tile_name(tile)} holds nothing yet; see 'submin info'")
            if images is None or tile not in self._tiles:
                self._tiles.add(tile)
                return self.snapshot.sub_min(tile, images)
            whole = self._merges.put(("tile", tile), self.snapshot.sub_min(tile))
        return whole if images is None else marginal(whole, images)

    def with_outside(self, tiles: Sequence[int], images: Index) -> SubMin | None:
        """State of some images from tiles and all that lies outside of them; None where the network cannot tell."""
        return tiles_with_outside(self, self._reconciled, tiles, images, self._unions) if self._reconciled else None

    def combined_with_outside(self, tiles: Sequence[int], images: Index, loading: sp.csr_array) -> CombinedState | None:
        """State of some images and the covariance of combinations of them; see `submin.query.outside.combined_with_outside`."""
        return combined_with_outside(self, self._reconciled, tiles, images, loading) if self._reconciled else None

    def image_set(self, rows: Sequence[int] | Index) -> ImageSet:
        """Images of these rows; the latest asked for are kept in memory."""
        if len(self._plain_images) > KEPT_IMAGES:
            self._plain_images.clear()
            self._images.clear()
        unread = [int(row) for row in rows if int(row) not in self._images]
        pages = {row // IMAGE_PAGE for row in unread if row not in self._plain_images}
        if pages:  # neighbours are asked for next, and lie in the chunks that are read anyway
            near = np.concatenate([np.arange(IMAGE_PAGE * page, IMAGE_PAGE * (page + 1)) for page in sorted(pages)])
            near = near[near < self.snapshot.image_count()]
            self._plain_images.update(zip(near.tolist(), self.snapshot.plain_images(near), strict=True))
        images = with_joint(self.snapshot.root, [self._plain_images[row] for row in unread])
        self._images.update(zip(unread, images, strict=True))
        return image_set([self._images[int(row)] for row in rows], self.snapshot.metadata.ellipsoid, self.snapshot.metadata.parameters)

    @cached_property
    def _blocks(self) -> NDArray[np.str_]:
        """Block of every image."""
        return np.asarray(self.snapshot.image_columns(["block_id"])["block_id"], dtype=np.str_)

    def blocks_of(self, images: Index) -> tuple[str, ...]:
        """Blocks, ascending, of some images (rows); rows beyond the network's have none."""
        rows = images.tolist()
        if all(row in self._plain_images for row in rows):  # those of a small question, which it has read: the table is not
            return tuple(sorted({self._plain_images[row].block_id for row in rows}))
        return tuple(np.unique(self._blocks[images[images < len(self._blocks)]]).tolist())

    @cached_property
    def directory(self) -> Directory:
        """In which cell each point is; all of it is kept."""
        return self.snapshot.directory()


def _as_it_was(snapshot: Snapshot, version: int) -> VersionReader:
    """A network as it was at an earlier version, with as many parameters an image."""
    return VersionReader(Snapshot.open(snapshot.place, f"v{version}", snapshot.metadata.parameters))
