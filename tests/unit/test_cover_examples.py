"""Covers that can be drawn on paper: their cells, outlines and depths."""

from __future__ import annotations

import numpy as np
import pytest
from covers import CODES, EXAMPLES, MILLIMETRES, MOON, covers, places
from hypothesis import given
from hypothesis import strategies as st

from submin.geodesy import Ellipsoid, geodetic_to_geocentric
from submin.tiling.cover import Cover


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
