"""Rays and points that come into a cell and go out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from hypothesis import given
from registering import EXAMPLES, NOTHING, ROW, SEEDS, THERE, Fused, P, arriving, assert_same, observed, places

from submin.network.cell import RegisteredPoints, empty_cell, with_points, without_points
from submin.network.registration import (
    IN_THE_NETWORK,
    taken_out,
    together,
)


def test_rays_taken_out_are_all_rays_of_the_chosen_points() -> None:
    fused = Fused()
    ground = places([35.0, 37.0, 39.0], [45.0, 46.0, 47.0])
    fused.add(arriving(["a", "b", "c"], ground, [1, 3]))
    cell, _ = fused.cell_of("b")
    assert len(cell) == 3
    rays = taken_out(cell, np.array([True, False, True]))
    assert len(rays) == 4
    assert rays.block.tolist() == [IN_THE_NETWORK] * 4
    expected = {("a", ROW + 1), ("a", ROW + 3), ("c", ROW + 1), ("c", ROW + 3)}
    assert set(zip(rays.point_ids.tolist(), rays.image.tolist(), strict=True)) == expected
    for k in range(4):
        j, image = "abc".index(rays.point_ids[k]), int(rays.image[k]) - ROW
        np.testing.assert_array_equal(rays.observed[k], observed(ground, image)[j])
    np.testing.assert_array_equal(rays.sigma, 0.3)
    assert len(taken_out(cell, np.zeros(3, dtype=np.bool_))) == 0


def test_blocks_can_be_put_together_and_left_out() -> None:
    parts = [arriving(["a"], THERE, [0], block=0), arriving(["a long name"], THERE, [1], block=1), arriving(["c"], THERE, [2], block=2)]
    rays = together(parts)
    assert len(rays) == 3 and len(NOTHING) == 0
    assert rays.point_ids.tolist() == ["a", "a long name", "c"]
    kept = rays.take(rays.block != 1)
    assert kept.point_ids.tolist() == ["a", "c"] and kept.block.tolist() == [0, 2]
    for name in ("image", "observed", "sigma"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(rays, name)[[0, 2]])
    assert (rays.image.dtype, rays.block.dtype) == (np.int32, np.int32)


def random_points(rng: np.random.Generator, ids: Sequence[str]) -> RegisteredPoints:
    """Points with one to four rays each, in any order, seen by some of a dozen images."""
    count = rng.integers(1, 5, len(ids))
    point = rng.permutation(np.repeat(np.arange(len(ids)), count)).astype(np.int32)
    r = len(point)
    return RegisteredPoints(
        np.array(ids, dtype=np.str_), rng.normal(0.0, 4e6, (len(ids), 3)), point,
        rng.choice(12, r).astype(np.int32), rng.normal(5e3, 1e3, (r, 2)), rng.uniform(0.3, 1.0, (r, 2)),
    )  # fmt: skip


def random_ids(rng: np.random.Generator) -> tuple[list[str], list[str]]:
    """Two sets of ids, neither of which need have any."""
    ids = [f"{'abcde'[int(rng.integers(5))]}/{i}" for i in range(int(rng.integers(0, 25)))]
    ids = rng.permutation(np.array(ids, dtype=np.str_)).tolist()
    half = int(rng.integers(0, len(ids) + 1))
    return ids[:half], ids[half:]


@EXAMPLES
@given(SEEDS)
def test_points_that_come_and_go_leave_no_trace(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mine, theirs = random_ids(rng)
    cell = with_points(empty_cell(7, P), random_points(rng, mine))
    # adjusted meanwhile
    cell = replace(
        cell, linearised_at=cell.origin + rng.normal(size=cell.origin.shape), theta=rng.normal(size=cell.theta.shape),
        rays=cell.rays.with_accepted(rng.uniform(size=len(cell.rays)) < 0.7),
    )  # fmt: skip
    new = random_points(rng, theirs)
    more = with_points(cell, new)
    assert more.point_ids.tolist() == sorted(mine + theirs)
    assert len(more.rays) == len(cell.rays) + len(new.point)
    assert_same(without_points(more, new.point_ids), cell)
    # ids that the cell does not hold are no matter
    assert_same(without_points(cell, new.point_ids), cell)
    assert_same(without_points(more, more.point_ids), empty_cell(7, P))


@EXAMPLES
@given(SEEDS)
def test_points_that_go_and_come_back_are_as_they_were(seed: int) -> None:
    rng = np.random.default_rng(seed)
    staying, leaving = random_ids(rng)
    points = random_points(rng, staying + leaving)
    cell = with_points(empty_cell(7, P), points)
    chosen = np.isin(cell.point_ids, leaving)
    rays = taken_out(cell, chosen)
    ids, row = np.unique(rays.point_ids, return_inverse=True)
    order = rng.permutation(len(rays))
    back = RegisteredPoints(
        ids, cell.origin[chosen], row.astype(np.int32)[order], rays.image[order], rays.observed[order], rays.sigma[order]
    )  # fmt: skip
    less = without_points(cell, np.array(leaving, dtype=np.str_))
    assert less.point_ids.tolist() == sorted(staying)
    np.testing.assert_array_equal(less.images, np.unique(cell.images[cell.rays.image[~chosen[cell.rays.point]]]))
    assert_same(with_points(less, back), cell)
    # in whatever order they came first
    first, then = (random_points(np.random.default_rng(seed + k), part) for k, part in ((1, staying), (2, leaving)))
    assert_same(with_points(with_points(empty_cell(7, P), first), then), with_points(with_points(empty_cell(7, P), then), first))


@EXAMPLES
@given(SEEDS)
def test_a_cell_keeps_what_its_points_came_with(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mine, theirs = random_ids(rng)
    parts = [random_points(rng, ids) for ids in (mine, theirs)]
    cell = with_points(with_points(empty_cell(7, P), parts[0]), parts[1])
    origin = {str(i): o for part in parts for i, o in zip(part.point_ids, part.origin, strict=True)}
    np.testing.assert_array_equal(cell.origin, np.array([origin[i] for i in cell.point_ids.tolist()]).reshape(-1, 3))
    came = sorted(
        (str(part.point_ids[p]), int(i), *o, *s)
        for part in parts
        for p, i, o, s in zip(part.point, part.image, part.observed.tolist(), part.sigma.tolist(), strict=True)
    )
    found = zip(cell.point_ids[cell.rays.point].tolist(), cell.images[cell.rays.image].tolist(), *cell.rays.observed.T.tolist(),
                *cell.rays.sigma.T.tolist(), strict=True)  # fmt: skip
    assert sorted(found) == came
    assert cell.rays.accepted.all() and not cell.theta.any()
