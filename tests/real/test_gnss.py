"""Real GNSS measurements and geodetic solutions: what is read is what the files hold, and adjusts as a network must."""

from __future__ import annotations

import csv
import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.stats import chi2

from orchestration.cli import main
from submin.geodesy import geodetic_to_geocentric
from submin.network.observations import Cluster
from submin.storage.catalogue import Catalogue
from submin.storage.gnss_import import import_gnss
from submin.storage.point_table import read_point_table
from submin.storage.sinex_import import import_solution

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def network(data: Path) -> Path:
    return data / "dynadjust_gnss_network"


@pytest.fixture(scope="module")
def catalogue(network: Path, tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    """The network with the values of GDA2020."""
    out = tmp_path_factory.mktemp("gnss") / "catalogue"
    import_gnss(network / "gnss-network.msr", out, values=network / "measured_gda2020.csv", shared_ids=True)
    return Catalogue.open(out)


def least_squares(clusters: list[Cluster]) -> tuple[list[str], Array, Array, float]:
    """Points, coordinates, covariance and sum of squares of all clusters at once, in plain matrices."""
    ids = sorted({point for cluster in clusters for point in cluster.point_ids.tolist()})
    rows = {point: slice(3 * i, 3 * i + 3) for i, point in enumerate(ids)}
    design = np.zeros((3 * sum(map(len, clusters)), 3 * len(ids)))
    covariance = np.zeros((len(design), len(design)))
    first = 0
    for cluster in clusters:
        mine = slice(3 * first, 3 * (first + len(cluster)))
        covariance[mine, mine] = cluster.covariance
        for k, (start, end) in enumerate(zip(cluster.from_ids.tolist(), cluster.to_ids.tolist(), strict=True), start=first):
            design[3 * k : 3 * k + 3, rows[start]] = -np.eye(3) if end else np.eye(3)
            if end:
                design[3 * k : 3 * k + 3, rows[end]] = np.eye(3)
        first += len(cluster)
    values = np.concatenate([cluster.values.ravel() for cluster in clusters])
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    found, _, rank, _ = np.linalg.lstsq(whiten @ design, whiten @ values)
    assert rank == 3 * len(ids)
    residuals = whiten @ (values - design @ found)  # of the residuals themselves: differences of great sums lose all digits
    normal = cho_factor((whiten @ design).T @ (whiten @ design))
    return ids, found.reshape(-1, 3), cho_solve(normal, np.eye(len(found))), float(residuals @ residuals)


def test_both_formats_hold_the_same_clusters(network: Path, tmp_path: Path) -> None:
    clusters = []
    for name in ("gnss-network.msr", "gnss-networkmsr.xml"):
        made = import_gnss(network / name, tmp_path / name)
        assert (made.clusters, made.positions, made.baselines, made.points, made.ignored) == (131, 6, 133, 43, 0)
        assert (made.frame, made.epoch, made.dataset) == ("GDA2020", "2020-01-01", "dynadjust_gnss_network")
        assert "baselines in ITRF2008 (71) and ITRF2014 (59), at 8 epochs from 2015-02-18 to 2018-05-30" in made.notes[0]
        clusters.append({c.cluster_id: c.content_hash() for c in Catalogue.open(tmp_path / name).observations()})
    assert clusters[0] == clusters[1] and len(clusters[0]) == 131


def test_what_is_imported_is_what_the_table_of_values_holds(network: Path, catalogue: Catalogue) -> None:
    with (network / "measured_gda2020.csv").open() as file:
        table = {(row["cluster"], row["from"], row["to"], row["component"]): float(row["value_gda2020_m"]) for row in csv.DictReader(file)}
    found = {
        (cluster.cluster_id.split("/")[1], start, end, axis): value
        for cluster in catalogue.observations()
        for start, end, values in zip(cluster.from_ids.tolist(), cluster.to_ids.tolist(), cluster.values.tolist(), strict=True)
        for axis, value in zip("XYZ", values, strict=True)
    }
    assert found == table and len(found) == 417
    assert (catalogue.validate().clusters, catalogue.validate().observations) == (131, 139)


def test_the_scale_multiplies_the_covariance(network: Path, catalogue: Catalogue) -> None:
    """The first measurement, by hand: its v-scale is 10."""
    first = next(catalogue.observations())
    lines = (network / "gnss-network.msr").read_text().splitlines()[7:11]
    assert float(lines[0][62:72]) == 10.0
    assert first.covariance[0, 0] == 10.0 * float(lines[1][82:102]) and first.covariance[2, 1] == 10.0 * float(lines[3][102:122])


def test_the_417_components_adjust_as_one_network(catalogue: Catalogue, network: Path) -> None:
    """With the values of one frame 43 points fit their observations; with those of the file as it is they fit worse."""
    clusters = list(catalogue.observations())
    ids, places, covariance, squares = least_squares(clusters)
    freedom = 417 - 3 * len(ids)
    assert (len(ids), freedom) == (43, 288)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    # The scales of the file make of the chi-square what its author wanted: neither too small nor too great.
    assert chi2.cdf(squares, freedom) < 0.999 and squares > 0.2 * freedom
    sigma = np.sqrt(np.diagonal(covariance))
    assert 0.001 < sigma.min() < sigma.max() < 0.1
    stations: dict[str, Array] = {}
    for line in (network / "gnss-network.stn").read_text().splitlines()[7:]:
        station, _, kind, *numbers = line[:85].split()[:6]
        first, second, third = map(float, numbers)
        if kind == "LLH":
            degrees = [np.sign(v) * sexagesimal(abs(v)) for v in (second, first)]
            stations[station] = geodetic_to_geocentric(np.array([[*degrees, third]]))[0]
        else:
            stations[station] = np.array([first, second, third])
    # Coordinates that came with the measurements; the heights of those in degrees are above the geoid, some 8 m lower.
    off = np.abs(places - [stations[point] for point in ids]).max(axis=1)
    assert (off < 10.0).all() and np.sort(off)[9] < 0.2


def sexagesimal(value: float) -> float:
    """Degrees of ``ddd.mmsssss``."""
    degrees = int(value)
    minutes = int(round((value - degrees) * 1e10) // 10**8)
    return degrees + minutes / 60 + ((value - degrees) * 100 - minutes) * 100 / 3600


def test_the_continental_solution_is_control_with_all_its_covariance(data: Path, tmp_path: Path) -> None:
    folder = data / "apr_itrf2008_continental"
    made = import_solution(folder / "apr.ITRF2008.04.06.2020.msr.gz", tmp_path / "control.parquet")
    assert (made.points, made.frame, made.epoch, made.constraint) == (58, "ITRF2008", "2020-06-04", "none")
    table = read_point_table(tmp_path / "control.parquet", "definite")
    lines = (folder / "apr.ITRF2008.04.06.2020.stn").read_text().splitlines()[3:]
    stations = {line[:20].strip(): [float(v) for v in line[28:].split()[:3]] for line in lines}
    np.testing.assert_allclose(geodetic_to_geocentric(table.geodetic), [stations[point] for point in table.point_ids.tolist()], atol=1e-6)
    joint = table.joint_covariance
    assert joint is not None and joint.shape == (174, 174) and (joint != 0.0).all()
    np.testing.assert_allclose(np.linalg.eigvalsh(joint)[[0, -1]], [8.7e-9, 4.6e-6], rtol=0.02)
    sigma = np.sqrt(np.diagonal(joint))
    correlation = np.abs(joint / np.outer(sigma, sigma))
    correlation[np.kron(np.eye(58), np.ones((3, 3))) > 0] = 0.0
    assert correlation.max() == pytest.approx(0.76, abs=0.01)
    measured = import_gnss(folder / "apr.ITRF2008.04.06.2020.msr.gz", tmp_path / "catalogue", shared_ids=True)
    (cluster,) = Catalogue.open(measured.catalogue).observations()
    np.testing.assert_array_equal(cluster.covariance, joint)


def sinex_block(path: Path, name: str) -> list[str]:
    """Lines of a block, comments left out."""
    text = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
    lines = text.splitlines()
    first, last = (next(i for i, line in enumerate(lines) if line.startswith(sign + name)) for sign in "+-")
    return [line for line in lines[first + 1 : last] if not line.startswith("*")]


@pytest.mark.parametrize(
    ("name", "points", "epoch", "constraint"),
    [("TEST_ITRF05.SNX", 3, "2017-10-25T12:00:00", "none"), ("gns_nz_2001_333.snx.gz", 20, "2001-11-29T11:59:45", "removed")],
)
def test_standard_deviations_are_those_of_the_file(data: Path, tmp_path: Path, name: str, points: int, epoch: str, constraint: str) -> None:
    path = data / "sinex_full_covariance" / name
    made = import_solution(path, tmp_path / "control.parquet")
    assert (made.points, made.epoch, made.constraint) == (points, epoch, constraint)
    table = read_point_table(tmp_path / "control.parquet", "definite")
    assert table.joint_covariance is not None
    estimate = sinex_block(path, "SOLUTION/ESTIMATE")
    np.testing.assert_allclose(np.sqrt(np.diagonal(table.joint_covariance)), [float(line[69:80]) for line in estimate], rtol=3e-5)
    np.testing.assert_allclose(geodetic_to_geocentric(table.geodetic).ravel(), [float(line[47:68]) for line in estimate], atol=1e-5)
    assert table.point_ids.tolist() == [line[14:18].strip() for line in estimate[::3]]


def matrix_of(path: Path, name: str, n: int) -> Array:
    """A lower triangle, in the test's own reading."""
    matrix = np.zeros((n, n))
    for line in sinex_block(path, name):
        row, first, *elements = line.split()
        for k, element in enumerate(elements):
            matrix[int(row) - 1, int(first) - 1 + k] = matrix[int(first) - 1 + k, int(row) - 1] = float(element)
    return matrix


def test_the_constraint_of_the_daily_solution_is_loose_and_is_removed(data: Path, tmp_path: Path) -> None:
    """Seven metres a coordinate, against centimetres of the least known direction: nearly nothing of the estimate is from it."""
    path = data / "sinex_full_covariance" / "gns_nz_2001_333.snx.gz"
    estimate, a_priori = matrix_of(path, "SOLUTION/MATRIX_ESTIMATE", 60), matrix_of(path, "SOLUTION/MATRIX_APRIORI", 60)
    assert np.sqrt(np.diagonal(a_priori)).min() == pytest.approx(6.8, abs=0.05)
    free = np.linalg.inv(np.linalg.inv(estimate) - np.linalg.inv(a_priori))
    made = import_solution(path, tmp_path / "control.parquet")
    joint = read_point_table(tmp_path / "control.parquet").joint_covariance
    np.testing.assert_allclose(joint, free, rtol=0, atol=1e-8 * free.max())
    assert eigh(free, joint, eigvals_only=True)[-1] <= 1.0 + 1e-12
    assert eigh(estimate, joint, eigvals_only=True)[0] < 1.0 - 1e-5  # what was published claims more
    assert 1e-5 < made.constraint_share < 1e-4
    kept = import_solution(path, tmp_path / "kept.parquet", keep_constraints=True)
    np.testing.assert_array_equal(read_point_table(kept.file).joint_covariance, estimate)
    assert kept.constraint == "kept"


def test_the_commands(
    data: Path, network: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*words: object) -> object:
        monkeypatch.setattr("sys.argv", ["submin", *map(str, words)])
        with pytest.raises(SystemExit) as left:
            main()
        return left.value.code

    def said(*words: object) -> dict[str, object]:
        assert run(*words, "--json") in (0, None)
        answer: dict[str, object] = json.loads(capsys.readouterr().out)
        return answer

    made = said(
        "import", "gnss", network / "gnss-network.msr", "--values", network / "measured_gda2020.csv", "--out", tmp_path / "catalogue"
    )  # fmt: skip
    assert (made["clusters"], made["points"], made["frame"]) == (131, 43, "GDA2020")
    made = said("import", "sinex", data / "sinex_full_covariance" / "TEST_ITRF05.SNX", "--out", tmp_path / "control.parquet")
    assert (made["points"], made["constraint"], made["notes"]) == (3, "none", [])
    assert run("import", "gnss", network / "gnss-network.msr", "--out", tmp_path / "catalogue") == 2
    assert "is not empty; expected a new folder" in capsys.readouterr().err
