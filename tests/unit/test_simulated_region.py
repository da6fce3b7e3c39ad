"""The simulated region: its geometry, its errors, and that its truth explains its rays."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.geodesy import WGS84, geocentric_to_geodetic, geodetic_to_geocentric
from submin.sensors import Ground, sensor_named
from submin.simulation.linear_array import LinearArrayCamera
from submin.simulation.region import RegionDesign, RegionFrame, SimulatedRegion, simulate_region, terrain_height
from submin.storage.catalogue import Catalogue, defects
from submin.storage.simulated import quadrants, write_region

Array = NDArray[np.float64]

SMALL = RegionDesign(width_km=120.0, height_km=120.0, point_spacing_km=9.5, seed=7)
TINY = RegionDesign(width_km=60.0, height_km=60.0, point_spacing_km=15.0, blunder_rate=0.0, bad_cameras=0)


@pytest.fixture(scope="module")
def small() -> SimulatedRegion:
    return simulate_region(SMALL)


@pytest.fixture(scope="module")
def full() -> SimulatedRegion:
    return simulate_region(RegionDesign())


def predicted(region: SimulatedRegion, theta: Array, image: NDArray[np.int32], point: NDArray[np.int32]) -> Array:
    ground = Ground.at(geodetic_to_geocentric(region.truth))
    return sensor_named("rpc").project(region.packed_cameras(), theta, ground, image, point).image


def residuals(region: SimulatedRegion) -> Array:
    return np.stack([region.sample, region.line], axis=1) - predicted(region, region.theta, region.image, region.point)


def triplets_of_points(region: SimulatedRegion) -> NDArray[np.int64]:
    """Number of blocks that see each point."""
    blocks = {block: k for k, block in enumerate(dict.fromkeys(i.block_id for i in region.images))}
    block = np.array([blocks[i.block_id] for i in region.images])[region.image]
    pairs = np.unique(np.stack([block, region.point], axis=1), axis=0)
    return np.bincount(pairs[:, 1], minlength=len(region.point_ids))


def test_full_size(full: SimulatedRegion) -> None:
    assert 3000 <= len(full.point_ids) <= 3500
    assert 130 <= len({image.block_id for image in full.images}) <= 170
    assert len(full.images) == 3 * len({image.block_id for image in full.images})
    assert np.bincount(full.image, minlength=len(full.images)).min() >= 20
    assert 2.0 <= triplets_of_points(full).mean() <= 2.6
    strips = {image.pass_id for image in full.images}
    assert 10 <= len(strips) <= 25
    assert full.truth[:, 2].min() >= 0.0 and full.truth[:, 2].max() <= 2000.0
    assert np.ptp(full.truth[:, 2]) > 1000.0


def test_small_region_keeps_the_proportions(small: SimulatedRegion) -> None:
    assert len({image.block_id for image in small.images}) == 12
    assert 140 <= len(small.point_ids) <= 180
    assert np.bincount(small.image, minlength=len(small.images)).min() >= 20
    assert 2.0 <= triplets_of_points(small).mean() <= 2.6


def test_strips_overlap_sideways(small: SimulatedRegion) -> None:
    across, along = SMALL.scene_across_km, SMALL.scene_along_km
    assert (np.diff(across) < 0.6 * SMALL.scene_km).all()
    assert (np.diff(along) <= 0.9 * SMALL.scene_km + 1e-9).all()
    assert across[0] - 0.5 * SMALL.scene_km == pytest.approx(-60.0)
    assert along[-1] + 0.5 * SMALL.scene_km == pytest.approx(60.0)


def test_linear_array_projects_back_what_it_looks_at() -> None:
    design = RegionDesign()
    frame = RegionFrame.of(design)
    axes, radius, pitch = frame.orbit_axes(80.0), frame.radius + 506e3, np.radians(22.0)
    camera = LinearArrayCamera(axes, radius, float(pitch), 6.4e-6, 5.5e-7, 0.01, 14286)
    line, column, distance = np.array([0.0, 5000.0, 14000.0]), np.array([0.0, 9000.0, 14285.0]), np.array([5.4e5, 5.5e5, 5.6e5])
    angle = 0.01 + 5.5e-7 * line
    up = np.cos(angle)[:, None] * axes[0] + np.sin(angle)[:, None] * axes[1]
    forward = np.cos(angle)[:, None] * axes[1] - np.sin(angle)[:, None] * axes[0]
    axis = np.sin(pitch) * forward - np.cos(pitch) * up
    right = -axes[2]
    look = axis + (6.4e-6 * (column - 0.5 * 14285.0))[:, None] * right
    image = camera.project(geocentric_to_geodetic(radius * up + distance[:, None] * look))
    np.testing.assert_allclose(image, np.stack([column, line], axis=1), rtol=0.0, atol=1e-4)


def test_views_pixels_and_times_are_those_of_zy3(small: SimulatedRegion) -> None:
    sensor = sensor_named("rpc")
    cameras = small.packed_cameras()[:3]
    size = np.array([[i.width, i.height] for i in small.images[:3]])
    image = np.arange(3, dtype=np.int32)
    centre = 0.5 * (size - 1.0)
    at = geodetic_to_geocentric(sensor.localise(cameras, image, centre[:, 0], centre[:, 1], np.full(3, 1000.0), WGS84))
    assert np.abs(at - at.mean(axis=0)).max() < 1.0, "the three images of a triplet share their centre"
    raised = geodetic_to_geocentric(sensor.localise(cameras, image, centre[:, 0], centre[:, 1], np.full(3, 2000.0), WGS84))
    tilt = np.degrees(np.arccos((raised - at) @ (at.mean(axis=0) / np.linalg.norm(at.mean(axis=0))) / np.linalg.norm(raised - at, axis=1)))
    np.testing.assert_allclose(tilt, [23.9, 0.0, 23.9], atol=0.4)
    np.testing.assert_allclose(np.degrees(np.arccos(_cosine(raised[0] - at[0], raised[2] - at[2]))), 47.7, atol=0.5)
    for step in ([1.0, 0.0], [0.0, 1.0]):
        beside = centre + step
        moved = geodetic_to_geocentric(sensor.localise(cameras, image, beside[:, 0], beside[:, 1], np.full(3, 1000.0), WGS84))
        np.testing.assert_allclose(np.linalg.norm(moved - at, axis=1), [3.5, 2.1, 3.5], rtol=0.01)
    forward, nadir, backward = (i.seconds for i in small.images[:3])
    assert 20.0 < nadir - forward < 40.0 and 20.0 < backward - nadir < 40.0
    assert [i.image_id.rsplit("-", 1)[1] for i in small.images[:3]] == ["FWD", "NAD", "BWD"]


def _cosine(a: Array, b: Array) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def test_a_pass_flies_at_its_azimuth(small: SimulatedRegion) -> None:
    strip = [i for i in small.images if i.pass_id == "pass-000" and i.image_id.endswith("NAD")]
    seconds = np.array([i.seconds for i in strip])
    assert (np.diff(seconds) > 3.0).all() and np.ptp(seconds) < 60.0
    first, last = (shapely.from_wkb(i.footprint).centroid for i in (strip[0], strip[-1]))
    north = last.y - first.y
    east = (last.x - first.x) * np.cos(np.radians(SMALL.latitude))
    assert np.degrees(np.arctan2(east, north)) % 360.0 == pytest.approx(190.0, abs=1.0)


def test_perfect_rays_meet_the_truth_exactly() -> None:
    region = simulate_region(replace(SMALL, noise_scale=0.0, blunder_rate=0.0))
    assert np.abs(residuals(region)).max() < 1e-9
    unadjusted = predicted(region, np.zeros_like(region.theta), region.image, region.point)
    assert np.abs(unadjusted - predicted(region, region.theta, region.image, region.point)).max() > 10.0


def test_noise_is_as_stated(full: SimulatedRegion) -> None:
    good = residuals(full)[~full.blunder] / full.sigma_sample[0]
    assert (full.sigma_sample == 0.5).all() and (full.sigma_line == 0.5).all()
    assert np.std(good) == pytest.approx(1.0, abs=0.02)
    assert np.abs(good.mean(axis=0)).max() < 0.03
    assert np.abs(good).max() < 6.0


def test_blunders_are_where_the_mask_says() -> None:
    region = simulate_region(replace(SMALL, blunder_rate=0.2, noise_scale=0.0))
    size = np.linalg.norm(residuals(region), axis=1)
    assert size[region.blunder].min() >= 5.0 - 1e-9 and size[region.blunder].max() <= 50.0 + 1e-9
    assert size[~region.blunder].max() < 1e-9
    assert region.blunder.mean() == pytest.approx(0.2, abs=0.05)


def test_every_point_is_seen_by_every_image_whose_format_holds_it(small: SimulatedRegion) -> None:
    m, n = len(small.images), len(small.point_ids)
    image, point = (index.ravel().astype(np.int32) for index in np.indices((m, n)))
    place = predicted(small, small.theta, image, point)
    size = np.array([[i.width, i.height] for i in small.images])[image]
    holds = ((place >= -0.5) & (place < size - 0.5)).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(holds), small.image.astype(np.int64) * n + small.point)


def test_order_of_images_points_and_rays(small: SimulatedRegion) -> None:
    blocks = [i.block_id for i in small.images]
    assert blocks == sorted(blocks)
    assert len({i.image_id for i in small.images}) == len(small.images)
    assert list(small.point_ids) == sorted(set(small.point_ids))
    key = small.image.astype(np.int64) * len(small.point_ids) + small.point
    assert (np.diff(key) > 0).all()
    assert len(set(small.point.tolist())) == len(small.point_ids)
    for block in set(blocks):
        assert len({i.pass_id for i in small.images if i.block_id == block}) == 1


def test_footprints_hold_what_the_images_see(small: SimulatedRegion) -> None:
    outlines = shapely.from_wkb(np.array([i.footprint for i in small.images]))
    assert shapely.is_valid(outlines).all()
    degree = 111.0
    np.testing.assert_allclose(shapely.area(outlines) * degree**2 * np.cos(np.radians(SMALL.latitude)), 2500.0, rtol=0.03)
    seen = shapely.points(small.truth[small.point, :2])
    assert (shapely.distance(outlines[small.image], seen) < 1.0 / degree).all()


def test_same_seed_same_region(small: SimulatedRegion) -> None:
    again, other = simulate_region(SMALL), simulate_region(replace(SMALL, seed=8))
    assert again.images == small.images and again.bad_cameras == small.bad_cameras
    for name in ("point_ids", "truth", "image", "point", "sample", "line", "theta", "blunder"):
        assert getattr(again, name).tobytes() == getattr(small, name).tobytes(), name
    assert other.images == small.images
    assert not np.array_equal(other.theta, small.theta)
    assert not np.array_equal(other.truth, small.truth)


def test_a_bad_camera_is_off_by_twelve_sigma(small: SimulatedRegion) -> None:
    good = simulate_region(replace(SMALL, bad_cameras=0))
    off = small.theta - good.theta
    changed = np.flatnonzero(np.abs(off).max(axis=1) > 0.0)
    assert [small.images[i].image_id for i in changed] == list(small.bad_cameras)
    assert len(changed) == 1 and good.bad_cameras == ()
    assert np.hypot(off[changed, 0], off[changed, 3])[0] == pytest.approx(120.0)
    assert np.abs(off[:, [1, 2, 4, 5]]).max() == 0.0


def test_true_parameters_follow_the_a_priori_model() -> None:
    priors = APriori(bias_px=8.0, drift_px=2.0, common_to_pass=0.36)
    regions = [simulate_region(replace(TINY, priors=priors, seed=seed)) for seed in range(60)]
    theta = np.stack([region.theta for region in regions])
    bias, drift = theta[:, :, [0, 3]], theta[:, :, [1, 2, 4, 5]]
    passes = np.array([i.pass_id for i in regions[0].images])
    assert len(set(passes)) >= 2
    assert np.sqrt(np.mean(drift**2)) == pytest.approx(2.0, rel=0.05)
    assert np.sqrt(np.mean(bias**2)) == pytest.approx(8.0, rel=0.1)
    same = np.mean([bias[:, i] * bias[:, j] for i, j in _pairs(passes) if passes[i] == passes[j]])
    apart = np.mean([bias[:, i] * bias[:, j] for i, j in _pairs(passes) if passes[i] != passes[j]])
    assert same / 64.0 == pytest.approx(0.36, abs=0.12)
    assert apart / 64.0 == pytest.approx(0.0, abs=0.12)
    assert np.mean([drift[:, i] * drift[:, j] for i, j in _pairs(passes)]) / 4.0 == pytest.approx(0.0, abs=0.05)


def _pairs(passes: NDArray[np.str_]) -> list[tuple[int, int]]:
    return [(i, j) for i in range(len(passes)) for j in range(i)]


def test_terrain_is_smooth_and_within_its_relief() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-300.0, 300.0, (2, 20000))
    height = terrain_height(x, y, 2000.0)
    assert height.min() >= 0.0 and height.max() <= 2000.0
    slope = (terrain_height(x + 0.01, y, 2000.0) - height) / 10.0
    assert np.abs(slope).max() < 0.1


@pytest.mark.parametrize("centre", [(179.9, -35.0), (-179.95, 0.0), (10.0, 60.0)])
def test_any_place_will_do(centre: tuple[float, float]) -> None:
    design = replace(SMALL, longitude=centre[0], latitude=centre[1], noise_scale=0.0, blunder_rate=0.0)
    region = simulate_region(design)
    assert 2.0 <= triplets_of_points(region).mean() <= 2.6
    assert np.bincount(region.image, minlength=len(region.images)).min() >= 20
    assert np.abs(region.truth[:, 0]).max() <= 180.0
    assert np.abs(residuals(region)).max() < 1e-9


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width_km": 40.0}, "width_km is 40.0"),
        ({"height_km": -1.0}, "height_km is -1.0"),
        ({"width_km": 4000.0}, "3000 km"),
        ({"latitude": 80.0}, "latitude is 80.0"),
        ({"strips": 2}, "2 strips"),
        ({"blunder_rate": 1.0}, "blunder_rate is 1.0"),
        ({"noise_scale": float("nan")}, "noise_scale is nan"),
        ({"bad_cameras": 37}, "expected 0 to 36"),
        ({"sigma_px": 0.0}, "sigma_px is 0.0"),
    ],
)
def test_a_design_that_cannot_be_laid_out_is_refused(change: dict[str, float], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(SMALL, **change)  # type: ignore[arg-type]


def test_catalogue_brings_everything_back(small: SimulatedRegion, tmp_path: Path) -> None:
    write_region(small, tmp_path / "region")
    catalogue = Catalogue.open(tmp_path / "region")
    summary = catalogue.validate()
    assert (summary.blocks, summary.images, summary.rays) == (12, 36, len(small.image))
    assert catalogue.a_priori("T000-000") == SMALL.priors
    assert [asdict(i) for i in small.images] == [{k: v for k, v in asdict(i).items() if k != "licence"} for i in catalogue.images]
    assert [i.seconds for i in catalogue.images] == [i.seconds for i in small.images]
    np.testing.assert_array_equal(np.stack([i.pack() for i in catalogue.images]), small.packed_cameras())

    blocks = list(catalogue.blocks())
    assert [defects(block) for block in blocks] == [None] * 12
    for name in ("sample", "line", "sigma_sample", "sigma_line"):
        np.testing.assert_array_equal(np.concatenate([getattr(block, name) for block in blocks]), getattr(small, name))
    image_ids = [block.images[i].image_id for block in blocks for i in block.image]
    assert image_ids == [small.images[i].image_id for i in small.image]
    assert [str(j) for block in blocks for j in block.point_ids] == small.point_ids[small.point].tolist()

    truth, check = catalogue.points("truth"), catalogue.points("check")
    assert truth is not None and check is not None and catalogue.points("control") is None
    for table in (truth, check):
        assert table.point_ids.tolist() == small.point_ids.tolist()
        np.testing.assert_array_equal(table.geodetic, small.truth)
    assert not check.covariance_enu.any()
    counts = [int((check.area == name).sum()) for name in ("NW", "NE", "SW", "SE")]
    assert sum(counts) == len(check) and min(counts) > 0.15 * len(check)
    assert (check.geodetic[check.area == "NE"][:, :2] >= [SMALL.longitude, SMALL.latitude]).all()
    assert (check.geodetic[check.area == "SW"][:, :2] < [SMALL.longitude, SMALL.latitude]).all()


def test_quadrants_across_the_antimeridian() -> None:
    places = np.array([[-179.9, 1.0, 0.0], [179.8, 1.0, 0.0], [-179.9, -1.0, 0.0], [179.8, -1.0, 0.0]])
    assert quadrants(places, replace(SMALL, longitude=179.9, latitude=0.0)).tolist() == ["NE", "NW", "SE", "SW"]
