"""What lies outside a part of the network, by elimination over a tree: messages go up, posterior states come down.

A *front* is the information about some whitened vectors u, those that no one outside of the part holds (the interior) first:

    Lambda = [I + S_II  S_IB]   h = [h_I]      L_II L_II' = I + S_II     L_BI = S_BI L_II^-T     y = L_II^-1 h_I
             [S_BI      S_BB]       [h_B]

Up goes the message ``S_BB - L_BI L_BI'``, ``h_B - L_BI y`` about the boundary; the prior of a vector is counted once, where it is
eliminated. Down comes the posterior state (u_B, P_BB) of the boundary, which completes that of the front:

    u_I = L_II^-T y - G u_B,   P_IB = -G P_BB,   P_II = (L_II L_II')^-1 + G P_BB G',   G = L_II^-T L_BI'

(docs/mathematics.md, "Outside messages"). What arrives at a tile is the marginal of the whole network on the vectors that it holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.adjustment.estimation import cholesky
from submin.adjustment.symmetric import add_packed, fill_symmetric, packed, taken, unpacked

Array = NDArray[np.float64]
Names = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Message:
    """What a part of the network says of vectors that others hold too, without their priors.

    Attributes
    ----------
    names : (b,) ascending; information : (b (b + 1) / 2,) lower triangle row by row; vector : (b,)
    chi_square, redundancy : of the part so far, what its boundary will explain not yet taken off
    """

    names: Names
    information: Array
    vector: Array
    chi_square: float
    redundancy: int


@dataclass(frozen=True, eq=False)
class State:
    """Posterior state of some vectors: names (q,) ascending, mean (q,), covariance as packed lower triangle."""

    names: Names
    mean: Array
    covariance: Array

    def of(self, names: Names) -> tuple[Array, Array]:
        """Mean (k,) and covariance (k, k), both triangles, of some of the vectors."""
        at = np.searchsorted(self.names, names)
        return self.mean[at], taken(self.covariance, at)


@dataclass(frozen=True, eq=False)
class Elimination:
    """A front whose interior is eliminated.

    Attributes
    ----------
    interior, boundary : (k,), (b,) names, ascending each
    root : (k + b, k) L_II (its upper triangle zero) above L_BI; shift : (k,) y
    """

    interior: Names
    boundary: Names
    root: Array
    shift: Array


def front_of(names: Names, messages: Sequence[Message]) -> tuple[Array, Array]:
    """Sum of messages about ``names`` (f,), in any order that holds all of theirs: information (lower triangle) and vector."""
    information, vector = np.zeros((len(names), len(names))), np.zeros(len(names))
    order = np.argsort(names)
    for message in messages:
        at = order[np.searchsorted(names, message.names, sorter=order)]
        add_packed(information, message.information, at)
        vector[at] += message.vector
    return information, vector


def eliminate(
    interior: Names, boundary: Names, information: Array, vector: Array, chi_square: float, redundancy: int
) -> tuple[Elimination, Message]:
    """Eliminate the interior of a front, and give the message about its boundary.

    Parameters
    ----------
    information : (f, f) lower triangle, interior first, without priors; overwritten. vector : (f,)
    chi_square, redundancy : sums over the parts of the front

    Raises
    ------
    NumericalError
        When the information is not positive semidefinite, or not finite.
    """
    k = len(interior)
    inner = np.ascontiguousarray(information[:k, :k])
    inner[np.diag_indices(k)] += 1.0
    root, below = np.empty((k + len(boundary), k), order="F"), np.zeros((len(boundary), k), order="F")
    shift = vector[:k].copy()
    rest = np.ascontiguousarray(information[k:, k:])
    if k:
        lower = cholesky(fill_symmetric(inner))
        root[:k] = np.tril(lower)
        shift = la.solve_triangular(lower, shift, lower=True)
        if len(boundary):
            below = la.blas.dtrsm(1.0, lower, np.asfortranarray(information[k:, :k]), side=1, lower=1, trans_a=1, overwrite_b=1)
            # a lower triangle in C order is an upper one in Fortran order
            rest = la.blas.dsyrk(-1.0, below, beta=1.0, c=rest.T, lower=0, overwrite_c=1).T
    root[k:] = below
    message = Message(boundary, packed(rest), vector[k:] - below @ shift, chi_square - float(shift @ shift), redundancy)
    return Elimination(interior, boundary, root, shift), message


def complete(done: Elimination, boundary: State | None) -> State:
    """Posterior state of a front, from that of its boundary (of any vectors that hold it; None where there is none)."""
    k, b = len(done.interior), len(done.boundary)
    covariance = np.zeros((k + b, k + b), order="F")
    mean = np.zeros(k + b)
    inner = np.asfortranarray(done.root[:k])
    if k:
        inverse, info = la.lapack.dpotri(inner.copy(order="F"), lower=1, overwrite_c=1)
        assert info == 0  # the root of a positive definite matrix
        covariance[:k, :k] = inverse
        mean[:k] = la.solve_triangular(inner, done.shift, lower=True, trans=1)
    if b:
        assert boundary is not None
        mean[k:], of_boundary = boundary.of(done.boundary)
        covariance[k:, k:] = of_boundary
        if k:
            gain = la.blas.dtrsm(1.0, inner, np.asfortranarray(done.root[k:].T), lower=1, trans_a=1)  # G (k, b)
            mean[:k] -= gain @ mean[k:]
            cross = la.blas.dsymm(-1.0, np.asfortranarray(of_boundary), gain, side=1, lower=1)  # P_IB
            covariance[:k, :k] = la.blas.dsyr2k(
                -0.5, cross, gain, beta=1.0, c=np.asfortranarray(covariance[:k, :k]), lower=1, overwrite_c=1
            )
            covariance[k:, :k] = cross.T
    names = np.concatenate([done.interior, done.boundary])
    order = np.argsort(names)
    whole = fill_symmetric(np.ascontiguousarray(covariance))
    return State(names[order], mean[order], packed(whole[np.ix_(order, order)]))


def carried(done: Elimination, names: Names, weights: Array) -> tuple[Array, Array]:
    """Carry functionals of a front's vectors to its boundary.

    Given the boundary, the interior is ``u_I = L_II^-T (y + z) - G u_B`` with z ~ N(0, I) independent of everything above and beside.

    Parameters
    ----------
    names : (f,) vectors of the front; weights : (n, f) of n functionals

    Returns
    -------
    noise (n, k), of z, and weights (n, b) of the boundary's vectors.
    """
    return carried_together(done, [(np.arange(len(weights)), names, weights)], len(weights))


def carried_together(done: Elimination, parts: Sequence[tuple[NDArray[np.int64], Names, Array]], count: int) -> tuple[Array, Array]:
    """`carried` for ``count`` sums of functionals; of each part the sums that it belongs to (rows, each once), its vectors and weights."""
    whole = np.concatenate([done.interior, done.boundary])
    order = np.argsort(whole)
    every = np.zeros((count, len(whole)))
    for rows, names, weights in parts:
        every[np.ix_(rows, order[np.searchsorted(whole, names, sorter=order)])] += weights
    k = len(done.interior)
    if not k:
        return np.zeros((count, 0)), every
    noise = la.solve_triangular(done.root[:k], every[:, :k].T, lower=True).T
    return noise, every[:, k:] - noise @ done.root[k:].T


def unpacked_state(state: State) -> tuple[Array, Array]:
    """Mean (q,) and covariance (q, q), both triangles, of all vectors of a state."""
    return state.mean, fill_symmetric(unpacked(state.covariance))
