"""Random networks of linear rays that come block by block, and a dense adjustment of them that shares no code with the library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, Sums, eliminate
from submin.adjustment.images import ImageSet
from submin.adjustment.new_rays import NewRays
from submin.adjustment.priors import APriori, ImagePrior, prior_factor
from submin.network.sub_min import SubMin, factor
from submin.sensors import sensor_named

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Index = NDArray[np.int32]
RPC = sensor_named("rpc")
P = 6
MODELS = (
    APriori(10.0, 1.0, 0.4, "gaussian", 20.0),
    APriori(10.0, 1.0, 0.5, "exponential", 60.0),
    APriori(10.0, 1.0, 0.0),
    APriori(10.0, 1.0, 0.9, "fixed", 0.5),
)


@dataclass(frozen=True)
class Network:
    """Rays of a random network, sorted by point; a block is two images, passes go across blocks.

    Attributes
    ----------
    linear : all rays; weight : (r,) 0 for rejected ones
    images : number of images; model : their a priori model
    """

    linear: LinearRays
    weight: Array
    images: int
    model: APriori

    @property
    def points(self) -> int:
        return len(self.linear.first) - 1

    @property
    def blocks(self) -> int:
        return -(-self.images // 2)

    @property
    def point(self) -> NDArray[np.int64]:
        return np.repeat(np.arange(self.points), np.diff(self.linear.first))

    def of_blocks(self, blocks: Sequence[int]) -> Flags:
        """Rays (r,) of the images of some blocks."""
        return np.isin(self.linear.image // 2, blocks)

    def image_set(self, rows: Index) -> ImageSet:
        """Images of these rows; their ids are in another order than their rows."""
        priors = tuple(ImagePrior(f"b{i // 2}", f"p{i % 3}", 11.0 * i, self.model, RPC.parameters) for i in rows)
        ids = tuple(f"image {(7 * i) % 101:03d}" for i in rows)
        return ImageSet(ids, ("rpc",) * len(rows), np.full((len(rows), 94), np.nan), priors, P)

    def sums(self, rays: Flags) -> tuple[Index, Sums]:
        """Summed information of some rays, about the images that have any of them."""
        chosen = taken(self.linear, rays)
        images, image = np.unique(chosen.image, return_inverse=True)
        return images.astype(np.int32), eliminate(replace(chosen, image=image.astype(np.int32)), self.weight[rays], len(images))

    def factored(self, blocks: Sequence[int]) -> SubMin:
        """The sub-MIN of some blocks by one factorisation."""
        images, sums = self.sums(self.of_blocks(blocks))
        return factor(sums, images, self.image_set(images))

    def arrival(self, known: Sequence[int], new: Sequence[int]) -> NewRays:
        """Rays of new blocks, with those that their points have by known ones."""
        coming = self.of_blocks(new)
        seen = np.zeros(self.points, dtype=np.bool_)
        seen[self.point[coming]] = True
        rays = (coming | self.of_blocks(known)) & seen[self.point]
        return NewRays(taken(self.linear, rays), self.weight[rays], coming[rays])

    def rows(self, blocks: Sequence[int]) -> Index:
        """Rows of the images of some blocks that have any rays."""
        return np.unique(self.linear.image[self.of_blocks(blocks)]).astype(np.int32)


def taken(linear: LinearRays, rays: Flags) -> LinearRays:
    """Some of the rays of the same points."""
    point = np.repeat(np.arange(len(linear.first) - 1), np.diff(linear.first))[rays]
    first = np.searchsorted(point, np.arange(len(linear.first))).astype(np.int64)
    return LinearRays(first, linear.image[rays], linear.by_ground[rays], linear.by_parameters[rays], linear.y[rays])


def random_network(seed: int, points: int = 14, images: int = 8, rejected: float = 0.1) -> Network:
    """A random network; points have one to five rays, some of them rejected."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, min(images, 5) + 1, points)
    image = np.concatenate([np.sort(rng.choice(images, c, replace=False)) for c in counts]).astype(np.int32)
    rays = len(image)
    ray = np.column_stack([rng.uniform(-1.0, 1.0, (rays, 2)), np.ones(rays)])
    across = np.cross(ray, [0.0, 1.0, 0.0])
    rows = np.stack([across, np.cross(ray, across)], axis=1)
    by_ground = 2.0 * rows / np.linalg.norm(rows, axis=2)[:, :, None]
    by_parameters = 0.01 * rng.normal(size=(rays, 2, P))
    for c in range(2):
        by_parameters[:, c, 3 * c] += 1.0
        by_parameters[:, c, 3 * c + 1 : 3 * c + 3] += rng.uniform(-1.0, 1.0, (rays, 2))
    sigma = rng.uniform(0.3, 1.0, (rays, 2))
    linear = LinearRays(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), image, by_ground / sigma[:, :, None],
        by_parameters / sigma[:, :, None], rng.normal(0.0, 20.0, (rays, 2)),
    )  # fmt: skip
    return Network(linear, (rng.uniform(size=rays) >= rejected).astype(np.float64), images, MODELS[seed % len(MODELS)])


@dataclass(frozen=True)
class Dense:
    """One adjustment of whitened image vectors and ground coordinates together, by QR of the whole design.

    Attributes
    ----------
    images : rows of the images with rays; theta : (m p,); covariance : (m p, m p)
    points : points with a determined position; where : (n, 3) their corrections; joint : (3n, 3n)
    chi_square, redundancy : at the solution
    """

    images: Index
    theta: Array
    covariance: Array
    points: NDArray[np.int64]
    where: Array
    joint: Array
    chi_square: float
    redundancy: int


def dense_adjustment(network: Network, blocks: Sequence[int]) -> Dense:
    """Adjust the accepted rays of some blocks; points with a single ray take no part."""
    linear, of_point = network.linear, network.point
    images = network.rows(blocks)
    accepted = network.of_blocks(blocks) & (network.weight > 0.0)
    count = np.bincount(of_point[accepted], minlength=network.points)
    points = np.flatnonzero(count >= 2)
    used = np.flatnonzero(accepted & (count >= 2)[of_point])
    k = prior_factor(network.image_set(images).priors, P).toarray()
    q = k.shape[1]
    a, b = np.zeros((len(used), 2, len(images) * P)), np.zeros((len(used), 2, 3 * len(points)))
    for row, r in enumerate(used):
        i, j = int(np.searchsorted(images, linear.image[r])), int(np.searchsorted(points, of_point[r]))
        a[row, :, P * i : P * i + P] = linear.by_parameters[r]
        b[row, :, 3 * j : 3 * j + 3] = linear.by_ground[r]
    by_images, by_ground = a.reshape(2 * len(used), len(images) * P) @ k, b.reshape(2 * len(used), 3 * len(points))
    design = np.block([[by_images, by_ground], [np.eye(q), np.zeros((q, 3 * len(points)))]])
    observed = np.concatenate([linear.y[used].ravel(), np.zeros(q)])
    orthogonal, triangle = np.linalg.qr(design)
    solution, inverse = np.linalg.solve(triangle, orthogonal.T @ observed), np.linalg.inv(triangle)
    covariance = inverse @ inverse.T
    residual = observed - design @ solution
    return Dense(
        images, k @ solution[:q], k @ covariance[:q, :q] @ k.T, points, solution[q:].reshape(-1, 3), covariance[q:, q:],
        float(residual @ residual), 2 * len(used) - 3 * len(points),
    )  # fmt: skip


def assert_close(found: Array, expected: Array, relative: float = 1e-9) -> None:
    """Equal to a part of the largest number expected."""
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=relative * float(np.abs(expected).max(initial=1e-300)))
