"""Covers of areas of any shape anywhere: polygons with holes and in parts, across the antimeridian, over the poles, split or not."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry

from submin.errors import InputError
from submin.tiling.area import MAX_OUTLINE, cover_area, polygons_of
from submin.tiling.cover import ZONES, Cover
from submin.tiling.footprints import FootprintIndex, footprint_widths, in_plane, on_globe

Array = NDArray[np.float64]

EXAMPLES = settings(max_examples=40, deadline=None, derandomize=True)
POLES = [(0.0, 90.0), (77.0, -90.0), (-140.0, 89.0), (30.0, -88.5)]
ANTIMERIDIAN = [(180.0, 0.0), (-179.7, -17.0), (179.5, 66.0), (-180.0, -77.0)]
ELSEWHERE = [(0.0, 0.0), (10.0, 50.0), (-70.0, -40.0), (100.0, 35.0)]


@dataclass(frozen=True)
class Place:
    """An area, and the same in the plane of a frame about its middle, where it was drawn; metres."""

    area: BaseGeometry
    flat: BaseGeometry
    frame: Cover

    @property
    def size(self) -> float:
        west, south, east, north = self.flat.bounds
        return float(max(east - west, north - south))


def star(rng: np.random.Generator, at: Array, size: float, corners: int) -> Polygon:
    """A polygon with corners in all directions, some near, some far."""
    angle = 2.0 * np.pi * (np.arange(corners) + rng.uniform(0.0, 0.8, corners)) / corners
    return Polygon(at + size * rng.uniform(0.35, 1.0, corners)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


def drawn(rng: np.random.Generator, size: float, parts: int, holes: bool) -> BaseGeometry:
    """Stars beside each other; a hole in the middle of each, where there are holes."""
    shapes = []
    for k in range(parts):
        at = np.array([2.1 * size * k, size * rng.uniform(-1.0, 1.0)])
        shell = star(rng, at, size, int(rng.integers(4, 9)))
        shapes.append(shell.difference(star(rng, at, 0.25 * size, 5)) if holes else shell)
    return shapely.transform(MultiPolygon(shapes), lambda p: p - 1.05 * size * np.array([parts - 1, 0.0]))


def laid_out(frame: Cover, flat: BaseGeometry, cut: bool) -> BaseGeometry:
    """Polygons of the plane in longitude and latitude: cut at the antimeridian, or running on beyond it."""

    def region(ring: BaseGeometry) -> BaseGeometry:
        fine = shapely.segmentize(shapely.polygons(ring), 2e-3 * np.sqrt(flat.area))
        return on_globe(shapely.transform(fine, lambda at: np.column_stack(frame.geographic(at[:, 0], at[:, 1]))))

    def everywhere(shape: BaseGeometry) -> BaseGeometry:
        turns = np.array([[-360.0, 0.0], [0.0, 0.0], [360.0, 0.0]])
        return shapely.union_all([shapely.transform(shape, lambda at, turn=turn: at + turn) for turn in turns])

    areas = []
    for part in flat.geoms:
        area = region(part.exterior)
        for hole in part.interiors:
            area = area.difference(everywhere(region(hole)))
        areas.append(everywhere(area).intersection(box(-180.0, -90.0, 180.0, 90.0)) if cut else area)
    return polygons_of(shapely.union_all(areas))


@st.composite
def areas(draw: st.DrawFn) -> Place:
    """One to three polygons of 30 to 400 km, with and without holes."""
    frame = Cover(draw(st.sampled_from([*POLES, *ANTIMERIDIAN, *ELSEWHERE])), (0.0, 0.0), 1, 1, 1000.0, 0.0)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    flat = drawn(rng, draw(st.sampled_from([3e4, 2e5])), draw(st.integers(1, 3)), draw(st.booleans()))
    return Place(laid_out(frame, flat, draw(st.booleans())), flat, frame)


@st.composite
def covered(draw: st.DrawFn) -> tuple[Place, Cover]:
    """An area and its cover, of which up to four tiles were split."""
    place = draw(areas())
    core = place.size / draw(st.sampled_from([0.7, 2.5, 6.0]))
    cover = cover_area(place.area, core, core * draw(st.sampled_from([0.0, 0.2, 0.45])))
    for _ in range(draw(st.integers(0, 4))):
        possible = [tile for tile in cover.tiles() if cover.can_split(tile)]
        cover = cover.split(draw(st.sampled_from(possible))) if possible else cover
    return place, cover


def around(place: Place, seed: int, count: int = 300) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Places (longitude, latitude) in and around an area, none near its outline, and which of them are in it."""
    west, south, east, north = place.flat.bounds
    rng, margin = np.random.default_rng(seed), 0.1 * place.size
    at = rng.uniform([west - margin, south - margin], [east + margin, north + margin], (count, 2))
    clear = shapely.distance(place.flat.boundary, shapely.points(at)) > 2e-3 * place.size
    at = at[clear]
    return *place.frame.geographic(at[:, 0], at[:, 1]), shapely.contains_xy(place.flat, at[:, 0], at[:, 1])


