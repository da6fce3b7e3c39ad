"""GNSS measurement files as catalogues of observations, and as tables of control: nothing is transformed, what differs is told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.linalg import lapack

from submin.errors import CatalogueError, InputError
from submin.formats.columns import column_names, integer, number, number_values, read_table, refuse, text
from submin.formats.dna import read_dna
from submin.formats.dynaml import read_dynaml
from submin.formats.gnss import GnssFile, Measurement
from submin.network.observations import Cluster
from submin.storage.catalogue_schema import CatalogueMetadata
from submin.storage.catalogue_writer import CatalogueWriter

Array = NDArray[np.float64]

AXES = ("X", "Y", "Z")
AGREES_M = 1e-4
"""Files of measurements and of values print metres with four decimals at least: a greater difference is another measurement."""
_VALUE_KEYS = (integer("cluster"), text("type"), text("from"), text("to", blank=True), text("component"))


@dataclass(frozen=True)
class GnssImport:
    """What an import of measurements has written.

    Attributes
    ----------
    catalogue : folder
    dataset : name of the catalogue, prefix of its ids
    frame, epoch : that the catalogue states
    clusters, positions, baselines, points : numbers of them
    ignored : measurements that the file flags to be left out
    notes : one line each
    """

    catalogue: Path
    dataset: str
    frame: str
    epoch: str
    clusters: int
    positions: int
    baselines: int
    points: int
    ignored: int
    notes: tuple[str, ...]


def import_gnss(
    file: str | Path,
    out: str | Path,
    *,
    values: str | Path | None = None,
    value_column: str | None = None,
    frame: str | None = None,
    epoch: str | None = None,
    dataset: str | None = None,
    shared_ids: bool = False,
    overwrite: bool = False,
) -> GnssImport:
    """Make a catalogue of observations of a file of GNSS measurements; every measurement of the file is a cluster.

    Parameters
    ----------
    file
        DNA (``.msr``) or DynaML (``.xml``), perhaps gzipped; see `submin.formats.dna`.
    out
        Folder of the catalogue.
    values
        CSV with ``cluster, type, from, to, component``, the values of the file and others that take their place (as another program
        transformed them to one frame and epoch). The covariances stay.
    value_column
        Column of ``values`` that is taken; the last one unless given.
    frame, epoch
        Of the coordinates, as the catalogue states them; by default those of the file's header. Nothing is transformed.
    dataset
        Name of the catalogue; else that of the folder of ``file``. Clusters are ``DATASET/number``, point ids ``DATASET/station``.
    shared_ids
        Leave the stations' names as point ids: the same name in another catalogue is the same ground point.
    overwrite
        Take the place of a catalogue in ``out``.

    Raises
    ------
    InputError
        When the file or the table of values cannot be used: file, line or row, value, what was expected. Nothing is written then.
    """
    path = Path(file)
    measured = read_gnss(path)
    name = dataset or path.resolve().parent.name
    stated_frame, stated_epoch = frame or measured.frame, measured.epoch if epoch is None else epoch
    if not stated_frame:
        raise InputError(f"{path}: line 1: states no frame; give it by --frame")
    writer = CatalogueWriter(out, CatalogueMetadata(name, frame=stated_frame, epoch=stated_epoch), overwrite)
    notes = _notes(path, measured)
    used = measured.measurements
    if values is None:
        refuse_other_positions(path, used, stated_frame, stated_epoch)
        notes += _frame_notes(used, stated_frame, stated_epoch)
    else:
        column, used = _with_values(path, measured, Path(values), value_column)
        notes.append(f"values are those of column {column!r} of {Path(values).name}; covariances are those of {path.name}")
    prefix = "" if shared_ids else f"{name}/"
    clusters = [_cluster(measurement, f"{name}/", prefix) for measurement in used]
    with writer:
        for cluster in clusters:
            writer.write_observations(cluster)
    positions = sum(int(cluster.positions.sum()) for cluster in clusters)
    return GnssImport(
        catalogue=Path(out),
        dataset=name,
        frame=stated_frame,
        epoch=stated_epoch,
        clusters=len(clusters),
        positions=positions,
        baselines=sum(map(len, clusters)) - positions,
        points=len(set().union(*(cluster.point_ids.tolist() for cluster in clusters))),
        ignored=measured.ignored,
        notes=tuple(notes),
    )


def read_gnss(path: Path) -> GnssFile:
    """A file of measurements, of the format that its name says, with covariances that are positive definite.

    Raises
    ------
    InputError
        When it cannot be used, naming its line; or when it flags all measurements to be left out.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    suffix = suffixes[-2] if suffixes[-1:] == [".gz"] and len(suffixes) > 1 else (suffixes or [""])[-1]
    reader = {".msr": read_dna, ".xml": read_dynaml}.get(suffix)
    if reader is None:
        raise InputError(f"{path}: unknown suffix {suffix!r}; expected .msr (DNA) or .xml (DynaML), perhaps with .gz")
    found = reader(path)
    if not found.measurements:
        raise InputError(f"{path}: all {found.ignored} measurements are flagged to be left out; expected some to use")
    for measurement in found.measurements:
        minor = lapack.dpotrf(measurement.covariance, lower=1)[1]
        if minor:
            raise InputError(
                f"{path}: line {measurement.line}: the covariance of the measurement that begins here is not positive definite "
                f"(at {'xyz'[(minor - 1) % 3]} of entry {(minor - 1) // 3 + 1}); expected that of observations with errors of their own"
            )
    return found


