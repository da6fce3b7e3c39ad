"""The control set: shapes, derived accuracy, relative accuracy, subsets."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from submin.accuracy import ce90, le90
from submin.errors import InputError, NumericalError, QueryError
from submin.geodesy import WGS84, geodetic_to_geocentric, local_axes
from submin.query.control_set import ControlSet

CIRCLE = float(np.sqrt(2.0 * np.log(10.0)))


def control_set(n: int = 4, seed: int = 1, **changes: Any) -> ControlSet:
    random = np.random.default_rng(seed)
    geodetic = np.column_stack([random.uniform(100.0, 101.0, n), random.uniform(30.0, 31.0, n), random.uniform(0.0, 3000.0, n)])
    root = random.normal(size=(3 * n, 3 * n + 3))
    values: dict[str, Any] = {
        "ids": np.array([f"SET/{i}" for i in range(n)], dtype=str),
        "geocentric": geodetic_to_geocentric(geodetic),
        "covariance": root @ root.T,
        "ellipsoid": WGS84,
        "frame": "ITRF2014",
        "epoch": "2010.0",
        "policy": "rigorous",
        "tiles": ("r003c007", "r003c008"),
        "tile_of_point": np.array([f"r003c00{7 + i % 2}" for i in range(n)], dtype=str),
        "rays": np.arange(n) + 2,
        "version": "v12",
        "blocks": ("a", "b"),
        "scope": "network",
    }
    return ControlSet(**values | changes)


def local_blocks(points: np.ndarray, enu: np.ndarray) -> np.ndarray:
    """Joint geocentric covariance of points with independent errors of these ENU covariances."""
    rotation = local_axes(points)
    joint = np.zeros((3 * len(points), 3 * len(points)))
    for i, (r, p) in enumerate(zip(rotation, enu, strict=True)):
        joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = r.T @ p @ r
    return joint


def test_point_covariance_is_the_diagonal_of_the_joint_one() -> None:
    control = control_set()
    for i in range(len(control)):
        np.testing.assert_array_equal(control.point_covariance[i], control.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3])


def test_local_covariance_and_accuracy_are_east_north_up() -> None:
    control = control_set()
    enu = np.array([np.diag([1.0, 1.0, 9.0]), np.diag([4.0, 4.0, 1.0]), np.diag([1.0, 0.0, 4.0]), np.diag([0.0, 4.0, 0.0])])
    control = replace(control, covariance=local_blocks(control.geodetic, enu))
    np.testing.assert_allclose(control.local_covariance, enu, atol=1e-13)
    np.testing.assert_allclose(control.ce90, [CIRCLE, 2.0 * CIRCLE, 1.6448536269514722, 2.0 * 1.6448536269514722], rtol=1e-9)
    np.testing.assert_allclose(control.le90[:3], 1.6448536269514722 * np.array([3.0, 1.0, 2.0]), rtol=1e-9)


def test_geodetic_uses_the_ellipsoid_of_the_body() -> None:
    geodetic = np.array([[100.0, 30.0, 12.5]])
    moon = type(WGS84)(1737400.0, 0.0)
    control = control_set(1, geocentric=geodetic_to_geocentric(geodetic, moon), ellipsoid=moon)
    np.testing.assert_allclose(control.geodetic, geodetic, atol=1e-9)


def test_relative_accuracy_of_a_pair_by_hand() -> None:
    points = np.array([[100.0, 30.0, 50.0], [100.0, 30.0, 50.0]])
    own, shared = np.diag([1.0, 1.0, 4.0]), np.diag([100.0, 100.0, 100.0])
    rotation = local_axes(points)[0]
    blocks = np.block([[own + shared, shared], [shared, own + shared]])
    both = np.kron(np.eye(2), rotation)
    control = control_set(2, geocentric=geodetic_to_geocentric(points), covariance=both.T @ blocks @ both)
    relative = control.relative(0, 1)
    np.testing.assert_allclose(relative.covariance, 2.0 * own, atol=1e-11)
    assert relative.ce90 == pytest.approx(np.sqrt(2.0) * CIRCLE)
    assert relative.le90 == pytest.approx(np.sqrt(8.0) * 1.6448536269514722)
    assert control.ce90[0] == pytest.approx(np.sqrt(101.0) * CIRCLE)


def test_relative_accuracy_is_in_the_axes_of_the_middle() -> None:
    control = control_set(2, geocentric=geodetic_to_geocentric(np.array([[99.0, 0.0, 0.0], [101.0, 0.0, 0.0]])))
    relative = control.relative(0, 1)
    difference = np.hstack([-np.eye(3), np.eye(3)])
    axes = local_axes(np.array([[100.0, 0.0, 0.0]]))[0]
    expected = axes @ difference @ control.covariance @ difference.T @ axes.T
    np.testing.assert_allclose(relative.covariance, expected, rtol=1e-12, atol=1e-12)
    assert relative.ce90 == pytest.approx(ce90(expected[:2, :2])[0], rel=1e-9)
    assert relative.le90 == pytest.approx(le90(expected[2, 2])[0], rel=1e-9)


@given(st.integers(0, 10_000))
def test_relative_accuracy_does_not_depend_on_the_order(seed: int) -> None:
    control = control_set(3, seed)
    one, other = control.relative(0, 2), control.relative(2, 0)
    assert (one.ce90, one.le90) == (other.ce90, other.le90)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_relative_accuracy_of_equal_errors_is_zero() -> None:
    control = control_set(3)
    assert control.relative(1, 1).ce90 == 0.0
    assert control.relative(1, 1).le90 == 0.0
    # Equal but for the height: the horizontal block is round-off beside the vertical one.
    points = np.array([[100.0, 30.0, 50.0], [100.0, 30.0, 50.0]])
    both = np.kron(np.eye(2), local_axes(points)[0])
    blocks = np.full((2, 2), 5.0)[:, None, :, None] * np.eye(3)[None, :, None, :]
    enu = blocks.reshape(6, 6) + np.diag([0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    joint = both.T @ enu @ both
    relative = control_set(2, geocentric=geodetic_to_geocentric(points), covariance=0.5 * (joint + joint.T)).relative(0, 1)
    assert relative.ce90 < 1e-6
    assert relative.le90 == pytest.approx(np.sqrt(2.0) * 1.6448536269514722)


@pytest.mark.parametrize(("i", "j"), [(0, 4), (-1, 0)])
def test_relative_accuracy_of_a_point_that_is_not_there(i: int, j: int) -> None:
    with pytest.raises(QueryError, match=r"expected 0 to 3 \(4 points\)"):
        control_set().relative(i, j)


def test_relative_accuracy_of_an_impossible_joint_covariance() -> None:
    joint = np.eye(6)
    joint[:3, 3:] = joint[3:, :3] = 2.0 * np.eye(3)
    with pytest.raises(NumericalError, match="positive semi-definite"):
        control_set(2, covariance=joint).relative(0, 1)


def test_subset_takes_rows_of_everything() -> None:
    control = control_set(5)
    part = control.subset([3, 1])
    assert part.ids.tolist() == ["SET/3", "SET/1"]
    assert part.rays.tolist() == [5, 3]
    assert part.tile_of_point.tolist() == control.tile_of_point[[3, 1]].tolist()
    np.testing.assert_array_equal(part.geocentric, control.geocentric[[3, 1]])
    rows = [9, 10, 11, 3, 4, 5]
    np.testing.assert_array_equal(part.covariance, control.covariance[np.ix_(rows, rows)])
    np.testing.assert_array_equal(part.ce90, control.ce90[[3, 1]])
    assert part.relative(0, 1).le90 == pytest.approx(control.relative(3, 1).le90)
    assert (part.policy, part.tiles, part.scope) == (control.policy, control.tiles, control.scope)


def test_subset_by_mask() -> None:
    mask = np.array([False, True, False, True])
    assert control_set().subset(mask).ids.tolist() == ["SET/1", "SET/3"]


@pytest.mark.parametrize("nothing", [[], np.array([]), np.zeros(4, dtype=bool)])
def test_empty_subset(nothing: Any) -> None:
    part = control_set().subset(nothing)
    assert len(part) == 0
    assert part.covariance.shape == (0, 0)


@pytest.mark.parametrize("indices", [[4], [-1], [0.5], [[0, 1]], np.array([True, False])])
def test_impossible_subset(indices: Any) -> None:
    with pytest.raises(QueryError, match="subset"):
        control_set().subset(indices)


def test_empty_control_set_answers_everything() -> None:
    empty = control_set(0)
    assert len(empty) == 0
    assert empty.geodetic.shape == (0, 3)
    assert empty.point_covariance.shape == empty.local_covariance.shape == (0, 3, 3)
    assert empty.ce90.shape == empty.le90.shape == (0,)
    assert len(empty.subset([])) == 0
    with pytest.raises(QueryError, match="0 points"):
        empty.relative(0, 0)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("geocentric", np.zeros((4, 2)), r"geocentric has shape \(4, 2\); expected \(4, 3\)"),
        ("covariance", np.eye(9), r"covariance has shape \(9, 9\); expected \(12, 12\)"),
        ("rays", np.zeros(3, dtype=int), r"rays has shape \(3,\)"),
        ("tile_of_point", np.array(["a"]), r"tile_of_point has shape \(1,\)"),
        ("ids", np.arange(4), "ids is of type int64"),
        ("ids", np.array(["a", "b", "c", "d"], dtype=object), "ids is of type object"),
        ("ids", np.array([["a"], ["b"], ["c"], ["d"]]), r"ids has shape \(4, 1\)"),
        ("covariance", np.eye(12, dtype=np.float32), "float32; expected numpy.float64"),
        ("rays", np.zeros(4), "rays is of type float64"),
        ("geocentric", np.full((4, 3), np.nan), "point SET/0 is at"),
        ("scope", "world", "expected one of network, tiles"),
    ],
)
def test_what_does_not_fit_is_refused(name: str, value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        control_set(**{name: value})


def test_control_set_is_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        control_set().policy = "ci"  # type: ignore[misc]


def test_table_names_everything() -> None:
    control = control_set()
    table = control.table()
    np.testing.assert_array_equal(table.columns["cov_nu"], control.local_covariance[:, 1, 2])
    np.testing.assert_array_equal(table.columns["latitude"], control.geodetic[:, 1])
    assert table.metadata["tiles"] == control.tiles
    assert table.metadata["semimajor_axis"] == 6378137.0


@pytest.mark.parametrize("suffix", ["parquet", "npz", "geojson", "csv"])
def test_write_chooses_by_suffix(tmp_path: Path, suffix: str) -> None:
    control = control_set()
    control.write(tmp_path / f"chosen.{suffix}")
    getattr(control, f"to_{suffix}")(tmp_path / f"named.{suffix}")
    chosen, named = (tmp_path / f"{n}.{suffix}" for n in ("chosen", "named"))
    if suffix == "npz":
        with np.load(chosen) as a, np.load(named) as b:
            assert a.files == b.files
            assert all((a[k] == b[k]).all() for k in a.files)
    else:
        assert chosen.read_bytes() == named.read_bytes()


def test_parquet_of_a_control_set_reads_back(tmp_path: Path) -> None:
    control = control_set()
    control.to_parquet(tmp_path / "c.parquet")
    table = pq.read_table(tmp_path / "c.parquet")
    assert table.column("ce90").to_pylist() == control.ce90.tolist()
    assert table.schema.metadata[b"policy"] == b"rigorous"
