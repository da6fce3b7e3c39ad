"""Rays: measured image coordinates of ground points, the raw material of every network."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int32]


@dataclass(frozen=True)
class Rays:
    """Measured rays, sorted by point.

    Attributes
    ----------
    point : (r,) row of the ground point that each ray sees, not decreasing
    image : (r,) row of the image in which it was measured
    observed : (r, 2) sample and line, pixels
    sigma : (r, 2) standard deviations of sample and line, pixels
    accepted : (r,) False for a ray that was rejected as a blunder
    """

    point: Index
    image: Index
    observed: Array
    sigma: Array
    accepted: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.point)

    def first(self, points: int) -> NDArray[np.int64]:
        """Offsets (points + 1,) of each point's rays."""
        return np.searchsorted(self.point, np.arange(points + 1)).astype(np.int64)

    def with_accepted(self, accepted: NDArray[np.bool_]) -> Rays:
        """The same rays with other decisions about blunders."""
        return replace(self, accepted=accepted)

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Rays:
        """The rays of these rows, which must keep the order by point."""
        return Rays(self.point[rows], self.image[rows], self.observed[rows], self.sigma[rows], self.accepted[rows])


def canonical_order(point: NDArray[np.integer], image: NDArray[np.integer], observed: Array) -> NDArray[np.int64]:
    """Order (r,) of rays by point, then image, then the columns of what was observed (r, c): that of ``lexsort``, which sorts by each."""
    key = (point.astype(np.int64) << 32) | image
    if bool((key[1:] > key[:-1]).all()):
        return np.arange(len(key))
    order = np.argsort(key)
    key = key[order]
    if bool((key[1:] > key[:-1]).all()):
        return order
    return np.lexsort((*observed.T[::-1], image, point))  # a point measured twice in one image


def sorted_rays(point: Index, image: Index, observed: Array, sigma: Array, accepted: NDArray[np.bool_]) -> Rays:
    """Rays in canonical order: by point, then image. The order of arrival leaves no trace in later sums."""
    order = canonical_order(point, image, observed)
    return Rays(
        np.ascontiguousarray(point[order], dtype=np.int32),
        np.ascontiguousarray(image[order], dtype=np.int32),
        np.ascontiguousarray(observed[order], dtype=np.float64),
        np.ascontiguousarray(sigma[order], dtype=np.float64),
        np.ascontiguousarray(accepted[order], dtype=np.bool_),
    )
