"""A network's own linear system, that of all its cells, solved once by a sparse direct solver: what a reconciliation must give.

    Lambda = I + K' S K        Lambda u = K' h        theta = K u        P_ij = delta_ij D_j + U_i K Lambda^-1 K' U_j'

S and h are the sums of all cells, K the a priori factor of all images; no tile, no tree and no stored state of either is looked at. The
solver is CHOLMOD (of cvxopt's wheel), or SuperLU (of SciPy) where that is not installed.

Memory: cells are read a few at a time and added to the blocks of S that any point joins, so it is that of S and of the factor of Lambda.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from submin.adjustment.elimination import ground_corrections
from submin.adjustment.priors import prior_factor
from submin.network.sub_min import GroundPart, loadings
from submin.query.planner import Selection, determined_parts
from submin.storage.arrays import group_of, read_records
from submin.storage.network import Network
from submin.storage.snapshot import Snapshot

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Ids = NDArray[np.str_]

CELLS_AT_ONCE = 16
POINTS_AT_ONCE = 32
"""Covariances of so many points are found together: SuperLU's right-hand sides are 120 MB then for all of China."""


@dataclass(frozen=True, eq=False)
class Factor:
    """A positive definite matrix Lambda (q, q), factored.

    Attributes
    ----------
    solver : name
    solve : right-hand sides (q, k) to ``Lambda^-1`` times them
    quadratic : V' (q, k), sparse, to ``V Lambda^-1 V'`` (k, k)
    """

    solver: str
    solve: Callable[[Array], Array]
    quadratic: Callable[[sp.csc_array], Array]


@dataclass(frozen=True, eq=False)
class SparseSystem:
    """Sums of all cells, and the a priori factor.

    Attributes
    ----------
    information : S (m p, m p), both triangles
    vector : h (m p,)
    prior : K (m p, q)
    parameters : p
    """

    information: sp.csc_array
    vector: Array
    prior: sp.csr_array
    parameters: int


@dataclass(frozen=True, eq=False)
class SparseAdjustment:
    """Images of a whole network, adjusted simultaneously.

    Attributes
    ----------
    theta : (m, p) corrections of all images
    prior : K (m p, q)
    factor : of Lambda
    """

    theta: Array
    prior: sp.csr_array
    factor: Factor

    @classmethod
    def of(cls, snapshot: Snapshot, solver: str | None = None) -> SparseAdjustment:
        """Solve a network; ``solver`` is ``cholmod`` or ``superlu``, by default the first that is installed."""
        return cls.of_system(sparse_system(snapshot), solver)

    @classmethod
    def of_system(cls, system: SparseSystem, solver: str | None = None) -> SparseAdjustment:
        """Solve a system that is there already."""
        factor = factorised(reduced(system), solver)
        theta = system.prior @ factor.solve((system.prior.T @ system.vector)[:, None])[:, 0]
        return cls(theta.reshape(-1, system.parameters), system.prior, factor)


@dataclass(frozen=True, eq=False)
class AdjustedPoints:
    """Points (n,) by ascending id, geocentric coordinates (n, 3) in metres, and the covariance (n, 3, 3) of each by itself."""

    ids: Ids
    geocentric: Array
    covariance: Array


def sparse_system(snapshot: Snapshot) -> SparseSystem:
    """The sums of all cells of a network, and its a priori factor."""
    images, p = snapshot.image_count(), snapshot.metadata.parameters
    numbers = snapshot.cell_numbers()
    keys = np.empty(0, dtype=np.int64)  # pairs of images that some cell joins, row * m + column
    group = group_of(snapshot.root, "cells")
    for some in _batches(numbers):
        records = read_records(group, map(snapshot.cover.cell_name, some), ("images",))
        seen = [_pairs(record.parts["images"], images) for record in records if record is not None]
        keys = np.unique(np.concatenate([keys, *seen]))
    blocks, vector = np.zeros((len(keys), p, p)), np.zeros((images, p))
    for some in _batches(numbers):
        for of_cell, sums in snapshot.some_sums(some):
            lower = np.tril_indices(len(of_cell))
            square = sums.information.reshape(len(of_cell), p, len(of_cell), p)
            blocks[np.searchsorted(keys, _pairs(of_cell, images))] += square[lower[0], :, lower[1], :]
            vector[of_cell] += sums.vector.reshape(-1, p)
    prior = prior_factor(snapshot.image_priors(), p)
    return SparseSystem(_symmetric(keys, blocks, images), vector.ravel(), prior, p)


def reduced(system: SparseSystem) -> sp.csc_array:
    """``Lambda = I + K' S K`` (q, q), both triangles."""
    half = system.prior.T.tocsc() @ (system.information @ system.prior.tocsc())
    return sp.csc_array(half + sp.eye_array(half.shape[0], format="csc"))


def factorised(matrix: sp.csc_array, solver: str | None = None) -> Factor:
    """Factor a positive definite matrix of which both triangles are given.

    Raises
    ------
    ArithmeticError, RuntimeError
        When the matrix is not positive definite (CHOLMOD), or singular (SuperLU).
    """
    name = solver or ("cholmod" if importlib.util.find_spec("cvxopt") else "superlu")
    return _cholmod(matrix) if name == "cholmod" else _superlu(matrix)


