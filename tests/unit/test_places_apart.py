"""Rays of one point that see two places: how far apart they are, and which block is to blame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from registering import COVER, IMAGES, NOTHING, ROW, ROWS, THERE, Array, Fused, Index, arriving, exactly, image_set, places

from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori
from submin.network.registration import (
    IN_THE_NETWORK,
    SAME_POINT_METRES,
    LooseRays,
    contradictions,
    register,
    together,
)
from submin.sensors.base import Ground, Projection
from submin.sensors.rpc import RpcSensor


def rays_at(images: ImageSet, grounds: Sequence[Array], sigma: Sequence[float] | None = None) -> LooseRays:
    """One exact ray of point ``p`` in each image, each towards a ground point (1, 3) of its own."""
    n = len(grounds)
    return LooseRays.of(
        np.full(n, "p"), np.arange(ROW, ROW + n, dtype=np.int32), np.concatenate([exactly(g, k, images) for k, g in enumerate(grounds)]),
        np.repeat(np.array(sigma or [0.3] * n)[:, None], 2, axis=1), np.ones(n, dtype=np.bool_), np.arange(n, dtype=np.int32),
    )  # fmt: skip


def distance_of_rays(here: Array, there: Array, views: Sequence[tuple[float, float]]) -> float:
    """Shortest distance of the lines of sight through two ground points (east, north, up)."""
    u, v = (np.array([-east, -north, 1.0]) for east, north in views)
    normal = np.cross(u, v)
    return float(abs((there - here) @ normal) / np.linalg.norm(normal))


@pytest.mark.parametrize("tangent", [0.1, 0.3, 0.5])
@pytest.mark.parametrize(
    ("east", "north", "up"), [(0.0, 300.0, 0.0), (200.0, -1500.0, 100.0), (-100.0, 3000.0, -200.0), (900.0, 20.0, 0.0)]
)
@pytest.mark.parametrize("sigma", [(0.3, 0.3), (0.2, 1.0)])
def test_two_rays_of_two_places_are_as_far_apart_as_they_pass_each_other(
    tangent: float, east: float, north: float, up: float, sigma: tuple[float, float]
) -> None:
    views = ((-tangent, 0.0), (tangent, 0.0))
    images = image_set(views)
    registration = register(rays_at(images, [places([0.0], [0.0]), places([east], [north], 400.0 + up)], sigma), images, ROWS[:2], COVER)
    expected = distance_of_rays(np.zeros(3), np.array([east, north, up]), views)
    np.testing.assert_allclose(registration.apart, expected, rtol=5e-3)


@pytest.mark.parametrize(("here", "there"), [(1, 1), (1, 5), (2, 3), (2, 12), (9, 2), (6, 6)])
def test_two_places_are_as_far_apart_however_many_rays_see_each(here: int, there: int) -> None:
    # views to the west and to the east: height takes nothing up of a distance to the north
    count = here + there
    images = image_set([((-0.1, 0.1)[k % 2], 0.0) for k in range(count)], [f"image {k:02d}" for k in range(count)])
    rows = np.arange(ROW, ROW + count, dtype=np.int32)
    grounds = [places([0.0], [0.0])] * here + [places([0.0], [800.0])] * there
    np.testing.assert_allclose(register(rays_at(images, grounds), images, rows, COVER).apart, 800.0, rtol=5e-3)


def contradicting(rays: LooseRays) -> dict[int, tuple[str, float]]:
    return contradictions(rays, register(rays, IMAGES, ROWS, COVER), IMAGES, ROWS, COVER)


def test_the_block_that_contradicts_what_came_before_is_named_and_no_later_one() -> None:
    far, other = places([3000.0], [-2500.0]), places([-3000.0], [2500.0])
    parts = [
        arriving(["p", "q"], np.concatenate([THERE, THERE]), [0], block=0), arriving(["p"], far, [1], block=1),
        arriving(["p", "q"], np.concatenate([THERE, other]), [2], block=2), arriving(["p"], THERE, [3], block=3),
    ]  # fmt: skip
    rays = together(parts)
    found = contradicting(rays)
    assert {block: point for block, (point, _) in found.items()} == {1: "p", 2: "q"}
    # what the network has comes before every block
    known = together([replace(parts[1], block=np.full(1, IN_THE_NETWORK, dtype=np.int32)), *(parts[k] for k in (0, 3))])
    found = contradicting(known)
    assert {block: point for block, (point, _) in found.items()} == {0: "p", 3: "p"}


def test_a_blunder_that_stage_one_has_found_is_no_second_place() -> None:
    rays = together(
        [arriving(["p"], THERE, [0, 1]), replace(arriving(["p"], places([3000.0], [0.0]), [2], block=1), accepted=np.array([False]))]
    )
    assert not contradicting(rays)


@pytest.mark.parametrize("km", [1.0, 3.0, 5.5, 6.0, 7.0, 8.0])
def test_nor_where_it_draws_the_point_out_of_sight_of_a_camera(km: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a line scanner does, a camera answers only for its image and a little beside it; registration still takes all rays."""
    project, images = RpcSensor.project, replace(IMAGES, cameras=IMAGES.cameras.copy())
    images.cameras[2, -2:] *= 10.0  # half of its size: the camera of the blunder sees far

    def near_the_image(sensor: RpcSensor, cameras: Array, parameters: Array, ground: Ground, image: Index, *more: Any) -> Projection:
        seen = project(sensor, cameras, parameters, ground, image, *more)
        off = np.abs(seen.image - 5000.0).max(axis=1) > 1.06 * cameras[image, -1]
        return replace(seen, image=np.where(off[:, None], np.nan, seen.image))

    good, blunder = arriving(["p"], places([2000.0], [0.0]), [0, 1]), arriving(["p"], places([2000.0 + 1000.0 * km], [0.0]), [2], block=1)
    rays = together([good, replace(blunder, accepted=np.array([False]))])
    monkeypatch.setattr(RpcSensor, "project", near_the_image)
    registration = register(rays, images, ROWS, COVER)
    assert np.isinf(registration.apart[0]) == (km > 2.0)
    assert not contradictions(rays, registration, images, ROWS, COVER)


