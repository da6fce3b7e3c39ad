"""`submin export`: what another program makes of the file, that it cannot come back as control, and what is refused."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.linalg as la
from networks import area_of, fuse

import submin
from orchestration.cli import main
from submin.correlation import FAMILIES, expand
from submin.errors import CatalogueError, InputError
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.point_table import read_point_table
from submin.storage.simulated import write_region

PAGE = Path(__file__).parents[2] / "docs" / "correlation.md"
TINY = RegionDesign(width_km=60, height_km=60, point_spacing_km=9.5)
(EXAMPLE,) = re.findall(r"```python\n(import json.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
BOX = (99.0, 34.0, 101.0, 36.0)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    region = simulate_region(TINY)
    write_region(region, folder / "catalogue")
    fuse(folder / "catalogue", folder / "network", area_of(region))
    return folder / "network"


@pytest.fixture(scope="module")
def exported(network: Path) -> Path:
    path = network.with_name("compact.parquet")
    submin.open(network).export(path, family="exponential", rank=4, policy="rigorous")
    return path


def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["submin", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr()
    return int(ended.value.code or 0), shown.out, shown.err


def test_the_example_of_the_documentation_expands_the_file(network: Path, exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is run as it stands, where the file is; it knows nothing of submin."""
    assert "submin" not in EXAMPLE and len(EXAMPLE.strip().splitlines()) <= 20
    monkeypatch.chdir(exported.parent)
    names: dict[str, np.ndarray] = {}
    exec(compile(EXAMPLE, str(PAGE), "exec"), names)
    joint = names["joint"]
    read = submin.read_compact(exported)
    np.testing.assert_allclose(joint, expand(read.covariance), rtol=1e-9, atol=1e-9 * np.abs(joint).max())
    true = submin.open(network).query(bbox=BOX, policy="rigorous")
    assert read.ids.tolist() == true.ids.tolist()
    assert la.eigh(true.covariance, joint, eigvals_only=True)[-1] <= 1.0 + 1e-9
    np.testing.assert_array_equal(read.covariance.geocentric, true.geocentric)
    np.testing.assert_array_equal(read.covariance.blocks, 0.5 * (true.point_covariance + true.point_covariance.transpose(0, 2, 1)))


