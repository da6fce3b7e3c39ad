"""Simulated regions through the whole product: is the reported accuracy the true one, and are blunders and bad cameras found?

On a small region the errors of a hundred points are few independent numbers: with 10 px of a priori sigma, half of it common to a pass,
all points move
together, and 20 seeds leave "per cent within CE90" a standard deviation of 6. The percentages are therefore judged on cameras known to
half a pixel, where neighbouring points err separately; NEES, which weighs every direction alike, is judged on both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from networks import SMALL, accepted_rays, area_of, fuse
from numpy.typing import NDArray

import submin
from submin.accuracy import AccuracyTable, accuracy_against_truth, nees_band, nees_per_dof
from submin.adjustment.priors import APriori
from submin.geodesy import geodetic_to_geocentric, local_axes, rotate_covariance
from submin.query.control_set import ControlSet
from submin.sensors import Ground, sensor_named
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region
from submin.storage.simulated import write_region

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

SEEDS = range(20)
DESIGNS = {
    "cameras known to half a pixel": replace(SMALL, priors=APriori(bias_px=0.5, drift_px=0.2, common_to_pass=0.2)),
    "cameras known to ten pixels": SMALL,
}
DRAWS = 200


@dataclass(frozen=True, eq=False)
class Outcome:
    """One seed: the region, the answer for all its points, their errors, which rays were rejected, which images flagged.

    Attributes
    ----------
    errors : (n, 3), estimate minus truth, geocentric metres; local, covariance : the same in local axes, with each point's covariance
    rejected : (r,) by ray of the region
    """

    region: SimulatedRegion
    control: ControlSet
    errors: Array
    local: Array
    covariance: Array
    rejected: Flags
    flagged: frozenset[str]

    @property
    def nees(self) -> float:
        """Normalised squared error of all points together, chi-square with three degrees of freedom a point."""
        return nees_per_dof(self.errors.ravel(), self.control.covariance) * self.errors.size


@pytest.fixture(scope="module", params=DESIGNS)
def outcomes(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Outcome]:
    folder = tmp_path_factory.mktemp("consistency")
    return [outcome(replace(DESIGNS[request.param], seed=seed), folder / str(seed)) for seed in SEEDS]


def flagged(region: SimulatedRegion, folder: Path, tile_km: float, overlap_km: float) -> frozenset[str]:
    """Make a network of a region; the images that are flagged."""
    write_region(region, folder / "catalogue")
    result = fuse(folder / "catalogue", folder / "network", area_of(region), tile_km=tile_km, overlap_km=overlap_km)
    assert not result.rejected
    return frozenset(image.image_id for image in result.flagged)


def outcome(design: RegionDesign, folder: Path) -> Outcome:
    region = simulate_region(design)
    images = flagged(region, folder, 80.0, 30.0)
    control = submin.open(folder / "network").query(area=area_of(region).buffer(0.1), policy="rigorous")
    assert control.scope == "network" and len(control.tiles) == 4
    truth = region.truth[np.searchsorted(region.point_ids, control.ids)]
    errors = control.geocentric - geodetic_to_geocentric(truth)
    axes = local_axes(truth)
    accepted = accepted_rays(folder / "network")
    names = zip(region.point_ids[region.point].tolist(), (region.images[i].image_id for i in region.image), strict=True)
    return Outcome(
        region, control, errors, (axes @ errors[:, :, None])[:, :, 0], rotate_covariance(control.point_covariance, axes),
        np.array([not accepted[name] for name in names]), images,
    )  # fmt: skip


def pooled(outcomes: list[Outcome]) -> AccuracyTable:
    return accuracy_against_truth(np.concatenate([o.local for o in outcomes]), np.concatenate([o.covariance for o in outcomes]))


def scatter(outcomes: list[Outcome]) -> tuple[float, float]:
    """Standard deviation of the pooled per cent within CE90 and LE90 if the reported covariance is the true one."""
    rng = np.random.default_rng(0)
    variance = np.zeros(2)
    for o in outcomes[:4]:
        n = len(o.control)
        drawn = (np.linalg.cholesky(o.control.covariance) @ rng.standard_normal((3 * n, DRAWS))).reshape(n, 3, DRAWS)
        local = local_axes(o.control.geodetic) @ drawn
        horizontal = np.hypot(local[:, 0], local[:, 1]) <= o.control.ce90[:, None]
        vertical = np.abs(local[:, 2]) <= o.control.le90[:, None]
        variance += [np.var(100.0 * inside.mean(axis=0)) / (4.0 * len(outcomes)) for inside in (horizontal, vertical)]
    return float(np.sqrt(variance[0])), float(np.sqrt(variance[1]))


def across_epipolar(region: SimulatedRegion) -> Array:
    """Part (r,) of each ray's shift by a blunder that its point's other rays cannot follow, in sigmas; 0 for good rays.

    The point can move along any other ray, which draws an epipolar line in this image; the main direction of these lines is taken.
    """
    ground = Ground.at(geodetic_to_geocentric(region.truth))
    projection = sensor_named("rpc").project(region.packed_cameras(), region.theta, ground, region.image, region.point)
    shift = np.stack([region.sample, region.line], axis=1) - projection.image
    direction = np.cross(projection.by_ground[:, 0], projection.by_ground[:, 1])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.zeros(len(shift))
    for i in np.flatnonzero(region.blunder):
        others = np.flatnonzero((region.point == region.point[i]) & (np.arange(len(shift)) != i))
        lines = direction[others] @ projection.by_ground[i].T
        across[i] = abs(np.linalg.svd(lines)[2][1] @ shift[i]) / region.sigma_sample[i]
    return across


def rays_of_point(region: SimulatedRegion) -> NDArray[np.int64]:
    """Rays of the point of each ray (r,)."""
    return np.bincount(region.point)[region.point]


def test_nees_is_in_its_band(outcomes: list[Outcome]) -> None:
    dof = sum(o.errors.size for o in outcomes)
    low, high = nees_band(dof)
    assert dof > 9000
    assert low < sum(o.nees for o in outcomes) / dof < high


def test_nine_tenths_of_the_points_are_within_ce90_and_le90(outcomes: list[Outcome]) -> None:
    table, (horizontal, vertical) = pooled(outcomes), scatter(outcomes)
    if outcomes[0].region.design.priors.bias_px < 1.0:
        assert max(horizontal, vertical) < 1.5, "errors are so much in common that the percentages say nothing"
        assert 87.0 <= table.per_cent_within_ce90 <= 93.0
        assert 87.0 <= table.per_cent_within_le90 <= 93.0
    else:
        assert abs(table.per_cent_within_ce90 - 90.0) < 3.0 * horizontal
        assert abs(table.per_cent_within_le90 - 90.0) < 3.0 * vertical


def test_large_blunders_in_points_of_four_rays_are_found(outcomes: list[Outcome]) -> None:
    found = []
    for o in outcomes:
        large = (across_epipolar(o.region) > 8.0) & (rays_of_point(o.region) >= 4)
        found.append(o.rejected[large])
    planted = np.concatenate(found)
    assert len(planted) >= 15
    assert planted.all()


def test_few_good_rays_are_lost(outcomes: list[Outcome]) -> None:
    lost = np.concatenate([o.rejected[~o.region.blunder] for o in outcomes])
    assert lost.mean() < 1e-3


def test_bad_cameras_are_flagged(outcomes: list[Outcome]) -> None:
    names = [[image.image_id for image in o.region.images] for o in outcomes]
    bias = [0, 3]
    for o, ids in zip(outcomes, names, strict=True):
        for camera in o.region.bad_cameras:
            shift = np.linalg.norm(o.region.theta[ids.index(camera), bias]) / o.region.design.priors.bias_px
            assert shift <= 6.0 or camera in o.flagged, f"{camera} of seed {o.region.design.seed} is off by {shift:.1f} sigmas"


def test_few_good_cameras_are_flagged(outcomes: list[Outcome]) -> None:
    wrongly = sum(len(o.flagged - set(o.region.bad_cameras)) for o in outcomes)
    assert wrongly < 0.01 * sum(len(o.region.images) for o in outcomes)


@pytest.mark.parametrize(("seed", "tile_km", "overlap_km"), [(11, 80.0, 30.0), (3, 40.0, 20.0)])
def test_a_blunder_is_not_blamed_on_its_camera(seed: int, tile_km: float, overlap_km: float, tmp_path: Path) -> None:
    """The same region with its blunders and without; in both seeds one lies in an image of which a tile sees few rays."""
    named = []
    for rate in (SMALL.blunder_rate, 0.0):
        region = simulate_region(replace(SMALL, seed=seed, blunder_rate=rate))
        named.append(flagged(region, tmp_path / str(rate), tile_km, overlap_km))
    assert named[0] <= named[1]


@pytest.mark.parametrize("seed", [12, pytest.param(2, marks=pytest.mark.xfail(strict=True, reason="two in a point: docs/decisions/004"))])
def test_a_blunder_that_three_rays_cannot_locate_does_not_stay(seed: int, tmp_path: Path) -> None:
    """One blunder in fifty rays, some of them along the track in points of one triplet, where all three rays look equally bad.

    With seed 2 such a point has two of them, and what the first one leaves are two rays that meet: a known limit.
    """
    design = DESIGNS["cameras known to half a pixel"]
    found = outcome(replace(design, seed=seed, blunder_rate=0.02), tmp_path)
    region = found.region
    hidden = region.blunder & (rays_of_point(region) == 3) & (across_epipolar(region) < 2.0)
    assert hidden.any()
    assert found.rejected[hidden].all()
    low, high = nees_band(found.errors.size, 0.999)
    assert low < found.nees / found.errors.size < high
