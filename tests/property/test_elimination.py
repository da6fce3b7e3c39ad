"""Elimination of points: random networks against one dense adjustment of all unknowns, done here by plain numpy.

The dense side knows nothing of points and rays one by one: it has one design matrix for all image parameters, one for all ground
coordinates, and projects or solves with both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.elimination import (
    LinearRays,
    PointFactors,
    Sums,
    eliminate,
    ground_corrections,
    placed,
    point_factors,
    residuals_of,
)
from submin.adjustment.estimation import ImageEstimate, cholesky, estimate_images, reduced_information
from submin.adjustment.point_basis import by_images
from submin.adjustment.priors import APriori, ImagePrior, prior_factor, prior_variance
from submin.adjustment.symmetric import fill_symmetric
from submin.errors import NumericalError
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


@EXAMPLES
@given(SEEDS)
def test_sums_are_those_of_all_points_projected_out_at_once(seed: int) -> None:
    network = random_network(seed, rejected=0.2)
    sums = eliminated(network)
    information, vector, misclosure, redundancy = dense_sums(network)
    assert_close(full(sums), information)
    assert_close(sums.vector, vector)
    assert sums.misclosure == pytest.approx(misclosure, rel=1e-9)
    assert sums.redundancy == redundancy


def test_only_the_lower_triangle_is_written() -> None:
    assert not np.triu(eliminated(random_network(1)).information, 1).any()


@EXAMPLES
@given(SEEDS)
def test_points_are_where_the_dense_adjustment_of_the_ground_puts_them(seed: int) -> None:
    network = random_network(seed, rejected=0.2)
    factors = point_factors(network.linear, network.weight)
    a, b, y = dense_design(network)
    for j in range(network.points):
        rows = slice(2 * network.linear.first[j], 2 * network.linear.first[j + 1])
        of_point = b[rows, 3 * j : 3 * j + 3]
        assert factors.rank[j] == np.linalg.matrix_rank(of_point, tol=1e-10)
        loading = np.zeros((3, network.images, P))
        for r in range(network.linear.first[j], network.linear.first[j + 1]):
            loading[:, network.linear.image[r]] += factors.loading[r]
        if factors.rank[j] < 3:
            assert np.isnan(factors.own[j]).all()
            assert not factors.offset[j].any() and not loading.any()
            continue
        inverse = np.linalg.pinv(of_point)
        assert_close(factors.own[j], inverse @ inverse.T)
        assert_close(factors.offset[j], inverse @ y[rows])
        assert_close(loading.reshape(3, -1), -inverse @ a[rows])


@EXAMPLES
@given(SEEDS)
def test_images_and_ground_are_those_of_one_adjustment_of_all_unknowns(seed: int) -> None:
    network = without_rejected(random_network(seed, rejected=0.2))
    factors = point_factors(network.linear, network.weight)
    estimate = estimated(network)
    # unknowns: whitened vectors u, and the coordinates of the points that have two rays; a single ray says nothing
    a, b, y = dense_design(network)
    held = np.repeat(np.diff(network.linear.first), np.diff(network.linear.first)) >= 2
    rows, columns = np.repeat(held, 2), np.repeat(np.diff(network.linear.first) >= 2, 3)
    k = network.prior
    design = np.block([[a[rows] @ k, b[np.ix_(rows, columns)]], [np.eye(k.shape[1]), np.zeros((k.shape[1], columns.sum()))]])
    observed = np.concatenate([y[rows], np.zeros(k.shape[1])])
    q, r = np.linalg.qr(design)
    solution, inverse = np.linalg.solve(r, q.T @ observed), np.linalg.inv(r)
    covariance = inverse @ inverse.T
    u, x = np.arange(k.shape[1]), np.arange(k.shape[1], len(r))

    assert_close(estimate.theta.ravel(), k @ solution[u])
    assert_close(estimate.covariance, k @ covariance[np.ix_(u, u)] @ k.T)
    assert_close(ground_corrections(factors, network.linear, estimate.theta).ravel()[columns], solution[x])
    assert_close(joint_covariance(network, factors, estimate)[np.ix_(columns, columns)], covariance[np.ix_(x, x)])
    residual = observed - design @ solution
    assert estimate.chi_square == pytest.approx(float(residual @ residual), rel=1e-9)


def joint_covariance(network: Network, factors: PointFactors, estimate: ImageEstimate) -> Array:
    """``delta_ij D_j + U_i M U_j'``, element by element."""
    loading = np.zeros((network.points, 3, network.images, P))
    for r, j in enumerate(network.point):
        loading[j, :, network.linear.image[r]] += factors.loading[r]
    u = loading.reshape(3 * network.points, -1)
    joint = u @ estimate.covariance @ u.T
    for j in range(network.points):
        joint[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] += factors.own[j]
    return joint


