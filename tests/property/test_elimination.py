"""Points are eliminated orthogonally: the sums are those of the dense adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from eliminations import (
    EXAMPLES,
    SEEDS,
    Array,
    Network,
    P,
    assert_close,
    dense_design,
    dense_sums,
    eliminated,
    estimated,
    full,
    random_network,
    without_rejected,
)
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.elimination import (
    LinearRays,
    PointFactors,
    eliminate,
    ground_corrections,
    placed,
    point_factors,
    residuals_of,
)
from submin.adjustment.estimation import ImageEstimate, estimate_images
from submin.adjustment.point_basis import by_images


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
