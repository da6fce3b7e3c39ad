"""Sub-MINs: cells of a random network, added up and factored, against one dense adjustment of everything by plain numpy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, Sums, eliminate, point_factors
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori, ImagePrior, prior_factor
from submin.network import sub_min as module
from submin.network.sub_min import GroundPart, SubMin, add_sums, covariances_of, factor, joint_covariance, loadings, locate, marginal
from submin.sensors import sensor_named

Array = NDArray[np.float64]
RPC = sensor_named("rpc")
Index = NDArray[np.int32]

P = 6
# a smaller seed is not a simpler network: nothing to shrink
EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
SEEDS = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class RayTable:
    """Rays of a random network, one row a ray, sorted by point; every point has two or more."""

    point: NDArray[np.int64]
    image: Index
    by_ground: Array
    by_parameters: Array
    y: Array
    origin: Array
    images: int

    @property
    def points(self) -> int:
        return len(self.origin)


def random_rays(seed: int, points: int = 15, images: int = 6) -> RayTable:
    rng = np.random.default_rng(seed)
    counts = rng.integers(2, min(images, 5) + 1, points)
    image = np.concatenate([np.sort(rng.choice(images, c, replace=False)) for c in counts]).astype(np.int32)
    rays = len(image)
    by_parameters = 0.01 * rng.normal(size=(rays, 2, P))
    for c in range(2):
        by_parameters[:, c, 3 * c] += 2.0
        by_parameters[:, c, 3 * c + 1 : 3 * c + 3] += rng.uniform(-2.0, 2.0, (rays, 2))
    down = np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    return RayTable(
        np.repeat(np.arange(points), counts), image, down + rng.normal(0.0, 1.5, (rays, 2, 3)), by_parameters,
        rng.normal(0.0, 20.0, (rays, 2)), rng.uniform(-1e3, 1e3, (points, 3)) + np.array([4e6, 1e6, 5e6]), images,
    )  # fmt: skip


def image_set(rows: Index) -> ImageSet:
    """Images of these rows of the network: blocks of two, passes across blocks, correlated in time. Their cameras do not matter here."""
    priors = tuple(ImagePrior(f"b{i // 2}", f"p{i % 3}", 11.0 * i, APriori(10.0, 1.0, 0.4, "gaussian", 20.0), RPC.parameters) for i in rows)
    return ImageSet(tuple(f"image {i}" for i in rows), ("rpc",) * len(rows), np.full((len(rows), 94), np.nan), priors, P)


def part_of(rays: RayTable, chosen: NDArray[np.bool_]) -> tuple[tuple[Index, Sums], GroundPart]:
    """A cell of some points: its images (rows of the network) with its sums, and its ground."""
    own = chosen[rays.point]
    counts = np.bincount(rays.point[own], minlength=rays.points)[chosen]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    linear = LinearRays(first, rays.image[own], rays.by_ground[own], rays.by_parameters[own], rays.y[own])
    images, local = np.unique(rays.image[own], return_inverse=True)
    weight = np.ones(int(own.sum()))
    sums = eliminate(replace(linear, image=local.astype(np.int32)), weight, len(images))
    return (images.astype(np.int32), sums), GroundPart(rays.origin[chosen], linear, point_factors(linear, weight))


def cells(rays: RayTable, cell_of_point: NDArray[np.integer]) -> tuple[list[tuple[Index, Sums]], list[GroundPart], NDArray[np.int64]]:
    """Cells, their ground, and the points in the order in which the cells hold them."""
    numbers = np.unique(cell_of_point)
    parts = [part_of(rays, cell_of_point == number) for number in numbers]
    order = np.concatenate([np.flatnonzero(cell_of_point == number) for number in numbers])
    return [sums for sums, _ in parts], [ground for _, ground in parts], order


def sub_min_of(sums: list[tuple[Index, Sums]], weights: list[float] | None = None) -> SubMin:
    rows = np.unique(np.concatenate([images for images, _ in sums])).astype(np.int32)
    return factor(add_sums(sums, rows, P, weights), rows, image_set(rows))


def answer(rays: RayTable, cell_of_point: NDArray[np.integer]) -> tuple[SubMin, Array, Array]:
    """Sub-MIN of cells, and coordinates (n, 3) and joint covariance (3n, 3n) of all their points in the order of the ray table."""
    sums, parts, order = cells(rays, cell_of_point)
    sub_min = sub_min_of(sums)
    back = np.argsort(order)
    joint = joint_covariance(loadings(parts, sub_min.images, P), np.concatenate([p.factors.own for p in parts]), sub_min.covariance)
    where = np.concatenate([locate(p, sub_min) for p in parts])
    rows = (3 * back[:, None] + np.arange(3)).ravel()
    return sub_min, where[back], joint[np.ix_(rows, rows)]


def dense_adjustment(rays: RayTable, scale: Array | None = None) -> tuple[Array, Array, Array, Array, float]:
    """theta, M, coordinates, joint covariance and chi-square of one adjustment of whitened vectors and ground coordinates together.

    ``scale`` (r,) multiplies the weights of rays.
    """
    k = prior_factor(image_set(np.arange(rays.images, dtype=np.int32)).priors, P).toarray()
    count, q = len(rays.point), k.shape[1]
    root = np.ones(count) if scale is None else np.sqrt(scale)
    a, b = np.zeros((count, 2, rays.images * P)), np.zeros((count, 2, 3 * rays.points))
    for r in range(count):
        i, j = int(rays.image[r]), int(rays.point[r])
        a[r, :, P * i : P * i + P] = root[r] * rays.by_parameters[r]
        b[r, :, 3 * j : 3 * j + 3] = root[r] * rays.by_ground[r]
    design = np.block([[a.reshape(2 * count, -1) @ k, b.reshape(2 * count, -1)], [np.eye(q), np.zeros((q, 3 * rays.points))]])
    observed = np.concatenate([(root[:, None] * rays.y).ravel(), np.zeros(q)])
    orthogonal, triangle = np.linalg.qr(design)
    solution, inverse = np.linalg.solve(triangle, orthogonal.T @ observed), np.linalg.inv(triangle)
    covariance = inverse @ inverse.T
    residual = observed - design @ solution
    where = rays.origin + solution[q:].reshape(-1, 3)
    return k @ solution[:q], k @ covariance[:q, :q] @ k.T, where, covariance[q:, q:], float(residual @ residual)


def assert_close(found: Array, expected: Array, relative: float = 1e-9) -> None:
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=relative * float(np.abs(expected).max()))


@EXAMPLES
@given(SEEDS, st.integers(1, 6))
def test_cells_together_are_the_dense_adjustment(seed: int, number_of_cells: int) -> None:
    rays = random_rays(seed)
    sub_min, where, joint = answer(rays, np.random.default_rng(seed).integers(0, number_of_cells, rays.points))
    theta, m, expected_where, expected_joint, chi_square = dense_adjustment(rays)
    seen = (sub_min.images[:, None] * P + np.arange(P)).ravel()
    assert_close(sub_min.theta.ravel(), theta[seen])
    assert_close(sub_min.covariance, m[np.ix_(seen, seen)])
    assert_close(where - rays.origin, expected_where - rays.origin)
    assert_close(joint, expected_joint)
    assert sub_min.chi_square == pytest.approx(chi_square, rel=1e-9)
    assert sub_min.redundancy == 2 * len(rays.point) - 3 * rays.points


@EXAMPLES
@given(SEEDS)
def test_joint_covariance_is_sound_for_all_points_together(seed: int) -> None:
    rays = random_rays(seed)
    _, _, joint = answer(rays, np.zeros(rays.points, dtype=np.int64))
    _, _, _, expected, _ = dense_adjustment(rays)
    lower = np.linalg.cholesky(expected)
    np.testing.assert_array_equal(joint, joint.T)
    # whitened: no combination of points, however well known, is better or worse than in truth
    np.testing.assert_allclose(np.linalg.solve(lower, np.linalg.solve(lower, joint).T), np.eye(len(joint)), rtol=0.0, atol=1e-9)


@EXAMPLES
@given(SEEDS)
def test_some_cells_are_the_adjustment_of_their_rays_alone(seed: int) -> None:
    rays = random_rays(seed)
    held = np.random.default_rng(seed).uniform(size=rays.points) < 0.5
    held[0] = True
    place = np.cumsum(held) - 1
    mine = held[rays.point]
    alone = RayTable(
        place[rays.point[mine]], rays.image[mine], rays.by_ground[mine], rays.by_parameters[mine], rays.y[mine],
        rays.origin[held], rays.images,
    )  # fmt: skip
    sums, ground = part_of(rays, held)
    sub_min = sub_min_of([sums])
    theta, m, where, joint, _ = dense_adjustment(alone)
    seen = (sub_min.images[:, None] * P + np.arange(P)).ravel()
    # images that the tile does not see are left out, and their prior with them: nothing changes for the others
    assert_close(sub_min.theta.ravel(), theta[seen])
    assert_close(sub_min.covariance, m[np.ix_(seen, seen)])
    assert_close(locate(ground, sub_min) - rays.origin[held], where - rays.origin[held])
    assert_close(joint_covariance(loadings([ground], sub_min.images, P), ground.factors.own, sub_min.covariance), joint)


@EXAMPLES
@given(SEEDS)
def test_weighted_cells_are_rays_of_scaled_weight(seed: int) -> None:
    rays = random_rays(seed)
    cell = np.random.default_rng(seed).integers(0, 2, rays.points)
    cell[:2] = (0, 1)
    sums, _, _ = cells(rays, cell)
    weights = [0.3, 0.7]
    sub_min = sub_min_of(sums, weights)
    theta, m, _, _, chi_square = dense_adjustment(rays, np.array(weights)[cell[rays.point]])
    seen = (sub_min.images[:, None] * P + np.arange(P)).ravel()
    assert_close(sub_min.theta.ravel(), theta[seen])
    assert_close(sub_min.covariance, m[np.ix_(seen, seen)])
    assert sub_min.chi_square == pytest.approx(chi_square, rel=1e-9)


@EXAMPLES
@given(SEEDS)
def test_order_of_cells_is_free(seed: int) -> None:
    rays = random_rays(seed)
    sums, _, _ = cells(rays, np.arange(rays.points) % 5)
    one, other = sub_min_of(sums), sub_min_of(sums[::-1])
    assert_close(one.theta, other.theta, 1e-12)
    assert_close(one.covariance, other.covariance, 1e-12)


def test_sums_land_on_the_rows_of_their_own_images() -> None:
    one = Sums(np.tril(np.full((2 * P, 2 * P), 1.0)), np.full(2 * P, 2.0), 3.0, 4)
    other = Sums(np.tril(np.full((P, P), 10.0)), np.full(P, 20.0), 30.0, 40)
    total = add_sums([(np.array([3, 9], np.int32), one), (np.array([7], np.int32), other)], np.array([3, 7, 9], np.int32), P)
    block = total.information.reshape(3, P, 3, P)
    np.testing.assert_array_equal(block[:, P - 1, :, 0], [[1.0, 0.0, 0.0], [0.0, 10.0, 0.0], [1.0, 0.0, 1.0]])
    assert not np.triu(total.information, 1).any()
    np.testing.assert_array_equal(total.vector, np.repeat([2.0, 20.0, 2.0], P))
    assert (total.misclosure, total.redundancy) == (33.0, 44)


@pytest.mark.parametrize("dense_columns", [0, 600], ids=["sparse", "dense"])
def test_both_products_give_the_same_joint_covariance(monkeypatch: pytest.MonkeyPatch, dense_columns: int) -> None:
    monkeypatch.setattr(module, "DENSE_COLUMNS", dense_columns)
    rays = random_rays(2, points=40, images=9)
    _, _, joint = answer(rays, np.arange(rays.points) % 3)
    assert_close(joint, dense_adjustment(rays)[3])
    np.testing.assert_array_equal(joint, joint.T)


def test_point_covariances_are_the_blocks_of_the_joint_one() -> None:
    rays = random_rays(6, points=3000)
    sums, ground = part_of(rays, np.ones(rays.points, dtype=np.bool_))
    sub_min = sub_min_of([sums])
    loading = loadings([ground], sub_min.images, P)
    blocks = covariances_of(ground, sub_min)
    np.testing.assert_array_equal(blocks, np.swapaxes(blocks, 1, 2))
    for start in (0, 2040, 2990):
        rows = slice(3 * start, 3 * start + 30)
        joint = joint_covariance(loading[rows], ground.factors.own[start : start + 10], sub_min.covariance)
        for k in range(10):
            assert_close(blocks[start + k], joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], 1e-12)


def test_a_marginal_is_that_of_the_images_that_are_there() -> None:
    rays = random_rays(6)
    sums, _ = part_of(rays, np.ones(rays.points, dtype=np.bool_))
    whole = sub_min_of([sums])
    part = marginal(whole, np.array([*whole.images[1:3], whole.images[-1] + 7], dtype=np.int32))
    np.testing.assert_array_equal(part.images, whole.images[1:3])
    np.testing.assert_array_equal(part.theta, whole.theta[1:3])
    np.testing.assert_array_equal(part.covariance, whole.covariance[P : 3 * P, P : 3 * P])
    assert marginal(whole, whole.images) is whole


def test_a_query_of_some_points_is_the_marginal_of_all() -> None:
    rays = random_rays(8)
    _, _, joint = answer(rays, np.zeros(rays.points, dtype=np.int64))
    sums, ground = part_of(rays, np.ones(rays.points, dtype=np.bool_))
    sub_min = sub_min_of([sums])
    chosen = np.array([1, 4, 11])
    rows = (3 * chosen[:, None] + np.arange(3)).ravel()
    loading = loadings([ground], sub_min.images, P)
    part = joint_covariance(sp.csr_array(loading[rows]), ground.factors.own[chosen], sub_min.covariance)
    assert_close(part, joint[np.ix_(rows, rows)], 1e-12)


def test_no_parts_have_no_loadings() -> None:
    assert loadings([], np.array([2, 5], np.int32), P).shape == (0, 2 * P)
