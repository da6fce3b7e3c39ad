"""Laws of the factored form, on random networks: whatever the order, grouping or form of fusing, the answer is that of one adjustment.

The reference is a dense adjustment by QR of all unknowns, or, where rays are nearly parallel, the same in sixty digits.
"""

from __future__ import annotations

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from property.ray_networks import Network, P, assert_close, dense_adjustment, random_network, taken

from benchmarks.factored_drift import drift
from benchmarks.tile_scene import TileScene, tile_scene
from submin.adjustment.elimination import LinearRays, eliminate, point_factors
from submin.adjustment.estimation import estimate_images
from submin.adjustment.images import ImageSet
from submin.adjustment.new_rays import NewRays
from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.network.cell import Cell, empty_cell, summed, with_points, without_points
from submin.network.low_rank import fuse, new_rays, update
from submin.network.sub_min import GroundPart, SubMin, add_sums, factor, joint_covariance, loadings, locate

Array = NDArray[np.float64]
# a smaller seed is not a simpler network: nothing to shrink
EXAMPLES = settings(max_examples=20, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
SEEDS = st.integers(0, 2**32 - 1)
NOTHING = SubMin(np.empty(0, np.int32), np.empty((0, P)), np.empty((0, 0)), 0.0, 0)


def fused(network: Network, state: SubMin, known: list[int], new: list[int], low_rank: bool) -> SubMin:
    """More blocks in a state, in one of the two ways."""
    images = network.rows([*known, *new])
    if low_rank:
        found = update(state, network.arrival(known, new), images, network.image_set(images))
        assert found is not None
        return found.sub_min
    return network.factored([*known, *new])


def ground(network: Network, blocks: list[int], points: NDArray[np.int64]) -> GroundPart:
    """Some points with the rays of some blocks."""
    rays = network.of_blocks(blocks) & np.isin(network.point, points)
    linear = taken(network.linear, rays)
    linear = replace(linear, first=np.concatenate([linear.first[points], linear.first[-1:]]))
    return GroundPart(np.zeros((len(points), 3)), linear, point_factors(linear, network.weight[rays]))


def answer(network: Network, state: SubMin, blocks: list[int], points: NDArray[np.int64]) -> tuple[Array, Array]:
    """Corrections (n, 3) and joint covariance of some points that blocks determine."""
    part = ground(network, blocks, points)
    return locate(part, state), joint_covariance(loadings([part], state.images, P), part.factors.own, state.covariance)


@EXAMPLES
@given(SEEDS)
def test_any_order_grouping_and_form_is_the_simultaneous_adjustment(seed: int) -> None:
    network, rng = random_network(seed), np.random.default_rng(seed)
    order, known = rng.permutation(network.blocks).tolist(), []
    state = NOTHING
    while order:
        count = int(rng.integers(1, len(order) + 1))
        group, order = order[:count], order[count:]
        state = fused(network, state, known, group, low_rank=bool(rng.random() < 0.7))
        known = known + group
    expected = dense_adjustment(network, known)
    np.testing.assert_array_equal(state.images, expected.images)
    assert_close(state.theta.ravel(), expected.theta)
    assert_close(state.covariance, expected.covariance)
    where, joint = answer(network, state, known, expected.points)
    assert_close(where, expected.where)
    assert_close(joint, expected.joint)
    assert state.chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    assert state.redundancy == expected.redundancy


@EXAMPLES
@given(SEEDS)
def test_any_grouping_of_points_into_cells_is_the_simultaneous_adjustment(seed: int) -> None:
    network, rng = random_network(seed), np.random.default_rng(seed)
    cell = rng.integers(0, int(rng.integers(1, 6)), network.points)
    parts = [network.sums(cell[network.point] == number) for number in np.unique(cell)]
    images = np.unique(network.linear.image).astype(np.int32)
    state = factor(add_sums(parts, images, P), images, network.image_set(images))
    expected = dense_adjustment(network, range(network.blocks))
    assert_close(state.theta.ravel(), expected.theta)
    assert_close(state.covariance, expected.covariance)
    assert state.chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    assert state.redundancy == expected.redundancy


@EXAMPLES
@given(SEEDS, st.booleans())
def test_no_block_makes_any_combination_of_old_points_worse(seed: int, low_rank: bool) -> None:
    network, rng = random_network(seed, points=12), np.random.default_rng(seed)
    order = rng.permutation(network.blocks).tolist()
    known = order[:1]
    state = network.factored(known)
    for block in order[1:]:
        points, earlier = dense_adjustment(network, known).points, state
        state = fused(network, state, known, [block], low_rank)
        known = [*known, block]
        if len(points):
            _, before = answer(network, earlier, known[:-1], points)
            _, after = answer(network, state, known, points)
            sigma = np.sqrt(np.diag(before))
            gain = (before - after) / sigma / sigma[:, None]
            assert np.linalg.eigvalsh(gain).min() > -1e-12 * len(gain)


@EXAMPLES
@given(SEEDS)
def test_images_are_never_known_worse_than_before(seed: int) -> None:
    network = random_network(seed)
    state, expected = network.factored([0, 1]), network.rows([0, 1])
    after = fused(network, state, [0, 1], [2, 3], low_rank=True)
    old = (np.searchsorted(after.images, expected)[:, None] * P + np.arange(P)).ravel()
    sigma = np.sqrt(np.diag(state.covariance))
    gain = (state.covariance - after.covariance[np.ix_(old, old)]) / sigma / sigma[:, None]
    assert np.linalg.eigvalsh(gain).min() > -1e-12 * len(gain)


# Cells with cameras


@pytest.fixture(scope="module")
def scene() -> TileScene:
    return tile_scene(60, 3, 2, rays_a_point=5.0, seed=8)


def images_of(scene: TileScene, cell: Cell) -> ImageSet:
    return scene.images.take(cell.images)


def factored(scene: TileScene, cell: Cell) -> SubMin:
    cell = summed(cell, images_of(scene, cell))
    return factor(add_sums([(cell.images, cell.sums)], cell.images, P), cell.images, images_of(scene, cell))


def assert_same(found: SubMin, expected: SubMin, relative: float = 1e-9) -> None:
    np.testing.assert_array_equal(found.images, expected.images)
    sigma = np.sqrt(np.diag(expected.covariance))
    assert_close(found.theta.ravel() / sigma, expected.theta.ravel() / sigma, relative)
    assert_close(found.covariance / sigma / sigma[:, None], expected.covariance / sigma / sigma[:, None], relative)
    assert found.chi_square == pytest.approx(expected.chi_square, rel=relative)
    assert found.redundancy == expected.redundancy


def test_a_triplet_that_is_withdrawn_was_never_there(scene: TileScene) -> None:
    all_in = scene.grown(scene.cell(scene.earlier), scene.earlier, len(scene.images))
    gone = np.isin(scene.image, np.arange(3))
    touched = np.zeros(len(scene.point_ids), dtype=np.bool_)
    touched[scene.point[gone]] = True
    back = scene.points_of(touched[scene.point] & ~gone)
    without = with_points(without_points(all_in, scene.point_ids[touched]), back)
    never = with_points(empty_cell(0, P), scene.points_of(~gone))
    assert set(range(3)).isdisjoint(without.images.tolist())
    assert_same(factored(scene, without), factored(scene, never))


def test_a_triplet_by_a_low_rank_update_is_the_factorisation_of_the_cell_with_it(scene: TileScene) -> None:
    before = scene.cell(scene.earlier)
    after = scene.grown(before, scene.earlier, len(scene.images))
    coming = after.images >= scene.earlier
    found = update(factored(scene, before), new_rays(after, images_of(scene, after), coming), after.images, images_of(scene, after))
    assert found is not None and found.low_rank
    assert_same(found.sub_min, factored(scene, after))


def test_a_block_is_not_fused_twice(scene: TileScene) -> None:
    before = scene.cell(scene.earlier)
    with pytest.raises(InputError, match=r"cell 0: holds \d+ of the points already, P\d+ among them, and their rays would count twice"):
        with_points(before, scene.points_of(scene.image < 3))
    network = random_network(4)
    again = network.arrival([0, 1], [2])
    twice = LinearRays(
        2 * again.linear.first,
        *(np.repeat(getattr(again.linear, name), 2, axis=0) for name in ("image", "by_ground", "by_parameters", "y")),
    )
    known = np.tile([False, True], len(again.new))
    with pytest.raises(InputError, match=r"\d+ of \d+ new rays are known already, that of point \d+ in image \d+ among them"):
        NewRays(twice, np.repeat(again.weight, 2), known)


# Points that wait


def rays_that_come_one_by_one(seed: int, points: int = 10, images: int = 10) -> Network:
    """Points whose first two rays, in images of other blocks, are parallel to the last bit."""
    network = random_network(seed, points, images, rejected=0.0)
    first = network.linear.first
    by_ground = network.linear.by_ground.copy()
    for j in np.flatnonzero(np.diff(first) >= 3):
        by_ground[first[j] + 1] = by_ground[first[j]]
    return replace(network, linear=replace(network.linear, by_ground=by_ground), model=APriori(10.0, 1.0, 0.5))


@EXAMPLES
@given(SEEDS)
def test_pending_and_undetermined_points_enter_when_they_can(seed: int) -> None:
    network = rays_that_come_one_by_one(seed)
    state, known = NOTHING, []
    for block in range(network.blocks):
        state = fused(network, state, known, [block], low_rank=True)
        known.append(block)
        assert_same(state, network.factored(known))


# Rays that meet at a tiny angle

ANGLES = [1e-3, 1e-5, 1e-7, 1e-9]


def narrow_network(angle: float, points: int = 8) -> Network:
    """Three images: the first two see every point under ``angle`` radians, the third sees some of them from elsewhere."""
    rng = np.random.default_rng(3)
    seen = [[0, 2, 4] if j < 3 else [0, 2] for j in range(points)]
    image = np.concatenate(seen).astype(np.int32)
    first = np.cumsum([0, *(len(s) for s in seen)])
    point = np.repeat(np.arange(points), np.diff(first))
    ray = np.column_stack([rng.uniform(-0.5, 0.5, (points, 2)), np.ones(points)])[point]
    ray[image == 2] += angle * np.linalg.norm(ray[image == 2], axis=1)[:, None] * [1.0, 0.0, 0.0]
    ray[image == 4] += [0.4, 0.3, 0.0]
    across = np.cross(ray, [0.0, 1.0, 0.0])
    rows = np.stack([across, np.cross(ray, across)], axis=1)
    by_ground = 2.0 * rows / np.linalg.norm(rows, axis=2)[:, :, None]
    by_parameters = np.zeros((len(image), 2, P))
    place = rng.uniform(-1.0, 1.0, (points, 2))[point] + 0.1 * rng.uniform(-1.0, 1.0, (len(image), 2))
    for c in range(2):
        by_parameters[:, c, 3 * c] = 1.0
        by_parameters[:, c, 3 * c + 1 : 3 * c + 3] = place
    linear = LinearRays(first.astype(np.int64), image, by_ground, by_parameters, np.zeros((len(image), 2)))
    return Network(linear, np.ones(len(image)), 6, APriori(10.0, 1.0, 0.0))


def exact_information(network: Network) -> mpmath.matrix:
    """Inverse covariance of the images' whitened vectors, in sixty digits, of exactly the numbers that the library is given."""
    linear = network.linear
    images = np.unique(linear.image)
    k = mpmath.matrix(network.image_set(images.astype(np.int32)).prior.toarray().tolist())
    size = len(images) * P
    total = mpmath.zeros(size, size)
    for j in range(network.points):
        rays = range(linear.first[j], linear.first[j + 1])
        a, b = mpmath.zeros(2 * len(rays), size), mpmath.zeros(2 * len(rays), 3)
        for at, r in enumerate(rays):
            column = int(np.searchsorted(images, linear.image[r])) * P
            for c in range(2):
                for u in range(P):
                    a[2 * at + c, column + u] = mpmath.mpf(float(linear.by_parameters[r, c, u]))
                for d in range(3):
                    b[2 * at + c, d] = mpmath.mpf(float(linear.by_ground[r, c, d]))
        total += a.T * a - (a.T * b) * (b.T * b) ** -1 * (b.T * a)
    return mpmath.eye(k.cols) + k.T * total * k


def largest_ratio(network: Network, information: mpmath.matrix, covariance: Array) -> tuple[float, float]:
    """Largest and smallest true variance over reported variance of any function of the images that rays or priors can tell apart."""
    images = np.unique(network.linear.image).astype(np.int32)
    k = network.image_set(images).prior.toarray()
    assert np.linalg.matrix_rank(k) == k.shape[0] == k.shape[1]
    inverse = mpmath.matrix(np.linalg.inv(k).tolist())
    # reported covariance of u = K^-1 theta times its true information: its eigenvalues are reported over true
    whitened = inverse * mpmath.matrix(covariance.tolist()) * inverse.T
    lower = mpmath.cholesky(information)
    values = mpmath.eigsy(lower.T * (whitened + whitened.T) / 2 * lower, eigvals_only=True)
    return float(1 / values[0]), float(1 / values[len(values) - 1])


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 0, 2]])
def test_rays_that_meet_at_a_tiny_angle_claim_no_more_than_there_is(angle: float, order: list[int]) -> None:
    network = narrow_network(angle)
    with mpmath.workdps(60):
        information = exact_information(network)
        state, known = NOTHING, []
        for block in order:
            state = fused(network, state, known, [block], low_rank=True)
            known.append(block)
        for found in (state, network.factored(order)):
            largest, smallest = largest_ratio(network, information, found.covariance)
            assert largest <= 1.0 + 1e-6
            assert smallest >= 1.0 - 1e-6


