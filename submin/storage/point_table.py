"""Tables of ground points from outside: control, check points, simulated truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from submin.errors import CatalogueError, InputError
from submin.formats.columns import Column, column_names, number, number_values, read_table, refuse, text, text_values
from submin.formats.replacing import replacing
from submin.formats.tables import covariance_of_rows, covariance_rows
from submin.geodesy import local_axes, rotate_covariance
from submin.storage.catalogue_schema import COVARIANCE_COLUMNS, SIGMA_COLUMNS, PointTable, first_repeated

Array = NDArray[np.float64]

POINT_COLUMNS = (
    text("point_id"), number("longitude"), number("latitude"), number("height"), text("area", False, blank=True),
    *(number(name, False) for name in (*COVARIANCE_COLUMNS, *SIGMA_COLUMNS)),
    Column("covariance_row", pa.list_(pa.float64()), False),
)  # fmt: skip

RULE_0 = "derived from an adjustment: use it, but never enter it into a network, neither as block nor as control"
"""Goes as ``use`` into the metadata of every file of points or cameras that an adjustment gave."""
DERIVED_COLUMNS = ("ce90", "le90", "tile", "rays")
"""What a network's answer and an adjustment say of their points, in every format; no survey counts rays or has tiles."""

Covariances = Literal["definite", "any", "none"]
"""What is asked of the points' covariances; see `read_point_table`."""


def read_point_table(path: str | Path, covariance: Covariances = "any") -> PointTable:
    """Ground points of a Parquet or CSV file: the layout of ``control``, ``check`` and ``truth`` in a catalogue.

    Parameters
    ----------
    path : file with ``point_id``, ``longitude``, ``latitude``, ``height``, perhaps ``area``, and covariances as ``cov_ee`` ... ``cov_uu``
        (m2) or as ``sigma_e``, ``sigma_n``, ``sigma_u`` (m), or as ``covariance_row`` (joint, geocentric axes, as query output has it)
    covariance : ``definite`` for points that control (surveyed ones; no direction is known without error), ``any``, or ``none`` when
        it may be absent: zeros

    Raises
    ------
    CatalogueError
        When a column is missing, an id comes twice, coordinates are out of range, or a covariance is none; for points that control
        also when they were derived from rays.
    """
    file = Path(path)
    if covariance == "definite":
        _refuse_derived(file)
    table = read_table(file, POINT_COLUMNS)
    point_ids, n = text_values(table, "point_id"), table.num_rows
    repeated = first_repeated(np.unique(point_ids, return_inverse=True)[1], np.zeros(n, dtype=np.int8))
    if repeated is not None:
        earlier, later = repeated
        raise CatalogueError(
            f"{file}: row {later + 1}: point_id {str(point_ids[later])!r} is that of row {earlier + 1} too; expected it once"
        )
    geodetic = np.stack([number_values(table, name) for name in ("longitude", "latitude", "height")], axis=1)
    limits = (("longitude", 360.0, "degrees from -360 to 360"), ("latitude", 90.0, "degrees from -90 to 90"), ("height", 1e9, "metres"))
    for k, (name, limit, expected) in enumerate(limits):
        refuse(pa.array(~(np.abs(geodetic[:, k]) <= limit)), table[name], name, file, 1, expected)
    enu, joint = _covariances(table, file, geodetic, covariance)
    return PointTable(point_ids, geodetic, enu, text_values(table, "area"), joint)


def point_columns(points: PointTable, covariance: bool = True) -> pa.Table:
    """The columns of a table of points, as `read_point_table` reads them; without ``covariance`` the coordinates only."""
    columns: dict[str, object] = {
        "point_id": pa.array(points.point_ids, pa.string()),
        **{name: points.geodetic[:, k] for k, name in enumerate(("longitude", "latitude", "height"))},
    }
    if covariance:
        columns["area"] = pa.array(points.area, pa.string())
        row, column = np.triu_indices(3)
        columns |= {name: points.covariance_enu[:, i, j] for name, i, j in zip(COVARIANCE_COLUMNS, row, column, strict=True)}
        if points.joint_covariance is not None:
            columns["covariance_row"] = covariance_rows(points.joint_covariance, 0, len(points))
    return pa.table(columns)


def write_point_table(path: str | Path, points: PointTable, metadata: Mapping[str, str]) -> None:
    """Write points as a Parquet file of their own, with texts that say where they come from; nothing that is there is written over.

    Raises
    ------
    InputError
        When the name does not end in ``.parquet``, something is there already, or it cannot be written.
    """
    file = Path(path)
    if file.suffix != ".parquet":
        raise InputError(f"{file}: unknown suffix {file.suffix!r}; expected .parquet")
    if file.exists():
        raise InputError(f"{file}: already exists; choose another place, or remove it first")
    with replacing(file) as temporary:
        pq.write_table(point_columns(points).replace_schema_metadata(dict(metadata)), temporary, compression="zstd")


