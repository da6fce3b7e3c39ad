"""The dense sub-MIN: blocks in any order and grouping against one simultaneous least squares, and against the factored form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, eliminate, point_factors
from submin.errors import InputError, NumericalError
from submin.network import triangle
from submin.network.dense_sub_min import DenseSubMin
from submin.network.observations import Cluster, PointObservations, Stack
from submin.network.pending import DenseNetwork, fusable
from submin.network.sub_min import GroundPart, SubMin, factor, joint_covariance, loadings, locate
from submin.network.triangle import Triangle
from tests.property.dense_networks import (
    assert_equal,
    heights,
    mixed_cluster,
    position_cluster,
    regular,
    simultaneous,
    truth,
    victoria,
)
from tests.property.test_sub_min import P, image_set

Array = NDArray[np.float64]

# a smaller seed is not a simpler network: nothing to shrink
EXAMPLES = settings(max_examples=20, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
SEEDS = st.integers(0, 2**32 - 1)


@pytest.fixture(autouse=True)
def small_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Panels so small that every network has several."""
    monkeypatch.setattr(triangle, "PANEL", 12)


def random_blocks(seed: int, points: int = 10, blocks: int = 16) -> tuple[dict[str, Array], list[PointObservations]]:
    """Clusters of positions and baselines, and heights; one cluster of positions at least, so that something is fixed."""
    rng = np.random.default_rng(seed)
    at = truth(rng, points)
    ids = list(at)
    made: list[PointObservations] = [mixed_cluster(rng, at, f"cluster {k}", 0.15) for k in range(blocks)]
    made.append(position_cluster(rng, at, "positions", ids[: int(rng.integers(1, 4))]))
    pairs = [tuple(rng.choice(ids, 2, replace=False).tolist()) for _ in range(3)]
    made.append(heights(rng, at, "levelling", pairs))
    return at, made


def fused_in(order: Sequence[int], parts: int, blocks: Sequence[PointObservations]) -> DenseNetwork:
    network = DenseNetwork()
    for part in np.array_split(np.asarray(order), parts):
        network.add([blocks[k] for k in part])
    return network


@EXAMPLES
@given(SEEDS)
def test_any_order_and_grouping_is_one_simultaneous_adjustment(seed: int) -> None:
    at, blocks = random_blocks(seed)
    rng = np.random.default_rng(seed)
    can = fusable(blocks)
    expected = simultaneous([block for block, c in zip(blocks, can, strict=True) if c], at)
    for _ in range(2):
        network = fused_in(rng.permutation(len(blocks)), int(rng.integers(1, len(blocks) + 1)), blocks)
        assert_equal(network.state, expected)
        assert network.pending == tuple(sorted(block.block_id for block, c in zip(blocks, can, strict=True) if not c))


@EXAMPLES
@given(SEEDS)
def test_points_without_prior_are_exact(seed: int) -> None:
    """New points by positions alone, by more baselines than they need, and both in one block with known ones."""
    rng = np.random.default_rng(seed)
    at = truth(rng, 6)
    a, b, c, d, e, f = at
    covariance = regular(rng, 15)
    pairs = [(a, c), (b, c), (c, d), (a, d), (b, e)]
    twice = Cluster("twice", np.array([p for p, _ in pairs]), np.array([q for _, q in pairs]),
                    np.stack([at[q] - at[p] for p, q in pairs]) + rng.normal(0.0, 0.01, (5, 3)), covariance)  # fmt: skip
    blocks = [position_cluster(rng, at, "two", [b, a]), twice, position_cluster(rng, at, "old and new", [f, a, e])]
    state = DenseSubMin()
    innovations = [state.fuse(block) for block in blocks]
    assert_equal(state, simultaneous(blocks, at))
    assert [i.degrees_of_freedom for i in innovations] == [0, 6, 6]
    assert innovations[0].d2 == 0.0
    assert state.chi_square == pytest.approx(sum(i.d2 for i in innovations), rel=1e-12)