@EXAMPLES
@given(covered(), st.integers(0, 2**32 - 1))
def test_every_point_of_an_area_is_in_one_core_of_its_tiles(given: tuple[Place, Cover], seed: int) -> None:
    place, cover = given
    lon, lat, inside = around(place, seed)
    assert inside.any()
    east, north = cover.plane(lon, lat)
    tiles = np.array(sorted(cover.tiles()))
    cores = np.array([cover.core_bounds(tile) for tile in tiles])
    held = (cores[:, 0] <= east[:, None]) & (east[:, None] < cores[:, 2]) & (cores[:, 1] <= north[:, None]) & (north[:, None] < cores[:, 3])
    np.testing.assert_array_equal(held[inside].sum(axis=1), 1)
    assert (held.sum(axis=1) <= 1).all()
    cells = cover.cells_of(lon, lat)
    np.testing.assert_array_equal(cells[inside] // ZONES**2, tiles[held[inside].argmax(axis=1)])
    # and in the cells of a tile that it is in, which know their holders
    for cell in np.unique(cells).tolist():
        owner = Cover.owner(cell)
        assert cell in cover.cells_owned(owner) and owner in cover.holders(cell)
        assert all(cell in cover.cells_held(tile) for tile in cover.holders(cell))
        assert cover.cell_number(cover.cell_name(cell)) == cell


@EXAMPLES
@given(covered(), st.integers(0, 2**32 - 1))
def test_places_outside_an_area_are_told(given: tuple[Place, Cover], seed: int) -> None:
    place, cover = given
    lon, lat, inside = around(place, seed)
    assert not cover.outside(lon[inside], lat[inside]).any()
    if cover.area:
        np.testing.assert_array_equal(cover.outside_area(lon, lat), ~inside)
    # outside the tiles is outside the area; whoever is in the core of a tile is not outside
    assert not (cover.outside(lon, lat) & ~cover.outside_area(lon, lat)).any()
    owners = set((cover.cells_of(lon, lat)[~cover.outside(lon, lat)] // ZONES**2).tolist())
    assert owners <= set(cover.tiles())
    turned = lon + 360.0 * np.sign(-lon)
    np.testing.assert_array_equal(cover.outside_area(turned, lat), cover.outside_area(lon, lat))


@EXAMPLES
@given(covered())
def test_tiles_are_those_whose_outline_meets_the_area(given: tuple[Place, Cover]) -> None:
    place, cover = given
    fine = shapely.segmentize(place.flat, 2e3)
    flat = shapely.transform(fine, lambda at: np.column_stack(cover.plane(*place.frame.geographic(at[:, 0], at[:, 1]))))
    every = list(cover.leaves())
    outlines = shapely.polygons([cover.tile_outline(tile) for tile in every])
    apart = shapely.distance(outlines, flat)
    depth = shapely.area(shapely.intersection(outlines, shapely.buffer(flat, 0)))
    tiles = set(cover.tiles())
    assert cover.tile_count == len(tiles) and tiles <= set(every)
    slack = 1e-3 * place.size
    for tile, distance, common in zip(every, apart.tolist(), depth.tolist(), strict=True):
        if distance > slack:
            assert tile not in tiles or not cover.area
        if common > slack**2:
            assert tile in tiles
    for tile in tiles:
        (west, south), (east, north) = cover.core_outline(tile)[[0, 2]]
        wide = cover.tile_outline(tile)
        assert (wide[0] <= [west, south]).all() and (wide[2] >= [east, north]).all()
        assert all(tile in cover.neighbours(other) for other in cover.neighbours(tile))


@EXAMPLES
@given(covered())
def test_numbers_names_and_cells_do_not_depend_on_the_area(given: tuple[Place, Cover]) -> None:
    _, cover = given
    grid = replace(cover, area=b"")
    assert list(grid.tiles()) == list(grid.leaves()) == list(cover.leaves())
    tiles = list(cover.tiles())
    assert [grid.tile_name(tile) for tile in tiles] == [cover.tile_name(tile) for tile in tiles]
    assert all(grid.cells_held(tile) == cover.cells_held(tile) for tile in tiles)
    assert [cover.tile_number(cover.tile_name(tile)) for tile in cover.leaves()] == list(cover.leaves())
    assert "area" not in grid.to_mapping()
    back = Cover.from_mapping(json.loads(json.dumps(cover.to_mapping())))
    assert back == cover and hash(back) == hash(cover) and list(back.tiles()) == tiles


@EXAMPLES
@given(areas())
def test_frame_is_about_the_middle_of_the_area(place: Place) -> None:
    cover = cover_area(place.area, place.size, 0.0)
    at = place.flat.centroid
    lon, lat = place.frame.geographic(np.array([at.x]), np.array([at.y]))
    assert np.hypot(*cover.plane(lon, lat))[0] < 1e-3 * place.size
    # the grid is the smallest over it, up to the turn of the axes
    assert cover.rows <= 2 and cover.columns <= 2


@EXAMPLES
@given(areas(), st.sampled_from([0.15, 0.4, 2.0]))
def test_footprints_go_to_every_tile_that_they_meet(place: Place, part: float) -> None:
    rings = [shapely.Polygon(p.exterior) for p in place.flat.geoms]
    lonlat = shapely.transform(np.array(rings), lambda at: np.column_stack(place.frame.geographic(at[:, 0], at[:, 1])))
    cover = cover_area(place.area, part * place.size, 0.1 * part * place.size)
    pairs = set(zip(*(column.tolist() for column in FootprintIndex.of(lonlat, cover).all_met(cover)), strict=True))
    bounds = {tile: np.clip(cover.tile_bounds(tile), -1e8, 1e8) for tile in cover.leaves()}
    expected = {(t, k) for k, shape in enumerate(in_plane(lonlat, cover)) for t, b in bounds.items() if box(*b).intersects(shape)}
    assert pairs == expected
    assert {k for _, k in pairs} == set(range(len(rings)))


@EXAMPLES
@given(st.sampled_from([*POLES, *ANTIMERIDIAN, *ELSEWHERE]), st.floats(0.0, 180.0), st.sampled_from([1e3, 5e4, 1.8e5]))
def test_width_is_the_shorter_side_in_metres_wherever_it_lies(at: tuple[float, float], turn: float, width: float) -> None:
    frame = Cover(at, (0.0, 0.0), 1, 1, 1000.0, 0.0)
    rectangle = shapely.affinity.rotate(box(-width, -0.5 * width, width, 0.5 * width), turn)
    lonlat = shapely.transform(np.array([rectangle]), lambda p: np.column_stack(frame.geographic(p[:, 0], p[:, 1])))
    np.testing.assert_allclose(footprint_widths(lonlat, frame.ellipsoid), width, rtol=2e-3)


# Examples


@pytest.mark.parametrize(
    ("area", "centre"),
    [
        (box(-180.0, 70.0, 180.0, 90.0), (None, 90.0)),
        (box(-180.0, -90.0, 180.0, -60.0), (None, -90.0)),
        (shapely.union_all([box(170.0, 60.0, 180.0, 62.0), box(-180.0, 60.0, -170.0, 62.0)]), (180.0, 61.0)),
        (box(3.0, 43.0, 6.0, 45.0), (4.5, 44.0)),
        (Polygon([(-170.0, 80.0), (-50.0, 80.0), (70.0, 80.0), (180.0, 80.0), (180.0, 90.0), (-170.0, 90.0)]), (None, 90.0)),
    ],
    ids=["arctic", "antarctic", "cut", "box", "round-the-pole"],
)
def test_centre_is_on_the_sphere_and_not_a_mean_of_longitudes(area: BaseGeometry, centre: tuple[float | None, float]) -> None:
    cover = cover_area(area, 1e6, 0.0)
    assert cover.centre[1] == pytest.approx(centre[1], abs=0.6)
    if centre[0] is not None:
        assert (cover.centre[0] - centre[0] + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-6)


def test_box_that_every_tile_meets_is_not_kept() -> None:
    assert cover_area(box(5.0, 43.0, 6.5, 44.0), 40e3, 10e3).area == b""
    bent = cover_area(box(-30.0, 60.0, 60.0, 62.0), 40e3, 10e3)
    assert bent.area and bent.tile_count < 0.3 * bent.rows * bent.columns
    for description in (bent.to_mapping(), cover_area(box(5.0, 43.0, 6.5, 44.0), 40e3, 10e3).to_mapping()):
        assert Cover.from_mapping({k: v for k, v in description.items() if k != "area"}).area == b""  # as written before areas were kept


def test_outline_of_many_corners_is_thinned_and_holds_the_area() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 60_000)
    radius = 2.0 + 0.02 * np.sin(9_000 * angle)
    area = Polygon(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])).buffer(0)
    cover = cover_area(area, 20e3, 2e3)
    assert shapely.get_num_coordinates(shapely.from_wkb(cover.area)) <= MAX_OUTLINE
    lon, lat = shapely.get_coordinates(area).T
    assert not cover.outside_area(lon, lat).any()
    np.testing.assert_array_equal(cover.outside_area(np.array([0.0, 2.2]), np.array([0.0, 0.0])), [False, True])


