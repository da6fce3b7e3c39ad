"""Messages up and states down a tree of tiles, against one dense inverse: random tiles, vectors held by any number of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.symmetric import packed
from submin.network.outside_messages import (
    Elimination,
    Message,
    State,
    carried,
    complete,
    eliminate,
    front_of,
    unpacked_state,
)
from submin.tiling.tile_tree import TileTree, trees_of

Array = NDArray[np.float64]
Names = NDArray[np.int64]


class Tiles:
    """Random tiles: vectors that each holds, and what its own cells say of some of them."""

    def __init__(self, seed: int, count: int, vectors: int) -> None:
        rng = np.random.default_rng(seed)
        self.at = rng.uniform(0.0, 100.0, size=(count, 2))
        self.names = np.sort(rng.choice(10 * vectors, vectors, replace=False)).astype(np.int64)
        place = rng.uniform(0.0, 100.0, size=(vectors, 2))
        reach = rng.uniform(5.0, 60.0, size=vectors)
        near = np.linalg.norm(place[:, None] - self.at[None], axis=2) < reach[:, None]
        near[np.arange(vectors), rng.integers(count, size=vectors)] = True
        self.held = [self.names[near[:, t]] for t in range(count)]
        self.information, self.vector = [], []
        for names in self.held:
            said = rng.random(len(names)) < 0.7  # the others are held by shared cells, or by single rays, alone
            root = rng.normal(size=(len(names), len(names) + 2)) * 10.0 ** rng.uniform(-1, 2, size=len(names))[:, None] * said[:, None]
            self.information.append(root @ root.T)
            self.vector.append(root @ rng.normal(size=len(names) + 2))

    def whole(self) -> tuple[Array, Array]:
        """Mean and covariance of all vectors, at once."""
        total, right = np.eye(len(self.names)), np.zeros(len(self.names))
        for names, information, vector in zip(self.held, self.information, self.vector, strict=True):
            at = np.searchsorted(self.names, names)
            total[np.ix_(at, at)] += information
            right[at] += vector
        covariance = np.linalg.inv(total)
        return covariance @ right, covariance

    def eliminations(self, tree: TileTree) -> list[Elimination]:
        """Of every node of a tree."""
        done: list[tuple[Elimination, Message]] = []
        for node in tree.nodes:
            names = np.concatenate([node.interior, node.boundary])
            if node.children:
                information, vector = front_of(names, [done[c][1] for c in node.children])
            else:
                order = np.searchsorted(self.held[node.tile], names)
                information, vector = self.information[node.tile][np.ix_(order, order)], self.vector[node.tile][order]
            done.append(eliminate(node.interior, node.boundary, information, vector, 0.0, 0))
        return [elimination for elimination, _ in done]


def states_of(tree: TileTree, eliminations: list[Elimination]) -> list[State]:
    parents, states = tree.parents(), [None] * len(tree.nodes)
    for k in reversed(range(len(tree.nodes))):
        states[k] = complete(eliminations[k], states[parents[k]] if parents[k] >= 0 else None)
    return states


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 9), vectors=st.integers(1, 40))
def test_every_tile_has_the_marginal_of_the_whole(seed: int, count: int, vectors: int) -> None:
    tiles = Tiles(seed, count, vectors)
    mean, covariance = tiles.whole()
    trees = trees_of(range(count), tiles.held, tiles.at)
    assert sorted(tile for tree in trees for tile in tree.tiles) == list(range(count))
    for tree in trees:
        eliminated = np.concatenate([node.interior for node in tree.nodes])
        assert len(np.unique(eliminated)) == len(eliminated)  # each prior once
        assert len(tree.nodes[-1].boundary) == 0
        states = states_of(tree, tiles.eliminations(tree))
        for node, state in zip(tree.nodes, states, strict=True):
            at = np.searchsorted(tiles.names, state.names)
            found_mean, found = unpacked_state(state)
            np.testing.assert_allclose(found, covariance[np.ix_(at, at)], atol=1e-9)
            np.testing.assert_allclose(found_mean, mean[at], atol=1e-8 * max(1.0, np.abs(mean).max()))
            if node.tile >= 0:
                np.testing.assert_array_equal(state.names, tiles.held[node.tile])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(2, 9), vectors=st.integers(2, 40))
def test_what_two_tiles_have_in_common_is_the_noise_that_both_pass(seed: int, count: int, vectors: int) -> None:
    tiles = Tiles(seed, count, vectors)
    _, covariance = tiles.whole()
    for tree in trees_of(range(count), tiles.held, tiles.at):
        eliminations, parents = tiles.eliminations(tree), tree.parents()
        ways = []
        for k, node in enumerate(tree.nodes):
            if node.tile < 0:
                continue
            names, weights, place, noise = tiles.held[node.tile], np.eye(len(tiles.held[node.tile])), k, {}
            while place >= 0:
                noise[place], weights = carried(eliminations[place], names, weights)
                names, place = eliminations[place].boundary, parents[place]
            ways.append((np.searchsorted(tiles.names, tiles.held[node.tile]), noise))
        for one, first in ways:
            for other, second in ways:
                common = sum((first[n] @ second[n].T for n in first.keys() & second.keys()), np.zeros((len(one), len(other))))
                np.testing.assert_allclose(common, covariance[np.ix_(one, other)], atol=1e-9)


def test_tiles_without_a_common_vector_are_trees_of_their_own() -> None:
    held = [np.array([1, 2]), np.array([2, 3]), np.array([7]), np.array([3, 9])]
    trees = trees_of([4, 5, 6, 7], held, np.arange(8.0).reshape(4, 2))
    assert sorted(tree.tiles for tree in trees) == [(4, 5, 7), (6,)]
    assert trees_of([], [], np.empty((0, 2))) == ()


def test_a_grid_is_cut_into_halves() -> None:
    """Sixteen tiles in a row and column each share a vector with their neighbours: no front is much wider than a side of the grid."""
    side = 8
    held: list[list[int]] = [[] for _ in range(side * side)]
    for k in range(side * side):
        for neighbour in ([k + 1] if k % side < side - 1 else []) + ([k + side] if k + side < side * side else []):
            name = 1000 * k + neighbour
            held[k].append(name)
            held[neighbour].append(name)
    at = np.array([(k % side, k // side) for k in range(side * side)], dtype=np.float64)
    (tree,) = trees_of(range(side * side), [np.array(sorted(names), dtype=np.int64) for names in held], at)
    assert max(len(node.interior) + len(node.boundary) for node in tree.nodes) <= 3 * side
    assert len(tree.nodes) == 2 * side * side - 1


def test_messages_are_summed_where_their_vectors_are() -> None:
    one = Message(np.array([3, 8]), packed(np.array([[2.0, 0.0], [1.0, 5.0]])), np.array([1.0, 2.0]), 0.0, 0)
    two = Message(np.array([8]), packed(np.array([[7.0]])), np.array([4.0]), 0.0, 0)
    information, vector = front_of(np.array([8, 5, 3]), [one, two])
    np.testing.assert_array_equal(np.tril(information), [[12.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 2.0]])
    np.testing.assert_array_equal(vector, [6.0, 0.0, 1.0])


def test_information_that_is_negative_is_an_error() -> None:
    from submin.errors import NumericalError

    with pytest.raises(NumericalError, match="not positive definite"):
        eliminate(np.array([1]), np.array([], dtype=np.int64), np.array([[-2.0]]), np.array([0.0]), 0.0, 0)