@EXAMPLES
@given(SEEDS, st.integers(1, 5))
def test_any_grouping_of_points_adds_up_to_the_same(seed: int, groups: int) -> None:
    network = random_network(seed, rejected=0.1)
    whole = eliminated(network)
    group = np.random.default_rng(seed).integers(0, groups, network.points)
    parts = [eliminated(points_of(network, group == g)) for g in range(groups)]
    assert_close(sum((part.information for part in parts), np.zeros_like(whole.information)), whole.information, 1e-13)
    assert_close(sum((part.vector for part in parts), np.zeros_like(whole.vector)), whole.vector, 1e-13)
    assert sum(part.misclosure for part in parts) == pytest.approx(whole.misclosure, rel=1e-13)
    assert sum(part.redundancy for part in parts) == whole.redundancy


def points_of(network: Network, chosen: NDArray[np.bool_]) -> Network:
    linear, rays = network.linear, chosen[network.point]
    counts = np.diff(linear.first)[chosen]
    part = LinearRays(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), linear.image[rays], linear.by_ground[rays], linear.by_parameters[rays],
        linear.y[rays],
    )  # fmt: skip
    return replace(network, linear=part, weight=network.weight[rays])


@EXAMPLES
@given(SEEDS)
def test_order_of_a_points_rays_is_free(seed: int) -> None:
    network = random_network(seed)
    order = np.lexsort((np.random.default_rng(seed).uniform(size=len(network.point)), network.point))
    linear = network.linear
    shuffled = replace(
        linear, image=linear.image[order], by_ground=linear.by_ground[order], by_parameters=linear.by_parameters[order], y=linear.y[order]
    )  # fmt: skip
    one, other = eliminated(network), eliminate(shuffled, network.weight[order], network.images)
    assert_close(other.information, one.information, 1e-11)
    assert_close(other.vector, one.vector, 1e-11)


@EXAMPLES
@given(SEEDS)
def test_single_rays_tell_nothing(seed: int) -> None:
    network = random_network(seed)
    single = np.diff(network.linear.first) == 1
    alone = eliminated(points_of(network, single))
    assert not alone.information.any() and not alone.vector.any()
    assert (alone.misclosure, alone.redundancy) == (0.0, 0)
    factors = point_factors(network.linear, network.weight)
    assert (factors.rank[single] == 2).all()


@EXAMPLES
@given(SEEDS)
def test_points_are_placed_where_their_factors_say(seed: int) -> None:
    network = random_network(seed, rejected=0.2)
    theta = np.random.default_rng(seed).normal(0.0, 5.0, (network.images, P))
    factors = point_factors(network.linear, network.weight)
    determined, correction = placed(network.linear, network.weight, theta)
    np.testing.assert_array_equal(determined, factors.rank == 3)
    np.testing.assert_allclose(correction, ground_corrections(factors, network.linear, theta), rtol=1e-9, atol=1e-9)


