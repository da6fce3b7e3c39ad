"""Statistics of an adjustment: against a dense one, and by trial."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from unit.test_adjustment import FIVE, Array, P, Simulated, adjusted, image_set, simulate, with_ray_moved

from submin.adjustment import blunders
from submin.adjustment.elimination import linearise
from submin.adjustment.priors import APriori
from submin.adjustment.quality import Quality, quality


@cache
def block() -> Simulated:
    """Five images, one of them in two rays only; points of two to five rays."""
    made = simulate(21, points=40, images=image_set(FIVE, APriori(2.0, 1.0, 0.5)))
    return with_ray_moved(made, 11, (25.0, -30.0))


@cache
def found() -> Quality:
    result = adjusted(block())
    assert result.converged and (~result.accepted).sum() >= 1
    return quality(block().images, block().rays, result)


def dense() -> tuple[Array, Array, Array]:
    """Design (rows, 3n + m p), its covariance, and the rows of accepted rays (2, a): all unknowns at once, the a priori model inverted."""
    b, result = block(), adjusted(block())
    n, m = len(b.ground), len(b.images)
    images = b.images.release(result.released)
    linear = linearise(images, b.rays, result.theta, result.ground, result.ground)
    design = np.zeros((2 * len(b.rays), 3 * n + m * P))
    for i in np.flatnonzero(result.accepted):
        rows = slice(2 * i, 2 * i + 2)
        design[rows, 3 * b.rays.point[i] : 3 * b.rays.point[i] + 3] = linear.by_ground[i]
        design[rows, 3 * n + P * b.rays.image[i] : 3 * n + P * b.rays.image[i] + P] = linear.by_parameters[i]
    normal = design.T @ design
    normal[3 * n :, 3 * n :] += np.linalg.inv((images.prior @ images.prior.T).toarray())
    return design, np.linalg.inv(normal), result.accepted


def test_redundancy_numbers_are_those_of_a_dense_adjustment() -> None:
    design, covariance, accepted = dense()
    expected = 1.0 - np.einsum("ij,jk,ik->i", design, covariance, design).reshape(-1, 2)
    np.testing.assert_allclose(found().redundancy_numbers[accepted], expected[accepted], rtol=0.0, atol=1e-9)
    assert np.isnan(found().redundancy_numbers[~accepted]).all()


def test_redundancy_numbers_add_up_to_the_redundancy() -> None:
    total = np.nansum(found().redundancy_numbers) + found().prior_redundancy.sum()
    assert total == pytest.approx(found().redundancy, abs=1e-8)
    assert found().redundancy == 2 * int(found().weight.sum()) - 3 * len(block().ground)


def test_covariances_are_those_of_a_dense_adjustment() -> None:
    _, covariance, _ = dense()
    n = 3 * len(block().ground)
    scale = np.sqrt(np.diag(covariance))
    difference = (found().joint_covariance(np.arange(n // 3)) - covariance[:n, :n]) / np.outer(scale[:n], scale[:n])
    assert np.abs(difference).max() < 1e-8
    difference = (found().image_covariance - covariance[n:, n:]) / np.outer(scale[n:], scale[n:])
    assert np.abs(difference).max() < 1e-8
    joint = found().joint_covariance(np.array([7, 3]))
    np.testing.assert_allclose(joint[:3, :3], found().point_covariances[7], rtol=1e-10)
    np.testing.assert_allclose(joint[3:, 3:], found().point_covariances[3], rtol=1e-10)
    np.testing.assert_allclose(joint[:3, 3:], covariance[21:24, 9:12], rtol=0.0, atol=1e-8 * joint.max())


def test_the_variance_factor_is_that_of_the_measurements() -> None:
    inside, factors = 0, []
    for seed in range(40):
        made = simulate(500 + seed, points=15)
        statistics = quality(made.images, made.rays, adjusted(made))
        factors.append(statistics.variance_factor)
        inside += statistics.band[0] <= statistics.variance_factor <= statistics.band[1]
    assert inside >= 33, "95 of 100"
    assert np.mean(factors) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / statistics.redundancy / 40))
    made = simulate(3)
    doubtful = replace(made, images=image_set(a_priori=APriori(40.0, 4.0, 0.5)), rays=replace(made.rays, sigma=4.0 * made.rays.sigma))
    one, other = (quality(b.images, b.rays, adjusted(b)).variance_factor for b in (made, doubtful))
    assert other == pytest.approx(one / 16.0, rel=1e-6)


@pytest.mark.parametrize("critical", [3.2905, blunders.CRITICAL_RAY])
def test_a_minimal_detectable_blunder_is_found_in_four_of_five_cases(critical: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each trial is a new network with one blunder as large as is said to be detectable, whose own w is to exceed the value."""
    monkeypatch.setattr(blunders, "CRITICAL_RAY", np.inf)  # tested, not rejected
    monkeypatch.setattr(blunders, "IMAGE_FAMILY", 1e-9)
    hits, trials = 0, 150
    clean = simulate(900, points=12)
    detectable = quality(clean.images, clean.rays, adjusted(clean)).detectable(critical)
    checked = np.flatnonzero(np.isfinite(detectable[:, 0]))
    rng = np.random.default_rng(5)
    exact = clean.images.project(clean.theta, clean.images.ground(clean.ground), clean.rays.image, clean.rays.point, clean.rays.observed)
    for trial in range(trials):
        row = int(checked[trial % len(checked)])
        observed = exact.image + rng.normal(size=exact.image.shape) * clean.rays.sigma
        observed[row, 0] += rng.choice([-1.0, 1.0]) * detectable[row, 0]
        made = replace(clean, rays=replace(clean.rays, observed=observed))
        result = adjusted(made)
        statistics = quality(made.images, made.rays, result)
        w = result.residuals[row, 0] / np.sqrt(statistics.redundancy_numbers[row, 0])
        hits += abs(w) > critical
    assert abs(hits / trials - 0.8) < 3.5 * np.sqrt(0.8 * 0.2 / trials)


