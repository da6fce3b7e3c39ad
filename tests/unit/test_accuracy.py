"""CE90 and LE90 by table, by independent quadrature and by simulation; relative accuracy; comparison with truth; NEES."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import erf
from scipy.stats import chi2, norm

from submin.accuracy import (
    accuracy_against_truth,
    ce90,
    circular_error,
    le90,
    linear_error,
    nees_band,
    nees_per_dof,
    relative_covariance,
)
from submin.errors import InputError, NumericalError

K90 = np.array([1.6449, 1.6479, 1.6573, 1.6738, 1.6992, 1.7371, 1.7915, 1.8625, 1.9472, 2.0424, 2.1460])
"""docs/mathematics.md 6.1, r = 0, 0.1 .. 1."""

ratios = st.floats(0.0, 1.0)
sigmas = st.floats(1e-6, 1e6)
angles = st.floats(-np.pi, np.pi)
probabilities = st.floats(0.1, 0.999999)


def ellipse(sigma_1: float, sigma_2: float, angle: float = 0.0) -> np.ndarray:
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(rotation @ np.diag([sigma_1**2, sigma_2**2]) @ rotation.T)


def random_covariance(n: int, seed: int = 1) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(n, n + 2))
    return np.asarray(root @ root.T)


def test_ce90_of_the_published_table() -> None:
    covariances = np.array([ellipse(1.0, r) for r in np.linspace(0.0, 1.0, 11)])
    np.testing.assert_allclose(ce90(covariances), K90, atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("probability", [0.1, 0.393, 0.5, 0.9, 0.95, 0.99, 0.999999])
@pytest.mark.parametrize("ratio", [0.003, 0.0517, 0.211, 0.5003, 0.777, 0.9991])
def test_radius_is_right_to_1e_8_by_independent_quadrature(ratio: float, probability: float) -> None:
    """Integral over slices along the longer axis: the error across must be within the chord."""
    radius = float(circular_error(ellipse(1.0, ratio), probability)[0])

    def inside(limit: float) -> float:
        def slice_(t: float) -> float:
            return float(2.0 * limit * np.cos(t) * norm.pdf(limit * np.sin(t)) * erf(limit * np.cos(t) / (ratio * np.sqrt(2.0))))

        edges = 0.5 * np.pi - np.array([np.pi / 2, 0.3, 0.1, 0.03, 0.01, 0.003, 0.0])
        return float(sum(quad(slice_, a, b, epsabs=1e-15, epsrel=1e-13)[0] for a, b in pairwise(edges)))

    assert inside(radius * (1.0 - 1e-8)) < probability < inside(radius * (1.0 + 1e-8))


def test_distribution_function_as_written_in_the_specification() -> None:
    sigma_1, sigma_2 = 3.0, 1.2
    radius = float(ce90(ellipse(sigma_1, sigma_2, 0.4))[0])

    def integrand(theta: float) -> float:
        q = np.cos(theta) ** 2 / sigma_1**2 + np.sin(theta) ** 2 / sigma_2**2
        return float((1.0 - np.exp(-(radius**2) * q / 2.0)) / q)

    assert 2.0 / (np.pi * sigma_1 * sigma_2) * quad(integrand, 0.0, 0.5 * np.pi, epsabs=1e-13)[0] == pytest.approx(0.9, abs=1e-9)


@pytest.mark.parametrize("probability", [0.1, 0.5, 0.9, 0.999])
def test_limits_are_the_line_and_the_circle(probability: float) -> None:
    line, circle = circular_error(np.array([ellipse(1.0, 0.0), ellipse(1.0, 1.0)]), probability)
    assert line == pytest.approx(norm.ppf(0.5 * (1.0 + probability)), rel=1e-12)
    assert circle == pytest.approx(np.sqrt(-2.0 * np.log(1.0 - probability)), rel=1e-12)


def test_monte_carlo() -> None:
    random = np.random.default_rng(20240607)
    covariances = np.array([ellipse(2.0, s, a) for s, a in ((0.1, 0.3), (0.9, -1.0), (1.9, 2.0))])
    samples = 200_000
    for covariance, radius in zip(covariances, ce90(covariances), strict=True):
        errors = random.multivariate_normal(np.zeros(2), covariance, samples)
        within = float((np.hypot(errors[:, 0], errors[:, 1]) <= radius).mean())
        assert within == pytest.approx(0.9, abs=4.0 * np.sqrt(0.09 / samples))


@given(ratios, sigmas, angles, probabilities)
def test_scale_and_rotation_do_not_matter(ratio: float, sigma: float, angle: float, probability: float) -> None:
    plain = circular_error(ellipse(1.0, ratio), probability)[0]
    turned = circular_error(ellipse(sigma, sigma * ratio, angle), probability)[0]
    assert turned == pytest.approx(sigma * plain, rel=2e-8)


@given(ratios, ratios)
def test_radius_grows_with_the_smaller_axis(one: float, other: float) -> None:
    small, large = sorted((one, other))
    radius = ce90(np.array([ellipse(1.0, small), ellipse(1.0, large)]))
    assert radius[0] <= radius[1] + 1e-12


def test_semi_definite_and_empty_covariances() -> None:
    v = np.array([[3.0, -1.1]])
    np.testing.assert_allclose(ce90(v.T @ v), norm.ppf(0.95) * np.hypot(3.0, 1.1), rtol=1e-12)
    assert ce90(np.zeros((2, 2))).tolist() == [0.0]
    assert ce90(np.empty((0, 2, 2))).shape == (0,)
    assert le90(np.empty(0)).shape == (0,)


@pytest.mark.parametrize(
    "bad",
    [
        [[1.0, 2.0], [2.0, 1.0]],
        [[-1.0, 0.0], [0.0, -1.0]],
        [[np.nan, 0.0], [0.0, 1.0]],
        [[np.inf, 0.0], [0.0, 1.0]],
        [[1.0, 0.0], [0.0, -1e-6]],
    ],
)
def test_impossible_horizontal_covariance_is_refused(bad: list[list[float]]) -> None:
    with pytest.raises(NumericalError, match="covariance 1 is"):
        ce90(np.array([np.eye(2), bad]))


@pytest.mark.parametrize("probability", [0.0, 1.0, 0.05, np.nan])
def test_circular_probability_out_of_range(probability: float) -> None:
    with pytest.raises(InputError, match=r"0\.1 to 0\.999999"):
        circular_error(np.eye(2), probability)


def test_circular_shape_is_checked() -> None:
    with pytest.raises(InputError, match=r"\(3, 3\)"):
        ce90(np.eye(3))


def test_linear_error() -> None:
    np.testing.assert_allclose(le90(np.array([0.0, 1.0, 4.0])), [0.0, 1.6448536269514722, 3.2897072539029444], rtol=1e-15)
    np.testing.assert_allclose(linear_error(9.0, 0.6826894921370859), [3.0], rtol=1e-12)


@pytest.mark.parametrize("bad", [-1e-9, np.nan, np.inf])
def test_impossible_variance_is_refused(bad: float) -> None:
    with pytest.raises(NumericalError, match="variance 1 is"):
        le90(np.array([1.0, bad]))


@pytest.mark.parametrize("probability", [0.0, 1.0, -0.1, np.nan])
def test_linear_probability_out_of_range(probability: float) -> None:
    with pytest.raises(InputError, match="between 0 and 1"):
        linear_error(1.0, probability)


def test_relative_covariance_is_that_of_the_difference() -> None:
    joint = random_covariance(12)
    difference = np.zeros((3, 12))
    difference[:, 3:6], difference[:, 9:12] = -np.eye(3), np.eye(3)
    relative = relative_covariance(joint, 1, 3)
    np.testing.assert_allclose(relative, difference @ joint @ difference.T, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(relative, relative.T)
    np.testing.assert_array_equal(relative, relative_covariance(joint, 3, 1))


def test_relative_covariance_of_equal_errors_is_zero_or_round_off_of_it() -> None:
    joint = random_covariance(6)
    assert not relative_covariance(joint, 1, 1).any()
    common = random_covariance(3, seed=4) / 3.0
    nearly = np.block([[common, common], [common, common]])
    nearly[3:, 3:] -= 1e-15 * np.trace(common) * np.eye(3)
    raw = nearly[:3, :3] + nearly[3:, 3:] - nearly[:3, 3:] - nearly[3:, :3]
    assert np.linalg.eigvalsh(raw)[0] < 0.0
    ce90(relative_covariance(nearly, 0, 1)[:2, :2])
    le90(relative_covariance(nearly, 0, 1)[2, 2])


@pytest.mark.parametrize(("i", "j"), [(0, 2), (-1, 0)])
def test_relative_covariance_of_a_point_that_does_not_exist(i: int, j: int) -> None:
    with pytest.raises(InputError, match=r"expected 0 to 1 \(2 points\)"):
        relative_covariance(np.eye(6), i, j)


def test_relative_covariance_of_values_that_are_not_finite() -> None:
    with pytest.raises(NumericalError, match="points 0 and 1"):
        relative_covariance(np.full((6, 6), np.nan), 0, 1)


def test_relative_covariance_shape() -> None:
    with pytest.raises(InputError, match=r"\(4, 4\)"):
        relative_covariance(np.eye(4), 0, 0)


def test_accuracy_table_by_hand() -> None:
    errors = np.array([[3.0, 4.0, -1.0], [0.0, 0.0, 2.0], [0.6, 0.8, 0.0]])
    table = accuracy_against_truth(errors, np.array([np.eye(3), np.eye(3), 4.0 * np.eye(3)]))
    circle = np.sqrt(2.0 * np.log(10.0))
    assert table.points == 3
    assert table.horizontal_p50 == pytest.approx(1.0)
    assert table.horizontal_p90 == pytest.approx(4.2)
    assert table.horizontal_p95 == pytest.approx(4.6)
    assert table.mean_ce90 == pytest.approx(4.0 / 3.0 * circle)
    assert table.per_cent_within_ce90 == pytest.approx(200.0 / 3.0)
    assert (table.vertical_p50, table.vertical_p90, table.vertical_p95) == pytest.approx((1.0, 1.8, 1.9))
    assert table.mean_le90 == pytest.approx(4.0 / 3.0 * norm.ppf(0.95))
    assert table.per_cent_within_le90 == pytest.approx(200.0 / 3.0)
    mapping = table.to_mapping()
    assert set(mapping) == {"points", "horizontal", "vertical"}
    assert set(mapping["horizontal"]) == {"p50", "p90", "p95", "mean_ce90", "per_cent_within"}
    assert set(mapping["vertical"]) == {"p50", "p90", "p95", "mean_le90", "per_cent_within"}
    assert mapping["vertical"]["p90"] == table.vertical_p90


def test_accuracy_of_honest_errors_is_ninety_per_cent() -> None:
    random = np.random.default_rng(3)
    n = 20_000
    root = random.normal(size=(n, 3, 3))
    blocks = root @ root.transpose(0, 2, 1)
    table = accuracy_against_truth(np.einsum("nij,nj->ni", root, random.normal(size=(n, 3))), blocks)
    assert table.per_cent_within_ce90 == pytest.approx(90.0, abs=0.9)
    assert table.per_cent_within_le90 == pytest.approx(90.0, abs=0.9)


def test_accuracy_refuses_what_it_cannot_compare() -> None:
    with pytest.raises(InputError, match="no point"):
        accuracy_against_truth(np.empty((0, 3)), np.empty((0, 3, 3)))
    with pytest.raises(InputError, match=r"\(2, 3\)"):
        accuracy_against_truth(np.zeros((2, 3)), np.zeros((1, 3, 3)))
    with pytest.raises(NumericalError, match="error of point 1"):
        accuracy_against_truth(np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]), np.tile(np.eye(3), (2, 1, 1)))


def test_nees_is_the_quadratic_form() -> None:
    p, e = random_covariance(9), np.arange(1.0, 10.0)
    assert nees_per_dof(e, p) == pytest.approx(e @ np.linalg.inv(p) @ e / 9.0, rel=1e-10)


def test_nees_of_honest_errors_is_in_its_band() -> None:
    random = np.random.default_rng(11)
    p = random_covariance(300)
    error = np.linalg.cholesky(p) @ random.normal(size=300)
    low, high = nees_band(300)
    assert low < nees_per_dof(error, p) < high
    assert nees_per_dof(2.0 * error, p) > high


@pytest.mark.parametrize(("dof", "probability"), [(3, 0.99), (300, 0.95)])
def test_nees_band_has_equal_tails(dof: int, probability: float) -> None:
    low, high = nees_band(dof, probability)
    assert chi2.cdf(low * dof, dof) == pytest.approx(0.5 * (1.0 - probability), rel=1e-9)
    assert chi2.sf(high * dof, dof) == pytest.approx(0.5 * (1.0 - probability), rel=1e-9)


def test_nees_errors() -> None:
    indefinite = np.diag([1.0, -1.0, 1.0])
    with pytest.raises(NumericalError, match="not positive definite"):
        nees_per_dof(np.ones(3), indefinite)
    with pytest.raises(NumericalError, match="not finite"):
        nees_per_dof(np.array([1.0, np.nan, 0.0]), np.eye(3))
    with pytest.raises(InputError, match="above 0"):
        nees_per_dof(np.empty(0), np.empty((0, 0)))
    with pytest.raises(InputError, match=r"\(3,\), covariance \(2, 2\)"):
        nees_per_dof(np.ones(3), np.eye(2))
    with pytest.raises(InputError, match="dof is 0"):
        nees_band(0)
    with pytest.raises(InputError, match="between 0 and 1"):
        nees_band(3, 1.0)