@EXAMPLES
@given(SEEDS)
def test_points_of_the_same_images_come_together_in_the_order_of_the_first(seed: int) -> None:
    network = random_network(seed, points=60, images=3, rejected=0.2)
    linear, accepted = network.linear, network.weight > 0.0
    seen = [
        tuple(linear.image[s:e][accepted[s:e]].tolist()) for s, e in zip(linear.first[:-1], linear.first[1:], strict=True)
    ]  # fmt: skip
    expected = sorted(range(len(seen)), key=lambda j: seen.index(seen[j]))
    assert by_images(linear.first, linear.image, network.weight).tolist() == expected
    # whatever the images are called
    renamed = np.array([7, 2, 5], dtype=np.int32)[linear.image]
    assert by_images(linear.first, renamed, network.weight).tolist() == expected


@EXAMPLES
@given(SEEDS)
def test_variances_are_the_diagonal_of_the_covariance(seed: int) -> None:
    network = random_network(seed)
    one, other = (
        estimate_images(eliminate(network.linear, network.weight, network.images), sp.csr_array(network.prior), P) for _ in range(2)
    )
    np.testing.assert_allclose(one.variance.ravel(), np.diag(other.covariance), rtol=1e-11)
    np.testing.assert_array_equal(other.variance.ravel(), np.diag(other.covariance))


@EXAMPLES
@given(SEEDS)
def test_rejected_rays_are_as_good_as_absent(seed: int) -> None:
    network = random_network(seed, rejected=0.4)
    fewer = without_rejected(network)
    with_them, without_them = eliminated(network), eliminated(fewer)
    np.testing.assert_array_equal(with_them.information, without_them.information)
    np.testing.assert_array_equal(with_them.vector, without_them.vector)
    assert (with_them.misclosure, with_them.redundancy) == (without_them.misclosure, without_them.redundancy)
    one, other = point_factors(network.linear, network.weight), point_factors(fewer.linear, fewer.weight)
    np.testing.assert_array_equal(one.rank, other.rank)
    np.testing.assert_array_equal(one.offset, other.offset)
    np.testing.assert_array_equal(one.own, other.own)
    np.testing.assert_array_equal(one.loading[network.weight > 0.0], other.loading)
    assert not one.loading[network.weight == 0.0].any()


@EXAMPLES
@given(SEEDS)
def test_weights_are_scaled_sigmas(seed: int) -> None:
    network = random_network(seed)
    weight = np.random.default_rng(seed).uniform(0.05, 3.0, len(network.weight))
    linear, root = network.linear, np.sqrt(weight)[:, None]
    scaled = replace(
        linear, by_ground=linear.by_ground * root[:, :, None], by_parameters=linear.by_parameters * root[:, :, None], y=linear.y * root
    )
    one, other = eliminate(linear, weight, network.images), eliminate(scaled, np.ones(len(weight)), network.images)
    assert_close(one.information, other.information, 1e-12)
    assert_close(one.vector, other.vector, 1e-12)
    assert one.misclosure == pytest.approx(other.misclosure, rel=1e-12)
    first, second = point_factors(linear, weight), point_factors(scaled, np.ones(len(weight)))
    assert_close(first.loading, second.loading, 1e-11)
    assert_close(first.offset, second.offset, 1e-11)


def test_no_points_and_points_without_rays_are_no_trouble() -> None:
    none = LinearRays(np.zeros(1, np.int64), np.empty(0, np.int32), np.empty((0, 2, 3)), np.empty((0, 2, P)), np.empty((0, 2)))
    assert not eliminate(none, np.empty(0), 2).information.any()
    assert point_factors(none, np.empty(0)).offset.shape == (0, 3)
    network = points_of(random_network(4), np.arange(14) < 3)
    first = network.linear.first
    gaps = replace(network.linear, first=np.concatenate([[0, 0], first[1:2], first[1:], first[-1:]]))
    factors, theta = point_factors(gaps, network.weight), np.random.default_rng(0).normal(size=(network.images, P))
    places = [1, 3, 4]
    np.testing.assert_array_equal(factors.rank[[0, 2, 5]], 0)
    found = ground_corrections(factors, gaps, theta)
    np.testing.assert_array_equal(found[[0, 2, 5]], 0.0)
    expected = ground_corrections(point_factors(network.linear, network.weight), network.linear, theta)
    np.testing.assert_array_equal(found[places], expected)


