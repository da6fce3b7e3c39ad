"""The papers' experiments as simulated: counts and common points are exact, and errors are drawn from the a priori model that is stated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from submin.accuracy import ce90, le90
from submin.adjustment.images import ImageSet
from submin.geodesy import geodetic_to_geocentric, local_axes
from submin.sensors import sensor_named
from submin.simulation.five_blocks import EXTERNAL_CONTROL, five_blocks
from submin.simulation.scene import Layout, realise, visible
from submin.simulation.worldview import CELLS, MIDDLE, cell_of, worldview
from submin.storage.catalogue import Catalogue, defects
from submin.storage.point_table import read_point_table
from submin.storage.simulated import write_scene

Array = NDArray[np.float64]

DRAWS = 2000


@pytest.fixture(scope="module")
def five() -> Layout:
    return five_blocks()


@pytest.fixture(scope="module")
def fifty() -> Layout:
    return worldview()


def blocks_of(layout: Layout) -> dict[str, set[str]]:
    """Blocks that measure each point."""
    blocks: dict[str, set[str]] = {}
    for image, point in zip(layout.image, layout.point, strict=True):
        blocks.setdefault(str(layout.point_ids[point]), set()).add(layout.images[image].block_id)
    return blocks


def sizes(layout: Layout) -> Array:
    return np.array([[image.width, image.height] for image in layout.images], dtype=np.float64)


def sight_lines(images: ImageSet, layout: Layout) -> Array:
    """Unit vectors (m, 3) from what the middle of each image sees up towards the camera."""
    rows, middle = np.arange(len(images), dtype=np.int32), 0.5 * (sizes(layout) - 1.0)
    sensor = sensor_named(images.sensors[0])
    low, high = (
        geodetic_to_geocentric(sensor.localise(images.cameras, rows, middle[:, 0], middle[:, 1], np.full(len(rows), h), images.ellipsoid))
        for h in (1000.0, 2000.0)
    )
    return np.asarray((high - low) / np.linalg.norm(high - low, axis=1, keepdims=True))


def pixel_sizes(images: ImageSet, layout: Layout) -> Array:
    """Size (m, 2) on the ground of the pixel in the middle of each image, along samples and lines, metres."""
    rows, middle = np.arange(len(images), dtype=np.int32), 0.5 * (sizes(layout) - 1.0)
    sensor = sensor_named(images.sensors[0])

    def ground(ds: float, dl: float) -> Array:
        at = sensor.localise(
            images.cameras, rows, middle[:, 0] + ds, middle[:, 1] + dl, sensor.mean_height(images.cameras), images.ellipsoid
        )  # fmt: skip
        return geodetic_to_geocentric(at)

    return np.stack(
        [np.linalg.norm(ground(1.0, 0.0) - ground(0.0, 0.0), axis=1), np.linalg.norm(ground(0.0, 1.0) - ground(0.0, 0.0), axis=1)], 1
    )


def test_counts_and_common_points_of_five_blocks(five: Layout) -> None:
    assert (len(five.images), len(five.point_ids)) == (18, 62)
    assert Counter(image.block_id for image in five.images) == {"block 1": 4, "block 2": 6, "block 3": 4, "block 4": 2, "block 5": 2}
    blocks = blocks_of(five)
    assert Counter(block for of_point in blocks.values() for block in of_point) == {
        "block 1": 20, "block 2": 24, "block 3": 24, "block 4": 8, "block 5": 14,
    }  # fmt: skip

    def common(one: int, other: int) -> list[str]:
        return sorted(point for point, of_point in blocks.items() if {f"block {one}", f"block {other}"} <= of_point)

    assert common(1, 2) == ["GP04", "GP08", "GP11", "GP14", "GP17", "GP20"]
    assert len(common(1, 5)) == 6 and len(common(4, 5)) == 4
    assert not common(1, 3) and not common(1, 4) and not common(2, 5) and not common(3, 5)
    assert sorted(point for point, of_point in blocks.items() if of_point == {"block 5"}) == list(EXTERNAL_CONTROL)
    assert sorted(blocks, key=lambda point: int(point[2:]))[:20] == sorted(p for p, of_point in blocks.items() if "block 1" in of_point)
    assert {point: min(of_point) for point, of_point in blocks.items()} == dict(
        zip(five.point_ids.tolist(), five.area.tolist(), strict=True)
    )


def test_every_point_is_measured_in_two_or_four_images_of_a_block(five: Layout) -> None:
    rays = Counter((five.images[i].block_id, int(p)) for i, p in zip(five.image, five.point, strict=True))
    assert set(rays.values()) == {2, 4}
    assert max(Counter(five.point.tolist()).values()) == 8
    seen = visible(five.image_set, sizes(five), five.truth)
    assert seen[five.image, five.point].all()
    of_block = {(image.block_id, k) for image, row in zip(five.images, seen, strict=True) for k in np.flatnonzero(row)}
    assert of_block == set(rays), "a block measures what it sees, in every image that sees it"


def test_geometry_of_five_blocks(five: Layout) -> None:
    images = five.image_set
    up = sight_lines(images, five)
    convergence = np.degrees(np.arccos(np.sum(up[::2] * up[1::2], axis=1)))
    np.testing.assert_allclose(convergence, 60.0, atol=0.5)
    np.testing.assert_allclose(pixel_sizes(images, five), 2.5, rtol=0.01)
    assert sizes(five)[:16].tolist() == [[20_000, 50_000]] * 16 and sizes(five)[16:].tolist() == [[25_000, 80_000]] * 2
    heights = np.linalg.norm(images.cameras[:, :3], axis=1) - np.linalg.norm(geodetic_to_geocentric(five.truth), axis=1).mean()
    np.testing.assert_allclose(heights, 400e3, atol=2e3)
    seconds = np.array([image.seconds for image in five.images])
    np.testing.assert_allclose(seconds[1::2] - seconds[::2], 80.0, atol=1e-3)
    np.testing.assert_allclose(np.diff(seconds[:4:2]), 5.0, atol=1e-3)


def test_counts_of_worldview(fifty: Layout) -> None:
    assert (len(fifty.images), len({image.block_id for image in fifty.images}), len({image.pass_id for image in fifty.images})) == (
        100,
        49,
        49,
    )
    assert Counter(cell_of(image.image_id) for image in fifty.images) == {cell.name: 2 * cell.pairs for cell in CELLS}
    assert sum(cell.pairs for cell in CELLS) == 50
    rays = np.bincount(fifty.point)
    assert Counter(rays.tolist()) == {2: 472, 4: 697, 6: 152, 8: 26}
    assert Counter(rays[fifty.check.points].tolist()) == {2: 41, 4: 38, 6: 18, 8: 4}
    assert np.bincount(fifty.image).min() >= 45 and np.bincount(fifty.image).max() <= 52
    check, control = fifty.area[fifty.check.points], fifty.area[fifty.control.points]
    assert Counter(check.tolist())[MIDDLE] == 25 and Counter(control.tolist())[MIDDLE] == 3
    assert len(control) == 9 and len(set(control.tolist())) == 6
    assert np.isin(fifty.control.points, fifty.check.points).all()
    assert ce90(fifty.check.covariance[:2, :2])[0] == pytest.approx(0.5) and le90(fifty.check.covariance[2, 2])[0] == pytest.approx(0.5)


def test_two_pairs_share_a_pass(fifty: Layout) -> None:
    (shared,) = (block for block, images in Counter(image.block_id for image in fifty.images).items() if images == 4)
    of_block = [image for image in fifty.images if image.block_id == shared]
    assert {cell_of(image.image_id) for image in of_block} == {"Fallon-EW", "EdwardsM-EW"}
    assert len({image.pass_id for image in of_block}) == 1 and of_block[0].acquired.startswith("2008-07-30")
    assert np.ptp([image.seconds for image in of_block]) < 180.0


def test_geometry_of_worldview(fifty: Layout) -> None:
    images = fifty.image_set
    up = sight_lines(images, fifty)
    cells = {cell.name: cell for cell in CELLS}
    of_pair = [cells[cell_of(image.image_id)] for image in fifty.images[::2]]
    convergence = np.degrees(np.arccos(np.sum(up[::2] * up[1::2], axis=1)))
    np.testing.assert_allclose(convergence, [cell.convergence for cell in of_pair], atol=0.3)
    rows, middle = np.arange(100, dtype=np.int32), 0.5 * (sizes(fifty) - 1.0)
    sensor = sensor_named("pushbroom")
    at = sensor.localise(images.cameras, rows, middle[:, 0], middle[:, 1], np.full(100, 1200.0), images.ellipsoid)
    incidence = np.arccos(np.sum(up * local_axes(at)[:, 2], axis=1))
    radius = np.linalg.norm(geodetic_to_geocentric(at), axis=1)
    off_nadir = np.degrees(np.arcsin(radius / (radius + 496e3) * np.sin(incidence)))
    np.testing.assert_allclose(off_nadir, np.repeat([cell.off_nadir for cell in of_pair], 2), atol=0.3)
    np.testing.assert_allclose(pixel_sizes(images, fifty), 0.6, rtol=0.02)
    assert visible(images, sizes(fifty), fifty.truth)[fifty.image, fifty.point].all()


@pytest.mark.parametrize("make", [five_blocks, worldview])
def test_parameters_are_drawn_from_the_a_priori_model(make: Callable[[], Layout]) -> None:
    layout = make()
    images, rng = layout.image_set, np.random.default_rng(1)
    drawn = (images.prior @ rng.standard_normal((images.prior.shape[1], DRAWS))).reshape(len(images), images.parameters, DRAWS)
    scale = np.array([0.5, 1.0]) if layout.name == "five blocks" else np.array([1.0])
    sigmas = np.array([12.0, 20.0, 8.0, 30e-6, 30e-6, 200e-6, 0.6]) if layout.name == "five blocks" else np.array([5e-6] * 3 + [0.5e-6] * 3)
    stated = np.repeat(scale, [16, 2])[:, None] * sigmas if len(scale) == 2 else np.tile(sigmas, (100, 1))
    np.testing.assert_allclose(drawn.std(axis=2) / stated, 1.0, atol=0.1)

    def correlation(i: int, j: int) -> list[float]:
        return [float(np.corrcoef(drawn[i, c], drawn[j, c])[0, 1]) for c in range(images.parameters)]

    if layout.name == "five blocks":
        constants = np.array([2000.0, 3000.0, 1000.0, 200.0, 100.0, 300.0, 5000.0])
        for i, j, seconds in ((0, 1, 80.0), (0, 2, 5.0), (0, 3, 85.0), (4, 9, 90.0), (16, 17, 80.0)):
            np.testing.assert_allclose(correlation(i, j), np.exp(-((seconds / constants) ** 2)), atol=0.07)
        np.testing.assert_allclose(correlation(3, 4), 0.0, atol=0.1)
    else:
        np.testing.assert_allclose(correlation(0, 1), 0.75, atol=0.05)
        np.testing.assert_allclose(correlation(1, 2), 0.0, atol=0.1)
        i, *_, j = (k for k, image in enumerate(layout.images) if "+" in image.block_id)
        np.testing.assert_allclose(correlation(i, j), 0.75, atol=0.05)


@pytest.mark.parametrize("make", [five_blocks, worldview])
def test_a_scene_is_its_truth_and_noise(make: Callable[[], Layout]) -> None:
    layout = make()
    scene, images = realise(layout, 3), layout.image_set
    ground = images.ground(geodetic_to_geocentric(layout.truth))
    noise = (scene.observed - images.project(scene.theta, ground, layout.image, layout.point).image) / layout.sigma_px
    assert noise.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * noise.size))
    np.testing.assert_array_equal(realise(layout, 3).observed, scene.observed)
    assert np.abs(realise(layout, 4).theta - scene.theta).max() > 0.0
    assert ((scene.observed >= -0.5) & (scene.observed < sizes(layout)[layout.image] - 0.5)).all()


def test_catalogue_of_five_blocks(five: Layout, tmp_path: Path) -> None:
    scene = realise(five, 0)
    write_scene(scene, tmp_path / "catalogue")
    catalogue = Catalogue.open(tmp_path / "catalogue")
    assert (catalogue.validate().blocks, catalogue.validate().rays) == (5, len(five.image))
    assert [defects(block) for block in catalogue.blocks()] == [None] * 5
    assert {block.block_id: block.a_priori for block in catalogue.blocks()} == dict(five.priors)
    check, truth = catalogue.points("check"), catalogue.points("truth")
    assert check is not None and truth is not None and catalogue.points("control") is None
    np.testing.assert_array_equal(check.geodetic, five.truth)
    assert not check.covariance_enu.any() and check.area.tolist() == five.area.tolist()
    control = read_point_table(tmp_path / "catalogue" / "control-external.parquet", "definite")
    assert control.point_ids.tolist() == list(EXTERNAL_CONTROL)
    np.testing.assert_allclose(ce90(control.covariance_enu[:, :2, :2]), 1.0)
    np.testing.assert_allclose(le90(control.covariance_enu[:, 2, 2]), 1.0)
    assert not (tmp_path / "catalogue" / "check-external.parquet").exists()


def test_surveyed_points_err_as_they_say(fifty: Layout, tmp_path: Path) -> None:
    scenes = [realise(fifty, seed) for seed in range(20)]
    truth = geodetic_to_geocentric(fifty.truth[fifty.check.points])
    axes = local_axes(fifty.truth[fifty.check.points])
    errors = np.concatenate([
        np.einsum("nij,nj->ni", axes, geodetic_to_geocentric(scene.coordinates(fifty.check)) - truth) for scene in scenes
    ])  # fmt: skip
    np.testing.assert_allclose(errors.std(axis=0), np.sqrt(np.diag(fifty.check.covariance)), rtol=0.06)
    write_scene(scenes[0], tmp_path / "catalogue")
    check, left, control = (
        read_point_table(tmp_path / "catalogue" / f"{name}.parquet") for name in ("check", "check-external", "control-external")
    )
    assert {*check.point_ids} == {*left.point_ids} | {*control.point_ids} and (len(left), len(control)) == (92, 9)
    same = np.isin(check.point_ids, control.point_ids)
    np.testing.assert_array_equal(check.geodetic[same], control.geodetic)
