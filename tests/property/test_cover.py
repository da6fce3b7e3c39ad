"""The cover: every place has one owner, one cell, and the tiles that the outlines say; areas anywhere; bad areas by their message."""

from __future__ import annotations

import json
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
from submin.tiling.cover import PARTS, Cover, cover_area

Array = NDArray[np.float64]

EXAMPLES = settings(max_examples=40, deadline=None, derandomize=True)
MILLIMETRES = 5e-3
"""PROJ's series for the authalic latitude brings a place of the plane back to a millimetre. Only the way to the plane decides on cells."""
MOON = Ellipsoid(1737400.0, 0.0)


@st.composite
def covers(draw: st.DrawFn) -> Cover:
    """Covers of up to five by five cores anywhere on the Earth, without overlap, with some, with nearly a core's."""
    core = draw(st.sampled_from([50.0, 3e3, 1e5]))
    return Cover(
        (draw(st.floats(-180.0, 180.0)), draw(st.floats(-90.0, 90.0))),
        (draw(st.floats(-3.0, 1.0)) * core, draw(st.floats(-3.0, 1.0)) * core),
        draw(st.integers(1, 5)), draw(st.integers(1, 5)), core, core * draw(st.sampled_from([0.0, 0.1, 0.5, 0.97])),
    )  # fmt: skip


def places(cover: Cover, seed: int, count: int = 200) -> tuple[Array, Array]:
    """Places (easting, northing) in and around a cover, none within a thousandth of a core (5 cm at least) of an outline."""
    rng = np.random.default_rng(seed)
    core = rng.uniform(-1.5, [cover.columns + 1.5, cover.rows + 1.5], (4 * count, 2))
    half = 0.5 * cover.overlap / cover.core
    from_lines = np.abs([core - shift - np.round(core - shift) for shift in (0.0, half, -half)]).min(axis=(0, 2))
    chosen = core[from_lines > 1e-3][:count] * cover.core + np.array(cover.origin)
    assert len(chosen) == count
    return chosen[:, 0], chosen[:, 1]


def bounds_of_core(cover: Cover, tile: int, widen: float) -> tuple[float, float, float, float]:
    """West, south, east, north of a core widened on each side, those on the rim reaching to infinity: written out once more."""
    row, column = tile // cover.columns, tile % cover.columns
    west = -np.inf if column == 0 else cover.origin[0] + column * cover.core - widen
    south = -np.inf if row == 0 else cover.origin[1] + row * cover.core - widen
    east = np.inf if column == cover.columns - 1 else cover.origin[0] + (column + 1) * cover.core + widen
    north = np.inf if row == cover.rows - 1 else cover.origin[1] + (row + 1) * cover.core + widen
    return west, south, east, north


def tiles_at(cover: Cover, east: float, north: float, widen: float) -> list[int]:
    """Tiles whose cores, so much widened, hold a place of the plane."""
    found = []
    for tile in range(cover.rows * cover.columns):
        bounds = bounds_of_core(cover, tile, widen)
        if bounds[0] <= east < bounds[2] and bounds[1] <= north < bounds[3]:
            found.append(tile)
    return found


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_every_place_has_one_owner_and_the_holders_of_its_cell(cover: Cover, seed: int) -> None:
    east, north = places(cover, seed)
    for e, n, cell in zip(east, north, cover.cells_of(*cover.geographic(east, north)), strict=True):
        assert tiles_at(cover, e, n, 0.0) == [Cover.owner(cell)]
        assert tiles_at(cover, e, n, 0.5 * cover.overlap) == list(cover.holders(int(cell)))
        assert cell in cover.cells_owned(Cover.owner(cell))


@EXAMPLES
@given(covers(), st.integers(0, 2**32 - 1))
def test_holders_are_the_tiles_of_positive_depth(cover: Cover, seed: int) -> None:
    east, north = places(cover, seed)
    lon, lat = cover.geographic(east, north)
    depth = np.stack([cover.depth(tile, lon, lat) for tile in cover.tiles()], axis=1)
    for k, cell in enumerate(cover.cells_of(lon, lat)):
        assert tuple(np.flatnonzero(depth[k] >= 0.0)) == cover.holders(int(cell))


@EXAMPLES
@given(covers())
def test_cells_held_owned_and_their_holders_agree(cover: Cover) -> None:
    owned = [cell for tile in cover.tiles() for cell in cover.cells_owned(tile)]
    assert len(owned) == len(set(owned))
    for tile in cover.tiles():
        assert cover.cells_held(tile) == tuple(cell for cell in sorted(owned) if tile in cover.holders(cell))
        assert set(cover.cells_owned(tile)) <= set(cover.cells_held(tile))
        assert all(Cover.owner(cell) == tile for cell in cover.cells_owned(tile))
    for cell in owned:
        assert Cover.owner(cell) in cover.holders(cell)
        assert list(cover.holders(cell)) == sorted(set(cover.holders(cell)))


