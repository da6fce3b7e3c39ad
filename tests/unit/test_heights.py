"""Heights known beforehand: one more observation a point, no more and no less."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from unit.test_adjustment import Array, P, Simulated, adjusted, image_set, simulate

from submin.adjustment.adjustment import adjust
from submin.adjustment.elimination import linearise
from submin.adjustment.heights import HeightPrior, adjust_with_heights, constant_height, height_grid
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori
from submin.adjustment.quality import quality
from submin.errors import InputError
from submin.formats.height_grid import read_height_grid
from submin.geodesy import geocentric_to_geodetic, geodetic_to_geocentric, local_axes, rotate_covariance

PAIR = ((0.2, 0.1), (0.2 + 1e-5, 0.1))
"""Two images of one viewpoint."""


def heights_of(ground: Array) -> Array:
    return np.asarray(geocentric_to_geodetic(ground)[:, 2])


def test_points_of_one_viewpoint_get_their_height_from_the_surface() -> None:
    # a plane that rises to the east, 1 in 10: it must be read where the points are, not where their rays were first cut
    block = simulate(1, images=image_set(PAIR, APriori(0.5, 0.1, 0.0)))
    geodetic = geocentric_to_geodetic(block.ground)
    slope, middle = 8100.0, geodetic[:, 0].mean()
    level = geodetic[:, 2].mean()
    true = level + slope * (geodetic[:, 0] - middle)
    block = simulate_at(block, np.column_stack([geodetic[:, :2], true]))
    prior = HeightPrior(lambda longitude, latitude: level + slope * (longitude - middle), 2.0)
    start = intersect(block.images, block.rays, len(block.ground))
    images, rays, result = adjust_with_heights(block.images, block.rays, start, prior)
    assert result.converged and result.accepted.all()
    error = (local_axes(geodetic) @ (result.ground - block.ground)[:, :, None])[:, :, 0]
    sigma = np.sqrt(np.einsum("nii->ni", rotate_covariance(quality(images, rays, result).point_covariances, local_axes(geodetic))))
    assert np.abs(error[:, 2]).max() < 0.5, "heights were read without error here"
    assert (np.abs(error) < 4.0 * sigma).all()
    assert np.median(sigma[:, 2]) == pytest.approx(2.0, rel=0.05)
    # without them the points are anywhere along their rays
    free = adjust(block.images, block.rays, start)
    assert np.median(np.abs(heights_of(free.ground) - heights_of(block.ground))) > 50.0


def simulate_at(block: Simulated, geodetic: Array) -> Simulated:
    """The block's rays to points elsewhere, with the same measurement errors."""
    rays = block.rays
    ground = geodetic_to_geocentric(geodetic)
    project, theta = block.images.project, block.theta
    before, after = (project(theta, block.images.ground(g), rays.image, rays.point).image for g in (block.ground, ground))
    return replace(block, ground=ground, rays=replace(rays, observed=rays.observed + after - before))


def test_a_height_is_one_observation_along_the_vertical() -> None:
    block = simulate(2, points=25)
    start = intersect(block.images, block.rays, len(block.ground))
    images, rays, result = adjust_with_heights(block.images, block.rays, start, constant_height(500.0, 300.0))
    assert result.accepted.all()
    found = quality(images, rays, result)
    assert found.redundancy == 2 * len(block.rays) - 3 * 25 + 25
    # densely: rays, a priori model, heights
    linear = linearise(block.images, block.rays, result.theta[:3], result.ground, result.ground)
    design, right = np.zeros((2 * len(block.rays) + 25, 75 + 3 * P)), np.zeros(2 * len(block.rays) + 25)
    for i in range(len(block.rays)):
        j, m = block.rays.point[i], block.rays.image[i]
        design[2 * i : 2 * i + 2, 3 * j : 3 * j + 3] = linear.by_ground[i]
        design[2 * i : 2 * i + 2, 75 + P * m : 75 + P * m + P] = linear.by_parameters[i]
        right[2 * i : 2 * i + 2] = linear.y[i]
    up = local_axes(geocentric_to_geodetic(result.ground))[:, 2]
    for j in range(25):
        design[2 * len(block.rays) + j, 3 * j : 3 * j + 3] = up[j] / 300.0
        right[2 * len(block.rays) + j] = (500.0 - heights_of(result.ground)[j]) / 300.0
    normal = design.T @ design
    normal[75:, 75:] += np.linalg.inv((block.images.prior @ block.images.prior.T).toarray())
    unknown = np.linalg.solve(normal, design.T @ right)
    np.testing.assert_allclose(unknown[:75], 0.0, atol=1e-5)
    np.testing.assert_allclose(unknown[75:].reshape(3, P), result.theta[:3], atol=1e-6)
    covariance = np.linalg.inv(normal)
    points = covariance[:75, :75]
    np.testing.assert_allclose(found.joint_covariance(np.arange(25)), points, rtol=0.0, atol=1e-7 * points.max())
    np.testing.assert_allclose(found.image_covariance[: 3 * P, : 3 * P], covariance[75:, 75:], rtol=0.0, atol=1e-8 * covariance.max())