def _refuse_derived(path: Path) -> None:
    """Refuse points that a network or an adjustment gave, before they are read: as control their rays count twice (Rule 0)."""
    expected = "expected surveyed points: what comes from rays, entered beside them, counts twice"
    derived = [name for name in column_names(path) if name.strip().lower() in DERIVED_COLUMNS]
    if _use(path) == RULE_0:
        raise CatalogueError(f"{path}: holds points that an adjustment gave; {expected}")
    if derived:
        columns = f"column{'s' * (len(derived) > 1)} {', '.join(derived)}"
        raise CatalogueError(f"{path}: has the {columns} of points that a network or an adjustment gave; {expected}")


def check_stated_frame(path: str | Path, frame: str, epoch: str) -> None:
    """Refuse points whose file states another frame or epoch than these; a file that states none is taken at its user's word.

    Of two epochs one may be the beginning of the other's ISO 8601 text: a day, and a time of that day.

    Raises
    ------
    CatalogueError
        When the metadata of a Parquet file state another frame or epoch.
    """
    for name, ours in (("frame", frame), ("epoch", epoch)):
        stated = _stated(Path(path), name)
        same = stated == ours or (name == "epoch" and (stated.startswith(ours) or ours.startswith(stated)))
        if stated and ours and not same:
            raise CatalogueError(
                f"{path}: {name} is {stated!r}, but the network's is {ours!r}; transform the points to the network's frame and epoch first"
            )


def _use(path: Path) -> str:
    """What a Parquet file says that its content may be used for."""
    return _stated(path, "use")


def _stated(path: Path, key: str) -> str:
    """A text of the metadata of a Parquet file; empty for other files and without it."""
    try:
        metadata = pq.read_schema(path).metadata if path.suffix == ".parquet" else None
    except (pa.ArrowException, OSError):
        return ""  # whoever reads it says what is wrong with it
    return bytes((metadata or {}).get(key.encode(), b"")).decode(errors="replace")


def _covariances(table: pa.Table, path: Path, geodetic: Array, kind: Covariances) -> tuple[Array, Array | None]:
    """Covariance of each point (n, 3, 3) in local axes, and the joint one where the table has it."""
    names, n = table.schema.names, table.num_rows
    joint = _joint_covariance(table, path) if "covariance_row" in names else None
    enu = np.zeros((n, 3, 3))
    if any(name in names for name in COVARIANCE_COLUMNS):
        for name, row, column in zip(COVARIANCE_COLUMNS, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2), strict=True):
            enu[:, row, column] = enu[:, column, row] = _finite(table, name, path)
    elif any(name in names for name in SIGMA_COLUMNS):
        for k, name in enumerate(SIGMA_COLUMNS):
            sigma = _finite(table, name, path)
            refuse(pa.array(sigma < 0.0), table[name], name, path, 1, "metres, not negative")
            enu[:, k, k] = sigma**2
    elif joint is not None:
        own = joint.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
        enu = rotate_covariance(own, local_axes(geodetic))
    elif kind != "none":
        raise CatalogueError(
            f"{path}: columns of the covariance are missing; expected {', '.join(COVARIANCE_COLUMNS)}, or {', '.join(SIGMA_COLUMNS)}"
        )
    else:
        return enu, None
    values = np.linalg.eigvalsh(enu)
    floor = 1e-12 * np.abs(values[:, -1])  # round-off of the eigenvalues themselves
    bad = values[:, 0] <= 0.0 if kind == "definite" else values[:, 0] < -floor
    if bad.any():  # as lists all of them would be much larger than they are
        first = int(np.argmax(bad))
        refuse(
            pa.array([True]), pa.array(enu[first].reshape(1, 9).tolist()), "covariance", path, 1 + first,
            "a positive definite matrix (m2)" if kind == "definite" else "a matrix without negative eigenvalues (m2)",
        )  # fmt: skip
    return enu, joint


def _finite(table: pa.Table, name: str, path: Path) -> Array:
    if name not in table.schema.names:
        raise CatalogueError(f"{path}: column {name!r} is missing; expected {', '.join(COVARIANCE_COLUMNS)}, or {', '.join(SIGMA_COLUMNS)}")
    values = number_values(table, name)
    refuse(pa.array(~np.isfinite(values)), table[name], name, path, 1, "a finite number")
    return values


def _joint_covariance(table: pa.Table, path: Path) -> Array:
    try:
        return covariance_of_rows(table["covariance_row"].chunks, table.num_rows, str(path))
    except InputError as error:
        raise CatalogueError(str(error)) from None


__all__ = ["POINT_COLUMNS", "Covariances", "PointTable", "point_columns", "read_point_table", "write_point_table"]
