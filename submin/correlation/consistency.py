"""How much an approximate covariance must be enlarged so that it claims no more accuracy than there is.

    kappa = lambda_max(P_hat^-1 P)                                                        kappa P_hat >= P
    P <= lambda_{r+1} P_hat + sum_{i<=r} (lambda_i - lambda_{r+1}) u_i u_i'               P V = P_hat V Lambda, u_i = P_hat v_i

The first is the least factor that makes P_hat consistent; the second keeps the r directions in which P_hat falls most short of P as they
are, and needs only the next factor (docs/mathematics.md, "Correlation functions"). Both are computed with whitened matrices
(`submin.correlation.assembly`), which changes no eigenvalue.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, eigsh

from submin.errors import InputError, NumericalError

Array = NDArray[np.float64]

DENSE = 400
"""Matrices up to this size are solved whole; of larger ones the leading eigenvalues by Lanczos' method."""
MARGIN = 1e-8
"""Part by which a bound is enlarged against the round-off of whoever forms it again; the factor by more where that does not suffice."""


@dataclass(frozen=True, eq=False)
class Bound:
    """A whitened bound ``factor R + vectors vectors'`` of a covariance.

    Attributes
    ----------
    factor : of P_hat beside the vectors
    alone : of P_hat without them (kappa)
    vectors : (3n, r), whitened, component-major
    inflation : mean over all coordinates of the bound's variance over the true one
    """

    factor: float
    alone: float
    vectors: Array
    inflation: float


def lower_factors(correlations: Array) -> Array:
    """Cholesky factors (3, n, n), lower, of the correlations (3, n, n) of the components.

    Raises
    ------
    NumericalError
        When one is not positive definite.
    """
    try:
        return np.stack([la.cholesky(matrix, lower=True) for matrix in correlations])
    except la.LinAlgError as cause:
        raise NumericalError(f"correlations between points are not positive definite ({cause})") from None


def leading(covariance: Array, factors: Array, count: int, tolerance: float = 0.0) -> tuple[Array, Array]:
    """The largest eigenvalues (k,) of ``R^-1 C``, descending, and ``R v`` (3n, k) of their vectors v, which are R-orthonormal.

    Parameters
    ----------
    covariance : (3n, 3n), C, whitened
    factors : (3, n, n), Cholesky factors of R
    count : k, below 3n
    tolerance : of the eigenvalues, relative; 0 is round-off
    """
    size, n = len(covariance), factors.shape[1]

    def by_component(x: Array, transposed: bool, solved: bool) -> Array:
        parts = x.reshape(3, n, -1)
        if solved:
            done = [la.solve_triangular(f, part, lower=True, trans=int(transposed)) for f, part in zip(factors, parts, strict=True)]
        else:
            done = [f @ part for f, part in zip(factors, parts, strict=True)]
        return np.concatenate(done).reshape(x.shape)

    if size <= DENSE or count > size // 4:
        half = by_component(covariance, transposed=False, solved=True)
        standard = by_component(np.ascontiguousarray(half.T), transposed=False, solved=True)
        # all of them: asked for some by their index, LAPACK finds none of a matrix that is the identity but for round-off
        values, vectors = (part[..., size - count :] for part in la.eigh(standard, driver="evd"))
    else:
        operator = LinearOperator(
            (size, size), dtype=np.float64,
            matvec=lambda x: by_component(
                covariance @ by_component(np.ravel(x), transposed=True, solved=True), transposed=False, solved=True
            ),
        )  # fmt: skip
        begin = np.random.default_rng(0).normal(size=size)  # the same question has the same answer
        values, vectors = eigsh(operator, count, which="LA", v0=begin, tol=tolerance)
    order = np.argsort(values)[::-1]
    return values[order], by_component(np.ascontiguousarray(vectors[:, order]), transposed=False, solved=False)


def inflation(values: Array, vectors: Array) -> float:
    """Mean variance of the bound with all but the last of some leading eigenvalues kept as vectors; each true variance is one."""
    return float(values[-1] + (values[:-1] - values[-1]) @ (vectors[:, :-1] ** 2).sum(axis=0) / len(vectors))


def consistent_bound(covariance: Array, correlations: Array, rank: int = 0) -> Bound:
    """The least factor of R, beside ``rank`` vectors, with which it bounds C; that it does is shown by a Cholesky factorisation.

    Parameters
    ----------
    covariance : (3n, 3n), C, whitened; correlations : (3, n, n), R
    rank : number of vectors, 0 to 3n - 1

    Raises
    ------
    InputError
        When there cannot be so many vectors.
    NumericalError
        When R is not positive definite.
    """
    size = len(covariance)
    if not 0 <= rank < size:
        raise InputError(f"rank is {rank}; expected 0 to {size - 1} for {size // 3} points")
    values, vectors = leading(covariance, lower_factors(correlations), rank + 1)
    directions = vectors[:, :rank] * np.sqrt((1.0 + MARGIN) * np.maximum(values[:rank] - values[rank], 0.0))
    alone = _certified(covariance, correlations, values[0], directions[:, :0])
    factor = alone if rank == 0 else _certified(covariance, correlations, values[rank], directions)
    return Bound(factor, alone, directions, float(factor + (directions**2).sum() / size))


def _certified(covariance: Array, correlations: Array, factor: float, directions: Array) -> float:
    """A factor a little above an eigenvalue for which ``factor R + directions directions' - C`` has a Cholesky factorisation."""
    margin = MARGIN
    while margin < 1.0:
        enlarged = float(factor * (1.0 + margin))
        if positive_definite(difference(covariance, correlations, enlarged, directions)):
            return enlarged
        margin *= 10.0
    raise NumericalError(f"no factor up to {2.0 * factor:g} makes the approximation a bound; its correlations are too close to singular")


def difference(covariance: Array, correlations: Array, factor: float, directions: Array) -> Array:
    """``factor R + directions directions' - C``, of which positive semi-definite means consistent."""
    n = correlations.shape[1]
    left = directions @ directions.T
    left -= covariance
    for c, matrix in enumerate(correlations):
        part = slice(c * n, (c + 1) * n)
        left[part, part] += factor * matrix
    return np.asarray(left)


def positive_definite(matrix: Array) -> bool:
    """True when the lower triangle of a matrix has a Cholesky factorisation; the matrix is lost."""
    _, failed = la.lapack.dpotrf(matrix.T, lower=0, overwrite_a=1, clean=0)
    return int(failed) == 0


__all__ = ["Bound", "consistent_bound", "difference", "inflation", "leading", "lower_factors", "positive_definite"]
