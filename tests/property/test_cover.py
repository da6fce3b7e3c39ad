"""The cover: every place has one owner, one cell, and the tiles that the outlines say, however its tiles are split; areas anywhere."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry

from submin.errors import InputError
from submin.geodesy import Ellipsoid, geodetic_to_geocentric
from submin.tiling.area import cover_area
from submin.tiling.cover import MAX_LEVEL, ZONES, Cover

Array = NDArray[np.float64]

EXAMPLES = settings(max_examples=40, deadline=None, derandomize=True)
MILLIMETRES = 5e-3
"""PROJ's series for the authalic latitude brings a place of the plane back to a millimetre. Only the way to the plane decides on cells."""
MOON = Ellipsoid(1737400.0, 0.0)
CODES = ZONES**2
"""Codes of cells to a tile."""


@st.composite
def grids(draw: st.DrawFn) -> Cover:
    """Covers of up to five by five cores anywhere on the Earth, without overlap, with some, with nearly a core's."""
    core = draw(st.sampled_from([50.0, 3e3, 1e5]))
    return Cover(
        (draw(st.floats(-180.0, 180.0)), draw(st.floats(-90.0, 90.0))),
        (draw(st.floats(-3.0, 1.0)) * core, draw(st.floats(-3.0, 1.0)) * core),
        draw(st.integers(1, 5)), draw(st.integers(1, 5)), core, core * draw(st.sampled_from([0.0, 0.07, 0.1, 0.25, 1.0 / 3.0, 0.5, 0.97])),
    )  # fmt: skip


def splittable(cover: Cover, most: int = 4) -> list[int]:
    """Tiles that can be split, of cores that were halved less than ``most`` times."""
    return [tile for tile in cover.tiles() if cover.can_split(tile) and cover.side(tile) > 1.01 * cover.core / 2**most]


@st.composite
def covers(draw: st.DrawFn) -> Cover:
    """Grids of which up to eight tiles were split one after another: any tile, or a part of the one before."""
    cover = draw(grids())
    last: int | None = None
    for _ in range(draw(st.sampled_from([0, 1, 2, 3, 4, 6, 8]))):
        possible = splittable(cover)
        if last is not None and draw(st.booleans()):
            possible = [tile for tile in cover.quarters(last) if tile in possible] or possible
        if not possible:
            break
        last = draw(st.sampled_from(possible))
        cover = cover.split(last)
    return cover


@st.composite
def covers_to_split(draw: st.DrawFn) -> tuple[Cover, int]:
    """A cover and one of its tiles that can be split."""
    cover = draw(covers().filter(lambda cover: bool(splittable(cover, 5))))
    return cover, draw(st.sampled_from(splittable(cover, 5)))


