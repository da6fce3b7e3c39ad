"""Simulated images as a catalogue on disk: what a network is given, and beside it the truth to judge the network by."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.priors import APriori
from submin.geodesy import geocentric_to_geodetic, geodetic_to_geocentric, local_axes
from submin.simulation.campaign import SURVEY_SIGMA, Campaign, CampaignDesign, Scene, simulate_scene
from submin.simulation.keyed_random import keyed_normal, keyed_uniform
from submin.simulation.region import RegionDesign, SimulatedRegion
from submin.simulation.scene import SimulatedImage, SimulatedScene, Survey
from submin.storage.catalogue import Block, CatalogueMetadata, ImageRecord, PointTable
from submin.storage.catalogue_writer import CatalogueWriter

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Numbers = NDArray[np.int64]
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


@dataclass(frozen=True, eq=False)
class CampaignPart:
    """Blocks of some scenes of a campaign, and the fields (n,) of the points that they measure, ascending."""

    blocks: tuple[Block, ...]
    points: Numbers


@dataclass(frozen=True)
class CampaignSize:
    """What a campaign's catalogue holds."""

    blocks: int
    images: int
    points: int
    rays: int
    check_points: int


def campaign_part(design: CampaignDesign, scenes: Sequence[Scene]) -> CampaignPart:
    """Simulate some scenes of a campaign."""
    blocks, points = [], []
    for scene in scenes:
        rays = simulate_scene(design, scene)
        row = np.searchsorted(rays.points, rays.number)
        sigma = np.full(len(row), design.sigma_px)
        blocks.append(
            Block(
                scene.block_id, tuple(ImageRecord(**asdict(image)) for image in rays.images), design.priors,
                design.grid.ids(rays.points)[row], rays.image, rays.observed[:, 0].copy(), rays.observed[:, 1].copy(), sigma, sigma,
            )
        )  # fmt: skip
        points.append(rays.points)
    return CampaignPart(tuple(blocks), np.unique(np.concatenate(points)))


def write_campaign(campaign: Campaign, parts: Iterable[CampaignPart], path: str | Path, *, overwrite: bool = False) -> CampaignSize:
    """Write the catalogue of a campaign whose parts come one after another, in the order of its scenes; none is kept.

    The table ``truth`` holds every point, ``check`` some that are surveyed with their sub-areas. What is kept of all parts is one bit a
    field of the point grid (of which memory takes those pages where there are points) and the check points.

    Raises
    ------
    CatalogueError
        When the folder holds something already.
    """
    design, blocks, images, rays, points = campaign.design, 0, 0, 0, 0
    known = np.zeros(design.grid.fields, dtype=np.bool_)
    check = np.empty(0, dtype=np.int64)
    with CatalogueWriter(path, CatalogueMetadata(name=campaign.name), overwrite) as writer:
        for part in parts:
            writer.write_images(image for block in part.blocks for image in block.images)
            for block in part.blocks:
                writer.write_block(block)
                blocks, images, rays = blocks + 1, images + len(block.images), rays + len(block)
            new = part.points[~known[part.points]]
            known[new] = True
            points += len(new)
            truth = design.grid.geodetic(new)
            writer.write_points("truth", _exact_points(design, new, truth, campaign.area(truth)))
            check = _first_drawn(design, np.concatenate([check, new]), campaign.check_points)
        writer.write_priors(design.priors)
        writer.write_points("check", surveyed_points(campaign, np.sort(check)))
    return CampaignSize(blocks, images, points, rays, len(check))


def surveyed_points(campaign: Campaign, number: Numbers) -> PointTable:
    """Points of a campaign as a survey states them, with its errors and their covariance."""
    design = campaign.design
    truth = design.grid.geodetic(number)
    enu = SURVEY_SIGMA * keyed_normal(design.seed, "survey", number[:, None], np.arange(2)).reshape(len(number), 4)[:, :3]
    moved = geocentric_to_geodetic(geodetic_to_geocentric(truth) + np.einsum("nij,ni->nj", local_axes(truth), enu))
    covariance = np.broadcast_to(SURVEY_SIGMA**2 * np.eye(3), (len(number), 3, 3))
    return PointTable(design.grid.ids(number), moved, covariance, campaign.area(truth))


def _exact_points(design: CampaignDesign, number: Numbers, truth: Array, area: Ids) -> PointTable:
    return PointTable(design.grid.ids(number), truth, np.broadcast_to(np.zeros((3, 3)), (len(number), 3, 3)), area)


def _first_drawn(design: CampaignDesign, number: Numbers, count: int) -> Numbers:
    """So many of some points, drawn by their names: whatever order they come in, it is the same ones."""
    return number[np.argsort(keyed_uniform(design.seed, "check", number), kind="stable")[:count]]


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
