"""True error covariance of merged estimates, in closed form.

Every policy's estimate of the whitened image parameters u is a sum over independent sources: the classes of cells of `PaddedTiles`, whose
right-hand sides are ``h_c = S_c u + n_c`` with ``Cov n_c = S_c``, and the priors. With gains G_c its error is

    e = sum_c G_c n_c - G_0 u,     G_0 = I - sum_c G_c S_c

so the covariance of the errors of any two such estimates, of one policy or of two, is ``G_0 H_0' + sum_c G_c S_c H_c'``. A point adds its
own part D, which is independent of all estimates of u and the same in all of them (docs/mathematics.md, "Factored form").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.query.bounded_inflation import correlation_bounds, inflation
from submin.query.covariance_intersection import intersection_weights
from submin.query.padded_tiles import PaddedTiles
from submin.query.split_intersection import blend, split_weights

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearEstimate:
    """An estimate of u (q,) and what it claims.

    Attributes
    ----------
    of_class : (c, q, q) gains G_c; of_prior : (q, q) G_0
    claimed : (q, q) covariance that it states
    """

    of_class: Array
    of_prior: Array
    claimed: Array

    def solution(self, padded: PaddedTiles) -> Array:
        """The estimate itself (q,)."""
        return np.asarray(np.einsum("cij,cj->i", self.of_class, padded.vector))


def cross_covariance(padded: PaddedTiles, one: LinearEstimate, other: LinearEstimate) -> Array:
    """Covariance (q, q) of the errors of two estimates; of one with itself its true covariance."""
    total = one.of_prior @ other.of_prior.T
    for mine, information, theirs in zip(one.of_class, padded.information, other.of_class, strict=True):
        total += mine @ information @ theirs.T
    return np.asarray(total)


def weighted(padded: PaddedTiles, of_class: Array, of_prior: float) -> LinearEstimate:
    """The estimate of weighted classes and priors, as `PaddedTiles.weighted`: its claim is the inverse of what it has added."""
    information = np.tensordot(of_class, padded.information, axes=1)
    information[np.diag_indices(len(information))] += of_prior
    covariance = la.cho_solve(la.cho_factor(information, lower=True), np.eye(len(information)))
    covariance = 0.5 * (covariance + covariance.T)
    return LinearEstimate(of_class[:, None, None] * covariance, of_prior * covariance, covariance)


def alone(padded: PaddedTiles, tile: int) -> LinearEstimate:
    """One of the tiles by itself."""
    return weighted(padded, padded.holds[:, tile].astype(np.float64), 1.0)


def naive(padded: PaddedTiles, functionals: Array) -> LinearEstimate:
    """All tiles' answers merged as if they were independent: what they share counts as often as it is shared. No policy of submin."""
    return weighted(padded, padded.holds.sum(axis=1).astype(np.float64), float(padded.holds.shape[1]))


def intersected(padded: PaddedTiles, functionals: Array) -> LinearEstimate:
    """Policy ``ci``."""
    return weighted(padded, padded.holds @ intersection_weights(padded.of_tiles, functionals), 1.0)


def inflated(padded: PaddedTiles, functionals: Array) -> LinearEstimate:
    """Policy ``bci``, for more points than one."""
    scale = inflation(padded.of_tiles, correlation_bounds(padded), functionals)
    return weighted(padded, padded.holds @ (1.0 / scale), float((1.0 / scale).sum()))


def split(padded: PaddedTiles, functionals: Array) -> LinearEstimate:
    """Policy ``split``."""
    weights = split_weights(padded, functionals)
    of_tile = [la.solve(blend(padded, weights, t), own, assume_a="pos").T for t, own in enumerate(padded.of_tiles)]  # Lambda_t B_t^-1
    information = sum(gain @ own for gain, own in zip(of_tile, padded.of_tiles, strict=True))
    covariance = la.inv(0.5 * (information + information.T))
    gains = np.stack([covariance @ gain for gain in of_tile])
    return LinearEstimate(
        np.tensordot(padded.holds.astype(np.float64), gains, axes=1), gains.sum(axis=0), 0.5 * (covariance + covariance.T)
    )


def together(padded: PaddedTiles, functionals: Array) -> LinearEstimate:
    """Policy ``rigorous``: every cell once, the priors once."""
    return weighted(padded, np.ones(len(padded.holds)), 1.0)


MERGED: dict[str, Callable[[PaddedTiles, Array], LinearEstimate]] = {
    "naive": naive,
    "ci": intersected,
    "bci": inflated,
    "split": split,
    "rigorous": together,
}
"""How tiles are merged, by policy; the second argument is ``F'F`` of `PaddedTiles.functionals`."""
