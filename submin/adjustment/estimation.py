"""From summed information and an a priori model to the images' corrections and their covariance: one Cholesky factorisation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.symmetric import between, fill_symmetric, transposed_times
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
        return covariance_of(self.factor.copy(order="F"), self.prior)

    @property
    def variance(self) -> Array:
        """Variances (m, p) of ``theta``, the diagonal of M; raises as `covariance`."""
        return np.diagonal(self.covariance).reshape(self.theta.shape)


def covariance_of(factor: Array, prior: sp.csr_array) -> Array:
    """``M = K (L L')^-1 K'`` (m p, m p), both triangles, of the Cholesky factor L (Fortran order) of the information and a priori factor K.

    L is overwritten by the inverse: at most two matrices of this size exist at a time.

    Raises
    ------
    NumericalError
        When the factor is not that of a regular matrix.
    """
    if not len(factor):
        return np.zeros((prior.shape[0], prior.shape[0]))
    inverse, info = la.lapack.dpotri(factor, lower=1, overwrite_c=1)
    if info != 0:
        raise NumericalError(f"the information matrix ({len(factor)} parameters) cannot be inverted")
    return between(prior, fill_symmetric(np.asarray(inverse)).T)  # the transpose is in C order, and the same


def reduced_information(information: Array, prior: sp.csr_array) -> Array:
    """``I + K' S K`` (q, q), both triangles, for summed information S (lower triangle) and a priori factor K."""
    total = between(prior, fill_symmetric(information.copy()), transposed=True)
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
    right = transposed_times(prior, sums.vector)
    u, _ = la.lapack.dpotrs(factor, right, lower=1)
    theta = np.asarray(prior @ u).reshape(-1, parameters)
    # f + |u|^2 at the minimum equals f - h'theta
    return ImageEstimate(theta, u, float(sums.misclosure - sums.vector @ theta.ravel()), factor, prior)
