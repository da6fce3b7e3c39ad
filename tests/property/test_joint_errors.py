"""A covariance in two parts, errors shared and noise of each coordinate, is the whole; its rows are the marginal of some."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.joint_errors import LEAST_EIGENVALUE, joint_errors, marginal_factor
from submin.adjustment.priors import ImagePrior, JointRows, prior_factor
from submin.errors import InputError
from submin.sensors.survey import SHIFTS

Array = NDArray[np.float64]


def random_covariance(seed: int, points: int) -> Array:
    """Errors common to all points and of each, of sizes that differ by a thousand from coordinate to coordinate."""
    rng, n = np.random.default_rng(seed), 3 * points
    loading = rng.normal(size=(n, 2))
    correlation = loading @ loading.T + np.diag(rng.uniform(0.05, 1.0, n))
    scale = 10.0 ** rng.uniform(-3.0, 0.0, n)
    return np.asarray(correlation * scale * scale[:, None])


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 12), st.floats(0.01, 0.99))
def test_the_parts_are_the_whole(seed: int, points: int, share: float) -> None:
    covariance = random_covariance(seed, points)
    parts = joint_errors(covariance, share)
    sigma = np.sqrt(np.diag(covariance))
    whole = parts.factor @ parts.factor.T + np.diag(parts.variance)
    assert np.abs((whole - covariance) / sigma / sigma[:, None]).max() < 1e-14
    assert (parts.variance > 0.0).all() and np.array_equal(parts.factor, np.tril(parts.factor))
    alone = 1.0 / np.diag(np.linalg.inv(covariance))
    np.testing.assert_allclose(parts.variance, parts.part * alone, rtol=1e-6)
    assert 0.0 < parts.part <= share


def test_uncorrelated_coordinates_have_the_share_as_noise() -> None:
    parts = joint_errors(np.diag([1.0, 4.0, 1e-6]))
    np.testing.assert_allclose(parts.variance, [0.5, 2.0, 5e-7], rtol=1e-12)
    assert parts.part == pytest.approx(0.5)


@pytest.mark.parametrize("common", [1e6, 1e13])
def test_what_is_singular_to_working_precision_is_refused(common: float) -> None:
    covariance = np.full((6, 6), common) + np.eye(6)
    if 6.0 * common * LEAST_EIGENVALUE < 1.0:
        parts = joint_errors(covariance)
        assert np.abs(parts.factor @ parts.factor.T + np.diag(parts.variance) - covariance).max() < 1e-15 * 6 * common
    else:
        with pytest.raises(InputError, match="singular to working precision"):
            joint_errors(covariance)


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 8))
def test_rows_of_a_factor_are_the_marginal_with_no_more_columns_than_rows(seed: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    parts = joint_errors(random_covariance(seed, points))
    chosen = rng.permutation(3 * points)[: rng.integers(1, 3 * points + 1)]
    rows = parts.factor[chosen]
    found = marginal_factor(rows)
    assert found.shape[1] <= len(chosen)
    sigma = np.sqrt((rows**2).sum(axis=1))
    assert np.abs((found @ found.T - rows @ rows.T) / sigma / sigma[:, None]).max() < 1e-14


def test_any_views_of_a_set_have_the_marginal_of_the_whole_prior() -> None:
    covariance = random_covariance(3, 4)
    parts = joint_errors(covariance)
    shared = covariance - np.diag(parts.variance)
    views = [
        ImagePrior("set", "set", float("nan"), None, SHIFTS, joint=JointRows(parts.factor[3 * k + 2 * n : 3 * k + 2 + n], parts.part))
        for k in range(4)
        for n in range(2)
    ]
    other = ImagePrior("x", "x", float("nan"), None, ())
    for chosen in ([0, 1, 2, 3, 4, 5, 6, 7], [5, 0], [3], [6, 1, 2]):
        factor = prior_factor([other, *(views[i] for i in chosen)], 6).toarray()
        at = [6 * (1 + place) + c for place, i in enumerate(chosen) for c in range(2 - i % 2)]
        rows = [3 * (i // 2) + 2 * (i % 2) + c for i in chosen for c in range(2 - i % 2)]
        np.testing.assert_allclose((factor @ factor.T)[np.ix_(at, at)], shared[np.ix_(rows, rows)], rtol=1e-12, atol=1e-16)
        assert np.count_nonzero(factor.any(axis=1)) == len(at)
