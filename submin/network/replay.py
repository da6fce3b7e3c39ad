"""A sub-MIN against an independent computation from its rays: the health of a factorisation in one number.

The sub-MIN comes from summed normal equations, points eliminated by Gram-Schmidt, and one Cholesky factor. The replay never forms normal
equations: points are eliminated by singular values, and ``(I + K' A'(I - QQ')A K) v = K' g`` is solved by iterative refinement, whose
residuals come from the rays themselves. What both say of a few random combinations of points, ``c' P c``, and of the corrections differs
by the round-off of the sub-MIN (docs/mathematics.md, "Round-off and replay").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, PointFactors
from submin.adjustment.point_basis import ROUND_OFF

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

REFINEMENTS = 5
"""Steps of refinement: each gains the digits that the factor has, so that the second already leaves round-off only."""


def joined(parts: Sequence[LinearRays]) -> LinearRays:
    """The rays of several cells, points one cell after another; ``image`` must mean the same in all of them."""
    shifts = np.cumsum([0, *(part.first[-1] for part in parts)])
    first = np.concatenate([np.zeros(1, dtype=np.int64), *(part.first[1:] + s for part, s in zip(parts, shifts, strict=False))])
    return LinearRays(first, *(np.concatenate([getattr(part, name) for part in parts]) for name in _RAYS))


_RAYS = ("image", "by_ground", "by_parameters", "y")


@dataclass(frozen=True)
class _Eliminated:
    """Accepted rays with an orthonormal basis of what their points explain: groups of points with equally many rays.

    ``groups`` : (g, k) rows of the rays, (g, 2 k, 3) basis, zero in directions that the rays do not determine
    """

    linear: LinearRays
    images: int
    groups: tuple[tuple[Rows, Array], ...]

    @classmethod
    def of(cls, linear: LinearRays, weight: Array, images: int) -> _Eliminated:
        point = np.repeat(np.arange(len(linear.first) - 1), np.diff(linear.first))
        rays = np.flatnonzero(weight > 0.0)
        _, start, count = np.unique(point[rays], return_index=True, return_counts=True)
        groups = []
        for k in np.unique(count).tolist():
            rows = rays[start[count == k][:, None] + np.arange(k)]
            u, s, _ = np.linalg.svd(linear.by_ground[rows].reshape(len(rows), 2 * k, 3), full_matrices=False)
            basis = np.zeros((len(rows), 2 * k, 3))
            basis[:, :, : s.shape[1]] = u * (s > ROUND_OFF * s[:, :1])[:, None, :]
            groups.append((rows, basis))
        return cls(linear, images, tuple(groups))

    def left(self, values: Array) -> Array:
        """``(I - QQ')`` of values (r, 2) of the rays; zero for rejected rays."""
        out = np.zeros_like(values)
        for rows, basis in self.groups:
            flat = values[rows].reshape(len(rows), -1, 1)
            out[rows] = (flat - basis @ (np.swapaxes(basis, 1, 2) @ flat)).reshape(*rows.shape, 2)
        return out

    def on_images(self, values: Array) -> Array:
        """``A'`` of values (r, 2): (m p,)."""
        p = self.linear.by_parameters.shape[2]
        out = np.zeros((self.images, p))
        np.add.at(out, self.linear.image, np.einsum("rcp,rc->rp", self.linear.by_parameters, values))
        return out.ravel()

    def information(self, theta: Array) -> Array:
        """``A'(I - QQ')A theta`` for corrections (m p,)."""
        moved = np.einsum("rcp,rp->rc", self.linear.by_parameters, theta.reshape(self.images, -1)[self.linear.image])
        return self.on_images(self.left(moved))


def _solved(rays: _Eliminated, prior: sp.csr_array, factor: Array, right: Array) -> Array:
    """``Lambda^-1 right`` for whitened vectors (q,), refined by residuals that come from the rays."""
    v = np.zeros_like(right)
    for _ in range(REFINEMENTS):
        residual = right - v - prior.T @ rays.information(prior @ v)
        step, _ = la.lapack.dpotrs(factor, residual, lower=1)
        v = v + step
    return v


def replay_error(
    linear: LinearRays, weight: Array, factors: PointFactors, theta: Array, covariance: Array, prior: sp.csr_array, factor: Array,
    combinations: Sequence[tuple[Rows, Array]],
) -> float:  # fmt: skip
    """Largest relative difference between a sub-MIN and its replay.

    Parameters
    ----------
    linear, weight, factors : all rays of the tile (``image``: rows of its m images), weights (r,) 0 or 1, and the points' own parts
    theta, covariance : the sub-MIN's (m, p) and (m p, m p)
    prior, factor : a priori factor K (m p, q); a Cholesky factor (q, q) near that of the information, which only guides the refinement
    combinations : rows (k,) of determined points with coefficients (k, 3), each a functional c

    Returns
    -------
    float
        Of ``c' P c``, relative; of the corrections, in their standard deviations.
    """
    rays, p = _Eliminated.of(linear, weight, len(theta)), theta.shape[1]
    worst = 0.0
    if prior.shape[1]:
        replayed = prior @ _solved(rays, prior, factor, prior.T @ rays.on_images(rays.left(linear.y)))
        sigma = np.sqrt(np.clip(np.diagonal(covariance), 0.0, None))
        moves = sigma > 0.0
        worst = float(np.abs((theta.ravel() - replayed)[moves] / sigma[moves]).max(initial=0.0))
    for points, coefficients in combinations:
        claimed, replayed_own = 0.0, 0.0
        on_images, by_sums = np.zeros((len(linear.image), 2)), np.zeros(theta.size)
        for j, c in zip(points.tolist(), coefficients, strict=True):
            at = np.arange(linear.first[j], linear.first[j + 1])
            at = at[weight[at] > 0.0]
            # c'(B'B)^-1 B', which is zero where c has no part in what the rays determine
            on_rays = np.linalg.pinv(linear.by_ground[at].reshape(-1, 3), rcond=ROUND_OFF).T @ c
            replayed_own += float(on_rays @ on_rays)
            on_images[at] -= on_rays.reshape(-1, 2)
            claimed += float(c @ factors.own[j] @ c)
            for r in at:
                by_sums[linear.image[r] * p : linear.image[r] * p + p] += c @ factors.loading[r]
        claimed += float(by_sums @ covariance @ by_sums)
        right = prior.T @ rays.on_images(on_images)
        replayed_variance = replayed_own + (float(right @ _solved(rays, prior, factor, right)) if prior.shape[1] else 0.0)
        worst = max(worst, abs(claimed - replayed_variance) / replayed_variance)
    return worst
