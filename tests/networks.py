"""Small networks that several tests make through the product's own path."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from orchestration.create import create
from orchestration.executors import Executor, SerialExecutor
from orchestration.run import RunResult, run
from submin.simulation.region import RegionDesign, SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.network_store import Snapshot

SMALL = RegionDesign(width_km=120, height_km=120, point_spacing_km=9.5)
"""12 triplets, 169 points, 1,052 rays."""


def area_of(region: SimulatedRegion) -> shapely.Polygon:
    """Box around all points of a region."""
    low, high = region.truth[:, :2].min(axis=0), region.truth[:, :2].max(axis=0)
    return shapely.box(*low, *high)


def fuse(
    catalogue: Path, network: Path, area: shapely.Polygon, *, tile_km: float = 60.0, overlap_km: float = 20.0,
    executor: Executor | None = None, batch_blocks: int = 500,
) -> RunResult:  # fmt: skip
    """Make a network over an area, when there is none, and run a catalogue into it."""
    opened = Catalogue.open(catalogue)
    if not network.exists():
        create(str(network), area, opened.metadata, tile_km, overlap_km)
    return run(opened, str(network), executor or SerialExecutor(), batch_blocks=batch_blocks)


def accepted_rays(network: Path) -> dict[tuple[str, str], bool]:
    """Every ray in the cells of a network, by point and image, and whether it is accepted; a ray that is there twice fails."""
    snapshot = Snapshot.open(str(network))
    images = snapshot.image_columns(["image_id"])["image_id"]
    rays: dict[tuple[str, str], bool] = {}
    for number in snapshot.cell_numbers():
        cell = snapshot.cell(number)
        names: NDArray[np.str_] = images[cell.images[cell.rays.image]]
        for point, image, accepted in zip(cell.point_ids[cell.rays.point], names, cell.rays.accepted, strict=True):
            assert (str(point), str(image)) not in rays, f"ray of {point} in {image} is in the network twice"
            rays[str(point), str(image)] = bool(accepted)
    return rays
