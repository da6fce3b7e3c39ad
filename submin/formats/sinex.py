"""SINEX files, versions 0 to 2: estimated parameters, their a priori values, and the matrices of both, by the columns of the format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.formats.gnss import finite, read_text

Array = NDArray[np.float64]

MatrixKind = Literal["COVA", "CORR", "INFO"]
KINDS: tuple[MatrixKind, ...] = ("COVA", "CORR", "INFO")
_ESTIMATE, _APRIORI = "SOLUTION/ESTIMATE", "SOLUTION/APRIORI"
_MATRIX_ESTIMATE, _MATRIX_APRIORI = "SOLUTION/MATRIX_ESTIMATE", "SOLUTION/MATRIX_APRIORI"
_VARIANCE_FACTOR = "VARIANCE FACTOR"


@dataclass(frozen=True)
class Parameter:
    """One line of an estimate or of a priori values.

    Attributes
    ----------
    line : in the file, from 1
    type : ``STAX``, ``VELX``, ``TROTOT``, ...
    site, point, solution : to which station it belongs, which of its points, and which of the solutions for it
    epoch : ISO 8601, to the second, or empty
    unit : ``m``, ...
    value, sigma : in that unit; ``sigma`` is 0 where the file gives none
    """

    line: int
    type: str
    site: str
    point: str
    solution: str
    epoch: str
    unit: str
    value: float
    sigma: float

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """What it is, without its numbers."""
        return self.type, self.site, self.point, self.solution, self.epoch


@dataclass(frozen=True, eq=False)
class Matrix:
    """A symmetric matrix of a file.

    Attributes
    ----------
    line : where its block begins
    kind : ``COVA`` covariance, ``CORR`` correlations with standard deviations on the diagonal, ``INFO`` inverse of the covariance
    values : (n, n), both triangles
    present : (n,) whether the file gives the diagonal element
    digits : relative error of its elements, from the digits printed
    """

    line: int
    kind: MatrixKind
    values: Array
    present: NDArray[np.bool_]
    digits: float


@dataclass(frozen=True, eq=False)
class SinexFile:
    """What is read of a SINEX file.

    Attributes
    ----------
    constraint : code of the header: 0 fixed or tight, 1 significant, 2 unconstrained; empty for none
    estimate, a_priori : parameters in the order of their index; the second may be empty
    matrix : of the estimate, (n, n)
    a_priori_matrix : (n, n) in the order of the estimate, or None
    a_priori_values : (n,) in the order of the estimate, NaN where the file gives none
    sites : station and point that SITE/ID lists, with their lines; None without that block
    variance_factor : as the statistics state it, or None
    """

    constraint: str
    estimate: tuple[Parameter, ...]
    a_priori: tuple[Parameter, ...]
    matrix: Matrix
    a_priori_matrix: Matrix | None
    a_priori_values: Array
    sites: frozenset[tuple[str, str]] | None
    variance_factor: float | None


@dataclass(frozen=True)
class _Block:
    """The lines of a block with their numbers; ``line`` is that of its title, ``titled`` what stands there after the name."""

    line: int
    titled: tuple[str, ...]
    lines: tuple[tuple[int, str], ...]


def read_sinex(path: str | Path) -> SinexFile:
    """Read a SINEX file, perhaps gzipped.

    Raises
    ------
    InputError
        Naming the file and the line: what is missing, wrong or not read.
    """
    try:
        return _file(read_text(path, "a SINEX file").splitlines())
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}") from None


def _file(lines: Sequence[str]) -> SinexFile:
    header = lines[0] if lines else ""
    if not header.startswith("%=SNX"):
        raise InputError(f"line 1: begins with {header[:20]!r}; expected '%=SNX'")
    version = header[6:10].strip()
    if version[:2] not in ("0.", "1.", "2."):
        raise InputError(f"line 1: SINEX version is {version!r}; expected 0.05 to 2.xx")
    blocks = _blocks(lines)
    for name in (_ESTIMATE, _MATRIX_ESTIMATE):
        if name not in blocks:
            raise InputError(f"has no block {name}; expected the estimated coordinates and their covariance")
    estimate = _parameters(blocks[_ESTIMATE])
    if not estimate:
        raise InputError(f"line {blocks[_ESTIMATE].line}: block {_ESTIMATE} is empty; expected the estimated parameters")
    matrix = _matrix(blocks[_MATRIX_ESTIMATE], len(estimate))
    if not matrix.present.all():
        k = int(np.argmin(matrix.present))
        raise InputError(
            f"line {matrix.line}: element {k + 1}, {k + 1} of {_MATRIX_ESTIMATE} is missing; "
            f"expected the diagonal of all {len(estimate)} parameters"
        )
    a_priori = _parameters(blocks[_APRIORI]) if _APRIORI in blocks else ()
    values, a_priori_matrix = np.full(len(estimate), np.nan), None
    places = _places(estimate, a_priori)
    values[places] = [parameter.value for parameter in a_priori]
    if _MATRIX_APRIORI in blocks:
        if not a_priori:
            raise InputError(f"line {blocks[_MATRIX_APRIORI].line}: {_MATRIX_APRIORI} without a block {_APRIORI}; expected the values too")
        a_priori_matrix = _ordered(_matrix(blocks[_MATRIX_APRIORI], len(a_priori)), places, len(estimate))
    return SinexFile(
        header[66:67].strip(), estimate, a_priori, matrix, a_priori_matrix, values, _sites(blocks), _variance_factor(blocks),
    )  # fmt: skip


def _blocks(lines: Sequence[str]) -> dict[str, _Block]:
    """Blocks by name; comments and empty lines are left out."""
    blocks: dict[str, _Block] = {}
    name, begun, titled, content = "", 0, tuple[str, ...](), list[tuple[int, str]]()
    for number, line in enumerate(lines, start=1):
        first = line[:1]
        if first in ("", "*") or not line.strip():
            continue
        if first == "%" and number > 1:
            if name:
                raise InputError(f"line {number}: the file ends inside of block {name}, which begins in line {begun}; copy it again")
            return blocks
        if first == "+":
            if name:
                raise InputError(
                    f"line {number}: block {line[1:].strip()} begins inside of block {name} (line {begun}); expected '-{name}'"
                )
            name, *rest = line[1:].split() or [""]
            begun, titled, content = number, tuple(rest), []
            if name in blocks:
                raise InputError(
                    f"line {number}: block {name} comes twice, first in line {blocks[name].line}; expected one solution a file"
                )
        elif first == "-":
            if not name or line[1:].split()[:1] != [name]:
                raise InputError(f"line {number}: ends block {line[1:].strip()!r}; expected {f'-{name}' if name else 'a block to begin'!r}")
            blocks[name], name = _Block(begun, titled, tuple(content)), ""
        elif name:
            content.append((number, line))
    where = f"inside of block {name}, which begins in line {begun}" if name else "without '%ENDSNX'"
    raise InputError(f"line {len(lines)}: the file ends {where}: it was cut short; copy it again")


def _parameters(block: _Block) -> tuple[Parameter, ...]:
    found: list[Parameter] = []
    for number, line in block.lines:
        try:
            if line[1:6].strip() != str(len(found) + 1):
                raise InputError(f"index is {line[1:6].strip()!r}; expected {len(found) + 1}, in columns 2-6")
            sigma = line[69:80].strip()
            found.append(
                Parameter(
                    number, line[7:13].strip(), line[14:18].strip(), line[19:21].strip(), line[22:26].strip(), _epoch(line[27:39].strip()),
                    line[40:44].strip(), finite(line[47:68].strip(), "value"), finite(sigma, "standard deviation") if sigma else 0.0,
                )
            )  # fmt: skip
        except InputError as error:
            raise InputError(f"line {number}: {error}") from None
    return tuple(found)


def _epoch(text: str) -> str:
    """ISO 8601 of ``yy:ddd:sssss``; one of zeros is none.

    Examples
    --------
    >>> _epoch("17:298:43200")
    '2017-10-25T12:00:00'
    """
    parts = text.split(":")
    if len(parts) != 3 or not all(part.isdigit() for part in parts):
        raise InputError(f"epoch is {text!r}; expected year, day of the year and second as in 17:298:43200")
    year, day, second = map(int, parts)
    if (year, day, second) == (0, 0, 0):
        return ""
    full = year if len(parts[0]) == 4 else year + (1900 if year > 50 else 2000)
    return (datetime(full, 1, 1) + timedelta(days=day - 1, seconds=second)).isoformat()


def _matrix(block: _Block, n: int) -> Matrix:
    """A matrix of its triangle; elements that are not given are zero."""
    triangle, kind = (*block.titled, "", "")[:2]
    for known in KINDS:
        if kind == known:
            break
    else:
        raise InputError(f"line {block.line}: the matrix is of kind {kind!r}; expected one of {', '.join(KINDS)}")
    if triangle not in ("L", "U"):
        raise InputError(f"line {block.line}: the triangle of the matrix is {triangle!r}; expected L or U")
    values, given = np.zeros((n, n)), np.zeros((n, n), dtype=bool)
    digits = 0
    for number, line in block.lines:
        try:
            row, columns, elements, printed = _elements(line, n)
            inside = columns <= row if triangle == "L" else columns >= row
            if any(element != 0.0 for element, there in zip(elements, inside, strict=True) if not there):  # zeros only fill the line
                raise InputError(f"elements {row + 1}, {columns[0] + 1} to {columns[-1] + 1} are outside of the triangle {triangle}")
            elements, columns = [element for element, there in zip(elements, inside, strict=True) if there], columns[inside]
            if given[row, columns].any():
                raise InputError(f"elements {row + 1}, {columns[0] + 1} to {columns[-1] + 1} come twice; expected them once")
        except InputError as error:
            raise InputError(f"line {number}: {error}") from None
        values[row, columns], given[row, columns] = elements, True
        digits = max(digits, printed)
    full = values + values.T - np.diag(np.diagonal(values))
    return Matrix(block.line, known, full, np.diagonal(given).copy(), 5.0 * 10.0**-digits if digits else 0.0)


def _elements(line: str, n: int) -> tuple[int, NDArray[np.int64], list[float], int]:
    """Row, columns, elements of a line of a matrix, and how many digits they have."""
    row_text, column_text, *texts = (*line.split(), "", "")[: max(len(line.split()), 2)]
    if not (row_text.isdigit() and column_text.isdigit() and 1 <= len(texts) <= 3):
        raise InputError(f"has {len(line.split())} fields; expected a row, a column, and one to three elements of the matrix")
    row, first = int(row_text) - 1, int(column_text) - 1
    columns = np.arange(first, first + len(texts))
    if not (0 <= row < n and first >= 0 and columns[-1] < n):
        raise InputError(f"row and column are {row + 1} and {first + 1}, with {len(texts)} elements; expected 1 to {n}: a parameter each")
    mantissa = texts[0].upper().replace("D", "E").partition("E")[0].strip("+-").replace(".", "").lstrip("0")
    return row, columns, [finite(text, "an element of the matrix") for text in texts], len(mantissa)


def _places(estimate: Sequence[Parameter], a_priori: Sequence[Parameter]) -> NDArray[np.int64]:
    """Index of each a priori parameter among the estimated ones."""
    index: dict[tuple[str, ...], int] = {}
    for i, parameter in enumerate(estimate):
        if index.setdefault(parameter.key, i) != i:
            raise InputError(f"line {parameter.line}: {' '.join(parameter.key)} is estimated twice; expected it once")
    for parameter in a_priori:
        if parameter.key not in index:
            raise InputError(f"line {parameter.line}: a priori {' '.join(parameter.key)} is unknown; expected an estimated parameter")
    return np.array([index[parameter.key] for parameter in a_priori], dtype=np.int64)


def _ordered(matrix: Matrix, places: NDArray[np.int64], n: int) -> Matrix:
    """A matrix of the a priori parameters in the order of the estimate."""
    values, present = np.zeros((n, n)), np.zeros(n, dtype=bool)
    values[np.ix_(places, places)] = matrix.values
    present[places] = matrix.present
    return Matrix(matrix.line, matrix.kind, values, present, matrix.digits)


def _sites(blocks: Mapping[str, _Block]) -> frozenset[tuple[str, str]] | None:
    if "SITE/ID" not in blocks:
        return None
    return frozenset((line[1:5].strip(), line[6:8].strip()) for _, line in blocks["SITE/ID"].lines)


def _variance_factor(blocks: Mapping[str, _Block]) -> float | None:
    for number, line in blocks["SOLUTION/STATISTICS"].lines if "SOLUTION/STATISTICS" in blocks else ():
        if line[1:31].strip() == _VARIANCE_FACTOR:
            try:
                return finite(line[32:54].strip(), "variance factor")
            except InputError as error:
                raise InputError(f"line {number}: {error}") from None
    return None


__all__ = ["KINDS", "Matrix", "MatrixKind", "Parameter", "SinexFile", "read_sinex"]
