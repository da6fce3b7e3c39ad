"""The linear system of a network as arrays that any solver can be given: rays, a priori model and points, with what is asked of them.

A ray says ``y = A theta + B (x - x0) + v``, ``Cov v = I``; an image's adjustable parameters are ``theta = K u``, ``u ~ N(0, I)``. That is
what the product itself has linearised: peers need know nothing of cameras, and all solve the same.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from submin.adjustment.priors import prior_and_columns
from submin.network.cell import linear_rays
from submin.query.planner import DETERMINED_METRES
from submin.storage.network import Network

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Ids = NDArray[np.str_]

ASKED = 100
"""Points of a joint covariance."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Rays of all points that two or more accepted rays see, sorted by point.

    Attributes
    ----------
    ids : (n,) points, ascending; origin : (n, 3) x0, geocentric metres
    first : (n + 1,) offsets of each point's rays; image : (r,) row of each ray's image
    by_ground : (r, 2, 3) B; by_parameters : (r, 2, p) A; y : (r, 2)
    prior : K (m p, q), of which the first columns are the images' own, one for each of ``adjusted``
    adjusted : (k,) rows of K that can move, image-major
    added : (m,) images of the block that comes last
    near, far : points (rows) around one of them, and spread over all
    """

    ids: Ids
    origin: Array
    first: Rows
    image: Rows
    by_ground: Array
    by_parameters: Array
    y: Array
    prior: sp.csr_array
    adjusted: Rows
    added: NDArray[np.bool_]
    near: Rows
    far: Rows

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def point(self) -> Rows:
        """Row (r,) of each ray's point."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))

    def save(self, path: Path) -> None:
        """Write it to a file."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "prior"}
        parts = {f"prior_{name}": getattr(self.prior, name) for name in ("data", "indices", "indptr", "shape")}
        np.savez(path, **arrays, **parts)

    @classmethod
    def load(cls, path: Path) -> Problem:
        """Read it from a file."""
        with np.load(path) as held:
            prior = sp.csr_array((held["prior_data"], held["prior_indices"], held["prior_indptr"]), shape=tuple(held["prior_shape"]))
            return cls(prior=prior, **{field.name: held[field.name] for field in fields(cls) if field.name != "prior"})

    def own_covariances(self, rays: NDArray[np.bool_]) -> Array:
        """``(B'B)^-1`` (n, 3, 3) of points by some of their rays (r,) alone, infinite where they do not determine one."""
        normal = np.zeros((len(self), 3, 3))
        np.add.at(normal, self.point[rays], np.einsum("rci,rcj->rij", self.by_ground[rays], self.by_ground[rays]))
        seen = np.linalg.eigvalsh(normal)[:, 0] > DETERMINED_METRES**-2
        found = np.full(normal.shape, np.inf)
        found[seen] = np.linalg.inv(normal[seen])
        return found

    def before_last_block(self) -> NDArray[np.bool_]:
        """Rays (r,) that were there before the last block, of points that these alone determine well."""
        rays = ~self.added[self.image]
        rays &= np.bincount(self.point[rays], minlength=len(self))[self.point] >= 2
        return np.asarray(rays & np.isfinite(self.own_covariances(rays)[:, 0, 0])[self.point])


@dataclass(frozen=True, eq=False)
class ImageGroups:
    """Images whose own errors hang together, and what their passes have in common.

    Attributes
    ----------
    own : by group, rows of `Problem.adjusted` (and columns of K) that are its own
    of_row, place : (k,) group of each row, and its place there
    shared : columns of K by common variable
    common : (g,) the common variable that moves each group; -1: none
    """

    own: tuple[Rows, ...]
    of_row: Rows
    place: Rows
    shared: tuple[Rows, ...]
    common: Rows

    def of_images(self, problem: Problem) -> tuple[Rows, list[tuple[Rows, Rows]]]:
        """Group (m,) of each image, -1 of one that nothing moves; and by image its adjustable parameters and their places in the group."""
        images, p = len(problem.added), problem.by_parameters.shape[2]
        edges = np.searchsorted(problem.adjusted, np.arange(images + 1) * p)
        of_images, rows = np.full(images, -1), []
        for image, (low, high) in enumerate(pairwise(edges)):
            rows.append((problem.adjusted[low:high] % p, self.place[low:high]))
            if high > low:
                of_images[image] = self.of_row[low]
        return of_images, rows


def image_groups(problem: Problem) -> ImageGroups:
    """Groups of images by the pattern of K; columns of K that move one group make one common variable."""
    k = len(problem.adjusted)
    rows = problem.prior[problem.adjusted].tocsc()
    own, other = rows[:, :k], rows[:, k:]
    image = problem.adjusted // problem.by_parameters.shape[2]
    same_image = sp.csr_array((np.ones(k), (np.arange(k), image)))
    together = abs(own) + same_image @ same_image.T
    count, group = connected_components(together, directed=False)
    touches = sp.csr_array(sp.csr_array((np.ones(k), (group, np.arange(k)))) @ abs(other))
    commons, common_of = connected_components(touches.T @ touches, directed=False)
    order = np.argsort(group, kind="stable")
    members = np.split(order, np.cumsum(np.bincount(group, minlength=count))[:-1])
    place = np.empty(k, dtype=np.int64)
    common = np.full(count, -1, dtype=np.int64)
    for g, rows_of in enumerate(members):
        place[rows_of] = np.arange(len(rows_of))
        seen = touches.indices[touches.indptr[g] : touches.indptr[g + 1]]
        if len(seen):
            common[g] = common_of[seen[0]]
    shared = tuple(k + np.flatnonzero(common_of == c) for c in range(commons)) if other.shape[1] else ()
    return ImageGroups(tuple(members), group.astype(np.int64), place, shared, common)


def problem_of(network: Network, last_block: frozenset[str]) -> Problem:
    """The linear system of a network, at the state at which its cells are linearised; ``last_block``: ids of that block's images.

    Raises
    ------
    ValueError
        When the network has correlated control, whose factors this form does not have.
    """
    snapshot = network.snapshot
    prior, columns = prior_and_columns(snapshot.image_priors(), snapshot.metadata.parameters)
    if columns.sets:
        raise ValueError("the network has correlated control; expected images alone")
    ids, origin, counts, image, by_ground, by_parameters, y = [], [], [], [], [], [], []
    for number in network.cell_numbers():
        cell = network.cell(number)
        seen = np.bincount(cell.rays.point[cell.rays.accepted], minlength=len(cell))
        kept = cell.rays.accepted & (seen >= 2)[cell.rays.point]
        linear = linear_rays(cell, network.image_set(cell.images))
        ids.append(cell.point_ids[seen >= 2])
        origin.append(cell.origin[seen >= 2])
        counts.append(seen[seen >= 2])
        image.append(cell.images[linear.image[kept]])
        by_ground.append(linear.by_ground[kept])
        by_parameters.append(linear.by_parameters[kept])
        y.append(linear.y[kept])
    count = np.concatenate(counts)
    whole = np.concatenate(ids)
    order = np.argsort(whole)
    starts = np.cumsum(count) - count
    ray = np.concatenate([np.arange(starts[j], starts[j] + count[j]) for j in order])
    at, names = np.concatenate(origin)[order], snapshot.image_columns(["image_id"])["image_id"]
    middle = int(np.argmin(np.linalg.norm(at - at.mean(axis=0), axis=1)))
    return Problem(
        whole[order], at, np.concatenate([[0], np.cumsum(count[order])]), np.concatenate(image)[ray].astype(np.int64),
        np.concatenate(by_ground)[ray], np.concatenate(by_parameters)[ray], np.concatenate(y)[ray], prior,
        columns.image * snapshot.metadata.parameters + columns.parameter, np.isin(names, list(last_block)),
        _nearest(at, middle), _drawn(len(at), np.random.default_rng(0)),
    )  # fmt: skip


def around(problem: Problem, rng: np.random.Generator) -> Rows:
    """The points around one that is drawn, ascending."""
    return _nearest(problem.origin, int(rng.integers(len(problem))))


def spread(problem: Problem, rng: np.random.Generator) -> Rows:
    """Points drawn from all, ascending."""
    return _drawn(len(problem), rng)


def _nearest(at: Array, centre: int) -> Rows:
    return np.sort(np.argsort(np.linalg.norm(at - at[centre], axis=1))[:ASKED])


def _drawn(points: int, rng: np.random.Generator) -> Rows:
    return np.sort(rng.choice(points, min(ASKED, points), replace=False))
