"""Simulated images of real footprints: their formats hold the outlines, their rays lie in them, neighbours are tied as they overlap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from outlines import WORLD
from real_data import real_data

from orchestration.executors import SerialExecutor
from orchestration.progress import Silent
from orchestration.simulate import simulate_campaign
from submin.errors import InputError
from submin.formats.outlines import landsat_outlines, named_polygons, satellite_scenes
from submin.geodesy import geodetic_to_geocentric
from submin.sensors import Ground, sensor_named
from submin.simulation.campaign import Campaign, SceneRays, simulate_scene
from submin.simulation.footprints import australia, morocco
from submin.simulation.scene import simulated_image_set
from submin.storage.catalogue import Catalogue, defects

Array = NDArray[np.float64]

real_data(whole_module=True)

RPC = sensor_named("rpc")
LANDSAT, SCENES = WORLD / "wrs2_descending.csv.gz", WORLD / "maxar_open_data_scenes.jsonl.gz"


@pytest.fixture(scope="module")
def campaigns() -> dict[str, Campaign]:
    land = named_polygons(WORLD / "naturalearth_lowres" / "naturalearth_lowres.shp", "name")["Australia"]
    return {"australia": australia(landsat_outlines(LANDSAT), land), "morocco": morocco(satellite_scenes(SCENES))}


def cameras(campaign: Campaign, scene: SceneRays) -> Array:
    return simulated_image_set(scene.images, {scene.images[0].block_id: campaign.design.priors}).cameras


def test_all_real_scenes_are_there(campaigns: dict[str, Campaign]) -> None:
    continent, event = campaigns["australia"], campaigns["morocco"]
    assert 360 < len(continent.scenes) < 385 and {len(scene.views) for scene in continent.scenes} == {2}
    assert len({scene.pass_id for scene in continent.scenes}) < 40
    assert 230 < len(event.scenes) < 238 and {len(scene.views) for scene in event.scenes} == {1}
    pitch = np.array([scene.views[0].pitch for scene in event.scenes])
    assert np.ptp(pitch) > 30.0 and np.abs(pitch).max() < 45.0


@pytest.mark.parametrize("region", ["australia", "morocco"])
def test_images_show_the_real_outlines(region: str, campaigns: dict[str, Campaign]) -> None:
    campaign = campaigns[region]
    for scene in campaign.scenes[:: len(campaign.scenes) // 6]:
        found = simulate_scene(campaign.design, scene)
        outline = shapely.from_wkb(scene.outline)
        assert {image.footprint for image in found.images} == {scene.outline}
        ring = shapely.get_coordinates(outline)
        middle = np.full(len(ring), 0.5 * campaign.design.grid.relief_m)
        ground = Ground.at(geodetic_to_geocentric(np.column_stack([ring, middle])))
        m, n = len(found.images), len(ring)
        image, point = (index.ravel().astype(np.int32) for index in np.indices((m, n)))
        place = RPC.project(cameras(campaign, found), np.zeros((m, 6)), ground, image, point).image
        size = np.array([[i.width, i.height] for i in found.images], dtype=np.float64)[image]
        part = (place + 0.5) / size
        assert part.min() > -0.02 and part.max() < 1.02, "the outline is in the format"
        assert part.min() < 0.03 and part.max() > 0.97, "which is no larger"
        at = campaign.design.grid.geodetic(found.points)
        assert len(at) > 5
        assert shapely.contains_xy(outline, at[:, 0], at[:, 1]).all()


def test_neighbours_are_tied_as_their_outlines_overlap(campaigns: dict[str, Campaign]) -> None:
    campaign = campaigns["australia"]
    near = [scene for scene in campaign.scenes if scene.pass_id in ("path-100", "path-101")]
    scenes = [scene for scene in near if shapely.contains(campaign.design.outline, shapely.from_wkb(scene.outline))]
    assert len(scenes) > 10
    points = [simulate_scene(campaign.design, scene).points for scene in scenes]
    outlines = [shapely.from_wkb(scene.outline) for scene in scenes]
    overlap, common = [], []
    for i in range(len(scenes)):
        for k in range(i):
            overlap.append(outlines[i].intersection(outlines[k]).area / outlines[i].area)
            common.append(len(np.intersect1d(points[i], points[k])) / len(points[i]))
    assert np.corrcoef(overlap, common)[0, 1] > 0.9
    assert np.sum(np.array(common) > 0.0) > len(scenes)


def test_passes_are_minutes_of_one_satellite(campaigns: dict[str, Campaign]) -> None:
    days: dict[str, list[float]] = {}
    for scene in campaigns["morocco"].scenes:
        days.setdefault(scene.pass_id, []).append(scene.day)
    assert 100 < len(days) < len(campaigns["morocco"].scenes)
    for found in days.values():
        assert np.diff(sorted(found)).max(initial=0.0) <= 180.0 / 86400.0


@pytest.mark.parametrize(("region", "blocks"), [("australia", 7), ("morocco", 12)])
def test_a_part_makes_a_catalogue(region: str, blocks: int, tmp_path: Path) -> None:
    land = named_polygons(WORLD / "naturalearth_lowres" / "naturalearth_lowres.shp", "name")["Australia"]
    part = australia(landsat_outlines(LANDSAT), land, 0.02) if region == "australia" else morocco(satellite_scenes(SCENES), 0.05)
    size = simulate_campaign(part, tmp_path / "catalogue", SerialExecutor(), Silent())
    opened = Catalogue.open(tmp_path / "catalogue")
    summary = opened.validate()
    assert (summary.blocks, summary.rays) == (size.blocks, size.rays) and summary.blocks == blocks
    assert all(defects(block) is None for block in opened.blocks())
    check = opened.points("check")
    assert check is not None and len(check) == size.check_points == 100


def test_what_cannot_be_simulated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--scale is 2; expected a part of the 23[0-9] scenes"):
        morocco(satellite_scenes(SCENES), 2.0)
    with pytest.raises(InputError, match="no scene of Morocco in the list"):
        morocco([])
    wrong = tmp_path / "wrong.csv.gz"
    wrong.write_bytes(LANDSAT.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"wrong.csv.gz: cannot be read"):
        landsat_outlines(wrong)
    with pytest.raises(InputError, match=r"wrong.csv.gz: cannot be read"):
        satellite_scenes(wrong)
    with pytest.raises(InputError, match="has no column 'nation'; expected one of"):
        named_polygons(WORLD / "naturalearth_lowres" / "naturalearth_lowres.shp", "nation")
    with pytest.raises(InputError, match="cannot be read as a shapefile"):
        named_polygons(tmp_path / "none.shp", "name")