def cores_of(cover: Cover) -> dict[int, tuple[float, float, float, float]]:
    """West, south, east, north of every core, from the grid and the splits alone: written out once more, by halving."""
    found: dict[int, tuple[float, float, float, float]] = {}

    def halve(tile: int, west: float, south: float, side: float) -> None:
        if tile not in cover.splits:
            found[tile] = west, south, west + side, south + side
            return
        for quarter, part in enumerate(cover.quarters(tile)):
            halve(part, west + (quarter % 2) * 0.5 * side, south + (quarter // 2) * 0.5 * side, 0.5 * side)

    for tile in range(cover.rows * cover.columns):
        row, column = divmod(tile, cover.columns)
        halve(tile, cover.origin[0] + column * cover.core, cover.origin[1] + row * cover.core, cover.core)
    return found


def near(a: float, b: float, cover: Cover) -> bool:
    return abs(a - b) < 1e-6 * cover.core


def outlines_of(cover: Cover, widen: float) -> tuple[NDArray[np.int64], Array]:
    """Numbers (t,) of all tiles and bounds (t, 4) of their cores, so much widened; those on the rim reach to infinity."""
    cores = cores_of(cover)
    rim = [*cover.origin, cover.origin[0] + cover.columns * cover.core, cover.origin[1] + cover.rows * cover.core]
    bounds = []
    for core in cores.values():
        wide = [core[0] - widen, core[1] - widen, core[2] + widen, core[3] + widen]
        bounds.append([(-np.inf if k < 2 else np.inf) if near(core[k], rim[k], cover) else wide[k] for k in range(4)])
    return np.array(list(cores)), np.array(bounds)


def tiles_at(cover: Cover, east: Array, north: Array, widen: float) -> list[list[int]]:
    """For each place of the plane the tiles, ascending, whose cores, so much widened, hold it."""
    tiles, bounds = outlines_of(cover, widen)
    inside = (bounds[:, 0] <= east[:, None]) & (east[:, None] < bounds[:, 2]) & (bounds[:, 1] <= north[:, None])
    inside &= north[:, None] < bounds[:, 3]
    return [sorted(tiles[row].tolist()) for row in inside]


def places(cover: Cover, seed: int, count: int = 200) -> tuple[Array, Array]:
    """Places (easting, northing) in and around a cover and its smallest tiles, none within a thousandth of a core (5 cm) of an outline."""
    rng = np.random.default_rng(seed)
    low, high = np.array(cover.origin), np.array(cover.origin) + cover.core * np.array([cover.columns, cover.rows])
    anywhere = rng.uniform(low - 1.5 * cover.core, high + 1.5 * cover.core, (4 * count, 2))
    cores = np.array(list(cores_of(cover).values()))
    small = cores[rng.integers(0, len(cores), 4 * count)]
    reach = 0.6 * cover.overlap
    about = rng.uniform(small[:, :2] - reach, small[:, 2:] + reach)
    both = np.stack([anywhere, about], axis=1).reshape(-1, 2)
    half, outline = 0.5 * cover.overlap, np.concatenate([cores[:, :2], cores[:, 2:]])
    lines = np.concatenate([outline, outline - half, outline + half])
    chosen = both[(np.abs(both[:, None] - lines[None]) > 1e-3 * cover.core).all(axis=(1, 2))][:count]
    assert len(chosen) == count
    return chosen[:, 0], chosen[:, 1]


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


# Splits


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


# Examples


def test_nine_cells_to_a_core_and_twenty_five_to_a_tile() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 3, 1000.0, 300.0)
    assert [len(cover.cells_owned(tile)) for tile in cover.tiles()] == [4, 6, 4, 6, 9, 6, 4, 6, 4]
    assert len(cover.cells_held(4)) == 9 + 4 * 3 + 4 * 1
    assert [len(cover.holders(cell)) for cell in cover.cells_owned(4)] == [4, 2, 4, 2, 1, 2, 4, 2, 4]
    assert cover.neighbours(4) == (0, 1, 2, 3, 5, 6, 7, 8)
    assert cover.neighbours(0) == (1, 3, 4)
    # codes are 25 to a tile: the first zone, by row and column, with these holders
    assert cover.cells_owned(4) == tuple(CODES * 4 + zone for zone in (0, 1, 4, 5, 6, 9, 20, 21, 24))
    assert cover.holders(CODES * 4 + 24) == (4, 5, 7, 8)
    assert cover.holders(CODES * 4 + 1) == (1, 4)


def test_smaller_neighbours_cut_the_edge_of_a_core_in_three() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 1, 2, 1000.0, 100.0).split(0)
    south_east, north_east = cover.quarters(0)[1], cover.quarters(0)[3]
    assert {cover.holders(cell) for cell in cover.cells_owned(1)} == {(1,), (1, south_east), (1, north_east), (1, south_east, north_east)}
    east, north = np.array([1020.0] * 5 + [1200.0]), np.array([-1e3, 440.0, 460.0, 540.0, 560.0, 500.0])
    names = [cover.cell_name(cell) for cell in cover.cells_of(*cover.geographic(east, north))]
    assert names == [
        "r000c001+r000c000q1", "r000c001+r000c000q1", "r000c001+r000c000q1+r000c000q3", "r000c001+r000c000q1+r000c000q3",
        "r000c001+r000c000q3", "r000c001",
    ]  # fmt: skip


