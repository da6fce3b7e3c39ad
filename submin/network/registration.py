"""Registration: every point gets an approximate position, and with it its one cell, from all the rays that it has.

A point that gets or loses a ray is taken out of its cell and put back with the rays that it then has. Unadjusted cameras, images in the
order of their ids: where a point is registered depends on its rays alone, not on when they came (decision 006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.explained import explained_metres
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geocentric_to_geodetic, geodetic_to_geocentric
from submin.network.cell import Cell, RegisteredPoints
from submin.network.id_numbers import numbered
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
Flags = NDArray[np.bool_]

SAME_POINT_METRES = 1000.0
"""Rays of one point id that pass each other by more than this, and than unadjusted cameras explain, belong to two places."""
IN_THE_NETWORK = -1
"""Block of a ray that the network has already."""


@dataclass(frozen=True)
class LooseRays:
    """Rays that lie in no cell, in any order: those of new blocks, and those of points taken out of their cells.

    Attributes
    ----------
    ids : (n,) ids of their points, ascending; point : (r,) row of each ray's point in ``ids``, each of which has a ray
    image : (r,) row of the network's images
    observed, sigma : (r, 2)
    accepted : (r,) as last judged: by stage 1, or in the cell
    block : (r,) number of each ray's block within its batch; `IN_THE_NETWORK` for a ray taken out of a cell
    """

    ids: Ids
    point: NDArray[np.int32]
    image: NDArray[np.int32]
    observed: Array
    sigma: Array
    accepted: Flags
    block: NDArray[np.int32]

    @classmethod
    def of(
        cls, point_ids: Ids, image: NDArray[np.int32], observed: Array, sigma: Array, accepted: Flags, block: NDArray[np.int32]
    ) -> LooseRays:
        """Rays with the id (r,) of each one's point."""
        ids, point = numbered(point_ids)
        return cls(ids, point.astype(np.int32), image, observed, sigma, accepted, block)

    def __len__(self) -> int:
        return len(self.image)

    @property
    def point_ids(self) -> Ids:
        """Id (r,) of each ray's point."""
        return self.ids[self.point]

    def take(self, rows: Flags | NDArray[np.int64]) -> LooseRays:
        """The rays of these rows, or where ``rows`` (r,) is True."""
        points, point = _compact(self.point[rows], len(self.ids))
        return LooseRays(self.ids[points], point, *(getattr(self, name)[rows] for name in _OF_RAYS))


