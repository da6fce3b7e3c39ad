"""From the sums of a network to its images, covariance and chi-square."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from eliminations import EXAMPLES, SEEDS, P, assert_close, dense_design, eliminated, estimated, full, random_network
from hypothesis import given

from submin.adjustment.elimination import (
    Sums,
)
from submin.adjustment.estimation import cholesky, estimate_images, reduced_information
from submin.adjustment.priors import prior_variance
from submin.adjustment.symmetric import fill_symmetric
from submin.errors import NumericalError


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
