"""The dense sub-MIN: one vector of points and one triangle of its covariance, updated in place (docs/mathematics.md, "Dense form")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.stats import chi2

from submin.errors import InputError, NumericalError
from submin.network.observations import PointObservations
from submin.network.triangle import Triangle

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
Rows = NDArray[np.int64]

UNDETERMINED = 1e-10
"""A block determines new points when the weakest direction of its whitened design is above this part of the strongest."""


@dataclass(frozen=True)
class BlockInnovation:
    """How well a block agreed with what was there.

    Attributes
    ----------
    d2 : weighted square sum of its innovations, chi-square distributed
    degrees_of_freedom : observations less coordinates of new points
    """

    d2: float
    degrees_of_freedom: int

    @property
    def probability(self) -> float:
        """Of a good block to agree as badly as this or worse; 1 for a block that brings nothing but new points."""
        return float(chi2.sf(self.d2, self.degrees_of_freedom)) if self.degrees_of_freedom else 1.0


@dataclass(frozen=True)
class _Split:
    """A block in two parts: observations of known points alone, ``y_c = A_c x + v_c``, and what gives the new, ``x_b = y_b - A_b x - v_b``.

    ``x`` stands for the coordinates of the block's known points. ``r_cc, r_bb, r_bc`` are covariances of v.
    """

    y_c: Array
    a_c: Array | sp.csr_array
    r_cc: Array
    y_b: Array
    a_b: Array | sp.csr_array
    r_bb: Array
    r_bc: Array


class DenseSubMin:
    """Ground points with their full covariance, which blocks of linear observations are fused into one after another.

    The state is changed in place: at 15,000 coordinates a copy would be 0.9 gigabyte. Results do not depend on the order of the blocks
    beyond round-off. A block that was fused cannot be taken out again; fuse those that are left anew (`submin.network.pending`).

    Attributes
    ----------
    triangle : covariance of the adjustments, square metres, geocentric axes, point-major in the order in which points came
    chi_square : weighted square sum of all residuals; redundancy : its degrees of freedom
    """

    def __init__(self) -> None:
        self.triangle = Triangle()
        self.chi_square = 0.0
        self.redundancy = 0
        self._ids: list[str] = []
        self._row: dict[str, int] = {}
        self._origins = np.empty((0, 3))
        self._adjustments = np.empty(0)
        self._blocks: dict[str, None] = {}

    @classmethod
    def restored(
        cls, ids: Ids, origins: Array, adjustments: Array, triangle: Triangle, chi_square: float, redundancy: int, blocks: tuple[str, ...]
    ) -> DenseSubMin:
        """A state as it was kept; what it holds is not copied, and changes with it."""
        state = cls()
        state.triangle, state.chi_square, state.redundancy = triangle, chi_square, redundancy
        state._ids = ids.tolist()
        state._row = {point: k for k, point in enumerate(state._ids)}
        state._origins, state._adjustments = origins, adjustments
        state._blocks = dict.fromkeys(blocks)
        return state

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def ids(self) -> Ids:
        """Points (n,), in the order in which they came."""
        return np.array(self._ids, dtype=np.str_)

    @property
    def blocks(self) -> tuple[str, ...]:
        """Names of the blocks fused, in their order."""
        return tuple(self._blocks)

    @property
    def origins(self) -> Array:
        """Fixed origins (n, 3) of the points' coordinates, geocentric metres."""
        return self._origins

    @property
    def adjustments(self) -> Array:
        """Estimates (3n,) about the origins, metres: small, so that no digit is lost to the radius of the earth."""
        return self._adjustments

    @property
    def geocentric(self) -> Array:
        """Estimated positions (n, 3), metres."""
        return np.asarray(self._origins + self._adjustments.reshape(-1, 3))

    def rows_of(self, ids: Ids) -> Rows:
        """Places (k,) of points in the state, -1 for those that it does not hold."""
        return np.array([self._row.get(point, -1) for point in ids.tolist()], dtype=np.int64)

    def covariance(self, rows: Rows) -> Array:
        """Joint covariance (3k, 3k) of the points at these places, square metres."""
        return self.triangle.submatrix(_coordinates(rows))

    def fuse(self, block: PointObservations) -> BlockInnovation:
        """Fuse a block: any linear observations of points, with their full covariance. New points have no prior.

        One symmetric rank-m update of one triangle, in place; besides it arrays of m rows are made, none of the size of the state squared.

        Raises
        ------
        InputError
            When the block was fused before: it would count twice.
        NumericalError
            When its covariance is not positive definite, or it does not determine its new points; nothing is changed then.
        """
        for name in block.block_ids:
            if name in self._blocks:
                raise InputError(f"block {name} is already fused; expected a new one: a block counts once")
        ids = block.point_ids
        rows = self.rows_of(ids)
        new = np.flatnonzero(rows < 0)
        origins = self._origins_for(block, ids, rows)
        split = _split(block, origins, rows)
        known = rows[rows >= 0]
        at = _coordinates(known)
        x = self._adjustments[at]

        innovation = split.y_c - split.a_c @ x
        prior_b = split.y_b - split.a_b @ x
        touched = self.triangle.rows(at) if len(at) else np.zeros((0, self.triangle.padded_size), order="F")
        gain = _times(split.a_c, touched)  # A_c P
        s = np.asarray(split.a_c @ gain[:, at].T) + split.r_cc
        factor = _cholesky(s, block.block_id)
        if len(new):
            cross = -_times(split.a_b, touched)[:, : self.triangle.size]  # Cov(x_b, x) = -A_b P
            own = split.r_bb - np.asarray(split.a_b @ cross[:, at].T)
            self._append(ids[new], origins[new], prior_b, cross, own)
            gain = _padded(gain, self.triangle.padded_size)
            n = self.triangle.size
            gain[:, n - len(own) : n] = (
                np.asarray(split.a_c @ cross[:, at].T) - split.r_bc.T
            )  # the minus: y_c = A_c x + v_c, x_b = ... - v_b
        d2 = 0.0
        if len(innovation):
            w = la.blas.dtrsm(1.0, factor, gain, lower=1, overwrite_b=1)
            whitened = la.solve_triangular(factor, innovation, lower=True, check_finite=False)
            self._adjustments += w[:, : self.triangle.size].T @ whitened
            self.triangle.subtract_square(w)
            d2 = float(whitened @ whitened)
        self._blocks |= dict.fromkeys(block.block_ids)
        self.chi_square += d2
        self.redundancy += len(innovation)
        return BlockInnovation(d2, len(innovation))

    def _origins_for(self, block: PointObservations, ids: Ids, rows: Rows) -> Array:
        known = np.full((len(ids), 3), np.nan)
        known[rows >= 0] = self._origins[rows[rows >= 0]]
        origins = block.approximate(known)
        lost = np.isnan(origins).any(axis=1)
        if lost.any():
            raise NumericalError(
                f"block {block.block_id}: does not determine point {ids[lost][0]}; fuse what fixes it first, or together with it"
            )
        return origins

    def _append(self, ids: Ids, origins: Array, adjustments: Array, cross: Array, own: Array) -> None:
        self._row.update({point: len(self._ids) + k for k, point in enumerate(ids.tolist())})
        self._ids.extend(ids.tolist())
        self._origins = np.concatenate([self._origins, origins])
        self._adjustments = np.concatenate([self._adjustments, adjustments])
        self.triangle.append(cross, own)


