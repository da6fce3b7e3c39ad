"""Lists of point ids that users hand in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
from numpy.typing import NDArray

from submin.errors import InputError


def read_point_ids(path: Path) -> NDArray[np.str_]:
    """Ids of a file: column ``point_id`` of a CSV or Parquet table, or one id a line of any other text.

    Raises
    ------
    InputError
        When the file cannot be read, has no such column, or holds no id.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a list of points: a column point_id, or one id a line")
    try:
        if path.suffix == ".parquet":
            ids = pq.read_table(path, columns=["point_id"])["point_id"].cast(pa.string()).to_pylist()
        elif path.suffix == ".csv" or path.name.endswith(".csv.gz"):
            options = pa.csv.ConvertOptions(include_columns=["point_id"], column_types={"point_id": pa.string()})
            ids = pa.csv.read_csv(path, convert_options=options)["point_id"].to_pylist()
        else:
            ids = [line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError, KeyError, pa.ArrowException) as error:
        raise InputError(f"{path}: cannot be read as a list of points ({error}); expected a column point_id, or one id a line") from None
    if not ids or None in ids:
        raise InputError(f"{path}: holds no point id, or an empty one; expected a column point_id, or one id a line")
    return np.array(ids, dtype=np.str_)
