"""Control sets that were written to files, read again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from submin.errors import InputError
from submin.formats.tables import NUMBERS, TEXTS, read_npz, read_parquet
from submin.geodesy import Ellipsoid
from submin.query.control_set import ControlSet

_READERS = {".parquet": read_parquet, ".npz": read_npz}


def read_control(path: str | Path) -> ControlSet:
    """A control set as `ControlSet.to_parquet` or `ControlSet.to_npz` wrote it, joint covariance included.

    Raises
    ------
    InputError
        When the suffix is another, the file cannot be read, or something is missing that a query writes.
    """
    reader = _READERS.get(Path(path).suffix.lower())
    if reader is None:
        raise InputError(f"{path}: unknown suffix {Path(path).suffix!r}; expected a query with its joint covariance: {', '.join(_READERS)}")
    arrays = reader(path)
    missing = [name for name in (*TEXTS, *NUMBERS, "tiles", "blocks", "tile", "rays") if name not in arrays]
    if missing:
        raise InputError(f"{path}: {missing[0]!r} is missing; expected what a query writes, which says frame, epoch and ellipsoid too")
    ids = arrays["ids"].astype(np.str_)
    if len(np.unique(ids)) < len(ids):
        names, counts = np.unique(ids, return_counts=True)
        raise InputError(f"{path}: point {names[counts.argmax()]} is there {counts.max()} times; expected each point once")
    return ControlSet(
        ids=ids,
        geocentric=arrays["geocentric"],
        covariance=arrays["covariance"],
        ellipsoid=Ellipsoid(float(arrays["semimajor_axis"]), float(arrays["flattening"])),
        frame=str(arrays["frame"]),
        epoch=str(arrays["epoch"]),
        policy=str(arrays["policy"]),
        tiles=tuple(arrays["tiles"].tolist()),
        tile_of_point=arrays["tile"].astype(np.str_),
        rays=arrays["rays"],
        version=str(arrays["version"]),
        blocks=tuple(arrays["blocks"].tolist()),
        scope=str(arrays["scope"]),
        validity=tuple(arrays["validity"].tolist()) if "validity" in arrays else (),
    )
