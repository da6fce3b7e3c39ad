"""Control of a new block by a network: its common points with their joint covariance, and what the network knows of its images already.

The new images are joined to those of the network with no rays of their own, so that a policy's estimate covers them too. That matters where
they share an error with images of the network (one pass): control and new images are correlated then, and taking them for
independent would claim too much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.adjustment.control import ControlledPrior, covariance_factor
from submin.adjustment.elimination import Sums
from submin.adjustment.images import ImageSet
from submin.network.cell import Cell, widened_sums
from submin.network.sub_min import GroundPart, SubMin, add_sums, factor, loadings, locate
from submin.query.planner import POLICIES, check_policy, choose, determined_parts, points_named, well_spread
from submin.query.source import Index, NetworkSource, existing_cells
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Ids = NDArray[np.str_]


@dataclass(frozen=True)
class NetworkControl:
    """Where the control of a block comes from.

    Attributes
    ----------
    ids : (k,) control points, ascending
    policy : the one used; tiles : those concerned; images : rows of the network's images behind it
    """

    source: NetworkSource
    parts: tuple[GroundPart, ...]
    ids: Ids
    order: NDArray[np.int64]
    policy: str
    tiles: tuple[int, ...]
    network_images: int

    def prior(self, block: ImageSet, points: Ids) -> ControlledPrior:
        """Control and images of a block before its rays; ``points`` (n,), ascending, are the block's."""
        rows = np.arange(self.network_images, self.network_images + len(block), dtype=np.int32)
        joined = _Joined(self.source, block, rows)
        seen = np.unique(np.concatenate([rows, *(part.linear.image for part in self.parts)])).astype(np.int32)
        state = POLICIES[self.policy](joined, self.tiles, seen, self.parts)
        p, at = block.parameters, np.searchsorted(state.images, seen)
        by_image = (at[:, None] * p + np.arange(p)).ravel()
        root = covariance_factor(state.covariance[np.ix_(by_image, by_image)])
        on_points, k = loadings(self.parts, seen, p) @ root, len(self.ids)
        # no more whitened vectors than coordinates and parameters that they are to describe
        both = np.concatenate([on_points, root[-len(block) * p :]])
        if both.shape[1] > len(both):
            both = np.ascontiguousarray(la.qr(both.T, mode="r")[0][: len(both)].T)
        return ControlledPrior(
            np.searchsorted(points, self.ids),
            np.concatenate([locate(part, state) for part in self.parts])[self.order],
            np.concatenate([part.factors.own for part in self.parts])[self.order],
            both[: 3 * k].reshape(k, 3, -1)[self.order],
            state.theta[at[-len(block) :]],
            both[3 * k :],
        )


def control_of_block(
    source: NetworkSource, ids: Ids, cells: NDArray[np.int64], policy: str, network_images: int, most: int | None = None
) -> NetworkControl | None:
    """Those of a block's points ``ids`` (in ``cells``, see `points_named`) that a network can answer for, as control; None without any.

    ``most``: at most so many, well spread and well determined. ``network_images`` is the number of images in the network.

    Raises
    ------
    QueryError
        When the policy is unknown, or ``tile`` is asked of points that no one tile holds.
    """
    check_policy(policy)
    selections, _ = points_named(source, ids, cells)
    if most is not None:
        selections = well_spread(source, selections, most)
    kept, parts = determined_parts(source, selections)
    if not parts:
        return None
    chosen, tiles = choose(source, kept, policy, None)
    found = np.concatenate([s.cell.point_ids[s.rows] for s in kept])
    order = np.argsort(found, kind="stable")
    return NetworkControl(source, tuple(parts), found[order], order, chosen, tuple(tiles), network_images)


@dataclass(frozen=True)
class _Joined(NetworkSource):
    """A network with the images of a block behind its own, of which it has no rays."""

    source: NetworkSource
    block: ImageSet
    rows: Index

    @property
    def cover(self) -> Cover:
        return self.source.cover

    def cell_numbers(self) -> tuple[int, ...]:
        return self.source.cell_numbers()

    def existing(self, numbers: Sequence[int]) -> tuple[int, ...]:
        return self.source.existing(numbers)

    def cell(self, number: int) -> Cell:
        return self.source.cell(number)

    def some_cells(self, numbers: Sequence[int]) -> list[Cell]:
        return self.source.some_cells(numbers)

    def cell_sums(self, number: int) -> tuple[Index, Sums]:
        images, sums = self.source.cell_sums(number)
        every = np.concatenate([images, self.rows])
        return every, add_sums([(images, widened_sums(sums, len(images), self.block.parameters))], every, self.block.parameters)

    def sub_min(self, tile: int, images: Index | None) -> SubMin:
        cells = [self.cell_sums(cell) for cell in existing_cells(self, [tile])]
        rows = np.unique(np.concatenate([of_cell for of_cell, _ in cells])).astype(np.int32)
        of_tile = self.image_set(rows)
        return factor(add_sums(cells, rows, of_tile.parameters), rows, of_tile)

    def with_outside(self, tiles: Sequence[int], images: Index) -> SubMin | None:
        return None  # what lies outside knows nothing of the block's images

    def image_set(self, rows: Sequence[int] | Index) -> ImageSet:
        wanted = np.asarray(rows, dtype=np.int32)
        known, new = self.source.image_set(wanted[wanted < self.rows[0]]), self.block.take(wanted[wanted >= self.rows[0]] - self.rows[0])
        return both(known, new)


def both(known: ImageSet, new: ImageSet) -> ImageSet:
    """Images of a network followed by those of a block, with the block's number of parameters."""
    width = max(known.cameras.shape[1], new.cameras.shape[1])
    cameras = np.full((len(known) + len(new), width), np.nan)
    cameras[: len(known), : known.cameras.shape[1]] = known.cameras
    cameras[len(known) :, : new.cameras.shape[1]] = new.cameras
    return ImageSet(
        known.ids + new.ids, known.sensors + new.sensors, cameras, known.priors + new.priors, new.parameters, new.ellipsoid,
    )  # fmt: skip
