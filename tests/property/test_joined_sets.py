"""Sets from elsewhere join a network's answer by Covariance Intersection: a bound whatever they share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as la
from numpy.typing import NDArray
from property.exact_covariance import largest_ratio
from scipy.optimize import minimize_scalar
from unit.test_control_set import control_set

import submin
from submin.errors import InputError, NumericalError, QueryError
from submin.geodesy import Ellipsoid
from submin.query.joined import PointSet, join

Array = NDArray[np.float64]

CONSISTENT = 1.0 + 1e-9


def ids_of(*numbers: int) -> NDArray[np.str_]:
    return np.array([f"P{k:02d}" for k in numbers])


def axes(places: NDArray[np.integer]) -> NDArray[np.integer]:
    return (3 * np.asarray(places)[:, None] + np.arange(3)).ravel()


def pair(seed: int, ids_one: NDArray[np.str_], ids_other: NDArray[np.str_]) -> tuple[PointSet, PointSet, Array]:
    """Two sets with errors that have random sources, some in common, and the joint covariance (one, other) of both."""
    rng = np.random.default_rng(seed)
    a, b = 3 * len(ids_one), 3 * len(ids_other)
    shared = int(rng.integers(1, a + b))
    sources = rng.normal(size=(a + b, shared)) * 10.0 ** rng.uniform(-2.0, 1.0, shared)
    own = la.block_diag(rng.normal(size=(a, a)) * rng.uniform(0.1, 3.0), rng.normal(size=(b, b)) * rng.uniform(0.1, 3.0))
    root = np.hstack([sources, own])
    joint = root @ root.T
    places = rng.normal(0.0, 1e5, (100, 3))
    errors = (root @ rng.normal(size=root.shape[1])).reshape(-1, 3)
    numbers = [np.array([int(name[1:]) for name in ids]) for ids in (ids_one, ids_other)]
    return (
        PointSet(ids_one, places[numbers[0]] + errors[: len(ids_one)], joint[:a, :a]),
        PointSet(ids_other, places[numbers[1]] + errors[len(ids_one) :], joint[a:, a:]), joint,
    )  # fmt: skip


OVERLAPS = {
    "some": (ids_of(0, 1, 2, 3), ids_of(5, 2, 3, 4)),
    "all": (ids_of(0, 1, 2), ids_of(2, 0, 1)),
    "inside": (ids_of(4, 3, 2, 1, 0), ids_of(1, 3)),
    "one": (ids_of(0, 1, 2), ids_of(2, 3, 4, 5)),
}


def informed(one: PointSet, other: PointSet, ids: NDArray[np.str_], weight: float) -> tuple[Array, Array]:
    """Positions and covariance of the union in information form, as the formula has it."""
    total, right = np.zeros((3 * len(ids), 3 * len(ids))), np.zeros(3 * len(ids))
    for part, w in ((one, weight), (other, 1.0 - weight)):
        at = axes(np.searchsorted(ids, part.ids))
        inverse = np.linalg.inv(part.covariance)
        total[np.ix_(at, at)] += w * inverse
        right[at] += w * inverse @ part.geocentric.ravel()
    return np.linalg.solve(total, right).reshape(-1, 3), np.linalg.inv(total)


@pytest.mark.parametrize("overlap", OVERLAPS)
@pytest.mark.parametrize("seed", range(8))
def test_the_union_is_the_weighted_sum_of_informations_with_the_best_weight(overlap: str, seed: int) -> None:
    one, other, _ = pair(seed, *OVERLAPS[overlap])
    found = join(one, other)
    np.testing.assert_array_equal(found.points.ids, np.union1d(one.ids, other.ids))
    positions, covariance = informed(one, other, found.points.ids, found.weight)
    np.testing.assert_allclose(found.points.covariance, covariance, rtol=0.0, atol=1e-7 * np.abs(covariance).max())
    np.testing.assert_allclose(found.points.geocentric, positions, rtol=0.0, atol=1e-6)
    np.linalg.cholesky(found.points.covariance)

    def trace(weight: float) -> float:
        return float(np.trace(informed(one, other, found.points.ids, weight)[1]))

    searched = minimize_scalar(trace, bounds=(1e-5, 1.0 - 1e-5), method="bounded", options={"xatol": 1e-8})
    assert np.trace(found.points.covariance) <= searched.fun * (1.0 + 1e-6)


@pytest.mark.parametrize("overlap", OVERLAPS)
@pytest.mark.parametrize("seed", range(25))
def test_the_union_is_consistent_whatever_is_shared(overlap: str, seed: int) -> None:
    one, other, joint = pair(100 + seed, *OVERLAPS[overlap])
    found = join(one, other)

    def located(numbers: Array) -> Array:
        a = len(one.ids)
        at = numbers.reshape(-1, 3)
        return join(PointSet(one.ids, at[:a], one.covariance), PointSet(other.ids, at[a:], other.covariance)).points.geocentric.ravel()

    linear_map = np.stack([located(unit) for unit in np.eye(len(joint))], axis=1)
    assert largest_ratio(linear_map @ joint @ linear_map.T, found.points.covariance) <= CONSISTENT


def test_a_naive_join_is_not_consistent() -> None:
    """Negative control: the same set taken twice as if it were two, which the check above must refuse."""
    one, _, _ = pair(3, *OVERLAPS["all"])
    assert largest_ratio(one.covariance, informed(one, one, np.sort(one.ids), 0.5)[1] * 0.5) == pytest.approx(2.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_set_joined_with_itself_is_itself(seed: int) -> None:
    one, _, _ = pair(200 + seed, *OVERLAPS["some"])
    found = join(one, one).points
    order = np.argsort(one.ids)
    rows = axes(order)
    expected = one.covariance[np.ix_(rows, rows)]
    np.testing.assert_allclose(found.covariance, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(found.geocentric, one.geocentric[order], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("count", "own"), [(30, 0.1), (300, 0.001)])
def test_of_two_equal_sets_neither_is_left_out(count: int, own: float) -> None:
    """Every weight is as good but for round-off, which near 0 and 1 costs six digits."""
    rng = np.random.default_rng(count)
    sources = rng.normal(size=(3 * count, 8))
    one = PointSet(
        np.array([f"P{k:03d}" for k in range(count)]), rng.normal(0.0, 1e5, (count, 3)), sources @ sources.T + own**2 * np.eye(3 * count)
    )
    assert 0.01 < join(one, one).weight < 0.99


def test_a_set_that_knows_less_of_every_point_is_given_no_weight() -> None:
    one, _, _ = pair(4, *OVERLAPS["all"])
    worse = PointSet(one.ids, one.geocentric + 1.0, 4.0 * one.covariance)
    found = join(one, worse)
    assert found.weight > 1.0 - 1e-5
    np.testing.assert_allclose(found.points.geocentric, one.geocentric, rtol=0.0, atol=1e-4)


def test_points_that_only_one_set_knows_move_with_the_common_ones() -> None:
    """One point common, one new, both with the same error: the new one goes where the common one goes."""
    shared = np.kron(np.ones((2, 2)), np.eye(3)) + 1e-12 * np.eye(6)
    one = PointSet(ids_of(0), np.zeros((1, 3)), 1e-4 * np.eye(3))
    other = PointSet(ids_of(0, 1), np.array([[5.0, 0.0, 0.0], [105.0, 0.0, 0.0]]), shared)
    found = join(one, other)
    np.testing.assert_allclose(found.points.geocentric, [[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]], atol=0.1)


def test_sets_that_cannot_be_joined_are_refused() -> None:
    one, other, _ = pair(5, ids_of(0, 1), ids_of(2, 3))
    with pytest.raises(QueryError, match="the sets of 2 and 2 points have no id in common, so joining them would inflate both"):
        join(one, other)
    far = PointSet(one.ids, one.geocentric + np.array([[0.0], [3000.0]]) * [0.0, 0.0, 1.0], one.covariance)
    with pytest.raises(QueryError, match=r"point P01 is at two places 3\.0 km apart"):
        join(one, far)
    exact = PointSet(one.ids, one.geocentric, np.zeros_like(one.covariance))
    with pytest.raises(NumericalError, match="covariances of the 2 common points are not positive definite together"):
        join(exact, exact)


def test_control_sets_join_by_intersection_alone() -> None:
    control, other = control_set(4, seed=1), control_set(4, seed=2)
    other = submin.ControlSet(**{**vars_of(other), "ids": np.array([f"SET/{k}" for k in (2, 3, 4, 5)]), "blocks": ("b", "c"),
                                 "geocentric": control.geocentric[[2, 3, 0, 1]] + 0.5})  # fmt: skip
    both = control.joined(other)
    assert both.ids.tolist() == [f"SET/{k}" for k in range(6)]
    assert (both.policy, both.scope, both.blocks, both.tiles) == ("ci", "tiles", ("a", "b", "c"), control.tiles)
    assert both.tile_of_point.tolist() == [*control.tile_of_point.tolist(), "", ""]
    assert both.rays.tolist() == [2, 3, 4, 5, 4, 5]
    for policy in ("rigorous", "bci", "split", "tile", "auto"):
        with pytest.raises(
            QueryError, match=f"policy is '{policy}'; a set from elsewhere can join only by 'ci': it has no ledger of blocks"
        ):
            control.joined(other, policy)
    with pytest.raises(QueryError, match="frame of the other set is GDA2020; expected ITRF2014"):
        control.joined(submin.ControlSet(**{**vars_of(other), "frame": "GDA2020"}))
    with pytest.raises(QueryError, match="epoch of the other set is 2020.0; expected 2010.0"):
        control.joined(submin.ControlSet(**{**vars_of(other), "epoch": "2020.0"}))
    with pytest.raises(QueryError, match="ellipsoid of the other set is"):
        control.joined(submin.ControlSet(**{**vars_of(other), "ellipsoid": Ellipsoid(1737400.0, 0.0)}))


def vars_of(control: submin.ControlSet) -> dict[str, object]:
    return {name: getattr(control, name) for name in submin.ControlSet.__dataclass_fields__}


@pytest.mark.parametrize("suffix", ["parquet", "npz"])
def test_a_written_control_set_is_read_again(suffix: str, tmp_path: Path) -> None:
    control = control_set(5)
    control.write(tmp_path / f"control.{suffix}")
    again = submin.read_control(tmp_path / f"control.{suffix}")
    for name, value in vars_of(control).items():
        assert np.array_equal(getattr(again, name), value) if isinstance(value, np.ndarray) else getattr(again, name) == value, name


def test_files_that_are_no_query_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown suffix '.csv'; expected a query with its joint covariance: .parquet, .npz"):
        submin.read_control(tmp_path / "control.csv")
    np.savez(tmp_path / "bare.npz", ids=ids_of(0), geocentric=np.zeros((1, 3)), covariance=np.eye(3))
    with pytest.raises(InputError, match="'policy' is missing; expected what a query writes"):
        submin.read_control(tmp_path / "bare.npz")
