"""Blocks fused into a sub-MIN by low-rank updates, against one factorisation of everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from property.ray_networks import Network, P, assert_close, random_network

from submin.adjustment.elimination import Sums
from submin.adjustment.priors import APriori
from submin.network import low_rank
from submin.network.low_rank import Fused, fuse, update
from submin.network.sub_min import SubMin, add_sums, factor

# a smaller seed is not a simpler network: nothing to shrink
EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
SEEDS = st.integers(0, 2**32 - 1)
NOTHING = SubMin(np.empty(0, np.int32), np.empty((0, P)), np.empty((0, 0)), 0.0, 0)


def updated(network: Network, state: SubMin, known: list[int], new: list[int]) -> Fused:
    images = network.rows([*known, *new])
    found = update(state, network.arrival(known, new), images, network.image_set(images))
    assert found is not None
    return found


def one_after_another(network: Network, groups: list[list[int]], state: SubMin = NOTHING, known: tuple[int, ...] = ()) -> SubMin:
    done = list(known)
    for group in groups:
        state = updated(network, state, done, group).sub_min
        done += group
    return state


def assert_same(found: SubMin, expected: SubMin) -> None:
    np.testing.assert_array_equal(found.images, expected.images)
    sigma = np.sqrt(np.diag(expected.covariance))
    assert_close(found.theta.ravel() / sigma, expected.theta.ravel() / sigma)
    assert_close(found.covariance / sigma / sigma[:, None], expected.covariance / sigma / sigma[:, None])
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    assert found.chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    assert found.redundancy == expected.redundancy


def grouping(network: Network, seed: int) -> list[list[int]]:
    """The blocks in random order, in groups of random size."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(network.blocks)
    cuts = np.flatnonzero(rng.random(len(order) - 1) < 0.6) + 1
    return [part.tolist() for part in np.split(order, cuts)]


@EXAMPLES
@given(SEEDS)
def test_any_order_and_grouping_is_one_factorisation_of_everything(seed: int) -> None:
    network = random_network(seed)
    assert_same(one_after_another(network, grouping(network, seed)), network.factored(range(network.blocks)))


@EXAMPLES
@given(SEEDS)
def test_many_rays_in_parameter_space_are_one_factorisation_too(seed: int) -> None:
    network = random_network(seed, points=90, images=6)
    assert_same(one_after_another(network, grouping(network, seed)), network.factored(range(network.blocks)))


def test_both_spaces_are_used() -> None:
    few, many = random_network(1), random_network(1, points=90, images=6)
    assert updated(few, few.factored([0, 1]), [0, 1], [2]).rank < 2 * few.of_blocks([2]).sum()
    rank = updated(many, many.factored([0, 1]), [0, 1], [2]).rank
    assert rank <= 6 * P < many.of_blocks([2]).sum()


def test_the_cheaper_way_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    network = random_network(7, points=30, images=8)
    images = network.rows(range(4))
    state, (_, sums) = network.factored([0, 1, 2]), network.sums(network.of_blocks([0, 1, 2]))
    arguments = state, network.arrival([0, 1, 2], [3]), images, network.image_set(images)
    asked = []

    def known() -> Sums:
        asked.append(True)
        return sums

    monkeypatch.setattr(low_rank, "PASSES", 0.0)
    for costs, low, calls in ((1e9, True, 0), (0.0, False, 1)):
        monkeypatch.setattr(low_rank, "INVERSE_COSTS", costs)
        found = fuse(*arguments, known)
        assert (found.low_rank, len(asked)) == (low, calls)
        assert_same(found.sub_min, network.factored(range(4)))


def test_a_small_block_in_a_large_tile_is_a_low_rank_update_and_a_large_one_is_not() -> None:
    update_costs, factor_costs = low_rank._update_costs, low_rank._factor_costs
    assert update_costs(900, 180, 2000) < 0.2 * factor_costs(2000)
    assert update_costs(8000, 1500, 2000) > factor_costs(2000)


def test_images_that_cannot_be_predicted_without_loss_are_factored() -> None:
    network = replace(random_network(11), model=APriori(10.0, 1.0, 1.0))  # all of a pass have one and the same shift
    known, new = [0, 1, 3], [2]  # the passes of block 2 have images already
    images = network.rows([*known, *new])
    state, (_, sums) = network.factored(known), network.sums(network.of_blocks(known))
    arguments = state, network.arrival(known, new), images, network.image_set(images)
    assert update(*arguments) is None
    found = fuse(*arguments, lambda: sums)
    assert not found.low_rank
    assert_same(found.sub_min, network.factored([*known, *new]))


def test_images_without_rays_that_tell_anything_join_with_their_prior() -> None:
    network = random_network(2)
    state = network.factored([0, 1])
    images = np.arange(network.images, dtype=np.int32)
    nothing = replace(network.arrival([0, 1], [2]), weight=np.zeros(len(network.arrival([0, 1], [2]).weight)))
    found = update(state, nothing, images, network.image_set(images))
    assert found is not None and (found.rank, found.redundancy, found.chi_square) == (0, 0, 0.0)
    _, sums = network.sums(network.of_blocks([0, 1]))
    expected = factor(add_sums([(state.images, sums)], images, P), images, network.image_set(images))
    assert_same(found.sub_min, expected)


def test_the_state_before_is_left_as_it_was() -> None:
    network = random_network(9)
    state = network.factored([1, 2])
    theta, covariance = state.theta.copy(), state.covariance.copy()
    updated(network, state, [1, 2], [0])
    np.testing.assert_array_equal(state.theta, theta)
    np.testing.assert_array_equal(state.covariance, covariance)


def test_what_a_block_adds_to_the_squares_is_chi_square() -> None:
    # the block's own test against the network: y'y and the squares that it alone leaves, with its redundancy
    network, rng = random_network(21, rejected=0.0), np.random.default_rng(6)
    images = network.rows(range(4))
    k = network.image_set(images).prior
    point, linear = network.point, network.linear
    at = np.searchsorted(images, linear.image)
    squares, degrees = [], 0
    for _ in range(300):
        theta = np.asarray(k @ rng.normal(size=k.shape[1])).reshape(-1, P)
        y = np.einsum("rcp,rp->rc", linear.by_parameters, theta[at]) + rng.normal(size=linear.y.shape)
        y += np.einsum("rck,rk->rc", linear.by_ground, rng.normal(0.0, 50.0, (network.points, 3))[point])
        drawn = replace(network, linear=replace(linear, y=y))
        found = updated(drawn, drawn.factored([0, 1, 2]), [0, 1, 2], [3])
        squares.append(found.chi_square)
        degrees = found.redundancy
    assert degrees > 5
    assert abs(np.mean(squares) - degrees) < 4.0 * np.sqrt(2.0 * degrees / len(squares))


@pytest.mark.parametrize(("difference", "told"), [(1e-3, True), (1e-9, False), (0.0, False)])
def test_nearly_equal_images_predict_nothing_without_loss(difference: float, told: bool) -> None:
    within = np.array([[4.0, 4.0 - difference], [4.0 - difference, 4.0]])
    found = low_rank._prediction(within, np.array([[2.0, 2.0]]))
    assert (found is not None) == told
    if found is not None:
        assert_close(found @ within, np.array([[2.0, 2.0]]), 1e-11)
