"""Combinations of the whitened vectors of reconciled tiles: jointly, carried up the tree where they are of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.symmetric import between
from submin.network.cell import kept_rows
from submin.network.outside_messages import carried, carried_together
from submin.query.reconciled_state import Reconciled

Array = NDArray[np.float64]
Names = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Functionals:
    """Combinations of a tile's vectors: weights (n, k) of its columns (k,), ascending."""

    tile: int
    columns: NDArray[np.int64]
    weights: sp.csr_array


def joint(kept: Reconciled, parts: Sequence[Functionals]) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n), both triangles, of combinations of the vectors of several tiles.

    Of one tile they come from its own state. Those of two are carried up the tree: what they have in common is the noise of the nodes on
    both ways to the root. Different parts of the network are independent.
    """
    if len(parts) == 1:  # a large matrix is made once
        (part,), state = parts, kept.tile(parts[0].tile)
        assert state is not None
        return part.weights @ state.mean[part.columns], between(part.weights, kept.covariance(part.tile, part.columns))
    ends = np.cumsum([0, *(part.weights.shape[0] for part in parts)])
    mean, covariance = np.empty(ends[-1]), np.zeros((ends[-1], ends[-1]))
    passing: dict[tuple[str, int], list[tuple[int, Array]]] = {}
    for k, part in enumerate(parts):
        for node, noise in _way_up(kept, part).items():
            passing.setdefault(node, []).append((k, noise))
    for ways in passing.values():
        if len(ways) > 1:  # what only one passes is in its own block
            rows = np.concatenate([np.arange(ends[k], ends[k + 1]) for k, _ in ways])
            noise = np.concatenate([noise for _, noise in ways])
            covariance[np.ix_(rows, rows)] += noise @ noise.T
    for k, part in enumerate(parts):
        own, state = slice(ends[k], ends[k + 1]), kept.tile(part.tile)
        assert state is not None
        mean[own] = part.weights @ state.mean[part.columns]
        covariance[own, own] = between(part.weights, kept.covariance(part.tile, part.columns))
    return mean, covariance


def _way_up(kept: Reconciled, part: Functionals) -> dict[tuple[str, int], Array]:
    """Noise (n, k) of combinations of a tile's vectors at every node of its tree from the tile to the root."""
    state = kept.tile(part.tile)
    assert state is not None
    names, weights = state.vectors.names, np.zeros((part.weights.shape[0], len(state.vectors.names)))
    weights[:, part.columns] = part.weights.toarray()
    parents, node, noise = kept.tree(state.tree).parents, state.node, {}
    while node >= 0:
        done = kept.elimination(state.tree, node)
        noise[state.tree, node], weights = carried(done, names, weights)
        names, node = done.boundary, parents[node]
    return noise


def summed_noise(kept: Reconciled, parts: Sequence[tuple[Functionals, NDArray[np.int64]]], count: int) -> Array:
    """Covariance (n, n) of ``count`` sums of combinations of the vectors of several tiles; of each part also the sums that it belongs to.

    All of it is noise of the nodes above the tiles. What tiles add to the same sum is one combination from the node on where their ways
    meet, so the large nodes near the root are passed once.
    """
    arriving: dict[tuple[str, int], list[tuple[NDArray[np.int64], Names, Array]]] = {}
    depth: dict[tuple[str, int], int] = {}
    for part, sums in parts:
        state = kept.tile(part.tile)
        assert state is not None
        weights = np.zeros((len(sums), len(state.vectors.names)))
        weights[:, part.columns] = part.weights.toarray()
        arriving.setdefault((state.tree, state.node), []).append((sums, state.vectors.names, weights))
        way, node, parents = [], state.node, kept.tree(state.tree).parents
        while node >= 0:
            way.append((state.tree, node))
            node = parents[node]
        depth.update((key, len(way) - k) for k, key in enumerate(way))
    covariance = np.zeros((count, count))
    for tree, node in sorted(depth, key=lambda key: -depth[key]):  # children before their parents
        come = arriving.pop((tree, node))
        sums = np.unique(np.concatenate([of_part for of_part, _, _ in come]))
        done = kept.elimination(tree, node)
        here = [(np.searchsorted(sums, of_part), names, given) for of_part, names, given in come]
        noise, weights = carried_together(done, here, len(sums))
        covariance[np.ix_(sums, sums)] += noise @ noise.T
        parent = kept.tree(tree).parents[node]
        if parent >= 0:
            arriving.setdefault((tree, parent), []).append((sums, done.boundary, weights))
    return covariance


def parameter_rows(images: NDArray[np.integer], parameters: int) -> NDArray[np.int64]:
    """Rows (m p,) of the parameters of images at these places."""
    return np.asarray((images.astype(np.int64)[:, None] * parameters + np.arange(parameters)).ravel())


def widened_prior(prior: sp.csr_array, images: int, parameters: int) -> sp.csr_array:
    """K of some images with so many parameters each; what is added is zero."""
    old = prior.shape[0] // max(images, 1)
    if not images or old == parameters:
        return prior
    place = sp.csr_array(
        (np.ones(images * old), (kept_rows(images, old, parameters), np.arange(images * old))), shape=(images * parameters, images * old)
    )
    return sp.csr_array(place @ prior)
