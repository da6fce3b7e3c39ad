"""SINEX: every kind of matrix, what an estimate is without its constraint, and what is wrong, told in one line."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import eigh
from sinex_files import sinex_lines, station_parameters, write_sinex

from submin.adjustment.constraint_removal import without_constraint
from submin.errors import InputError, NumericalError
from submin.formats.sinex import read_sinex
from submin.geodesy import geodetic_to_geocentric
from submin.storage.point_table import read_point_table
from submin.storage.sinex_import import SolutionImport, import_solution

Array = NDArray[np.float64]


def places(stations: int) -> Array:
    """Stations some thousand kilometres apart, (n, 3)."""
    rng = np.random.default_rng(5)
    return geodetic_to_geocentric(
        np.stack([rng.uniform(110, 180, stations), rng.uniform(-50, 0, stations), rng.uniform(0, 900, stations)], axis=1)
    )


def information(n: int, seed: int, scale: float = 1e5) -> Array:
    """A random information matrix of coordinates known to some millimetres."""
    factor = np.random.default_rng(seed).normal(size=(n, n + 3))
    return np.asarray(scale * factor @ factor.T / n)


def translations(stations: int) -> Array:
    """The directions (3n, 3) in which a network of vectors alone is free."""
    return np.tile(np.eye(3), (stations, 1))


def constrained(free: Array, truth: Array, constraint: Array, a_priori: Array) -> tuple[Array, Array]:
    """Estimate and covariance with a constraint of that information, by the normal equations."""
    normal = free + constraint
    covariance = np.linalg.inv(normal)
    covariance = 0.5 * (covariance + covariance.T)
    return truth + covariance @ (constraint @ (a_priori - truth)), covariance


def import_lines(tmp_path: Path, lines: list[str], **options: Any) -> SolutionImport:
    return import_solution(write_sinex(tmp_path / "solution.snx", lines), tmp_path / "control.parquet", **options)


def written(tmp_path: Path) -> tuple[Array, Array]:
    """Geocentric coordinates (3n,) and joint covariance of the control that was written."""
    table = read_point_table(tmp_path / "control.parquet", "definite")
    assert table.joint_covariance is not None
    return geodetic_to_geocentric(table.geodetic).ravel(), table.joint_covariance


def looser(reported: Array, truth: Array) -> float:
    """Greatest eigenvalue of reported^-1 truth: not above 1 when no more accuracy is claimed than there is."""
    return float(eigh(truth, reported, eigvals_only=True)[-1])


@pytest.mark.parametrize("triangle", ["L", "U"])
@pytest.mark.parametrize("kind", ["COVA", "CORR", "INFO"])
def test_every_kind_of_matrix_is_the_same_covariance(tmp_path: Path, kind: str, triangle: str) -> None:
    truth, covariance = places(4).ravel(), np.linalg.inv(information(12, 1))
    covariance = 0.5 * (covariance + covariance.T)
    made = import_lines(tmp_path, sinex_lines(station_parameters(4), truth, covariance, triangle, kind))
    found, joint = written(tmp_path)
    np.testing.assert_allclose(found, truth, atol=1e-7)
    np.testing.assert_allclose(joint, covariance, rtol=0, atol=1e-12 * covariance.max())
    assert (made.points, made.epoch, made.constraint, made.notes) == (4, "2017-10-25T12:00:00", "none", ())


def test_correlations_with_ones_on_the_diagonal_take_the_sigmas_of_the_estimates(tmp_path: Path) -> None:
    covariance = np.linalg.inv(information(6, 1))
    lines = sinex_lines(station_parameters(2), places(2).ravel(), covariance, "L", "CORR")
    start = lines.index("+SOLUTION/MATRIX_ESTIMATE L CORR")
    for i in range(6):
        row = next(k for k in range(start, len(lines)) if lines[k].startswith(f" {i + 1:5d} {3 * (i // 3) + 1:5d}"))
        fields = lines[row].split()
        lines[row] = f" {fields[0]:>5s} {fields[1]:>5s} " + " ".join([*fields[2:-1], "1.00000000000000E+00"])
    import_lines(tmp_path, lines)
    np.testing.assert_allclose(written(tmp_path)[1], covariance, rtol=0, atol=1.2e-5 * covariance.max())  # six digits, squared


def test_a_compressed_file_is_the_same(tmp_path: Path) -> None:
    lines = sinex_lines(station_parameters(2), places(2).ravel(), np.linalg.inv(information(6, 1)))
    (tmp_path / "solution.SNX.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    assert import_solution(tmp_path / "solution.SNX.gz", tmp_path / "control.parquet").points == 2


def test_parameters_that_are_no_coordinates_are_marginalised(tmp_path: Path) -> None:
    names = station_parameters(3, velocities=True)
    values = np.where([kind.startswith("STA") for kind, _ in names], np.repeat(places(3), [2] * 3, axis=0).ravel(), 0.02)
    covariance = np.linalg.inv(information(18, 2))
    made = import_lines(tmp_path, sinex_lines(names, values, covariance))
    rows = np.flatnonzero([kind.startswith("STA") for kind, _ in names])
    np.testing.assert_allclose(written(tmp_path)[1], covariance[np.ix_(rows, rows)], atol=1e-12 * covariance.max())
    assert made.notes == ("parameters other than coordinates are left out, as unknown as the file has them: 3 VELX, 3 VELY, 3 VELZ",)


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), stations=st.integers(1, 5), exponent=st.floats(-4, 4))
def test_without_its_constraint_an_estimate_is_that_of_the_observations(seed: int, stations: int, exponent: float) -> None:
    n = 3 * stations
    free, constraint = information(n, seed), information(n, seed + 1, 10.0 ** (5 + exponent))
    rng = np.random.default_rng(seed)
    truth, a_priori = rng.normal(size=n), rng.normal(size=n)
    estimate, covariance = constrained(free, truth, constraint, a_priori)
    try:
        freed = without_constraint(estimate, covariance, a_priori, constraint, digits=1e-13)
    except NumericalError:
        # Only where the observations are a millionth of the whole or less in some direction.
        assert eigh(free, free + constraint, eigvals_only=True)[0] < 1e-5
        return
    true_covariance = np.linalg.inv(free)
    assert looser(freed.covariance, true_covariance) <= 1.0 + 1e-9
    np.testing.assert_allclose(freed.covariance, true_covariance, atol=0.03 * np.abs(true_covariance).max())
    np.testing.assert_allclose(freed.estimate, truth, atol=0.03)


@pytest.mark.parametrize(("kind", "a_priori_kind"), [("COVA", "COVA"), ("INFO", "INFO"), ("CORR", "COVA"), ("COVA", "CORR")])
@pytest.mark.parametrize("share", [1e-4, 0.5, 0.999])
def test_the_constraint_of_a_file_is_removed(tmp_path: Path, kind: str, a_priori_kind: str, share: float) -> None:
    """A file whose truth is known; what is imported claims no more than the observations alone give."""
    names, n = station_parameters(4), 12
    truth, free = places(4).ravel(), information(n, 3)
    direction = translations(4)
    tight = np.linalg.eigvalsh(direction.T @ free @ direction).mean() / 4 * share / (1 - share)
    constraint = tight * np.eye(n)  # sum over the stations: `share` of the information of a common translation
    a_priori = truth + 0.01 * np.random.default_rng(4).normal(size=n)
    estimate, covariance = constrained(free, truth, constraint, a_priori)
    lines = sinex_lines(names, estimate, covariance, "L", kind, (a_priori, np.linalg.inv(constraint)), a_priori_kind, "1")
    made = import_lines(tmp_path, lines)
    found, joint = written(tmp_path)
    true_covariance = np.linalg.inv(free)
    assert looser(joint, true_covariance) <= 1.0
    np.testing.assert_allclose(joint, true_covariance, rtol=0, atol=1e-6 * np.abs(true_covariance).max())
    error = found - truth
    assert error @ free @ error < (0.1 if share > 0.9 else 1e-3) ** 2  # standard deviations; coordinates are printed to 10 nm
    assert made.constraint == "removed" and 0.0 < made.constraint_share < 1.0
    assert looser(covariance, true_covariance) > 1.0  # as the file stands it claims more


def test_velocities_take_their_part_in_the_removal(tmp_path: Path) -> None:
    names = station_parameters(2, velocities=True)
    n, rows = len(names), [i for i, (kind, _) in enumerate(names) if kind.startswith("STA")]
    values = np.where([kind.startswith("STA") for kind, _ in names], np.repeat(places(2), [2] * 2, axis=0).ravel(), 0.02)
    free = information(n, 6)
    constraint = np.diag([0.0 if kind.startswith("STA") else 1e5 for kind, _ in names])  # of the velocities alone
    estimate, covariance = constrained(free, values, constraint, values + 0.01)
    a_priori_covariance = np.diag([0.0 if kind.startswith("STA") else 1e-5 for kind, _ in names])
    import_lines(tmp_path, sinex_lines(names, estimate, covariance, a_priori=(values + 0.01, a_priori_covariance)))
    found, joint = written(tmp_path)
    np.testing.assert_allclose(joint, np.linalg.inv(free)[np.ix_(rows, rows)], atol=1e-11)
    np.testing.assert_allclose(found, values[rows], atol=2e-7)


def free_network(stations: int = 4) -> list[str]:
    """Lines of a solution whose observations do not know where it lies; its constraint alone holds it."""
    names, n = station_parameters(stations), 3 * stations
    truth, direction = places(stations).ravel(), translations(stations)
    free = information(n, 3)
    held = free @ direction
    free -= held @ np.linalg.solve(direction.T @ held, held.T)
    constraint = 1e4 * np.eye(n)
    estimate, covariance = constrained(free, truth, constraint, truth)
    return sinex_lines(names, estimate, covariance, "L", "COVA", (truth, np.linalg.inv(constraint)), code="1")


def test_a_free_network_is_refused_unless_its_constraint_is_kept(tmp_path: Path) -> None:
    lines = free_network()
    with pytest.raises(InputError, match=r"line \d+: without its constraint .* undetermined in 3 of 12 directions .* --keep-constraints"):
        import_lines(tmp_path, lines)
    assert not (tmp_path / "control.parquet").exists()
    made = import_lines(tmp_path, lines, keep_constraints=True)
    assert made.constraint == "kept" and "the a priori constraint is kept" in made.notes[-1]


def test_a_constraint_that_knows_more_than_the_estimate_is_none_of_it() -> None:
    with pytest.raises(NumericalError, match=r"holds 4 times the information of the estimate in one direction"):
        without_constraint(np.zeros(3), np.eye(3), np.zeros(3), np.diag([0.0, 4.0, 0.0]), 1e-14)


def test_a_stated_constraint_without_its_matrix_cannot_be_removed(tmp_path: Path) -> None:
    lines = sinex_lines(station_parameters(2), places(2).ravel(), np.linalg.inv(information(6, 1)), code="1")
    with pytest.raises(
        InputError, match=r"line 1: the header calls the constraints significant \(code 1\), and there is no .*MATRIX_APRIORI"
    ):
        import_lines(tmp_path, lines)
    made = import_lines(tmp_path, lines, keep_constraints=True)
    assert made.constraint == "kept" and "they are kept" in made.notes[0]


def test_of_two_statements_of_one_accuracy_the_lesser_is_believed(tmp_path: Path) -> None:
    names, covariance = station_parameters(2), np.linalg.inv(information(6, 1))
    lines = sinex_lines(names, places(2).ravel(), 4.0 * covariance)
    of_matrix = sinex_lines(names, places(2).ravel(), covariance)
    start = lines.index("+SOLUTION/MATRIX_ESTIMATE L COVA")
    made = import_lines(tmp_path, [*lines[:start], *of_matrix[start:]])
    np.testing.assert_allclose(written(tmp_path)[1], 4.0 * covariance, rtol=0, atol=1e-5 * covariance.max())
    assert "2 times those of the matrix; the greater are taken: the covariance is multiplied by 4" in made.notes[0]


def test_frame_and_epoch_are_compared_and_nothing_is_transformed(tmp_path: Path) -> None:
    lines = sinex_lines(station_parameters(2), places(2).ravel(), np.linalg.inv(information(6, 1)))
    with pytest.raises(InputError, match=r"of epoch 2017-10-25T12:00:00; expected 2020: nothing is transformed$"):
        import_lines(tmp_path, lines, epoch="2020")
    made = import_lines(tmp_path, lines, epoch="2017-10-25", frame="ITRF2014", prefix="gnss/")
    assert (made.frame, made.epoch) == ("ITRF2014", "2017-10-25T12:00:00")
    assert read_point_table(tmp_path / "control.parquet").point_ids.tolist() == ["gnss/S000", "gnss/S001"]


def edit(old: str, new: str) -> Callable[[list[str]], list[str]]:
    """Replaces one line that has the text."""

    def change(lines: list[str]) -> list[str]:
        at = next(i for i, line in enumerate(lines) if old in line)
        return [*lines[:at], *([lines[at].replace(old, new, 1)] if new else []), *lines[at + 1 :]]

    return change


def without_block(name: str) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        first, last = (next(i for i, line in enumerate(lines) if line.startswith(sign + name)) for sign in "+-")
        return lines[:first] + lines[last + 1 :]

    return change


def doubled(lines: list[str]) -> list[str]:
    """An off-diagonal element as large as cannot be."""
    at = lines.index("+SOLUTION/MATRIX_ESTIMATE L COVA") + 2
    fields = lines[at].split()
    return [*lines[:at], f" {fields[0]:>5s} {fields[1]:>5s}  9.00000000000000E+00 {fields[3]}", *lines[at + 1 :]]


def second_epoch(lines: list[str]) -> list[str]:
    return edit("STAY   S001  A    1 17:298:43200", "STAY   S001  A    1 17:299:00000")(lines)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:-5], r"line 22: the file ends inside of block SOLUTION/MATRIX_ESTIMATE, which begins in line 16: it was"),
        (lambda lines: lines[:-1], r"line 26: the file ends without '%ENDSNX': it was cut short"),
        (edit("%=SNX 2.01", "%=ABC 2.01"), r"line 1: begins with '%=ABC.*'; expected '%=SNX'"),
        (edit("%=SNX 2.01", "%=SNX 3.00"), r"line 1: SINEX version is '3.00'; expected 0.05 to 2.xx"),
        (without_block("SOLUTION/MATRIX_ESTIMATE"), r"has no block SOLUTION/MATRIX_ESTIMATE; expected the estimated coordinates"),
        (without_block("SOLUTION/ESTIMATE"), r"has no block SOLUTION/ESTIMATE; expected"),
        (edit("-SOLUTION/ESTIMATE", "-SOLUTION/APRIORI"), r"line 15: ends block 'SOLUTION/APRIORI'; expected '-SOLUTION/ESTIMATE'"),
        (edit("-SOLUTION/ESTIMATE", ""), r"line 15: block SOLUTION/MATRIX_ESTIMATE L COVA begins inside of block SOLUTION/EST"),
        (edit(" S001  A", " S009  A"), r"line 12: STAX of station 'S001', point 'A': unknown; expected a station of SITE/ID"),
        (edit("STAZ   S001", "VELZ   S001"), r"line 12: STAZ of station 'S001' is missing; expected all three coordinates"),
        (edit("STAY   S001", "STAX   S001"), r"line 13: STAX S001 A 1 2017-10-25T12:00:00 is estimated twice; expected it once"),
        (second_epoch, r"line 13: STAY of station .S001. is at epoch 2017-10-26T00:00:00, others are at 2017-10-25T12"),
        (edit("STAY   S001  A    1 17:298:43200", "STAY   S001  A    1 17/298/43200"), r"line 13: epoch is '17/298/43200'; expected year"),
        (edit("17:298:43200 m ", "17:298:43200 mm"), r"line 9: STAX of station 'S000' has unit 'mm'; expected 'm'"),
        (edit("     2 STAY", "     3 STAY"), r"line 10: index is '3'; expected 2, in columns 2-6"),
        (edit("L COVA", "L NORM"), r"line 16: the matrix is of kind 'NORM'; expected one of COVA, CORR, INFO"),
        (edit("L COVA", "X COVA"), r"line 16: the triangle of the matrix is 'X'; expected L or U"),
        (edit("     2     1", "     2      "), r"line 18: .*"),
        (edit("     2     1", "     7     1"), r"line 18: row and column are 7 and 1, with 2 elements; expected 1 to 6: a parameter each"),
        (edit("     2     1", "     1     1"), r"line 18: elements 1, 1 to 2 are outside of the triangle L"),
        (edit("     3     1", "     2     1"), r"line 19: elements 2, 1 to 3 are outside|line 19: elements 2, 1 to 2 come twice"),
        (edit("     1     1", "*    1     1"), r"line 16: element 1, 1 of SOLUTION/MATRIX_ESTIMATE is missing; expected the diag"),
        (doubled, r"line 16: SOLUTION/MATRIX_ESTIMATE is not positive definite; expected the covariance of 6 parameters"),
        (edit("E-0", "E-X"), r"line \d+: .* is '.*E-X.*'; expected a finite number"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_in_one_line(tmp_path: Path, change: Callable[[list[str]], list[str]], message: str) -> None:
    lines = change(sinex_lines(station_parameters(2), places(2).ravel(), np.linalg.inv(information(6, 1))))
    with pytest.raises(InputError, match=message) as raised:
        import_lines(tmp_path, lines)
    said = str(raised.value)
    assert said.startswith(str(tmp_path / "solution.snx")) and "\n" not in said
    assert not (tmp_path / "control.parquet").exists()


def test_the_sigmas_of_the_estimates_must_be_those_of_the_matrix(tmp_path: Path) -> None:
    lines = sinex_lines(station_parameters(2), places(2).ravel(), np.linalg.inv(information(6, 1)))
    lines[10] = lines[10][:69] + f"{0.5:11.5E}"
    with pytest.raises(
        InputError, match=r"line 11: STAZ of 'S000' has a standard deviation of 0.5, in the matrix 0\.0.*: the matrix is not that"
    ):
        import_lines(tmp_path, lines)


def test_no_file_and_places_that_are_taken(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.snx: no such file; expected a SINEX file$"):
        import_solution(tmp_path / "none.snx", tmp_path / "control.parquet")
    lines = sinex_lines(station_parameters(2), places(2).ravel(), np.linalg.inv(information(6, 1)))
    import_lines(tmp_path, lines)
    with pytest.raises(InputError, match=r"control\.parquet: already exists; choose another place, or remove it first$"):
        import_lines(tmp_path, lines)
    with pytest.raises(InputError, match=r"unknown suffix '\.csv'; expected \.parquet$"):
        import_solution(tmp_path / "solution.snx", tmp_path / "control.csv")


def test_the_matrix_of_a_constraint_needs_its_values(tmp_path: Path) -> None:
    lines = free_network(2)
    first = lines.index("+SOLUTION/APRIORI")
    last = lines.index("-SOLUTION/APRIORI")
    with pytest.raises(InputError, match=r"line \d+: SOLUTION/MATRIX_APRIORI without a block SOLUTION/APRIORI; expected the values too$"):
        read_sinex(write_sinex(tmp_path / "a.snx", lines[:first] + lines[last + 1 :]))
    lines[first + 1] = lines[first + 1].replace("S000", "S777")
    with pytest.raises(InputError, match=r"line \d+: a priori STAX S777 A 1 .* is unknown; expected an estimated parameter$"):
        read_sinex(write_sinex(tmp_path / "b.snx", lines))
