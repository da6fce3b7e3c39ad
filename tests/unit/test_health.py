"""Numbers of health: what a replay, a condition and a difference of sums say of small systems that numpy solves by itself."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from submin.adjustment.elimination import LinearRays, eliminate, point_factors
from submin.adjustment.estimation import estimate_images, reduced_information
from submin.network.health import asymmetry, condition, positive_semi_definite, sums_difference
from submin.network.replay import joined, replay_error

IMAGES, PARAMETERS, POINTS = 4, 3, 12


def system(seed: int) -> tuple[LinearRays, np.ndarray, sp.csr_array]:
    """Linear rays of a dozen points in four images, some of them rejected, one point with one ray, and a correlated prior."""
    chance = np.random.default_rng(seed)
    counts = chance.integers(2, IMAGES + 1, POINTS)
    counts[3] = 1
    image = np.concatenate([np.sort(chance.choice(IMAGES, n, replace=False)) for n in counts]).astype(np.int32)
    r = len(image)
    rays = LinearRays(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), image, chance.standard_normal((r, 2, 3)),
        chance.standard_normal((r, 2, PARAMETERS)), chance.standard_normal((r, 2)),
    )  # fmt: skip
    weight = (chance.random(r) > 0.1).astype(np.float64)
    prior = np.kron(np.eye(IMAGES), np.diag([2.0, 1.0, 0.5]))
    return rays, weight, sp.csr_array(np.hstack([prior, chance.standard_normal((IMAGES * PARAMETERS, 1))]))


def dense(rays: LinearRays, weight: np.ndarray, prior: sp.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and covariance of whitened vectors and points at once, by numpy alone (points that are not determined get a weak prior)."""
    q, point = prior.shape[1], np.repeat(np.arange(POINTS), np.diff(rays.first))
    rows, right = [np.hstack([np.eye(q), np.zeros((q, 3 * POINTS))])], [np.zeros(q)]
    for k in np.flatnonzero(weight):
        at = rays.image[k] * PARAMETERS
        row = np.zeros((2, q + 3 * POINTS))
        row[:, :q] = rays.by_parameters[k] @ prior.toarray()[at : at + PARAMETERS]
        row[:, q + 3 * point[k] : q + 3 * point[k] + 3] = rays.by_ground[k]
        rows.append(row)
        right.append(rays.y[k])
    a, b = np.vstack(rows), np.concatenate(right)
    solution, *_ = np.linalg.lstsq(a, b, rcond=None)
    inverse = np.linalg.pinv(a)
    return solution, inverse @ inverse.T


@pytest.mark.parametrize("seed", range(4))
def test_a_replay_is_the_dense_adjustment(seed: int) -> None:
    rays, weight, prior = system(seed)
    sums = eliminate(rays, weight, IMAGES)
    estimate = estimate_images(sums, prior, PARAMETERS)
    factors = point_factors(rays, weight)
    good = np.flatnonzero(factors.rank == 3)[:3]
    chosen = [(good, np.random.default_rng(seed).standard_normal((3, 3)))]
    _, root = condition(reduced_information(sums.information, prior))

    def error(theta: np.ndarray, covariance: np.ndarray) -> float:
        return replay_error(rays, weight, factors, theta, covariance, prior, root, chosen)

    assert error(estimate.theta, estimate.covariance) < 1e-12
    # the dense adjustment says the same, and every error in the claim shows as large as it is
    solution, joint = dense(rays, weight, prior)
    q = prior.shape[1]
    assert np.allclose(prior @ solution[:q], estimate.theta.ravel(), atol=1e-10)
    c = np.zeros(q + 3 * POINTS)
    for j, part in zip(*chosen[0], strict=True):
        c[q + 3 * j : q + 3 * j + 3] = part
    claimed = float(c @ joint @ c)
    assert error(estimate.theta, 1.001 * estimate.covariance) == pytest.approx(
        0.001 * (claimed - sum(float(v @ factors.own[j] @ v) for j, v in zip(*chosen[0], strict=True))) / claimed, rel=1e-6
    )
    off = estimate.theta.copy()
    off[1, 2] += 1e-4 * np.sqrt(estimate.covariance[5, 5])
    assert error(off, estimate.covariance) == pytest.approx(1e-4, rel=1e-6)


def test_the_replay_does_not_lean_on_its_factor() -> None:
    """A factor that is somewhat wrong only guides the refinement."""
    rays, weight, prior = system(9)
    sums = eliminate(rays, weight, IMAGES)
    estimate, factors = estimate_images(sums, prior, PARAMETERS), point_factors(rays, weight)
    _, root = condition(reduced_information(sums.information, prior))
    found = replay_error(rays, weight, factors, estimate.theta, estimate.covariance, prior, 1.0001 * root, [])
    assert found < 1e-12


def test_sums_of_rays_in_another_order_differ_by_round_off_and_damage_by_more() -> None:
    rays, weight, _ = system(5)
    sums = eliminate(rays, weight, IMAGES)
    n = POINTS - 1
    parts = [LinearRays(rays.first[k : k + 2] - rays.first[k], *(getattr(rays, f)[rays.first[k] : rays.first[k + 1]] for f in
             ("image", "by_ground", "by_parameters", "y"))) for k in range(n, -1, -1)]  # fmt: skip
    backwards = joined(parts)
    turned = np.concatenate([weight[rays.first[k] : rays.first[k + 1]] for k in range(n, -1, -1)])
    again = eliminate(backwards, turned, IMAGES)
    assert 0.0 < sums_difference(sums, again, rays, weight, IMAGES) < 1e-14
    sums.information[4, 4] *= 1.0 + 1e-6
    assert sums_difference(sums, again, rays, weight, IMAGES) > 1e-8


def test_condition_is_that_of_the_scaled_matrix() -> None:
    scale = np.array([1e-6, 1.0, 1e5])
    matrix = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.1], [0.0, 0.1, 1.0]])
    number, root = condition(matrix * scale[:, None] * scale)
    assert number == pytest.approx(np.linalg.cond(matrix, 1), rel=1e-9)
    assert np.allclose(root @ root.T, matrix * scale[:, None] * scale, rtol=1e-12)
    assert condition(np.array([[1.0, 2.0], [2.0, 1.0]]))[0] == np.inf
    assert condition(np.array([[1.0, np.nan], [np.nan, 1.0]]))[0] == np.inf


def test_singular_covariances_are_no_damage_and_negative_ones_are() -> None:
    loading = np.random.default_rng(1).standard_normal((6, 3)) * np.array([1.0, 1e-5, 1e3, 1.0, 2.0, 0.0])[:, None]
    covariance = loading @ loading.T
    assert positive_semi_definite(covariance, 1e-9)
    covariance[1, 1] *= 0.9
    assert not positive_semi_definite(covariance, 1e-9)
    assert not positive_semi_definite(np.full((2, 2), np.nan), 1e-9)
    lopsided = loading @ loading.T
    lopsided[3, 4] *= 1.001
    assert asymmetry(loading @ loading.T) < 1e-15
    assert asymmetry(lopsided) > 1e-4
