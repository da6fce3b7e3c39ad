"""Retirement: points of a network get dates, because the ground has changed where they were. What was measured stays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from submin import Network
from submin.errors import InputError
from submin.storage.commit import begin_change, commit
from submin.storage.validity import Validity, append_validity, read_date
from submin.storage.writer_lock import writing


@dataclass(frozen=True)
class Retired:
    """What was said of points; the keys of ``submin retire --json``.

    Attributes
    ----------
    version : of the network afterwards; points : given; changed : of which something else was said before
    """

    version: str
    points: int
    changed: int

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {"version": self.version, "points": self.points, "points_changed": self.changed}


def retire(
    where: str, ids: NDArray[np.str_], *, valid_to: str | None = None, valid_from: str | None = None, reason: str = ""
) -> Retired:  # fmt: skip
    """Give points a last day, a first day, or take them back (``none``), in one commit; what is so already is not written again.

    A date that is not given stays as it was. ``reason`` replaces an earlier one; without it an earlier one stays while its dates do.

    Raises
    ------
    InputError
        When no date is given, one is none, the first day is after the last, or the network does not have all of the points.
    BusyError, ConflictError
        When another process is writing to the network; nothing has changed then.
    """
    if valid_to is None and valid_from is None:
        raise InputError("no date is given; expected --valid-to, --valid-from, or both: a date as 2026-05-31, or none")
    last = None if valid_to is None else read_date(valid_to, "--valid-to", or_open=True)
    first = None if valid_from is None else read_date(valid_from, "--valid-from", or_open=True)
    ids = np.unique(ids)
    _changes(Network(where), ids, first, last, reason)  # what cannot be is refused before anything is touched
    with writing(where):
        current = Network(where)
        rows = _changes(current, ids, first, last, reason)
        if not len(rows):
            return Retired(current.version, len(ids), 0)
        session, base = begin_change(where, current.snapshot.number)
        root, version = zarr.open_group(session.store, mode="r+"), base.number + 1
        append_validity(root, rows, version)
        root.attrs["version"] = version
        given = [f"{word} {date or 'open'}" for word, date in (("valid from", first), ("valid to", last)) if date is not None]
        points = f"{len(rows)} point{'s' * (len(rows) > 1)}"
        commit(session, version, f"{points} {', '.join(given)}{f': {reason}' if reason else ''}")
    return Retired(f"v{version}", len(ids), len(rows))


def _changes(network: Network, ids: NDArray[np.str_], first: str | None, last: str | None, reason: str) -> Validity:
    """What is new for points; dates that are None stay as they are."""
    network.named(ids)
    before_first, before_last, before_reason = network.validity.rows_of(ids)
    new_first = before_first if first is None else np.full(len(ids), first)
    new_last = before_last if last is None else np.full(len(ids), last)
    same = (new_first == before_first) & (new_last == before_last)
    new_reason = np.full(len(ids), reason) if reason else np.where(same, before_reason, "")
    turned = (new_first != "") & (new_last != "") & (new_first > new_last)
    if turned.any():
        k = int(np.argmax(turned))
        raise InputError(
            f"point {ids[k]} would be valid from {new_first[k]} to {new_last[k]}; expected a first day that is not after the last"
        )
    rows = ~same | (new_reason != before_reason)
    return Validity(ids[rows], new_first[rows], new_last[rows], new_reason[rows])
