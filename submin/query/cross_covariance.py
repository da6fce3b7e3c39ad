"""Covariance between the answers of two tiles, each by itself, in closed form.

Each estimate is M times a sum over sources, and sources that both tiles hold are the same random numbers:

    Cov(x_i of A, x_j of B) = delta_ij D_j + U_i K Lambda_A^-1 Lambda_AB Lambda_B^-1 K' U_j'

(docs/mathematics.md, "Cross-covariance of two tiles").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.network.sub_min import GroundPart, loadings
from submin.query.padded_tiles import padded_tiles
from submin.query.source import NetworkSource

Array = NDArray[np.float64]
Ids = NDArray[np.str_]


def cross_covariance(
    source: NetworkSource, tiles: tuple[int, int], ids: tuple[Ids, Ids], parts: tuple[Sequence[GroundPart], Sequence[GroundPart]]
) -> Array:
    """Covariance (3n, 3k) of n points as the first tile answers for them, and k points as the second one does; geocentric square metres.

    ``ids`` name the points of ``parts``, in their order; a point is the same point in both.
    """
    padded = padded_tiles(source, tiles)
    p = padded.images.parameters
    seen = [(loadings(of_tile, padded.rows, p) @ padded.prior).toarray() for of_tile in parts]
    reach = [la.cho_solve((lower, True), u.T) for lower, u in zip(padded.factors, seen, strict=True)]  # Lambda_t^-1 K' U'
    covariance = reach[0].T @ padded.common(0, 1) @ reach[1]
    _, first, second = np.intersect1d(*ids, return_indices=True)
    own = np.concatenate([part.factors.own for part in parts[0]])
    covariance.reshape(len(ids[0]), 3, len(ids[1]), 3)[first, :, second, :] += own[first]
    return np.asarray(covariance)
