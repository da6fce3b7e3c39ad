"""Covariance between the answers of two tiles, each by itself, in closed form.

Each estimate is M times a sum over sources, and sources that both tiles hold are the same random numbers:

    Cov(x_i of A, x_j of B) = delta_ij D_j + U_i K Lambda_A^-1 Lambda_AB Lambda_B^-1 K' U_j'

(docs/mathematics.md, "Cross-covariance of two tiles").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.errors import QueryError
from submin.network.sub_min import GroundPart, loadings
from submin.query.asked import few
from submin.query.padded_tiles import padded_tiles
from submin.query.planner import determined_parts, points_named
from submin.query.source import NetworkSource

Array = NDArray[np.float64]
Ids = NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class PointsOfTile:
    """Points for which one tile answers by itself.

    Attributes
    ----------
    ids : (n,) names in the order of ``parts``
    place : (k,) place among these of each point that was asked for
    """

    tile: int
    ids: Ids
    parts: tuple[GroundPart, ...]
    place: NDArray[np.int64]


def points_of_one_tile(source: NetworkSource, tile: int, ids: Ids, cells: NDArray[np.int64]) -> PointsOfTile:
    """Points by their ids, in any order; ``cells`` are those of the unique ids, ascending, as in `points_named`.

    Raises
    ------
    QueryError
        When the tile does not hold a point, or a point is not determined.
    """
    unique = np.unique(ids)
    selections, _ = points_named(source, unique, np.where(np.isin(cells, source.cover.cells_held(tile)), cells, -1))
    kept, parts = determined_parts(source, selections)
    names = np.concatenate([np.empty(0, dtype="U1"), *(s.cell.point_ids[s.rows] for s in kept)])
    missing = np.setdiff1d(unique, names)
    if len(missing):
        raise QueryError(
            f"tile {source.cover.tile_name(tile)} does not hold {len(missing)} of {len(unique)} points, or they are not yet determined: "
            f"{few(missing)}"
        )
    order = np.argsort(names)
    return PointsOfTile(tile, names, tuple(parts), order[np.searchsorted(names[order], ids)])


def cross_covariance(source: NetworkSource, one: PointsOfTile, other: PointsOfTile) -> Array:
    """Covariance (3n, 3k) of the n points asked of one tile and the k points asked of another, geocentric square metres.

    A point of the same id is the same point.
    """
    padded = padded_tiles(source, (one.tile, other.tile))
    p = padded.images.parameters
    seen = [(loadings(points.parts, padded.rows, p) @ padded.prior).toarray() for points in (one, other)]
    reach = [la.cho_solve((lower, True), u.T) for lower, u in zip(padded.factors, seen, strict=True)]  # Lambda_t^-1 K' U'
    covariance = reach[0].T @ padded.common(0, 1) @ reach[1]
    _, first, second = np.intersect1d(one.ids, other.ids, return_indices=True)
    own = np.concatenate([part.factors.own for part in one.parts])
    covariance.reshape(len(one.ids), 3, len(other.ids), 3)[first, :, second, :] += own[first]
    axes = np.arange(3)
    return np.asarray(covariance[np.ix_((3 * one.place[:, None] + axes).ravel(), (3 * other.place[:, None] + axes).ravel())])