def test_without_overlap_a_core_is_one_cell() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 4, 1000.0, 0.0).split(5)
    assert cover.tile_count == 15
    cells = {tile: cover.cells_owned(tile)[0] for tile in cover.tiles()}
    for tile in cover.tiles():
        assert cover.cells_owned(tile) == cover.cells_held(tile) == (cells[tile],)
        assert cover.holders(cells[tile]) == (tile,)
        assert cover.neighbours(tile) == ()
        assert cover.cell_name(cells[tile]) == cover.tile_name(tile)
    # a place on a border belongs to the core north and east of it
    lon, lat = cover.geographic(np.array([1000.0 + MILLIMETRES, 1000.0 - MILLIMETRES]), np.array([500.0, 500.0]))
    np.testing.assert_array_equal(cover.cells_of(lon, lat), [cells[1], cells[0]])
    lon, lat = cover.geographic(np.array([1500.0 + MILLIMETRES, 1500.0 - MILLIMETRES]), np.array([1250.0, 1750.0]))
    np.testing.assert_array_equal(cover.cells_of(lon, lat), [cells[cover.quarters(5)[1]], cells[cover.quarters(5)[2]]])


def test_one_tile_holds_the_whole_plane() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 1, 1, 1000.0, 900.0)
    lon, lat = np.array([10.0, -170.0, 100.0]), np.array([50.0, 10.0, -80.0])
    assert len(cover.cells_owned(0)) == 1
    np.testing.assert_array_equal(cover.cells_of(lon, lat), cover.cells_owned(0)[0])
    assert np.isinf(cover.depth(0, lon, lat)).all()
    np.testing.assert_array_equal(cover.outside(np.array([10.001, -170.0]), np.array([50.001, 10.0])), [False, True])


def test_four_quarters_hold_the_whole_plane() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 1, 1, 1000.0, 100.0).split(0)
    far = np.array([-2e6, 2e6])
    east, north = (a.ravel() for a in np.meshgrid(far, far))
    names = [cover.cell_name(cell) for cell in cover.cells_of(*cover.geographic(east, north))]
    assert names == [f"r000c000q{quarter}" for quarter in range(4)]
    assert cover.core_bounds(cover.quarters(0)[1]) == (500.0, -np.inf, np.inf, 500.0)


def test_cells_are_where_their_names_say() -> None:
    cover = Cover((0.0, 0.0), (-1500.0, -1500.0), 3, 3, 1000.0, 200.0)
    east = np.array([-450.0, 0.0, 450.0] * 3)
    north = np.repeat([-450.0, 0.0, 450.0], 3)
    names = [cover.cell_name(cell) for cell in cover.cells_of(*cover.geographic(east, north))]
    assert names == [
        "r001c001+r000c000+r000c001+r001c000", "r001c001+r000c001", "r001c001+r000c001+r000c002+r001c002",
        "r001c001+r001c000", "r001c001", "r001c001+r001c002",
        "r001c001+r001c000+r002c000+r002c001", "r001c001+r002c001", "r001c001+r001c002+r002c001+r002c002",
    ]  # fmt: skip
    beyond = cover.cells_of(*cover.geographic(np.array([-1e5, 1e5]), np.array([1e5, 0.0])))
    assert [cover.cell_name(cell) for cell in beyond] == ["r002c000", "r001c002"]