def test_a_height_that_is_wrong_is_rejected() -> None:
    block = simulate(3)
    truth = heights_of(block.ground)
    known = truth.copy()
    known[7] += 400.0
    at = geocentric_to_geodetic(block.ground)[:, :2]
    start = adjusted(block).ground

    def surface(longitude: Array, latitude: Array) -> Array:
        return np.asarray(known[np.abs(np.stack([longitude, latitude], axis=1)[:, None] - at).sum(axis=2).argmin(axis=1)])

    _, rays, result = adjust_with_heights(block.images, block.rays, start, HeightPrior(surface, 5.0))
    wrong = np.flatnonzero((rays.image == 3) & (rays.point == 7))
    assert not result.accepted[wrong].any()
    assert result.accepted.sum() == len(rays) - 1


def test_points_outside_the_grid_have_no_height() -> None:
    block = simulate(4)
    geodetic = geocentric_to_geodetic(block.ground)
    east = np.median(geodetic[:, 0])
    grid = height_grid(np.array([5.0, east]), np.array([43.0, 44.0]), np.full((2, 2), 500.0), 300.0)
    start = adjusted(block).ground
    _, rays, result = adjust_with_heights(block.images, block.rays, start, grid)
    seen = np.isin(np.arange(len(block.ground)), rays.point[rays.image == 3])
    inside = geocentric_to_geodetic(result.ground)[:, 0] <= east
    assert result.converged and 5 < seen.sum() < 55
    np.testing.assert_array_equal(seen, inside)


def test_a_grid_is_bilinear() -> None:
    longitudes, latitudes = np.array([10.0, 11.0, 13.0]), np.array([-1.0, 0.0])
    heights = np.array([[0.0, 10.0, 30.0], [100.0, 110.0, np.nan]])
    surface = height_grid(longitudes, latitudes, heights, 1.0).surface
    found = surface(np.array([10.5, 11.0, 12.0, 12.0, 9.9, 13.1, 10.0, 370.5]), np.array([-0.5, 0.0, -1.0, -0.5, -0.5, -0.5, 0.1, -0.5]))
    np.testing.assert_allclose(found, [55.0, np.nan, np.nan, np.nan, np.nan, np.nan, np.nan, 55.0])
    assert surface(np.array([10.9]), np.array([0.0]))[0] == pytest.approx(109.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: constant_height(100.0, 0.0), "sigma is 0"),
        (lambda: constant_height(100.0, float("nan")), "sigma is nan"),
        (lambda: constant_height(float("nan"), 1.0), "height is nan"),
        (lambda: height_grid(np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.zeros((2, 2)), 1.0), "longitudes do not ascend"),
        (lambda: height_grid(np.array([0.0, 1.0]), np.array([0.0]), np.zeros((1, 2)), 1.0), "latitudes do not ascend"),
        (lambda: height_grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.zeros((3, 2)), 1.0), "expected latitudes x longitudes, 2 x 2"),
    ],
)  # fmt: skip
def test_heights_that_are_none(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


def test_a_grid_on_disk(tmp_path: Path) -> None:
    axes = {"longitudes": np.array([10.0, 11.0]), "latitudes": np.array([0.0, 1.0])}
    np.savez(tmp_path / "grid.npz", **axes, heights=np.array([[0.0, 10.0], [20.0, 30.0]]))
    prior = read_height_grid(tmp_path / "grid.npz", 2.0)
    assert prior.surface(np.array([10.5]), np.array([0.5])).tolist() == [15.0] and prior.sigma == 2.0
    np.savez(tmp_path / "short.npz", **axes)
    np.savez(tmp_path / "odd.npz", **axes, heights=np.zeros((2, 3)))
    np.savez(tmp_path / "text.npz", **axes, heights=np.array([["a", "b"], ["c", "d"]]))
    np.save(tmp_path / "one.npy", np.zeros(3))
    (tmp_path / "mine.npz").write_text("mine")
    (tmp_path / "empty.npz").write_text("")
    for name, message in (
        ("nowhere.npz", "cannot be read as a grid"), ("mine.npz", "cannot be read as a grid"), ("empty.npz", "cannot be read as a grid"),
        ("one.npy", "a single array"), ("text.npz", "cannot be read as a grid"),
        ("short.npz", "array 'heights' is missing"), ("odd.npz", "the grid is 2 x 3"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message) as raised:
            read_height_grid(tmp_path / name, 2.0)
        assert str(raised.value).startswith(f"{tmp_path / name}: ")
    with pytest.raises(InputError, match="sigma is -1"):
        read_height_grid(tmp_path / "grid.npz", -1.0)
