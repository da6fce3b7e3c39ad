"""A simulated region as a catalogue on disk: what a network is given, and beside it the truth to judge the network by."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from submin.simulation.region import RegionDesign, SimulatedRegion
from submin.storage.catalogue import Block, CatalogueMetadata, ImageRecord, PointTable
from submin.storage.catalogue_writer import CatalogueWriter

Array = NDArray[np.float64]


def write_region(region: SimulatedRegion, path: str | Path, *, overwrite: bool = False) -> None:
    """Write the catalogue of a simulated region.

    The table ``truth`` holds every point; so does ``check``, without error, where ``area`` is the quadrant about the region's centre
    (``NW``, ``NE``, ``SW``, ``SE``). True image parameters, blunders and bad cameras stay out of the catalogue.

    Parameters
    ----------
    region : SimulatedRegion
    path : folder of the catalogue, new or empty
    overwrite : take the place of a catalogue that is there

    Raises
    ------
    CatalogueError
        When the folder holds something already.
    """
    with CatalogueWriter(path, CatalogueMetadata(name=f"simulated region, seed {region.design.seed}"), overwrite) as writer:
        writer.write_images(_records(region))
        for block in _blocks(region):
            writer.write_block(block)
        writer.write_priors(region.design.priors)
        points = PointTable(region.point_ids, region.truth, np.zeros((len(region.point_ids), 3, 3)), quadrants(region.truth, region.design))
        writer.write_points("truth", points)
        writer.write_points("check", points)


def quadrants(geodetic: Array, design: RegionDesign) -> NDArray[np.str_]:
    """Quadrant (n,) about the centre of the design of each geodetic place (n, 3): north or south, then west or east."""
    north = np.where(geodetic[:, 1] >= design.latitude, "N", "S")
    east = np.where((geodetic[:, 0] - design.longitude + 180.0) % 360.0 >= 180.0, "E", "W")
    return np.char.add(north, east)


def _records(region: SimulatedRegion) -> list[ImageRecord]:
    return [ImageRecord(**asdict(image)) for image in region.images]


def _blocks(region: SimulatedRegion) -> list[Block]:
    """Blocks in order, cut out of the sorted rays."""
    records = _records(region)
    block_ids = np.array([record.block_id for record in records])
    edges = [0, *(np.flatnonzero(block_ids[1:] != block_ids[:-1]) + 1).tolist(), len(records)]
    rays = np.searchsorted(region.image, edges).tolist()
    return [
        Block(
            block_id=str(block_ids[start]),
            images=tuple(records[start:stop]),
            a_priori=region.design.priors,
            point_ids=region.point_ids[region.point[first:last]],
            image=region.image[first:last] - np.int32(start),
            sample=region.sample[first:last],
            line=region.line[first:last],
            sigma_sample=region.sigma_sample[first:last],
            sigma_line=region.sigma_line[first:last],
        )
        for start, stop, first, last in zip(edges[:-1], edges[1:], rays[:-1], rays[1:], strict=True)
    ]