def _split(block: PointObservations, origins: Array, rows: Rows) -> _Split:
    """Split a block: its new points have no prior, so as many observations as they have coordinates give them; the rest is free of them."""
    h, y, r = block.design(), block.misclosure(origins), np.asarray(block.covariance)
    known, new = _coordinates(np.flatnonzero(rows >= 0)), _coordinates(np.flatnonzero(rows < 0))
    a, b = sp.csr_array(h[:, known]), sp.csr_array(h[:, new])
    none = np.empty(0)
    if not len(new):
        empty = np.empty((0, len(known)))
        return _Split(y, a, r, none, empty, np.empty((0, 0)), np.empty((0, len(y))))
    giving = np.diff(b.indptr) > 0
    if _is_selection(b[giving], len(new)):
        # each new coordinate is observed once, by itself: nothing to eliminate, and the block stays sparse
        b_rows = np.flatnonzero(giving)
        sign = b[b_rows].data
        order = np.argsort(b[b_rows].indices)
        b_rows, sign = b_rows[order], sign[order]
        c_rows = np.flatnonzero(~giving)
        scaled = sp.csr_array(sp.diags_array(sign) @ a[b_rows])
        return _Split(
            y[c_rows], sp.csr_array(a[c_rows]), r[np.ix_(c_rows, c_rows)], sign * y[b_rows], scaled,
            r[np.ix_(b_rows, b_rows)] * np.outer(sign, sign), r[np.ix_(b_rows, c_rows)] * sign[:, None],
        )  # fmt: skip
    return _eliminated(block.block_id, a.toarray(), b.toarray(), y, r)


