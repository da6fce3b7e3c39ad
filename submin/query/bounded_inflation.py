"""Policy ``bci``: bounded covariance inflation. As much independence as the network can prove, and no more.

Of two estimates whose errors have canonical correlations of at most rho, ``(1 + rho r) A`` and ``(1 + rho / r) B`` are a joint bound for
any r > 0. Tiles know what they share, so rho is known: the norm of the whitened cross-covariance of exactly what is fused
(docs/mathematics.md, "Bounded covariance inflation"). With weights w on the simplex and ``r_ts = w_s / w_t``, tile t is scaled by

    c_t = 1 + sum_s rho_ts w_s / w_t

which is Covariance Intersection where rho is 1, and independent fusion where it is 0. A whole tile pair mostly has rho = 1: what both hold
in common and nobody else sees is the same number in both. Single points have less, so a point asked for alone is fused as a 3-vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.optimize import minimize

from submin.adjustment.estimation import cholesky
from submin.network.sub_min import GroundPart, SubMin, loadings
from submin.query.covariance_intersection import intersection_weights
from submin.query.padded_tiles import PaddedTiles, cross_information, padded_tiles
from submin.query.source import Index, NetworkSource

Array = NDArray[np.float64]

ROUND_OFF = 1e-9
"""Added to a computed correlation bound, which must not be below the true one."""


def estimate(source: NetworkSource, tiles: Sequence[int], images: Index, parts: Sequence[GroundPart]) -> SubMin:
    """A posteriori state of the images by bounded inflation; for a point asked for alone the tighter one of that and its own fusion."""
    padded = padded_tiles(source, tiles)
    scale = inflation(padded.of_tiles, correlation_bounds(padded), padded.functionals(parts))
    whole = padded.weighted(padded.holds @ (1.0 / scale), float((1.0 / scale).sum()))
    if len(tiles) == 1 or sum(len(part.origin) for part in parts) > 1:
        return whole
    alone = _of_one_point(padded, parts)
    seen = loadings(parts, padded.rows, padded.images.parameters)
    return min(whole, alone, key=lambda state: float((seen @ state.covariance @ seen.T).trace()))


def correlation_bounds(padded: PaddedTiles) -> Array:
    """Bounds (t, t) of the canonical correlations of the tiles' estimates of all images."""
    count = len(padded.factors)
    bounds = np.eye(count)
    for s, t in combinations(range(count), 2):
        bounds[s, t] = bounds[t, s] = _bound(cross_information(padded, s, t))
    return bounds


def _bound(cross: Array) -> float:
    """Largest canonical correlation, not below the true one."""
    return min(1.0, float(la.svdvals(cross)[0]) + ROUND_OFF)


def inflation(information: Array, correlation: Array, functionals: Array) -> Array:
    """Factors c (t,) by which the covariances of t estimates are inflated, so that they may be fused as if they were independent.

    The weights are those of Covariance Intersection, improved as long as the trace of ``F (sum_t J_t / c_t)^-1 F'`` falls: never looser.

    Parameters
    ----------
    information : (t, q, q) J_t; correlation : (t, t) bounds rho of their canonical correlations; functionals : (q, q) ``F'F``
    """
    count = len(information)
    start = intersection_weights(information, functionals) if count > 1 else np.ones(1)
    others = correlation - np.diag(np.diag(correlation))

    def factors(weights: Array) -> Array:
        return np.asarray(1.0 + others @ weights / np.maximum(weights, 1e-300))

    def trace(weights: Array) -> float:
        lower = cholesky(np.tensordot(1.0 / factors(weights), information, axes=1))
        solved, _ = la.lapack.dpotrs(lower, np.asfortranarray(functionals), lower=1)
        return float(np.trace(solved))

    if count == 1 or others[np.triu_indices(count, 1)].min() >= 1.0:  # nothing is known to be independent
        return factors(start)
    least = trace(start)

    def objective(free: Array) -> float:  # logarithms of the weights against the last one, within what matters
        return trace(np.exp(np.append(np.clip(free, -12.0, 12.0), 0.0))) / least

    found = minimize(objective, np.zeros(count - 1), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-9})
    return factors(np.exp(np.append(np.clip(found.x, -12.0, 12.0), 0.0)) if found.fun < 1.0 else start)


def _of_one_point(padded: PaddedTiles, parts: Sequence[GroundPart]) -> SubMin:
    """The 3-vector ``U u`` of one point fused by itself, as a state of the images that gives exactly this for the point.

    Fused on the images the point would be inflated for functionals that nobody asked for.
    """
    seen, information, correlation = seen_point(padded, parts)
    scale = inflation(information, correlation, np.eye(3))
    covariance = la.inv(_symmetric(np.tensordot(1.0 / scale, information, axes=1)))
    vector = padded.holds.T.astype(np.float64) @ padded.vector  # K' h_t of each tile
    fused = covariance @ sum(information[t] @ (seen[t].T @ vector[t]) / scale[t] for t in range(len(scale)))
    # u = G (U u) with U G = I: any state of the images that says this of the point, and of nothing else
    gain = seen[0] @ information[0]
    theta = np.asarray(padded.prior @ (gain @ fused)).reshape(len(padded.rows), -1)
    spread = padded.prior @ gain
    return SubMin(padded.rows, theta, np.asarray(spread @ covariance @ spread.T), float("nan"), 0)


def seen_point(padded: PaddedTiles, parts: Sequence[GroundPart]) -> tuple[list[Array], Array, Array]:
    """What the tiles say of the 3-vector ``U u`` of one point.

    Returns
    -------
    ``M_t U'`` (q, 3) of each tile, the information (t, 3, 3) about the vector, and bounds (t, t) of the canonical correlations.
    """
    loading = (loadings(parts, padded.rows, padded.images.parameters) @ padded.prior).toarray()
    count = len(padded.factors)
    seen = [la.cho_solve((lower, True), loading.T) for lower in padded.factors]
    information = np.stack([la.inv(_symmetric(loading @ of_tile)) for of_tile in seen])
    roots = [la.cholesky(of_tile) for of_tile in information]  # upper R, R'R = (U M_t U')^-1
    correlation = np.eye(count)
    for s, t in combinations(range(count), 2):
        cross = roots[s] @ (seen[s].T @ padded.common(s, t) @ seen[t]) @ roots[t].T
        correlation[s, t] = correlation[t, s] = _bound(cross)
    return seen, information, correlation


def _symmetric(matrix: Array) -> Array:
    return np.asarray(0.5 * (matrix + matrix.T))
