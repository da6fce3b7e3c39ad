"""Points with a full covariance as errors that they share and noise of their own: ``R = (R - A) + A``, A diagonal.

Seen by rays of covariance A through shifts of a priori covariance ``R - A = C C'``, points of covariance R enter sums over points like any
others, and exactly: shifts and noise together have the covariance R whatever A is (docs/mathematics.md, "Points with a full
covariance").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.errors import InputError

Array = NDArray[np.float64]

LEAST_EIGENVALUE = 1e-10
"""Part of the largest eigenvalue that the smallest must be, both of the scaled covariance: with less, round-off (2e-16 of the largest)
would be a part of 1e-6 of what is left, and a claim of more accuracy than there is."""


@dataclass(frozen=True, eq=False)
class JointErrors:
    """A covariance of n coordinates in two parts.

    Attributes
    ----------
    factor : (n, n) C, lower triangular, ``C C' = R - A``: of the errors that the coordinates share
    variance : (n,) diagonal of A: of the noise that each coordinate has to itself
    part : of the variance that a coordinate has when all others are known, ``1 / (R^-1)_ii``, what A is, the same of all
    """

    factor: Array
    variance: Array
    part: float


def joint_errors(covariance: Array, share: float = 0.5) -> JointErrors:
    """Split a covariance R (n, n) into shared errors and noise.

    With S the covariance scaled so that every coordinate has the variance 1 when all others are known, A is ``share`` (above 0, below 1)
    times the smallest eigenvalue of S, in the scale of each coordinate. What is left is as well conditioned as R, scaled, nearly is.

    Raises
    ------
    InputError
        When R is not positive definite, or so nearly singular that round-off would make up information.
    """
    factor, info = la.lapack.dpotrf(np.asfortranarray(covariance), lower=1)
    if info != 0:
        raise InputError("is not positive definite; expected one of points whose every combination has an error")
    inverse, _ = la.lapack.dpotri(factor, lower=1)
    alone = 1.0 / np.diagonal(inverse)
    scale = np.sqrt(alone)
    values = la.eigvalsh(covariance / scale / scale[:, None])
    if not values[0] > LEAST_EIGENVALUE * values[-1]:
        raise InputError(
            f"is singular to working precision (its eigenvalues, scaled, are {values[0]:.1e} to {values[-1]:.1e}); "
            "expected the points with a datum: a priori sigmas of metres, not kilometres, and no point twice"
        )
    part = share * float(values[0])
    left = np.array(covariance, order="F")
    left[np.diag_indices(len(left))] -= part * alone
    shared, info = la.lapack.dpotrf(left, lower=1, overwrite_a=1)
    if info != 0:  # cannot be, by the eigenvalues above
        raise InputError("is not positive definite; expected one of points whose every combination has an error")
    return JointErrors(np.ascontiguousarray(np.tril(shared)), part * alone, part)


def marginal_factor(rows: Array) -> Array:
    """A factor (r, k) of ``rows rows'`` of some rows (r, q) of a factor, with no more columns than rows.

    Its sign is fixed, so that it means the same on every machine.
    """
    used = rows[:, np.flatnonzero(rows.any(axis=0))]
    if used.shape[1] <= used.shape[0]:
        return used
    (upper,) = la.qr(used.T, mode="r", overwrite_a=True, check_finite=False)
    lower = upper[: len(rows)].T
    return np.ascontiguousarray(lower * np.where(np.diagonal(lower) < 0.0, -1.0, 1.0))