def test_depth_is_the_distance_to_the_outline_of_the_tile() -> None:
    cover = Cover((20.0, -35.0), (0.0, 0.0), 3, 3, 1000.0, 200.0)
    lon, lat = cover.geographic(np.array([1500.0, 1000.0, 2200.0, 850.0]), np.array([1500.0, 1300.0, 1400.0, 1500.0]))
    np.testing.assert_allclose(cover.depth(4, lon, lat), [600.0, 100.0, -100.0, -50.0], rtol=0.0, atol=MILLIMETRES)
    np.testing.assert_allclose(cover.depth(3, lon, lat), [-400.0, 100.0, -1100.0, 250.0], rtol=0.0, atol=MILLIMETRES)
    north_east = cover.quarters(4)[3]
    np.testing.assert_allclose(cover.split(4).depth(north_east, lon, lat), [100.0, -400.0, -100.0, -550.0], rtol=0.0, atol=MILLIMETRES)


def test_outlines_are_closed_and_of_full_size() -> None:
    cover = Cover((20.0, -35.0), (-50.0, 70.0), 2, 3, 1000.0, 200.0)
    np.testing.assert_array_equal(cover.core_outline(4), [[950, 1070], [1950, 1070], [1950, 2070], [950, 2070], [950, 1070]])
    np.testing.assert_array_equal(cover.tile_outline(4), [[850, 970], [2050, 970], [2050, 2170], [850, 2170], [850, 970]])
    assert cover.core_bounds(4) == (950.0, 1070.0, 1950.0, np.inf)
    part = cover.quarters(4)[2]
    np.testing.assert_array_equal(cover.split(4).tile_outline(part), [[850, 1470], [1550, 1470], [1550, 2170], [850, 2170], [850, 1470]])
    assert cover.split(4).core_bounds(part) == (950.0, 1570.0, 1450.0, np.inf)


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_plane_and_globe_are_inverse(cover: Cover, seed: int) -> None:
    east, north = places(cover, seed)
    back = np.stack(cover.plane(*cover.geographic(east, north)))
    np.testing.assert_allclose(back, [east, north], rtol=0.0, atol=MILLIMETRES)


@pytest.mark.parametrize("centre", [(12.0, 50.0), (180.0, -17.0), (77.0, 90.0), (-30.0, -90.0)])
@pytest.mark.parametrize("body", [Ellipsoid(6378137.0, 1.0 / 298.257223563), MOON], ids=["earth", "moon"])
def test_lengths_in_the_plane_are_metres_on_the_ground(centre: tuple[float, float], body: Ellipsoid) -> None:
    cover = Cover(centre, (0.0, 0.0), 1, 1, 1000.0, 0.0, body)
    east, north = np.array([-3e3, 3e3, 0.0, 0.0]), np.array([0.0, 0.0, -3e3, 3e3])
    ground = geodetic_to_geocentric(np.column_stack([*cover.geographic(east, north), np.zeros(4)]), body)
    np.testing.assert_allclose(np.linalg.norm(ground[[0, 2]] - ground[[1, 3]], axis=1), 6e3, rtol=1e-5)


# Names


@EXAMPLES
@given(covers())
def test_names_come_back_as_numbers(cover: Cover) -> None:
    names = [cover.tile_name(tile) for tile in cover.tiles()]
    assert len(set(names)) == len(names)
    assert [cover.tile_number(name) for name in names] == list(cover.tiles())
    cells = [cell for tile in cover.tiles() for cell in cover.cells_owned(tile)]
    cell_names = [cover.cell_name(cell) for cell in cells]
    assert len(set(cell_names)) == len(cell_names)
    assert [cover.cell_number(name) for name in cell_names] == cells
    for cell, name in zip(cells, cell_names, strict=True):
        owner, *others = (cover.tile_number(part) for part in name.split("+"))
        assert owner == Cover.owner(cell)
        assert others == [tile for tile in cover.holders(cell) if tile != owner]


