"""Several tiles brought to one vector of image parameters, and what they share.

A tile that does not see an image has its a priori state there: with whitened parameters u and the a priori factor K of all images that any
of the tiles sees, ``Lambda_t = I + K' S_t K``. The errors of the estimates ``u_t = Lambda_t^-1 K' h_t`` come from the priors, common to all
tiles, and from the rays of cells. Cells of the same holders among the tiles are one *class*; different classes are independent. So

    Cov(u_s, u_t) = Lambda_s^-1 Lambda_st Lambda_t^-1,     Lambda_st = I + K' (sum of the classes that both hold) K

in closed form (docs/mathematics.md, "Cross-covariance of two tiles").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.estimation import cholesky, reduced_information
from submin.adjustment.images import ImageSet
from submin.network.sub_min import GroundPart, SubMin, add_sums, loadings
from submin.query.source import Index, NetworkSource, existing_cells

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PaddedTiles:
    """Information of some tiles about the whitened parameters u (q,) of all images that any of them sees.

    Attributes
    ----------
    rows : (m,) rows of the network's images, ascending
    images : these images
    holds : (c, t) True where a tile holds the cells of a class
    information : (c, q, q) ``K' S_c K`` of each class, both triangles, without the priors
    vector : (c, q) ``K' h_c``
    """

    rows: Index
    images: ImageSet
    holds: Flags
    information: Array
    vector: Array

    @property
    def prior(self) -> sp.csr_array:
        """A priori factor K (m p, q)."""
        return self.images.prior

    def common(self, *tiles: int) -> Array:
        """``I + K' S K`` (q, q) over the classes that all of these tiles (by their place) hold; of one tile its own ``Lambda_t``."""
        held = self.holds[:, list(tiles)].all(axis=1)
        total = self.information[held].sum(axis=0)
        total[np.diag_indices(len(total))] += 1.0
        return np.asarray(total)

    @cached_property
    def of_tiles(self) -> Array:
        """``Lambda_t`` (t, q, q)."""
        return np.stack([self.common(t) for t in range(self.holds.shape[1])])

    @cached_property
    def factors(self) -> tuple[Array, ...]:
        """Lower Cholesky factors of ``Lambda_t``."""
        return tuple(np.tril(cholesky(of_tile.copy())) for of_tile in self.of_tiles)

    def functionals(self, parts: Sequence[GroundPart]) -> Array:
        """``F'F`` (q, q), F being the loadings of all coordinates of some points on u: their trace is ``tr(F P_u F')``."""
        seen = loadings(parts, self.rows, self.images.parameters) @ self.prior
        return np.asarray((seen.T @ seen).todense())

    def weighted(self, of_class: Array, of_prior: float) -> SubMin:
        """Images from classes and priors with weights: information ``of_prior I + K' sum_c of_class_c S_c K``, a claim as it stands."""
        information = np.tensordot(of_class, self.information, axes=1)
        information[np.diag_indices(len(information))] += of_prior
        return self.state(information, of_class @ self.vector)

    def state(self, information: Array, vector: Array) -> SubMin:
        """Images from information about u (q, q), overwritten, and its right-hand side (q,). A merge by weights has no chi-square."""
        lower = cholesky(information)
        theta = np.asarray(self.prior @ la.cho_solve((lower, True), vector)).reshape(len(self.rows), -1)
        half = la.solve_triangular(lower, self.prior.toarray().T, lower=True, overwrite_b=True)
        return SubMin(self.rows, theta, half.T @ half, float("nan"), 0)


def padded_tiles(source: NetworkSource, tiles: Sequence[int]) -> PaddedTiles:
    """Bring some tiles to the union of the images that they see."""
    cells = existing_cells(source, tiles)
    sums = source.some_sums(cells)
    rows = np.unique(np.concatenate([of_cell for of_cell, _ in sums])).astype(np.int32)
    images = source.image_set(rows)
    held = np.array([[tile in source.cover.holders(cell) for tile in tiles] for cell in cells])
    holds, of_cell = np.unique(held, axis=0, return_inverse=True)
    by_class = [add_sums([sums[k] for k in np.flatnonzero(of_cell.ravel() == c)], rows, images.parameters) for c in range(len(holds))]
    information = np.stack([reduced_information(s.information, images.prior) for s in by_class])
    information[:, np.arange(information.shape[1]), np.arange(information.shape[1])] -= 1.0
    return PaddedTiles(rows, images, holds, information, np.stack([images.prior.T @ s.vector for s in by_class]))


def cross_information(padded: PaddedTiles, one: int, other: int) -> Array:
    """Whitened cross-covariance ``L_s^-1 Lambda_st L_t^-T`` (q, q) of two estimates: its singular values are their correlations."""
    half = la.solve_triangular(padded.factors[one], padded.common(one, other), lower=True)
    return np.asarray(la.solve_triangular(padded.factors[other], half.T, lower=True).T)
