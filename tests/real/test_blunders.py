"""Blunders planted in a real triplet (Pleiades, Provence): one ray in twenty is shifted by 5 to 50 pixels in any direction.

The tie points have been measured with 0.16 pixel (so says the variance factor), and the default sigma of an import is 0.5. What a test
of residuals can see depends on the sigma that is stated: 0.5, and 0.25, nearer to the truth, are tried.

* In a point of three views a blunder is *found* when its ray goes, and *located* when nothing else of the point goes.
* In a point of two views a shift shows across the epipolar line only: as ``shift / (sigma sqrt 2)``, and both rays go.
* A good ray is *lost* when it goes without a shifted one in its point of two views: there the partner must go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from submin.adjustment.adjustment import Adjustment, adjust
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.quality import Quality, quality
from submin.adjustment.rays import Rays, sorted_rays
from submin.geodesy import WGS84
from submin.network.network_image import image_set
from submin.sensors import width_of
from submin.storage.block_images import network_images
from submin.storage.catalogue import Catalogue
from submin.storage.rpc_import import import_rpc

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

NAME = "pleiades_provence_triplet"
SEEDS = range(5)
RATE = 0.05
STATED, NEARER, MEASURED = 0.5, 0.25, 0.16


@dataclass(frozen=True)
class Triplet:
    """The rays at one stated sigma, adjusted as they are."""

    images: ImageSet
    rays: Rays
    points: int

    def adjusted(self, rays: Rays) -> Adjustment:
        return adjust(self.images, rays, intersect(self.images, rays, self.points))

    @cached_property
    def clean(self) -> Adjustment:
        return self.adjusted(self.rays)

    @cached_property
    def quality(self) -> Quality:
        return quality(self.images, self.rays, self.clean)

    @cached_property
    def across(self) -> Array:
        """Direction (r, 2) across the epipolar line of the other ray, for rays of points of two views."""
        projection = self.images.project(
            self.clean.theta, self.images.ground(self.clean.ground), self.rays.image, self.rays.point, self.rays.observed
        )
        ray = np.cross(projection.by_ground[:, 0], projection.by_ground[:, 1])
        other = np.arange(len(self.rays)) + np.where(self.rays.point == np.roll(self.rays.point, -1), 1, -1)
        along = np.einsum("rck,rk->rc", projection.by_ground, ray[other % len(other)])
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        return np.stack([-along[:, 1], along[:, 0]], axis=1)


@dataclass(frozen=True)
class Spoilt:
    """The same with blunders, adjusted."""

    triplet: Triplet
    shift: Array
    result: Adjustment

    @cached_property
    def shifted(self) -> Flags:
        return self.shift.any(axis=1)

    def of_point(self, flags: Flags) -> NDArray[np.int64]:
        """How many rays (r,) of the point of each ray have the flag."""
        point = self.triplet.rays.point
        return np.bincount(point[flags], minlength=self.triplet.points)[point]

    @cached_property
    def views(self) -> NDArray[np.int64]:
        return self.of_point(np.ones(len(self.shift), dtype=np.bool_))


@pytest.fixture(scope="module", params=[STATED, NEARER], ids=["sigma 0.5", "sigma 0.25"])
def triplet(request: pytest.FixtureRequest, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Triplet:
    folder = tmp_path_factory.mktemp("provence") / "catalogue"
    import_rpc(data / NAME / "images.csv", data / NAME / "rpc", data / NAME / "tracks.csv.gz", folder)
    block = next(Catalogue.open(folder).blocks())
    ids, point = np.unique(block.point_ids, return_inverse=True)
    observed = block.observed
    rays = sorted_rays(
        point.astype(np.int32), block.image, observed, np.full_like(observed, request.param), np.ones(len(observed), dtype=np.bool_)
    )  # fmt: skip
    return Triplet(image_set(network_images(block), WGS84, width_of(["rpc"])), rays, len(ids))


@pytest.fixture(scope="module")
def spoilt(triplet: Triplet) -> list[Spoilt]:
    made = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        rays = triplet.rays
        chosen = rng.choice(len(rays), round(RATE * len(rays)), replace=False)
        length, direction = rng.uniform(5.0, 50.0, len(chosen)), rng.uniform(0.0, 2.0 * np.pi, len(chosen))
        shift = np.zeros((len(rays), 2))
        shift[chosen] = np.stack([length * np.cos(direction), length * np.sin(direction)], axis=1)
        made.append(Spoilt(triplet, shift, triplet.adjusted(replace(rays, observed=rays.observed + shift))))
    return made


def test_the_measurements_are_better_than_an_import_says(triplet: Triplet) -> None:
    stated = triplet.rays.sigma[0, 0]
    assert stated * np.sqrt(triplet.quality.variance_factor) == pytest.approx(MEASURED, abs=0.02)
    assert triplet.quality.redundancy > 7000
    assert np.nanmin(triplet.quality.convergence_angles) > 3.0


def test_blunders_in_points_of_three_views_are_found_and_the_points_kept(spoilt: list[Spoilt]) -> None:
    for s in spoilt:
        assert s.result.converged and not s.result.released.any()
        alone = s.shifted & (s.views == 3) & (s.of_point(s.shifted) == 1)
        gone = ~s.result.accepted
        located = alone & gone & (s.of_point(gone) == 1)
        assert alone.sum() > 200
        assert located.sum() >= 0.95 * alone.sum()
        # a blunder that is known to be there and is not located takes its point along: next to none is blamed on a good ray
        assert (alone & ~gone).sum() <= 0.005 * alone.sum()


def test_blunders_in_points_of_two_views_are_found_where_they_show(spoilt: list[Spoilt]) -> None:
    for s in spoilt:
        two = s.shifted & (s.views == 2) & (s.of_point(s.shifted) == 1)
        across = np.abs(np.einsum("rc,rc->r", s.triplet.across, s.shift))
        # critical value and measurement errors
        least = {STATED: 3.5, NEARER: 2.0}[s.triplet.rays.sigma[0, 0]]
        seen = two & (across > least)
        assert seen.sum() > 120
        assert not s.result.accepted[seen].any()
        assert (s.of_point(~s.result.accepted)[seen] == 2).all()


def test_few_good_rays_are_lost(spoilt: list[Spoilt]) -> None:
    for s in spoilt:
        good = ~s.shifted & ~((s.views == 2) & (s.of_point(s.shifted) > 0))
        assert (good & ~s.result.accepted).sum() < 0.01 * good.sum()


def test_the_result_is_that_without_blunders(spoilt: list[Spoilt]) -> None:
    """Images, and points of which at least two rays are left and none of them is shifted: within one sigma."""
    for s in spoilt:
        clean, statistics = s.triplet.clean, s.triplet.quality
        sigma = np.sqrt(np.diag(statistics.image_covariance)).reshape(clean.theta.shape)
        assert (np.abs(s.result.theta - clean.theta) < sigma).all()
        left = np.bincount(s.triplet.rays.point[s.result.accepted], minlength=s.triplet.points)
        wrong = np.bincount(s.triplet.rays.point[s.result.accepted & s.shifted], minlength=s.triplet.points)
        kept = (left >= 2) & (wrong == 0)
        assert kept.sum() > 0.85 * s.triplet.points
        own = quality(s.triplet.images, s.triplet.rays, s.result).point_covariances
        ground = np.abs(s.result.ground - clean.ground)[kept] / np.sqrt(np.einsum("nii->ni", own[kept]))
        assert ground.max() < 1.0
