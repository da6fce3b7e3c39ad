"""A cover whose tiles are split: what changes, what does not, and what cannot be split."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from covers import EXAMPLES, cores_of, covers, covers_to_split, outlines_of, places, tiles_at
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Polygon

from submin.errors import InputError
from submin.tiling.cover import MAX_LEVEL, Cover


@EXAMPLES
@given(covers_to_split())
def test_quarters_tile_the_core_and_their_tiles_the_tile(given: tuple[Cover, int]) -> None:
    cover, tile = given
    after = cover.split(tile)
    quarters = cover.quarters(tile)
    assert quarters == after.quarters(tile) and len(set(quarters)) == 4
    west, south, east, north = cover.core_outline(tile)[[0, 2]].ravel()
    middle = 0.5 * (west + east), 0.5 * (south + north)
    expected = [
        (west, south, *middle), (middle[0], south, east, middle[1]), (west, middle[1], middle[0], north), (*middle, east, north),
    ]  # fmt: skip
    for quarter, bounds in zip(quarters, expected, strict=True):
        assert quarter in set(after.tiles()) and quarter not in set(cover.tiles())
        assert after.side(quarter) == 0.5 * cover.side(tile)
        np.testing.assert_allclose(after.core_outline(quarter)[[0, 2]].ravel(), bounds, rtol=0.0, atol=1e-6)
    assert tile not in set(after.tiles())
    whole = Polygon(cover.tile_outline(tile))
    parts = shapely.union_all([Polygon(after.tile_outline(quarter)) for quarter in quarters])
    assert shapely.symmetric_difference(parts, whole).area < 1e-9 * cover.core**2
    # to infinity where the tile is on the rim
    inner = np.array([after.core_bounds(quarter) for quarter in quarters])
    assert (*inner[:, :2].min(axis=0), *inner[:, 2:].max(axis=0)) == pytest.approx(cover.core_bounds(tile), abs=1e-6)


@EXAMPLES
@given(covers_to_split(), st.integers(0, 2**32 - 1))
def test_places_of_a_tile_are_those_of_its_quarters(given: tuple[Cover, int], seed: int) -> None:
    cover, tile = given
    after = cover.split(tile)
    lon, lat = cover.geographic(*places(after, seed))
    depth = np.maximum.reduce([after.depth(quarter, lon, lat) for quarter in cover.quarters(tile)])
    np.testing.assert_array_equal(depth >= 0.0, cover.depth(tile, lon, lat) >= 0.0)


@EXAMPLES
@given(covers_to_split(), st.integers(0, 2**32 - 1))
def test_splitting_changes_only_cells_that_a_split_tile_holds(given: tuple[Cover, int], seed: int) -> None:
    cover, tile = given
    after = cover.split(tile)
    split, added = set(after.splits) - set(cover.splits), set(after.tiles()) - set(cover.tiles())
    assert tile in split and set(cover.splits) <= set(after.splits)
    assert added == {quarter for each in split for quarter in cover.quarters(each)} - split
    before = {
        cell: (cover.cell_name(cell), cover.holders(cell))
        for each in cover.tiles() for cell in cover.cells_owned(each) if not split & set(cover.holders(cell))
    }  # fmt: skip
    later = {
        cell: (after.cell_name(cell), after.holders(cell))
        for each in after.tiles() for cell in after.cells_owned(each) if not added & set(after.holders(cell))
    }  # fmt: skip
    assert later == before
    at = cover.geographic(*places(after, seed))
    for old, new in zip(cover.cells_of(*at).tolist(), after.cells_of(*at).tolist(), strict=True):
        assert old == new if old in before else split & set(cover.holders(old)) and added & set(after.holders(new))


@EXAMPLES
@given(covers())
def test_neighbours_differ_by_one_halving_at_most(cover: Cover) -> None:
    cores = cores_of(cover)
    sides = {tile: east - west for tile, (west, _, east, _) in cores.items()}
    if cover.overlap > 0.0:
        outlines = shapely.polygons([cover.tile_outline(tile) for tile in cores])
        tree = shapely.STRtree(outlines)
        pairs = tree.query(outlines, predicate="intersects").T
        numbers = list(cores)
        common = shapely.area(shapely.intersection(outlines[pairs[:, 0]], outlines[pairs[:, 1]])) > 1e-9 * cover.core**2
        ratios = [sides[numbers[a]] / sides[numbers[b]] for a, b in pairs[common]]
        assert max(ratios) < 2.01
        assert all(side >= cover.overlap * (1.0 - 1e-12) for side in sides.values())


@EXAMPLES
@given(covers_to_split())
def test_nothing_is_split_that_need_not_be(given: tuple[Cover, int]) -> None:
    # put back any tile that was split beside the one asked for, and it has a neighbour of a quarter of its side
    cover, tile = given
    after = cover.split(tile)
    for other in set(after.splits) - set(cover.splits) - {tile}:
        if not set(after.quarters(other)) & set(after.splits):
            whole = Polygon(after.tile_outline(other))
            common = {t for t in after.tiles() if shapely.intersection(Polygon(after.tile_outline(t)), whole).area > 1e-9 * cover.core**2}
            assert min(after.side(t) for t in common - set(after.quarters(other))) == 0.25 * cover.side(other)


@EXAMPLES
@given(covers())
def test_too_narrow_quarters_and_split_tiles_are_refused(cover: Cover) -> None:
    for tile in cover.tiles():
        quarter = 0.5 * cover.side(tile)
        assert cover.can_split(tile) == (quarter >= cover.overlap)
        if quarter < cover.overlap:
            with pytest.raises(InputError, match=f"tile {cover.tile_name(tile)} cannot be split: its quarters would be narrower"):
                cover.split(tile)
    for tile in cover.splits:
        with pytest.raises(InputError, match=f"tile is {tile}, which is none of the cover"):
            cover.split(tile)


@pytest.mark.parametrize("tile", [-1, 9, 9 + 4 * 4 + 1, 9 + 4 * (9 + 4 * 4)])
def test_what_is_no_tile_of_the_cover_cannot_be_split(tile: int) -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 3, 1000.0, 100.0).split(8)
    with pytest.raises(InputError):
        cover.split(tile)


def test_overlap_of_nearly_a_core_lets_nothing_be_split() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 3, 1000.0, 970.0)
    assert not any(cover.can_split(tile) for tile in cover.tiles())
    with pytest.raises(InputError, match="tile r001c001 cannot be split"):
        cover.split(4)


def test_quarters_may_be_just_as_wide_as_the_overlap() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 3, 1000.0, 500.0)
    after = cover.split(4)
    assert [after.can_split(tile) for tile in after.quarters(4)] == [False] * 4
    # no place of a quarter is its own; along the middle of the core's sides there is but one tile opposite
    for quarter in after.quarters(4):
        assert sorted(len(after.holders(cell)) for cell in after.cells_owned(quarter)) == [3, 3, 4, 4]


def test_without_overlap_cores_can_be_halved_so_often_and_no_more() -> None:
    cover, tile = Cover((10.0, 50.0), (0.0, 0.0), 1, 1, 4096.0, 0.0), 0
    for _ in range(MAX_LEVEL):
        assert cover.can_split(tile)
        cover, tile = cover.split(tile), cover.quarters(tile)[3]
    assert cover.side(tile) == 4096.0 / 2**MAX_LEVEL
    assert not cover.can_split(tile)
    assert cover.tile_name(tile) == "r000c000q" + "3" * MAX_LEVEL
    assert cover.tile_number(cover.tile_name(tile)) == tile
    assert cover.tile_count == 1 + 3 * MAX_LEVEL
    corner = cover.geographic(np.array([4096.0 - 0.5]), np.array([4096.0 - 0.5]))
    assert Cover.owner(int(cover.cells_of(*corner)[0])) == tile


def test_larger_neighbours_are_split_first() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 3, 1000.0, 100.0).split(4)
    assert cover.splits == (4,)
    after = cover.split(cover.quarters(4)[0])
    # its western, southern and south-western neighbours were four times as wide
    assert set(after.splits) == {4, cover.quarters(4)[0], 0, 1, 3}
    # and so on outwards: the other three quarters, and before them all the cores around them
    inner = after.quarters(cover.quarters(4)[0])[3]
    assert set(after.split(inner).splits) - set(after.splits) == {inner, *cover.quarters(4)[1:], 2, 5, 6, 7, 8}


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1), st.sampled_from([10.0, 1e4, 3e6]))
def test_cores_on_the_rim_reach_to_infinity(cover: Cover, seed: int, beyond: float) -> None:
    rng = np.random.default_rng(seed)
    low, high = np.array(cover.origin), np.array(cover.origin) + cover.core * np.array([cover.columns, cover.rows])
    at = np.column_stack(places(cover, seed, 60))
    axis = rng.integers(0, 2, 60)
    at[np.arange(60), axis] = np.where(rng.uniform(size=60) < 0.5, (low - beyond)[axis], (high + beyond)[axis])
    lon, lat = cover.geographic(*at.T)
    assert cover.outside(lon, lat).all()
    holders = tiles_at(cover, *at.T, 0.5 * cover.overlap)
    for cell, owner, held in zip(cover.cells_of(lon, lat).tolist(), tiles_at(cover, *at.T, 0.0), holders, strict=True):
        assert owner == [Cover.owner(cell)] and tuple(held) == cover.holders(cell)
        assert cell in cover.cells_owned(owner[0])


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_the_box_around_a_cell_holds_it(cover: Cover, seed: int) -> None:
    east, north = places(cover, seed)
    for cell, x, y in zip(cover.cells_of(*cover.geographic(east, north)).tolist(), east, north, strict=True):
        w, s, e, n = cover.cell_bounds(cell)
        assert w <= x <= e and s <= y <= n
        west, south, e_core, n_core = cover.core_bounds(Cover.owner(cell))
        assert west <= w < e <= e_core and south <= s < n <= n_core


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_tiles_that_meet_a_box_are_those_with_a_place_in_it(cover: Cover, seed: int) -> None:
    (west, east), (south, north) = (np.sort(axis[:2]) for axis in places(cover, seed))
    tiles, bounds = outlines_of(cover, 0.0)
    meet = (bounds[:, 0] <= east) & (bounds[:, 2] >= west) & (bounds[:, 1] <= north) & (bounds[:, 3] >= south)
    assert sorted(cover.tiles_meeting(west, south, east, north)) == sorted(tiles[meet].tolist())
