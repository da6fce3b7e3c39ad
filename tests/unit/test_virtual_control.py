"""Virtual control: what it makes, that it holds a block which nothing else holds, and why nothing is said of accuracy then."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.linalg as la
from numpy.typing import NDArray

from submin.adjustment.elimination import eliminate, linearise
from submin.adjustment.estimation import estimate_images
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori
from submin.adjustment.rays import Rays, sorted_rays
from submin.adjustment.symmetric import fill_symmetric
from submin.adjustment.virtual_control import VirtualControl, VirtuallyControlled, adjust_virtually, virtual_control, virtual_factor
from submin.errors import InputError
from submin.geodesy import geodetic_to_geocentric, local_axes
from submin.simulation.linear_array import SENSOR
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region

Array = NDArray[np.float64]
DESIGN = RegionDesign(
    width_km=120, height_km=120, point_spacing_km=5.0, blunder_rate=0.0, bad_cameras=0, seed=3,
    priors=APriori(bias_px=5.0, drift_px=0.3, common_to_pass=0.0),
)  # fmt: skip
"""Single images of some 15 m, 36 of them, errors independent: what the ZY-3 paper assumes. Simulated."""
SIGMA = 5.0


@dataclass(frozen=True)
class Case:
    """A simulated region as one block."""

    region: SimulatedRegion
    images: ImageSet
    rays: Rays
    start: Array
    first: Array
    size: Array

    def control(self, grid: int, weight: str, sigma: float = SIGMA, height: float | None = None) -> VirtualControl:
        ties = np.bincount(self.rays.image, minlength=len(self.images))
        return virtual_control(self.images, self.first, self.size, ties, grid, sigma, weight, height)

    def rms(self, found: VirtuallyControlled) -> Array:
        """Errors east, north, up, metres."""
        known = np.isfinite(found.ground).all(axis=1) & (np.bincount(self.rays.point) >= 2)
        error = found.ground - geodetic_to_geocentric(self.region.truth)
        enu = np.einsum("nij,nj->ni", local_axes(self.region.truth), error)[known]
        return np.asarray(np.sqrt((enu**2).mean(axis=0)))


@pytest.fixture(scope="module")
def case() -> Case:
    region = simulate_region(DESIGN)
    images = region.image_set
    rays = sorted_rays(
        region.point, region.image, np.stack([region.sample, region.line], axis=1),
        np.stack([region.sigma_sample, region.sigma_line], axis=1), np.ones(len(region.image), dtype=np.bool_),
    )  # fmt: skip
    size = np.array([(i.width, i.height) for i in region.images], dtype=np.float64)
    return Case(region, images, rays, intersect(images, rays, len(region.point_ids)), np.zeros_like(size), size)


def test_points_lie_at_the_centres_of_a_grid_and_are_seen_there(case: Case) -> None:
    control = case.control(3, "plain", height=700.0)
    assert len(control.image) == 9 * len(case.images)
    width, height = case.size[0]
    np.testing.assert_allclose(control.observed[:3, 0], [width / 6 - 0.5, width / 2 - 0.5, 5 * width / 6 - 0.5])
    np.testing.assert_allclose(control.observed[[0, 3, 6], 1], [height / 6 - 0.5, height / 2 - 0.5, 5 * height / 6 - 0.5])
    ground = case.images.ground(control.ground)
    np.testing.assert_allclose(ground.geodetic[:, 2], 700.0, atol=1e-3)
    theta = np.zeros((len(case.images), 6))
    seen = SENSOR.project(case.images.cameras, theta, ground, control.image, np.arange(len(control.image), dtype=np.int32))
    np.testing.assert_allclose(seen.image, control.observed, atol=1e-3)
    np.testing.assert_allclose(
        case.images.ground(case.control(1, "plain").ground).geodetic[:, 2], SENSOR.mean_height(case.images.cameras), atol=1e-3
    )


def test_weights_follow_the_rule_that_is_named(case: Case) -> None:
    plain, balanced = case.control(3, "plain"), case.control(3, "balanced")
    np.testing.assert_allclose(plain.weight, 1.0 / SIGMA**2)
    ties = np.bincount(case.rays.image, minlength=len(case.images))
    np.testing.assert_allclose(balanced.weight, ties[balanced.image] / 9.0 / SIGMA**2)
    # of an affine correction the shift is held as by so many independent points
    spread = virtual_factor(case.images, plain)
    shift = (spread @ spread.T).toarray()[0, 0]
    assert shift == pytest.approx(SIGMA**2 / 9.0, rel=1e-9)


@pytest.mark.parametrize("weight", ["plain", "balanced"])
def test_a_block_that_nothing_else_holds_is_held(case: Case, weight: str) -> None:
    """Free unknowns are singular; held loosely they distort the block; virtual control gives coordinates better than single images."""
    theta = np.zeros((len(case.images), 6))
    linear = linearise(case.images, case.rays, theta, case.start, case.start)
    sums = eliminate(linear, np.ones(len(case.rays)), len(case.images))
    values = np.linalg.eigvalsh(fill_symmetric(sums.information.copy()))
    assert values[0] < 1e-10 * values[-1], "tie points alone would hold the block"
    found = adjust_virtually(case.images, case.rays, case.start, case.control(3, weight))
    assert found.iterations < 10
    loose = adjust_virtually(case.images, case.rays, case.start, case.control(3, "plain", sigma=30.0 * SIGMA))
    single = np.sqrt(2.0) * DESIGN.priors.bias_px * 2.5  # metres, plane
    plane, height = np.hypot(*case.rms(found)[:2]), case.rms(found)[2]
    assert plane < 0.6 * single and height < 0.6 * single
    # 5 with drift at measured coordinates, which made the free block smaller than it is (decision 018)
    assert np.linalg.norm(case.rms(loose)) > 4.0 * np.linalg.norm(case.rms(found))


@pytest.mark.parametrize(("weight", "least"), [("plain", 4.0), ("balanced", 50.0)])
def test_a_covariance_of_these_equations_would_be_too_small(case: Case, weight: str, least: float) -> None:
    """Exact propagation: the virtual points of an image have one error in common, and the equations take it for many."""
    linear = linearise(case.images, case.rays, np.zeros((len(case.images), 6)), case.start, case.start)
    sums = eliminate(linear, np.ones(len(case.rays)), len(case.images))
    factor = virtual_factor(case.images, case.control(3, weight))
    stated = estimate_images(sums, factor, 6).covariance
    held = np.linalg.inv((factor @ factor.T).toarray())
    real = (case.images.prior @ case.images.prior.T).toarray()
    information = fill_symmetric(sums.information.copy())
    true = stated @ (information + held @ real @ held) @ stated
    assert la.eigh(true, stated, eigvals_only=True)[-1] > least
    honest = estimate_images(sums, case.images.prior, 6).covariance
    assert la.eigh(honest, stated, eigvals_only=True)[-1] > least


def test_what_does_not_hold_an_image_is_refused(case: Case) -> None:
    with pytest.raises(InputError, match="1 virtual control points do not hold its 6 adjustable parameters; give more points"):
        adjust_virtually(case.images, case.rays, case.start, case.control(1, "plain"))
    shifts = replace(case.images, priors=tuple(replace(p, a_priori=APriori(correction="shift")) for p in case.images.priors))
    found = adjust_virtually(shifts, case.rays, case.start, case.control(1, "plain"))
    assert not found.theta[:, [1, 2, 4, 5]].any()
    for wrong in ({"grid": 0, "weight": "plain"}, {"grid": 3, "weight": "heavy"}, {"grid": 3, "weight": "plain", "sigma": 0.0}):
        with pytest.raises(InputError, match="expected 1 or more, a positive number, and one of plain, balanced"):
            case.control(**wrong)  # type: ignore[arg-type]
