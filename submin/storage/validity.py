"""From when to when points of a network are valid: ground changes, and what was measured stays (decision 013).

Dates are ISO 8601 texts (``2026-05-31``), which sort as dates do; an empty one leaves that side open. A point is valid on both of its
dates and between them. Rows are only ever added, and the last one of a point counts: every version keeps what was said in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime

import numpy as np
import zarr
from numpy.typing import NDArray

from submin.errors import InputError
from submin.storage.arrays import append_table, create_table, group_of, read_table
from submin.storage.snapshot import Snapshot

Texts = NDArray[np.str_]
Flags = NDArray[np.bool_]

TABLE = "validity"
COLUMNS = {"point_id": "text", "valid_from": "text", "valid_to": "text", "reason": "text", "version": "int64"}
OPEN = "none"
"""What a user gives for a date that is to be taken back."""


@dataclass(frozen=True)
class Validity:
    """What a version says of the validity of points; of points that are not here it says nothing.

    Attributes
    ----------
    point_ids : (k,) ids, ascending
    valid_from, valid_to : (k,) first and last day, ISO 8601; empty where open
    reason : (k,) why, as given
    """

    point_ids: Texts
    valid_from: Texts
    valid_to: Texts
    reason: Texts

    @classmethod
    def of(cls, snapshot: Snapshot) -> Validity:
        """What a version says; a network from before there was such a table says nothing."""
        none = np.empty(0, dtype="U1")
        if TABLE not in snapshot.root:
            return cls(none, none, none, none)
        rows = read_table(group_of(snapshot.root, TABLE), ["point_id", "valid_from", "valid_to", "reason"])
        ids, from_the_end = np.unique(rows["point_id"][::-1], return_index=True)
        last = len(rows["point_id"]) - 1 - from_the_end
        return cls(ids, rows["valid_from"][last], rows["valid_to"][last], rows["reason"][last])

    def __len__(self) -> int:
        return len(self.point_ids)

    def rows_of(self, ids: Texts) -> tuple[Texts, Texts, Texts]:
        """First and last day and reason (n,) of points; empty where nothing is said."""
        if not len(self):
            none = np.zeros(len(ids), dtype="U1")
            return none, none, none
        at = np.minimum(np.searchsorted(self.point_ids, ids), len(self) - 1)
        known = self.point_ids[at] == ids
        first, last, reason = (np.where(known, values[at], "") for values in (self.valid_from, self.valid_to, self.reason))
        return first, last, reason

    def valid(self, ids: Texts, on: date) -> Flags:
        """True (n,) for points that are valid on a day; those of which nothing is said are."""
        first, last, _ = self.rows_of(ids)
        day = on.isoformat()
        return np.asarray((first <= day) & ((last == "") | (last >= day)))

    def intervals(self, ids: Texts) -> tuple[str, ...]:
        """``ID FROM/TO`` for each of some points that has a date: an ISO 8601 interval, ``..`` where it is open."""
        first, last, _ = self.rows_of(ids)
        dated = np.flatnonzero((first != "") | (last != ""))
        return tuple(f"{ids[k]} {first[k] or '..'}/{last[k] or '..'}" for k in dated)


def append_validity(root: zarr.Group, rows: Validity, version: int) -> None:
    """Append what is new in a version to the table of a network, which is made where it has none yet."""
    table = group_of(root, TABLE) if TABLE in root else create_table(root, TABLE, COLUMNS)
    append_table(table, {
        "point_id": rows.point_ids, "valid_from": rows.valid_from, "valid_to": rows.valid_to, "reason": rows.reason,
        "version": np.full(len(rows), version, dtype=np.int64),
    })  # fmt: skip


def today() -> date:
    """The date in UTC."""
    return datetime.now(UTC).date()


def read_date(text: str, name: str, or_open: bool = False) -> str:
    """A date as ISO 8601 writes it, checked; ``none`` gives an empty text where that is allowed. ``name`` is for messages.

    Raises
    ------
    InputError
        When it is none.

    Examples
    --------
    >>> read_date("2026-05-31", "--valid-to"), read_date("none", "--valid-to", or_open=True)
    ('2026-05-31', '')
    """
    if or_open and text == OPEN:
        return ""
    try:
        return datetime.strptime(text, "%Y-%m-%d").date().isoformat()
    except ValueError:
        raise InputError(f"{name} is {text!r}; expected a date as 2026-05-31{f', or {OPEN}' if or_open else ''}") from None
