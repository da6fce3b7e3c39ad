"""What a merge policy may ask of a network: one version of it, whatever holds it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Protocol, TypeVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.images import ImageSet
from submin.network.cell import Cell
from submin.network.sub_min import CombinedState, SubMin
from submin.tiling.cover import Cover

Index = NDArray[np.int32]
T = TypeVar("T")


class NetworkSource(Protocol):
    """One version of a network. What has a body here need not be there in a class that is derived from this one: it is then only slower."""

    @property
    def cover(self) -> Cover:
        """Tiles and cells."""
        ...

    def cell_numbers(self) -> tuple[int, ...]:
        """Cells that hold points, ascending."""
        ...

    def existing(self, numbers: Sequence[int]) -> tuple[int, ...]:
        """Those of some cells that hold points, in their order."""
        there = set(self.cell_numbers())
        return tuple(number for number in numbers if number in there)

    def cell(self, number: int) -> Cell:
        """A cell without its sums."""
        ...

    def some_cells(self, numbers: Sequence[int]) -> list[Cell]:
        """Cells without their sums."""
        return [self.cell(number) for number in numbers]

    def cell_sums(self, number: int) -> tuple[Index, Sums]:
        """A cell's images (rows of the network) and its sums."""
        ...

    def some_sums(self, numbers: Sequence[int]) -> list[tuple[Index, Sums]]:
        """Images and sums of cells."""
        return [self.cell_sums(number) for number in numbers]

    def kept(self, key: Hashable, make: Callable[[], T]) -> T:
        """What was made of this version under a key before, or else is made now. It must not be changed."""
        return make()

    def sub_min(self, tile: int, images: Index | None) -> SubMin:
        """A tile's sub-MIN from its own cells and those that it shares, or its marginal on some images (ascending)."""
        ...

    def with_outside(self, tiles: Sequence[int], images: Index) -> SubMin | None:
        """State of some images (ascending) from tiles and all that lies outside of them; None where the network cannot tell.

        It cannot before it is reconciled, nor once something is gone that was counted then (docs/mathematics.md, "Outside messages").
        """
        ...

    def combined_with_outside(self, tiles: Sequence[int], images: Index, loading: sp.csr_array) -> CombinedState | None:
        """State of some images (ascending), and the covariance of what ``loading`` (n, m p) makes of them, as in `with_outside`.

        None where that costs no less than the covariance of the images.
        """
        return None

    def image_set(self, rows: Sequence[int] | Index) -> ImageSet:
        """Images of these rows (ascending)."""
        ...


def existing_cells(source: NetworkSource, tiles: Sequence[int]) -> tuple[int, ...]:
    """Distinct cells with points that any of these tiles holds, ascending."""
    return source.existing(sorted({cell for tile in tiles for cell in source.cover.cells_held(tile)}))