@EXAMPLES
@given(SEEDS)
def test_baselines_before_positions_wait_and_leave_no_trace(seed: int) -> None:
    rng = np.random.default_rng(seed)
    at = truth(rng, 8)
    baselines = [mixed_cluster(rng, at, f"baselines {k}", 0.0) for k in range(12)]
    positions = [position_cluster(rng, at, f"position of {point}", [point]) for point in at]
    network = DenseNetwork(baselines)
    assert not len(network.state)
    assert len(network.pending) == len(baselines)
    network.add(positions)
    assert not network.pending
    assert_equal(network.state, simultaneous([*baselines, *positions], at))


def test_blocks_that_only_together_fix_a_point_are_fused_together() -> None:
    """Three heights from known points fix a fourth, if their verticals differ enough; each alone does not."""
    rng = np.random.default_rng(5)
    at = truth(rng, 4)
    a, b, c, d = at
    known = position_cluster(rng, at, "known", [a, b, c])
    steep = [heights(rng, at, f"height {k}", [(p, d)]) for k, p in enumerate((a, b, c))]
    # as if verticals were at right angles
    steep = [replace(h, up=np.stack([h.up[:, 0], np.eye(3)[[k]]], axis=1)) for k, h in enumerate(steep)]
    network = DenseNetwork([known, *steep[:2]])
    assert network.pending == ("height 0", "height 1")
    fused = network.add([steep[2]])
    assert [f.block_ids for f in fused] == [("height 0", "height 1", "height 2")]
    assert_equal(network.state, simultaneous([known, *steep], at))
    flat = DenseNetwork([known, *(heights(rng, at, f"level {k}", [(p, d)]) for k, p in enumerate((a, b, c)))])
    assert flat.pending == ("level 0", "level 1", "level 2"), "the curvature of the earth fixed a point"


def test_a_chain_in_reverse_is_fused_one_after_another() -> None:
    rng = np.random.default_rng(3)
    at = truth(rng, 40)
    ids = list(at)
    chain: list[PointObservations] = [
        Cluster(f"leg {k:02d}", np.array([one]), np.array([other]), (at[other] - at[one])[None], regular(rng, 3))
        for k, (one, other) in enumerate(pairwise(ids))
    ]
    fused = (network := DenseNetwork(chain[::-1])).add([position_cluster(rng, at, "start", ids[:1])])
    assert len(fused) == 40
    assert {f.innovation.degrees_of_freedom for f in fused} == {0}
    assert_equal(network.state, simultaneous([*chain, network.blocks["start"]], at))


@EXAMPLES
@given(SEEDS)
def test_covariance_only_shrinks(seed: int) -> None:
    at, blocks = random_blocks(seed)
    first = DenseNetwork([position_cluster(np.random.default_rng(seed), at, "all", list(at))])
    rows = first.state.rows_of(np.array(list(at)))
    before = first.state.covariance(rows)
    for block in blocks:
        first.add([block])
        after = first.state.covariance(rows)
        assert np.linalg.eigvalsh(before - after)[0] > -1e-12 * np.trace(before)
        before = after
    assert first.state.triangle.check_definite() > 1.0


@EXAMPLES
@given(SEEDS)
def test_withdrawal_is_never_fused(seed: int) -> None:
    at, blocks = random_blocks(seed)
    rng = np.random.default_rng(seed)
    gone = {blocks[k].block_id for k in rng.choice(len(blocks) - 2, 5, replace=False)}
    left = [block for block in blocks if block.block_id not in gone]
    network = fused_in(rng.permutation(len(blocks)), 4, blocks).without(gone)
    assert_equal(network.state, simultaneous([block for block, c in zip(left, fusable(left), strict=True) if c], at))
    assert set(network.blocks) == {block.block_id for block in left}
    with pytest.raises(InputError, match="not in the network"):
        network.without(gone)


def test_a_block_counts_once() -> None:
    rng = np.random.default_rng(1)
    at = truth(rng, 4)
    block = position_cluster(rng, at, "one", list(at))
    state = DenseSubMin()
    state.fuse(block)
    before = state.covariance(np.arange(4))
    with pytest.raises(InputError, match="block one is already fused"):
        state.fuse(block)
    with pytest.raises(InputError, match="block one is already fused"):
        state.fuse(Stack((position_cluster(rng, at, "two", list(at)), block)))
    np.testing.assert_array_equal(state.covariance(np.arange(4)), before)
    network = DenseNetwork([block])
    for again in ([block], [two := position_cluster(rng, at, "two", list(at)), two]):
        with pytest.raises(InputError, match="is already in the network"):
            network.add(again)
    assert network.state.blocks == ("one",)


