"""What a block would bring to a tile, against the factorisation of the same rays and against the network that a run makes of it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from networks import area_of, fuse, rewrite

import submin
from submin.errors import QueryError
from submin.network.sub_min import add_sums, factor
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.network import Network
from submin.storage.simulated import write_region

DESIGN = RegionDesign(width_km=100, height_km=100, point_spacing_km=9.0, blunder_rate=0.0, bad_cameras=0, seed=2)


@dataclasses.dataclass(frozen=True)
class World:
    """A network without the last block, the block, and the network with it."""

    network: Network
    block: Block
    after: Network
    fused: Block


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("world")
    region = simulate_region(DESIGN)
    write_region(region, folder / "catalogue")
    blocks = list(Catalogue.open(folder / "catalogue").blocks())
    earlier = rewrite(folder / "catalogue", folder / "earlier", blocks[:-1])
    for name, catalogue in (("before", earlier), ("after", folder / "catalogue")):
        fuse(catalogue, folder / name, area_of(region), tile_km=70.0, overlap_km=20.0)
    return World(submin.open(folder / "before"), blocks[-1], submin.open(folder / "after"), blocks[0])


def tile_of(world: World) -> str:
    """The tile that holds most of the block's points."""
    cells = world.network.snapshot.candidate_cells(np.unique(world.block.point_ids))
    cover = world.network.cover
    tiles = world.network.snapshot.tile_numbers()
    return cover.tile_name(max(tiles, key=lambda tile: int(np.isin(cells, cover.cells_held(tile)).sum())))


def test_it_is_the_factorisation_of_the_cells_with_the_block(world: World) -> None:
    preview = world.network.tile(tile_of(world)).with_block(world.block)
    source = preview._source
    cells = [source.cell_sums(number) for number in source.cover.cells_held(source.tile) if number in source.cell_numbers()]
    rows = np.unique(np.concatenate([images for images, _ in cells])).astype(np.int32)
    expected = factor(add_sums(cells, rows, 6), rows, source.image_set(rows))
    found = source.fused.sub_min
    sigma = np.sqrt(np.diag(expected.covariance))
    np.testing.assert_array_equal(found.images, expected.images)
    assert np.abs((found.covariance - expected.covariance) / sigma / sigma[:, None]).max() < 1e-9
    in_sigmas = expected.theta.ravel() / sigma
    assert np.abs(found.theta.ravel() / sigma - in_sigmas).max() < 1e-9 * np.abs(in_sigmas).max()
    assert found.chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    assert found.redundancy == expected.redundancy


def test_it_is_what_a_run_makes_of_the_block_to_the_second_order(world: World) -> None:
    tile = tile_of(world)
    preview, after = world.network.tile(tile).with_block(world.block).query(), world.after.tile(tile).query()
    # the tile holds the same points when nothing is registered anew elsewhere
    both, one, other = np.intersect1d(preview.ids, after.ids, return_indices=True)
    assert len(both) > 0.9 * len(after.ids)
    sigma = np.sqrt(np.diag(after.covariance)).reshape(-1, 3)[other]
    assert (np.abs(preview.geocentric[one] - after.geocentric[other]) / sigma).max() < 0.1
    found = np.sqrt(np.diag(preview.covariance)).reshape(-1, 3)[one]
    np.testing.assert_allclose(found, sigma, rtol=0.02)


def test_no_point_gets_worse_and_the_network_stays_as_it_was(world: World) -> None:
    tile = tile_of(world)
    before = world.network.tile(tile).query()
    preview = world.network.tile(tile).with_block(world.block).query(before.ids.tolist())
    np.testing.assert_array_equal(preview.ids, before.ids)
    sigma = np.sqrt(np.diag(before.covariance))
    gain = (before.covariance - preview.covariance) / sigma / sigma[:, None]
    assert np.linalg.eigvalsh(gain).min() > -1e-9
    assert np.diag(gain).max() > 0.1
    again = world.network.tile(tile).query()
    np.testing.assert_array_equal(again.covariance, before.covariance)


def test_a_good_block_agrees_with_the_tile_and_a_wrong_one_does_not(world: World) -> None:
    view = world.network.tile(tile_of(world))
    good = view.with_block(world.block)
    assert good.redundancy > 100 and good.rank > 10
    assert abs(good.chi_square - good.redundancy) < 5.0 * np.sqrt(2.0 * good.redundancy)
    mixed = dataclasses.replace(world.block, point_ids=np.roll(world.block.point_ids, 1))
    assert view.with_block(mixed).chi_square > 100.0 * good.chi_square


def test_blocks_that_cannot_be_joined_are_told_so(world: World) -> None:
    view = world.network.tile(tile_of(world))
    with pytest.raises(QueryError, match=r"image T000-000-\w+ of block T000-000 is in the network already"):
        view.with_block(world.fused)
    columns = ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")
    nowhere = dataclasses.replace(world.block, **{name: getattr(world.block, name)[:0] for name in columns})
    with pytest.raises(QueryError, match="no ray of the block falls into tile"):
        view.with_block(nowhere)
    with pytest.raises(QueryError, match="1 of 1 points are not determined in the tile, nothing among them"):
        view.with_block(world.block).query(["nothing"])
