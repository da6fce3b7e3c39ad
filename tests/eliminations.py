"""Small random networks of rays, and the dense adjustment that elimination is compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from hypothesis import Phase, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.elimination import (
    LinearRays,
    Sums,
    eliminate,
)
from submin.adjustment.estimation import ImageEstimate, estimate_images
from submin.adjustment.priors import APriori, ImagePrior, prior_factor
from submin.adjustment.symmetric import fill_symmetric
from submin.sensors import sensor_named

Array = NDArray[np.float64]
RPC = sensor_named("rpc")

P = 6
PIXELS_PER_METRE = 2.0
# a smaller seed is not a simpler network: nothing to shrink
EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
SEEDS = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class Network:
    """A random linear network: rays, their weights, and the a priori factor K of its images."""

    linear: LinearRays
    weight: Array
    prior: Array
    images: int

    @property
    def points(self) -> int:
        return len(self.linear.first) - 1

    @property
    def point(self) -> NDArray[np.int64]:
        return np.repeat(np.arange(self.points), np.diff(self.linear.first))


def camera_rows(rng: np.random.Generator, rays: int) -> Array:
    """Ground partials (r, 2, 3) of rays that look down within 45 degrees: rows perpendicular to each ray."""
    ray = np.column_stack([rng.uniform(-1.0, 1.0, (rays, 2)), np.ones(rays)])
    across = np.cross(ray, [0.0, 1.0, 0.0])
    along = np.cross(ray, across)
    rows = np.stack([across, along], axis=1)
    return np.asarray(PIXELS_PER_METRE * rows / np.linalg.norm(rows, axis=2)[:, :, None])


def random_network(seed: int, points: int = 14, images: int = 5, *, rejected: float = 0.0) -> Network:
    """A network of points with one to all rays, images in correlated blocks and passes."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, images + 1, points)
    counts[:3] = (1, 2, images)
    image = np.concatenate([np.sort(rng.choice(images, c, replace=False)) for c in counts]).astype(np.int32)
    rays = len(image)
    by_parameters = np.zeros((rays, 2, P))
    for c in range(2):
        by_parameters[:, c, 3 * c] = 1.0
        by_parameters[:, c, 3 * c + 1 : 3 * c + 3] = rng.uniform(-1.0, 1.0, (rays, 2))
    by_parameters += 0.01 * rng.normal(size=by_parameters.shape)
    sigma = rng.uniform(0.3, 1.0, (rays, 2))
    model = APriori(10.0, 1.0, 0.4, "exponential", 30.0)
    priors = [ImagePrior(f"b{i // 2}", f"p{i % 2}", 10.0 * i, model, RPC.parameters) for i in range(images)]
    linear = LinearRays(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), image, camera_rows(rng, rays) / sigma[:, :, None],
        by_parameters / sigma[:, :, None], rng.normal(0.0, 20.0, (rays, 2)),
    )  # fmt: skip
    weight = (rng.uniform(size=rays) >= rejected).astype(np.float64)
    return Network(linear, weight, prior_factor(priors, P).toarray(), images)


def dense_design(network: Network) -> tuple[Array, Array, Array]:
    """Whitened design of all image parameters (2r, m p), of all ground coordinates (2r, 3n), and observations (2r,)."""
    linear, root = network.linear, np.sqrt(network.weight)
    rays = len(linear.image)
    a, b = np.zeros((rays, 2, network.images * P)), np.zeros((rays, 2, 3 * network.points))
    for r in range(rays):
        i, j = int(linear.image[r]), int(network.point[r])
        a[r, :, P * i : P * i + P] = root[r] * linear.by_parameters[r]
        b[r, :, 3 * j : 3 * j + 3] = root[r] * linear.by_ground[r]
    return a.reshape(2 * rays, -1), b.reshape(2 * rays, -1), (root[:, None] * linear.y).ravel()


def dense_sums(network: Network) -> tuple[Array, Array, float, int]:
    """``A' (I - QQ') A`` and its kin with one Q for the ground coordinates of all points at once."""
    a, b, y = dense_design(network)
    u, s, _ = np.linalg.svd(b, full_matrices=False)
    q = u[:, s > 1e-10 * s.max()]
    left = a - q @ (q.T @ a)
    free = y - q @ (q.T @ y)
    return left.T @ left, left.T @ free, float(free @ free), int(2 * network.weight.sum()) - q.shape[1]


def eliminated(network: Network) -> Sums:
    return eliminate(network.linear, network.weight, network.images)


def full(sums: Sums) -> Array:
    return fill_symmetric(sums.information.copy())


def estimated(network: Network) -> ImageEstimate:
    return estimate_images(eliminated(network), sp.csr_array(network.prior), P)


def without_rejected(network: Network) -> Network:
    keep = network.weight > 0.0
    linear = network.linear
    counts = np.bincount(network.point[keep], minlength=network.points)
    fewer = LinearRays(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), linear.image[keep], linear.by_ground[keep],
        linear.by_parameters[keep], linear.y[keep],
    )  # fmt: skip
    return replace(network, linear=fewer, weight=network.weight[keep])


def assert_close(found: Array, expected: Array, relative: float = 1e-9) -> None:
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=relative * float(np.abs(expected).max(initial=1e-300)))
