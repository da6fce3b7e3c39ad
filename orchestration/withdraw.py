"""Withdrawal: a block, an image or a control point leaves a network as if it had never been fused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orchestration.change import finish, place, settle, take_points_seen
from orchestration.executors import Executor
from orchestration.progress import Reporter, Silent
from submin.errors import InputError
from submin.network.registration import together
from submin.storage.catalogue_schema import CONTROL_PREFIX
from submin.storage.commit import begin_change
from submin.storage.control_blocks import view_id
from submin.storage.ledger import VIEWS, Entry, Ledger
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import writing


@dataclass(frozen=True)
class Withdrawn:
    """What was withdrawn.

    Attributes
    ----------
    version : of the network afterwards
    what : block, image or control point, with its id; images, rays : that left with it
    tiles : names of the tiles that were judged and factored again
    """

    version: str
    what: str
    images: int
    rays: int
    tiles: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {"version": self.version, "withdrawn": self.what, "images": self.images, "rays": self.rays, "tiles": list(self.tiles)}


def withdraw(
    where: str, executor: Executor, *, block: str | None = None, image: str | None = None, control: str | None = None,
    reporter: Reporter | None = None,
) -> Withdrawn:  # fmt: skip
    """Withdraw one block, image or control point, by its id. It can come again.

    Points that came with a joint covariance are one block: withdrawing one of them withdraws all, and the result says so.

    The last image of a block takes the block with it. A block of which an image was withdrawn stays in the ledger: the same block again
    is skipped, and brings the image back only after the whole block was withdrawn.

    Raises
    ------
    InputError
        When the network does not have it, or not exactly one is named.
    BusyError, ConflictError
        When another process is writing to the network; nothing has changed then.
    """
    named = [(kind, value) for kind, value in (("block", block), ("image", image), ("control point", control)) if value is not None]
    if len(named) != 1:
        raise InputError("give exactly one of --block, --image and --control")
    kind, name = named[0]
    _leaving(Snapshot.open(where), kind, name)  # what is not there is refused before anything is touched
    with writing(where):
        current = Snapshot.open(where)
        leaving = _leaving(current, kind, name)  # again, now that nobody else writes
        return _withdraw(where, current.number, leaving, executor, reporter or Silent())


@dataclass(frozen=True)
class _Leaving:
    """What leaves: its kind and name, its block, the rows of its images, and whether they are all that the block has left."""

    kind: str
    name: str
    before: Entry
    rows: NDArray[np.int64]
    whole_block: bool


def _leaving(base: Snapshot, kind: str, name: str) -> _Leaving:
    ledger = Ledger.of(base)
    table = base.image_columns(["image_id", "block_id", "withdrawn"])
    view = name if kind == "image" else view_id(name, 0)
    block_id = name if kind == "block" else ledger.block_of_image.get(view, "")
    of_block = np.flatnonzero((table["withdrawn"] == 0) & (table["block_id"] == block_id))
    rows = of_block[table["image_id"][of_block] == name] if kind == "image" else of_block
    if kind == "image" and name.startswith(CONTROL_PREFIX):
        raise InputError(f"image {name!r} is a view of a control point; withdraw the point with --control")
    if not len(rows):
        raise InputError(
            f"{base.place}: {kind} {name!r} is not in the network; see 'submin info', or 'submin history' for what came and went"
        )
    return _Leaving(kind, name, ledger.entries[block_id], rows, len(rows) == len(of_block))


def _withdraw(where: str, version: int, leaving: _Leaving, executor: Executor, reporter: Reporter) -> Withdrawn:
    session, base = begin_change(where, version)
    rows, before, what = leaving.rows, leaving.before, f"{leaving.kind} {leaving.name}"
    surveyed = before.kind != "images"
    if leaving.kind == "control point" and len(rows) > VIEWS:
        what += f" and the {len(rows) // VIEWS - 1} points that its errors are correlated with (block {before.block_id})"
    out = take_points_seen(base, rows.astype(np.int32))
    move = place(base, out, together([]), [], executor)
    settled = settle(session, base, move, executor, reporter)
    left = replace(before, version=version + 1, images=before.images - len(rows), rays=before.rays - out.lost)
    if leaving.whole_block:
        entry = replace(left, status="withdrawn", reason=f"{leaving.kind} withdrawn", rays_rejected=0)
    else:
        entry = replace(left, reason=", ".join([before.reason or "without image", leaving.name]).replace("image, ", "image "))
    finish(session, base, move, settled, [], [entry], f"{what} withdrawn", withdrawn=rows.tolist())
    tiles = tuple(move.cover.tile_name(report.tile) for report in settled.reports)
    return Withdrawn(f"v{version + 1}", what, 0 if surveyed else len(rows), out.lost, tiles)