def refuse_other_positions(path: Path, measurements: Sequence[Measurement], frame: str, epoch: str) -> None:
    """Refuse positions of another frame or epoch than the catalogue's: they are decimetres or metres from where it would have them."""
    for m in measurements:
        if m.type == "Y" and ((m.frame and m.frame != frame) or (m.epoch and m.epoch != epoch)):
            raise InputError(
                f"{path}: line {m.line}: positions are of {_said(m.frame, m.epoch)}; expected {_said(frame, epoch)}: "
                "nothing is transformed. Transform them and give them by --values, or give their own by --frame and --epoch"
            )


def _cluster(measurement: Measurement, cluster_prefix: str, prefix: str) -> Cluster:
    to_ids = np.array([prefix + station if station else "" for station in measurement.to_ids.tolist()])
    from_ids = np.array([prefix + station for station in measurement.from_ids.tolist()])
    return Cluster(f"{cluster_prefix}{measurement.number}", from_ids, to_ids, measurement.values, measurement.covariance)


def _notes(path: Path, measured: GnssFile) -> list[str]:
    notes = [f"{measured.ignored} measurements of {path.name} are flagged to be left out"] if measured.ignored else []
    total = len(measured.measurements) + measured.ignored
    if measured.stated and measured.stated not in (total, measured.lines):
        notes.append(f"the header of {path.name} states {measured.stated} measurements; the file has {total}: it may have been cut short")
    return notes


def _frame_notes(measurements: Sequence[Measurement], frame: str, epoch: str) -> list[str]:
    """What baselines are measured in, where that is not what the catalogue states."""
    others = Counter((m.frame, m.epoch) for m in measurements if (m.frame, m.epoch) not in ((frame, epoch), ("", "")))
    if not others:
        return []
    frames = Counter(m.frame for m in measurements if m.frame and m.frame != frame)
    where = " and ".join(f"{name} ({count})" for name, count in sorted(frames.items())) or frame
    days = sorted({day for _, day in others if day})
    when = f", at {len(days)} epochs from {days[0]} to {days[-1]}" if len(days) > 1 else f", at {days[0]}" if days else ""
    return [
        f"{sum(others.values())} measurements of {len(measurements)} are baselines in {where}{when}: they are taken as of "
        f"{_said(frame, epoch)} as they are, nothing is transformed; values in one frame and epoch may be given by --values"
    ]


