"""Surveyed control points into a network, any time: each is entered in the ledger, counted once, and can be withdrawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from orchestration.executors import Executor
from orchestration.progress import Reporter, Silent
from orchestration.run import fuse_blocks
from submin.storage.catalogue_schema import PointTable
from submin.storage.control_blocks import control_blocks, control_point_of
from submin.storage.network_store import Snapshot


@dataclass(frozen=True)
class RejectedPoint:
    """A control point that was not taken, and why."""

    point_id: str
    reason: str


@dataclass(frozen=True)
class ControlAdded:
    """What became of some control points; the keys of ``submin control add --json``."""

    version: str
    fused: int
    skipped: int
    rejected: tuple[RejectedPoint, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        rejected = [{"point_id": r.point_id, "reason": r.reason} for r in self.rejected]
        return {"version": self.version, "control_fused": self.fused, "control_skipped": self.skipped, "control_rejected": rejected}


def add_control(points: PointTable, source: str, where: str, executor: Executor, reporter: Reporter | None = None) -> ControlAdded:
    """Add control points (from ``source``, for messages) to a network, in one commit. Those that it has already are skipped.

    Raises
    ------
    InputError
        When the points are correlated: this release takes points with a covariance each.
    """
    reporter = reporter or Silent()
    reporter.begin(len(points))
    blocks = control_blocks(points, Snapshot.open(where).metadata.ellipsoid, source)
    tally = fuse_blocks(blocks, where, executor, max(len(points), 1), reporter)
    rejected = tuple(RejectedPoint(control_point_of(r.block_id) or r.block_id, r.reason) for r in tally.rejected)
    return ControlAdded(f"v{tally.version}", tally.control, len(points) - tally.control - len(rejected), rejected)
