"""A cell: the one place of its ground points, with their rays, the state at which they are linearised, and their sums.

Cells are values: fusing makes a new one. Everything a network knows is in its cells, its images and its a priori models; sub-MINs are
derived from them (docs/mathematics.md, "Cells").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, PointFactors, Sums, eliminate, linearise, point_factors
from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays, canonical_order, sorted_rays
from submin.adjustment.symmetric import permuted
from submin.errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Ids = NDArray[np.str_]


@dataclass(frozen=True)
class Cell:
    """State of a cell.

    Attributes
    ----------
    number : code of the cell in the cover
    point_ids : (n,) ids of its points, ascending
    origin : (n, 3) registered position, geocentric metres: the origin of each point's coordinates
    linearised_at : (n, 3) position at which the point's rays are linearised
    images : (m,) rows of the network's images that see any of its points, ascending
    theta : (m, p) corrections at which these images are linearised
    rays : all rays of its points, rejected ones too; ``rays.point`` and ``rays.image`` are rows of this cell
    sums : what the accepted rays say about ``images``
    """

    number: int
    point_ids: Ids
    origin: Array
    linearised_at: Array
    images: Index
    theta: Array
    rays: Rays
    sums: Sums

    def __len__(self) -> int:
        return len(self.point_ids)


@dataclass(frozen=True)
class RegisteredPoints:
    """Points that join a cell, with all of their rays.

    Attributes
    ----------
    point_ids : (n,) ids of the points, unique
    origin : (n, 3) registered positions, geocentric metres
    point : (r,) row of each ray's point in ``point_ids``; image : (r,) row of the network's images
    observed, sigma : (r, 2)
    """

    point_ids: Ids
    origin: Array
    point: Index
    image: Index
    observed: Array
    sigma: Array


def empty_sums(images: int, parameters: int) -> Sums:
    """No information about so many images."""
    return Sums(np.zeros((images * parameters, images * parameters)), np.zeros(images * parameters), 0.0, 0)


def widened(cell: Cell, parameters: int) -> Cell:
    """The cell with so many parameters an image: what is added says and is nothing."""
    images, old = cell.theta.shape
    if old == parameters:
        return cell
    theta = np.zeros((images, parameters))
    theta[:, :old] = cell.theta
    sums = widened_sums(cell.sums, images, parameters) if len(cell.sums.vector) else cell.sums
    return replace(cell, theta=theta, sums=sums)


def widened_sums(sums: Sums, images: int, parameters: int) -> Sums:
    """Sums about m images with so many parameters an image."""
    rows = kept_rows(images, len(sums.vector) // max(images, 1), parameters)
    wide = empty_sums(images, parameters)
    wide.information[np.ix_(rows, rows)] = sums.information
    wide.vector[rows] = sums.vector
    return replace(sums, information=wide.information, vector=wide.vector)


def kept_rows(images: int, old: int, new: int) -> NDArray[np.int64]:
    """Places (m old,) of the parameters of m images when each gets ``new`` of them, the ``old`` ones first."""
    return np.asarray((np.arange(images)[:, None] * new + np.arange(old)).ravel())


def empty_cell(number: int, parameters: int) -> Cell:
    """A cell without points."""
    none = np.empty(0, dtype=np.int32)
    rays = Rays(none, none, np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.bool_))
    return Cell(
        number, np.empty(0, dtype="U1"), np.empty((0, 3)), np.empty((0, 3)),
        none, np.empty((0, parameters)), rays, empty_sums(0, parameters),
    )  # fmt: skip


def with_points(cell: Cell, new: RegisteredPoints) -> Cell:
    """The cell with more points, none of which it holds yet. Its sums are *not* those of its rays until `summed` is called.

    Raises
    ------
    InputError
        When it holds one of the points: its rays would count twice.
    """
    twice = np.intersect1d(cell.point_ids, new.point_ids)
    if len(twice):
        raise InputError(
            f"cell {cell.number}: holds {len(twice)} of the points already, {twice[0]} among them, and their rays would count twice; "
            "expected points that it does not hold: take them out first, and put them back with all of their rays"
        )
    return with_rays(cell, new)


def with_rays(cell: Cell, new: RegisteredPoints) -> Cell:
    """The cell with more points and rays. Points that it holds stay where they are registered and linearised. Sums as in `with_points`."""
    ids = np.union1d(cell.point_ids, new.point_ids)
    old_rows, new_rows = np.searchsorted(ids, cell.point_ids), np.searchsorted(ids, new.point_ids)
    origin, linearised_at = np.empty((len(ids), 3)), np.empty((len(ids), 3))
    origin[new_rows] = linearised_at[new_rows] = new.origin
    origin[old_rows], linearised_at[old_rows] = cell.origin, cell.linearised_at

    images = np.union1d(cell.images, new.image).astype(np.int32)
    theta = np.zeros((len(images), cell.theta.shape[1]))
    theta[np.searchsorted(images, cell.images)] = cell.theta
    rays = sorted_rays(
        np.concatenate([old_rows[cell.rays.point], new_rows[new.point]]).astype(np.int32),
        np.searchsorted(images, np.concatenate([cell.images[cell.rays.image], new.image])).astype(np.int32),
        np.concatenate([cell.rays.observed, new.observed]),
        np.concatenate([cell.rays.sigma, new.sigma]),
        np.concatenate([cell.rays.accepted, np.ones(len(new.image), dtype=np.bool_)]),
    )
    return replace(cell, point_ids=ids, origin=origin, linearised_at=linearised_at, images=images, theta=theta, rays=rays)


def without_points(cell: Cell, point_ids: Ids) -> Cell:
    """The cell without some points and their rays. Sums as in `with_points`."""
    keep = ~np.isin(cell.point_ids, point_ids)
    row = np.cumsum(keep) - 1
    rays = cell.rays.take(keep[cell.rays.point])
    images, image = np.unique(rays.image, return_inverse=True)
    return replace(
        cell,
        point_ids=cell.point_ids[keep], origin=cell.origin[keep], linearised_at=cell.linearised_at[keep],
        images=cell.images[images], theta=cell.theta[images],
        rays=replace(rays, point=row[rays.point].astype(np.int32), image=image.astype(np.int32)),
    )  # fmt: skip


def linear_rays(cell: Cell, images: ImageSet, points: NDArray[np.int64] | None = None) -> LinearRays:
    """The cell's rays, or those of some of its points (rows, ascending), linearised at the cell's state.

    ``images`` are the cell's images, in its order.
    """
    if points is None:
        return linearise(images, cell.rays, cell.theta, cell.linearised_at, cell.origin)
    return linearise(images, rays_of(cell, points), cell.theta, cell.linearised_at[points], cell.origin[points])


def rays_of(cell: Cell, points: NDArray[np.int64]) -> Rays:
    """All rays of some of the cell's points (rows, ascending); ``point`` counts these."""
    place = np.full(len(cell), -1, dtype=np.int32)
    place[points] = np.arange(len(points), dtype=np.int32)
    point = place[cell.rays.point]
    chosen = point >= 0
    return replace(cell.rays.take(chosen), point=point[chosen])


