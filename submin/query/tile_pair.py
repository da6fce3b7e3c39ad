"""Two padded tiles in the axes that diagonalise both: every weighted intersection of theirs is then a sum of scaled squares.

With ``Lambda_1 + Lambda_2 = L L'`` and ``L^-1 Lambda_2 L^-T = V diag(mu) V'``, the columns of ``B = L^-T V`` are such axes:

    B' Lambda_1 B = diag(1 - mu),    B' Lambda_2 B = diag(mu)
    ((1 - w) Lambda_1 + w Lambda_2)^-1 = B diag(1 / d) B',    d = (1 - w)(1 - mu) + w mu

One factorisation serves every question to the pair (docs/mathematics.md, "Covariance Intersection
and bounded inflation in parameter space").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import brentq

from submin.adjustment.estimation import cholesky
from submin.network.sub_min import GroundPart, SubMin, loadings
from submin.query.padded_tiles import PaddedTiles
from submin.query.source import Index

Array = NDArray[np.float64]

ROUND_OFF = 1e-15
"""No share is nearer to 0 or 1."""


@dataclass(frozen=True, eq=False)
class TilePair:
    """Two tiles in their common axes.

    Attributes
    ----------
    rows : (m,) rows of the network's images, ascending
    reach : (m p, q) ``K B``: the image parameters along the axes
    share : (q,) mu, what the second tile has of the information along each axis
    vector : (2, q) ``B' K' h_t``
    """

    rows: Index
    reach: Array
    share: Array
    vector: Array

    @classmethod
    def of(cls, padded: PaddedTiles) -> TilePair:
        """The axes of two padded tiles."""
        share, axes = axes_of_both(padded.common(0), padded.common(1))
        # neither tile knows less than the priors, whatever round-off says: Lambda >= I
        least = np.einsum("ij,ij->j", axes, axes)
        vector = padded.holds.T.astype(np.float64) @ padded.vector
        return cls(padded.rows, np.ascontiguousarray(padded.prior @ axes), np.clip(share, least, 1.0 - least), vector @ axes)

    @property
    def parameters(self) -> int:
        """Parameters p of an image."""
        return len(self.reach) // len(self.rows)

    def squares(self, parts: Sequence[GroundPart]) -> Array:
        """Sums of squares (q,) of the coordinates of some points along each axis: the trace of their covariance is ``sum squares / d``."""
        seen = loadings(parts, self.rows, self.parameters)
        if seen.shape[0] <= seen.shape[1]:
            along = seen @ self.reach
            return np.asarray(np.einsum("ij,ij->j", along, along))
        return np.asarray(np.einsum("ij,ij->j", self.reach, sp.csr_array(seen.T @ seen) @ self.reach))

    def information(self, weights: Array) -> Array:
        """Information d (q,) along each axis with weights (2,) of the tiles."""
        return np.asarray(weights[0] * (1.0 - self.share) + weights[1] * self.share)

    def weights(self, squares: Array) -> Array:
        """Weights (2,) on the simplex by which the trace ``sum squares / d`` is least."""
        return weights_of_two(self.share, squares)

    def state(self, weights: Array, images: Index) -> SubMin:
        """Those images that are among ``images`` (ascending), from both tiles with weights (2,). A merge has no chi-square."""
        chosen, p = np.flatnonzero(np.isin(self.rows, images)), self.parameters
        reach = self.reach[(chosen[:, None] * p + np.arange(p)).ravel()]
        information = self.information(weights)
        theta = reach @ ((weights @ self.vector) / information)
        half = reach / np.sqrt(information)
        return SubMin(self.rows[chosen], theta.reshape(len(chosen), p), half @ half.T, float("nan"), 0, behind=self.rows)


def axes_of_both(first: Array, second: Array) -> tuple[Array, Array]:
    """Shares mu (q,) and axes B (q, q), by columns, of two information matrices: ``B' second B = diag(mu)``, ``B' first B = diag(1 - mu)``.

    Raises
    ------
    NumericalError
        When their sum is not positive definite.
    """
    lower = cholesky(first + second)
    half = la.solve_triangular(lower, second, lower=True)
    share, axes = la.eigh(la.solve_triangular(lower, half.T, lower=True), overwrite_a=True, driver="evd")
    return np.clip(share, ROUND_OFF, 1.0 - ROUND_OFF), la.solve_triangular(lower, axes, lower=True, trans=1, overwrite_b=True)


def weights_of_two(share: Array, squares: Array) -> Array:
    """Weights (2,) on the simplex by which ``sum squares / ((1 - w)(1 - share) + w share)``, a convex function of them, is least."""

    def slope(second: float) -> float:
        return float(squares @ ((1.0 - 2.0 * share) / ((1.0 - second) * (1.0 - share) + second * share) ** 2))

    if slope(0.0) >= 0.0:
        return np.array([1.0, 0.0])
    second = 1.0 if slope(1.0) <= 0.0 else float(brentq(slope, 0.0, 1.0, xtol=1e-12))
    return np.array([1.0 - second, second])
