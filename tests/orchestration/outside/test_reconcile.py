"""What lies outside of tiles: after a reconciliation each tile alone is the whole network; what comes later is added, and counted once.

The truth of every answer is one factorisation of the very sources that it may know: cells as they are now where the tile holds them, and
elsewhere as they were when it was reconciled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import shapely
from growing import HERE, Growing, ends_of_a_pass, quiet, with_more
from networks import area_of, rewrite
from whole_network import excess, points, same, truth, whole_network

import submin
from orchestration.create import create, fit_catalogue
from orchestration.executors import executor_for
from orchestration.reconcile import reconcile, reconcile_changes
from orchestration.run import run
from orchestration.withdraw import withdraw
from submin.query.planner import points_of_tile
from submin.simulation.five_blocks import five_blocks
from submin.simulation.region import SimulatedRegion
from submin.simulation.scene import realise
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.repository import versions
from submin.storage.simulated import write_scene
from submin.storage.snapshot import Snapshot


@pytest.mark.parametrize(("tile_km", "overlap_km"), [(40.0, 0.0), (40.0, 15.0), (40.0, 39.0), (25.0, 10.0), (100.0, 50.0)])
def test_each_tile_alone_is_the_whole_network(
    fuse: Callable[..., Path], blocks: list[Block], tile_km: float, overlap_km: float
) -> None:  # fmt: skip
    """With cores of 25 km an image of 52 km spans three; corners of four tiles lie inside the region in every case."""
    place = fuse(blocks[:12], tile_km=tile_km, overlap_km=overlap_km)
    alone = submin.open(place)
    done = reconcile(str(place), HERE)
    assert (done.version, done.untouched) == ("v2", 0)
    assert done.tiles == len(alone.snapshot.tile_numbers())
    whole_network(place)
    # and is better than it was alone
    network = submin.open(place)
    tile = network.cover.tile_name(network.snapshot.tile_numbers()[0])
    assert network.query(tile=tile).ce90.mean() < 0.95 * alone.query(tile=tile).ce90.mean()


def test_again_after_more_blocks_and_consistent_between(fuse: Callable[..., Path], blocks: list[Block]) -> None:
    """Twenty more blocks, some of passes that the network knows, some new: every tile answers by what it may know, and by no more."""
    first, more = blocks[::2][:15], [*blocks[1::2], *blocks[::2][15:]]
    assert len(more) >= 20
    place = fuse(first, tile_km=60.0, overlap_km=20.0)
    reconcile(str(place), HERE)
    then = submin.open(place)
    fuse(more)
    network = submin.open(place)
    whole = truth(network)
    for tile in network.snapshot.tile_numbers():
        answer = network.query(tile=network.cover.tile_name(tile))
        ids, _, best = points(network, [tile], whole)
        assert answer.ids.tolist() == ids.tolist()
        assert excess(answer.covariance, best) <= 1.0 + 1e-6
    again = reconcile(str(place), HERE)
    assert again.version == "v4"
    whole_network(place)
    assert then.version == "v2"
    assert reconcile(str(place), HERE).version == "v4"  # nothing has changed
    assert reconcile_changes(str(place), HERE) is None


@pytest.mark.parametrize("overlap_km", [0.0, 15.0])
def test_a_block_of_a_new_pass_is_added(fuse: Callable[..., Path], few: list[Block], overlap_km: float) -> None:
    new = few[-1].images[0].pass_id
    old = [block for block in few if block.images[0].pass_id != new]
    growing = with_more(fuse, old, [few[-1]], overlap_km=overlap_km)
    changed = growing.network.snapshot.image_count() - growing.then.snapshot.image_count()
    assert changed == 3
    assert growing.check() >= 10
    name = growing.network.cover.tile_name(growing.touched()[0])
    answer, alone = growing.network.query(tile=name), growing.then.at("v1").query(tile=name)
    assert answer.scope == "tiles"
    assert np.median(answer.ce90) < np.median(alone.ce90)


def test_a_block_of_an_old_pass_is_added(fuse: Callable[..., Path], few: list[Block]) -> None:
    """The vector of its pass is known to the network, but not to the tiles that the block reaches."""
    growing, strange = ends_of_a_pass(fuse, few)
    assert growing.check() >= 10
    for tile in strange[:2]:
        same(growing.network, tile, truth(growing.network, growing.then, [tile]))


def test_rays_that_wait_for_their_second(fuse: Callable[..., Path], few: list[Block]) -> None:
    """Images that a tile sees by single rays only are in its state: their points come about later."""
    single = [
        dataclasses.replace(
            few[0],
            **{
                name: getattr(few[0], name)[few[0].image == 0]
                for name in ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")
            },
            images=few[0].images[:1],
        )
    ]
    others = [block for block in few[1:] if not np.isin(block.point_ids, few[0].point_ids).any()]
    near = [block for block in few[1:] if np.isin(block.point_ids, few[0].point_ids).any()]
    place = fuse(single + others)
    pending = sum(
        int((np.bincount(c.rays.point, minlength=len(c)) == 1).sum())
        for c in map(submin.open(place).cell, submin.open(place).cell_numbers())
    )
    assert pending >= 5
    reconcile(str(place), HERE)
    whole_network(place)
    fuse(near[:1])
    growing = Growing(place, "v2")
    assert growing.check() >= 5


def test_after_a_withdrawal_no_tile_counts_what_is_gone(fuse: Callable[..., Path], few: list[Block]) -> None:
    place = fuse(few)
    reconcile(str(place), HERE)
    withdraw(str(place), HERE, block=few[7].block_id)
    network = submin.open(place)
    whole = truth(network)
    for tile in network.snapshot.tile_numbers():
        answer = network.query(tile=network.cover.tile_name(tile))
        if len(answer.ids):
            assert excess(answer.covariance, points(network, [tile], whole)[2]) <= 1.0 + 1e-6
            assert answer.scope == "tiles"
    reconcile(str(place), HERE)
    whole_network(place)


def test_after_a_tile_was_split(fuse: Callable[..., Path], few: list[Block]) -> None:
    place = fuse(few[:8], tile_km=95.0, overlap_km=20.0, max_parameters=150)
    splits = submin.open(place).cover.splits
    reconcile(str(place), HERE)
    whole_network(place)
    fuse(few[8:])
    network = submin.open(place)
    assert len(network.cover.splits) > len(splits)
    whole = truth(network)
    for tile in network.snapshot.tile_numbers():
        answer = network.query(tile=network.cover.tile_name(tile))
        if len(answer.ids):
            assert excess(answer.covariance, points(network, [tile], whole)[2]) <= 1.0 + 1e-6
    reconcile(str(place), HERE)
    whole_network(place)


def test_islands_are_reconciled_by_themselves(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    """Two groups of blocks without a common point or pass: the one that nothing touches keeps its states."""
    few = quiet(list(Catalogue.open(catalogue).blocks()), region)
    first = [block for block in few if block.images[0].pass_id == few[0].images[0].pass_id]
    last = [block for block in few if block.images[0].pass_id == few[-1].images[0].pass_id]
    place = tmp_path / "islands"
    create(str(place), area_of(region), Catalogue.open(catalogue).metadata, 40.0, 5.0)

    def fused(part: Sequence[Block], name: str) -> None:
        assert run(Catalogue.open(rewrite(catalogue, tmp_path / name, list(part))), str(place), HERE).fused == len(part)

    fused(first, "first")
    fused(last[:-1], "last")
    done = reconcile(str(place), HERE)
    assert (done.parts, done.version) == (2, "v3")
    fused(last[-1:], "one-more")
    again = reconcile(str(place), HERE)
    assert again.parts == 2
    assert min(again.tiles, again.untouched) > 0
    whole = submin.open(place)
    state = truth(whole)
    for tile in whole.snapshot.tile_numbers():
        if points_of_tile(whole, tile):
            same(whole, tile, state)


def test_two_workers_give_the_same_states(fuse: Callable[..., Path], few: list[Block]) -> None:
    one, two = fuse(few[:8], "one"), fuse(few[:8], "two")
    reconcile(str(one), HERE)
    with executor_for(2) as executor:
        reconcile(str(two), executor)
    first, second = submin.open(one), submin.open(two)
    for tile in first.snapshot.tile_numbers():
        a, b = (network.query(tile=network.cover.tile_name(tile)) for network in (first, second))
        assert a.ids.tolist() == b.ids.tolist()
        if len(a.ids):
            np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-9 * np.abs(a.covariance).max(), rtol=0.0)


def test_images_whose_errors_are_correlated_in_their_block(tmp_path: Path) -> None:
    """The 2008 paper's five blocks: a block's vectors are held whole, also by tiles that see one of its images."""
    write_scene(realise(five_blocks(), 3), tmp_path / "catalogue")
    opened = Catalogue.open(tmp_path / "catalogue")
    area, _, _ = fit_catalogue(opened)
    create(str(tmp_path / "network"), area, opened.metadata, 12.0, 3.0)
    assert run(opened, str(tmp_path / "network"), HERE).fused == 5
    assert len(submin.open(tmp_path / "network").snapshot.tile_numbers()) >= 4
    reconcile(str(tmp_path / "network"), HERE)
    whole_network(tmp_path / "network")


def test_versions_before_stay_as_they_were(fuse: Callable[..., Path], few: list[Block]) -> None:
    place = fuse(few[:8])
    before = submin.open(place)
    tile = before.cover.tile_name(before.snapshot.tile_numbers()[0])
    expected = before.query(tile=tile).covariance
    reconcile(str(place), HERE)
    assert [v.name for v in versions(str(place))] == ["v2", "v1", "v0"]
    np.testing.assert_array_equal(submin.open(place).at("v1").query(tile=tile).covariance, expected)


# Wrong versions of the same, which claim what nobody knows.


def test_a_dense_network_has_nothing_outside(tmp_path: Path, catalogue: Path) -> None:
    create(str(tmp_path / "dense"), shapely.box(99.0, 34.0, 101.0, 36.0), Catalogue.open(catalogue).metadata, None, None, "dense")
    with pytest.raises(submin.errors.InputError, match="nothing to reconcile"):
        reconcile(str(tmp_path / "dense"), HERE)
    assert Snapshot.open(str(tmp_path / "dense")).number == 0