def summed(cell: Cell, images: ImageSet) -> Cell:
    """The cell with sums made anew from its accepted rays at its linearisation, in the order of the images' ids."""
    by_id = np.argsort(np.array(images.ids, dtype=np.str_))
    rank = np.argsort(by_id).astype(np.int32)
    rays = sorted_rays(cell.rays.point, rank[cell.rays.image], cell.rays.observed, cell.rays.sigma, cell.rays.accepted)
    linear = linearise(images.take(by_id), rays, cell.theta[by_id], cell.linearised_at, cell.origin)
    sums = eliminate(linear, rays.accepted.astype(np.float64), len(images))
    return replace(cell, sums=reordered(sums, rank, images.parameters))


def reordered(sums: Sums, order: Index | NDArray[np.int64], parameters: int) -> Sums:
    """Sums about the same images in another order: image k of the result is image ``order[k]``."""
    if np.array_equal(order, np.arange(len(order))):
        return sums
    rows = (np.asarray(order, dtype=np.int64)[:, None] * parameters + np.arange(parameters)).ravel()
    return Sums(permuted(sums.information, order, parameters), sums.vector[rows], sums.misclosure, sums.redundancy)


def factors(cell: Cell, images: ImageSet, points: NDArray[np.int64]) -> tuple[LinearRays, PointFactors]:
    """Own parts and loadings of some of the cell's points (rows, ascending)."""
    rays = rays_of(cell, points)
    linear = linearise(images, rays, cell.theta, cell.linearised_at[points], cell.origin[points])
    return linear, point_factors(linear, rays.accepted.astype(np.float64))


def loses(before: Cell, after: Cell) -> bool:
    """True when a ray that gave information in one state of some points does not in another: of points that both cells hold.

    A point gives information with its second accepted ray.
    """
    informative = np.bincount(before.rays.point[before.rays.accepted], minlength=len(before)) >= 2
    chosen = before.rays.accepted & (informative & np.isin(before.point_ids, after.point_ids))[before.rays.point]
    if not chosen.any():
        return False
    place = np.searchsorted(after.point_ids, before.point_ids[before.rays.point[chosen]])
    row, width = before.images[before.rays.image[chosen]], 1 + int(max(before.images.max(), after.images.max(initial=0)))
    kept = after.rays.accepted
    now = after.rays.point[kept].astype(np.int64) * width + after.images[after.rays.image[kept]]
    return bool(np.isin(place.astype(np.int64) * width + row, now, invert=True).any())


def union_of_images(cells: Sequence[Cell]) -> Index:
    """Rows of the network's images that any of these cells sees, ascending."""
    if not cells:
        return np.empty(0, dtype=np.int32)
    return np.unique(np.concatenate([cell.images for cell in cells])).astype(np.int32)


@dataclass(frozen=True)
class Bundle:
    """All rays of some cells, to be adjusted together, in an order that does not depend on when anything came.

    Attributes
    ----------
    rays : candidates all, in canonical order; ``point`` counts the points of the cells one after another
    origin : (n, 3) registered positions of the points
    row : (r,) place of each ray among the rays of the cells one after another
    """

    rays: Rays
    origin: Array
    row: NDArray[np.int64]


def bundle(cells: Sequence[Cell], images: Index) -> Bundle:
    """Bundle the rays of some cells; ``images`` (rows of the network, in any order) are those of the bundle."""
    shifts = np.cumsum([0, *(len(cell) for cell in cells)])
    place = np.argsort(images)
    point = np.concatenate([cell.rays.point + shift for cell, shift in zip(cells, shifts, strict=False)]).astype(np.int32)
    image = np.concatenate([place[np.searchsorted(images, cell.images, sorter=place)][cell.rays.image] for cell in cells]).astype(np.int32)
    observed = np.concatenate([cell.rays.observed for cell in cells])
    row = canonical_order(point, image, observed)
    sigma = np.concatenate([cell.rays.sigma for cell in cells])
    rays = Rays(point[row], image[row], observed[row], sigma[row], np.ones(len(row), dtype=np.bool_))
    return Bundle(rays, np.concatenate([cell.origin for cell in cells]), row)
