"""Which points of a network are reported when it is thinned: one in each square of the plane, by a rule that knows no order.

The rule reads ids and registered positions alone (decision 013). A point that is not reported keeps its rays and its part of the sums, so
nothing that is computed knows of thinning (docs/mathematics.md, "Thinning").
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from submin.geodesy import geocentric_to_geodetic
from submin.network.cell import Cell
from submin.network.id_hash import hash_ids
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


def one_a_square(ids: NDArray[np.str_], easting: Array, northing: Array, side: float) -> Flags:
    """True (n,) for the point of each square whose id has the least hash; among equal hashes for the first by id.

    Parameters
    ----------
    ids : (n,) different ids
    easting, northing : (n,) registered positions in the plane, metres
    side : of the squares, metres; they are counted from the origin of the plane
    """
    reported = np.zeros(len(ids), dtype=np.bool_)
    if len(ids):
        column, row = np.floor(easting / side), np.floor(northing / side)
        order = np.lexsort((ids, hash_ids(ids), column, row))
        first = np.r_[True, (np.diff(column[order]) != 0.0) | (np.diff(row[order]) != 0.0)]
        reported[order[first]] = True
    return reported


def reported_points(cell: Cell, cover: Cover, side: float) -> Flags:
    """True (n,) for the points of a cell that are reported: one in each square of this side (metres), all without one (``side`` 0).

    Squares lie in the plane of the cover and end at the cell's outline. Whether the rays of a point determine it does not count.
    """
    if not side > 0.0:
        return np.ones(len(cell), dtype=np.bool_)
    geodetic = geocentric_to_geodetic(cell.origin, cover.ellipsoid)
    return one_a_square(cell.point_ids, *cover.plane(geodetic[:, 0], geodetic[:, 1]), side)
