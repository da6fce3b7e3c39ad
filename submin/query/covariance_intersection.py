"""Policy ``ci``: Covariance Intersection of all tiles concerned at once, in the space of image parameters.

Every tile is brought to the union of the images by padding with the prior: an image that it does not see has its a priori state there. With
``Lambda_t = I + K' S_t K`` of the padded tiles and weights on the simplex,

    Lambda(w) = sum_t w_t Lambda_t = I + K' (sum_c omega_c S_c) K,     omega_c = sum of w_t over the tiles that hold cell c

which counts no cell more than once whatever the tiles share, so ``P = D + U M(w) U'`` is consistent for all points jointly
(docs/mathematics.md, "Covariance Intersection and bounded inflation in parameter space"). The weights minimise the trace of the covariance
of the queried points, a convex function of w.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.optimize import minimize

from submin.adjustment.estimation import cholesky
from submin.network.sub_min import GroundPart, SubMin
from submin.query.padded_tiles import padded_tiles
from submin.query.source import Index, NetworkSource
from submin.query.tile_pair import TilePair, axes_of_both, weights_of_two

Array = NDArray[np.float64]

CERTIFICATE = 1e-6
"""The weights are optimal when no tile's share of the trace exceeds the whole by more than this part (Kuhn-Tucker condition)."""


def estimate(source: NetworkSource, tiles: Sequence[int], images: Index, parts: Sequence[GroundPart]) -> SubMin:
    """A posteriori state of all images that the tiles see, by Covariance Intersection with weights best for the points of ``parts``.

    Of two tiles, which are what most queries across a border concern, that of ``images`` alone.
    """
    if len(tiles) == 2:
        pair = source.kept(("pair", tuple(tiles)), lambda: TilePair.of(padded_tiles(source, tiles)))
        return pair.state(pair.weights(pair.squares(parts)), images)
    padded = padded_tiles(source, tiles)
    weights = np.ones(1) if len(tiles) == 1 else intersection_weights(padded.of_tiles, padded.functionals(parts))
    return padded.weighted(padded.holds @ weights, 1.0)


def intersection_weights(information: Array, functionals: Array) -> Array:
    """Weights (t,) on the simplex that minimise the trace of ``F (sum_t w_t J_t)^-1 F'``.

    Parameters
    ----------
    information : (t, q, q) information matrices J_t of the estimates; functionals : (q, q) ``F'F``, F being what the trace is taken of
    """
    count = len(information)
    if count == 2:
        share, axes = axes_of_both(*information)
        return weights_of_two(share, np.einsum("ij,ij->j", axes, functionals @ axes))

    def shares(weights: Array) -> tuple[float, Array]:
        """The trace, and ``tr(P F'F P J_t)`` of each tile: minus the trace's derivative."""
        lower = cholesky(np.tensordot(weights, information, axes=1))
        half, _ = la.lapack.dpotrs(lower, np.asfortranarray(functionals), lower=1)
        whole, _ = la.lapack.dpotrs(lower, np.asfortranarray(half.T), lower=1)
        return float(np.trace(half)), np.einsum("ij,tij->t", whole, information)

    start = np.full(count, 1.0 / count)
    scale = shares(start)[0]

    def objective(weights: Array) -> tuple[float, Array]:
        trace, gradient = shares(np.clip(weights, 0.0, None))
        return trace / scale, -gradient / scale

    found = minimize(
        objective, start, jac=True, method="SLSQP", bounds=[(0.0, 1.0)] * count,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0, "jac": lambda w: np.ones(count)},
        options={"ftol": 1e-14, "maxiter": 200},
    )  # fmt: skip
    weights = np.clip(found.x, 0.0, None)
    weights /= weights.sum()
    for _ in range(200):  # multiplicative steps, each of which lowers the trace, until the certificate holds
        trace, share = shares(weights)
        if share.max() <= (1.0 + CERTIFICATE) * trace:
            break
        weights = weights * np.sqrt(share / trace)
        weights /= weights.sum()
    return np.asarray(weights)
