"""Approximate positions of points from all their rays, unadjusted cameras: the registration of the network (docs/mathematics.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays
from submin.geodesy import geodetic_to_geocentric, local_axes

Array = NDArray[np.float64]

HEIGHT_SIGMA = 2000.0
"""Metres. A hold on the mean height, loose enough not to matter where rays converge, that keeps parallel rays from running away."""
ITERATIONS = 8


@dataclass(frozen=True)
class Intersection:
    """Approximate positions.

    Attributes
    ----------
    geocentric : (n, 3), metres; NaN where a point's camera does not reach the ground
    misfit : (r,) metres by which each ray passes its point, unadjusted cameras
    """

    geocentric: Array
    misfit: Array


def intersect(images: ImageSet, rays: Rays, points: int) -> Intersection:
    """Intersect the rays of each of ``points`` points; a single ray is cut at its camera's mean height.

    Every point must have at least one ray. Rays that were rejected count too: registration comes before any judgement.
    """
    first = rays.first(points)
    start = images.localise(rays.image[first[:-1]], rays.observed[first[:-1]])
    ground = geodetic_to_geocentric(start, images.ellipsoid)
    reached = np.isfinite(ground).all(axis=1)
    ground[~reached] = ground[reached][0] if reached.any() else np.array([images.ellipsoid.semimajor_axis, 0.0, 0.0])
    up = local_axes(start)[:, 2]
    up[~reached] = 0.0
    held = ground.copy()
    hold = np.einsum("ni,nj->nij", up, up) / HEIGHT_SIGMA**2
    theta = np.zeros((len(images), images.parameters))
    misfit = np.zeros(len(rays))
    moving = reached.copy()
    for _ in range(ITERATIONS):
        projection = images.project(theta, images.ground(ground), rays.image, rays.point)
        b = projection.by_ground / rays.sigma[:, :, None]
        v = (rays.observed - projection.image) / rays.sigma
        normal = np.add.reduceat(np.einsum("rci,rcj->rij", b, b), first[:-1], axis=0) + hold
        right = np.add.reduceat(np.einsum("rci,rc->ri", b, v), first[:-1], axis=0)
        right += np.einsum("nij,nj->ni", hold, held - ground)
        # one pixel-sized ridge keeps the normal matrix of a point without any usable ray regular
        normal[~reached] = np.eye(3)
        right[~reached] = 0.0
        step = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        step[~(np.isfinite(step).all(axis=1) & moving)] = 0.0  # each point stops by itself: its company must not matter
        ground = ground + step
        pixel = np.linalg.norm(projection.by_ground, axis=(1, 2)) / np.sqrt(2.0)
        misfit = np.linalg.norm(rays.observed - projection.image, axis=1) / pixel
        moving &= np.abs(step).max(axis=1) >= 1e-3
        if not moving.any():
            break
    ground[~reached] = np.nan
    return Intersection(ground, misfit)
