"""What tiles say with all that lies outside of them: the marginal of the whole network as it was reconciled, and what has come since.

A reconciled tile keeps the posterior state of the whitened vectors that it holds, of some version. What has come since to the cells that
it holds is added (`submin.query.increments`). A state is not used once something that it counts is gone: a tile outside has lost a ray
since, or a prior has changed (decision 014; docs/mathematics.md, "Outside messages").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.symmetric import between
from submin.network.sub_min import CombinedState, SubMin
from submin.query.increments import UnionState, with_increments
from submin.query.joint_vectors import Functionals, joint, parameter_rows, summed_noise, widened_prior
from submin.query.reconciled_state import Reconciled, TileState, TreeState
from submin.query.source import NetworkSource

Index = NDArray[np.int32]


def tiles_with_outside(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], images: Index, memory: dict[tuple[int, ...], UnionState]
) -> SubMin | None:
    """A posteriori state of ``images`` from some tiles and all that lies outside of them; None where that is not known any more.

    ``memory`` keeps what tiles say together with what has come since they were reconciled.
    """
    known = _known(kept, tiles)
    if known is None:
        return None
    states, trees = known
    p = source.image_set(images[:1]).parameters
    if _unchanged(source, kept, tiles, states, trees):
        return _as_reconciled(kept, tiles, states, trees, images, p)
    key = tuple(sorted(tiles))
    if key not in memory:
        union = with_increments(source, kept, tiles, states, trees, p)
        if union is None:
            return None
        memory.clear()
        memory[key] = union
    union = memory[key]
    at = np.searchsorted(union.images, images)
    if (at >= len(union.images)).any() or (union.images[at] != images).any():
        return None
    k = union.prior[parameter_rows(at, p)]
    state = union.state
    return SubMin(
        images, np.asarray(k @ state.mean).reshape(-1, p), between(k, state.covariance), state.chi_square, state.redundancy, whole=False
    )


def _known(kept: Reconciled, tiles: Sequence[int]) -> tuple[list[TileState], dict[str, TreeState]] | None:
    """The states of some tiles, and the parts of the network that they are of.

    None where a tile has none, or where one counts something that is no more.
    """
    states = [state for state in (kept.tile(tile) for tile in tiles) if state is not None]
    if not tiles or len(states) < len(tiles):
        return None
    trees = {name: kept.tree(name) for name in {state.tree for state in states}}
    return None if any(_stale(tree, kept, tiles) for tree in trees.values()) else (states, trees)


def _unchanged(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState]
) -> bool:
    """True when nothing has come to the cells of some tiles since they were reconciled."""
    return not any(_changed_owners(source, kept, tile, trees[state.tree].version) for tile, state in zip(tiles, states, strict=True))


def _nothing_since(kept: Reconciled, trees: Mapping[str, TreeState]) -> bool:
    """True when nothing has come to any tile of these parts of the network since they were reconciled."""
    return all(kept.changed.get(tile, 0) <= tree.version for tree in trees.values() for tile in tree.tiles)


def _stale(tree: TreeState, kept: Reconciled, tiles: Sequence[int]) -> bool:
    """True when the states of a part count something that is no more, outside of some tiles."""
    return other_priors(tree, kept.released) or kept.gone(tiles) > tree.version


def other_priors(tree: TreeState, released: frozenset[int]) -> bool:
    """True when the prior of an image of a part has been released since, or is in use again."""
    now = np.array(sorted(released), dtype=np.int64)
    return set(now[np.isin(now, tree.members)].tolist()) != tree.released


def _changed_owners(source: NetworkSource, kept: Reconciled, tile: int, version: int) -> bool:
    owners = {source.cover.owner(cell) for cell in source.cover.cells_held(tile)}
    return any(kept.changed.get(owner, 0) > version for owner in owners)


def _as_reconciled(
    kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState], images: Index, parameters: int,
) -> SubMin | None:  # fmt: skip
    """Images as the states of some tiles have them; one tile alone where it sees them all."""
    chosen = _first_to_see(states, images)
    if chosen is None:
        return None
    parts, order = [], []
    for k, rows in chosen:
        columns, prior = states[k].vectors.seen(images[rows])
        parts.append(Functionals(tiles[k], columns, widened_prior(prior, len(rows), parameters)))
        order.append(parameter_rows(rows, parameters))
    mean, covariance = joint(kept, parts)
    if len(parts) > 1:  # of one tile they are in order
        place = np.argsort(np.concatenate(order))
        mean, covariance = mean[place], covariance[np.ix_(place, place)]
    chi_square = sum(tree.chi_square for tree in trees.values())
    redundancy = sum(tree.redundancy for tree in trees.values())
    return SubMin(
        images, mean.reshape(-1, parameters), covariance, chi_square, redundancy, whole=_nothing_since(kept, trees)
    )  # fmt: skip


def _first_to_see(states: Sequence[TileState], images: Index) -> list[tuple[int, NDArray[np.int64]]] | None:
    """For some of the states the places of the images that are taken from each, of one alone where it sees them all.

    None where an image is seen by none.
    """
    sees = [np.isin(images, state.vectors.images) for state in states]
    if len(images) and not np.any(sees, axis=0).all():
        return None
    alone = [k for k, seen in enumerate(sees) if seen.all()]
    of_image = np.full(len(images), alone[0]) if alone else np.argmax(sees, axis=0)
    return [(int(k), np.flatnonzero(of_image == k)) for k in np.unique(of_image)]


def combined_with_outside(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], images: Index, loading: sp.csr_array
) -> CombinedState | None:
    """What ``loading`` (n, m p) makes of the m ``images``, from some tiles and all that lies outside of them.

    Few combinations of many images, as coordinates of points are, cost less to carry up the tree than all parameters of the images.
    None where one tile sees all images or something has come since they were reconciled (see `tiles_with_outside`), or nobody can tell.
    """
    known = _known(kept, tiles)
    if known is None or not _unchanged(source, kept, tiles, *known):
        return None
    states, trees = known
    chosen, p = _first_to_see(states, images), source.image_set(images[:1]).parameters
    if chosen is None or len(chosen) < 2:
        return None
    parts, theta = [], np.zeros((len(images), p))
    for k, rows in chosen:
        columns, prior = states[k].vectors.seen(images[rows])
        wide = widened_prior(prior, len(rows), p)
        theta[rows] = np.asarray(wide @ states[k].mean[columns]).reshape(-1, p)
        of_images = loading[:, parameter_rows(rows, p)]
        concerned = np.flatnonzero(np.diff(of_images.indptr))
        parts.append((Functionals(tiles[k], columns, sp.csr_array(of_images[concerned] @ wide)), concerned))
    return CombinedState(images, theta, summed_noise(kept, parts, loading.shape[0]), _nothing_since(kept, trees))
