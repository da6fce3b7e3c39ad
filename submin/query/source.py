"""What a merge policy may ask of a network: one version of it, whatever holds it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.images import ImageSet
from submin.network.cell import Cell
from submin.network.sub_min import SubMin
from submin.tiling.cover import Cover

Index = NDArray[np.int32]


class NetworkSource(Protocol):
    """One version of a network."""

    @property
    def cover(self) -> Cover:
        """Tiles and cells."""
        ...

    def cell_numbers(self) -> tuple[int, ...]:
        """Cells that hold points, ascending."""
        ...

    def cell(self, number: int) -> Cell:
        """A cell without its sums."""
        ...

    def cell_sums(self, number: int) -> tuple[Index, Sums]:
        """A cell's images (rows of the network) and its sums."""
        ...

    def sub_min(self, tile: int, images: Index | None) -> SubMin:
        """A tile's sub-MIN from its own cells and those that it shares, or its marginal on some images (ascending)."""
        ...

    def with_outside(self, tiles: Sequence[int], images: Index) -> SubMin | None:
        """State of some images (ascending) from tiles and all that lies outside of them; None where the network cannot tell.

        It cannot before it is reconciled, nor once something is gone that was counted then (docs/mathematics.md, "Outside messages").
        """
        ...

    def image_set(self, rows: Sequence[int] | Index) -> ImageSet:
        """Images of these rows (ascending)."""
        ...


def existing_cells(source: NetworkSource, tiles: Sequence[int]) -> tuple[int, ...]:
    """Distinct cells with points that any of these tiles holds, ascending."""
    existing = set(source.cell_numbers())
    return tuple(sorted({cell for tile in tiles for cell in source.cover.cells_held(tile)} & existing))