@pytest.mark.parametrize(("family", "rank"), [*((name, 0) for name in FAMILIES), ("askey", 2)])
def test_what_is_read_is_what_was_written(network: Path, tmp_path: Path, family: str, rank: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("submin.correlation.compact.STEPS", (10,))
    written = submin.open(network).export(tmp_path / "compact.parquet", bbox=BOX, family=family, rank=rank)
    read = submin.read_compact(tmp_path / "compact.parquet")
    assert read.metadata == written.metadata
    np.testing.assert_array_equal(expand(read.covariance), expand(written.covariance))
    assert read.covariance.functions == written.covariance.functions
    assert (read.covariance.kappa, read.covariance.rank) == (written.covariance.kappa, rank)
    assert read.metadata["formula"] == FAMILIES[family].formula
    true = submin.open(network).query(bbox=BOX)
    assert la.eigh(true.covariance, expand(read.covariance), eigvals_only=True)[-1] <= 1.0


def test_it_is_refused_as_control(exported: Path, tmp_path: Path) -> None:
    with pytest.raises(CatalogueError, match="holds points that an adjustment gave"):
        read_point_table(exported, "definite")
    unmarked = tmp_path / "unmarked.parquet"
    pq.write_table(pq.read_table(exported).replace_schema_metadata({}), unmarked)
    with pytest.raises(CatalogueError, match="columns ce90, le90, tile, rays of points that a network"):
        read_point_table(unmarked, "definite")


def test_the_example_does_without_vectors(network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    written = submin.open(network).export("compact.parquet", family="exponential")
    names: dict[str, np.ndarray] = {}
    exec(compile(EXAMPLE, str(PAGE), "exec"), names)
    np.testing.assert_allclose(names["joint"], expand(written.covariance), rtol=1e-9, atol=1e-9 * np.abs(names["joint"]).max())


def test_the_command(network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("submin.correlation.compact.STEPS", (20,))
    words = ("export", network, "--out", tmp_path / "c.parquet", "--bbox", *BOX, "--family", "wendland", "--floor-km", 30, "--rank", 5)
    code, out, err = call(monkeypatch, capsys, *words, "--json")
    values = json.loads(out)
    assert (code, err) == (0, "")
    read = submin.read_compact(tmp_path / "c.parquet")
    n = len(read)
    assert (values["points"], values["rank"], values["family"], values["kappa"]) == (n, 5, "wendland", read.covariance.kappa)
    assert all(function["D"] <= 30_000.0 * (1.0 + 1e-12) for function in values["functions"])
    assert values["numbers"] == 6 * n + 3 * 2 + 1 + 15 * n and values["numbers_of_full_triangle"] == 3 * n * (3 * n + 1) // 2
    assert values["sigma_inflation"] == pytest.approx(np.sqrt(read.covariance.inflation.mean()))
    code, out, _ = call(monkeypatch, capsys, *words)
    assert code == 0 and out.startswith(f"{n} points of ") and "beside 5 vectors" in out


def test_all_points_and_fewer(network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("submin.correlation.compact.STEPS", (5,))
    opened, path = submin.open(network), tmp_path / "c.parquet"
    assert opened.export(path, family="exponential").ids.tolist() == opened.query(bbox=(-180.0, -89.0, 180.0, 89.0)).ids.tolist()
    assert 3 <= len(opened.export(path, family="exponential", max_points=9)) <= 9
    tile = opened.cover.tile_name(opened.snapshot.tile_numbers()[0])
    assert opened.export(path, family="exponential", tile=tile).ids.tolist() == opened.query(tile=tile).ids.tolist()
    control = opened.query(bbox=BOX, max_points=9)
    assert np.array_equal(
        control.compact("exponential").blocks, opened.export(path, bbox=BOX, max_points=9, family="exponential").covariance.blocks
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.replace_schema_metadata({}), "layout is None; expected 'submin compact covariance 1'"),
        (lambda t: t.drop_columns(["cov_yz"]), "column 'cov_yz' is missing"),
        (
            lambda t: t.set_column(t.column_names.index("x"), "x", pa.array([None, *range(1, t.num_rows)], pa.float64())),
            "column 'x' holds a value",
        ),
        (lambda t: marked(t, functions='[{"A": 2.0, "D": 1.0}]'), "A is 2; expected a number above 0 to 1"),
        (lambda t: marked(t, functions='[{"A": 1.0, "D": 1.0}]'), "its metadata is damaged .*1 functions; expected 3"),
        (lambda t: marked(t, family="tent"), "positive definite on a line only"),
        (lambda t: marked(t, kappa="much"), "its metadata is damaged"),
        (lambda t: marked(t, rank="7"), "row 1: low_rank has 12 values; expected 21, 3 for each of 7 vectors"),
    ],
)
def test_a_damaged_file_is_refused(exported: Path, tmp_path: Path, change: object, says: str) -> None:
    path = tmp_path / "damaged.parquet"
    assert callable(change)
    pq.write_table(change(pq.read_table(exported)), path)
    with pytest.raises(InputError, match=f"damaged.parquet: .*{says}" if "layout" not in says else says):
        submin.read_compact(path)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.parquet"
    path.write_text("points")
    with pytest.raises(InputError, match=r"c\.parquet: cannot be read as Parquet"):
        submin.read_compact(path)


def marked(table: pa.Table, **changes: str) -> pa.Table:
    return table.replace_schema_metadata({**table.schema.metadata, **{key.encode(): value.encode() for key, value in changes.items()}})