def _said(frame: str, epoch: str) -> str:
    return " at ".join(part for part in (frame or "no stated frame", epoch) if part)


def _with_values(path: Path, measured: GnssFile, table_path: Path, value_column: str | None) -> tuple[str, tuple[Measurement, ...]]:
    """The column that is taken, and the measurements with its values."""
    table, (given, column) = _read_values(table_path, value_column)
    known, new = number_values(table, given), number_values(table, column)
    by_number = {m.number: m for m in measured.measurements}
    replaced = {m.number: np.full_like(m.values, np.nan) for m in measured.measurements}
    last = len(by_number) + measured.ignored - 1
    for row, key in enumerate(zip(*(table[c.name].to_pylist() for c in _VALUE_KEYS), strict=True)):
        if key[0] not in by_number and key[0] in range(last + 1):
            continue  # a measurement that the file flags to be left out
        try:
            m = by_number.get(key[0])
            if m is None:
                raise InputError(f"cluster is {key[0]}; expected the number of a measurement of {path.name}, 0 to {last}")
            i, k = _place(m, *key[1:])
            if np.isfinite(replaced[m.number][i, k]):
                raise InputError(f"component {AXES[k]} of entry {i + 1} of cluster {m.number} is there twice; expected it once")
            if not abs(known[row] - m.values[i, k]) <= AGREES_M:
                raise InputError(f"{given} is {known[row]}; expected {m.values[i, k]}, as measured in {path.name} (line {m.line})")
        except InputError as error:
            raise CatalogueError(f"{table_path}: row {row + 1}: {error}") from None
        replaced[m.number][i, k] = new[row]
    for n, values in replaced.items():
        if np.isnan(values).any():
            i, k = np.argwhere(np.isnan(values))[0]
            raise CatalogueError(
                f"{table_path}: component {AXES[k]} of entry {i + 1} of cluster {n} is missing; "
                f"expected a value for every component that is measured in {path.name}"
            )
    return column, tuple(replace(m, values=replaced[m.number]) for m in measured.measurements)


def _place(m: Measurement, kind: str, start: str, end: str, axis: str) -> tuple[int, int]:
    """Entry and axis of a measurement that a row of values names."""
    if kind != m.type:
        raise InputError(f"type is {kind!r}; expected {m.type!r}, that of measurement {m.number} (line {m.line} of its file)")
    found = np.flatnonzero((m.from_ids == start) & (m.to_ids == end))
    if not len(found):
        raise InputError(f"from, to are {start!r}, {end!r}; expected stations of measurement {m.number} (line {m.line} of its file)")
    if axis not in AXES:
        raise InputError(f"component is {axis!r}; expected {', '.join(AXES)}")
    return int(found[0]), AXES.index(axis)


def _read_values(path: Path, value_column: str | None) -> tuple[pa.Table, tuple[str, str]]:
    """The table of values, and its columns of the file's values and of those to take."""
    keys = [c.name for c in _VALUE_KEYS]
    others = [name for name in column_names(path) if name not in keys]
    names = (others[0], others[-1] if value_column is None else value_column) if others else ("", "")
    if value_column is not None and value_column not in others:
        raise CatalogueError(f"{path}: no column {value_column!r} of values; expected one of {', '.join(others) or 'none'}")
    table = read_table(path, (*_VALUE_KEYS, *(number(name) for name in dict.fromkeys(filter(None, names)))))
    if len(others) < 2:
        raise CatalogueError(
            f"{path}: has {len(others)} columns of values; expected two or more: that of the file's values, by which rows are "
            "recognised, and those to take"
        )
    for name in names:
        refuse(pa.array(~np.isfinite(number_values(table, name))), table[name], name, path, 1, "a finite number of metres")
    return table, names


__all__ = ["GnssImport", "import_gnss", "read_gnss", "refuse_other_positions"]