@pytest.mark.parametrize("area", [box(-180.0, -90.0, 180.0, 90.0), box(-180.0, -60.0, 180.0, 60.0)], ids=["all", "belt"])
def test_no_plane_reaches_around_the_globe(area: BaseGeometry) -> None:
    with pytest.raises(InputError, match="take less than a hemisphere"):
        cover_area(area, 1e6, 1e5)


def test_ten_million_tiles_are_refused_before_any_is_looked_at() -> None:
    with pytest.raises(InputError, match=r"the area would have (9|1\d),\d{3},\d{3} tiles; expected at most 1,000,000: choose a larger"):
        cover_area(Polygon([(0.0, 0.0), (30.0, 0.0), (30.0, 30.0), (0.0, 30.0), (-1.0, 15.0)]), 1e3, 100.0)


def test_footprint_whose_longitudes_jump_is_one_that_runs_on() -> None:
    jumping = Polygon([(179.0, 10.0), (-179.0, 10.0), (-179.0, 11.0), (179.0, 11.0)])
    assert on_globe(jumping).equals(box(179.0, 10.0, 181.0, 11.0)) or on_globe(jumping).equals(box(-181.0, 10.0, -179.0, 11.0))
    around_pole = Polygon([(lon, 88.0) for lon in range(-170, 190, 20)])
    assert on_globe(around_pole).area == pytest.approx(360.0 * 2.0)
