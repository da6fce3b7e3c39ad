"""The directory of a network: in which cell a point of an id is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.storage.arrays import hash_ids

SIEVE = 64
"""Places of the sieve for each id that is looked for: as many in a hundred of all other points pass it."""
LARGEST_SIEVE = 1 << 24


@dataclass(frozen=True, eq=False)
class Directory:
    """Entries in order of arrival; the last one of a hash counts.

    Attributes
    ----------
    hash : (k,) hash of each entry's id; cell : (k,) cell where the point was put
    """

    hash: NDArray[np.uint64]
    cell: NDArray[np.int64]

    def cells_of(self, point_ids: NDArray[np.str_]) -> NDArray[np.int64]:
        """Cell (n,) in which each point would be; -1 for points that are not in the network. The ids in the cell decide."""
        if not len(self.hash) or not len(point_ids):
            return np.full(len(point_ids), -1, dtype=np.int64)
        wanted, inverse = np.unique(hash_ids(point_ids), return_inverse=True)
        # nearly all entries are of other points, and one look at a few bits of the hash tells
        places = min(1 << (SIEVE * len(wanted)).bit_length(), LARGEST_SIEVE)
        bits = np.uint64(places - 1)
        sieve = np.zeros(places, dtype=np.bool_)
        sieve[wanted & bits] = True
        near = np.flatnonzero(sieve[self.hash & bits])
        at = np.minimum(np.searchsorted(wanted, self.hash[near]), len(wanted) - 1)
        hit = wanted[at] == self.hash[near]
        found = np.full(len(wanted), -1, dtype=np.int64)
        found[at[hit]] = self.cell[near[hit]]  # entries are in order of arrival, and the last assignment stays
        return found[inverse]
