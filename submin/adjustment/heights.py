"""Heights known beforehand: one more observation of every point, along its local vertical, in the adjustment of a block.

Rays of nearly one direction do not tell how far along them a point lies. A height model does, as well as it is known: a constant over flat
ground or water, or a grid. The heights are observed by one more image that has nothing to adjust (`submin.sensors.height`), so they are
weighted, tested and rejected like rays, and nothing else in the adjustment changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from submin.adjustment.adjustment import Adjustment, adjust
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import ImagePrior
from submin.adjustment.rays import Array, Rays, sorted_rays
from submin.errors import InputError
from submin.sensors import sensor_named

HEIGHTS = "heights"
"""Id of the image that observes heights."""
ROUNDS = 5
SETTLED = 0.01
"""A surface whose heights below the points change by less, in sigmas, is read at the right places."""


@dataclass(frozen=True)
class HeightPrior:
    """A surface on which the points are believed to lie.

    Parameters
    ----------
    surface : callable
        Heights (n,) in metres above the ellipsoid at longitudes and latitudes (n,) in degrees; NaN where nothing is known.
    sigma : float
        Standard deviation of the difference between a point and the surface, metres, independent from point to point.

    Raises
    ------
    InputError
        When sigma is not positive.
    """

    surface: Callable[[Array, Array], Array]
    sigma: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma) and self.sigma > 0.0):
            raise InputError(f"heights: sigma is {self.sigma}; expected a positive number of metres")

    def below(self, images: ImageSet, ground: Array) -> Array:
        """Heights (n,) of the surface at the longitudes and latitudes of points (n, 3), geocentric metres on the images' body."""
        geodetic = images.ground(ground).geodetic
        return self.surface(geodetic[:, 0], geodetic[:, 1])


def constant_height(height: float, sigma: float) -> HeightPrior:
    """All points near one height, metres above the ellipsoid."""
    if not np.isfinite(height):
        raise InputError(f"heights: height is {height}; expected a finite number of metres")
    return HeightPrior(lambda longitude, latitude: np.full(len(longitude), height), sigma)


def height_grid(longitudes: Array, latitudes: Array, heights: Array, sigma: float) -> HeightPrior:
    """Points near a grid of heights (rows: latitudes; columns: longitudes, both ascending, degrees), bilinear between its nodes.

    Nothing is known outside the grid, and next to nodes that are NaN.

    Raises
    ------
    InputError
        When an axis does not ascend, or the heights are not of the axes' lengths.
    """
    for name, axis in (("longitudes", longitudes), ("latitudes", latitudes)):
        if axis.ndim != 1 or len(axis) < 2 or not (np.diff(axis) > 0.0).all():
            raise InputError(f"heights: {name} do not ascend; expected two or more numbers of degrees in ascending order")
    if heights.shape != (len(latitudes), len(longitudes)):
        expected = f"{len(latitudes)} x {len(longitudes)}"
        raise InputError(f"heights: the grid is {' x '.join(map(str, heights.shape))}; expected latitudes x longitudes, {expected}")

    def surface(longitude: Array, latitude: Array) -> Array:
        turned = longitudes[0] + (longitude - longitudes[0]) % 360.0
        column = np.clip(np.searchsorted(longitudes, turned, side="right") - 1, 0, len(longitudes) - 2)
        row = np.clip(np.searchsorted(latitudes, latitude, side="right") - 1, 0, len(latitudes) - 2)
        u = (turned - longitudes[column]) / (longitudes[column + 1] - longitudes[column])
        v = (latitude - latitudes[row]) / (latitudes[row + 1] - latitudes[row])
        south = (1.0 - u) * heights[row, column] + u * heights[row, column + 1]
        north = (1.0 - u) * heights[row + 1, column] + u * heights[row + 1, column + 1]
        inside = (u <= 1.0) & (v >= 0.0) & (v <= 1.0)
        return np.where(inside, (1.0 - v) * south + v * north, np.nan)

    return HeightPrior(surface, sigma)


def with_heights(images: ImageSet, rays: Rays, ground: Array, heights: HeightPrior) -> tuple[ImageSet, Rays]:
    """The images and rays with one more image, the last, that observes the heights of the points (n, 3) where the surface is known."""
    height = heights.below(images, ground)
    known = np.flatnonzero(np.isfinite(height))
    camera = np.full((1, images.cameras.shape[1]), np.nan)
    camera[0, 0] = sensor_named("height").pack({"height": float(height[known].mean()) if len(known) else 0.0}, 1, 1)[0]
    joined = replace(
        images, ids=(*images.ids, HEIGHTS), sensors=(*images.sensors, "height"), cameras=np.vstack([images.cameras, camera]),
        priors=(*images.priors, ImagePrior(HEIGHTS, HEIGHTS, float("nan"), None, ())),
    )  # fmt: skip
    observed, sigma = np.zeros((len(known), 2)), np.full((len(known), 2), heights.sigma)
    observed[:, 0] = height[known]
    return joined, sorted_rays(
        np.concatenate([rays.point, known.astype(np.int32)]),
        np.concatenate([rays.image, np.full(len(known), len(images), dtype=np.int32)]),
        np.concatenate([rays.observed, observed]), np.concatenate([rays.sigma, sigma]),
        np.concatenate([rays.accepted, np.ones(len(known), dtype=np.bool_)]),
    )  # fmt: skip


def adjust_with_heights(images: ImageSet, rays: Rays, start: Array, heights: HeightPrior) -> tuple[ImageSet, Rays, Adjustment]:
    """Adjust as `adjust` does, with heights: on a surface that is not level, until it is read where the points are.

    Returns what was adjusted, the image of heights and its rays included, and the result. The other rays are those whose image is not the
    last; they are in canonical order.
    """
    ground, read = start, heights.below(images, start)
    for _ in range(ROUNDS):
        together, measured = with_heights(images, rays, ground, heights)
        result = adjust(together, measured, ground, start)
        ground, before = result.ground, read
        read = heights.below(images, ground)
        same = np.isnan(read) & np.isnan(before) | (np.abs(read - before) < SETTLED * heights.sigma)
        if same.all():
            break
    return together, measured, result
