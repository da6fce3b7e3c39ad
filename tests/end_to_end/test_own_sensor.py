"""The sensor of docs/sensors.md, as it stands there: its partials, and a network of its images."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from networks import fuse
from numpy.typing import NDArray

import submin
from submin import sensors
from submin.adjustment.priors import APriori
from submin.geodesy import WGS84, geodetic_to_geocentric, local_axes
from submin.sensors import Ground, Sensor
from submin.storage.catalogue_schema import Block, CatalogueMetadata, ImageRecord
from submin.storage.catalogue_writer import CatalogueWriter

Array = NDArray[np.float64]

ROOT = Path(__file__).parents[2]
CENTRE = np.array([[5.4, 43.3, 200.0]])
POINTS = 40
SIGMA_PX = 0.3


@pytest.fixture
def parallel(monkeypatch: pytest.MonkeyPatch) -> Sensor:
    """The class of the page, entered in the table."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "sensors.md").read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(code, "docs/sensors.md", "exec"), names)
    sensor: Sensor = names["ParallelSensor"]()
    monkeypatch.setitem(sensors.SENSORS, sensor.name, sensor)
    return sensor


def camera(lean_east: float, lean_north: float) -> dict[str, Any]:
    """Half-metre pixels; the view leans by these tangents."""
    east, north, up = local_axes(CENTRE)[0]
    by_metre = 2.0 * np.stack([east + lean_east * up, -north - lean_north * up])
    place = geodetic_to_geocentric(CENTRE)[0]
    return {"place": place.tolist(), "at": [2000.0, 2000.0], "by_metre": by_metre.tolist(), "height": 200.0}


def ground() -> Array:
    rng = np.random.default_rng(2)
    return geodetic_to_geocentric(CENTRE + rng.uniform(-1.0, 1.0, (POINTS, 3)) * np.array([0.01, 0.007, 100.0]))


def test_partials_are_differences(parallel: Sensor) -> None:
    cameras = np.stack([parallel.pack(camera(0.3, -0.2), 4000, 4000)])
    rows, theta = np.arange(POINTS, dtype=np.int32), np.array([[3.0, -4.0]])

    def image(move: Array, correct: Array) -> Array:
        return parallel.project(cameras, theta + correct, Ground.at(ground() + move), 0 * rows, rows).image

    found = parallel.project(cameras, theta, Ground.at(ground()), 0 * rows, rows)
    nothing = np.zeros(3), np.zeros(2)
    for k, step in enumerate(np.eye(3)):
        np.testing.assert_allclose(found.by_ground[:, :, k], 0.5 * (image(step, nothing[1]) - image(-step, nothing[1])), atol=1e-6)
    for k, step in enumerate(np.eye(2)):
        np.testing.assert_allclose(found.by_parameters[:, :, k], 0.5 * (image(nothing[0], step) - image(nothing[0], -step)), atol=1e-9)


def test_localise_is_the_inverse(parallel: Sensor) -> None:
    cameras, rows = np.stack([parallel.pack(camera(0.3, -0.2), 4000, 4000)]), np.zeros(POINTS, dtype=np.int32)
    at = Ground.at(ground())
    seen = parallel.project(cameras, np.zeros((1, 2)), at, rows, np.arange(POINTS, dtype=np.int32)).image
    found = parallel.localise(cameras, rows, seen[:, 0].copy(), seen[:, 1].copy(), at.geodetic[:, 2], WGS84)
    np.testing.assert_allclose(geodetic_to_geocentric(found), ground(), rtol=0.0, atol=1e-5)


def test_a_network_of_its_images_is_as_accurate_as_it_says(parallel: Sensor, tmp_path: Path) -> None:
    """Three images with shifts as the priors expect them: points come out within what is stated, and the shifts are found."""
    rng = np.random.default_rng(7)
    views = [camera(*lean) for lean in ((-0.4, 0.1), (0.0, -0.3), (0.45, 0.2))]
    images = tuple(
        ImageRecord(f"image {k}", "block", f"pass {k}", "", "parallel", json.dumps(view), 4000, 4000) for k, view in enumerate(views)
    )
    cameras, shifts = np.stack([image.pack() for image in images]), rng.normal(0.0, 10.0, (3, 2))
    image, point = np.repeat(np.arange(3, dtype=np.int32), POINTS), np.tile(np.arange(POINTS, dtype=np.int32), 3)
    seen = parallel.project(cameras, shifts, Ground.at(ground()), image, point).image + rng.normal(0.0, SIGMA_PX, (3 * POINTS, 2))
    ids, sigma = np.array([f"p{j:02d}" for j in range(POINTS)]), np.full(3 * POINTS, SIGMA_PX)
    with CatalogueWriter(tmp_path / "catalogue", CatalogueMetadata("example")) as writer:
        writer.write_images(images)
        writer.write_priors(APriori(parameters={"shift": {"common_to_pass": 0.0}}))
        writer.write_block(Block("block", images, None, ids[point], image, seen[:, 0], seen[:, 1], sigma, sigma))
    result = fuse(tmp_path / "catalogue", tmp_path / "network", shapely.box(5.38, 43.28, 5.42, 43.32), tile_km=10.0, overlap_km=2.0)
    assert (result.rejected, result.rays_rejected, result.rays_used) == ((), 0, 3 * POINTS)
    answer = submin.open(str(tmp_path / "network")).query(points=ids, policy="rigorous")
    error = (answer.geocentric - ground()).ravel()
    nees = error @ np.linalg.solve(answer.covariance, error) / len(error)
    assert abs(nees - 1.0) < 4.0 * np.sqrt(2.0 / len(error))


def test_an_incomplete_camera_is_refused(parallel: Sensor) -> None:
    with pytest.raises(submin.errors.InputError, match="parallel: 'height'; expected numbers for place, at, by_metre and height"):
        parallel.pack({k: v for k, v in camera(0.0, 0.0).items() if k != "height"}, 4000, 4000)
