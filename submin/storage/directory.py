"""The directory of a network: in which cell a point of an id is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.network.id_hash import hash_ids, look_up


@dataclass(frozen=True, eq=False)
class Directory:
    """Entries in order of arrival; the last one of a hash counts.

    Attributes
    ----------
    hash : (k,) hash of each entry's id; cell : (k,) cell where the point was put
    """

    hash: NDArray[np.uint64]
    cell: NDArray[np.int64]

    @classmethod
    def of_points(cls, pieces: Iterable[Directory], point_ids: NDArray[np.str_]) -> Directory:
        """What a directory says of some points. It comes in pieces, in the order of its entries, and need not be in memory as a whole."""
        wanted = np.unique(hash_ids(point_ids))
        cell = look_up(((piece.hash, piece.cell) for piece in (pieces if len(wanted) else ())), wanted)
        return cls(wanted[cell >= 0], cell[cell >= 0])

    def __len__(self) -> int:
        return len(self.hash)

    def cells_of(self, point_ids: NDArray[np.str_]) -> NDArray[np.int64]:
        """Cell (n,) in which each point would be; -1 for points that are not in the network. The ids in the cell decide."""
        if not len(self.hash) or not len(point_ids):
            return np.full(len(point_ids), -1, dtype=np.int64)
        wanted, inverse = np.unique(hash_ids(point_ids), return_inverse=True)
        return look_up([(self.hash, self.cell)], wanted)[inverse]