def _eliminated(block_id: str, a: Array, b: Array, y: Array, r: Array) -> _Split:
    """The split of a whitened block by an orthogonal factor of the new points' columns."""
    factor = _cholesky(r, block_id)
    white = la.solve_triangular(factor, np.column_stack([b, a, y]), lower=True, check_finite=False)
    q = b.shape[1]
    scale = np.linalg.norm(white[:, :q], axis=0)
    if len(y) < q or not scale.all():
        raise NumericalError(f"block {block_id}: does not determine its new points; fuse what fixes them first, or together with it")
    orthogonal, t = la.qr(white[:, :q] / scale, mode="full", check_finite=False)
    t = t[:q]
    strengths = la.svdvals(t)
    if strengths[-1] < UNDETERMINED * strengths[0]:
        raise NumericalError(f"block {block_id}: does not determine its new points; fuse what fixes them first, or together with it")
    rotated = orthogonal.T @ white[:, q:]
    solved = la.solve_triangular(t, np.column_stack([rotated[:q], np.eye(q)]), check_finite=False) / scale[:, None]
    given, inverse = solved[:, : rotated.shape[1]], solved[:, rotated.shape[1] :]
    rest = len(y) - q
    return _Split(
        rotated[q:, -1], rotated[q:, :-1], np.eye(rest), given[:, -1], given[:, :-1], inverse @ inverse.T, np.zeros((q, rest))
    )  # fmt: skip


def _is_selection(b: sp.csr_array, columns: int) -> bool:
    """True when every row has one entry, 1 or -1, and every column is met once."""
    single = b.shape[0] == columns and bool((np.diff(b.indptr) == 1).all())
    return single and len(np.unique(b.indices)) == columns and bool((np.abs(b.data) == 1.0).all())


def _times(a: Array | sp.csr_array, rows: Array) -> Array:
    """``A rows`` in Fortran order."""
    if not isinstance(a, np.ndarray):
        if (np.diff(a.indptr) == 1).all() and (a.data == 1.0).all():  # positions
            in_order = np.array_equal(a.indices, np.arange(len(rows)))
            return rows if in_order else np.take(rows.T, a.indices, axis=1).T
        a = a.toarray()
    if not a.size or not rows.size:
        return np.zeros((a.shape[0], rows.shape[1]), order="F")
    return np.asarray(la.blas.dgemm(1.0, a, rows))


def _padded(gain: Array, columns: int) -> Array:
    """The same with columns of zeros added."""
    if gain.shape[1] == columns:
        return gain
    wide = np.zeros((len(gain), columns), order="F")
    wide[:, : gain.shape[1]] = gain
    return wide


def _cholesky(matrix: Array, block_id: str) -> Array:
    """Lower Cholesky factor, in Fortran order."""
    if not len(matrix):
        return np.zeros((0, 0), order="F")
    factor, failed = la.lapack.dpotrf(matrix, lower=1)
    if failed:
        raise NumericalError(f"block {block_id}: its covariance is not positive definite (row {failed - 1}); expected a regular one")
    return np.asarray(factor)


def _coordinates(points: Rows) -> Rows:
    """Places (3k,) of the coordinates of points."""
    return np.asarray((3 * points[:, None] + np.arange(3)).ravel())
