"""One triangle of a symmetric matrix that grows and is updated in place: block columns of its upper triangle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.errors import NumericalError

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

PANEL = 768
"""Columns a panel holds: enough for products at full speed, little beside thousands of rows; a multiple of 3, so that no point is cut."""


class Triangle:
    """A symmetric matrix of which one triangle is stored, in panels.

    Panel k holds rows ``0`` to ``(k + 1) b`` of the columns ``k b`` to ``(k + 1) b``, ``b = PANEL``, in Fortran order. So new rows and
    columns never move what is there, the part of a panel that is in use is contiguous, and BLAS updates it in place. Besides the triangle,
    only the squares on the diagonal are stored whole: ``size * b / 2`` numbers, 5 per cent of a triangle of 15,000.

    Below the diagonal nothing is read: the matrix is symmetric by construction.
    """

    def __init__(self) -> None:
        self.size = 0
        self._panels: list[Array] = []

    @property
    def padded_size(self) -> int:
        """Columns of the arrays that `subtract_square` takes: the size, rounded up to whole panels."""
        return PANEL * len(self._panels)

    @property
    def nbytes(self) -> int:
        """Bytes that are stored."""
        return sum(panel.nbytes for panel in self._panels)

    @property
    def panels(self) -> Sequence[Array]:
        """What is stored, see the class; do not change it."""
        return tuple(self._panels)

    @classmethod
    def of(cls, matrix: Array) -> Triangle:
        """The triangle of a whole symmetric matrix, of which the upper part is read."""
        triangle = cls()
        triangle.append(np.empty((len(matrix), 0)), matrix)
        return triangle

    def append(self, cross: Array, own: Array) -> None:
        """Append q rows and columns.

        Parameters
        ----------
        cross : (q, size) covariance of the new with what is there; own : (q, q) of the new with one another
        """
        old, new = self.size, len(own)
        upper = np.triu(own)
        while PANEL * len(self._panels) < old + new:
            self._panels.append(np.zeros((PANEL * (len(self._panels) + 1), PANEL), order="F"))
        for start, panel, used in self._parts(old + new):
            if start + used <= old:
                continue
            low = max(start, old)
            columns = panel[:, low - start : used]
            columns[:old] = cross[low - old : start + used - old].T
            columns[old : start + used] = upper[: start + used - old, low - old : start + used - old]
        self.size = old + new

    def rows(self, wanted: Rows) -> Array:
        """Rows (q, padded size) of the whole symmetric matrix, in Fortran order; zeros beyond its size. They may be wanted in any order."""
        found = np.zeros((self.padded_size, len(wanted)))
        home = wanted // PANEL
        for k, (start, panel, used) in enumerate(self._parts(self.size)):
            stop = start + used
            above = np.flatnonzero(home < k)
            found[start:stop, above] = np.take(panel.T[:used], wanted[above], axis=1)
            here = np.flatnonzero(home == k)
            local = wanted[here] - start
            found[:start, here] = panel[:start, local]
            square, column = panel[start:stop, :used], np.arange(used)[:, None]
            found[start:stop, here] = np.where(column <= local, square[:, local], square[local].T)
        return found.T

    def submatrix(self, wanted: Rows) -> Array:
        """The symmetric matrix (q, q) of some rows and the same columns."""
        order = np.argsort(wanted, kind="stable")
        ascending = wanted[order]
        found = np.empty((len(wanted), len(wanted)))
        for k, (start, panel, used) in enumerate(self._parts(self.size)):
            low, high = np.searchsorted(ascending, (start, start + used))
            found[order[:high, None], order[None, low:high]] = panel[ascending[:high, None], ascending[None, low:high] - k * PANEL]
        upper = np.triu_indices(len(wanted), 1)
        found[order[upper[1]], order[upper[0]]] = found[order[upper[0]], order[upper[1]]]
        return found

    def diagonal_blocks(self) -> Array:
        """The blocks (size / 3, 3, 3) on the diagonal."""
        blocks = np.empty((self.size // 3, 3, 3))
        for start, panel, used in self._parts(self.size):
            at = np.arange(0, used, 3)
            for i in range(3):
                for j in range(i, 3):
                    blocks[start // 3 + at // 3, i, j] = blocks[start // 3 + at // 3, j, i] = panel[start + at + i, at + j]
        return blocks

    def subtract_square(self, w: Array) -> None:
        """Subtract ``W'W`` in place, W (m, padded size) in Fortran order: no temporary, whatever the size."""
        for start, panel, used in self._parts(self.size):
            stop = start + PANEL
            part = panel[:, :used]
            la.blas.dgemm(-1.0, w[:, :stop], w[:, start : start + used], 1.0, part, trans_a=1, overwrite_c=1)

    def whole(self) -> Array:
        """The upper triangle (size, size) in Fortran order, zeros below."""
        matrix = np.zeros((self.size, self.size), order="F")
        for start, panel, used in self._parts(self.size):
            matrix[:start, start : start + used] = panel[:start, :used]
            matrix[start : start + used, start : start + used] = np.triu(panel[start : start + used, :used])
        return matrix

    def check_definite(self) -> float:
        """Smallest pivot of a Cholesky factorisation over its row's diagonal, in units of round-off (2**-53 times the size).

        A pivot is what is left of a variance when all rows before are known. Far above 1 the matrix is regular whatever round-off did.

        Raises
        ------
        NumericalError
            When the matrix is not positive definite.
        """
        if not self.size:
            return float("inf")
        matrix = self.whole()
        variances = matrix.diagonal().copy()
        factor, failed = la.lapack.dpotrf(matrix, lower=0, overwrite_a=1, clean=0)
        if failed:
            raise NumericalError(
                f"the covariance is not positive definite (row {failed - 1} of {self.size}): it is damaged, or a block was wrong"
            )
        return float(np.min(factor.diagonal() ** 2 / variances) / (self.size * 2.0**-53))

    def _parts(self, size: int) -> list[tuple[int, Array, int]]:
        """First column, panel and columns in use of every panel."""
        return [(k * PANEL, panel, min(PANEL, size - k * PANEL)) for k, panel in enumerate(self._panels)]
