"""Files of points: layout, round trips to the last bit, errors that name the place, nothing left half done."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from submin.errors import InputError, QueryError
from submin.formats import tables
from submin.formats.tables import POINT_COLUMNS, ControlTable, read_npz, read_parquet, write_table

SUFFIXES = (".parquet", ".npz", ".geojson", ".csv")
SIZES = (0, 1, 2, 23)
METADATA: tables.Metadata = {
    "policy": "rigorous",
    "version": "v12",
    "frame": "ITRF2014",
    "epoch": "2010.0",
    "scope": "network",
    "semimajor_axis": 6378137.0,
    "flattening": 1.0 / 298.257223563,
    "tiles": ("r003c007", "r003c008"),
    "blocks": ("pass, 1", 'Ω"2"'),
}
AWKWARD = ["plain", "", 'quo"te', "com,ma", "back\\slash", "new\nline", "τελεία", "0012", "NaN", "null"]


def point_table(n: int) -> ControlTable:
    random = np.random.default_rng(n)
    root = random.normal(size=(3 * n, 3 * n + 1))
    columns: dict[str, Any] = {name: random.normal(size=n) / 3.0 for name in POINT_COLUMNS}
    columns["point_id"] = np.array([AWKWARD[i] if i < len(AWKWARD) else f"p{i}" for i in range(n)], dtype=str)
    columns["tile"] = np.array([f"r{i % 3:03d}" for i in range(n)], dtype=str)
    columns["rays"] = random.integers(2, 90, n)
    covariance = root @ root.T
    return ControlTable(columns, np.tril(covariance) + np.tril(covariance, -1).T, METADATA)


def assert_same(arrays: dict[str, Any], table: ControlTable) -> None:
    np.testing.assert_array_equal(arrays["ids"], table.columns["point_id"])
    np.testing.assert_array_equal(arrays["geocentric"], np.column_stack([table.columns[c] for c in "xyz"]))
    np.testing.assert_array_equal(arrays["covariance"], table.covariance)
    for name in POINT_COLUMNS[4:]:
        np.testing.assert_array_equal(arrays[name], table.columns[name])
        assert arrays[name].dtype.kind == table.columns[name].dtype.kind
    for name, value in table.metadata.items():
        assert (tuple(arrays[name].tolist()) if isinstance(value, tuple) else arrays[name].item()) == value


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize(("suffix", "read"), [(".parquet", read_parquet), (".npz", read_npz)])
def test_round_trip_to_the_last_bit(tmp_path: Path, n: int, suffix: str, read: Callable[[Path], dict[str, Any]]) -> None:
    table = point_table(n)
    write_table(tmp_path / f"t{suffix}", table)
    assert_same(read(tmp_path / f"t{suffix}"), table)


@pytest.mark.parametrize("values", [1, 9, 100, 1000])
def test_row_groups_do_not_change_the_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, values: int) -> None:
    monkeypatch.setattr(tables, "_GROUP_VALUES", values)
    table = point_table(23)
    write_table(tmp_path / "t.parquet", table)
    assert pq.ParquetFile(tmp_path / "t.parquet").num_row_groups > 1
    assert_same(read_parquet(tmp_path / "t.parquet"), table)


def test_parquet_layout(tmp_path: Path) -> None:
    table = point_table(5)
    write_table(tmp_path / "t.parquet", table)
    stored = pq.read_table(tmp_path / "t.parquet")
    assert tuple(stored.column_names) == (*POINT_COLUMNS, "covariance_row")
    for i, row in enumerate(stored.column("covariance_row").to_pylist()):
        np.testing.assert_array_equal(np.array(row).reshape(3, 3 * (i + 1)), table.covariance[3 * i : 3 * i + 3, : 3 * i + 3])
    metadata = stored.schema.metadata
    assert {k: metadata[k.encode()].decode() for k in tables.TEXTS} == {k: METADATA[k] for k in tables.TEXTS}
    assert json.loads(metadata[b"tiles"]) == ["r003c007", "r003c008"]


def test_covariance_comes_back_symmetric_from_the_lower_triangle(tmp_path: Path) -> None:
    table = point_table(7)
    blocks = np.kron(np.tri(7), np.ones((3, 3)))
    write_table(tmp_path / "t.parquet", ControlTable(table.columns, table.covariance * blocks, METADATA))
    covariance = read_parquet(tmp_path / "t.parquet")["covariance"]
    np.testing.assert_array_equal(covariance, covariance.T)
    np.testing.assert_array_equal(covariance, table.covariance)


def test_npz_holds_no_pickle(tmp_path: Path) -> None:
    write_table(tmp_path / "t.npz", point_table(3))
    with np.load(tmp_path / "t.npz", allow_pickle=False) as file:
        assert file["ids"].shape == (3,)
        assert file["geocentric"].shape == (3, 3)
        assert file["covariance"].shape == (9, 9)
        assert all(file[name].dtype.kind in "Ufi" for name in file.files)


@pytest.mark.parametrize("n", SIZES)
def test_geojson_layout(tmp_path: Path, n: int) -> None:
    table = point_table(n)
    write_table(tmp_path / "t.geojson", table)
    collection = json.loads((tmp_path / "t.geojson").read_text(encoding="utf-8"))
    assert collection["type"] == "FeatureCollection"
    assert collection["metadata"]["tiles"] == ["r003c007", "r003c008"]
    assert len(collection["features"]) == n
    for i, feature in enumerate(collection["features"]):
        assert feature["type"] == "Feature"
        assert feature["geometry"] == {
            "type": "Point",
            "coordinates": [table.columns[c][i] for c in ("longitude", "latitude", "height")],
        }
        assert feature["properties"] == {name: table.columns[name][i] for name in POINT_COLUMNS}


@pytest.mark.parametrize("n", SIZES)
def test_csv_layout(tmp_path: Path, n: int) -> None:
    table = point_table(n)
    write_table(tmp_path / "t.csv", table)
    with (tmp_path / "t.csv").open(encoding="utf-8", newline="") as file:
        header, *rows = list(csv.reader(file))
    assert tuple(header) == POINT_COLUMNS
    assert len(rows) == n
    for i, row in enumerate(rows):
        assert row[0] == table.columns["point_id"][i]
        assert [float(v) for v in row[1:15]] == [table.columns[c][i] for c in POINT_COLUMNS[1:15]]
        assert (row[15], int(row[16])) == (table.columns["tile"][i], table.columns["rays"][i])


def test_suffix_in_capitals(tmp_path: Path) -> None:
    write_table(tmp_path / "T.PARQUET", point_table(2))
    assert_same(read_parquet(tmp_path / "T.PARQUET"), point_table(2))


@pytest.mark.parametrize("name", ["t.txt", "t", "t.csv.gz"])
def test_unknown_suffix_names_the_four(tmp_path: Path, name: str) -> None:
    with pytest.raises(QueryError, match=r"expected one of \.parquet, \.npz, \.geojson, \.csv"):
        write_table(tmp_path / name, point_table(1))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_failed_write_leaves_what_was_there(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"t{suffix}"
    write_table(path, point_table(3))
    before = path.read_bytes()
    broken = point_table(3)
    object.__setattr__(broken, "metadata", {**METADATA, "epoch": {1, 2}})
    object.__setattr__(broken, "columns", {**broken.columns, "rays": np.array([1, "a", {2}], dtype=object)})
    if suffix == ".npz":
        original = np.savez

        def full_disk(file: Any, **arrays: Any) -> None:
            original(file, **{k: v for k, v in arrays.items() if k == "covariance"})
            raise OSError("no space left on device")

        with pytest.MonkeyPatch.context() as patch, pytest.raises(InputError, match=r"cannot be written \(no space left on device\)"):
            patch.setattr(np, "savez", full_disk)
            write_table(path, point_table(3))
    else:
        with pytest.raises((pa.ArrowException, TypeError)):
            write_table(path, broken)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_parquet_that_fails_between_row_groups_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_GROUP_VALUES", 50)
    rows = tables.covariance_rows

    def fails_later(covariance: Any, first: int, last: int) -> Any:
        if first > 5:
            raise MemoryError
        return rows(covariance, first, last)

    monkeypatch.setattr(tables, "covariance_rows", fails_later)
    with pytest.raises(MemoryError):
        write_table(tmp_path / "t.parquet", point_table(23))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_folder_is_missing_or_in_the_way(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="does not exist; create it first"):
        write_table(tmp_path / "no" / f"t{suffix}", point_table(1))
    (tmp_path / f"d{suffix}").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        write_table(tmp_path / f"d{suffix}", point_table(1))


def test_table_checks_itself() -> None:
    table = point_table(2)
    with pytest.raises(InputError, match=r"covariance has shape \(3, 3\); expected \(6, 6\)"):
        ControlTable(table.columns, np.eye(3), METADATA)
    with pytest.raises(InputError, match="columns are x"):
        ControlTable({"x": np.zeros(2)}, np.eye(6), METADATA)


def rewritten(path: Path, change: Callable[[pa.Table], pa.Table]) -> Path:
    write_table(path, point_table(4))
    pq.write_table(change(pq.read_table(path)), path)
    return path


def with_column(name: str, values: Any) -> Callable[[pa.Table], pa.Table]:
    return lambda t: t.set_column(t.column_names.index(name), name, values)


def test_parquet_of_another_program_reads_the_same(tmp_path: Path) -> None:
    path = rewritten(tmp_path / "t.parquet", lambda t: t)
    table = pq.read_table(path)
    large = table.column("covariance_row").cast(pa.large_list(pa.float64()))
    text = table.column("point_id").cast(pa.large_string())
    pq.write_table(with_column("covariance_row", large)(with_column("point_id", text)(table)), path)
    assert_same(read_parquet(path), point_table(4))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop_columns(["cov_en"]), "column 'cov_en' is missing"),
        (lambda t: t.drop_columns(["covariance_row"]), "column 'covariance_row' is missing"),
        (lambda t: t.slice(1), r"row 0: covariance_row has 18 values; expected 9 .*query again"),
        (lambda t: t.take([0, 2, 1, 3]), "row 1: covariance_row has 27 values; expected 18"),
        (with_column("covariance_row", pa.array([[1.0] * 9, None, [1.0] * 27, [1.0] * 36])), "row 1: covariance_row has 0 values"),
        (
            with_column("covariance_row", pa.array([[1.0] * 9, [1.0] * 17 + [np.nan], [1.0] * 27, [1.0] * 36])),
            "row 1: covariance_row holds a value that is null or not finite",
        ),
        (
            with_column("covariance_row", pa.array([[1.0] * 9, [1.0] * 18, [None] + [1.0] * 26, [1.0] * 36])),
            "row 2: covariance_row holds a value that is null or not finite",
        ),
        (with_column("covariance_row", pa.array([1.0, 2.0, 3.0, 4.0])), "column 'covariance_row' is of type double"),
        (with_column("covariance_row", pa.array([["a"] * 9 * i for i in (1, 2, 3, 4)])), "expected lists of float64"),
        (with_column("x", pa.array([1.0, None, 3.0, 4.0])), "row 1: column 'x' is null"),
        (with_column("x", pa.array(["1", "2", "3", "4"])), "column 'x' is of type string; expected double"),
        (with_column("point_id", pa.array([1, 2, 3, 4])), "column 'point_id' is of type int64; expected string"),
        (with_column("rays", pa.array([1.5, 2.0, 3.0, 4.0])), "column 'rays' is of type double; expected int64"),
        (lambda t: t.replace_schema_metadata({"tiles": "r003"}), "metadata 'tiles' is 'r003'"),
        (lambda t: t.replace_schema_metadata({"flattening": "[]"}), "metadata 'flattening'"),
    ],
)
def test_damaged_parquet_is_refused_with_its_place(tmp_path: Path, change: Callable[[pa.Table], pa.Table], message: str) -> None:
    path = rewritten(tmp_path / "t.parquet", change)
    with pytest.raises(InputError, match=rf"t\.parquet.*{message}"):
        read_parquet(path)


def test_parquet_without_metadata_is_read(tmp_path: Path) -> None:
    path = rewritten(tmp_path / "t.parquet", lambda t: t.replace_schema_metadata(None))
    arrays = read_parquet(path)
    np.testing.assert_array_equal(arrays["covariance"], point_table(4).covariance)
    assert "policy" not in arrays


@pytest.mark.parametrize("read", [read_parquet, read_npz])
def test_file_that_is_missing_or_something_else(tmp_path: Path, read: Callable[[Path], Any]) -> None:
    with pytest.raises(InputError, match="none"):
        read(tmp_path / "none")
    for content in (b"", b"PAR1 and rubbish", b"PK\x03\x04 and rubbish", b"\x93NUMPY"):
        (tmp_path / "other").write_bytes(content)
        with pytest.raises(InputError, match="other: cannot be read"):
            read(tmp_path / "other")


def test_npz_of_something_else(tmp_path: Path) -> None:
    np.savez(tmp_path / "o.npz", ids=np.array(["a"]))
    with pytest.raises(InputError, match="array 'geocentric' is missing"):
        read_npz(tmp_path / "o.npz")
    np.save(tmp_path / "single.npy", np.zeros(3))
    with pytest.raises(InputError, match="cannot be read as a NumPy archive"):
        read_npz(tmp_path / "single.npy")
    np.savez(tmp_path / "pickled.npz", ids=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="cannot be read as a NumPy archive"):
        read_npz(tmp_path / "pickled.npz")


def test_row_groups_cover_all_points_and_stay_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_GROUP_VALUES", 1000)
    groups = list(tables.row_groups(100))
    assert groups[0][0] == 0 and groups[-1][1] == 100
    assert all(a[1] == b[0] for a, b in pairwise(groups))
    # A group may pass the limit by less than one row.
    assert all(9 * sum(range(a + 1, b + 1)) <= 1000 + 9 * b for a, b in groups)


@pytest.mark.parametrize("n", [1, 5])
def test_gcp_claims_no_more_than_the_covariance_of_each_point(tmp_path: Path, n: int) -> None:
    table = point_table(n)
    write_table(tmp_path / "t.gcp", table)
    rows = np.array([[float(v) for v in line.split()] for line in (tmp_path / "t.gcp").read_text().splitlines()])
    assert rows.shape == (n, 7)
    np.testing.assert_array_equal(rows[:, 0], np.arange(1, n + 1))
    for k, name in enumerate(("latitude", "longitude", "height"), start=1):
        np.testing.assert_allclose(rows[:, k], table.columns[name], atol=1e-5 if name == "height" else 1e-11)
    for i, sigma in enumerate(rows[:, 4:]):
        own = table.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        whitened = np.linalg.eigvalsh(own / np.outer(sigma, sigma))
        assert 1.0 - 1e-4 < whitened[-1] <= 1.0


def test_gcp_keeps_ids_that_are_whole_numbers(tmp_path: Path) -> None:
    table = point_table(3)
    ids = np.array(["17", "3", "250"])
    write_table(tmp_path / "t.gcp", ControlTable({**table.columns, "point_id": ids}, table.covariance, METADATA))
    assert [line.split()[0] for line in (tmp_path / "t.gcp").read_text().splitlines()] == ["17", "3", "250"]
    ids[1] = "03"
    write_table(tmp_path / "t.gcp", ControlTable({**table.columns, "point_id": ids}, table.covariance, METADATA))
    assert [line.split()[0] for line in (tmp_path / "t.gcp").read_text().splitlines()] == ["1", "2", "3"]
