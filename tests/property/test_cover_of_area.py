"""The cover of an area is the smallest grid that holds it; unusable areas are named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
from covers import CODES, Array
from shapely.geometry import MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry

from submin.errors import InputError
from submin.tiling.area import cover_area
from submin.tiling.cover import Cover


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