def test_the_minimal_detectable_blunder_is_that_of_the_test_in_use() -> None:
    numbers, sigma = found().redundancy_numbers, block().rays.sigma
    checked = numbers > 0.01
    np.testing.assert_allclose(found().detectable(3.2905)[checked], 4.132 * sigma[checked] / np.sqrt(numbers[checked]), rtol=1e-4)
    np.testing.assert_allclose(found().detectable()[checked] / found().detectable(3.2905)[checked], 4.8416 / 4.1321, rtol=1e-4)
    assert np.isnan(found().detectable()[found().weight == 0.0]).all()


def test_what_nothing_checks_has_no_detectable_blunder() -> None:
    made = simulate(11)
    first = made.rays.first(len(made.ground))
    keep = np.ones(len(made.rays), dtype=np.bool_)
    keep[first[4] + 1 : first[5]] = False
    alone = replace(made, rays=made.rays.take(keep))
    statistics = quality(alone.images, alone.rays, adjusted(alone))
    row = first[4]
    assert (statistics.redundancy_numbers[row] == 0.0).all() and np.isposinf(statistics.detectable()[row]).all()
    assert np.isnan(statistics.point_covariances[4]).all() and np.isnan(statistics.convergence_angles[4]) and statistics.weak[4]
    assert np.isfinite(np.delete(statistics.point_covariances, 4, axis=0)).all() and not np.delete(statistics.weak, 4).any()


def test_without_redundancy_there_is_no_variance_factor() -> None:
    made = simulate(22, points=3)
    single = replace(made, rays=made.rays.take(made.rays.first(3)[:-1]))
    statistics = quality(single.images, single.rays, adjusted(single))
    assert statistics.redundancy == 0 and np.isnan(statistics.variance_factor) and statistics.band == (0.0, np.inf)


def test_angles_are_those_between_the_views() -> None:
    made = simulate(23, theta=np.zeros((3, P)))
    statistics = quality(made.images, made.rays, adjusted(made))
    # views lean by the tangents (-0.45, 0.1), (0, -0.05) and (0.4, 0.15), as degrees of longitude and latitude and metres have it
    lean = np.array([[-0.45, 0.1, 1.0], [0.0, -0.05, 1.0], [0.4, 0.15, 1.0]])
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    first = made.rays.first(len(made.ground))
    for j in range(len(made.ground)):
        views = lean[made.rays.image[first[j] : first[j + 1]]]
        expected = np.degrees(np.arccos(np.clip(views @ views.T, -1.0, 1.0))).max()
        assert statistics.convergence_angles[j] == pytest.approx(expected, abs=3.0)


def test_weak_points_are_told() -> None:
    made = simulate(24, images=image_set(((0.2, 0.1), (0.2 + np.tan(np.radians(2.0)), 0.1)), APriori(2.0, 1.0, 0.0)))
    statistics = quality(made.images, made.rays, adjusted(made))
    assert statistics.weak.all() and (statistics.convergence_angles == pytest.approx(2.0, abs=0.2))
    made = simulate(24, images=image_set(((0.2, 0.1), (0.2 + np.tan(np.radians(5.0)), 0.1)), APriori(2.0, 1.0, 0.0)))
    assert not quality(made.images, made.rays, adjusted(made)).weak.any()
