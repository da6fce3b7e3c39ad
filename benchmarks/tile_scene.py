"""A simulated tile: one cell with many points, and triplets that arrive when it is there, for benchmarks of the factored form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.geodesy import geodetic_to_geocentric
from submin.network.cell import Cell, RegisteredPoints, empty_cell, with_points, without_points
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
PER_TRIPLET = 3
MEASURED = 0.25
"""Part of the points in its format that an arriving triplet measures."""
NEW = 0.15
"""Part of the points that no earlier triplet has measured."""


@dataclass(frozen=True, eq=False)
class TileScene:
    """Images and rays of a tile, those of its earlier triplets and those that arrive; triplets in the order in which they come.

    Attributes
    ----------
    images : all images, in the order of arrival: the rows of the network
    earlier : number of images that are there from the beginning
    point_ids, origin : (n,), (n, 3) all points and where they are registered
    point, image : (r,) rows of each ray's point and image
    observed, sigma : (r, 2)
    """

    images: ImageSet
    earlier: int
    point_ids: NDArray[np.str_]
    origin: Array
    point: NDArray[np.int32]
    image: NDArray[np.int32]
    observed: Array
    sigma: Array

    def points_of(self, rays: NDArray[np.bool_]) -> RegisteredPoints:
        """Registered points with some of the rays."""
        points, point = np.unique(self.point[rays], return_inverse=True)
        return RegisteredPoints(
            self.point_ids[points], self.origin[points], point.astype(np.int32), self.image[rays], self.observed[rays], self.sigma[rays]
        )

    def cell(self, images: int) -> Cell:
        """The cell with all rays of the first images. It is not summed."""
        return with_points(empty_cell(0, self.images.parameters), self.points_of(self.image < images))

    def grown(self, cell: Cell, first: int, stop: int) -> Cell:
        """The cell with the rays of images ``first`` to ``stop``, as a run does it: their points out, and in with all rays. Not summed."""
        arriving = (self.image >= first) & (self.image < stop)
        touched = np.zeros(len(self.point_ids), dtype=np.bool_)
        touched[self.point[arriving]] = True
        return with_points(without_points(cell, self.point_ids[touched]), self.points_of(touched[self.point] & (self.image < stop)))


def tile_scene(points: int, earlier: int, arriving: int, rays_a_point: float = 8.0, seed: int = 3) -> TileScene:
    """A tile of about so many points and rays a point in ``earlier`` triplets, and ``arriving`` triplets over it. All simulated."""
    triplets = earlier + arriving
    scene = 50.0
    coverage = rays_a_point / PER_TRIPLET * triplets / earlier
    side = max(scene * np.sqrt(triplets / coverage), 1.2 * scene)
    design = RegionDesign(
        width_km=side,
        height_km=side,
        coverage=coverage,
        point_spacing_km=side / np.sqrt(points),
        bad_cameras=0,
        blunder_rate=0.0,
        seed=seed,
    )
    return _scene(simulate_region(design), earlier, arriving, np.random.default_rng(seed))


def _scene(region: SimulatedRegion, earlier: int, arriving: int, rng: np.random.Generator) -> TileScene:
    triplets = len(region.images) // PER_TRIPLET
    order = rng.permutation(triplets)[: earlier + arriving]
    rank = np.full(triplets, -1)
    rank[order] = np.arange(len(order))
    triplet = rank[region.image // PER_TRIPLET]
    new_point = rng.random(len(region.point_ids)) < NEW
    of_pair = rng.random((len(region.point_ids), triplets)) < MEASURED
    old = (triplet >= 0) & (triplet < earlier) & ~new_point[region.point]
    arrives = (triplet >= earlier) & of_pair[region.point, region.image // PER_TRIPLET]
    rays = np.flatnonzero(old | arrives)
    rows = (PER_TRIPLET * order[:, None] + np.arange(PER_TRIPLET)).ravel()
    return TileScene(
        region.image_set.take(rows), PER_TRIPLET * earlier, region.point_ids, geodetic_to_geocentric(region.truth),
        region.point[rays].astype(np.int32), (PER_TRIPLET * triplet + region.image % PER_TRIPLET)[rays].astype(np.int32),
        np.column_stack([region.sample, region.line])[rays], np.column_stack([region.sigma_sample, region.sigma_line])[rays],
    )  # fmt: skip
