"""Measured positions and baselines of a GNSS file, whatever its format, and its text."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

MeasurementType = Literal["G", "X", "Y"]
TYPES: tuple[MeasurementType, ...] = ("G", "X", "Y")
"""A baseline, a cluster of baselines, a cluster of positions."""
_DAY = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})")


@dataclass(frozen=True, eq=False)
class Measurement:
    """One measurement of a file: a baseline, or a cluster of baselines or of positions.

    Attributes
    ----------
    number : of the measurement in its file, from 0
    line : where it begins, from 1
    type : ``G``, ``X`` or ``Y``
    frame, epoch : of its values as the file states them; the epoch as ISO 8601 date
    from_ids, to_ids : (k,) stations; ``to_ids`` are empty for positions
    values : (k, 3) metres, geocentric axes
    covariance : (3k, 3k) m2, its scale applied
    """

    number: int
    line: int
    type: MeasurementType
    frame: str
    epoch: str
    from_ids: Ids
    to_ids: Ids
    values: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class GnssFile:
    """The measurements of a file.

    Attributes
    ----------
    frame, epoch : of the project, as the header states them; the epoch as ISO 8601 date
    measurements : those that are not ignored, in the order of the file
    ignored : how many the file flags to be left out
    stated : number of measurements that the header states, 0 for none
    lines : number of lines of numbers, which some programs state instead
    """

    frame: str
    epoch: str
    measurements: tuple[Measurement, ...]
    ignored: int
    stated: int = 0
    lines: int = 0


@dataclass(frozen=True, eq=False)
class Entry:
    """A position or baseline of a cluster, as files have it: its own covariance, and those with all later entries of the cluster.

    Attributes
    ----------
    start, end : stations; ``end`` is empty for a position
    value : (3,) metres
    own : (3, 3) m2, symmetric
    later : (l, 3, 3) m2: rows are the components of this entry, columns those of the later one
    """

    start: str
    end: str
    value: Array
    own: Array
    later: Array


def joined(entries: Sequence[Entry], scale: float) -> tuple[Ids, Ids, Array, Array]:
    """Starts (k,), ends (k,), values (k, 3) and covariance (3k, 3k), times ``scale``, of the entries of a cluster."""
    k = len(entries)
    blocks = np.zeros((k, k, 3, 3))
    for i, entry in enumerate(entries):
        blocks[i, i] = entry.own
        blocks[i, i + 1 :] = entry.later
        blocks[i + 1 :, i] = entry.later.transpose(0, 2, 1)
    return (
        np.array([entry.start for entry in entries]),
        np.array([entry.end for entry in entries]),
        np.stack([entry.value for entry in entries]),
        scale * blocks.transpose(0, 2, 1, 3).reshape(3 * k, 3 * k),
    )


def symmetric(lower: Sequence[float]) -> Array:
    """The matrix (3, 3) of ``xx, yx, yy, zx, zy, zz``."""
    matrix = np.zeros((3, 3))
    rows, columns = np.tril_indices(3)
    matrix[rows, columns] = matrix[columns, rows] = lower
    return matrix


def checked_scales(v: float, others: Sequence[float]) -> float:
    """The scale of a covariance; those by direction (latitude, longitude, height) must be 1.

    Raises
    ------
    InputError
        When a scale is another.
    """
    if not (np.isfinite(v) and v > 0.0):
        raise InputError(f"v-scale is {v:g}; expected a positive number")
    for name, scale in zip("plh", others, strict=True):
        if scale != 1.0:
            raise InputError(
                f"{name}-scale is {scale:g}; expected 1: scales by direction (latitude, longitude, height) are not read; "
                "apply them to the covariance first"
            )
    return v


def iso_day(text: str, what: str) -> str:
    """An epoch like ``01.01.2020`` as ISO 8601 date; an empty one stays empty.

    Examples
    --------
    >>> iso_day("18.02.2015", "epoch")
    '2015-02-18'
    """
    if not text:
        return ""
    found = _DAY.fullmatch(text)
    try:
        if not found:
            raise ValueError
        return date(int(found[3]), int(found[2]), int(found[1])).isoformat()
    except ValueError:
        raise InputError(f"{what} is {text!r}; expected a day as in 01.01.2020") from None


def finite(text: str, what: str) -> float:
    """A finite number; ``D`` may begin its exponent."""
    try:
        value = float(text.replace("D", "E").replace("d", "e"))
    except ValueError:
        value = float("nan")
    if not np.isfinite(value) or "_" in text:
        raise InputError(f"{what} is {text!r}; expected a finite number")
    return value


def read_text(path: str | Path, what: str) -> str:
    """The text of a file, perhaps gzipped, that holds ``what``.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    file = Path(path)
    try:
        content = file.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
        return content.decode("utf-8", errors="replace")  # names of stations are ASCII; comments may be in any encoding
    except FileNotFoundError:
        raise InputError(f"{file}: no such file; expected {what}") from None
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{file}: cannot be read ({error}); copy it again") from None


__all__ = [
    "TYPES",
    "Entry", "GnssFile", "Measurement", "MeasurementType", "checked_scales", "finite", "iso_day", "joined", "read_text", "symmetric",
]  # fmt: skip