@EXAMPLES
@given(covers())
def test_a_split_tile_is_refused_with_its_parts_named(cover: Cover) -> None:
    for tile in cover.splits:
        name = cover.tile_name(tile)
        parts = [cover.tile_name(part) for part in cover.quarters(tile)]
        assert parts == [f"{name}{q}" if "q" in name else f"{name}q{q}" for q in range(4)]
        words = f"tile is '{name}', which was split; expected one of its parts {', '.join(parts)}$"
        for refused in (cover.tile_number, cover.cell_number):
            with pytest.raises(InputError, match=words):
                refused(name)
    for tile in cover.tiles():
        for part in cover.quarters(tile):
            with pytest.raises(InputError, match=f"tile is '{cover.tile_name(part)}'; expected a name .*, or of a part of a split one"):
                cover.tile_number(cover.tile_name(part))


def test_quarters_are_named_from_the_south_west() -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 3, 4, 100.0, 1.0).split(6)
    assert [cover.tile_name(tile) for tile in cover.quarters(6)] == ["r001c002q0", "r001c002q1", "r001c002q2", "r001c002q3"]
    cover = cover.split(cover.quarters(6)[2])
    assert [cover.tile_name(tile) for tile in cover.quarters(cover.quarters(6)[2])] == [f"r001c002q2{q}" for q in range(4)]
    at = cover.geographic(np.array([210.0, 240.0, 210.0, 240.0, 275.0]), np.array([160.0, 160.0, 190.0, 190.0, 175.0]))
    owners = [cover.tile_name(Cover.owner(cell)) for cell in cover.cells_of(*at)]
    assert owners == ["r001c002q20", "r001c002q21", "r001c002q22", "r001c002q23", "r001c002q3"]


def test_unknown_cells_are_named_with_those_of_their_owner() -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 1, 2, 100.0, 10.0)
    for name in ("r000c000+r000c000", "r000c000+r000c001+r000c001", "r000c000-c", "r000c000+"):
        with pytest.raises(InputError):
            cover.cell_number(name)
    with pytest.raises(InputError, match=r"cell is 'r000c000\+r001c000'; expected one of r000c000, r000c000\+r000c001$"):
        cover.cell_number("r000c000+r001c000")
    # the owner comes first
    assert cover.cell_number("r000c001+r000c000") != cover.cell_number("r000c000+r000c001")


def test_names_beyond_a_thousand_rows() -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 1200, 3, 10.0, 1.0)
    assert cover.tile_name(3 * 1100 + 2) == "r1100c002"
    assert cover.tile_number("r1100c002") == 3 * 1100 + 2


@pytest.mark.parametrize(
    "name",
    ["r003c000", "r000c004", "r0c0", "x", "", "r000c000-c", "R000c000", "r-01c000", "r0000c000", "r000c000q", "r000c000q0",
     "r000c001q4", "r000c001q00", "r000c001q0q0", "r000c000+r000c001"],
)  # fmt: skip
def test_unknown_tiles_are_named_with_what_there_is(name: str) -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 3, 4, 10.0, 1.0).split(1)
    with pytest.raises(InputError, match=re.escape(f"tile is {name!r}; expected a name from r000c000 to r002c003, or of a part")):
        cover.tile_number(name)


@EXAMPLES
@given(covers())
def test_description_is_plain_and_comes_back(cover: Cover) -> None:
    back = Cover.from_mapping(json.loads(json.dumps(cover.to_mapping())))
    assert back == cover and hash(back) == hash(cover)
    assert back.splits == cover.splits and list(back.tiles()) == list(cover.tiles())
    assert cover == replace(cover) and (not cover.splits or cover != replace(cover, splits=()))


def test_description_keeps_the_body() -> None:
    cover = cover_area(box(3.0, 25.0, 4.0, 26.0), 5e3, 1e3, MOON)
    assert Cover.from_mapping(json.loads(json.dumps(cover.to_mapping()))).ellipsoid == MOON


# Areas