def test_nine_cells_to_a_core_and_twenty_five_to_a_tile() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 3, 1000.0, 300.0)
    assert [len(cover.cells_owned(tile)) for tile in cover.tiles()] == [4, 6, 4, 6, 9, 6, 4, 6, 4]
    assert len(cover.cells_held(4)) == 9 + 4 * 3 + 4 * 1
    assert [len(cover.holders(9 * 4 + part)) for part in range(9)] == [4, 2, 4, 2, 1, 2, 4, 2, 4]
    assert cover.holders(9 * 4 + PARTS.index("ne")) == (4, 5, 7, 8)
    assert cover.holders(9 * 4 + PARTS.index("s")) == (1, 4)


def test_without_overlap_a_core_is_one_cell() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 3, 4, 1000.0, 0.0)
    for tile in cover.tiles():
        assert cover.cells_owned(tile) == cover.cells_held(tile) == (9 * tile + 4,)
        assert cover.holders(9 * tile + 4) == (tile,)
    # a place on a border belongs to the core north and east of it
    lon, lat = cover.geographic(np.array([1000.0 + MILLIMETRES, 1000.0 - MILLIMETRES]), np.array([500.0, 500.0]))
    np.testing.assert_array_equal(cover.cells_of(lon, lat), [9 * 1 + 4, 9 * 0 + 4])


def test_one_tile_holds_the_whole_plane() -> None:
    cover = Cover((10.0, 50.0), (0.0, 0.0), 1, 1, 1000.0, 900.0)
    lon, lat = np.array([10.0, -170.0, 100.0]), np.array([50.0, 10.0, -80.0])
    np.testing.assert_array_equal(cover.cells_of(lon, lat), 4)
    assert np.isinf(cover.depth(0, lon, lat)).all()
    np.testing.assert_array_equal(cover.outside(np.array([10.001, -170.0]), np.array([50.001, 10.0])), [False, True])


def test_parts_of_a_core_are_where_their_names_say() -> None:
    cover = Cover((0.0, 0.0), (-1500.0, -1500.0), 3, 3, 1000.0, 200.0)
    east = np.array([-450.0, 0.0, 450.0] * 3)
    north = np.repeat([-450.0, 0.0, 450.0], 3)
    names = [cover.cell_name(cell) for cell in cover.cells_of(*cover.geographic(east, north))]
    assert names == [f"r001c001-{part}" for part in ("sw", "s", "se", "w", "c", "e", "nw", "n", "ne")]
    beyond = cover.cells_of(*cover.geographic(np.array([-1e5, 1e5]), np.array([1e5, 0.0])))
    assert [cover.cell_name(cell) for cell in beyond] == ["r002c000-c", "r001c002-c"]


def test_depth_is_the_distance_to_the_outline_of_the_tile() -> None:
    cover = Cover((20.0, -35.0), (0.0, 0.0), 3, 3, 1000.0, 200.0)
    lon, lat = cover.geographic(np.array([1500.0, 1000.0, 2200.0, 850.0]), np.array([1500.0, 1300.0, 1400.0, 1500.0]))
    np.testing.assert_allclose(cover.depth(4, lon, lat), [600.0, 100.0, -100.0, -50.0], rtol=0.0, atol=MILLIMETRES)
    np.testing.assert_allclose(cover.depth(3, lon, lat), [-400.0, 100.0, -1100.0, 250.0], rtol=0.0, atol=MILLIMETRES)


def test_outlines_are_closed_and_of_full_size() -> None:
    cover = Cover((20.0, -35.0), (-50.0, 70.0), 2, 3, 1000.0, 200.0)
    np.testing.assert_array_equal(cover.core_outline(4), [[950, 1070], [1950, 1070], [1950, 2070], [950, 2070], [950, 1070]])
    np.testing.assert_array_equal(cover.tile_outline(4), [[850, 970], [2050, 970], [2050, 2170], [850, 2170], [850, 970]])
    assert cover.core_bounds(4) == (950.0, 1070.0, 1950.0, np.inf)


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
    for tile in cover.tiles():
        for cell in cover.cells_owned(tile):
            assert cover.cell_number(cover.cell_name(cell)) == cell


def test_names_beyond_a_thousand_rows() -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 1200, 3, 10.0, 1.0)
    assert cover.tile_name(3 * 1100 + 2) == "r1100c002"
    assert cover.tile_number("r1100c002") == 3 * 1100 + 2


@pytest.mark.parametrize("name", ["r003c000", "r000c004", "r0c0", "x", "", "r000c000-c", "R000c000", "r-01c000"])
def test_unknown_tiles_are_named_with_what_there_is(name: str) -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 3, 4, 10.0, 1.0)
    with pytest.raises(InputError, match=f"tile is '{name}'; expected a name from r000c000 to r002c003"):
        cover.tile_number(name)


@EXAMPLES
@given(covers())
def test_description_is_plain_and_comes_back(cover: Cover) -> None:
    assert Cover.from_mapping(json.loads(json.dumps(cover.to_mapping()))) == cover


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
    np.testing.assert_array_equal(cover.cells_of(lon, lat) // 9, expected.cells_of(lon, lat) // 9)


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
