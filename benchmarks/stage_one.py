"""How fast stage 1 is: projection with all partials by sensor, one triplet from rays to accepted rays, and how its cost grows with rays."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orchestration.stage_one import BlockRays, adjust_block
from submin.geodesy import WGS84, geodetic_to_geocentric
from submin.network.network_image import NetworkImage
from submin.sensors import Ground, sensor_named
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region

Array = NDArray[np.float64]

PROJECTED_RAYS = 200_000
SCENE_KM = 50.0
POINTS = (10, 1000, 2000, 4000, 8000)


def measure(scale: float, workers: int) -> list[dict[str, Any]]:
    """Rows of what was done, how often, seconds, and rate against what is asked for; one core, the best of several repetitions."""
    region = triplet(1000)
    rays = max(int(PROJECTED_RAYS * scale), len(region.image))
    rows = [_row("project rpc with all partials", rays, "rays", _best(_projection(region, rays), 10), "2,000,000 rays/s")]
    blocks = {points: _block(triplet(points)) for points in POINTS}
    seconds = {points: _best(lambda block=block: _checked(block), 30) for points, block in blocks.items()}  # type: ignore[misc]
    clean = _block(triplet(1000, blunder_rate=0.0))
    what = "a triplet of 1,000 points without blunders through stage 1"
    rows.append(_row(what, len(clean.image), "rays", _best(lambda: _checked(clean), 30), "15 ms"))
    for points in POINTS:
        asked = {10: "2 ms: overhead outside the kernels", 1000: "15 ms"}.get(points, "linear in rays")
        rows.append(_row(f"a triplet of {points:,} points through stage 1", len(blocks[points].image), "rays", seconds[points], asked))
    return rows


def triplet(points: int, blunder_rate: float = 0.002) -> SimulatedRegion:
    """One simulated three-line scene with about so many points, and blunders among their rays."""
    spacing = SCENE_KM / np.sqrt(points)
    return simulate_region(
        RegionDesign(width_km=SCENE_KM, height_km=SCENE_KM, strips=1, point_spacing_km=float(spacing), bad_cameras=0,
                     blunder_rate=blunder_rate)
    )  # fmt: skip


def _block(region: SimulatedRegion) -> BlockRays:
    a_priori = json.dumps(region.design.priors.to_mapping())
    images = tuple(
        NetworkImage(i.image_id, i.block_id, i.pass_id, i.sensor, i.camera, i.width, i.height, i.seconds, a_priori) for i in region.images
    )
    return BlockRays(
        "triplet", images, region.point_ids, region.point, region.image, np.column_stack([region.sample, region.line]),
        np.column_stack([region.sigma_sample, region.sigma_line]),
    )  # fmt: skip


def _checked(block: BlockRays) -> None:
    outcome = adjust_block(block, WGS84)
    if outcome.reason is not None:
        raise AssertionError(outcome.reason)


def _projection(region: SimulatedRegion, rays: int) -> Callable[[], Any]:
    sensor, cameras = sensor_named("rpc"), region.packed_cameras()
    times = -(-rays // len(region.image))
    image, point = (np.tile(index, times)[:rays] for index in (region.image, region.point))
    at = np.tile(np.column_stack([region.sample, region.line]), (times, 1))[:rays]
    ground, theta = Ground.at(geodetic_to_geocentric(region.truth)), np.zeros((len(cameras), len(sensor.parameters)))
    return lambda: sensor.project(cameras, theta, ground, image, point, at)


def _best(work: Callable[[], Any], repeats: int) -> float:
    work()  # compiled and warm
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        taken.append(time.perf_counter() - started)
    return min(taken)


def _row(what: str, size: int, unit: str, seconds: float, asked: str) -> dict[str, Any]:
    return {"what": what, "size": size, "unit": unit, "milliseconds": 1e3 * seconds, f"{unit}/s": size / seconds, "asked for": asked}
