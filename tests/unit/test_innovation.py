"""Innovation of two estimates of the same points: chi-square for good blocks, power where it is promised, and the same number by rays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from orchestration.stage_one import BlockRays
from submin.adjustment.adjustment import adjust
from submin.adjustment.control import correlated, estimate, innovation_of, innovation_test
from submin.adjustment.elimination import linearise
from submin.adjustment.intersection import intersect
from submin.adjustment.quality import quality
from submin.adjustment.rays import sorted_rays
from submin.errors import NumericalError
from submin.geodesy import WGS84
from submin.network.innovation import BlockTest, allowed_cameras, allowed_points, innovation
from submin.network.network_image import image_set
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.simulated import _blocks

POINTS = 8


def covariances(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Of a block and of a network: a common shift of many metres, and errors of each point."""
    chance = np.random.default_rng(seed)
    found = []
    for common in (5.0, 1.0):
        loading = np.hstack([common * np.tile(np.eye(3), (POINTS, 1)), 0.3 * chance.standard_normal((3 * POINTS, 4))])
        found.append(loading @ loading.T + np.diag(chance.uniform(0.05, 0.5, 3 * POINTS)))
    return found[0], found[1]


def test_good_blocks_are_chi_square() -> None:
    """200 good blocks in numpy: the statistic of all, of each point, and of each coordinate."""
    block, network = covariances(1)
    of_block, of_network = np.linalg.cholesky(block), np.linalg.cholesky(network)
    chance = np.random.default_rng(2)
    truth = chance.standard_normal((POINTS, 3)) * 1e3
    found = [
        innovation(
            truth + (of_block @ chance.standard_normal(3 * POINTS)).reshape(-1, 3), block,
            truth + (of_network @ chance.standard_normal(3 * POINTS)).reshape(-1, 3), network,
        )
        for _ in range(200)
    ]  # fmt: skip
    assert {test.dof for test in found} == {3 * POINTS}
    assert kstest([test.d2 for test in found], chi2(3 * POINTS).cdf).pvalue > 0.01
    assert kstest([test.probability for test in found], "uniform").pvalue > 0.01
    assert kstest([test.point[3] for test in found], chi2(3).cdf).pvalue > 0.01
    assert kstest([test.coordinate[5, 1] for test in found], "norm").pvalue > 0.01
    assert min(test.probability for test in found) > 1e-6


def test_redundancy_is_shared_between_block_and_network() -> None:
    block, network = covariances(3)
    zero = np.zeros((POINTS, 3))
    test = innovation(zero, block, zero, network)
    assert np.allclose(test.by_block + test.by_network, 1.0, atol=1e-12)
    inverse = np.linalg.inv(block + network)
    assert np.allclose(test.by_block.ravel(), np.diag(block @ inverse), rtol=1e-9)
    assert np.allclose(test.detectable.ravel(), 4.1322 / np.sqrt(np.diag(inverse)), rtol=1e-3)


def test_a_minimal_detectable_error_is_found_in_eighty_of_a_hundred_cases() -> None:
    block, network = covariances(4)
    chance = np.random.default_rng(5)
    zero = np.zeros((POINTS, 3))
    size = innovation(zero, block, zero, network).detectable[2, 1]
    root = np.linalg.cholesky(block + network)
    errors = (root @ chance.standard_normal((3 * POINTS, 2000))).T.reshape(-1, POINTS, 3)
    errors[:, 2, 1] += size
    tests = [innovation(error, block, zero, network) for error in errors]
    power = np.mean([abs(test.coordinate[2, 1]) > 3.2905 for test in tests])
    assert abs(power - 0.8) < 3.0 * np.sqrt(0.16 / len(tests))
    # the test of the point has three degrees of freedom for one error, and is a little weaker
    by_point = np.mean([test.point[2] > chi2.isf(1e-3, 3) for test in tests])
    assert 0.55 < by_point < power
    assert np.mean([np.argmax(test.point) == 2 for test in tests if test.point[2] > 16.27]) > 0.95


def test_a_covariance_that_is_none_is_told() -> None:
    zero = np.zeros((2, 3))
    with pytest.raises(NumericalError, match="not positive definite at row 3"):
        innovation(zero, np.diag([1.0, 1, 1, -2, 1, 1]), zero, 0.5 * np.eye(6))


def test_by_rays_or_by_covariances_it_is_the_same_number() -> None:
    """The test of a block's rays needs no covariance of the block; that of two covariances is the specification."""
    region = simulate_region(RegionDesign(width_km=60, height_km=60, point_spacing_km=9.5, blunder_rate=0.0, bad_cameras=0))
    observed = np.column_stack([region.sample, region.line])
    sigma = np.column_stack([region.sigma_sample, region.sigma_line])
    priors = {image.block_id: region.design.priors for image in region.images}
    block = _blocks(region.images, priors, region.point_ids[region.point], region.image, observed, sigma)[0]
    of_block = BlockRays.of(block)
    images = image_set(of_block.images, WGS84, 6)
    ids, point = of_block.ids, of_block.point
    rays = sorted_rays(point.astype(np.int32), of_block.image, of_block.observed, of_block.sigma, np.ones(len(point), dtype=np.bool_))
    result = adjust(images, rays, intersect(images, rays, len(ids)))
    free = quality(images, rays, result)
    common = np.flatnonzero(np.bincount(rays.point[result.accepted]) == 3)[:6]
    factor = np.random.default_rng(1).standard_normal((18, 18))
    known = factor @ factor.T
    position = result.ground[common] + np.random.default_rng(2).standard_normal((6, 3)) * 4.0
    prior = correlated(images.prior, 6, common, position, known)
    origin = result.ground.copy()
    origin[common] = position
    linear, weight, active = linearise(images, rays, result.theta, result.ground, origin), result.accepted * 1.0, np.ones(6, dtype=np.bool_)
    by_rays = innovation_test(linear, weight, prior, active, estimate(linear, weight, prior, active, origin))
    assert innovation_of(linear, weight, prior, active).d2 == pytest.approx(by_rays.d2, rel=1e-9)
    by_points = innovation(result.ground[common], free.joint_covariance(common), position, known)
    assert by_rays.dof == by_points.dof == 18
    assert by_rays.d2 == pytest.approx(by_points.d2, rel=1e-4)  # the free block's solution is that of its last step
    assert by_rays.probability == pytest.approx(by_points.probability, rel=1e-2)


def test_the_rule() -> None:
    bad = BlockTest(500.0, 60, 1e-70, 40, images=3, explained=False)
    assert bad.rejected(1e-6)
    assert bad.doubtful
    assert not bad.rejected(0.0)  # switched off
    assert not BlockTest(500.0, 60, 1e-70, 40, images=3, explained=True).rejected(1e-6)
    assert not BlockTest(110.0, 60, 1e-4, 40, images=3, explained=False).rejected(1e-6)
    said = bad.reason(1e-6, "v12")
    for part in ("network v12", "d2 is 500.0", "60 degrees of freedom", "above 127.1", "1,000,000 good blocks", "40 common", "3 cameras"):
        assert part in said, said
    assert [allowed_cameras(n) for n in (1, 2, 3, 4, 9)] == [1, 1, 1, 2, 4]
    assert [allowed_points(n) for n in (1, 2, 3, 40)] == [1, 1, 1, 20]
