"""Registration: every new point gets an approximate position, and with it its one cell, from all the rays that it then has.

Registration is provisional while a point has fewer than two accepted rays, and final from then on, wherever the estimate moves later
(docs/mathematics.md, "Registration"). Unadjusted cameras: the result does not depend on the network's state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geocentric_to_geodetic
from submin.network.cell import Cell, NewRays
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

SAME_POINT_METRES = 1000.0
"""Rays of one point id that pass each other by more than this belong to two places."""


@dataclass(frozen=True)
class ArrivingRays:
    """Rays of a batch of blocks, in any order.

    Attributes
    ----------
    point_ids : (r,) ids of the points; image : (r,) row of the network's images
    observed, sigma : (r, 2) pixels; accepted : (r,) as stage 1 left them
    block : (r,) number of each ray's block within the batch
    """

    point_ids: Ids
    image: NDArray[np.int32]
    observed: Array
    sigma: Array
    accepted: NDArray[np.bool_]
    block: NDArray[np.int32]

    def of_blocks(self, keep: NDArray[np.bool_]) -> ArrivingRays:
        """The rays of the blocks to be kept (True by block number)."""
        rows = keep[self.block]
        return ArrivingRays(
            self.point_ids[rows], self.image[rows], self.observed[rows], self.sigma[rows], self.accepted[rows], self.block[rows]
        )  # fmt: skip


@dataclass(frozen=True)
class Registration:
    """Where the rays of a batch go.

    Attributes
    ----------
    arrivals : new rays (and those that move along with a provisional point) by cell
    departures : ids of the points that leave a cell, by cell
    directory : ids and cells of points that are new or have moved
    misfit : (r,) metres by which each arriving ray passes the place of its point
    outside : (r,) True for rays on points outside the cover's rectangle
    """

    arrivals: dict[int, NewRays]
    departures: dict[int, Ids]
    directory: tuple[Ids, NDArray[np.int64]]
    misfit: Array
    outside: NDArray[np.bool_]


def register(
    rays: ArrivingRays, images: ImageSet, image_rows: NDArray[np.int32], known: NDArray[np.int64], cells: Mapping[int, Cell], cover: Cover
) -> Registration:
    """Register the points of arriving rays.

    Parameters
    ----------
    images : the images of the arriving rays and of the rays of provisional points; ``image_rows`` : their rows in the network, ascending
    known : (u,) for each *unique* point id (as `numpy.unique` orders them) the cell that may hold it, -1 for none
    cells : those cells, as they are before the batch
    """
    ids, point = np.unique(rays.point_ids, return_inverse=True)
    count = len(ids)
    origin, final, at = np.full((count, 3), np.nan), np.zeros(count, dtype=np.bool_), np.full(count, -1, dtype=np.int64)
    carried: list[tuple[NDArray[np.int64], Cell, NDArray[np.int64]]] = []
    for number in np.unique(known[known >= 0]):
        cell = cells[int(number)]
        here = np.flatnonzero(known == number)
        row = np.searchsorted(cell.point_ids, ids[here])
        held = row < len(cell.point_ids)
        held[held] = cell.point_ids[row[held]] == ids[here[held]]
        here, row = here[held], row[held]
        at[here], final[here], origin[here] = number, cell.final[row], cell.origin[row]
        provisional = ~cell.final[row]
        if provisional.any():
            to_point = np.full(len(cell.point_ids), -1, dtype=np.int64)
            to_point[row[provisional]] = here[provisional]
            chosen = np.flatnonzero(to_point[cell.rays.point] >= 0)
            carried.append((to_point[cell.rays.point[chosen]], cell, chosen))

    old_point = np.concatenate([c[0] for c in carried]) if carried else np.empty(0, dtype=np.int64)
    old_cell = np.concatenate([np.full(len(r), c.number) for _, c, r in carried]) if carried else np.empty(0, dtype=np.int64)
    every_point = np.concatenate([point, old_point])
    every_image = np.concatenate([rays.image, *(c.images[c.rays.image[r]] for _, c, r in carried)]).astype(np.int32)
    observed = np.concatenate([rays.observed, *(c.rays.observed[r] for _, c, r in carried)])
    sigma = np.concatenate([rays.sigma, *(c.rays.sigma[r] for _, c, r in carried)])
    accepted = np.concatenate([rays.accepted, *(c.rays.accepted[r] for _, c, r in carried)])
    local = np.searchsorted(image_rows, every_image).astype(np.int32)

    fresh = ~final
    before = at.copy()
    if fresh.any():
        compact = np.cumsum(fresh) - 1
        chosen = fresh[every_point]
        bundle = sorted_rays(
            compact[every_point[chosen]].astype(np.int32), local[chosen], observed[chosen], sigma[chosen], accepted[chosen]
        )
        origin[fresh] = intersect(images, bundle, int(fresh.sum())).geocentric
        final[fresh] = np.bincount(every_point[accepted], minlength=count)[fresh] >= 2
    reached = np.isfinite(origin).all(axis=1)
    geodetic = np.full((count, 3), np.nan)
    geodetic[reached] = geocentric_to_geodetic(origin[reached], cover.ellipsoid)
    moving = fresh & reached
    at[moving] = cover.cells_of(geodetic[moving, 0], geodetic[moving, 1])

    misfit = np.full(len(point), np.inf)
    usable = reached[point]
    misfit[usable] = _misfit(images, local[: len(point)][usable], rays.observed[usable], origin[point[usable]])
    outside = np.zeros(len(point), dtype=np.bool_)
    outside[usable] = cover.outside(geodetic[point[usable], 0], geodetic[point[usable], 1])

    # old rays stay where they are unless their point has moved to another cell
    goes = np.concatenate([np.ones(len(point), dtype=np.bool_), at[old_point] != old_cell])
    arrivals: dict[int, NewRays] = {}
    goes &= at[every_point] >= 0
    for number in np.unique(at[every_point[goes]]):
        chosen_rays = np.flatnonzero(goes & (at[every_point] == number))
        members, row = np.unique(every_point[chosen_rays], return_inverse=True)
        arrivals[int(number)] = NewRays(
            ids[members], origin[members], final[members], row.astype(np.int32), every_image[chosen_rays],
            observed[chosen_rays], sigma[chosen_rays], accepted[chosen_rays],
        )  # fmt: skip
    moved = (before >= 0) & (before != at)
    departures = {int(number): ids[moved & (before == number)] for number in np.unique(before[moved])}
    listed = (before != at) & (at >= 0)
    return Registration(arrivals, departures, (ids[listed], at[listed]), misfit, outside)


def _misfit(images: ImageSet, image: NDArray[np.int32], observed: Array, ground: Array) -> Array:
    """Metres by which rays pass given ground points (r, 3)."""
    theta = np.zeros((len(images), images.parameters))
    rows = np.arange(len(image), dtype=np.int32)
    projection = images.project(theta, images.ground(ground), image, rows)
    pixels_per_metre = np.linalg.norm(projection.by_ground, axis=(1, 2)) / np.sqrt(2.0)
    return np.asarray(np.linalg.norm(observed - projection.image, axis=1) / pixels_per_metre)
