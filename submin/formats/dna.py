"""DNA 3 measurement files (``.msr``, perhaps gzipped): GNSS baselines (G), clusters of baselines (X) and of positions (Y).

Fixed columns, counted from 1: type 1, ``*`` in 2 for a measurement to be left out, stations in 3-22 and 23-42 (of a Y cluster the kind of
coordinates), number of a cluster's entries in 43-62, scales in 63-72 (of the whole covariance) and 73-102 (by direction), frame in 103-122,
epoch in 123-142. Then come for each entry its x, y, z in 63-82, each with its row of the lower triangle of the covariance in fields of 20
from 83 on, and three such rows for each later entry of the cluster: the covariance of this entry's x, y, z (rows) with the later one's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.formats.gnss import (
    TYPES,
    Entry,
    GnssFile,
    Measurement,
    MeasurementType,
    checked_scales,
    finite,
    iso_day,
    joined,
    read_text,
    symmetric,
)

Array = NDArray[np.float64]

_HEADER = "!#=DNA"
_FIELDS = ((82, 102), (102, 122), (122, 142))
_AXES = ("x", "y", "z")


def read_dna(path: str | Path) -> GnssFile:
    """The measurements of a DNA file.

    Raises
    ------
    InputError
        Naming the file and the line: what is wrong or not read.
    """
    reader = _Reader(read_text(path, "a DNA measurement file").splitlines())
    try:
        return reader.file()
    except InputError as error:
        raise InputError(f"{path}: line {reader.at}: {error}") from None


class _Reader:
    """Goes through the lines of a file once; ``at`` is the number of the line that was read last."""

    def __init__(self, lines: Sequence[str]) -> None:
        self.lines = lines
        self.at = 1
        self.data_lines = 0

    def file(self) -> GnssFile:
        header = self.lines[0] if self.lines else ""
        if not header.startswith(_HEADER) or header[6:12].strip()[:1] != "3":
            raise InputError(f"begins with {header[:30]!r}; expected a DNA file of version 3 ('{_HEADER} 3.01 MSR')")
        if header[12:19].strip() != "MSR":
            raise InputError(f"is a DNA file of {header[12:19].strip()!r}; expected one of measurements ('MSR')")
        frame, epoch, stated = header[29:43].strip(), iso_day(header[43:57].strip(), "epoch"), header[57:].strip()
        found = list(self._measurements())
        if not found:
            raise InputError("the file ends without any measurement; expected some of type G, X or Y")
        used = tuple(measurement for measurement in found if measurement is not None)
        return GnssFile(frame, epoch, used, len(found) - len(used), int(stated) if stated.isdigit() else 0, self.data_lines)

    def _measurements(self) -> Iterator[Measurement | None]:
        number = 0
        while (line := self._next()) is not None:
            yield self._measurement(line, number)
            number += 1

    def _next(self) -> str | None:
        """The next line that is neither empty nor a comment; None at the end."""
        while self.at < len(self.lines):
            line = self.lines[self.at]
            self.at += 1
            if line.strip() and not line.startswith("*"):
                return line.rstrip()
        return None

    def _measurement(self, line: str, number: int) -> Measurement | None:
        first = self.at
        kind = _type(line)
        ignored = _ignored(line)
        frame, epoch = line[102:122].strip(), iso_day(line[122:142].strip(), "epoch")
        if kind == "Y" and line[22:42].strip() != "XYZ":
            raise InputError(f"coordinates of the positions are {line[22:42].strip()!r}; expected XYZ: others are not read")
        count = 1 if kind == "G" else _count(line[42:62].strip())
        scale = checked_scales(*_scales(line))
        entries: list[Entry] = []
        for i in range(count):
            if i:
                line = self._entry_line(kind, i, count, first)
            entries.append(self._entry(line, kind, count - 1 - i, first))
        if ignored:
            return None
        return Measurement(number, first, kind, frame, epoch, *joined(entries, scale))

    def _entry_line(self, kind: str, i: int, count: int, first: int) -> str:
        line = self._next()
        if line is None or line[0] != kind or (kind == "X") != bool(line[22:42].strip()) or line[42:].strip():
            found = "the file ends" if line is None else f"found {line.strip()[:40]!r}"
            raise InputError(f"{found}; expected entry {i + 1} of {count} of the {kind} cluster that begins in line {first}")
        return line

    def _entry(self, line: str, kind: str, later: int, first: int) -> Entry:
        start, end = line[2:22].strip(), "" if kind == "Y" else line[22:42].strip()
        named = (("first", start, "3-22"), ("second", end, "23-42"))
        for name, station, columns in named[:1] if kind == "Y" else named:
            if not station:
                raise InputError(f"the {name} station is missing; expected its name in columns {columns}")
        if start == end:
            raise InputError(f"a baseline goes from {start!r} to itself; expected two stations")
        value, lower = np.zeros(3), list[float]()
        for k, axis in enumerate(_AXES):
            row = self._numbers(first, f"{axis} of {start}")
            value[k] = finite(row[62:82].strip(), f"{axis} of {start}")
            lower += self._row(row, k + 1)
        covariances = np.array([self._row(self._numbers(first, f"a covariance of {start}"), 3, 62) for _ in range(3 * later)])
        return Entry(start, end, value, symmetric(lower), covariances.reshape(later, 3, 3))

    def _numbers(self, first: int, what: str) -> str:
        """The next line, which must be one of numbers."""
        line = self._next()
        if line is None:
            raise InputError(f"the file ends; expected {what}, of the measurement that begins in line {first}")
        if line[:62].strip():
            raise InputError(f"found {line.strip()[:40]!r}; expected {what}, of the measurement that begins in line {first}")
        self.data_lines += 1
        return line

    def _row(self, line: str, count: int, blank_from: int = 82) -> list[float]:
        """A row of a covariance: as many fields of 20 columns, and nothing else after ``blank_from``."""
        fields = [line[a:b].strip() for a, b in _FIELDS]
        found = [field for field in (line[blank_from:82].strip(), *fields, line[142:].strip()) if field]
        if len(found) != count or not all(fields[:count]):
            raise InputError(f"has {len(found)} numbers of a covariance; expected {count}, in fields of 20 columns from column 83 on")
        return [finite(field, "a covariance") for field in fields[:count]]


def _type(line: str) -> MeasurementType:
    for kind in TYPES:
        if line[0] == kind:
            return kind
    raise InputError(f"begins with {line[0]!r}; expected a measurement of type G, X or Y: others are not read; take them out of the file")


def _ignored(line: str) -> bool:
    if line[1:2].strip() not in ("", "*"):
        raise InputError(f"column 2 holds {line[1]!r}; expected '*' for a measurement to be left out, or a blank")
    return line[1:2] == "*"


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise InputError(f"number of entries of the cluster is {text!r}; expected 1 or more in columns 43-62")
    return int(text)


def _scales(line: str) -> tuple[float, list[float]]:
    """Scale of the covariance, and those by direction; an empty one is 1."""
    fields = [line[a : a + 10].strip() for a in range(62, 102, 10)]
    v, *others = (finite(field, "a scale") if field else 1.0 for field in fields)
    return v, others


__all__ = ["read_dna"]
