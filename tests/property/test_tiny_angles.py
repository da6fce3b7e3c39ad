"""Rays that meet at a tiny angle: nothing is claimed of a direction that they do not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from eliminations import PIXELS_PER_METRE, RPC, Array, Network, P, dense_design, eliminated, full

from submin.adjustment.elimination import (
    LinearRays,
    eliminate,
    point_factors,
)
from submin.adjustment.priors import APriori, ImagePrior, prior_factor


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