@EXAMPLES
@given(SEEDS)
def test_residuals_are_what_is_left_of_the_observations(seed: int) -> None:
    network = random_network(seed)
    rng = np.random.default_rng(seed)
    theta, x = rng.normal(size=(network.images, P)), rng.normal(size=(network.points, 3))
    a, b, y = dense_design(network)
    assert_close(residuals_of(network.linear, theta, x).ravel(), y - a @ theta.ravel() - b @ x.ravel(), 1e-13)


# Rays that meet at a tiny angle


def weak_network(angle: float) -> Network:
    """Two images and twenty points, each with two rays that meet at ``angle`` radians."""
    rng = np.random.default_rng(12)
    points, images = 20, 2
    ray = np.column_stack([rng.uniform(-0.5, 0.5, (points, 2)), np.ones(points)])
    by_ground = np.empty((points, 2, 2, 3))
    for i in range(2):
        turned = ray + i * angle * np.linalg.norm(ray, axis=1)[:, None] * [1.0, 0.0, 0.0]
        across = np.cross(turned, [0.0, 1.0, 0.0])
        rows = np.stack([across, np.cross(turned, across)], axis=1)
        by_ground[:, i] = PIXELS_PER_METRE * rows / np.linalg.norm(rows, axis=2)[:, :, None]
    by_parameters = np.zeros((points, 2, 2, P))
    for c in range(2):
        by_parameters[:, :, c, 3 * c] = 1.0
        place = rng.uniform(-1.0, 1.0, (points, 1, 2)) + 0.1 * rng.uniform(-1.0, 1.0, (points, 2, 2))
        by_parameters[:, :, c, 3 * c + 1 : 3 * c + 3] = place
    priors = [ImagePrior(f"b{i}", f"p{i}", 0.0, APriori(10.0, 1.0, 0.0), RPC.parameters) for i in range(images)]
    linear = LinearRays(
        np.arange(0, 2 * points + 1, 2), np.tile(np.arange(2, dtype=np.int32), points), by_ground.reshape(-1, 2, 3),
        by_parameters.reshape(-1, 2, P), np.zeros((2 * points, 2)),
    )  # fmt: skip
    return Network(linear, np.ones(2 * points), prior_factor(priors, P).toarray(), images)


def truncated_projector(network: Network, smallest: float) -> Array:
    """``I - QQ'`` with Q that leaves out the directions of each point below ``smallest`` of its largest: what must not be done."""
    _, b, _ = dense_design(network)
    left = np.eye(len(b))
    for j in range(network.points):
        u, s, _ = np.linalg.svd(b[:, 3 * j : 3 * j + 3], full_matrices=False)
        q = u[:, s > smallest * s[0]]
        left -= q @ q.T
    return left


def worst_ratio(network: Network, place_sigma: float, information: Array, by_observation: Array) -> float:
    """``lambda_max(P_rep^-1 P_true)`` of the images' estimate ``theta = M h``, ``h = H y`` with H (m p, 2r), ``M = K (I + K'SK)^-1 K'``.

    Truth: corrections of the a priori covariance, points ``place_sigma`` metres from where they are registered, rays with a sigma of one.
    """
    a, b, _ = dense_design(network)
    k = network.prior
    inverse = np.linalg.inv(np.eye(k.shape[1]) + k.T @ information @ k)
    gain = k @ inverse @ k.T @ by_observation
    by_theta, by_place = gain @ a @ k - k, place_sigma * gain @ b
    true = by_theta @ by_theta.T + by_place @ by_place.T + gain @ gain.T
    reported = k @ inverse @ k.T
    lower = np.linalg.cholesky(reported)
    white = np.linalg.solve(lower, np.linalg.solve(lower, true).T)
    return float(np.linalg.eigvalsh(0.5 * (white + white.T)).max())


