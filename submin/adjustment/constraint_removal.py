"""Taking the a priori constraint out of an estimate that was published with it (docs/mathematics.md, "The constraint of a solution")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular

from submin.errors import NumericalError

Array = NDArray[np.float64]

SURELY = 100.0
"""What is left of the information in a direction must be so many times as great as the error that the printed digits give it."""


@dataclass(frozen=True, eq=False)
class Freed:
    """An estimate without its constraint.

    Attributes
    ----------
    estimate : (n,) in the units of the estimate given
    covariance : (n, n) their squares
    share : the greatest part of the information in any direction that was the constraint's, 0 to below 1
    """

    estimate: Array
    covariance: Array
    share: float


def without_constraint(estimate: Array, covariance: Array, a_priori: Array, information: Array, digits: float) -> Freed:
    """The estimate that the observations alone give.

    With ``P = L L'`` the covariance and ``C`` the information of the constraint, the eigenvalues ``m`` of ``L' C L`` are the parts of the
    information in independent directions that came from the constraint. What is left of a direction is ``1 - m``; its variance grows by
    ``1 / (1 - m)``. It is taken with the worst that the printed digits allow, so that no more accuracy is claimed than the file can show.

    Parameters
    ----------
    estimate, covariance : (n,), (n, n) as published, with the constraint in them
    a_priori, information : (n,), (n, n) values and information matrix of the constraint; rows and columns of zeros where there is none
    digits : relative error of the elements of the covariance, from the digits that are printed

    Raises
    ------
    NumericalError
        When the covariance is not positive definite, the constraint has more information than the estimate, or what is left in some
        direction cannot be told from nothing: an estimate that the constraint alone holds there.
    """
    sigma = np.sqrt(np.diagonal(covariance))
    if not (sigma > 0.0).all():  # also NaN, of a negative variance
        raise NumericalError("the covariance of the estimate is not positive definite")
    correlation = covariance / np.outer(sigma, sigma)
    spread = eigh(correlation, eigvals_only=True)
    if not spread[0] > len(sigma) * np.finfo(np.float64).eps * spread[-1]:
        raise NumericalError("the covariance of the estimate is not positive definite")
    factor = sigma[:, None] * np.linalg.cholesky(correlation)
    shares, vectors = eigh(factor.T @ information @ factor)
    error = digits * np.sqrt(len(sigma)) * spread[-1] / spread[0]
    if shares[-1] > 1.0 + SURELY * error:
        raise NumericalError(
            f"the constraint holds {shares[-1]:.3g} times the information of the estimate in one direction; "
            "expected less than once: it cannot be a part of it"
        )
    left = 1.0 - shares
    lost = int((left < SURELY * error).sum())
    if lost:
        raise NumericalError(
            f"without its constraint the estimate is undetermined in {lost} of {len(left)} directions (what is left of their information, "
            f"{max(left[-1], 0.0):.1e} of it, cannot be told from nothing by the digits of the matrix): a free network"
        )
    directions = factor @ vectors
    at_worst = directions / np.sqrt(left - error)
    pulled = directions @ ((directions.T @ (information @ (estimate - a_priori))) / left)
    return Freed(estimate + pulled, at_worst @ at_worst.T, float(max(shares[-1], 0.0)))


def information_of(covariance: Array) -> Array:
    """The inverse of a covariance, symmetric.

    Raises
    ------
    NumericalError
        When it is not positive definite.
    """
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise NumericalError("is not positive definite") from None
    root = solve_triangular(factor, np.eye(len(factor)), lower=True)
    return np.asarray(root.T @ root)


__all__ = ["Freed", "information_of", "without_constraint"]
