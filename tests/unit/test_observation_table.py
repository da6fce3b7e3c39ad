"""The table ``observations`` of a catalogue: clusters come back as they were written, and what is wrong is told with its place."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import pytest

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError
from submin.geodesy import WGS84
from submin.network.observations import Cluster
from submin.storage import catalogue_writer
from submin.storage.catalogue import Catalogue, CatalogueMetadata, CatalogueSummary, PointTable
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.observation_table import read_clusters
from submin.storage.point_table import read_point_table

METADATA = CatalogueMetadata("gnss", frame="GDA2020", epoch="2020-01-01")


def covariance(observations: int, seed: int = 0) -> np.ndarray:
    """A random positive definite matrix, millimetres to centimetres."""
    factor = np.random.default_rng(seed).normal(size=(3 * observations, 3 * observations + 2))
    lower = np.tril(1e-6 * factor @ factor.T)
    return np.asarray(lower + np.tril(lower, -1).T)


def clusters(seed: int = 0) -> list[Cluster]:
    """A position, a baseline, and a cluster of both."""
    rng = np.random.default_rng(seed)
    place = np.array([-4.2e6, 2.8e6, -3.8e6])

    def cluster(name: str, pairs: list[tuple[str, str]]) -> Cluster:
        start, end = np.array([a for a, _ in pairs]), np.array([b for _, b in pairs])
        values = np.where((end == "")[:, None], place, 0.0) + rng.normal(size=(len(pairs), 3)) * 1e4
        return Cluster(name, start, end, values, covariance(len(pairs), seed + len(pairs)))

    return [
        cluster("gnss/1", [("A", "")]), cluster("gnss/2", [("A", "B")]),
        cluster("gnss/3", [("C", ""), ("C", "A"), ("B", "D"), ("D", "")]),
    ]  # fmt: skip


def write(path: Path, of: list[Cluster]) -> Path:
    with CatalogueWriter(path, METADATA) as writer:
        for cluster in of:
            writer.write_observations(cluster)
    return path


def as_csv(path: Path, suffix: str = ".csv") -> None:
    """The same table as text."""
    columns = pq.read_table(path / "observations.parquet").to_pydict()
    columns["covariance_row"] = [" ".join(map(repr, row)) for row in columns["covariance_row"]]
    with (
        pa.CompressedOutputStream(str(path / f"observations{suffix}"), "gzip")
        if suffix.endswith("gz")
        else pa.OSFile(str(path / f"observations{suffix}"), "wb") as file
    ):
        pcsv.write_csv(pa.table(columns), file)
    (path / "observations.parquet").unlink()


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".csv.gz"])
def test_clusters_come_back_to_the_last_bit(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / "catalogue", clusters())
    if suffix != ".parquet":
        as_csv(path, suffix)
    catalogue = Catalogue.open(path)
    found = list(catalogue.observations())
    assert [c.cluster_id for c in found] == ["gnss/1", "gnss/2", "gnss/3"]
    for cluster, truth in zip(found, clusters(), strict=True):
        for name in ("from_ids", "to_ids", "values", "covariance"):
            np.testing.assert_array_equal(getattr(cluster, name), getattr(truth, name))
        assert cluster.content_hash() == truth.content_hash()
    assert catalogue.validate() == CatalogueSummary(blocks=0, images=0, rays=0, clusters=3, observations=6)


def test_a_catalogue_of_observations_has_no_tables_of_images(tmp_path: Path) -> None:
    path = write(tmp_path / "catalogue", clusters())
    assert sorted(file.name for file in path.iterdir()) == ["catalogue.json", "observations.parquet"]
    catalogue = Catalogue.open(path)
    assert len(catalogue.images) == 0 and list(catalogue.blocks()) == [] and catalogue.points("control") is None
    with pytest.raises(CatalogueError, match=r"no block 'b'; the catalogue has no images$"):
        catalogue.block("b")


def test_a_catalogue_of_control_alone(tmp_path: Path) -> None:
    table = PointTable(np.array(["A"]), np.array([[145.0, -36.0, 100.0]]), 1e-4 * np.eye(3)[None], np.array([""]))
    with CatalogueWriter(tmp_path / "catalogue", METADATA) as writer:
        writer.write_points("control", table)
    catalogue = Catalogue.open(tmp_path / "catalogue")
    assert catalogue.validate() == CatalogueSummary(0, 0, 0) and list(catalogue.observations()) == []
    assert len(catalogue.points("control") or ()) == 1


def test_a_catalogue_of_nothing_still_lacks_its_images(tmp_path: Path) -> None:
    with CatalogueWriter(tmp_path / "catalogue", METADATA) as writer:
        writer.write_priors(APriori())
    with pytest.raises(CatalogueError, match="holds no images"):
        Catalogue.open(tmp_path / "catalogue")
    (tmp_path / "catalogue" / "images.parquet").unlink()
    with pytest.raises(CatalogueError, match="no table 'images'"):
        Catalogue.open(tmp_path / "catalogue")


def test_many_clusters_come_in_few_row_groups_and_one_may_span_several(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    many = [Cluster(f"c{i}", np.array(["A"]), np.array(["B"]), np.ones((1, 3)), covariance(1)) for i in range(300)]
    assert pq.ParquetFile(write(tmp_path / "many", many) / "observations.parquet").num_row_groups == 1
    monkeypatch.setattr(catalogue_writer, "_GROUP_VALUES", 1)
    large = Cluster("large", np.array([f"p{i}" for i in range(130)]), np.array([""] * 130), np.full((130, 3), 4e6), covariance(130))
    path = write(tmp_path / "large", [large, many[0]])
    assert pq.ParquetFile(path / "observations.parquet").num_row_groups > 1
    assert [c.content_hash() for c in Catalogue.open(path).observations()] == [large.content_hash(), many[0].content_hash()]


def test_a_cluster_is_written_once(tmp_path: Path) -> None:
    with pytest.raises(CatalogueError, match="cluster 'gnss/1' is written twice"), CatalogueWriter(tmp_path / "c", METADATA) as writer:
        for _ in range(2):
            writer.write_observations(clusters()[0])
    assert not (tmp_path / "c").exists()


def test_the_content_is_that_of_the_observations_in_any_order() -> None:
    cluster = clusters()[2]
    order = np.array([2, 0, 3, 1])
    rows = (3 * order[:, None] + np.arange(3)).ravel()
    turned = Cluster("other", cluster.from_ids[order], cluster.to_ids[order], cluster.values[order], cluster.covariance[np.ix_(rows, rows)])
    assert turned.content_hash() == cluster.content_hash()


@pytest.mark.parametrize("what", ["from_ids", "to_ids", "values", "covariance"])
def test_whatever_differs_makes_another_content(what: str) -> None:
    cluster = clusters()[2]
    changed = {name: getattr(cluster, name).copy() for name in ("from_ids", "to_ids", "values", "covariance")}
    changed[what].flat[-1] = "Z" if what.endswith("ids") else 1.000001 * changed[what].flat[-1]
    assert Cluster("gnss/3", **changed).content_hash() != cluster.content_hash()


def put(name: str, row: int, value: Any) -> Callable[[dict[str, list[Any]]], None]:
    def change(columns: dict[str, list[Any]]) -> None:
        columns[name][row] = value

    return change


def degrees(columns: dict[str, list[Any]]) -> None:
    columns["x"][0], columns["y"][0], columns["z"][0] = 145.5, -36.5, 170.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("kind"), r"column 'kind' is missing; expected cluster, kind, from, to, x, y, z, covariance_row"),
        (put("kind", 1, "vector"), r"row 2: kind is 'vector'; expected 'position' or 'baseline'"),
        (put("to", 0, "B"), r"row 1: to is 'B'; expected an empty text: a position has no end"),
        (put("to", 1, ""), r"row 2: to is ''; expected the point where the baseline ends"),
        (put("to", 1, "A"), r"row 2: to is 'A'; expected another point than that where the baseline starts"),
        (put("from", 1, ""), r"row 2: from is ''; expected a text that is not empty"),
        (put("y", 3, None), r"row 4: y is None; expected a finite number of metres"),
        (put("x", 3, float("inf")), r"row 4: x is inf; expected a finite number of metres"),
        (degrees, r"row 1: x, y, z is '145.5, -36.5, 170'; expected geocentric metres of a point on the ground"),
        (put("covariance_row", 3, [1.0] * 9), r"row 4: covariance_row has 9 values; expected 18 .* of cluster 'gnss/3'\)$"),
        (put("covariance_row", 0, [2.0, 1, 0, 0, 2, 0, 0, 0, 2]), r"row 1: covariance_row is .*; expected a symmetric covariance"),
        (put("covariance_row", 1, [float("nan")] * 9), r"row 2: covariance_row holds a value that is null or not finite"),
        (put("covariance_row", 1, [1.0] * 9), r"row 2: the covariance of cluster 'gnss/2' \(covariance_row\) is not positive definite"),
        (put("cluster", 4, "gnss/1"), r"row 5: cluster 'gnss/1' comes back after 'gnss/3'; expected rows sorted by cluster"),
        (put("cluster", 0, "control:A"), r"row 1: cluster is 'control:A'; expected another id"),
        (lambda c: [values.clear() for values in c.values()], r"holds no observations; expected at least one row"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_with_its_place(tmp_path: Path, change: Callable[[dict[str, list[Any]]], None], message: str) -> None:
    path = write(tmp_path / "catalogue", clusters())
    file = path / "observations.parquet"
    columns, types = pq.read_table(file).to_pydict(), {f.name: f.type for f in pq.read_schema(file)}
    change(columns)
    pq.write_table(pa.table({name: pa.array(values, types[name]) for name, values in columns.items()}), file)
    with pytest.raises(CatalogueError, match=message) as raised:
        Catalogue.open(path).validate()
    assert str(raised.value).startswith(str(file)) and not re.search(r"\n", str(raised.value))


def test_a_broken_number_in_the_text_of_a_covariance(tmp_path: Path) -> None:
    path = write(tmp_path / "catalogue", clusters()[:2])
    as_csv(path)
    file = path / "observations.csv"
    header, first, second = file.read_text().splitlines()
    start, values = second.rsplit(",", 1)
    file.write_text("\n".join([header, first, f'{start},"one{values[1:]}', ""]))
    with pytest.raises(CatalogueError, match=r"row 2: covariance_row is 'one.*'; expected numbers with blanks between them"):
        Catalogue.open(path).validate()


def test_a_cluster_is_no_block_of_images(tmp_path: Path) -> None:
    file = write(tmp_path / "catalogue", clusters()) / "observations.parquet"
    with pytest.raises(CatalogueError, match=r"row 2: cluster is 'gnss/2', a block of images; expected an id of its own$"):
        list(read_clusters(file, WGS84, {"gnss/2"}))


def test_control_in_csv_has_its_joint_covariance_as_text(tmp_path: Path) -> None:
    joint = covariance(2)
    lines = ["point_id,longitude,latitude,height,covariance_row"]
    lines += [f"P{i},{145 + i},-36,100,{' '.join(map(repr, joint[3 * i : 3 * i + 3, : 3 * i + 3].ravel().tolist()))}" for i in range(2)]
    (tmp_path / "control.csv").write_text("\n".join(lines) + "\n")
    np.testing.assert_array_equal(read_point_table(tmp_path / "control.csv").joint_covariance, joint)
