"""The simulated China: its size is that of the paper, its rays explain its truth, and parts of it know the same points and errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from numpy.typing import NDArray
from outlines import WORLD
from real_data import real_data
from shapely.geometry.base import BaseGeometry
from typer.testing import CliRunner

from orchestration.commands.simulate import app
from orchestration.executors import SerialExecutor, executor_for
from orchestration.progress import Silent
from orchestration.simulate import simulate_campaign
from submin.accuracy import ce90
from submin.errors import CatalogueError, InputError
from submin.formats.outlines import named_polygons
from submin.geodesy import WGS84, geodetic_to_geocentric, local_axes
from submin.network.network_image import image_set
from submin.sensors import Ground, sensor_named
from submin.sensors.footprint import ground_pixels
from submin.sensors.rpc import image_centres
from submin.simulation.campaign import Campaign, SceneRays, simulate_scene, true_parameters
from submin.simulation.china import MOST_COPIES, TRIPLETS, china, placed, sub_areas, turn
from submin.simulation.scene import simulated_image_set
from submin.storage.block_images import network_images
from submin.storage.catalogue import Catalogue, defects

Array = NDArray[np.float64]

real_data(whole_module=True)

RPC = sensor_named("rpc")
FEW, SOME = 0.001, 0.005
HERE = np.zeros(1)


@pytest.fixture(scope="module")
def outline() -> BaseGeometry:
    return named_polygons(WORLD / "naturalearth_lowres" / "naturalearth_lowres.shp", "name")["China"]


@pytest.fixture(scope="module")
def whole(outline: BaseGeometry) -> Campaign:
    return china(outline)


@pytest.fixture(scope="module")
def few(outline: BaseGeometry) -> Campaign:
    return china(outline, FEW, seed=4)


@pytest.fixture(scope="module")
def rays(few: Campaign) -> list[SceneRays]:
    return [simulate_scene(few.design, scene) for scene in few.scenes]


@pytest.fixture(scope="module")
def catalogue(few: Campaign, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("china") / "catalogue"
    simulate_campaign(few, path, SerialExecutor(), Silent())
    return path


def centres(campaign: Campaign) -> Array:
    return np.concatenate([scene.geodetic(HERE, HERE) for scene in campaign.scenes])


def exact(campaign: Campaign, scene: SceneRays, theta: Array) -> Array:
    cameras = simulated_image_set(scene.images, {scene.images[0].block_id: campaign.design.priors}).cameras
    ground = Ground.at(geodetic_to_geocentric(campaign.design.grid.geodetic(scene.points)))
    point = np.searchsorted(scene.points, scene.number).astype(np.int32)
    return RPC.project(cameras, theta, ground, scene.image, point).image


def test_size_is_the_papers(whole: Campaign) -> None:
    assert len(whole.scenes) == TRIPLETS == 8802
    assert sum(len(scene.views) for scene in whole.scenes) == 26406
    assert len({scene.block_id for scene in whole.scenes}) == TRIPLETS
    assert len({scene.pass_id for scene in whole.scenes}) == pytest.approx(726, rel=0.02)
    assert whole.check_points == 8000
    assert [(view.pitch, view.pixel) for view in whole.scenes[0].views] == [(22.0, 3.5), (0.0, 2.1), (-22.0, 3.5)]
    assert set(sub_areas(centres(whole)).tolist()) == {"West", "North", "Middle", "Northeast", "East"}


def test_scenes_cover_china_some_two_times(whole: Campaign, outline: BaseGeometry) -> None:
    rng = np.random.default_rng(0)
    west, south, east, north = outline.bounds
    places = np.stack([rng.uniform(west, east, 3000), rng.uniform(south, north, 3000), np.zeros(3000)], axis=1)
    places = places[shapely.contains_xy(outline, places[:, 0], places[:, 1])]
    direction = geodetic_to_geocentric(places)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    covered = np.zeros(len(places), dtype=np.int64)
    for scene in whole.scenes:
        along, across = np.arctan2(direction @ scene.orbit_axes[1], direction @ scene.orbit_axes[0]), direction @ scene.orbit_axes[2]
        covered += (np.abs(along - scene.along) < 25.0 / 6371.0) & (np.abs(across) < 25.0 / 6371.0)
    assert (covered == 0).mean() < 0.002
    assert (covered >= 2).mean() > 0.9
    assert 2.1 < covered.mean() < 2.5


def test_neighbours_come_together(whole: Campaign) -> None:
    x = geodetic_to_geocentric(centres(whole))
    step = np.linalg.norm(np.diff(x, axis=0), axis=1) / 1e3
    assert np.median(step) < 60.0 and np.mean(step > 300.0) < 0.02
    of_pass: dict[str, list[float]] = {}
    for scene in whole.scenes:
        of_pass.setdefault(scene.pass_id, []).append(scene.along)
    assert max(map(len, of_pass.values())) <= 17


def test_a_small_part_is_a_connected_one_of_the_whole(whole: Campaign, outline: BaseGeometry) -> None:
    part = china(outline, 0.01)
    assert len(part.scenes) == 88
    names = {scene.block_id: k for k, scene in enumerate(whole.scenes)}
    assert all(np.array_equal(scene.orbit_axes, whole.scenes[names[scene.block_id]].orbit_axes) for scene in part.scenes)
    assert all(scene.along == whole.scenes[names[scene.block_id]].along for scene in part.scenes)
    corners = np.array([[-25, -25], [-25, 25], [25, 25], [25, -25]], dtype=np.float64)
    scenes = [shapely.Polygon(scene.geodetic(corners[:, 0], corners[:, 1])[:, :2]) for scene in part.scenes]
    assert isinstance(shapely.union_all(scenes), shapely.Polygon)


def test_several_chinas_have_the_same_geometry(whole: Campaign, outline: BaseGeometry) -> None:
    three = china(outline, 3.0)
    assert len(three.scenes) == 26406
    assert len({scene.block_id for scene in three.scenes}) == 26406
    first = geodetic_to_geocentric(centres(whole))
    at = geodetic_to_geocentric(centres(three)).reshape(3, TRIPLETS, 3)
    for copy in range(3):
        np.testing.assert_allclose(at[copy], first @ turn(copy).T, rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(sub_areas(centres(three)).reshape(3, -1), np.tile(sub_areas(centres(whole)), (3, 1)))
    lands = [shapely.transform(outline, lambda places, copy=copy: placed(places, copy)) for copy in range(MOST_COPIES)]
    gaps = shapely.distance(np.array(lands)[:, None], np.array(lands)) + np.eye(MOST_COPIES)
    assert gaps.min() > 0.6, "copies do not touch"
    assert min(land.bounds[0] for land in lands) > -179.0 and max(land.bounds[2] for land in lands) < 179.0


@pytest.mark.parametrize("copy", range(MOST_COPIES))
def test_copies_are_turned_rigidly(copy: int) -> None:
    rotation = turn(copy)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    places = np.array([[74.0, 39.0], [104.35, 36.0], [134.0, 48.0], [110.0, 19.0]])
    before, after = (geodetic_to_geocentric(np.column_stack([p, np.zeros(4)])) for p in (places, placed(places, copy)))
    np.testing.assert_allclose(after, before @ rotation.T, rtol=0.0, atol=1e-6)


def test_rays_are_the_truth_and_noise(few: Campaign, rays: list[SceneRays]) -> None:
    residual = np.concatenate([scene.observed - exact(few, scene, scene.theta) for scene in rays]) / few.design.sigma_px
    assert len(residual) > 15000
    assert np.std(residual) == pytest.approx(1.0, abs=0.02) and np.abs(residual.mean(axis=0)).max() < 0.03
    assert np.abs(residual).max() < 6.0
    perfect = replace(few.design, noise_scale=0.0)
    scene = simulate_scene(perfect, few.scenes[3])
    assert np.abs(scene.observed - exact(few, scene, scene.theta)).max() < 1e-9
    np.testing.assert_array_equal(scene.number, rays[3].number)
    assert np.abs(scene.observed - exact(few, scene, np.zeros_like(scene.theta))).max() > 3.0


def test_a_scene_needs_no_other(few: Campaign, rays: list[SceneRays]) -> None:
    for k in (5, 2):
        again = simulate_scene(few.design, few.scenes[k])
        assert again.images == rays[k].images
        for name in ("number", "image", "observed", "theta"):
            np.testing.assert_array_equal(getattr(again, name), getattr(rays[k], name))
    other = simulate_scene(replace(few.design, seed=5), few.scenes[5])
    assert other.images == rays[5].images and not np.array_equal(other.theta, rays[5].theta)


def test_points_have_some_six_rays_where_all_neighbours_are_there(outline: BaseGeometry) -> None:
    part = china(outline, SOME)
    numbers = [simulate_scene(part.design, scene).number for scene in part.scenes]
    assert 2000 < np.mean([len(number) for number in numbers]) < 2200
    point, rays_of = np.unique(np.concatenate(numbers), return_counts=True)
    _, scenes_of = np.unique(np.concatenate([np.unique(number) for number in numbers]), return_counts=True)
    at = geodetic_to_geocentric(part.design.grid.geodetic(point))
    middle = np.linalg.norm(at - geodetic_to_geocentric(np.array([[103.8, 36.1, 2500.0]])), axis=1) < 70e3
    assert middle.sum() > 4000
    assert 5.5 < rays_of[middle].mean() < 6.5
    assert (scenes_of[middle] >= 2).mean() > 0.7
    assert rays_of.min() >= 2


def test_errors_are_fifteen_metres_and_shared_as_asked(outline: BaseGeometry) -> None:
    for error, part in (("independent", 0.0), ("mixed", 0.5), ("common", 1.0)):
        campaign = china(outline, SOME, error=error)
        own, shifts, drifts = campaign.design.priors, [], []
        assert own.common_to_pass == part
        for scene in campaign.scenes[:2]:
            found = simulate_scene(campaign.design, scene)
            members = simulated_image_set(found.images, {scene.block_id: own})
            pixels = ground_pixels(RPC, members.cameras, image_centres(members.cameras), WGS84)
            for seed in range(200):
                theta = true_parameters(seed, found.images, members)
                shifts.append(theta[:, [0, 3]] * pixels[:, None])
                drifts.append(theta[:, [1, 2, 4, 5]])
        metres = np.stack(shifts)
        # common to a pass, 200 draws of two coordinates say no more: four sigma
        assert np.sqrt(np.mean(metres**2)) == pytest.approx(15.0, rel=4.0 / np.sqrt(800.0))
        assert np.sqrt(np.mean(np.stack(drifts) ** 2)) == pytest.approx(1.0, rel=0.05)
        between = np.mean(metres[:, 0] * metres[:, 1]) / 225.0
        assert between == pytest.approx(part, abs=4.0 * np.sqrt(2.0 / 400.0)), "forward and nadir images of a pass"
        if error == "common":
            np.testing.assert_allclose(metres[:, 0], metres[:, 1], rtol=5e-3)


def test_catalogue_keeps_its_contract(few: Campaign, catalogue: Path) -> None:
    opened = Catalogue.open(catalogue)
    found = opened.validate()
    assert (found.blocks, found.images) == (9, 27)
    assert json.loads((catalogue / "priors.json").read_text())["default"]["bias_m"] == 15.0
    assert [block.block_id for block in opened.blocks()] == [scene.block_id for scene in few.scenes]
    truth, check = opened.points("truth"), opened.points("check")
    assert truth is not None and check is not None and len(check) == 100
    place = dict(zip(truth.point_ids.tolist(), truth.geodetic, strict=True))
    seen = set()
    for block in opened.blocks():
        assert defects(block) is None
        seen |= set(block.point_ids.tolist())
        images = image_set(network_images(block), WGS84, 6)
        theta = true_parameters(4, tuple(block.images), images)  # type: ignore[arg-type]
        ground = Ground.at(geodetic_to_geocentric(np.array([place[name] for name in block.point_ids.tolist()])))
        predicted = images.project(theta, ground, block.image, np.arange(len(block), dtype=np.int32)).image
        assert np.abs(predicted - block.observed).max() < 6.0 * 0.5
    assert seen == set(place)
    off = geodetic_to_geocentric(check.geodetic) - geodetic_to_geocentric(np.array([place[name] for name in check.point_ids.tolist()]))
    enu = np.einsum("nij,nj->ni", local_axes(check.geodetic), off)
    assert np.sqrt((enu**2).mean(axis=0)) == pytest.approx(np.full(3, 0.1), abs=0.03)
    assert ce90(check.covariance_enu[:, :2, :2])[0] == pytest.approx(0.2146, abs=1e-3)
    assert set(check.area.tolist()) <= {"North", "Middle"}


def test_the_catalogue_does_not_depend_on_the_workers(few: Campaign, catalogue: Path, tmp_path: Path) -> None:
    with executor_for(2) as executor:
        size = simulate_campaign(few, tmp_path / "two", executor, Silent())
    assert (size.blocks, size.images, size.check_points) == (9, 27, 100)
    for path in sorted(catalogue.iterdir()):
        assert (tmp_path / "two" / path.name).read_bytes() == path.read_bytes(), path.name
    assert pq.read_metadata(catalogue / "truth.parquet").num_rows == size.points
    assert pq.read_metadata(catalogue / "measurements.parquet").num_rows == size.rays


def test_nothing_is_written_over(few: Campaign, catalogue: Path) -> None:
    with pytest.raises(CatalogueError, match="is not empty"):
        simulate_campaign(few, catalogue, SerialExecutor(), Silent())


def test_what_cannot_be_simulated_is_refused(outline: BaseGeometry) -> None:
    for scale in (0.0, -1.0, 11.0, float("nan")):
        with pytest.raises(InputError, match="--scale is"):
            china(outline, scale)
    with pytest.raises(InputError, match="--error is 'none'; expected one of independent, mixed, common"):
        china(outline, 1.0, error="none")


@pytest.mark.parametrize(
    ("words", "sizes"),
    [
        (["china", "--scale", "0.0005", "--error", "common"], {"blocks": 4, "images": 12, "check_points": 100}),
        (["footprints", "--scale", "0.01"], {"blocks": 4, "images": 8, "check_points": 100}),
        (["footprints", "--region", "morocco", "--scale", "0.02"], {"blocks": 5, "images": 5, "check_points": 100}),
    ],
)
def test_commands_say_what_they_made(words: list[str], sizes: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SUBMIN_DATA", str(WORLD.parent))
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "catalogue"), "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["simulated"] is True and {name: said[name] for name in sizes} == sizes
    summary = Catalogue.open(tmp_path / "catalogue").validate()
    assert (summary.blocks, summary.images, summary.rays) == (said["blocks"], said["images"], said["rays"])
    assert len({image.pass_id for image in Catalogue.open(tmp_path / "catalogue").images}) == said["passes"]
    text = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "again")])
    assert "simulated" in text.stdout and "passes" in text.stdout
