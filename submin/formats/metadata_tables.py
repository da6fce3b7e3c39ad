"""Tables that describe points, without covariance: Parquet, CSV or GeoJSON. What is not known is null, or empty in CSV."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from submin.errors import QueryError
from submin.formats.replacing import replacing
from submin.formats.tables import arrow_table, write_features

SUFFIXES = (".parquet", ".csv", ".geojson")


def check_suffix(path: Path) -> None:
    """Raise `QueryError` for a path whose suffix names none of the formats."""
    if path.suffix.lower() not in SUFFIXES:
        raise QueryError(f"{path}: unknown suffix {path.suffix!r}; expected one of {', '.join(SUFFIXES)}")


def write_columns(path: Path, columns: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> None:
    """Write columns (n,), among them longitude, latitude (degrees) and height (metres), in the format that the suffix names.

    ``metadata`` goes into the schema of Parquet and into a member of GeoJSON; CSV has no place for it.

    Raises
    ------
    QueryError
        When the suffix is another.
    InputError
        When the folder does not exist or cannot be written.
    """
    check_suffix(path)
    texts = {name: pa.string() for name, values in columns.items() if np.issubdtype(values.dtype, np.str_)}
    table = arrow_table(columns, texts)
    if path.suffix.lower() == ".geojson":
        write_features(path, table, metadata)
        return
    with replacing(path) as temporary:
        if path.suffix.lower() == ".csv":
            pa_csv.write_csv(table, str(temporary))
        else:
            pq.write_table(table.replace_schema_metadata(dict(metadata)), temporary, compression="zstd")
