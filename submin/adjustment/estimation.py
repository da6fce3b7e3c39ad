"""From summed information and an a priori model to the images' corrections and their covariance: one Cholesky factorisation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.errors import NumericalError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImageEstimate:
    """A posteriori image parameters.

    Attributes
    ----------
    theta : (m, p) corrections
    whitened : (q,) the same as whitened vectors, ``theta = K u``
    chi_square : weighted sum of squares of residuals, a priori model included
    factor : (q, q) lower Cholesky factor of the information about the whitened vectors u
    prior : (m p, q) a priori factor K
    """

    theta: Array
    whitened: Array
    chi_square: float
    factor: Array
    prior: sp.csr_array

    @cached_property
    def covariance(self) -> Array:
        """Covariance M (m p, m p) of ``theta``, both triangles; made when first asked for, since most iterations do not need it.

        Raises
        ------
        NumericalError
            When the factor is not that of a regular matrix.
        """
        if not len(self.factor):
            return np.zeros((self.prior.shape[0], self.prior.shape[0]))
        inverse, info = la.lapack.dpotri(self.factor, lower=1)
        if info != 0:
            raise NumericalError(f"the information matrix ({len(self.factor)} parameters) cannot be inverted")
        rows, factor = adjustable_part(self.prior)
        covariance = np.asarray(factor @ (factor @ fill_symmetric(np.asarray(inverse))).T)
        if len(rows) == self.prior.shape[0]:
            return covariance
        whole = np.zeros((self.prior.shape[0], self.prior.shape[0]))
        whole[np.ix_(rows, rows)] = covariance
        return whole


DENSE_SIZE = 200
"""Up to so many parameters a dense product with the a priori factor costs less than looking up its few entries."""
DENSE_PART = 0.05
"""So does it where so large a part of the entries is not zero: correlated control, whose shifts all depend on one another."""
MIRROR_BLOCK = 256


def fill_symmetric(lower: Array) -> Array:
    """The full symmetric matrix of a lower triangle, in place, block by block (a whole transpose would miss the cache)."""
    size = len(lower)
    for start in range(0, size, MIRROR_BLOCK):
        stop = min(start + MIRROR_BLOCK, size)
        square = lower[start:stop, start:stop]
        square[...] = np.tril(square) + np.tril(square, -1).T  # what LAPACK left above the diagonal must not take part
        lower[start:stop, stop:] = lower[stop:, start:stop].T
    return lower


def adjustable_part(prior: sp.csr_array) -> tuple[NDArray[np.int64], sp.csr_array | Array]:
    """Rows of an a priori factor K that are not zero, and these of K, dense where that costs less.

    The others are padding: parameters that an image's sensor does not have, or that are held.
    """
    rows = np.flatnonzero(np.diff(prior.indptr))
    factor = prior if len(rows) == prior.shape[0] else prior[rows]
    dense = len(rows) <= DENSE_SIZE or factor.nnz > DENSE_PART * factor.shape[0] * factor.shape[1]
    return rows, factor.toarray() if dense else factor


def reduced_information(information: Array, prior: sp.csr_array) -> Array:
    """``I + K' S K`` (q, q), for summed information S (lower triangle) and a priori factor K."""
    rows, factor = adjustable_part(prior)
    full = fill_symmetric(information.copy() if len(rows) == len(information) else information[np.ix_(rows, rows)])
    if isinstance(factor, np.ndarray):
        total = factor.T @ (full @ factor)
        total[np.diag_indices(len(total))] += 1.0
        return np.asarray(total)
    half = factor.T @ full
    total = np.asarray((factor.T @ np.ascontiguousarray(half.T)).T)
    total[np.diag_indices(len(total))] += 1.0
    return total


def cholesky(matrix: Array) -> Array:
    """Lower Cholesky factor, in place (Fortran order, upper triangle undefined); `NumericalError` when not positive definite."""
    factor, info = la.lapack.dpotrf(matrix.T, lower=1, overwrite_a=1, clean=0)
    if info != 0:
        raise NumericalError(
            f"the information matrix ({len(matrix)} parameters) is not positive definite at row {info - 1}; a sum of cells is damaged"
        )
    if not np.isfinite(np.diagonal(factor)).all():  # LAPACK does not look for NaN
        raise NumericalError(f"the information matrix ({len(matrix)} parameters) is not finite; a camera or a measurement is not")
    return np.asarray(factor)


def estimate_images(sums: Sums, prior: sp.csr_array, parameters: int) -> ImageEstimate:
    """Estimate the images from their summed information and a priori factor.

    ``Lambda = I + K' S K``, ``u = Lambda^-1 K' h``, ``theta = K u``, ``M = K Lambda^-1 K'``.

    Raises
    ------
    NumericalError
        When the information is not positive definite, which sound sums never are.
    """
    if not np.isfinite(sums.vector).all():
        raise NumericalError(f"the right-hand side of {len(sums.vector)} image parameters is not finite; a camera or a position is not")
    if not prior.shape[1]:  # only images that have nothing to adjust
        return ImageEstimate(np.zeros((len(sums.vector) // parameters, parameters)), np.empty(0), sums.misclosure, np.empty((0, 0)), prior)
    factor = cholesky(reduced_information(sums.information, prior))
    right = prior.T @ sums.vector
    u, _ = la.lapack.dpotrs(factor, right, lower=1)
    theta = np.asarray(prior @ u).reshape(-1, parameters)
    # f + |u|^2 at the minimum equals f - h'theta
    return ImageEstimate(theta, u, float(sums.misclosure - sums.vector @ theta.ravel()), factor, prior)