def test_blocks_that_cannot_be_fused_leave_the_state_as_it_was() -> None:
    rng = np.random.default_rng(2)
    at = truth(rng, 5)
    state = DenseSubMin()
    state.fuse(position_cluster(rng, at, "some", list(at)[:3]))
    a, *_, d, e = at
    floating = Cluster("floating", np.array([d]), np.array([e]), (at[e] - at[d])[None], regular(rng, 3))
    with pytest.raises(NumericalError, match="block floating: does not determine"):
        state.fuse(floating)
    with pytest.raises(NumericalError, match="block level: does not determine its new points"):
        state.fuse(heights(rng, at, "level", [(a, d)]))
    singular = replace(position_cluster(rng, at, "singular", [a]), covariance=np.ones((3, 3)))
    with pytest.raises(InputError, match="block singular: its covariance is not positive definite"):
        DenseNetwork([singular])
    skew = replace(singular, cluster_id="skew", covariance=np.eye(3) + np.triu(np.full((3, 3), 0.1), 1))
    with pytest.raises(InputError, match="block skew: its covariance is not symmetric"):
        DenseNetwork([skew])
    assert (len(state), state.redundancy, state.blocks) == (3, 0, ("some",))


def test_a_triangle_is_the_matrix_whatever_its_panels() -> None:
    rng = np.random.default_rng(4)
    matrix = regular(rng, 45)
    grown = Triangle()
    for low, high in ((0, 9), (9, 12), (12, 39), (39, 45)):
        grown.append(matrix[low:high, :low], matrix[low:high, low:high])
    wanted = rng.permutation(45)[:20]
    np.testing.assert_array_equal(grown.rows(wanted)[:, :45], matrix[wanted])
    assert not grown.rows(wanted)[:, 45:].any()
    np.testing.assert_array_equal(grown.submatrix(wanted), matrix[np.ix_(wanted, wanted)])
    np.testing.assert_array_equal(grown.whole(), np.triu(matrix))
    np.testing.assert_array_equal(grown.diagonal_blocks(), matrix.reshape(15, 3, 15, 3)[np.arange(15), :, np.arange(15)])
    w = np.asfortranarray(0.001 * rng.normal(size=(5, grown.padded_size)))
    w[:, 45:] = 0.0
    where = [panel.ctypes.data for panel in grown.panels]
    grown.subtract_square(w)
    np.testing.assert_allclose(grown.submatrix(np.arange(45)), matrix - w[:, :45].T @ w[:, :45], rtol=0.0, atol=1e-18)
    assert where == [panel.ctypes.data for panel in grown.panels], "the update was not in place"
    grown.append(np.zeros((3, 45)), np.ones((3, 3)))
    with pytest.raises(NumericalError, match="not positive definite"):
        grown.check_definite()


def test_many_blocks_one_after_another_do_not_drift() -> None:
    """The small sister of the benchmark: 150 blocks on 30 points, a Cholesky factorisation after each."""
    rng = np.random.default_rng(9)
    at = truth(rng, 30)
    state = DenseSubMin()
    blocks = [position_cluster(rng, at, "all", list(at))]
    blocks += [position_cluster(rng, at, f"block {k}", rng.choice(list(at), 5, replace=False).tolist()) for k in range(150)]
    for block in blocks:
        state.fuse(block)
        state.triangle.check_definite()
    assert_equal(state, simultaneous(blocks, at))


# -- dense = factored