def far(angle: float) -> float:
    """Sigma (metres) of a point's place along its rays that moves one image against the other by twenty sigmas, or the Earth's size.

    Tie points have no prior: a place that far away must not matter.
    """
    return min(10.0 / angle, 1e7)


@pytest.mark.parametrize("angle", [1e-1, 1e-3, 1e-5, 1e-7, 1e-9, 1e-11])
def test_rays_that_meet_at_a_tiny_angle_stay_consistent(angle: float) -> None:
    network = weak_network(angle)
    linear = network.linear
    observations = linear.y.size
    by_observation = np.empty((network.images * P, observations))
    for k in range(observations):
        unit = np.zeros(observations)
        unit[k] = 1.0
        by_observation[:, k] = eliminate(replace(linear, y=unit.reshape(-1, 2)), network.weight, network.images).vector
    assert (point_factors(linear, network.weight).rank == 3).all()
    assert worst_ratio(network, far(angle), full(eliminated(network)), by_observation) <= 1.0 + 1e-6


def joined(parts: list[Network]) -> Network:
    """Networks of the same images together; the second ray of every fifth point is rejected, so that the point is pending."""
    by_ground, by_parameters, y, image = (
        np.concatenate([getattr(part.linear, name) for part in parts]) for name in ("by_ground", "by_parameters", "y", "image")
    )
    weight = np.ones(len(image))
    weight[1::10] = 0.0
    return Network(LinearRays(np.arange(0, len(image) + 1, 2), image, by_ground, by_parameters, y), weight, parts[0].prior, parts[0].images)


@pytest.mark.parametrize("angle", [1e-7, 1e-9])
def test_tiny_angles_stay_consistent_among_pending_undetermined_and_sound_points(angle: float) -> None:
    network = joined([weak_network(angle), weak_network(0.0), weak_network(0.3)])
    linear = network.linear
    by_observation = np.empty((network.images * P, linear.y.size))
    for k in range(linear.y.size):
        unit = np.zeros(linear.y.size)
        unit[k] = 1.0
        by_observation[:, k] = eliminate(replace(linear, y=unit.reshape(-1, 2)), network.weight, network.images).vector
    rank = point_factors(linear, network.weight).rank
    assert np.bincount(rank, minlength=4).tolist() == [0, 0, 12 + 16, 32]  # single rays and parallel ones; the others
    assert worst_ratio(network, far(angle), full(eliminated(network)), by_observation) <= 1.0 + 1e-6


@pytest.mark.parametrize("angle", [1e-3, 1e-5])
def test_truncating_the_weak_direction_would_not_be_consistent(angle: float) -> None:
    network = weak_network(angle)
    a, _, _ = dense_design(network)
    truncated, kept = truncated_projector(network, 100.0 * angle), truncated_projector(network, 1e-13)
    assert worst_ratio(network, far(angle), a.T @ truncated @ a, a.T @ truncated) > 2.0
    assert worst_ratio(network, far(angle), a.T @ kept @ a, a.T @ kept) <= 1.0 + 1e-6


def test_parallel_rays_leave_the_point_open_and_are_not_divided_by_nothing() -> None:
    network = weak_network(0.0)
    factors = point_factors(network.linear, network.weight)
    sums = eliminated(network)
    assert (factors.rank == 2).all() and np.isnan(factors.own).all()
    assert np.isfinite(sums.information).all()
    assert sums.redundancy == 2 * network.points


# From sums to estimates


@EXAMPLES
@given(SEEDS)
def test_chi_square_is_the_dense_sum_of_weighted_squares(seed: int) -> None:
    network = random_network(seed)
    estimate = estimated(network)
    a, b, y = dense_design(network)
    u = np.linalg.pinv(network.prior) @ estimate.theta.ravel()
    left = y - a @ estimate.theta.ravel()
    residual = left - b @ np.linalg.lstsq(b, left, rcond=1e-10)[0]
    # of all u that give this theta the shortest is the estimate
    assert estimate.chi_square == pytest.approx(float(residual @ residual + u @ u), rel=1e-9)


