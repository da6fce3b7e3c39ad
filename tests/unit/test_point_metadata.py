"""Group reductions behind the metadata of points, against the loops that they stand for; dates; tables of what is known."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from submin.errors import InputError, QueryError
from submin.formats.metadata_tables import write_columns
from submin.query.point_metadata import BETWEEN, STATUSES, PointMetadata, group_distinct, group_extremes, joined_texts
from submin.storage.validity import Validity, append_validity, read_date

EXAMPLES = settings(max_examples=40, deadline=None)
PAIRS = st.lists(st.tuples(st.integers(0, 11), st.integers(0, 5)), max_size=60)
NAMES = np.array(["", "a; b", "CC BY 4.0", "d", "ž", "z" * 40])


@EXAMPLES
@given(PAIRS)
def test_reductions_are_the_loops_over_points(pairs: list[tuple[int, int]]) -> None:
    point, value = (np.array([pair[k] for pair in pairs], dtype=np.int64) for k in (0, 1))
    of_point = [{v for p, v in pairs if p == k} for k in range(12)]
    least, greatest = group_extremes(point, value, 12)
    assert least.tolist() == [min(values, default=-1) for values in of_point]
    assert greatest.tolist() == [max(values, default=-1) for values in of_point]
    assert list(zip(*(c.tolist() for c in group_distinct(point, value)), strict=True)) == sorted(set(pairs))
    assert joined_texts(point, value, NAMES, 12).tolist() == [BETWEEN.join(NAMES[sorted(values)].tolist()) for values in of_point]


def metadata(n: int = 4, **changes: Any) -> PointMetadata:
    texts = np.array([f"t{k}" for k in range(n)])
    named = ("first_block", "last_block", "first_acquired", "last_acquired", "licences", "tile", "cell")
    values: dict[str, Any] = dict.fromkeys((*named, "valid_from", "valid_to", "reason"), texts)
    places = np.column_stack([np.arange(n) + 100.0, np.full(n, 35.0), np.full(n, 9.5)])
    counts = np.arange(n)
    values |= {
        "ids": texts, "geodetic": places, "registered": places + 1e-5, "status": np.resize(np.array(STATUSES), n), "rays": counts,
        "rays_rejected": counts, "blocks": counts, "convergence": np.where(counts == 3, np.nan, 30.0), "reported": counts > 0,
        "epoch": "2010.0", "version": "v3",
    }  # fmt: skip
    return PointMetadata(**values | changes)


def test_points_of_a_status() -> None:
    points = metadata(10)
    for status in STATUSES:
        assert points.with_status(status).status.tolist() == [status] * 2
    with pytest.raises(QueryError, match="status is 'good'; expected one of internal, external, check, pending, undetermined"):
        points.with_status("good")


@pytest.mark.parametrize("n", [4, 0])
def test_what_is_written_comes_back(tmp_path: Path, n: int) -> None:
    columns = metadata(n).columns()
    for suffix in ("parquet", "csv", "geojson"):
        write_columns(tmp_path / f"points.{suffix}", columns, {"version": "v3"})
    stored = pq.read_table(tmp_path / "points.parquet")
    assert stored.column_names == list(columns)
    assert stored.schema.metadata[b"version"] == b"v3"
    for name, values in columns.items():
        expected = [None if isinstance(v, float) and np.isnan(v) else v for v in values.tolist()]
        assert stored[name].to_pylist() == expected
    features = json.loads((tmp_path / "points.geojson").read_text())
    assert [feature["properties"] for feature in features["features"]] == stored.to_pylist()
    assert [feature["geometry"]["coordinates"] for feature in features["features"]] == columns_of_places(columns)
    assert pcsv.read_csv(tmp_path / "points.csv").column_names == list(columns)


def columns_of_places(columns: dict[str, Any]) -> list[list[float]]:
    return np.column_stack([columns[name] for name in ("longitude", "latitude", "height")]).tolist()


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(QueryError, match=r"unknown suffix '.npz'; expected one of .parquet, .csv, .geojson"):
        write_columns(tmp_path / "points.npz", metadata().columns(), {})
    assert not list(tmp_path.iterdir())


class Version:
    """Stands for a version of a network: a root."""

    def __init__(self, root: zarr.Group) -> None:
        self.root = root


def said(*rows: tuple[str, str, str, str]) -> Validity:
    return Validity(*(np.array([row[k] for row in rows], dtype=np.str_) for k in range(4)))


def test_the_last_row_of_a_point_counts() -> None:
    root = zarr.create_group(zarr.storage.MemoryStore())
    assert len(Validity.of(Version(root))) == 0  # type: ignore[arg-type]
    append_validity(root, said(("b", "", "2020-01-01", "flood"), ("c", "2019-05-01", "", "")), 4)
    append_validity(root, said(("a", "", "2021-12-31", "road"), ("b", "", "", "")), 5)
    found = Validity.of(Version(root))  # type: ignore[arg-type]
    assert found.point_ids.tolist() == ["a", "b", "c"]
    asked = np.array(["c", "x", "b", "a"])
    assert [v.tolist() for v in found.rows_of(asked)] == [["2019-05-01", "", "", ""], ["", "", "", "2021-12-31"], ["", "", "", "road"]]
    assert found.intervals(asked) == ("c 2019-05-01/..", "a ../2021-12-31")


@pytest.mark.parametrize(
    ("on", "valid"),
    [("2019-04-30", [True, False, True]), ("2019-05-01", [True, True, True]), ("2021-12-31", [True, True, True]),
     ("2022-01-01", [False, True, True])],
)  # fmt: skip
def test_points_are_valid_on_their_first_and_last_day(on: str, valid: list[bool]) -> None:
    dates = said(("a", "", "2021-12-31", ""), ("c", "2019-05-01", "", ""))
    assert dates.valid(np.array(["a", "c", "x"]), date.fromisoformat(on)).tolist() == valid
    assert said().valid(np.array(["a", "c", "x"]), date.fromisoformat(on)).all()


@pytest.mark.parametrize("text", ["", "2026-13-01", "2026-02-30", "31.5.2026", "20260531", "2026-05-31T00:00", "tomorrow", "None"])
def test_a_date_that_is_none(text: str) -> None:
    with pytest.raises(InputError, match=f"--valid-to is '{text}'; expected a date as 2026-05-31, or none"):
        read_date(text, "--valid-to", or_open=True)
    with pytest.raises(InputError, match="expected a date as 2026-05-31$"):
        read_date("none", "--on")
