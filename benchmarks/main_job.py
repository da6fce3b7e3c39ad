"""Main job: the rate of every station from rays to a committed network, on a simulated region.

Kernels are compared with what bounds them in the same run: the factorisation with LAPACK's plain Cholesky of the same size, the rest with
a copy of the same numbers through memory.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg as la

from orchestration.create import create, fit_catalogue
from orchestration.executors import executor_for
from orchestration.run import run
from submin.adjustment.adjustment import adjust
from submin.adjustment.elimination import eliminate, linearise, point_factors
from submin.adjustment.estimation import estimate_images
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import sorted_rays
from submin.sensors import sensor_named
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import write_region

RPC = sensor_named("rpc")


def measure(scale: float, workers: int) -> list[dict[str, Any]]:
    """Rows of station, size, seconds and rate."""
    side = 400.0 * scale**0.5
    region = simulate_region(RegionDesign(width_km=side, height_km=side))
    images = region.image_set
    rays = sorted_rays(
        region.point, region.image, np.column_stack([region.sample, region.line]),
        np.column_stack([region.sigma_sample, region.sigma_line]), np.ones(len(region.point), dtype=np.bool_),
    )  # fmt: skip
    points, count = len(region.point_ids), len(rays)
    start = intersect(images, rays, points)
    theta = np.zeros((len(images), images.parameters))
    linear = linearise(images, rays, theta, start, start)
    weight = np.ones(count)
    sums = eliminate(linear, weight, len(images))
    size = images.prior.shape[1]
    spd = np.eye(size) * size + 1.0

    def lapack() -> None:
        factor, _ = la.lapack.dpotrf(spd, lower=1)
        la.lapack.dpotri(factor, lower=1)

    rows = [
        _row("project with partials", count, "rays", lambda: images.project(theta, images.ground(start), rays.image, rays.point)),
        _row("register (intersect)", points, "points", lambda: intersect(images, rays, points)),
        _row("eliminate and sum", count, "rays", lambda: eliminate(linear, weight, len(images))),
        _row("own parts and loadings", count, "rays", lambda: point_factors(linear, weight)),
        _row("estimate images with covariance", size, "parameters", lambda: estimate_images(sums, images.prior, 6).covariance),
        _row("  LAPACK potrf + potri alone", size, "parameters", lapack),
        _row("adjust all as one bundle", count, "rays", lambda: adjust(images, rays, start), repeats=1),
    ]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        write_region(region, place / "catalogue")
        catalogue = Catalogue.open(place / "catalogue")
        area, _, _ = fit_catalogue(catalogue)
        create(str(place / "network"), area, catalogue.metadata, 100.0, 50.0)
        with executor_for(workers) as executor:
            result = run(catalogue, str(place / "network"), executor)
        rows.append(_row_of(f"run to commit, {workers} workers", result.fused, "blocks", result.seconds))
    return rows


def _row(station: str, size: int, unit: str, work: Callable[[], Any], repeats: int = 5) -> dict[str, Any]:
    work()  # compiled and warm
    best = np.inf
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - started)
    return _row_of(station, size, unit, float(best))


def _row_of(station: str, size: int, unit: str, seconds: float) -> dict[str, Any]:
    return {"station": station, "size": size, "unit": unit, "seconds": seconds, "rate": size / seconds}
