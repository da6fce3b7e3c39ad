"""Joint covariances of functions with zero floor as sparse matrices: points farther apart than the floor have none.

Pairs within the floor come from a k-d tree, so neither time nor memory grows with all pairs. The factorisation is SuperLU's with a
symmetric ordering and the pivots left on the diagonal: of a positive definite matrix that is its Cholesky factorisation, L in one
triangle and D L' in the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree

from submin.correlation.assembly import symmetric_roots
from submin.correlation.families import Correlation
from submin.errors import InputError, NumericalError

Array = NDArray[np.float64]


def assemble_sparse(blocks: Array, geocentric: Array, functions: Sequence[Correlation], axes: Array) -> sp.csc_array:
    """The matrix of `submin.correlation.assembly.assemble`, sparse; all functions have a zero floor.

    Returns
    -------
    (3n, 3n), m2, point-major, both triangles stored; 3 x 3 blocks of zeros are not.

    Raises
    ------
    InputError
        When a function has no zero floor.
    NumericalError
        When a point's own covariance is not positive definite.
    """
    endless = [function.family.name for function in functions if not np.isfinite(function.floor)]
    if endless:
        raise InputError(f"family {endless[0]!r} is zero at no distance; expected families with zero floor for a sparse covariance")
    n = len(blocks)
    pairs = cKDTree(geocentric).query_pairs(max(function.floor for function in functions), output_type="ndarray")
    i, j = pairs.astype(np.int64).T
    chord = np.linalg.norm(geocentric[i] - geocentric[j], axis=1)
    along = symmetric_roots(blocks)[0] @ axes.T
    rho = np.stack([function(chord) for function in functions], axis=1)
    across = np.einsum("kac,kc,kbc->kab", along[i], rho, along[j], optimize=True)
    # blocks in the order of their rows: the diagonal, every pair, and every pair the other way round
    row, column = np.concatenate([np.arange(n), i, j]), np.concatenate([np.arange(n), j, i])
    order = np.lexsort((column, row))
    data = np.concatenate([blocks, across, np.swapaxes(across, 1, 2)])[order]
    first = np.searchsorted(row[order], np.arange(n + 1))
    return sp.bsr_array((data, column[order], first), shape=(3 * n, 3 * n)).tocsc()


@dataclass(frozen=True, eq=False)
class SparseFactor:
    """Factorisation of a sparse positive definite matrix.

    Attributes
    ----------
    factor : SuperLU's
    triangle : non-zeros in one triangle of the matrix, diagonal included; fill : those of its Cholesky factor
    """

    factor: SuperLU
    triangle: int
    fill: int

    @classmethod
    def of(cls, matrix: sp.csc_array) -> SparseFactor:
        """Factor a sparse symmetric matrix.

        Raises
        ------
        NumericalError
            When it is not positive definite.
        """
        n = matrix.shape[0]
        try:
            options = {"SymmetricMode": True}
            factor = splu(sp.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError as cause:
            raise NumericalError(f"sparse covariance: {cause}; expected a positive definite matrix") from None
        if not (factor.U.diagonal() > 0.0).all() or not np.array_equal(factor.perm_r, factor.perm_c):
            raise NumericalError("sparse covariance: a pivot is not positive; expected a positive definite matrix")
        return cls(factor, (matrix.nnz + n) // 2, int(factor.L.nnz))

    def solve(self, right: Array) -> Array:
        """``matrix^-1 right`` for (n,) or (n, k)."""
        return np.asarray(self.factor.solve(right))


__all__ = ["SparseFactor", "assemble_sparse"]
