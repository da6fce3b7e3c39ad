"""A tree of tiles by nested dissection: cut in two, again and again, where the fewest whitened vectors are held on both sides.

A connected part of the network, whose tiles share vectors with no other, is a tree of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.float64]
Names = NDArray[np.int64]

LEAST_SIDE = 0.3
"""Part of a node's vectors that the smaller of its halves has at least, where the tiles let it."""
CUTS = 9
"""So many places of a cut are compared along each axis."""


@dataclass(frozen=True, eq=False)
class TreeNode:
    """A node: one tile, or two nodes together.

    Attributes
    ----------
    tile : number of the tile, or -1; children : places of the two nodes in the tree, none of a tile
    interior : names of the vectors that are eliminated here: held in this part of the tree, and by no tile outside
    boundary : those of the front that tiles outside hold too; both ascending
    """

    tile: int
    children: tuple[int, ...]
    interior: Names
    boundary: Names


@dataclass(frozen=True, eq=False)
class TileTree:
    """A connected part of the network: its nodes, children before parents, the root last."""

    nodes: tuple[TreeNode, ...]

    @property
    def tiles(self) -> tuple[int, ...]:
        """Tiles of the tree."""
        return tuple(node.tile for node in self.nodes if node.tile >= 0)

    def parents(self) -> tuple[int, ...]:
        """Place of each node's parent, -1 for the root."""
        parent = [-1] * len(self.nodes)
        for k, node in enumerate(self.nodes):
            for child in node.children:
                parent[child] = k
        return tuple(parent)


def trees_of(tiles: Sequence[int], held: Sequence[Names], at: Array) -> tuple[TileTree, ...]:
    """Trees over some tiles, one for each connected part.

    Parameters
    ----------
    tiles : t numbers; held : names of the vectors that each holds, ascending; at : (t, 2) middles of their cores in the plane, metres
    """
    if not len(tiles):
        return ()
    names, column = np.unique(np.concatenate(held), return_inverse=True)
    row = np.repeat(np.arange(len(tiles)), [len(h) for h in held])
    holds = sp.csr_array((np.ones(len(row), dtype=np.int32), (row, column)), shape=(len(tiles), len(names)))
    count, label = connected_components(holds @ holds.T, directed=False)
    return tuple(_tree(np.flatnonzero(label == k), np.asarray(tiles), holds, names, at) for k in range(count))


def _tree(members: Names, tiles: Names, holds: sp.csr_array, names: Names, at: Array) -> TileTree:
    everywhere = np.asarray(holds[members].sum(axis=0)).ravel()
    nodes: list[TreeNode] = []

    def grow(part: Names) -> tuple[int, NDArray[np.int64]]:
        """Add the node of some tiles after those below it: its place, and the columns of its boundary."""
        here = np.asarray(holds[part].sum(axis=0)).ravel()
        children: tuple[int, ...] = ()
        front = np.flatnonzero(here)
        if len(part) > 1:
            below = [grow(half) for half in _cut(part, holds[part], at[part])]
            children = tuple(place for place, _ in below)
            front = np.unique(np.concatenate([boundary for _, boundary in below]))
        inner = here[front] == everywhere[front]
        tile = int(tiles[part[0]]) if len(part) == 1 else -1
        nodes.append(TreeNode(tile, children, names[front[inner]], names[front[~inner]]))
        return len(nodes) - 1, front[~inner]

    grow(members)
    return TileTree(tuple(nodes))


def _cut(part: Names, holds: sp.csr_array, at: Array) -> tuple[Names, Names]:
    """The two halves of some tiles: fewest vectors on both sides, among cuts that leave a fair part of them on each."""
    weight = np.diff(holds.indptr).astype(np.float64)
    best: tuple[float, Names, Names] | None = None
    for axis in (0, 1):
        order = np.lexsort((at[:, 1 - axis], at[:, axis]))
        share = np.cumsum(weight[order])[:-1] / weight.sum()
        fair = np.flatnonzero((share >= LEAST_SIDE) & (share <= 1.0 - LEAST_SIDE))
        if not len(fair):
            fair = np.array([int(np.argmin(np.abs(share - 0.5)))])
        for cut in fair[np.unique(np.linspace(0, len(fair) - 1, min(CUTS, len(fair))).round().astype(np.int64))]:
            first, second = order[: cut + 1], order[cut + 1 :]
            both = sum(
                ((np.asarray(holds[half].sum(axis=0)).ravel() > 0).astype(np.int64) for half in (first, second)),
                np.zeros(holds.shape[1], dtype=np.int64),
            )
            cost = float((both == 2).sum())
            if best is None or cost < best[0]:
                best = cost, np.sort(part[first]), np.sort(part[second])
    assert best is not None
    return best[1], best[2]