def within(area: BaseGeometry, count: int = 2000) -> tuple[Array, Array]:
    """Longitudes and latitudes all over an area, its corners among them."""
    west, south, east, north = area.bounds
    rng = np.random.default_rng(9)
    lonlat = np.concatenate([rng.uniform([west, south], [east, north], (count, 2)), shapely.get_coordinates(area)])
    inside = shapely.intersects_xy(area, lonlat[:, 0], lonlat[:, 1])
    return lonlat[inside, 0], lonlat[inside, 1]


AREAS = {
    "provence": box(5.0, 43.0, 6.5, 44.0),
    "equator": box(-0.5, -0.5, 0.5, 0.5),
    "wide-at-sixty-north": box(-30.0, 60.0, 60.0, 62.0),
    "slanted": Polygon([(10.0, 40.0), (14.0, 41.0), (13.0, 46.0), (9.5, 44.0)]),
    "with-a-hole": Polygon([(10.0, 40.0), (14.0, 40.0), (14.0, 44.0), (10.0, 44.0)], [[(11.0, 41.0), (13.0, 41.0), (12.0, 43.0)]]),
    "islands": MultiPolygon([box(140.0, 10.0, 141.0, 11.0), box(144.0, 13.0, 145.0, 14.0)]),
    "north-cap": box(-180.0, 84.0, 180.0, 90.0),
    "south-cap": box(-180.0, -90.0, 180.0, -80.0),
    "to-the-pole": box(-40.0, 80.0, 60.0, 90.0),
    "antimeridian-beyond-180": box(179.0, -17.5, 181.0, -16.0),
    "antimeridian-below-minus-180": box(-181.0, -17.5, -179.0, -16.0),
    "longitudes-to-360": box(278.0, 30.0, 279.0, 31.0),
}


@pytest.mark.parametrize("area", AREAS.values(), ids=AREAS)
def test_cover_holds_its_area_and_is_the_smallest_grid_that_does(area: BaseGeometry) -> None:
    core = 40e3
    cover = cover_area(area, core, 10e3)
    lon, lat = within(area)
    assert not cover.outside(lon, lat).any()
    assert not cover.outside(lon - 360.0 * np.round(lon / 360.0), lat).any()
    east, north = cover.plane(lon, lat)
    slack = 0.05 * core + 0.02 * max(np.ptp(east), np.ptp(north))
    assert (cover.columns - 1) * core < np.ptp(east) + slack
    assert (cover.rows - 1) * core < np.ptp(north) + slack
    middle = np.array(cover.origin) + 0.5 * core * np.array([cover.columns, cover.rows])
    np.testing.assert_allclose(middle, [0.5 * (east.min() + east.max()), 0.5 * (north.min() + north.max())], rtol=0.0, atol=slack)


HALVES = {
    "fiji": (box(179.0, -17.5, 180.0, -16.0), box(-180.0, -17.5, -179.0, -16.0), box(179.0, -17.5, 181.0, -16.0)),
    "equator": (box(179.5, -1.0, 180.0, 0.0), box(-180.0, -1.0, -179.5, 0.0), box(179.5, -1.0, 180.5, 0.0)),
    "uneven": (box(170.0, 60.0, 180.0, 65.0), box(-180.0, 60.0, -178.0, 65.0), box(170.0, 60.0, 182.0, 65.0)),
}


