"""Registration: every point gets an approximate position, and with it its one cell, from all the rays that it has.

A point that gets or loses a ray is taken out of its cell and put back with the rays that it then has. Unadjusted cameras, images in the
order of their ids: where a point is registered depends on its rays alone, not on when they came (decision 006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geocentric_to_geodetic
from submin.network.cell import Cell, RegisteredPoints
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
Flags = NDArray[np.bool_]

SAME_POINT_METRES = 1000.0
"""Rays of one point id that pass each other by more than this belong to two places."""
IN_THE_NETWORK = -1
"""Block of a ray that the network has already."""


@dataclass(frozen=True)
class LooseRays:
    """Rays that lie in no cell, in any order: those of new blocks, and those of points taken out of their cells.

    Attributes
    ----------
    point_ids : (r,) ids of the points; image : (r,) row of the network's images
    observed, sigma : (r, 2)
    block : (r,) number of each ray's block within its batch; `IN_THE_NETWORK` for a ray taken out of a cell
    """

    point_ids: Ids
    image: NDArray[np.int32]
    observed: Array
    sigma: Array
    block: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.image)

    def take(self, rows: Flags) -> LooseRays:
        """The rays where ``rows`` (r,) is True."""
        return LooseRays(self.point_ids[rows], self.image[rows], self.observed[rows], self.sigma[rows], self.block[rows])


def together(parts: Sequence[LooseRays]) -> LooseRays:
    """All rays of some parts."""
    none = np.empty(0, dtype=np.int32)
    empty = LooseRays(np.empty(0, dtype="U1"), none, np.empty((0, 2)), np.empty((0, 2)), none)
    names = ("point_ids", "image", "observed", "sigma", "block")
    return LooseRays(*(np.concatenate([getattr(part, name) for part in (empty, *parts)]) for name in names))


def taken_out(cell: Cell, points: Flags) -> LooseRays:
    """The rays of those of a cell's points where ``points`` (n,) is True."""
    rays = cell.rays.take(points[cell.rays.point])
    block = np.full(len(rays), IN_THE_NETWORK, dtype=np.int32)
    return LooseRays(cell.point_ids[rays.point], cell.images[rays.image], rays.observed, rays.sigma, block)


@dataclass(frozen=True)
class Registration:
    """Where points go.

    Attributes
    ----------
    arrivals : points by cell, with all of their rays
    directory : ids and cells of all points
    apart : (r,) metres between the two places that those rays of a ray's point give which disagree most; infinite where none is reached
    outside : (r,) True for rays on points outside the cover's rectangle
    """

    arrivals: dict[int, RegisteredPoints]
    directory: tuple[Ids, NDArray[np.int64]]
    apart: Array
    outside: Flags


def register(rays: LooseRays, images: ImageSet, image_rows: NDArray[np.int32], cover: Cover) -> Registration:
    """Register the points of some rays, which are all rays that these points have.

    ``images`` are at least those of the rays, ``image_rows`` their rows in the network, ascending.
    """
    ids, point = np.unique(rays.point_ids, return_inverse=True)
    if not len(rays):
        return Registration({}, (ids, np.empty(0, dtype=np.int64)), np.empty(0), np.empty(0, dtype=np.bool_))
    named = np.argsort(np.array(images.ids, dtype=np.str_))
    rank = np.empty(len(named), dtype=np.int32)
    rank[named] = np.arange(len(named))
    images = images.take(named)
    local = rank[np.searchsorted(image_rows, rays.image)]

    every = np.ones(len(rays), dtype=np.bool_)
    origin = intersect(images, sorted_rays(point.astype(np.int32), local, rays.observed, rays.sigma, every), len(ids)).geocentric
    reached: Flags = np.asarray(np.isfinite(origin).all(axis=1))
    at = np.full(len(ids), -1, dtype=np.int64)
    outside: Flags = np.zeros(len(ids), dtype=np.bool_)
    geodetic = geocentric_to_geodetic(origin[reached], cover.ellipsoid)
    at[reached] = cover.cells_of(geodetic[:, 0], geodetic[:, 1])
    outside[reached] = cover.outside(geodetic[:, 0], geodetic[:, 1])
    misfit = np.full(len(point), np.inf)
    usable = reached[point]
    misfit[usable] = _misfit(images, local[usable], rays.observed[usable], origin[point[usable]])
    apart = _two_largest(misfit, point, len(ids))

    arrivals: dict[int, RegisteredPoints] = {}
    order = np.lexsort((np.arange(len(point)), at[point]))  # rays by cell: one pass however many cells
    cells, start = np.unique(at[point[order]], return_index=True)
    for number, rows in zip(cells.tolist(), np.split(order, start[1:]), strict=True):
        if number >= 0:
            members, row = np.unique(point[rows], return_inverse=True)
            arrivals[number] = RegisteredPoints(
                ids[members], origin[members], row.astype(np.int32), rays.image[rows], rays.observed[rows], rays.sigma[rows]
            )
    return Registration(arrivals, (ids, at), apart[point], outside[point])


def _two_largest(values: Array, point: NDArray[np.int64], points: int) -> Array:
    """Sum (n,) of the two largest values of each point: rays of two places d apart pass their common point by d together."""
    order = np.lexsort((-values, point))
    first = np.searchsorted(point[order], np.arange(points))
    total = values[order[first]].copy()
    several = np.flatnonzero(np.diff(np.append(first, len(point))) > 1)
    total[several] += values[order[first[several] + 1]]
    return total


def _misfit(images: ImageSet, image: NDArray[np.int32], observed: Array, ground: Array) -> Array:
    """Metres by which rays pass given ground points (r, 3)."""
    theta = np.zeros((len(images), images.parameters))
    rows = np.arange(len(image), dtype=np.int32)
    projection = images.project(theta, images.ground(ground), image, rows)
    pixels_per_metre = np.linalg.norm(projection.by_ground, axis=(1, 2)) / np.sqrt(2.0)
    return np.asarray(np.linalg.norm(observed - projection.image, axis=1) / pixels_per_metre)
