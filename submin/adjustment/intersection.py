"""Approximate positions of points from all their rays, unadjusted cameras: the registration of the network (docs/mathematics.md)."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays
from submin.geodesy import geodetic_to_geocentric, local_axes

Array = NDArray[np.float64]
Offsets = NDArray[np.int64]

HEIGHT_SIGMA = 2000.0
"""Metres. A hold on the mean height, loose enough not to matter where rays converge, that keeps parallel rays from running away."""
ITERATIONS = 8
SETTLED_METRES = 1e-3


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _steps(first: Offsets, image: Array, by_ground: Array, observed: Array, sigma: Array, hold: Array, back: Array) -> Array:
    """Gauss-Newton steps (n, 3) of points from their rays, held along ``hold`` (n, 3) at ``back`` (n, 3): a 3 x 3 Cholesky solve each."""
    points = len(first) - 1
    step, a, x = np.empty((points, 3)), np.empty((3, 3)), np.empty(3)
    for j in range(points):
        pull = hold[j, 0] * back[j, 0] + hold[j, 1] * back[j, 1] + hold[j, 2] * back[j, 2]
        for k in range(3):
            x[k] = hold[j, k] * pull
            for m in range(k + 1):
                a[k, m] = hold[j, k] * hold[j, m]
        for i in range(first[j], first[j + 1]):
            if not (np.isfinite(image[i, 0]) and np.isfinite(image[i, 1])):  # the camera does not see the point where it is now
                continue
            for c in range(2):
                weight = 1.0 / (sigma[i, c] * sigma[i, c])
                residual = weight * (observed[i, c] - image[i, c])
                for k in range(3):
                    x[k] += by_ground[i, c, k] * residual
                    for m in range(k + 1):
                        a[k, m] += weight * by_ground[i, c, k] * by_ground[i, c, m]
        for k in range(3):
            for m in range(k + 1):
                for e in range(m):
                    a[k, m] -= a[k, e] * a[m, e]
                a[k, m] = np.sqrt(a[k, k]) if m == k else a[k, m] / a[m, m]
        for k in range(3):
            for e in range(k):
                x[k] -= a[k, e] * x[e]
            x[k] /= a[k, k]
        for k in range(2, -1, -1):
            for e in range(k + 1, 3):
                x[k] -= a[e, k] * x[e]
            x[k] /= a[k, k]
            step[j, k] = x[k]
    return step


def _cut(images: ImageSet, rays: Rays, first: Offsets) -> Array:
    """Where the first ray of each point that reaches the ground meets its camera's mean height, geodetic (n, 3); NaN where none does."""
    start = images.localise(rays.image[first[:-1]], rays.observed[first[:-1]])
    lost = np.asarray(~np.isfinite(start).all(axis=1))
    if lost.any():
        row = np.flatnonzero(lost[rays.point])
        place = images.localise(rays.image[row], rays.observed[row])
        reached = np.isfinite(place).all(axis=1)
        point, at = np.unique(rays.point[row[reached]], return_index=True)
        start[point] = place[reached][at]
    return start


def intersect(images: ImageSet, rays: Rays, points: int) -> Array:
    """Where the rays of each of ``points`` points meet, geocentric (n, 3), metres; NaN where no camera of a point reaches the ground.

    A single ray is cut at its camera's mean height.

    Every point must have at least one ray. Rays that were rejected count too: registration comes before any judgement.
    """
    first = rays.first(points)
    start = _cut(images, rays, first)
    ground = geodetic_to_geocentric(start, images.ellipsoid)
    reached = np.isfinite(ground).all(axis=1)
    ground[~reached] = ground[reached][0] if reached.any() else np.array([images.ellipsoid.semimajor_axis, 0.0, 0.0])
    up = local_axes(start)[:, 2]
    up[~reached] = 0.0
    held = ground.copy()
    theta = np.zeros((len(images), images.parameters))
    moving, before = reached.copy(), np.zeros(points)
    for _ in range(ITERATIONS):
        projection = images.project(theta, images.ground(ground), rays.image, rays.point)
        step = _steps(first, projection.image, projection.by_ground, rays.observed, rays.sigma, up / HEIGHT_SIGMA, held - ground)
        step[~(np.isfinite(step).all(axis=1) & moving)] = 0.0  # each point stops by itself: its company must not matter
        ground = ground + step
        length = np.abs(step).max(axis=1)
        # steps are expected to shrink as the last one has: where the next one would be short it is not made
        shrinks = np.where(length < before, length / np.maximum(before, SETTLED_METRES), 1.0)
        moving &= length * shrinks >= SETTLED_METRES
        before = length
        if not moving.any():
            break
    ground[~reached] = np.nan
    return ground


def blind_image(images: ImageSet, rays: Rays) -> tuple[int, int] | None:
    """An image none of whose rays reaches the ground at its camera's mean height, and the first point that it measures; None without any.

    Almost always the first ray of each image tells.
    """
    seen, at = np.unique(rays.image, return_index=True)
    for image, first in zip(seen.tolist(), at.tolist(), strict=True):
        rows = np.flatnonzero(rays.image == image) if _blind(images, rays, np.array([first])) else np.array([first])
        if _blind(images, rays, rows):
            return image, int(rays.point[first])
    return None


def _blind(images: ImageSet, rays: Rays, rows: NDArray[np.int64]) -> bool:
    return not bool(np.isfinite(images.localise(rays.image[rows], rays.observed[rows])).all(axis=1).any())
