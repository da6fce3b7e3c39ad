"""Surveyed control points into a network, any time: each is entered in the ledger, counted once, and can be withdrawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from orchestration.executors import Executor
from orchestration.progress import Reporter, Silent
from orchestration.reading import ready
from orchestration.run import fuse_blocks
from submin.adjustment.surveyed_points import ContradictedPoint
from submin.storage.catalogue_schema import PointTable
from submin.storage.control_blocks import control_blocks
from submin.storage.snapshot import Snapshot


@dataclass(frozen=True)
class RejectedPoint:
    """A control point that was not taken, or a set of correlated ones by its block, and why."""

    point_id: str
    reason: str
    points: tuple[str, ...]


@dataclass(frozen=True)
class ControlAdded:
    """What became of some control points; the keys of ``submin control add --json``."""

    version: str
    fused: int
    skipped: int
    rejected: tuple[RejectedPoint, ...]
    contradicted: tuple[ContradictedPoint, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        rejected = [{"point_id": r.point_id, "reason": r.reason, "points": list(r.points)} for r in self.rejected]
        flagged = [{"point_id": c.point_id, "reason": c.reason} for c in self.contradicted]
        return {
            "version": self.version, "control_fused": self.fused, "control_skipped": self.skipped, "control_rejected": rejected,
            "control_flagged": flagged,
        }  # fmt: skip


def add_control(points: PointTable, source: str, where: str, executor: Executor, reporter: Reporter | None = None) -> ControlAdded:
    """Add control points (from ``source``, for messages) to a network, in one commit. Those that it has already are skipped.

    Raises
    ------
    InputError
        When the points have a joint covariance that is not positive definite, or not that of the points.
    """
    reporter = reporter or Silent()
    reporter.begin(len(points))
    blocks = control_blocks(points, Snapshot.open(where).metadata.ellipsoid, source)
    tally = fuse_blocks(ready(blocks), where, executor, max(len(points), 1), reporter)
    rejected = tuple(RejectedPoint(r.points[0] if len(r.points) == 1 else r.block_id, r.reason, r.points) for r in tally.rejected)
    skipped = len(points) - tally.control - sum(len(r.points) for r in rejected)
    ours = set(points.point_ids.tolist())
    found = tuple(c for c in tally.contradicted if c.point_id in ours)
    return ControlAdded(f"v{tally.version}", tally.control, skipped, rejected, found)
