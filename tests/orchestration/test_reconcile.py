"""What lies outside of tiles: after a reconciliation each tile alone is the whole network; what comes later is added, and counted once.

The truth of every answer is one factorisation of the very sources that it may know: cells as they are now where the tile holds them, and
elsewhere as they were when it was reconciled. Wrong versions of the same are shown to claim too much.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg as la
import shapely
from networks import area_of, rewrite
from numpy.typing import NDArray
from whole_network import excess, points, same, truth, whole_network

import submin
from orchestration.create import create, fit_catalogue
from orchestration.executors import SerialExecutor, executor_for
from orchestration.reconcile import reconcile, reconcile_changes
from orchestration.run import run
from orchestration.withdraw import withdraw
from submin.query import outside
from submin.query.outside import TreeState
from submin.query.planner import points_of_tile
from submin.query.source import NetworkSource
from submin.simulation.five_blocks import five_blocks
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region
from submin.simulation.scene import realise
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.network import Network
from submin.storage.network_store import Snapshot, versions
from submin.storage.reconciled import read_changes
from submin.storage.simulated import write_region, write_scene
from submin.tiling import tile_tree

Array = NDArray[np.float64]
HERE = SerialExecutor()
DESIGN = RegionDesign(width_km=190, height_km=190, point_spacing_km=10.0)
"""35 triplets in 7 passes, images of 52 km."""


@pytest.fixture(scope="module")
def region() -> SimulatedRegion:
    return simulate_region(DESIGN)


@pytest.fixture(scope="module")
def catalogue(region: SimulatedRegion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("wide") / "catalogue"
    write_region(region, path)
    return path


@pytest.fixture(scope="module")
def blocks(catalogue: Path) -> list[Block]:
    return list(Catalogue.open(catalogue).blocks())


@pytest.fixture
def fuse(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> Callable[..., Path]:
    """Fuse some blocks into a network, made over the region when there is none."""

    def run_blocks(blocks: Sequence[Block], name: str = "network", tile_km: float = 40.0, overlap_km: float = 15.0, **more: int) -> Path:
        place, number = tmp_path / name, len(list(tmp_path.iterdir()))
        if not place.exists():
            create(str(place), area_of(region), Catalogue.open(catalogue).metadata, tile_km, overlap_km, **more)
        result = run(Catalogue.open(rewrite(catalogue, tmp_path / f"blocks-{number}", list(blocks))), str(place), HERE)
        assert result.fused == len(blocks)
        return place

    return run_blocks


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


def quiet(blocks: Sequence[Block], region: SimulatedRegion) -> list[Block]:
    """The blocks without their blunders and bad cameras' rays: nothing is rejected later that was accepted before."""
    wrong = {
        (str(region.point_ids[p]), region.images[i].image_id)
        for p, i in zip(region.point[region.blunder], region.image[region.blunder], strict=True)
    }
    clean = []
    for block in blocks:
        if {image.image_id for image in block.images} & set(region.bad_cameras):
            continue
        names = [image.image_id for image in block.images]
        good = np.array([(str(p), names[i]) not in wrong for p, i in zip(block.point_ids, block.image, strict=True)])
        clean.append(with_rays(block, good))
    return clean


def with_rays(block: Block, rays: NDArray[np.bool_]) -> Block:
    """Some of a block's rays."""
    fields = ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")
    return dataclasses.replace(block, **{name: getattr(block, name)[rays] for name in fields})


class Growing:
    """A network that was reconciled, and what came after."""

    def __init__(self, place: Path, version: str) -> None:
        self.network, self.then = submin.open(place), submin.open(place).at(version)

    def tiles(self) -> Iterator[int]:
        """Tiles whose state of then is in use."""
        none = np.empty(0, dtype=np.int32)
        for tile in self.network.snapshot.tile_numbers():
            if points_of_tile(self.network, tile) and self.network.with_outside([tile], none) is not None:
                yield tile

    def touched(self) -> list[int]:
        """Those of them that hold what came."""
        new = self.then.snapshot.image_count()
        return [tile for tile in self.tiles() if (self.network.snapshot.tile_images(tile) >= new).any()]

    def check(self) -> int:
        """Of these tiles four that hold what came, and two others, answer by the very sources that they may know; how many there are."""
        tiles, touched = list(self.tiles()), self.touched()
        others = [tile for tile in tiles if tile not in touched]
        for tile in (*touched[:2], *touched[-2:], *others[:1], *others[-1:]):
            same(self.network, tile, truth(self.network, self.then, [tile]))
        assert touched
        return len(tiles)


@pytest.fixture
def few(region: SimulatedRegion, blocks: list[Block]) -> list[Block]:
    return quiet(blocks, region)[:16]


def with_more(fuse: Callable[..., Path], first: Sequence[Block], more: Sequence[Block], **cover: float) -> Growing:
    place = fuse(first, **cover)
    reconcile(str(place), HERE)
    fuse(more, **cover)
    return Growing(place, "v2")


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


def ends_of_a_pass(fuse: Callable[..., Path], few: Sequence[Block]) -> tuple[Growing, list[int]]:
    """The first block of a pass is there, then the last comes, without those between; and tiles that get it and do not hold the pass."""
    of_pass = [k for k, block in enumerate(few) if block.images[0].pass_id == few[0].images[0].pass_id]
    rest = [block for k, block in enumerate(few) if k not in of_pass[1:]]
    growing = with_more(fuse, rest, [few[of_pass[-1]]])
    pass_rows = np.flatnonzero(growing.network.snapshot.image_columns(["pass_id"])["pass_id"] == few[0].images[0].pass_id)
    strange = []
    for tile in growing.touched():
        state = growing.network._reconciled.tile(tile)
        if state is not None and not np.isin(state.vectors.images, pass_rows).any():
            strange.append(tile)
    assert strange
    return growing, strange


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


def test_a_dense_network_has_nothing_outside(tmp_path: Path, catalogue: Path) -> None:
    create(str(tmp_path / "dense"), shapely.box(99.0, 34.0, 101.0, 36.0), Catalogue.open(catalogue).metadata, None, None, "dense")
    with pytest.raises(submin.errors.InputError, match="nothing to reconcile"):
        reconcile(str(tmp_path / "dense"), HERE)
    assert Snapshot.open(str(tmp_path / "dense")).number == 0
