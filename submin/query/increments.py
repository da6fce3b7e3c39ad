"""What has come to tiles since they were reconciled, added to their states.

With the same whitened vectors before and behind it (`submin.network.whitened_vectors`), what changed in the cells that tiles hold is added
to the state (u, P) of the time v when they were reconciled:

    P' = L (I + L' J L)^-1 L',   u' = u + P' (r - J u),   P = L L',   J = K' (S_now - S_v) K,   r = K' (h_now - h_v)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.estimation import cholesky
from submin.adjustment.symmetric import between, fill_symmetric
from submin.network.sub_min import add_sums
from submin.network.whitened_vectors import Vectors, first_rows
from submin.query.joint_vectors import Functionals, joint, parameter_rows, widened_prior
from submin.query.reconciled_state import Reconciled, TileState, TreeState
from submin.query.source import NetworkSource

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Names = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class WhitenedState:
    """Joint state of vectors: names (q,) ascending, mean (q,), covariance (q, q), both triangles."""

    names: Names
    mean: Array
    covariance: Array
    chi_square: float
    redundancy: int


@dataclass(frozen=True, eq=False)
class UnionState:
    """State of all images that some tiles see, beside what it depends on."""

    images: Index
    prior: sp.csr_array
    state: WhitenedState


def with_increments(
    source: NetworkSource,
    kept: Reconciled,
    tiles: Sequence[int],
    states: Sequence[TileState],
    trees: Mapping[str, TreeState],
    parameters: int,
) -> UnionState | None:
    """All images that some tiles see, from their states and what their cells sum to now beyond what they did then."""
    now, then = _increments(source, kept, tiles, states, trees)
    held = np.unique(np.concatenate([state.vectors.images for state in states]))
    rows = np.unique(np.concatenate([held, *(images for images, _ in (*now, *then))])).astype(np.int32)
    new = np.setdiff1d(rows, held).astype(np.int32)
    arrived = kept.vectors(new)
    names = np.unique(np.concatenate([arrived.names, *(state.vectors.names for state in states)]))
    parts = _parts(kept, tiles, states, trees, names)
    if parts is None:
        return None
    before = _before(kept, parts, names, trees)
    prior = _prior(rows, names, (*states, arrived), parameters)
    added, gone = add_sums(now, rows, parameters), add_sums(then, rows, parameters)
    difference = Sums(
        added.information - gone.information, added.vector - gone.vector, added.misclosure - gone.misclosure,
        added.redundancy - gone.redundancy,
    )  # fmt: skip
    return UnionState(rows, prior, with_sums(before, prior, difference))


def _increments(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState]
) -> tuple[list[tuple[Index, Sums]], list[tuple[Index, Sums]]]:
    """Sums of the cells that some tiles hold and that changed since: as they are now, and as they were."""
    now: dict[str, tuple[Index, Sums]] = {}
    then: dict[str, tuple[Index, Sums]] = {}
    existing = set(source.cell_numbers())
    for tile, state in zip(tiles, states, strict=True):
        version = trees[state.tree].version
        earlier = kept.earlier(version)
        for cell in set(source.cover.cells_held(tile)) & existing:
            if kept.changed.get(source.cover.owner(cell), 0) > version:
                now.setdefault(source.cover.cell_name(cell), source.cell_sums(cell))
        for cell in set(earlier.cover.cells_held(tile)) & set(earlier.cell_numbers()):
            owner = earlier.cover.owner(cell)
            if owner in source.cover.splits or kept.changed.get(owner, 0) > version:
                then.setdefault(earlier.cover.cell_name(cell), earlier.cell_sums(cell))
    return list(now.values()), list(then.values())


def _parts(
    kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState], names: Names
) -> list[Functionals] | None:
    """Each vector that the network knew when it was reconciled, from one tile that holds it; None when one is held nowhere.

    A vector of a pass or set that none of the tiles holds comes from another tile: its error is correlated with what they know.
    """
    parts, left = [], names
    for tile, state in zip(tiles, states, strict=True):
        parts.append(_of_names(tile, state, left))
        left = np.setdiff1d(left, state.vectors.names)
    for tree in trees.values():
        at = np.minimum(np.searchsorted(tree.shared, left), max(len(tree.shared) - 1, 0))
        found = tree.shared[at] == left if len(tree.shared) else np.zeros(len(left), dtype=np.bool_)
        for holder in np.unique(tree.holder[at[found]]).tolist():
            elsewhere = kept.tile(holder)
            if elsewhere is None:
                return None
            parts.append(_of_names(holder, elsewhere, left))
            left = np.setdiff1d(left, elsewhere.vectors.names)
    known = first_rows(left) < max(tree.images for tree in trees.values())
    return None if known.any() else [part for part in parts if len(part.columns)]


def _of_names(tile: int, state: TileState, names: Names) -> Functionals:
    columns = np.flatnonzero(np.isin(state.vectors.names, names)).astype(np.int64)
    return Functionals(tile, columns, sp.csr_array(sp.eye_array(len(columns))))


def _before(kept: Reconciled, parts: Sequence[Functionals], names: Names, trees: Mapping[str, TreeState]) -> WhitenedState:
    """State of all vectors as they were reconciled; those that are new have their prior."""
    of_parts = []
    for part in parts:
        state = kept.tile(part.tile)
        assert state is not None
        of_parts.append(state.vectors.names[part.columns])
    at = np.searchsorted(names, np.concatenate(of_parts))
    mean, covariance = np.zeros(len(names)), np.eye(len(names))
    mean[at], covariance[np.ix_(at, at)] = joint(kept, parts)
    return WhitenedState(
        names, mean, covariance, sum(tree.chi_square for tree in trees.values()), sum(tree.redundancy for tree in trees.values())
    )


def _prior(rows: Index, names: Names, known: Sequence[TileState | Vectors], parameters: int) -> sp.csr_array:
    """K of images (rows) by vectors (names), each image from the first that knows it."""
    blocks, place, left = [], [], np.ones(len(rows), dtype=np.bool_)
    for source in known:
        vectors = source.vectors if isinstance(source, TileState) else source
        chosen = np.flatnonzero(left & np.isin(rows, vectors.images))
        left[chosen] = False
        if not len(chosen):
            continue
        columns, prior = vectors.seen(rows[chosen])
        wide = widened_prior(prior, len(chosen), parameters).tocoo()
        at = np.searchsorted(names, vectors.names[columns])
        blocks.append(sp.coo_array((wide.data, (wide.row, at[wide.col])), shape=(wide.shape[0], len(names))))
        place.append(parameter_rows(chosen, parameters))
    whole = sp.vstack(blocks).tocsr()
    return sp.csr_array(whole[np.argsort(np.concatenate(place))])


def with_sums(state: WhitenedState, prior: sp.csr_array, sums: Sums) -> WhitenedState:
    """The state with more information about images, some of which may be taken away: what is left must be a sum of sources.

    Parameters
    ----------
    prior : K (m p, q) of the images by the state's vectors; sums : about the images
    """
    information = between(prior, fill_symmetric(sums.information.copy()), transposed=True)
    vector = prior.T @ sums.vector
    root = np.tril(cholesky(state.covariance.copy()))  # P = L L'
    half = la.blas.dtrmm(1.0, root, la.blas.dtrmm(1.0, root, np.asfortranarray(information), side=1, lower=1), lower=1, trans_a=1)
    half[np.diag_indices(len(half))] += 1.0
    inner = cholesky(np.ascontiguousarray(0.5 * (half + half.T)))  # of I + L' J L
    spread = la.blas.dtrsm(1.0, inner, np.asfortranarray(root.T), lower=1)
    covariance = fill_symmetric(np.ascontiguousarray(spread.T @ spread))
    misfit = vector - information @ state.mean
    moved = covariance @ misfit
    chi_square = (
        sums.misclosure - 2.0 * vector @ state.mean + state.mean @ information @ state.mean - misfit @ moved
    )  # what the new sources add at the new minimum
    return WhitenedState(
        state.names, state.mean + moved, covariance, state.chi_square + float(chi_square), state.redundancy + sums.redundancy
    )
