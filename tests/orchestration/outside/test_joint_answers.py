"""Points of several tiles of a reconciled network: exact, whichever way they are carried together."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from growing import HERE, with_more
from whole_network import points, truth

import submin
from orchestration.reconcile import reconcile
from submin.storage.catalogue_schema import Block
from submin.storage.network import Network
from submin.storage.reconciled import read_changes


def ways_noted(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Grows by whether a question was answered by combinations of images alone, for each that could have been."""
    ways: list[bool] = []
    direct = Network.combined_with_outside

    def noted(*arguments: Any) -> Any:
        state = direct(*arguments)
        ways.append(state is not None)
        return state

    monkeypatch.setattr(Network, "combined_with_outside", noted)
    return ways


def test_points_of_several_tiles_stay_exact_as_blocks_come(fuse: Callable[..., Path], few: list[Block]) -> None:
    new = few[-1].images[0].pass_id
    growing = with_more(fuse, [b for b in few if b.images[0].pass_id != new], [few[-1]])
    pair = [growing.touched()[0], growing.touched()[-1]]
    images = np.unique(
        np.concatenate(
            [
                growing.network.cell(c).images
                for t in pair
                for c in growing.network.cover.cells_held(t)
                if c in growing.network.cell_numbers()
            ]
        )
    ).astype(np.int32)
    state = growing.network.with_outside(pair, images)
    assert state is not None
    expected = truth(growing.network, growing.then, pair)
    _, at, covariance = points(growing.network, pair, expected)
    _, found_at, found = points(growing.network, pair, state)
    np.testing.assert_allclose(found, covariance, atol=1e-8 * np.abs(covariance).max(), rtol=0.0)
    assert np.abs(found_at - at).max() < 1e-6


def test_few_points_of_many_tiles_are_carried_up_the_tree_by_themselves(
    fuse: Callable[..., Path], few: list[Block], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fewer coordinates than image parameters: the same answer as over all of these, and as the monolithic network's."""
    place = fuse(few, tile_km=60.0, overlap_km=10.0)
    reconcile(str(place), HERE)
    network = submin.open(place)
    every, _, _ = points(network, network.snapshot.tile_numbers(), whole := truth(network))
    some = np.sort(np.random.default_rng(3).choice(every, 12, replace=False))
    ways = ways_noted(monkeypatch)
    found = network.query(points=some, policy="rigorous")
    assert ways == [True]
    assert len(found.tiles) > 3
    assert found.scope == "network"
    monkeypatch.setattr(Network, "combined_with_outside", lambda *_: None)
    over_images = submin.open(place).query(points=some, policy="rigorous")
    assert found.ids.tolist() == over_images.ids.tolist() == some.tolist()
    np.testing.assert_allclose(found.covariance, over_images.covariance, rtol=0.0, atol=1e-11 * np.abs(found.covariance).max())
    assert np.array_equal(found.covariance, found.covariance.T)
    np.testing.assert_allclose(found.geocentric, over_images.geocentric, rtol=0.0, atol=1e-8)
    ids, at, covariance = points(network, network.snapshot.tile_numbers(), whole)
    rows = np.flatnonzero(np.isin(ids, some))
    axes = (3 * rows[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(found.covariance, covariance[np.ix_(axes, axes)], rtol=0.0, atol=1e-8 * np.abs(covariance).max())
    assert np.abs(found.geocentric - at[rows]).max() < 1e-6


def test_few_points_of_tiles_that_nothing_came_to_are_of_those_tiles(
    fuse: Callable[..., Path], few: list[Block], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A block that comes elsewhere changes nothing that these tiles say, but for whom they speak."""
    place = fuse(few[:-1])
    reconcile(str(place), HERE)
    before = submin.open(place)
    number = fuse(few[-1:]) and submin.open(place).snapshot.number
    after = submin.open(place)
    changed = {tile for tile, version in read_changes(after.snapshot)["changed"].items() if version == number}
    cover = after.cover
    untouched = {t for t in after.snapshot.tile_numbers() if not changed & {cover.owner(cell) for cell in cover.cells_held(t)}}
    cells = [cell for cell in before.cell_numbers() if untouched.issuperset(cover.holders(cell)) and len(before.cell(cell)) > 3]
    some = np.concatenate([before.cell(cell).point_ids[:4] for cell in (cells[0], cells[-1])])
    ways = ways_noted(monkeypatch)
    found = [network.query(points=some, policy="rigorous") for network in (before, after)]
    assert ways == [True, True]
    assert [answer.scope for answer in found] == ["network", "tiles"]
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)
    np.testing.assert_array_equal(found[0].geocentric, found[1].geocentric)
