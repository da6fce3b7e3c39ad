"""A joint covariance out of each point's own covariance and correlation functions of distance.

    P_hat_ij = S_i E' diag(rho_1, rho_2, rho_3)(d_ij) E S_j      P_hat_ii = P_ii = S_i S_i

S_i is the symmetric square root of point i's own covariance, E one set of axes common to all points, d_ij the chord between i and j. With
functions that are positive definite in space P_hat is positive definite: it is ``S (E' (R_1 + R_2 + R_3) E) S'`` with R_c the matrix of
the correlations of component c, each positive definite (docs/mathematics.md, "Correlation functions").

Inside this package covariances are *whitened*: divided by S on both sides and turned into the common axes, component-major (all points'
first component, then the second, then the third). There P_hat is the direct sum of R_1, R_2 and R_3.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist, squareform

from submin.correlation.families import Correlation
from submin.errors import NumericalError

Array = NDArray[np.float64]
COMPONENTS = 3


def symmetric_roots(blocks: Array) -> tuple[Array, Array]:
    """Symmetric square roots (n, 3, 3) of points' own covariances (n, 3, 3), and their inverses.

    Raises
    ------
    NumericalError
        When a covariance is not positive definite: relative to nothing no error is correlated.
    """
    values, vectors = np.linalg.eigh(blocks)
    bad = ~(values[:, 0] > 1e-12 * values[:, -1])
    if bad.any():
        i = int(np.argmax(bad))
        raise NumericalError(f"point {i}: its covariance has the eigenvalues {values[i].tolist()} m2; expected positive ones")
    sigma, across = np.sqrt(values)[:, None, :], np.swapaxes(vectors, 1, 2)
    return np.asarray((vectors * sigma) @ across), np.asarray((vectors / sigma) @ across)


def own_blocks(covariance: Array) -> Array:
    """Covariance (n, 3, 3) of each point alone, of a joint one (3n, 3n), point-major."""
    n = len(covariance) // COMPONENTS
    return np.asarray(covariance.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :])


def whitened(covariance: Array, inverse_roots: Array, axes: Array) -> Array:
    """A joint covariance (3n, 3n), point-major, divided by the points' square roots, in common axes and component-major.

    Its blocks (i, i) of all three components are the identity; entry (c, i), (c, j) is the correlation of component c of points i and j.
    """
    n = len(inverse_roots)
    into = axes @ inverse_roots
    rows = np.einsum("iab,ibk->aik", into, covariance.reshape(n, 3, 3 * n), optimize=True).reshape(3 * n, n, 3)
    return np.asarray(np.einsum("kjb,jcb->kcj", rows, into, optimize=True).reshape(3 * n, 3 * n))


def unwhitened(vectors: Array, roots: Array, axes: Array) -> Array:
    """Vectors (3n, r), whitened and component-major, as geocentric ones, point-major."""
    n = len(roots)
    return np.asarray(np.einsum("iab,cb,cir->iar", roots, axes, vectors.reshape(3, n, -1), optimize=True).reshape(3 * n, -1))


def correlation_matrices(functions: Sequence[Correlation], geocentric: Array) -> Array:
    """Correlations (3, n, n) of each component between points (n, 3) in metres; ones on the diagonals."""
    n, chord = len(geocentric), pdist(geocentric)
    matrices = np.empty((COMPONENTS, n, n))
    for matrix, function in zip(matrices, functions, strict=True):
        matrix[:] = squareform(function(chord))
        np.fill_diagonal(matrix, 1.0)
    return matrices


def assemble(blocks: Array, geocentric: Array, functions: Sequence[Correlation], axes: Array) -> Array:
    """Joint covariance (3n, 3n), m2, point-major, of points' own covariances (n, 3, 3) and three functions.

    Parameters
    ----------
    blocks : (n, 3, 3), m2, geocentric axes
    geocentric : (n, 3), m
    functions : of the components along the three common axes
    axes : (3, 3), rows are the common axes

    Raises
    ------
    NumericalError
        When a point's own covariance is not positive definite.
    """
    roots, _ = symmetric_roots(blocks)
    n, along = len(blocks), roots @ axes.T
    joint = np.zeros((n, 3, n, 3))
    for c, matrix in enumerate(correlation_matrices(functions, geocentric)):
        for a in range(COMPONENTS):
            for b in range(COMPONENTS):  # the product of the two sides first: symmetric to the last bit
                joint[:, a, :, b] += np.multiply.outer(along[:, a, c], along[:, b, c]) * matrix
    joint[np.arange(n), :, np.arange(n), :] = blocks
    return joint.reshape(3 * n, 3 * n)