def test_chi_square_is_the_redundancy_on_the_average_and_theta_as_good_as_it_says() -> None:
    network = random_network(77, points=25, images=4)
    rng = np.random.default_rng(5)
    a, b, _ = dense_design(network)
    runs, squares, errors = 400, [], []
    for _ in range(runs):
        theta = network.prior @ rng.normal(size=network.prior.shape[1])
        y = a @ theta + b @ rng.normal(0.0, 50.0, b.shape[1]) + rng.normal(size=len(a))
        estimate = estimated(replace(network, linear=replace(network.linear, y=y.reshape(-1, 2))))
        squares.append(estimate.chi_square)
        errors.append(estimate.theta.ravel() - theta)
    redundancy = eliminated(network).redundancy
    assert redundancy > 40
    assert abs(np.mean(squares) - redundancy) < 4.0 * np.sqrt(2.0 * redundancy / runs)
    assert np.var(squares) == pytest.approx(2.0 * redundancy, rel=4.0 * np.sqrt(2.0 / runs) * 1.5)
    m = estimated(network).covariance
    nees = np.einsum("ri,ij,rj->r", errors, np.linalg.inv(m), errors)
    assert abs(nees.mean() - len(m)) < 4.0 * np.sqrt(2.0 * len(m) / runs)


@pytest.mark.parametrize("points", [30, 300, 3000])
def test_covariance_is_the_plain_inverse_however_much_is_known(points: int) -> None:
    network = random_network(5, points=points, images=8)
    k, found = network.prior, estimated(network).covariance
    lower = np.linalg.cholesky(k @ np.linalg.inv(np.eye(k.shape[1]) + k.T @ full(eliminated(network)) @ k) @ k.T)
    # whitened, so that the best known combination of images counts as much as the worst known; both triangles
    np.testing.assert_allclose(np.linalg.solve(lower, np.linalg.solve(lower, found).T), np.eye(len(lower)), rtol=0.0, atol=1e-9)


def test_without_rays_the_estimate_is_the_prior() -> None:
    network = random_network(3)
    prior = sp.csr_array(network.prior)
    size = network.images * P
    estimate = estimate_images(Sums(np.zeros((size, size)), np.zeros(size), 0.0, 0), prior, P)
    assert not estimate.theta.any() and estimate.chi_square == 0.0
    assert_close(estimate.covariance, network.prior @ network.prior.T, 1e-12)
    np.testing.assert_allclose(prior_variance(prior, P).ravel(), np.diag(network.prior @ network.prior.T), rtol=1e-12)


def test_reduced_information_is_symmetric_and_written_out() -> None:
    network = random_network(6)
    sums = eliminated(network)
    before = sums.information.copy()
    k = network.prior
    assert_close(reduced_information(sums.information, sp.csr_array(k)), np.eye(k.shape[1]) + k.T @ full(sums) @ k, 1e-12)
    np.testing.assert_array_equal(sums.information, before)


@pytest.mark.parametrize("size", [0, 1, 5, 256, 257, 700])
def test_filled_triangle_is_symmetric(size: int) -> None:
    # LAPACK leaves the other triangle undefined: it may hold anything
    matrix = np.random.default_rng(size).normal(size=(size, size)) + np.triu(np.full((size, size), 1e9), 1)
    expected = np.tril(matrix) + np.tril(matrix, -1).T
    np.testing.assert_array_equal(fill_symmetric(matrix.copy()), expected)


@pytest.mark.parametrize("damage", [-1.0, np.nan])
def test_damaged_sums_are_not_factored(damage: float) -> None:
    matrix = np.diag([1.0, 2.0, damage, 3.0])
    with pytest.raises(NumericalError, match=r"information matrix \(4 parameters\)"):
        cholesky(matrix)
