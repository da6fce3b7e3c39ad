"""Control points with a compact joint covariance, as a Parquet file that another program can expand (docs/correlation.md).

One row a point: ``point_id``, ``x, y, z`` (geocentric, m), ``longitude, latitude, height``, the point's own covariance ``cov_xx`` ...
``cov_zz`` (geocentric axes, m2), ``ce90, le90`` (m), ``tile``, ``rays``, and ``low_rank``: the point's three rows of V, 3 r values,
row-major. What belongs to all points is in the metadata of the schema, as text or JSON: `TEXTS`, `LAYOUT` and what `_described` adds.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from submin.correlation.compact import CompactCovariance
from submin.correlation.families import Correlation, family_named
from submin.errors import InputError
from submin.formats.replacing import replacing
from submin.query.control_set import ControlSet
from submin.storage.point_table import RULE_0

Array = NDArray[np.float64]

LAYOUT = "submin compact covariance 1"
MEANING = (
    "P <= factor * P_hat + V V'. P_hat_ii = P_ii (cov_xx ... cov_zz); P_hat_ij = S_i E' diag(rho_1, rho_2, rho_3)(d_ij) E S_j with S_i the "
    "symmetric square root of P_ii, E = axes, d_ij the distance of x, y, z, rho_c of functions; V: low_rank. Without V: P <= kappa * P_hat."
)
POSITION = ("x", "y", "z")
OWN = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_ROW, _COLUMN = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
_NUMBERS = (*POSITION, *OWN)


@dataclass(frozen=True, eq=False)
class CompactControl:
    """Control points of a compact file.

    Attributes
    ----------
    ids : (n,)
    covariance : what their joint covariance was condensed to; positions are in it
    metadata : texts of the file: policy, version, frame, epoch, scope, tiles, blocks, ...
    """

    ids: NDArray[np.str_]
    covariance: CompactCovariance
    metadata: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.ids)


def check_suffix(path: str | Path) -> None:
    """Refuse a file of another format.

    Raises
    ------
    InputError
        When the suffix is not ``.parquet``.
    """
    if Path(path).suffix.lower() != ".parquet":
        raise InputError(f"{path}: unknown suffix {Path(path).suffix!r}; expected .parquet")


def write_compact(path: str | Path, control: ControlSet, compact: CompactCovariance) -> CompactControl:
    """Write control points with what their joint covariance was condensed to; `read_compact` gives the same numbers to the last bit.

    Raises
    ------
    InputError
        When the suffix is not ``.parquet``, or the file cannot be written.
    """
    check_suffix(path)
    table = control.table()
    rows = compact.vectors.reshape(len(control), -1)
    columns: dict[str, Any] = {
        "point_id": pa.array(control.ids, pa.string()),
        **{name: table.columns[name] for name in (*POSITION, "longitude", "latitude", "height")},
        **{name: compact.blocks[:, i, j] for name, i, j in zip(OWN, _ROW, _COLUMN, strict=True)},
        "ce90": control.ce90,
        "le90": control.le90,
        "tile": pa.array(control.tile_of_point, pa.string()),
        "rays": pa.array(control.rays, pa.int64()),
        "low_rank": pa.array(list(rows), pa.list_(pa.float64())),
    }
    metadata = {key: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False) for key, value in table.metadata.items()}
    metadata |= _described(compact)
    with replacing(path) as temporary:
        pq.write_table(pa.table(columns).replace_schema_metadata(metadata), temporary, use_dictionary=["tile"], compression="zstd")
    return CompactControl(control.ids, compact, metadata)


def read_compact(path: str | Path) -> CompactControl:
    """Read a file of `write_compact`; `submin.correlation.expand` makes its joint covariance.

    Raises
    ------
    InputError
        When the file is not Parquet of this layout, a value is missing or not finite, or a function is not positive definite in space.
    """
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: cannot be read as Parquet ({error}); expected a file of 'submin export'") from None
    metadata = {key.decode(): value.decode(errors="replace") for key, value in (table.schema.metadata or {}).items()}
    if metadata.get("layout") != LAYOUT:
        raise InputError(f"{path}: layout is {metadata.get('layout')!r}; expected {LAYOUT!r}, as 'submin export' writes it")
    missing = [name for name in ("point_id", *_NUMBERS, "low_rank") if name not in table.column_names]
    if missing:
        raise InputError(f"{path}: column {missing[0]!r} is missing; expected the columns of 'submin export'")
    n = table.num_rows
    number = {name: _finite(table[name].to_numpy(), name, path) for name in _NUMBERS}
    blocks = np.empty((n, 3, 3))
    for name, i, j in zip(OWN, _ROW, _COLUMN, strict=True):
        blocks[:, i, j] = blocks[:, j, i] = number[name]
    try:
        axes = np.array(json.loads(metadata["axes"]), dtype=np.float64).reshape(3, 3)
        functions = tuple(
            Correlation(family_named(metadata["family"]), tuple(map(float, values.values())))
            for values in json.loads(metadata["functions"])
        )
        factor, kappa, rank = float(metadata["factor"]), float(metadata["kappa"]), int(metadata["rank"])
        if len(functions) != 3:
            raise ValueError(f"{len(functions)} functions; expected 3")
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: its metadata is damaged ({error}); expected that of 'submin export'") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    values = table["low_rank"].combine_chunks()
    lengths = values.value_lengths().fill_null(-1).to_numpy(zero_copy_only=False)
    if (lengths != 3 * rank).any():
        row = int(np.argmax(lengths != 3 * rank))
        raise InputError(f"{path}: row {row + 1}: low_rank has {lengths[row]} values; expected {3 * rank}, 3 for each of {rank} vectors")
    vectors = _finite(values.flatten().to_numpy(zero_copy_only=False), "low_rank", path).reshape(3 * n, rank)
    compact = CompactCovariance(np.stack([number[name] for name in POSITION], axis=1), blocks, axes, functions, factor, kappa, vectors)
    return CompactControl(np.array(table["point_id"].to_pylist(), dtype=np.str_), compact, metadata)


def _described(compact: CompactCovariance) -> dict[str, str]:
    """Metadata that says what the columns mean together, and what may be done with them."""
    return {
        "use": RULE_0,
        "layout": LAYOUT,
        "meaning": MEANING,
        "family": compact.family.name,
        "formula": compact.family.formula,
        "functions": json.dumps([function.parameters for function in compact.functions]),
        "axes": json.dumps(compact.axes.tolist()),
        "factor": repr(compact.factor),
        "kappa": repr(compact.kappa),
        "rank": str(compact.rank),
    }


def _finite(values: NDArray[Any], name: str, path: str | Path) -> Array:
    numbers = np.asarray(values, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: column {name!r} holds a value that is null or not finite; expected a number")
    return numbers


__all__ = ["LAYOUT", "CompactControl", "check_suffix", "read_compact", "write_compact"]