def _compact(point: NDArray[np.int32], points: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Those (n,) of some points that rays have, ascending, and the place (r,) of each ray's point among them."""
    seen = np.zeros(points, dtype=np.bool_)
    seen[point] = True
    return np.flatnonzero(seen), (np.cumsum(seen, dtype=np.int32) - 1)[point]


_OF_RAYS = tuple(field.name for field in fields(LooseRays))[2:]


def together(parts: Sequence[LooseRays]) -> LooseRays:
    """All rays of some parts."""
    none = np.empty(0, dtype=np.int32)
    every = (LooseRays(np.empty(0, dtype="U1"), none, none, np.empty((0, 2)), np.empty((0, 2)), none.astype(np.bool_), none), *parts)
    ids, place = numbered(np.concatenate([part.ids for part in every]))
    places = np.split(place.astype(np.int32), np.cumsum([len(part.ids) for part in every])[:-1])
    point = np.concatenate([of_part[part.point] for part, of_part in zip(every, places, strict=True)])
    return LooseRays(ids, point, *(np.concatenate([getattr(part, name) for part in every]) for name in _OF_RAYS))


def taken_out(cell: Cell, points: Flags) -> LooseRays:
    """The rays of those of a cell's points where ``points`` (n,) is True."""
    rays = cell.rays.take(points[cell.rays.point])
    seen, point = _compact(rays.point, len(cell))
    block = np.full(len(rays), IN_THE_NETWORK, dtype=np.int32)
    return LooseRays(
        cell.point_ids[seen], point, cell.images[rays.image], rays.observed, rays.sigma, rays.accepted, block
    )  # fmt: skip


@dataclass(frozen=True)
class Registration:
    """Where points go.

    Attributes
    ----------
    arrivals : points by cell, with all of their rays
    directory : ids and cells of all points
    apart : (n,) metres between the places to which the rays of each point point that count; infinite where a camera reaches no ground
    counts : (r,) True for rays that were accepted when last judged, or whose camera reaches no ground
    outside : (r,) True for rays on points outside the cover's rectangle
    """

    arrivals: dict[int, RegisteredPoints]
    directory: tuple[Ids, NDArray[np.int64]]
    apart: Array
    counts: Flags
    outside: Flags

    def doubtful(self, rays: LooseRays) -> Flags:
        """(r,) True for those of the registered rays, all of them, which count and whose point may be two places."""
        return np.asarray(self.counts & (self.apart > SAME_POINT_METRES)[rays.point])


@dataclass(frozen=True)
class Located:
    """Where points are registered.

    Attributes
    ----------
    origin : (n, 3) geocentric metres, NaN where a camera reaches no ground; cell : (n,) number, -1 there
    outside : (n,) True for points outside the cover's rectangle; apart : (n,), counts : (r,), see `Registration`
    """

    origin: Array
    cell: NDArray[np.int64]
    outside: Flags
    apart: Array
    counts: Flags


def register(rays: LooseRays, images: ImageSet, image_rows: NDArray[np.int32], cover: Cover) -> Registration:
    """Register the points of some rays, which are all rays that these points have.

    ``images`` are at least those of the rays, ``image_rows`` their rows in the network, ascending.
    """
    return arranged(rays, locate(rays, images, image_rows, cover))


def locate(rays: LooseRays, images: ImageSet, image_rows: NDArray[np.int32], cover: Cover) -> Located:
    """Where the points of some rays are registered; arguments as of `register`. Each point depends on its own rays alone."""
    point, points = rays.point, len(rays.ids)
    at, outside = np.full(points, -1, dtype=np.int64), np.zeros(points, dtype=np.bool_)
    if not len(rays):
        return Located(np.empty((0, 3)), at, outside, np.empty(0), np.empty(0, dtype=np.bool_))
    named = np.argsort(np.array(images.ids, dtype=np.str_))
    rank = np.empty(len(named), dtype=np.int32)
    rank[named] = np.arange(len(named))
    images = images.take(named)
    local = rank[np.searchsorted(image_rows, rays.image)]

    every = np.ones(len(rays), dtype=np.bool_)
    origin = intersect(images, sorted_rays(point, local, rays.observed, rays.sigma, every), points)
    reached: Flags = np.asarray(np.isfinite(origin).all(axis=1))
    geodetic = geocentric_to_geodetic(origin[reached], cover.ellipsoid)
    at[reached] = cover.cells_of(geodetic[:, 0], geodetic[:, 1])
    outside[reached] = cover.outside(geodetic[:, 0], geodetic[:, 1])
    usable, compact = reached[point], np.cumsum(reached) - 1
    passing = np.full((len(point), 3), np.inf)
    if usable.any():
        passing[usable] = _passing(images, local[usable], rays.observed[usable], compact[point[usable]], origin[reached])
    # a blunder that stage 1 has found is no second place
    counts = rays.accepted | ~np.isfinite(passing).all(axis=1)
    return Located(origin, at, outside, _apart(point[counts], passing[counts], points), counts)


def arranged(rays: LooseRays, located: Located) -> Registration:
    """Rays by the cells in which their points are registered."""
    ids, point, at = rays.ids, rays.point, located.cell
    cells, place = np.unique(at, return_inverse=True)
    of_points, of_rays = _by_group(place, len(cells)), _by_group(place[point], len(cells))
    row = np.empty(len(ids), dtype=np.int32)  # of each point in its cell
    for members in of_points:
        row[members] = np.arange(len(members), dtype=np.int32)
    arrivals = {
        number: RegisteredPoints(
            ids[members], located.origin[members], row[point[rows]], rays.image[rows], rays.observed[rows], rays.sigma[rows]
        )
        for number, members, rows in zip(cells.tolist(), of_points, of_rays, strict=True)
        if number >= 0
    }
    return Registration(arrivals, (ids, at), located.apart, located.counts, located.outside[point])


def _by_group(group: NDArray[np.integer], groups: int) -> list[NDArray[np.int64]]:
    """Rows, ascending, of each of so many groups."""
    few = group.astype(np.uint16) if groups <= 1 << 16 else group  # small numbers are sorted by their digits, in one pass
    return np.split(np.argsort(few, kind="stable"), np.cumsum(np.bincount(group, minlength=groups))[:-1])[:groups]


def by_points(rays: LooseRays, parts: int) -> list[NDArray[np.int64]]:
    """Rows of some rays in so many parts, each with all rays of its points: parts can be located apart, see `joined`."""
    return _by_group(rays.point.astype(np.int64) * parts // max(len(rays.ids), 1), parts)


def joined(parts: Sequence[Located], rows: Sequence[NDArray[np.int64]]) -> Located:
    """Where all points are registered, from parts of their rays, whose rows are those of `by_points`."""
    counts = np.empty(sum(map(len, rows)), dtype=np.bool_)
    for part, of_part in zip(parts, rows, strict=True):
        counts[of_part] = part.counts
    origin, cell, outside, apart = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("origin", "cell", "outside", "apart")
    )
    return Located(origin, cell, outside, apart, counts)


def _passing(images: ImageSet, image: NDArray[np.int32], observed: Array, point: NDArray[np.int64], origin: Array) -> Array:
    """Metres (r, 3) by which rays pass the places of their points, and on which side, each in the plane across it."""
    theta = np.zeros((len(images), images.parameters))
    projection = images.project(theta, images.ground(origin), image, point.astype(np.int32))
    b = projection.by_ground
    square = b @ np.swapaxes(b, 1, 2)
    square += 1e-12 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(2)  # a view along one axis only has an empty row
    return np.asarray(np.einsum("rck,rc->rk", b, np.linalg.solve(square, (observed - projection.image)[:, :, None])[:, :, 0]))


def contradictions(
    rays: LooseRays, registration: Registration, images: ImageSet, image_rows: NDArray[np.int32], cover: Cover
) -> dict[int, tuple[str, float]]:
    """Blocks of a batch that measure a point elsewhere than the network or the blocks before them, with the point and how far off, metres.

    Blocks are taken in their order, and one that contradicts is left out for those after it: the same as one at a time. Only rays that
    count do (see `Registration`). Arguments as of `register`, and its result.
    """
    doubtful = rays.take(registration.doubtful(rays))
    most = _most_apart(doubtful, images, image_rows)
    kept = doubtful.block == IN_THE_NETWORK
    found: dict[int, tuple[str, float]] = {}
    for block in np.unique(doubtful.block[~kept]).tolist():
        mine = doubtful.block == block
        now = (kept | mine) & np.isin(doubtful.point, doubtful.point[mine])
        together_now, points = doubtful.take(now), np.unique(doubtful.point[now])
        all_count = replace(together_now, accepted=np.ones(len(together_now), dtype=np.bool_))
        apart = register(all_count, images, image_rows, cover).apart
        too_far = apart - most[points]
        worst = int(np.argmax(too_far))
        if too_far[worst] > 0.0:
            found[block] = (str(together_now.ids[worst]), float(apart[worst]))
        else:
            kept |= mine
    return found


def _most_apart(rays: LooseRays, images: ImageSet, image_rows: NDArray[np.int32]) -> Array:
    """How far apart (n,) the rays of each point may place it, metres, with cameras known as they are a priori."""
    most = np.zeros(len(rays.ids))
    if len(rays):
        seen, image = np.unique(np.searchsorted(image_rows, rays.image), return_inverse=True)
        np.maximum.at(most, rays.point, _explained(images.take(seen), image.astype(np.int32), rays))
    return np.maximum(SAME_POINT_METRES, 2.0 * most)  # one ray to the one side, another to the other


def _explained(images: ImageSet, image: NDArray[np.int32], rays: LooseRays) -> Array:
    """See `explained_metres`; 0 for a ray that meets no ground. Which cameras were found to be bad, in whatever order, does not matter."""
    images = replace(images, priors=tuple(replace(prior, released=False) for prior in images.priors))
    place = geodetic_to_geocentric(images.localise(image, rays.observed), images.ellipsoid)
    reached = np.isfinite(place).all(axis=1)
    seen, every = image[reached], np.arange(int(reached.sum()), dtype=np.int32)
    projection = images.project(np.zeros((len(images), images.parameters)), images.ground(place[reached]), seen, every)
    explained = np.zeros(len(image))
    by_ground, by_parameters = (part / rays.sigma[reached][:, :, None] for part in (projection.by_ground, projection.by_parameters))
    explained[reached] = explained_metres(by_ground, by_parameters, images.prior_variance[seen])
    return explained


def _apart(point: NDArray[np.int32], passing: Array, points: int) -> Array:
    """Metres (n,) between the places to which the rays of each of n points point.

    Infinite where a camera reaches no ground, 0 for a point without rays.
    """
    order = np.argsort(point, kind="stable")
    seen, first = np.unique(point[order], return_index=True)
    apart = np.zeros(points)
    if len(seen):
        high, low = np.maximum.reduceat(passing[order], first, axis=0), np.minimum.reduceat(passing[order], first, axis=0)
        with np.errstate(invalid="ignore"):
            apart[seen] = np.linalg.norm(np.where(np.isfinite(high), high - low, np.inf), axis=1)
    return apart
