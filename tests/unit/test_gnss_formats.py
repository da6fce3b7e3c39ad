"""DNA and DynaML: one measurement in two formats, import as clusters, values that take the place of others, and what is wrong."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gnss_files import MEASUREMENTS, dna_lines, simulated, xml_lines

from submin.errors import InputError
from submin.formats.dna import read_dna
from submin.formats.dynaml import read_dynaml
from submin.formats.gnss import GnssFile
from submin.storage.catalogue import Catalogue
from submin.storage.gnss_import import GnssImport, import_gnss
from submin.storage.point_table import read_point_table
from submin.storage.sinex_import import import_solution


def write(path: Path, lines: list[str]) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def survey(tmp_path: Path, lines: list[str] | None = None) -> Path:
    return write(tmp_path / "survey" / "survey.msr", dna_lines() if lines is None else lines)


def value_lines(shift: float = 0.5) -> list[str]:
    """A table of values: those of the file, and others."""
    lines = ["cluster,type,from,to,component,value_file_m,value_new_m"]
    for number, m in enumerate(MEASUREMENTS):
        for (start, end), value in zip(m.pairs, m.values, strict=True):
            lines += [f"{number},{m.type},{start},{end},{axis},{v:.4f},{v + shift:.4f}" for axis, v in zip("XYZ", value, strict=True)]
    return lines


def run(tmp_path: Path, file: Path, **options: Any) -> GnssImport:
    return import_gnss(file, tmp_path / "catalogue", **({"frame": "GDA2020"} | options))


@pytest.mark.parametrize(("read", "lines"), [(read_dna, dna_lines()), (read_dynaml, xml_lines())], ids=["dna", "dynaml"])
@pytest.mark.parametrize("compressed", [False, True])
def test_measurements_are_as_they_were_written(
    tmp_path: Path, read: Callable[[Path], GnssFile], lines: list[str], compressed: bool
) -> None:
    file = write(tmp_path / "survey", lines)
    if compressed:
        file.write_bytes(gzip.compress(file.read_bytes()))
    found = read(file)
    assert (found.frame, found.epoch, found.ignored) == ("GDA2020", "2020-01-01", 1)
    used = [(n, m) for n, m in enumerate(MEASUREMENTS) if not m.ignored]
    for measurement, (number, truth) in zip(found.measurements, used, strict=True):
        assert (measurement.number, measurement.type, measurement.frame) == (number, truth.type, truth.frame)
        assert list(zip(measurement.from_ids.tolist(), measurement.to_ids.tolist(), strict=True)) == list(truth.pairs)
        np.testing.assert_array_equal(measurement.values, truth.values)
        np.testing.assert_array_equal(measurement.covariance, truth.scale * truth.covariance)
    assert found.measurements[0].epoch == "2015-02-18"


def test_a_catalogue_of_clusters(tmp_path: Path) -> None:
    made = run(tmp_path, survey(tmp_path))
    assert (made.dataset, made.clusters, made.positions, made.baselines, made.points, made.ignored) == ("survey", 3, 2, 4, 5, 1)
    catalogue = Catalogue.open(tmp_path / "catalogue")
    catalogue.validate()
    assert (catalogue.metadata.frame, catalogue.metadata.epoch) == ("GDA2020", "2020-01-01")
    clusters = list(catalogue.observations())
    assert [c.cluster_id for c in clusters] == ["survey/0", "survey/2", "survey/3"]
    assert clusters[1].from_ids.tolist() == ["survey/A", "survey/A", "survey/D"]
    np.testing.assert_allclose(clusters[1].covariance, 8.95 * MEASUREMENTS[2].covariance, rtol=1e-15)
    assert "flagged to be left out" in made.notes[0]
    assert "2 measurements of 3 are baselines in ITRF2008 (1) and ITRF2014 (1), at 2 epochs from 2015-02-18 to 2018-01-17" in made.notes[1]


def test_station_names_as_global_ids(tmp_path: Path) -> None:
    run(tmp_path, survey(tmp_path), shared_ids=True, dataset="2015")
    cluster = next(Catalogue.open(tmp_path / "catalogue").observations())
    assert (cluster.cluster_id, cluster.point_ids.tolist()) == ("2015/0", ["A", "B"])


def test_values_of_a_table_take_the_place_of_those_of_the_file(tmp_path: Path) -> None:
    table = write(tmp_path / "survey" / "values.csv", value_lines())
    made = run(tmp_path, survey(tmp_path), values=table, frame="GDA94", epoch="1994-01-01")
    for cluster in Catalogue.open(tmp_path / "catalogue").observations():
        truth = MEASUREMENTS[int(cluster.cluster_id.split("/")[1])]
        np.testing.assert_allclose(cluster.values, truth.values + 0.5, atol=1e-9)
        np.testing.assert_array_equal(cluster.covariance, truth.scale * truth.covariance)
    assert "values are those of column 'value_new_m' of values.csv" in made.notes[1]


def test_another_column_of_values(tmp_path: Path) -> None:
    table = write(tmp_path / "survey" / "values.csv", value_lines())
    run(tmp_path, survey(tmp_path), values=table, value_column="value_file_m")
    np.testing.assert_array_equal(next(Catalogue.open(tmp_path / "catalogue").observations()).values, MEASUREMENTS[0].values)


@pytest.mark.parametrize("options", [{"frame": "ITRF2020"}, {"epoch": "2021-01-01"}])
def test_positions_of_another_frame_or_epoch_are_refused(tmp_path: Path, options: dict[str, str]) -> None:
    with pytest.raises(InputError, match=r"line 32: positions are of GDA2020 at 2020-01-01; expected .*: nothing is transformed"):
        run(tmp_path, survey(tmp_path), **options)
    assert not (tmp_path / "catalogue").exists()


def test_a_cluster_of_positions_as_control(tmp_path: Path) -> None:
    file = survey(tmp_path, dna_lines((MEASUREMENTS[3],)))
    made = import_solution(file, tmp_path / "control.parquet")
    table = read_point_table(tmp_path / "control.parquet", "definite")
    np.testing.assert_array_equal(table.joint_covariance, MEASUREMENTS[3].covariance)
    assert (table.point_ids.tolist(), made.frame, made.epoch) == (["A", "E"], "GDA2020", "2020-01-01")
    with pytest.raises(InputError, match=r"holds measurements 1 G, 1 X, 1 Y; expected one cluster of positions"):
        import_solution(survey(tmp_path), tmp_path / "other.parquet")


def edit(line: int, old: str, new: str) -> Callable[[list[str]], list[str]]:
    """Replaces a text in a line (from 1)."""

    def change(lines: list[str]) -> list[str]:
        assert old in lines[line - 1]
        return [*lines[: line - 1], lines[line - 1].replace(old, new, 1), *lines[line:]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:5], r"line 5: the file ends; expected z of A, of the measurement that begins in line 3"),
        (lambda lines: lines[:19], r"line 19: the file ends; expected a covariance of A, of the measurement that begins in line 11"),
        (lambda lines: [*lines[:5], *lines[6:]], r"line 6: found 'G\*B.*'; expected z of A, of the measurement that begins in line 3"),
        (lambda lines: lines[:27], r"line 27: the file ends; expected entry 3 of 3 of the X cluster that begins in line 11"),
        (lambda lines: lines[:2], r"line 2: the file ends without any measurement; expected some of type G, X or Y"),
        (edit(1, "!#=DNA 3.01 MSR", "!#=DNA 2.01 MSR"), r"line 1: begins with .*; expected a DNA file of version 3"),
        (edit(1, "MSR", "STN"), r"line 1: is a DNA file of 'STN'; expected one of measurements \('MSR'\)"),
        (edit(1, "01.01.2020", "2020-01-01"), r"line 1: epoch is '2020-01-01'; expected a day as in 01.01.2020"),
        (edit(3, "G A", "D A"), r"line 3: begins with 'D'; expected a measurement of type G, X or Y: others are not read"),
        (edit(3, "G A", "GxA"), r"line 3: column 2 holds 'x'; expected '\*'"),
        (edit(3, "B    ", "A    "), r"line 3: a baseline goes from 'A' to itself; expected two stations"),
        (edit(3, "B    ", "     "), r"line 3: the second station is missing; expected its name in columns 23-42"),
        (edit(3, "      1.00", "      2.00"), r"line 3: p-scale is 2; expected 1: scales by direction .* are not read"),
        (edit(3, "     10.00", "      0.00"), r"line 3: v-scale is 0; expected a positive number"),
        (edit(5, "e-", "x-"), r"line 5: a covariance is '.*x-.*'; expected a finite number"),
        (lambda lines: [*lines[:4], lines[4][:102], *lines[5:]], r"line 5: has 1 numbers of a covariance; expected 2, in fields of 20"),
        (lambda lines: [*lines[:3], lines[3] + lines[4][82:102], *lines[4:]], r"line 4: has 2 numbers of a covariance; expected 1"),
        (edit(11, "3    ", "0    "), r"line 11: number of entries of the cluster is '0'; expected 1 or more"),
        (edit(11, "3    ", "2    "), r"line 18: found '.*; expected entry 2 of 2 of the X cluster that begins in line 11"),
        (edit(32, "XYZ", "LLH"), r"line 32: coordinates of the positions are 'LLH'; expected XYZ: others are not read"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_dna_file_is_told_in_one_line(tmp_path: Path, change: Callable[[list[str]], list[str]], message: str) -> None:
    file = survey(tmp_path, change(dna_lines()))
    with pytest.raises(InputError, match=message) as raised:
        run(tmp_path, file)
    assert str(raised.value).startswith(f"{file}: line ") and "\n" not in str(raised.value)
    assert not (tmp_path / "catalogue").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:30], r"line \d+: is not XML \(no element found\); copy the file again"),
        (edit(2, "Measurement File", "Station File"), r"line 1: begins with <DnaXmlFormat> of type 'Station File'; expected"),
        (edit(5, ">G<", ">S<"), r"line 4: a measurement is of type 'S'; expected G, X or Y"),
        (edit(6, "><", ">yes<"), r"line 4: <Ignore> is 'yes'; expected '\*'"),
        (edit(10, "1.000", "1.100"), r"line 4: p-scale is 1.1; expected 1"),
        (edit(13, "<First>A</First>", ""), r"line 4: <GPSBaseline> has stations '' and 'B'; expected their names"),
        (edit(14, ">B<", ">A<"), r"line 4: a baseline goes from 'A' to itself"),
        (edit(16, "X>", "W>"), r"line 16: is not XML \(mismatched tag\); copy the file again"),
        (edit(19, "e-", "x-"), r"line 4: <SigmaXX> is '.*'; expected a finite number"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_dynaml_file_is_told_in_one_line(tmp_path: Path, change: Callable[[list[str]], list[str]], message: str) -> None:
    file = write(tmp_path / "survey" / "survey.xml", change(xml_lines()))
    with pytest.raises(InputError, match=message) as raised:
        run(tmp_path, file)
    assert str(raised.value).startswith(f"{file}: line ") and "\n" not in str(raised.value)


def test_entries_and_covariances_must_be_as_many_as_stated(tmp_path: Path) -> None:
    lines = xml_lines()
    total = lines.index("<Total>3</Total>")
    with pytest.raises(InputError, match=r"line \d+: a measurement of type X has 3 entries; expected 4$"):
        run(tmp_path, write(tmp_path / "survey" / "a.xml", [*lines[:total], "<Total>4</Total>", *lines[total + 1 :]]))
    first, last = lines.index("<GPSCovariance>"), lines.index("</GPSCovariance>")
    with pytest.raises(InputError, match=r"line \d+: entry 1 has 1 covariances with later ones; expected 2$"):
        run(tmp_path, write(tmp_path / "survey" / "b.xml", lines[:first] + lines[last + 1 :]))


def test_a_covariance_that_is_none(tmp_path: Path) -> None:
    flat = simulated("G", (("A", "B"),), 1)
    flat.covariance[1] = flat.covariance[:, 1] = flat.covariance[0]
    with pytest.raises(
        InputError, match=r"line 3: the covariance of the measurement that begins here is not positive definite \(at y of entry 1\)"
    ):
        run(tmp_path, survey(tmp_path, dna_lines((flat,))))


def test_a_file_cut_between_measurements_is_told(tmp_path: Path) -> None:
    made = run(tmp_path, survey(tmp_path, dna_lines()[:31]))
    assert any("states 4 measurements; the file has 3: it may have been cut short" in note for note in made.notes)


def test_other_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown suffix '\.txt'; expected \.msr \(DNA\) or \.xml \(DynaML\)"):
        run(tmp_path, write(tmp_path / "survey.txt", dna_lines()))
    with pytest.raises(InputError, match=r"none\.msr: no such file; expected a DNA measurement file$"):
        run(tmp_path, tmp_path / "none.msr")
    with pytest.raises(InputError, match=r"all 1 measurements are flagged to be left out; expected some to use$"):
        run(tmp_path, survey(tmp_path, dna_lines((MEASUREMENTS[1],))))
    broken = tmp_path / "broken.msr.gz"
    broken.write_bytes(gzip.compress(b"!#=DNA")[:12])
    with pytest.raises(InputError, match=r"broken\.msr\.gz: cannot be read \(.*\); copy it again$"):
        run(tmp_path, broken)


def empty_value(lines: list[str]) -> list[str]:
    return [lines[0], lines[1].rsplit(",", 1)[0] + ",", *lines[2:]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (edit(1, "cluster", "number"), r"column 'cluster' is missing; expected cluster, type, from, to, component"),
        (edit(2, "0,", "none,"), r"row 1: cluster is 'none'; expected a whole number"),
        (edit(2, "0,", "7,"), r"row 1: cluster is 7; expected the number of a measurement of survey.msr, 0 to 3"),
        (edit(2, "0,G", "0,X"), r"row 1: type is 'X'; expected 'G', that of measurement 0 \(line 3 of its file\)"),
        (edit(2, ",A,B,", ",B,A,"), r"row 1: from, to are 'B', 'A'; expected stations of measurement 0 \(line 3 of its file\)"),
        (edit(2, ",X,", ",N,"), r"row 1: component is 'N'; expected X, Y, Z"),
        (edit(2, ",X,", ",Y,"), r"row 1: value_file_m is .*; expected .*, as measured in survey.msr \(line 3\)"),
        (lambda lines: [*lines, lines[1]], r"row 22: component X of entry 1 of cluster 0 is there twice; expected it once"),
        (lambda lines: [lines[0], *lines[2:]], r"component X of entry 1 of cluster 0 is missing; expected a value for every component"),
        (lambda lines: [line.rsplit(",", 1)[0] for line in lines], r"has 1 columns of values; expected two or more"),
        (empty_value, r"row 1: value_new_m is None; expected a finite number of metres"),
        (edit(2, f"{MEASUREMENTS[0].values[0, 0]:.4f}", "1000.0"), r"row 1: value_file_m is 1000.0; expected .*, as measured in"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_table_of_values(tmp_path: Path, change: Callable[[list[str]], list[str]], message: str) -> None:
    table = write(tmp_path / "survey" / "values.csv", change(value_lines()))
    with pytest.raises(InputError, match=message) as raised:
        run(tmp_path, survey(tmp_path), values=table)
    assert str(raised.value).startswith(str(table)) and "\n" not in str(raised.value)


def test_an_unknown_column_of_values(tmp_path: Path) -> None:
    table = write(tmp_path / "survey" / "values.csv", value_lines())
    with pytest.raises(InputError, match=r"no column 'gda' of values; expected one of value_file_m, value_new_m$"):
        run(tmp_path, survey(tmp_path), values=table, value_column="gda")