def test_a_weak_direction_that_is_dropped_would_claim_too_much() -> None:
    # the test above can fail: the same rays with the direction that they hardly determine left out of the elimination
    network = narrow_network(1e-5)
    flat = network.linear.by_ground.copy()
    flat[network.linear.image == 2] = flat[network.linear.image == 0]
    images = np.unique(network.linear.image).astype(np.int32)
    rows = np.searchsorted(images, network.linear.image).astype(np.int32)
    wrong = eliminate(replace(network.linear, by_ground=flat, image=rows), network.weight, len(images))
    with mpmath.workdps(60):
        claimed = estimate_images(wrong, network.image_set(images).prior, P).covariance
        assert largest_ratio(network, exact_information(network), claimed)[0] > 1.1


# Round-off


def test_many_blocks_one_after_another_drift_by_round_off_only() -> None:
    found = drift(60, 60)
    assert found.theta < 1e-10 and found.covariance < 1e-10 and found.chi_square < 1e-10
    assert found.symmetric and found.definite == found.steps == 60


def test_fuse_takes_either_way_to_the_same_place() -> None:
    network = random_network(5, points=40, images=8)
    images = network.rows([0, 1, 2, 3])
    known, sums = network.sums(network.of_blocks([0, 1, 2]))
    state = network.factored([0, 1, 2])
    np.testing.assert_array_equal(known, state.images)
    whole = fuse(state, network.arrival([0, 1, 2], [3]), images, network.image_set(images), lambda: sums)
    assert_same(whole.sub_min, network.factored([0, 1, 2, 3]))
    assert whole.chi_square == pytest.approx(whole.sub_min.chi_square - state.chi_square)
    assert whole.redundancy == whole.sub_min.redundancy - state.redundancy
