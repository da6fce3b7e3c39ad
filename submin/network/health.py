"""How far sums and sub-MINs are from what they should be, on scales on which round-off is of the order of 1e-16.

A difference of sums is judged against the same sums of absolute values, since that is what round-off is part of: an element of A'A
against the lengths of its two columns. A difference of covariances is judged against the two standard deviations.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, Sums
from submin.adjustment.estimation import fill_symmetric
from submin.network.sub_min import SubMin

Array = NDArray[np.float64]


def sums_difference(stored: Sums, made: Sums, linear: LinearRays, weight: Array, images: int) -> float:
    """Relative difference between stored sums of a cell and sums made anew from its rays (weights (r,), ``images`` images)."""
    p = linear.by_parameters.shape[2]
    squares = np.zeros((images, p))
    np.add.at(squares, linear.image, weight[:, None] * np.einsum("rcp,rcp->rp", linear.by_parameters, linear.by_parameters))
    column = np.sqrt(squares).ravel()
    column[column == 0.0] = 1.0
    right = float(np.sqrt((weight[:, None] * linear.y**2).sum())) or 1.0
    difference = np.abs(np.tril(stored.information - made.information)) / column[:, None] / column
    vector = np.abs(stored.vector - made.vector) / (column * right)
    misclosure = abs(stored.misclosure - made.misclosure) / (max(right * np.sqrt(made.misclosure), made.misclosure) or 1.0)
    return float(max(difference.max(initial=0.0), vector.max(initial=0.0), misclosure))


def sub_min_difference(stored: SubMin, made: SubMin) -> float:
    """Difference between two sub-MINs of the same images: of corrections in standard deviations, of covariances relative to two of them."""
    sigma = np.sqrt(np.clip(np.diagonal(made.covariance), 0.0, None))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    theta = np.abs(stored.theta - made.theta).ravel() / scale
    covariance = np.abs(stored.covariance - made.covariance) / scale[:, None] / scale
    squares = abs(stored.chi_square - made.chi_square) / max(abs(made.chi_square), 1.0)
    return float(max(theta.max(initial=0.0), covariance.max(initial=0.0), squares))


def asymmetry(matrix: Array) -> float:
    """Largest difference (relative to two standard deviations) between the two triangles of a covariance, where both are given.

    Elements whose mirror image is exactly zero are not given: a store keeps blocks on and below the diagonal.
    """
    sigma = np.sqrt(np.abs(np.diagonal(matrix)))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    given = (matrix != 0.0) & (matrix.T != 0.0)
    return float((np.abs(matrix - matrix.T) * given / scale[:, None] / scale).max(initial=0.0))


def positive_semi_definite(covariance: Array, tolerance: float) -> bool:
    """True when no eigenvalue of the correlation matrix (lower triangle) lies below ``-tolerance``.

    A covariance of corrections may be singular: parameters that are known, images seconds apart. So the test is one Cholesky
    factorisation of the correlation matrix with the tolerance added to its diagonal.
    """
    variance = np.diagonal(covariance)
    if not np.isfinite(covariance).all() or (variance < 0.0).any():
        return False
    scale = np.where(variance > 0.0, np.sqrt(variance), 1.0)
    correlation = covariance / scale[:, None] / scale
    correlation[np.diag_indices(len(scale))] = 1.0 + tolerance
    _, info = la.lapack.dpotrf(correlation.T, lower=0, overwrite_a=1)
    return bool(info == 0) and not np.abs(covariance[variance == 0.0]).any()


def condition(information: Array) -> tuple[float, Array]:
    """Condition number of an information matrix (q, q), both triangles, scaled to a unit diagonal, and its Cholesky factor (lower).

    The number is LAPACK's estimate in the 1-norm; infinite for a matrix that is not positive definite, whose factor is empty.
    """
    if not len(information):
        return 1.0, information
    diagonal = np.diagonal(information)
    if not np.isfinite(information).all() or (diagonal <= 0.0).any():
        return float("inf"), np.empty((0, 0))
    scale = np.sqrt(diagonal)
    scaled = fill_symmetric(information / scale[:, None] / scale)
    norm = float(np.abs(scaled).sum(axis=0).max())
    factor, info = la.lapack.dpotrf(scaled.T, lower=1, overwrite_a=1, clean=1)
    if info != 0:
        return float("inf"), np.empty((0, 0))
    reciprocal, _ = la.lapack.dpocon(factor, norm, uplo="L")
    return (1.0 / float(reciprocal) if reciprocal > 0.0 else float("inf")), factor * scale[:, None]
