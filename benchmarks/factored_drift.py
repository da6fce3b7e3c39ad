"""Many blocks fused one after another by low-rank updates: how far round-off takes them from one simultaneous solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, eliminate
from submin.adjustment.images import ImageSet
from submin.adjustment.new_rays import NewRays
from submin.adjustment.priors import APriori, ImagePrior
from submin.network.low_rank import update
from submin.network.sub_min import SubMin, factor
from submin.sensors import sensor_named

Array = NDArray[np.float64]
SHIFT = tuple(parameter for parameter in sensor_named("rpc").parameters if parameter.group == "bias")
MODEL = APriori(10.0, 1.0, 0.5)
RAYS = 30
"""Points that a block sees."""
IMAGES_A_PASS = 10


@dataclass(frozen=True)
class Drift:
    """Differences between blocks one after another and all at once.

    Attributes
    ----------
    theta, covariance : largest difference over the largest number, corrections and their covariance in units of their sigmas
    chi_square : relative difference
    definite : steps after which the covariance had a Cholesky factor; steps : all
    symmetric : True when the covariance was symmetric to the last bit after every step
    """

    theta: float
    covariance: float
    chi_square: float
    definite: int
    steps: int
    symmetric: bool


def rays_of_blocks(blocks: int, points: int, seed: int = 0) -> tuple[LinearRays, ImageSet]:
    """Rays of so many blocks of one image each over so many points, sorted by point; all simulated."""
    rng = np.random.default_rng(seed)
    seen = np.stack([rng.permutation(points)[: min(RAYS, points)] for _ in range(blocks)])
    image, point = np.repeat(np.arange(blocks), seen.shape[1]), seen.ravel()
    order = np.lexsort((image, point))
    image, point = image[order], point[order]
    rays = len(point)
    direction = np.column_stack([rng.uniform(-0.5, 0.5, (blocks, 2)), np.ones(blocks)])[image] + 0.02 * rng.normal(size=(rays, 3))
    across = np.cross(direction, [0.0, 1.0, 0.0])
    by_ground = np.stack([across, np.cross(direction, across)], axis=1)
    by_ground /= np.linalg.norm(by_ground, axis=2)[:, :, None]
    by_parameters = np.tile(np.eye(2), (rays, 1, 1))
    theta, place = rng.normal(0.0, MODEL.bias_px, (blocks, 2)), rng.normal(0.0, 30.0, (points, 3))
    y = theta[image] + np.einsum("rck,rk->rc", by_ground, place[point]) + rng.normal(0.0, 0.5, (rays, 2))
    linear = LinearRays(
        np.searchsorted(point, np.arange(points + 1)).astype(np.int64),
        image.astype(np.int32),
        by_ground / 0.5,
        by_parameters / 0.5,
        y / 0.5,
    )
    priors = tuple(ImagePrior(f"b{k}", f"p{k // IMAGES_A_PASS}", 0.0, MODEL, SHIFT) for k in range(blocks))
    ids = tuple(f"image {k:04d}" for k in range(blocks))
    return linear, ImageSet(ids, ("rpc",) * blocks, np.full((blocks, 1), np.nan), priors, len(SHIFT))


def drift(blocks: int, points: int, seed: int = 0) -> Drift:
    """Fuse blocks one after another, in random order, and compare with all at once."""
    linear, image_set = rays_of_blocks(blocks, points, seed)
    p = image_set.parameters
    point = np.repeat(np.arange(points), np.diff(linear.first))
    state = SubMin(np.empty(0, np.int32), np.empty((0, p)), np.empty((0, 0)), 0.0, 0)
    known = np.zeros(blocks, dtype=np.bool_)
    definite, symmetric = 0, True
    for block in np.random.default_rng(seed + 1).permutation(blocks):
        coming = linear.image == block
        touched = np.zeros(points, dtype=np.bool_)
        touched[point[coming]] = True
        chosen = touched[point] & (coming | known[linear.image])
        of_points = LinearRays(
            np.searchsorted(point[chosen], np.arange(points + 1)).astype(np.int64), linear.image[chosen], linear.by_ground[chosen],
            linear.by_parameters[chosen], linear.y[chosen],
        )  # fmt: skip
        known[block] = True
        images = np.flatnonzero(known).astype(np.int32)
        fused = update(state, NewRays(of_points, np.ones(int(chosen.sum())), coming[chosen]), images, image_set.take(images))
        if fused is None:
            raise AssertionError("the a priori model of the benchmark is regular")
        state = fused.sub_min
        symmetric = symmetric and bool((state.covariance == state.covariance.T).all())
        _, info = la.lapack.dpotrf(state.covariance, lower=1)
        definite += info == 0
    whole = factor(eliminate(linear, np.ones(len(point)), blocks), np.arange(blocks, dtype=np.int32), image_set)
    sigma = np.sqrt(np.diagonal(whole.covariance))
    in_sigmas = whole.theta.ravel() / sigma
    theta = float(np.abs(state.theta.ravel() / sigma - in_sigmas).max() / np.abs(in_sigmas).max())
    covariance = float(np.abs((state.covariance - whole.covariance) / sigma / sigma[:, None]).max())
    return Drift(theta, covariance, abs(state.chi_square / whole.chi_square - 1.0), definite, blocks, symmetric)