def located(network: Network, solution: SparseAdjustment, selections: Sequence[Selection]) -> tuple[Ids, Array]:
    """Ids, ascending, and geocentric coordinates (n, 3) of some points, such as those of a tile; undetermined ones are left out."""
    ids, at, _, _ = _placed(network, solution, selections)
    order = np.argsort(ids)
    return ids[order], at[order]


def adjusted_points(network: Network, solution: SparseAdjustment, selections: Sequence[Selection]) -> AdjustedPoints:
    """Coordinates and covariances of some points, such as ``network.named(ids)``; those that are not determined are left out."""
    ids, at, own, parts = _placed(network, solution, selections)
    loading = loadings(parts, np.arange(len(solution.theta), dtype=np.int32), solution.theta.shape[1])
    covariance = covariances(sp.csr_array(loading @ solution.prior), own, solution.factor)
    order = np.argsort(ids)
    return AdjustedPoints(ids[order], at[order], covariance[order])


def _placed(network: Network, solution: SparseAdjustment, selections: Sequence[Selection]) -> tuple[Ids, Array, Array, list[GroundPart]]:
    """Ids, coordinates and own parts of some points, cell after cell, and the ground parts that they come from."""
    kept, parts = determined_parts(network, selections)
    ids = np.concatenate([s.cell.point_ids[s.rows] for s in kept])
    at = np.concatenate([part.origin + ground_corrections(part.factors, part.linear, solution.theta) for part in parts])
    return ids, at, np.concatenate([part.factors.own for part in parts]), parts


def covariances(loading: sp.csr_array, own: Array, factor: Factor) -> Array:
    """``D + V Lambda^-1 V'`` (n, 3, 3) of points by themselves; V (3n, q) their loadings on the whitened vectors."""
    found = own.copy()
    for start in range(0, len(own), POINTS_AT_ONCE):
        stop = min(start + POINTS_AT_ONCE, len(own))
        joint = factor.quadratic(loading[3 * start : 3 * stop].T.tocsc()).reshape(stop - start, 3, stop - start, 3)
        diagonal = np.arange(stop - start)
        found[start:stop] += joint[diagonal, :, diagonal, :]
    return found


def _batches(numbers: Sequence[int]) -> Iterator[Sequence[int]]:
    return (numbers[start : start + CELLS_AT_ONCE] for start in range(0, len(numbers), CELLS_AT_ONCE))


def _pairs(of_cell: NDArray[np.integer], images: int) -> Rows:
    """Keys of the pairs of a cell's images, in the order of the blocks of its lower triangle."""
    lower = np.tril_indices(len(of_cell))
    at = np.asarray(of_cell, dtype=np.int64)
    return at[lower[0]] * images + at[lower[1]]


def _symmetric(keys: Rows, blocks: Array, images: int) -> sp.csc_array:
    """Both triangles of the matrix of which ``blocks`` (k, p, p) are the lower block triangle; of blocks on the diagonal the lower half."""
    p = blocks.shape[1]
    row, column = np.divmod(keys, images)
    below = row != column
    first = np.searchsorted(row, np.arange(images + 1))
    lower = sp.bsr_array((blocks, column.astype(np.int32), first.astype(np.int32)), shape=(images * p, images * p))
    # what stands above the diagonal of a cell's sums is not defined
    blocks[~below] = np.tril(blocks[~below])
    rows = lower.tocsr()
    rows.eliminate_zeros()
    diagonal = sp.diags_array(rows.diagonal(), format="csr")
    return sp.csc_array((rows + rows.T.tocsr() - diagonal).T)


def _cholmod(matrix: sp.csc_array) -> Factor:
    from cvxopt import cholmod, spmatrix
    from cvxopt import matrix as dense

    cholmod.options["supernodal"] = 2  # the factor of LL', in dense panels
    order, lower = 7, 4  # CHOLMOD's numbers for P b and for L^-1 b

    def packed(entries: sp.coo_array) -> Any:
        rows, columns = (dense(places.astype(np.int64)) for places in (entries.row, entries.col))
        return spmatrix(dense(np.ascontiguousarray(entries.data)), rows, columns, entries.shape)

    whole = packed(sp.tril(matrix, format="coo"))
    factor = cholmod.symbolic(whole)
    cholmod.numeric(whole, factor)

    def solve(right: Array) -> Array:
        found = dense(np.asfortranarray(right, dtype=np.float64))
        cholmod.solve(factor, found)
        return np.array(found)

    def quadratic(right: sp.csc_array) -> Array:
        # V Lambda^-1 V' = W'W, W = L^-1 P V': half of a solution, and W is sparse since L^-1 follows the tree of elimination
        half = cholmod.spsolve(factor, cholmod.spsolve(factor, packed(right.tocoo()), sys=order), sys=lower)
        first, row, value = (np.array(part).ravel() for part in half.CCS)
        w = sp.csc_array((value, row, first), shape=half.size)
        return np.asarray((w.T @ w).toarray())

    return Factor("cholmod", solve, quadratic)


def _superlu(matrix: sp.csc_array) -> Factor:
    # a symmetric ordering, pivots on the diagonal: for a positive definite matrix that is Cholesky's
    factor = spla.splu(sp.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def quadratic(right: sp.csc_array) -> Array:
        found = np.asarray(right.T @ factor.solve(right.toarray()))
        return np.asarray(0.5 * (found + found.T))

    return Factor("superlu", lambda right: np.asarray(factor.solve(np.ascontiguousarray(right))), quadratic)
