"""The cover: every place has one owner, one cell, and the tiles that the outlines say."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from covers import EXAMPLES, MILLIMETRES, cores_of, covers, outlines_of, places, tiles_at
from hypothesis import given, settings
from hypothesis import strategies as st

from submin.tiling.cover import Cover


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_every_place_has_one_owner_and_the_holders_of_its_cell(cover: Cover, seed: int) -> None:
    east, north = places(cover, seed)
    owners, holders = tiles_at(cover, east, north, 0.0), tiles_at(cover, east, north, 0.5 * cover.overlap)
    names: dict[tuple[int, ...], set[int]] = {}
    for cell, owner, held in zip(cover.cells_of(*cover.geographic(east, north)).tolist(), owners, holders, strict=True):
        assert owner == [Cover.owner(cell)]
        assert tuple(held) == cover.holders(cell)
        assert cell in cover.cells_owned(owner[0])
        names.setdefault((*owner, *held), set()).add(cell)
    # one owner and one set of holders are one cell
    assert all(len(cells) == 1 for cells in names.values())


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_holders_are_the_tiles_of_positive_depth(cover: Cover, seed: int) -> None:
    east, north = places(cover, seed)
    lon, lat = cover.geographic(east, north)
    tiles = np.array(sorted(cover.tiles()))
    depth = np.stack([cover.depth(tile, lon, lat) for tile in tiles], axis=1)
    for k, cell in enumerate(cover.cells_of(lon, lat)):
        assert tuple(tiles[depth[k] >= 0.0]) == cover.holders(int(cell))


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_depth_is_the_distance_to_the_nearest_side_of_the_outline(cover: Cover, seed: int) -> None:
    east, north = places(cover, seed, 20)
    lon, lat = cover.geographic(east, north)
    tiles, bounds = outlines_of(cover, 0.5 * cover.overlap)
    for tile, (west, south, far_east, far_north) in zip(tiles, bounds, strict=True):
        expected = np.array([min(e - west, far_east - e, n - south, far_north - n) for e, n in zip(east, north, strict=True)])
        np.testing.assert_allclose(cover.depth(tile, lon, lat), expected, rtol=0.0, atol=MILLIMETRES)


@EXAMPLES
@given(covers())
def test_cells_held_owned_and_their_holders_agree(cover: Cover) -> None:
    owned = [cell for tile in cover.tiles() for cell in cover.cells_owned(tile)]
    assert len(owned) == len(set(owned))
    assert len({(Cover.owner(cell), cover.holders(cell)) for cell in owned}) == len(owned)
    for tile in cover.tiles():
        assert cover.cells_held(tile) == tuple(cell for cell in sorted(owned) if tile in cover.holders(cell))
        assert set(cover.cells_owned(tile)) <= set(cover.cells_held(tile))
        assert all(Cover.owner(cell) == tile for cell in cover.cells_owned(tile))
        sharing = {other for cell in owned if tile in cover.holders(cell) for other in cover.holders(cell)} - {tile}
        assert set(cover.neighbours(tile)) <= sharing
        assert sorted(set(cover.neighbours(tile))) == list(cover.neighbours(tile))
    for cell in owned:
        assert Cover.owner(cell) in cover.holders(cell)
        assert list(cover.holders(cell)) == sorted(set(cover.holders(cell)))
        assert set(cover.holders(cell)) <= set(cover.tiles())


@settings(EXAMPLES, max_examples=25)
@given(covers())
def test_every_cell_is_a_place(cover: Cover) -> None:
    # the outlines cut each core into rectangles: the middles of all of them, by brute force, are all cells there are
    _, bounds = outlines_of(cover, 0.5 * cover.overlap)
    for tile, (west, south, east, north) in cores_of(cover).items():
        x, y = (
            np.unique(np.round(np.clip(np.concatenate([bounds[:, k], bounds[:, k + 2], sides]), *sides), 6))
            for k, sides in ((0, np.array([west, east])), (1, np.array([south, north])))
        )
        middle = np.meshgrid(*(0.5 * (line[:-1] + line[1:])[np.diff(line) > 1e-3] for line in (x, y)))
        held = tiles_at(cover, middle[0].ravel(), middle[1].ravel(), 0.5 * cover.overlap)
        assert {tuple(holders) for holders in held} == {cover.holders(cell) for cell in cover.cells_owned(tile)}


@EXAMPLES
@given(covers())
def test_neighbours_are_the_tiles_whose_outlines_overlap(cover: Cover) -> None:
    tiles = list(cover.tiles())
    outlines = shapely.polygons([cover.tile_outline(tile) for tile in tiles])
    for tile, outline in zip(tiles, outlines, strict=True):
        common = shapely.area(shapely.intersection(outlines, outline)) > 1e-9 * cover.core**2
        assert cover.neighbours(tile) == tuple(sorted(t for t, c in zip(tiles, common, strict=True) if c and t != tile))


@EXAMPLES
@given(covers())
def test_cores_tile_the_plane_and_have_their_size(cover: Cover) -> None:
    cores = cores_of(cover)
    assert list(cover.tiles()) == list(cores)
    assert cover.tile_count == len(cores) == len(set(cover.tiles()))
    for tile, (west, south, east, north) in cores.items():
        np.testing.assert_allclose(cover.core_outline(tile)[[0, 2]], [[west, south], [east, north]], rtol=0.0, atol=1e-6)
        assert cover.side(tile) == pytest.approx(east - west, rel=1e-9)
        wide = cover.tile_outline(tile) - cover.core_outline(tile)
        half = 0.5 * cover.overlap
        np.testing.assert_allclose(wide, [[-half, -half], [half, -half], [half, half], [-half, half], [-half, -half]], rtol=0.0, atol=1e-6)
    tiles, bounds = outlines_of(cover, 0.0)
    np.testing.assert_allclose([cover.core_bounds(tile) for tile in tiles], bounds, rtol=0.0, atol=1e-6)
    assert sum((c[2] - c[0]) * (c[3] - c[1]) for c in cores.values()) == pytest.approx(cover.rows * cover.columns * cover.core**2)
