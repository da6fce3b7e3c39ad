"""Wrong versions of a reconciliation, each of which claims what nobody knows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as la
from growing import HERE, ends_of_a_pass, with_more
from numpy.typing import NDArray
from whole_network import excess, points, truth, whole_network

import submin
from orchestration.reconcile import reconcile
from orchestration.withdraw import withdraw
from submin.query import outside
from submin.query.reconciled_state import TreeState
from submin.query.source import NetworkSource
from submin.storage.catalogue_schema import Block
from submin.storage.network import Network
from submin.tiling import tile_tree

Array = NDArray[np.float64]


def worst(network: Network, tiles: Iterator[int] | Sequence[int]) -> float:
    """The largest excess of what tiles claim over what the sources of the whole network know."""
    whole = truth(network)
    found = []
    for tile in tiles:
        answer = network.query(tile=network.cover.tile_name(tile))
        if len(answer.ids):
            found.append(excess(answer.covariance, points(network, [tile], whole)[2]))
    return max(found)


def test_wrong_a_stale_state_after_a_withdrawal(fuse: Callable[..., Path], few: list[Block], monkeypatch: pytest.MonkeyPatch) -> None:
    """Most of the images go again; states that still count them claim too much."""
    place = fuse(few[:14])
    reconcile(str(place), HERE)
    for block in few[6:12]:
        withdraw(str(place), HERE, block=block.block_id)
    assert worst(submin.open(place), submin.open(place).snapshot.tile_numbers()) <= 1.0 + 1e-6
    monkeypatch.setattr(outside, "_stale", lambda tree, kept, tiles: False)
    assert worst(submin.open(place), submin.open(place).snapshot.tile_numbers()) > 1.5


def test_wrong_the_prior_of_an_old_pass_again(fuse: Callable[..., Path], few: list[Block], monkeypatch: pytest.MonkeyPatch) -> None:
    """A pass that the network knows, taken as one that it does not: its prior counts twice, and its errors as independent."""
    growing, strange = ends_of_a_pass(fuse, few)
    right = {t: points(growing.network, [t], truth(growing.network, growing.then, [t]))[2] for t in strange}
    read = growing.network._reconciled.tree

    def forgetful(name: str) -> TreeState:
        return dataclasses.replace(read(name), images=0, shared=np.empty(0, np.int64), holder=np.empty(0, np.int64))

    wrong = submin.open(growing.network.snapshot.place)
    monkeypatch.setattr(wrong._reconciled, "tree", forgetful)
    found = [excess(wrong.query(tile=wrong.cover.tile_name(t)).covariance, right[t]) for t in strange]
    assert max(found) > 1.0 + 1e-4


def test_wrong_shared_cells_counted_again(fuse: Callable[..., Path], few: list[Block], monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells that changed added whole, and not by what they gained: their information counts twice."""
    growing = with_more(fuse, few[:-1], few[-1:])
    right = {t: points(growing.network, [t], truth(growing.network, growing.then, [t]))[2] for t in growing.touched()[:3]}

    class Empty:
        def __init__(self, network: NetworkSource) -> None:
            self.cover = network.cover

        def cell_numbers(self) -> tuple[int, ...]:
            return ()

    wrong = submin.open(growing.network.snapshot.place)
    monkeypatch.setattr(wrong._reconciled, "earlier", lambda version: Empty(wrong))
    assert max(excess(wrong.query(tile=wrong.cover.tile_name(t)).covariance, p) for t, p in right.items()) > 1.1


def test_wrong_vectors_eliminated_where_others_hold_them_by_single_rays(
    fuse: Callable[..., Path], few: list[Block], monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """Interior by ownership alone: what a neighbour holds in shared cells would be eliminated before it is asked about."""
    place = fuse(few[:10])
    network = submin.open(place)
    grow = tile_tree.trees_of

    def by_own_cells(tiles: Sequence[int], held: Sequence[NDArray[np.int64]], at: Array) -> tuple[tile_tree.TileTree, ...]:
        own = []
        for tile, names in zip(tiles, held, strict=True):
            cells = [network.cell_sums(c)[0] for c in network.cover.cells_owned(tile) if c in network.cell_numbers()]
            rows = np.unique(np.concatenate([*cells, np.empty(0, np.int32)]))
            own.append(names[(names >= 1 << 50) | np.isin(names >> 10, rows)])
        return grow(tiles, own, at)

    monkeypatch.setattr("orchestration.reconcile.trees_of", by_own_cells)
    with pytest.raises((IndexError, ValueError, AssertionError)):
        reconcile(str(place), HERE)
        whole_network(place)


def test_wrong_messages_of_two_tiles_added(fuse: Callable[..., Path], few: list[Block]) -> None:
    """What lies outside of one tile is mostly outside of the other too: added, it counts twice."""
    place = fuse(few[:10])
    reconcile(str(place), HERE)
    network = submin.open(place)
    pair = None
    for tile in network.snapshot.tile_numbers():
        for other in network.cover.neighbours(tile):
            states = [network._reconciled.tile(t) for t in (tile, other)]
            if all(states):
                pair = tile, other
    assert pair is not None
    states = [network._reconciled.tile(t) for t in pair]
    assert states[0] is not None
    assert states[1] is not None
    common = np.intersect1d(states[0].vectors.names, states[1].vectors.names)
    assert len(common)
    posterior, message = [], []
    for tile, state in zip(pair, states, strict=True):
        at = np.searchsorted(state.vectors.names, common)
        posterior.append(network._reconciled.covariance(tile, at))
        message.append(la.inv(posterior[-1]) - np.eye(len(common)))
    np.testing.assert_allclose(posterior[0], posterior[1], atol=1e-9)
    assert excess(la.inv(np.eye(len(common)) + message[0] + message[1]), posterior[0]) > 1.9
