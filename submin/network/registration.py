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
    apart : (r,) metres between the places to which the rays of the ray's point point; infinite where a camera reaches no ground
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
    usable, compact = reached[point], np.cumsum(reached) - 1
    apart = np.full(len(ids), np.inf)
    if usable.any():
        apart[reached] = _apart(images, local[usable], rays.observed[usable], compact[point[usable]], origin[reached])

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


def _apart(images: ImageSet, image: NDArray[np.int32], observed: Array, point: NDArray[np.int64], origin: Array) -> Array:
    """Metres (n,) between the places to which the rays of each point point: how far they pass it, each in its own plane, on which sides."""
    theta = np.zeros((len(images), images.parameters))
    projection = images.project(theta, images.ground(origin), image, point.astype(np.int32))
    b = projection.by_ground
    square = b @ np.swapaxes(b, 1, 2)
    square += 1e-12 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(2)  # a view along one axis only has an empty row
    passing = np.einsum("rck,rc->rk", b, np.linalg.solve(square, (observed - projection.image)[:, :, None])[:, :, 0])
    order = np.argsort(point, kind="stable")
    first = np.searchsorted(point[order], np.arange(len(origin)))
    widest = np.maximum.reduceat(passing[order], first, axis=0) - np.minimum.reduceat(passing[order], first, axis=0)
    return np.asarray(np.linalg.norm(widest, axis=1))
