"""Simulated images as a catalogue on disk: what a network is given, and beside it the truth to judge the network by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.priors import APriori
from submin.simulation.region import RegionDesign, SimulatedRegion
from submin.simulation.scene import SimulatedImage, SimulatedScene, Survey
from submin.storage.catalogue import Block, CatalogueMetadata, ImageRecord, PointTable
from submin.storage.catalogue_writer import CatalogueWriter

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Ids = NDArray[np.str_]


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
        observed = np.column_stack([region.sample, region.line])
        sigma = np.column_stack([region.sigma_sample, region.sigma_line])
        priors = {image.block_id: region.design.priors for image in region.images}
        _write_blocks(writer, _blocks(region.images, priors, region.point_ids[region.point], region.image, observed, sigma))
        writer.write_priors(region.design.priors)
        points = PointTable(region.point_ids, region.truth, np.zeros((len(region.point_ids), 3, 3)), quadrants(region.truth, region.design))
        writer.write_points("truth", points)
        writer.write_points("check", points)


def quadrants(geodetic: Array, design: RegionDesign) -> NDArray[np.str_]:
    """Quadrant (n,) about the centre of the design of each geodetic place (n, 3): north or south, then west or east."""
    north = np.where(geodetic[:, 1] >= design.latitude, "N", "S")
    east = np.where((geodetic[:, 0] - design.longitude + 180.0) % 360.0 >= 180.0, "E", "W")
    return np.char.add(north, east)


def write_scene(scene: SimulatedScene, path: str | Path, *, overwrite: bool = False) -> None:
    """Write the catalogue of a simulated scene.

    The table ``truth`` holds every point, ``check`` the layout's check points with their areas. Its control points are in
    ``control-external``, which a run does not take by itself: ``submin control add`` does. Where they are check points as well, the check
    points that remain then are in ``check-external``.

    Raises
    ------
    CatalogueError
        When the folder holds something already.
    """
    layout = scene.layout
    with CatalogueWriter(path, CatalogueMetadata(name=f"simulated {layout.name}, seed {scene.seed}"), overwrite) as writer:
        _write_blocks(writer, scene_blocks(scene))
        most, others = _default_and_others(layout.priors)
        writer.write_priors(most, others)
        exact = np.zeros((len(layout.point_ids), 3, 3))
        writer.write_points("truth", PointTable(layout.point_ids, layout.truth, exact, layout.area))
        check = survey_table(scene, layout.check)
        writer.write_points("check", check)
        writer.write_points("control", survey_table(scene, layout.control), "external")
        remaining = ~np.isin(layout.check.points, layout.control.points)
        if layout.check.covariance.any() and not remaining.all():
            writer.write_points(
                "check",
                PointTable(check.point_ids[remaining], check.geodetic[remaining], check.covariance_enu[remaining], check.area[remaining]),
                "external",
            )


def survey_table(scene: SimulatedScene, survey: Survey) -> PointTable:
    """Surveyed points as the surveyor states them."""
    layout, rows = scene.layout, survey.points
    covariance = np.broadcast_to(survey.covariance, (len(rows), 3, 3))
    return PointTable(layout.point_ids[rows], scene.coordinates(survey), covariance, layout.area[rows])


def _default_and_others(priors: Mapping[str, APriori]) -> tuple[APriori, dict[str, APriori]]:
    """The a priori model of most blocks, and the blocks that have another."""
    models = list(priors.values())
    default = max(models, key=models.count)
    return default, {block_id: model for block_id, model in priors.items() if model != default}


def scene_blocks(scene: SimulatedScene) -> list[Block]:
    """The blocks of a scene, as its catalogue holds them."""
    layout = scene.layout
    sigma = np.full(scene.observed.shape, layout.sigma_px)
    return _blocks(layout.images, layout.priors, layout.point_ids[layout.point], layout.image, scene.observed, sigma)


def _blocks(
    images: Sequence[SimulatedImage], priors: Mapping[str, APriori], point_ids: Ids, image: Index, observed: Array, sigma: Array
) -> list[Block]:
    """Blocks in order, cut out of rays that are sorted by image; images are ordered by block."""
    records = [ImageRecord(**asdict(image)) for image in images]
    block_ids = np.array([record.block_id for record in records])
    edges = [0, *(np.flatnonzero(block_ids[1:] != block_ids[:-1]) + 1).tolist(), len(records)]
    rays = np.searchsorted(image, edges).tolist()
    return [
        Block(
            block_id=str(block_ids[start]),
            images=tuple(records[start:stop]),
            a_priori=priors[str(block_ids[start])],
            point_ids=point_ids[first:last],
            image=image[first:last] - np.int32(start),
            sample=observed[first:last, 0],
            line=observed[first:last, 1],
            sigma_sample=sigma[first:last, 0],
            sigma_line=sigma[first:last, 1],
        )
        for start, stop, first, last in zip(edges[:-1], edges[1:], rays[:-1], rays[1:], strict=True)
    ]


def _write_blocks(writer: CatalogueWriter, blocks: Sequence[Block]) -> None:
    """Write blocks and their images."""
    writer.write_images(image for block in blocks for image in block.images)
    for block in blocks:
        writer.write_block(block)
