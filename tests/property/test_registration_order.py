"""Registration does not depend on when rays come and with which others; every ray is in one cell, exactly once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from registering import COVER, EXAMPLES, IMAGES, ROW, ROWS, SEEDS, THERE, VIEWS, Fused, arriving, assert_same_network, cell_at, places

from submin.network.id_numbers import numbered
from submin.network.registration import (
    LooseRays,
    arranged,
    by_points,
    joined,
    locate,
    register,
    together,
)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_three_rays_in_any_order_or_together_register_alike(order: tuple[int, ...]) -> None:
    fused, at_once = Fused(), Fused()
    at_once.add(arriving(["p"], THERE, [0, 1, 2]))
    for image in order:
        fused.add(arriving(["p"], THERE, [image]))
    assert_same_network(fused, at_once)


def test_row_of_an_image_in_the_network_leaves_no_trace() -> None:
    rng = np.random.default_rng(8)
    ids = [f"p{i:02d}" for i in range(30)]
    rays = arriving(ids, places(rng.uniform(-550.0, 550.0, 30).tolist(), rng.uniform(-550.0, 550.0, 30).tolist()), range(5))
    rays = rays.take(rng.uniform(size=len(rays)) < 0.6)
    expected = register(rays, IMAGES, ROWS, COVER)
    for order in ([4, 3, 2, 1, 0], [2, 0, 4, 1, 3]):
        # image k of the set is now in row 100 + 7 times its place in the order
        place = np.argsort(order)
        rows = (100 + 7 * np.arange(5)).astype(np.int32)
        moved = replace(rays, image=rows[place[rays.image - ROW]])
        found = register(moved, IMAGES.take(order), rows, COVER)
        np.testing.assert_array_equal(found.directory[0], expected.directory[0])
        np.testing.assert_array_equal(found.directory[1], expected.directory[1])
        np.testing.assert_array_equal(found.apart, expected.apart)
        assert found.arrivals.keys() == expected.arrivals.keys()
        for number, points in found.arrivals.items():
            np.testing.assert_array_equal(points.origin, expected.arrivals[number].origin)


@dataclass(frozen=True)
class Blocks:
    """Random blocks: each brings the rays of one image, of points that the others see too."""

    ids: list[str]
    rays: tuple[LooseRays, ...]

    @classmethod
    def random(cls, seed: int, wild: float = 0.0) -> Blocks:
        """``wild``: share of the rays that point hundreds of metres elsewhere."""
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 30))
        ids = [f"p{'x' * int(rng.integers(0, 5))}{i:02d}" for i in range(n)]
        ground = places(rng.uniform(-800.0, 800.0, n).tolist(), rng.uniform(-800.0, 800.0, n).tolist())
        every = []
        for image in range(len(VIEWS)):
            rays = arriving(ids, ground, [image], block=image)
            off = (rng.uniform(size=n) < wild)[:, None] * rng.uniform(-900.0, 900.0, (n, 2))
            rays = replace(rays, observed=rays.observed + off, sigma=rng.uniform(0.1, 1.0, (n, 2)))
            some = rays.take(rng.permutation(n)[: rng.integers(0, n + 1)])  # type: ignore[arg-type]
            # now and then a point is measured twice in an image
            every.append(together([some, replace(some, observed=some.observed + 0.2).take(rng.uniform(size=len(some)) < 0.1)]))
        return cls(ids, tuple(every))

    def some(self, images: Sequence[int]) -> LooseRays:
        """The rays of some images, one block after another."""
        return together([self.rays[image] for image in images])


def in_groups(rng: np.random.Generator, images: Sequence[int]) -> list[list[int]]:
    """Images in random order, cut into random groups."""
    shuffled = rng.permutation(np.array(images, dtype=np.int64))
    cuts = np.flatnonzero(rng.uniform(size=max(len(shuffled) - 1, 0)) < 0.6) + 1
    return [group.tolist() for group in np.split(shuffled, cuts)]


@EXAMPLES
@given(SEEDS, st.sampled_from([0.0, 0.2]))
def test_cells_do_not_depend_on_the_order_and_grouping_of_arrival(seed: int, wild: float) -> None:
    blocks, rng = Blocks.random(seed, wild), np.random.default_rng(seed + 1)
    at_once, fused = Fused(), Fused()
    at_once.add(blocks.some(range(5)))
    for group in in_groups(rng, range(5)):
        rays = blocks.some(group)
        fused.add(rays.take(rng.permutation(len(rays))))  # type: ignore[arg-type]
    assert_same_network(fused, at_once)


@EXAMPLES
@given(SEEDS, st.sampled_from([0.0, 0.2]))
def test_every_ray_is_in_one_cell_exactly_once(seed: int, wild: float) -> None:
    blocks, rng, fused = Blocks.random(seed, wild), np.random.default_rng(seed + 1), Fused()
    came: list[int] = []
    for group in in_groups(rng, range(5)):
        fused.add(blocks.some(group))
        came += group
        rays = blocks.some(came)
        expected = zip(rays.point_ids.tolist(), rays.image.tolist(), *rays.observed.T.tolist(), strict=True)
        assert fused.rays() == sorted(expected)
        for point in np.unique(rays.point_ids):
            cell, row = fused.cell_of(str(point))
            assert cell.number == cell_at(cell.origin[row])
        for cell in fused.cells.values():
            assert cell.point_ids.tolist() == sorted(set(cell.point_ids.tolist()))
            np.testing.assert_array_equal(cell.images, np.unique(cell.images[cell.rays.image]))
            np.testing.assert_array_equal(np.unique(cell.rays.point), np.arange(len(cell)))


@EXAMPLES
@given(SEEDS, st.sampled_from([0.0, 0.2]))
def test_withdrawn_images_leave_a_network_that_never_had_them(seed: int, wild: float) -> None:
    # images come and go and come again, one or several at a time, in any order
    blocks, rng, fused = Blocks.random(seed, wild), np.random.default_rng(seed + 1), Fused()
    here: set[int] = set()
    for _ in range(6):
        group = rng.permutation(5)[: rng.integers(1, 4)].tolist()
        new, old = [i for i in group if i not in here], [i for i in group if i in here]
        if new:
            fused.add(blocks.some(new))
        if old:
            fused.withdraw(old)
        here = (here | set(new)) - set(old)
        never = Fused()
        never.add(blocks.some(sorted(here)))
        assert_same_network(fused, never)
        assert all(np.isin(cell.images - ROW, sorted(here)).all() for cell in fused.cells.values())
    fused.withdraw(here)
    assert not fused.cells


def test_a_withdrawn_ray_changes_no_point_that_it_does_not_see() -> None:
    blocks, fused = Blocks.random(3), Fused()
    fused.add(blocks.some(range(5)))
    registration = fused.withdraw([4])
    seen = set(blocks.rays[4].point_ids.tolist())
    others = set(blocks.some(range(4)).point_ids.tolist())
    assert seen - others and seen & others and others - seen
    # of a point that only it saw nothing is left to be registered
    assert set(registration.directory[0].tolist()) == seen & others
    for point in seen - others:
        assert not fused.rays_of(point) and not any(point in cell.point_ids for cell in fused.cells.values())


@EXAMPLES
@given(SEEDS)
def test_company_does_not_matter(seed: int) -> None:
    # each point by itself is registered, bit by bit, as among all others
    rays = Blocks.random(seed, 0.2).some(range(5))
    whole = register(rays, IMAGES, ROWS, COVER)
    origin = {str(i): o for points in whole.arrivals.values() for i, o in zip(points.point_ids, points.origin, strict=True)}
    for point, number in zip(*whole.directory, strict=True):
        mine = rays.point_ids == point
        alone = register(rays.take(mine), IMAGES, ROWS, COVER)
        assert alone.directory[1].tolist() == list(alone.arrivals) == [number]
        np.testing.assert_array_equal(alone.arrivals[int(number)].origin[0], origin[str(point)])
        np.testing.assert_array_equal(alone.apart, whole.apart[whole.directory[0] == point])
        np.testing.assert_array_equal(alone.outside, whole.outside[mine])


@EXAMPLES
@given(SEEDS, st.integers(1, 40))
def test_parts_put_together_are_the_whole(seed: int, parts: int) -> None:
    rays = Blocks.random(seed, 0.2).some(range(5))
    whole = register(rays, IMAGES, ROWS, COVER)
    rows = by_points(rays, parts)
    assert sorted(np.concatenate(rows).tolist()) == list(range(len(rays)))
    found = arranged(rays, joined([locate(rays.take(part), IMAGES, ROWS, COVER) for part in rows], rows))
    for name in ("apart", "counts", "outside"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    for k in range(2):
        np.testing.assert_array_equal(found.directory[k], whole.directory[k])
    assert found.arrivals.keys() == whole.arrivals.keys()
    for number, points in found.arrivals.items():
        expected = whole.arrivals[number]
        np.testing.assert_array_equal(points.point_ids, expected.point_ids)
        np.testing.assert_array_equal(points.origin, expected.origin)
        mine, theirs = (sorted(zip(p.point, p.image, *p.observed.T, *p.sigma.T, strict=True)) for p in (points, expected))
        assert mine == theirs


@EXAMPLES
@given(st.lists(st.text(max_size=4).filter(lambda text: "\0" not in text), max_size=30))
def test_numbers_of_texts_are_those_of_unique(texts: list[str]) -> None:
    expected, place = np.unique(np.array(texts, dtype=np.str_), return_inverse=True)
    found, at = numbered(np.array(texts, dtype=np.str_))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(at, place)


@pytest.mark.parametrize("twin", ["a twin", "twin"])
def test_points_of_other_names_in_the_cell_that_the_directory_names_are_not_taken_for_it(twin: str) -> None:
    # two ids of one hash: the directory names the cell of the other point
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1]))
    number = fused.cell_of("p")[0].number
    fused.directory[twin] = number
    elsewhere = places([-330.0], [-340.0])
    fused.add(arriving([twin], elsewhere, [0, 1]))
    assert fused.cell_of(twin)[0].number == cell_at(elsewhere[0]) != number
    assert len(fused.rays_of("p")) == 2 and len(fused.rays_of(twin)) == 2