def test_apart_is_told_of_the_point_and_of_no_other() -> None:
    far = places([3000.0], [-2500.0])
    rays = together([arriving(["p"], THERE, [0, 1]), arriving(["q", "r"], np.concatenate([THERE, far]), [0, 1, 2], block=1),
                     arriving(["p"], far, [2, 3], block=2)])  # fmt: skip
    registration = register(rays, IMAGES, ROWS, COVER)
    of_p, told = registration.directory[0] == "p", registration.apart
    assert told[of_p].min() > SAME_POINT_METRES
    assert told[~of_p].max() < 4.0
    ((block, (point, metres)),) = contradictions(rays, registration, IMAGES, ROWS, COVER).items()
    assert (block, point) == (2, "p")
    assert metres == pytest.approx(told[of_p][0])


@pytest.mark.parametrize(("bias_px", "contradicts"), [(10.0, True), (300.0, True), (700.0, False)])
def test_cameras_known_to_kilometres_only_explain_kilometres(bias_px: float, contradicts: bool) -> None:
    """3 km apart; four sigmas of both axes, half-metre pixels, one camera to each side: 5.7 bias sigmas in metres."""
    images = replace(IMAGES, priors=tuple(replace(prior, a_priori=APriori(bias_px=bias_px)) for prior in IMAGES.priors))
    rays = together([arriving(["p"], THERE, [0, 1]), arriving(["p"], places([3000.0], [0.0]), [2], block=1)])
    assert bool(contradictions(rays, register(rays, images, ROWS, COVER), images, ROWS, COVER)) is contradicts


def test_cameras_found_to_be_bad_explain_no_more_than_before() -> None:
    """What was found depends on what came before; whether a block contradicts must not."""
    rays = together([arriving(["p"], THERE, [0, 1]), arriving(["p"], places([3000.0], [0.0]), [2], block=1)])
    released = IMAGES.release(np.ones(len(IMAGES), dtype=np.bool_))
    assert contradictions(rays, register(rays, released, ROWS, COVER), released, ROWS, COVER) == contradicting(rays) != {}


@pytest.mark.parametrize(("rays_there", "most"), [(1, 1.02), (2, 1.2)])
def test_rays_of_a_known_point_elsewhere_are_apart_from_those_in_the_network(rays_there: int, most: float) -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1, 4]))
    far = places([2315.0], [-1955.0])
    registration = fused.add(arriving(["p"], far, [2, 3][:rays_there]))
    # views that lean to all sides spread further, as no one height suits them
    distance = np.hypot(2280.0, 2000.0)
    told = registration.apart
    assert distance < told.min() <= told.max() < most * distance
    assert told.shape == (1,)


def test_a_single_ray_is_not_apart_from_itself_wherever_it_lies() -> None:
    ground = places([20.0, 900.0, -5000.0], [30.0, -100.0, 6000.0])
    registration = register(arriving(["p", "q", "r"], ground, [1]), IMAGES, ROWS, COVER)
    np.testing.assert_allclose(registration.apart, 0.0, rtol=0.0, atol=1e-6)


def unreachable() -> ImageSet:
    """The images, but the second turns back at 2,500 pixels from its middle: nothing on the ground is seen at sample 9,500."""
    images = replace(IMAGES, cameras=IMAGES.cameras.copy())
    images.cameras[1, 10 + 4 * 7 + 2] = -images.cameras[1, 10 + 4 * 1 + 2]
    return images


def test_rays_that_reach_no_ground_go_nowhere() -> None:
    rays = arriving(["lost", "p"], np.concatenate([THERE, THERE]), [0])
    bad = replace(rays, image=np.array([ROW + 1, ROW], dtype=np.int32), observed=np.array([[9500.0, 5000.0], rays.observed[1]]))
    registration = register(bad, unreachable(), ROWS, COVER)
    assert np.isinf(registration.apart[0]) and registration.apart[1] == 0.0
    assert not registration.outside.any()
    assert [new.point_ids.tolist() for new in registration.arrivals.values()] == [["p"]]
    assert registration.directory[0].tolist() == ["lost", "p"]
    assert registration.directory[1].tolist() == [-1, next(iter(registration.arrivals))]


def test_nothing_but_rays_that_reach_no_ground() -> None:
    rays = replace(arriving(["lost"], THERE, [1]), observed=np.array([[9500.0, 5000.0]]))
    registration = register(rays, unreachable(), ROWS, COVER)
    assert np.isinf(registration.apart).all() and not registration.arrivals
    assert registration.directory[1].tolist() == [-1]


def test_no_rays_are_registered_nowhere() -> None:
    registration = register(NOTHING, IMAGES.take([]), ROWS[:0], COVER)
    assert not registration.arrivals
    assert [len(part) for part in (*registration.directory, registration.apart, registration.outside)] == [0] * 4


def test_points_outside_the_area_are_marked_and_belong_to_the_nearest_core() -> None:
    fused = Fused()
    ground = places([20.0, 900.0], [30.0, 20.0])
    registration = fused.add(arriving(["in", "out"], ground, [0, 1]))
    np.testing.assert_array_equal(registration.outside, [False, True, False, True])
    assert COVER.owner(fused.cell_of("out")[0].number) == 4 * COVER.columns + COVER.columns - 1
