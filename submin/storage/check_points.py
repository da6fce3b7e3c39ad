"""Points that a catalogue names as check points: a network remembers them, so that nobody takes them for control."""

from __future__ import annotations

import numpy as np
import zarr
from numpy.typing import NDArray

from submin.storage.arrays import append_table, create_table, group_of, read_table
from submin.storage.snapshot import Snapshot

Ids = NDArray[np.str_]

TABLE = "check_points"
COLUMNS = {"point_id": "text"}


def check_points(snapshot: Snapshot) -> Ids:
    """Ids of all check points that a version knows of, ascending; whether it has the points does not count."""
    if TABLE not in snapshot.root:
        return np.empty(0, dtype="U1")
    return np.unique(read_table(group_of(snapshot.root, TABLE))["point_id"])


def enter_check_points(root: zarr.Group, base: Snapshot, ids: Ids) -> None:
    """Enter those of some check points that the last version does not know of; without any, nothing is written."""
    new = np.setdiff1d(ids, check_points(base))
    if len(new):
        table = group_of(root, TABLE) if TABLE in root else create_table(root, TABLE, COLUMNS)
        append_table(table, {"point_id": new})
