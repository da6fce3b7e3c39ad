"""Networks over whole continents (Natural Earth outlines), and footprints of Landsat scenes by the thousand."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from outlines import continents, landsat_rings
from real_data import real_data
from shapely.geometry.base import BaseGeometry

import submin
from orchestration.cli import main
from submin.tiling.area import cover_area
from submin.tiling.cover import Cover
from submin.tiling.footprints import FootprintIndex, in_plane

real_data(whole_module=True)

AREAS = continents()
MILLIONS_OF_KM2 = {
    "Africa": 30.0,
    "Antarctica": 12.3,
    "Asia": 31.2,
    "Europe": 23.1,
    "North America": 24.5,
    "Oceania": 8.5,
    "South America": 17.8,
}
"""Of the outlines on the ellipsoid, Russia with Europe; by pyproj's geodesic areas, part by part."""


@pytest.mark.parametrize("name", MILLIONS_OF_KM2)
def test_cover_of_a_continent(name: str) -> None:
    area, started = AREAS[name], time.monotonic()
    cover = cover_area(area, 100e3, 20e3)
    tiles = np.array(list(cover.tiles()))
    assert time.monotonic() - started < 20.0
    kept = shapely.from_wkb(cover.area)
    assert kept.area / 1e12 == pytest.approx(MILLIONS_OF_KM2[name], rel=0.01)
    # as many tiles as the land needs, and those along its coast; not those of all oceans between its islands
    coast = kept.length / 100e3
    assert kept.area / 1e10 < cover.tile_count == len(tiles) < kept.area / 1e10 + 2.0 * coast + 50.0
    assert cover.tile_count < 0.65 * cover.rows * cover.columns
    lon, lat = inner_places(area)
    assert not cover.outside(lon, lat).any()
    owners = cover.cells_of(lon, lat) // 25
    assert np.isin(owners, tiles).all()
    # by brute force, in longitude and latitude: a tile whose middle is on land is one, and every other is near land
    middle = np.array([cover.core_outline(tile)[[0, 2]].mean(axis=0) for tile in cover.leaves()])
    at = np.column_stack(cover.geographic(*middle.T))
    on_land = shapely.contains_xy(area, at[:, 0], at[:, 1])
    every = np.array(list(cover.leaves()))
    assert np.isin(every[on_land], tiles).all()


def inner_places(area: BaseGeometry, count: int = 3000) -> tuple[Any, Any]:
    """Longitudes and latitudes on land."""
    rng = np.random.default_rng(5)
    west, south, east, north = area.bounds
    lonlat = rng.uniform([west, south], [east, north], (20 * count, 2))
    inside = lonlat[shapely.contains_xy(area, lonlat[:, 0], lonlat[:, 1])][:count]
    assert len(inside) > 300
    return inside[:, 0], inside[:, 1]


def test_create_of_a_continent_says_its_tiles(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def command(*words: object) -> dict[str, Any]:
        monkeypatch.setattr("sys.argv", ["submin", *map(str, words), "--json"])
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code
        return dict(json.loads(capsys.readouterr().out))

    geometry = json.loads(shapely.to_geojson(AREAS["Europe"]))
    (tmp_path / "europe.geojson").write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": geometry}))
    created = command("create", tmp_path / "network", "--aoi", tmp_path / "europe.geojson", "--tile-km", 100, "--overlap-km", 20)
    cover = submin.open(tmp_path / "network").cover
    assert created["tiles"] == cover.tile_count == command("info", tmp_path / "network")["tiles_of_the_area"]
    assert 2500 < created["tiles"] < 3200 < created["rows"] * created["columns"]
    # eastern Siberia is beyond 180 degrees
    assert not cover.outside_area(np.array([-172.0, 175.0, 10.0]), np.array([66.0, 67.0, 50.0])).any()
    assert cover.outside(np.array([-150.0, 100.0]), np.array([66.0, 30.0])).all()


@pytest.mark.parametrize(
    "chosen",
    [lambda at: (at[:, 0] > 113).all() and (at[:, 0] < 154).all() and (at[:, 1] < -10).all() and (at[:, 1] > -44).all(),
     lambda at: (at[:, 1] > 78.0).all()],
    ids=["Australia", "Arctic"],
)  # fmt: skip
def test_landsat_scenes_go_to_every_tile_that_they_meet(chosen: Callable[[Any], bool]) -> None:
    rings = [ring for ring in landsat_rings() if chosen(ring)]
    assert len(rings) > 350
    footprints = np.array([shapely.Polygon(ring) for ring in rings], dtype=np.object_)
    cover = Cover((135.0, -27.0), (-2.2e6, -2e6), 10, 11, 4e5, 1e5)
    if rings[0][:, 1].min() > 0.0:
        cover = Cover((0.0, 90.0), (-1.5e6, -1.5e6), 6, 6, 5e5, 1e5)
    cover = cover.split(12).split(cover.quarters(12)[3])
    tiles, scenes = FootprintIndex.of(footprints, cover).all_met(cover)
    flat = in_plane(footprints, cover)
    expected = set()
    for tile in cover.leaves():
        outline = shapely.box(*np.clip(cover.tile_bounds(tile), -1e8, 1e8))
        expected |= {(tile, int(k)) for k in np.flatnonzero(shapely.intersects(outline, flat))}
    assert set(zip(tiles.tolist(), scenes.tolist(), strict=True)) == expected
    assert set(scenes.tolist()) == set(range(len(rings)))