@pytest.mark.parametrize(("west", "east", "whole"), HALVES.values(), ids=HALVES)
def test_area_cut_at_the_antimeridian_is_the_area_in_one_piece(west: Polygon, east: Polygon, whole: Polygon) -> None:
    # GeoJSON cuts areas at the antimeridian (RFC 7946, 3.1.9)
    cover, expected = cover_area(shapely.union_all([west, east]), 40e3, 10e3), cover_area(whole, 40e3, 10e3)
    assert (cover.rows, cover.columns) == (expected.rows, expected.columns)
    np.testing.assert_allclose(cover.origin, expected.origin, rtol=0.0, atol=1.0)
    lon, lat = within(whole)
    np.testing.assert_array_equal(cover.cells_of(lon, lat) // CODES, expected.cells_of(lon, lat) // CODES)


def test_longitudes_a_turn_apart_are_the_same_place() -> None:
    cover = cover_area(AREAS["antimeridian-beyond-180"], 40e3, 10e3)
    lon, lat = within(AREAS["antimeridian-beyond-180"])
    np.testing.assert_array_equal(cover.cells_of(lon, lat), cover.cells_of(np.where(lon > 180.0, lon - 360.0, lon), lat))


def test_area_of_exactly_three_cores_is_three_cores() -> None:
    frame = Cover((10.0, 0.0), (0.0, 0.0), 1, 1, 1000.0, 0.0)
    lon, _ = frame.geographic(np.array([-1500.0, 1500.0]), np.array([0.0, 0.0]))
    area = box(lon[0], -0.003, lon[1], 0.003)
    cover = cover_area(area, 1000.0, 100.0)
    assert (cover.rows, cover.columns) == (1, 3)


def test_area_smaller_than_a_core_is_one_tile() -> None:
    cover = cover_area(box(10.0, 50.0, 10.001, 50.001), 1000.0, 100.0)
    assert (cover.rows, cover.columns) == (1, 1)


@pytest.mark.parametrize(
    ("area", "core", "overlap", "words"),
    [
        (box(0.0, 0.0, 1.0, 1.0), 1000.0, 1000.0, "overlap is 1000 m; expected 0 or more and less than the core's 1000 m"),
        (box(0.0, 0.0, 1.0, 1.0), 1000.0, 2500.0, "overlap is 2500 m; .*--overlap-km below --tile-km"),
        (box(0.0, 0.0, 1.0, 1.0), 1000.0, -1.0, "overlap is -1 m"),
        (box(0.0, 0.0, 1.0, 1.0), 1000.0, np.nan, "overlap is nan m"),
        (box(0.0, 0.0, 1.0, 1.0), 0.0, 0.0, "side of a core is 0.0 m; expected a positive length .--tile-km"),
        (box(0.0, 0.0, 1.0, 1.0), -5.0, 0.0, "side of a core is -5.0 m"),
        (box(0.0, 0.0, 1.0, 1.0), np.nan, 0.0, "side of a core is nan m"),
        (box(0.0, 0.0, 1.0, 1.0), np.inf, 0.0, "side of a core is inf m"),
        (box(0.0, 0.0, 0.5, 0.5), 1.75, 0.0, r"have 1,\d{3},\d{3},\d{3} tiles; expected at most 1,000,000: choose a larger --tile-km"),
        (box(30.0, -120.0, 31.0, -119.0), 1e4, 1e3, "latitudes -120 to -119.* axes look swapped: expected longitude first"),
        (box(40.0, 100.0, 41.0, 102.0), 1e4, 1e3, "latitudes 100 to 102, which is not on a globe; its axes look swapped"),
        (box(500000.0, 4500000.0, 510000.0, 4510000.0), 1e4, 1e3, "which is not on a globe$"),
        (box(-1000.0, 0.0, 10.0, 1.0), 1e4, 1e3, "longitudes -1000 to 10 .* not on a globe$"),
        (Polygon([(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)]), 1e4, 1e3, "not a valid polygon: Self-intersection.*mend it"),
        (Polygon(), 1e4, 1e3, "the area is empty; expected a polygon"),
        (MultiPolygon(), 1e4, 1e3, "the area is empty"),
        (box(-180.0, -90.0, 180.0, 90.0), 1e6, 1e5, "area"),
    ],
)
def test_unusable_areas_are_named(area: BaseGeometry, core: float, overlap: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        cover_area(area, core, overlap)


@pytest.mark.parametrize("change", [{"rows": 0}, {"columns": 0}, {"rows": -1}])
def test_grid_needs_a_tile(change: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="expected at least one"):
        replace(Cover((0.0, 0.0), (0.0, 0.0), 2, 2, 10.0, 1.0), **change)
