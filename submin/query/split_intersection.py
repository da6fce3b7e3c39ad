"""Policy ``split``: split Covariance Intersection. Only what tiles share is inflated.

The errors of a tile are a sum over classes of sources: cells of the same holders, and the priors, which all tiles share. Different classes
are independent; of class c tile t gets the share ``w_ct`` of the weights, one among its holders, so that

    A_t = M_t (sum_c Lambda_c / w_ct) M_t,     M_t = Lambda_t^-1,     sum over the holders t of c: w_ct = 1

together bound the joint covariance (docs/mathematics.md, "Split intersection"). Here ``w_ct = w_t / sum of w_s over the holders of c``:
what only one tile holds is not inflated, and no part is inflated more than by Covariance Intersection with the same w.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.optimize import minimize

from submin.adjustment.estimation import cholesky
from submin.network.sub_min import GroundPart, SubMin
from submin.query.covariance_intersection import intersection_weights
from submin.query.padded_tiles import PaddedTiles, padded_tiles
from submin.query.source import Index, NetworkSource

Array = NDArray[np.float64]

LEAST_WEIGHT = 1e-6


def estimate(source: NetworkSource, tiles: Sequence[int], images: Index, parts: Sequence[GroundPart]) -> SubMin:
    """A posteriori state of all images that the tiles see, by split intersection with weights best for the points of ``parts``."""
    padded = padded_tiles(source, tiles)
    functionals = padded.functionals(parts)
    if len(tiles) == 1:
        return padded.weighted(np.ones(len(padded.holds)), 1.0)
    weights = split_weights(padded, functionals)
    blended = [blend(padded, weights, t) for t in range(len(tiles))]
    information, vector = np.zeros_like(padded.of_tiles[0]), np.zeros(len(padded.of_tiles[0]))
    held = padded.holds.T.astype(np.float64) @ padded.vector
    for t, of_tile in enumerate(padded.of_tiles):
        lower = cholesky(blended[t])
        half = la.solve_triangular(lower, of_tile, lower=True)
        information += half.T @ half
        vector += half.T @ la.solve_triangular(lower, held[t], lower=True)
    return padded.state(information, vector)


def blend(padded: PaddedTiles, weights: Array, tile: int) -> Array:
    """``sum_c Lambda_c / w_ct`` (q, q) of one tile (by its place), priors included."""
    of_class = np.where(padded.holds[:, tile], (padded.holds @ weights) / weights[tile], 0.0)
    total = np.tensordot(of_class, padded.information, axes=1)
    total[np.diag_indices(len(total))] += weights.sum() / weights[tile]
    return np.asarray(total)


def split_weights(padded: PaddedTiles, functionals: Array) -> Array:
    """Weights (t,) on the simplex with a small trace of ``F P_u F'``: those of Covariance Intersection, improved; any are consistent.

    The trace is followed by its derivative: with ``J = sum_t Lambda_t B_t^-1 Lambda_t``, ``Y_t = B_t^-1 Lambda_t J^-1``,
    ``dT = sum_t tr(Y_t F'F Y_t' dB_t)``.
    """
    count = padded.holds.shape[1]
    start = np.maximum(intersection_weights(padded.of_tiles, functionals), 0.02 / count)
    holds = np.vstack([padded.holds, np.ones(count, dtype=np.bool_)])  # the priors last

    def trace(weights: Array) -> tuple[float, Array]:
        lowers = [cholesky(blend(padded, weights, t)) for t in range(count)]
        halves = [la.solve_triangular(lower, of_tile, lower=True) for lower, of_tile in zip(lowers, padded.of_tiles, strict=True)]
        whole = cholesky(np.asarray(sum(half.T @ half for half in halves)))
        covariance = la.cho_solve((whole, True), np.eye(len(whole)))
        gradient = np.zeros(count)
        sizes = holds @ weights
        for t in range(count):
            y = la.solve_triangular(lowers[t], halves[t] @ covariance, lower=True, trans=1)
            spread = y @ functionals @ y.T
            of_class = np.append(np.einsum("cij,ji->c", padded.information, spread), np.trace(spread)) * holds[:, t]
            gradient += of_class @ holds / weights[t]
            gradient[t] -= float(of_class @ sizes) / weights[t] ** 2
        return float(np.einsum("ij,ji->", covariance, functionals)), gradient

    start = start / start.sum()
    scale = trace(start)[0]

    def objective(weights: Array) -> tuple[float, Array]:
        value, gradient = trace(weights)
        return value / scale, gradient / scale

    found = minimize(
        objective, start, jac=True, method="SLSQP", bounds=[(LEAST_WEIGHT, 1.0)] * count,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0, "jac": lambda w: np.ones(count)},
        options={"ftol": 1e-10, "maxiter": 60},
    )  # fmt: skip
    weights = np.clip(found.x, LEAST_WEIGHT, 1.0)
    return np.asarray(weights / weights.sum() if found.fun <= 1.0 else start)
