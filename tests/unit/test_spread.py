"""A number of points out of many: exactly so many, without gaps, the better ones, whatever order they come in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist

from submin.query.spread import spread_rows

EXAMPLES = settings(max_examples=30, deadline=None)


def named(n: int) -> NDArray[np.str_]:
    return np.array([f"P{k:05d}" for k in range(n)])


def clumped(seed: int, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places of which half lie together within ten metres, some at one place; and variances over two decades."""
    random = np.random.default_rng(seed)
    place = random.uniform(0.0, 50_000.0, (n, 2)) + 1e6
    place[: n // 2] = place[0] + random.normal(0.0, 10.0, (n // 2, 2))
    place[: n // 10] = place[0]
    return place, 10.0 ** random.uniform(-2.0, 0.0, n)


@EXAMPLES
@given(st.integers(0, 2**31), st.integers(1, 300), st.integers(1, 320))
def test_exactly_as_many_as_asked_for_in_any_order(seed: int, n: int, most: int) -> None:
    place, variance = clumped(seed, n)
    chosen = spread_rows(place, variance, named(n), most)
    assert len(chosen) == min(most, n)
    assert (np.diff(chosen) > 0).all()
    order = np.random.default_rng(seed + 1).permutation(n)
    turned = spread_rows(place[order], variance[order], named(n)[order], most)
    assert sorted(order[turned].tolist()) == chosen.tolist()


@pytest.mark.parametrize("most", [1, 2, 10, 99, 1000])
def test_round_off_does_not_choose(most: int) -> None:
    place, variance = clumped(1, 2000)
    noisy = variance * (1.0 + 1e-14 * np.random.default_rng(2).normal(size=2000))
    np.testing.assert_array_equal(spread_rows(place, noisy, named(2000), most), spread_rows(place, variance, named(2000), most))


@pytest.mark.parametrize("most", [9, 100, 700])
def test_even_points_stay_even(most: int) -> None:
    """No place is farther from a chosen point than twice the best that so many could do, and no two are close to each other."""
    random = np.random.default_rng(most)
    place, variance = random.uniform(0.0, 1e5, (10_000, 2)), random.uniform(1.0, 2.0, 10_000)
    chosen = place[spread_rows(place, variance, named(10_000), most)]
    best = 1e5 / np.sqrt(np.pi * most)  # radius of discs of the same area
    assert KDTree(chosen).query(place)[0].max() < 2.0 * best
    at_random = place[random.choice(10_000, most, replace=False)]
    assert KDTree(chosen).query(place)[0].max() < 0.8 * KDTree(at_random).query(place)[0].max()
    assert pdist(chosen).min() > best


def test_good_points_come_before_their_neighbours() -> None:
    random = np.random.default_rng(6)
    place, variance = random.uniform(0.0, 1e5, (10_000, 2)), 10.0 ** random.uniform(-2.0, 0.0, 10_000)
    chosen = spread_rows(place, variance, named(10_000), 100)
    assert (variance[chosen] < np.quantile(variance, 0.05)).mean() > 0.7  # five of a hundred, were they taken at random


def test_a_clump_does_not_keep_others_out_and_fills_what_is_asked_for() -> None:
    """A grid of which the clump is one square would give a dozen points where fifty are wanted."""
    random = np.random.default_rng(3)
    clump, apart = random.normal(0.0, 5.0, (1000, 2)), random.uniform(2e4, 9e4, (10, 2))
    place = np.concatenate([clump, apart])
    chosen = spread_rows(place, np.ones(1010), named(1010), 50)
    assert len(chosen) == 50
    assert set(range(1000, 1010)) <= set(chosen.tolist())
    assert pdist(place[chosen[chosen < 1000]]).min() > 1.0


def test_of_points_at_the_same_place_the_better_one_is_taken() -> None:
    random = np.random.default_rng(4)
    place, variance = np.repeat(random.uniform(0.0, 1e4, (200, 2)), 2, axis=0), np.tile([4.0, 1.0], 200)
    for most in (1, 7, 60, 200):
        assert (variance[spread_rows(place, variance, named(400), most)] == 1.0).all()


def test_one_point_is_the_best_of_all_and_the_first_of_equals() -> None:
    place, variance = clumped(5, 300)
    assert spread_rows(place, variance, named(300), 1).tolist() == [int(np.argmin(variance))]
    assert spread_rows(place, np.ones(300), named(300)[::-1], 1).tolist() == [299]


def test_points_all_at_one_place() -> None:
    assert spread_rows(np.zeros((5, 2)), np.array([5.0, 1.0, 2.0, 4.0, 3.0]), named(5), 3).tolist() == [1, 2, 4]
