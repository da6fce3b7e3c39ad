"""Small networks that several tests make through the product's own path."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

import submin
from orchestration.create import create
from orchestration.executors import Executor, SerialExecutor
from orchestration.run import RunResult, run
from submin.simulation.region import RegionDesign, SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.snapshot import Snapshot

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


def rewrite(catalogue: Path, out: Path, blocks: list[Block]) -> Path:
    """A catalogue of the same metadata with these blocks."""
    source = Catalogue.open(catalogue)
    with CatalogueWriter(out, source.metadata) as writer:
        writer.write_images(image for block in blocks for image in block.images)
        for block in blocks:
            writer.write_block(block)
        writer.write_priors(source.default_prior, source.priors)
    return out


def by_image(block: Block) -> list[Block]:
    """One block for every image of a block."""
    parts = []
    for k, image in enumerate(block.images):
        rows = block.image == k
        parts.append(
            Block(
                image.image_id,
                (dataclasses.replace(image, block_id=image.image_id),),
                block.a_priori,
                block.point_ids[rows],
                np.zeros(rows.sum(), dtype=np.int32),
                block.sample[rows],
                block.line[rows],
                block.sigma_sample[rows],
                block.sigma_line[rows],
            )
        )
    return parts


def same_network(one: Path, other: Path) -> None:
    """Two networks hold the same rays and give the same rigorous answer for all points, and each tile the same answer alone."""
    assert accepted_rays(one) == accepted_rays(other)
    first, second = submin.open(one), submin.open(other)
    assert first.snapshot.tile_numbers() == second.snapshot.tile_numbers()
    questions = [{"bbox": (90.0, 30.0, 110.0, 40.0), "policy": "rigorous"}]
    questions += [{"tile": first.cover.tile_name(tile)} for tile in first.snapshot.tile_numbers()]
    for question in questions:
        a, b = first.query(**question), second.query(**question)
        assert a.ids.tolist() == b.ids.tolist()
        sigma = np.sqrt(np.diag(a.covariance))
        assert (np.abs(a.geocentric - b.geocentric).ravel() / sigma).max(initial=0.0) < 1e-9
        assert (np.abs(a.covariance - b.covariance) / sigma / sigma[:, None]).max(initial=0.0) < 1e-9