def _rays(seed: int, points: int = 9, blocks: int = 4) -> tuple[LinearRays, Array, Array]:
    """Rays of blocks of two images, each of which sees all points of its block; the block of each ray; origins of the points."""
    rng = np.random.default_rng(seed)
    seen = rng.random((points, blocks)) < 0.6
    seen[np.arange(points), rng.integers(0, blocks, points)] = True
    seen[0] = True
    of_point = [np.flatnonzero(np.repeat(row, 2)) for row in seen]
    image = np.concatenate(of_point).astype(np.int32)
    first = np.concatenate([[0], np.cumsum([len(i) for i in of_point])]).astype(np.int64)
    rays = len(image)
    by_parameters = 0.01 * rng.normal(size=(rays, 2, P))
    by_parameters[:, 0, 0] += 2.0
    by_parameters[:, 1, 3] += 2.0
    # the two images of a block look from different sides
    look = np.where(
        (image % 2 == 0)[:, None, None], np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 0.5]]), np.array([[4.0, 0.0, -1.5], [0.0, 4.0, 0.5]])
    )
    origin = rng.uniform(-1e3, 1e3, (points, 3)) + np.array([4e6, 1e6, 5e6])
    linear = LinearRays(first, image, look + rng.normal(0.0, 0.2, (rays, 2, 3)), by_parameters, rng.normal(0.0, 3.0, (rays, 2)))
    return linear, image // 2, origin


def _factored(linear: LinearRays, origin: Array) -> tuple[SubMin, Array, Array]:
    images, local = np.unique(linear.image, return_inverse=True)
    rows = images.astype(np.int32)
    weight = np.ones(len(linear.image))
    sums = eliminate(replace(linear, image=local.astype(np.int32)), weight, len(rows))
    images_of = image_set(rows)
    priors = tuple(replace(prior, pass_id=prior.block_id) for prior in images_of.priors)  # nothing common to two blocks
    sub_min = factor(sums, rows, replace(images_of, priors=priors))
    part = GroundPart(origin, linear, point_factors(linear, weight))
    return sub_min, locate(part, sub_min), joint_covariance(loadings([part], sub_min.images, P), part.factors.own, sub_min.covariance)


@EXAMPLES
@given(SEEDS)
def test_dense_is_factored(seed: int) -> None:
    """Free adjustments of blocks fused as points with full covariance: the factored sub-MIN of all their rays."""
    linear, block_of_ray, origin = _rays(seed)
    sub_min, where, joint = _factored(linear, origin)
    point = np.repeat(np.arange(len(origin)), np.diff(linear.first))
    ids = np.array([f"p{k:02d}" for k in range(len(origin))])
    state, inner, redundancy = DenseSubMin(), 0.0, 0
    for block in np.random.default_rng(seed).permutation(np.unique(block_of_ray)):
        own = block_of_ray == block
        seen, local = np.unique(point[own], return_inverse=True)
        first = np.concatenate([[0], np.cumsum(np.bincount(local))]).astype(np.int64)
        rays = LinearRays(first, linear.image[own], linear.by_ground[own], linear.by_parameters[own], linear.y[own])
        free, z, r = _factored(rays, origin[seen])
        inner, redundancy = inner + free.chi_square, redundancy + free.redundancy
        state.fuse(Cluster(f"block {block}", ids[seen], np.full(len(seen), "", dtype="U1"), z, r))
    rows = state.rows_of(ids)
    sigma = np.sqrt(np.diag(joint))
    np.testing.assert_allclose((state.geocentric[rows] - where).ravel() / sigma, 0.0, atol=1e-8)  # coordinates have 1e-9 m
    np.testing.assert_allclose((state.covariance(rows) - joint) / np.outer(sigma, sigma), 0.0, atol=1e-9)
    assert state.chi_square + inner == pytest.approx(sub_min.chi_square, rel=1e-9)
    assert state.redundancy + redundancy == sub_min.redundancy


def test_gnss_solutions_in_random_order_are_one_least_squares(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangle, "PANEL", 99)
    clusters = victoria(data)
    assert len(clusters) == 131
    assert sum(c.values.size for c in clusters) == 417
    near = dict(zip((stack := Stack(tuple(clusters))).point_ids.tolist(), stack.approximate(np.full((43, 3), np.nan)), strict=True))
    expected = simultaneous(clusters, near)
    assert expected.redundancy == 417 - 3 * 43
    for seed in range(2):
        network = fused_in(np.random.default_rng(seed).permutation(131), 131, clusters)
        assert not network.pending
        assert_equal(network.state, expected)
