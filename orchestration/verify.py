"""Is a network sound? Every tile checked by a task of its own, then what no tile can see by itself. Nothing is changed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from orchestration.executors import Executor
from orchestration.progress import Reporter, Silent
from orchestration.verify_reconciled import verify_reconciled
from submin.errors import StoreError, SubminError
from submin.network.variance_factor import VarianceFactor, pooled
from submin.storage.problems import DAMAGE, Problem, first_line
from submin.storage.snapshot import Snapshot
from submin.storage.verify_dense import verify_dense
from submin.storage.verify_tables import stored_tiles, verify_network
from submin.storage.verify_tile import TileHealth, verify_tile

NUMBERS = ("condition", "sums_error", "factor_error", "symmetric_error", "replay_error")


@dataclass(frozen=True)
class Verified:
    """What was found; the keys of ``submin verify --json``.

    Attributes
    ----------
    version : that was checked
    problems : what is wrong, tile after tile; none in a sound network
    tiles : numbers of every tile
    """

    version: str
    problems: tuple[Problem, ...]
    tiles: tuple[TileHealth, ...]
    seconds: float

    @property
    def ok(self) -> bool:
        """True for a sound network."""
        return not self.problems

    @property
    def variance_factors(self) -> tuple[VarianceFactor, ...]:
        """Of all measurements, by sensor and platform."""
        return pooled(tile.fits for tile in self.tiles if tile.fits is not None)

    def worst(self, name: str) -> float:
        """The largest of the numbers of the tiles, NaN without any."""
        return float(np.fmax.reduce([getattr(tile, name) for tile in self.tiles], initial=np.nan))

    def to_json(self) -> dict[str, Any]:
        """Plain values; numbers that there are not are null."""
        tiles = [
            {"tile": t.tile, "images": t.images, "parameters": t.parameters} | {name: _number(getattr(t, name)) for name in NUMBERS}
            for t in self.tiles
        ]
        return {
            "ok": self.ok,
            "version": self.version,
            "problems": [{"tile": p.tile, "kind": p.kind, "detail": p.detail} for p in self.problems],
            "tiles": tiles,
            **{f"{name}_max": _number(self.worst(name)) for name in NUMBERS},
            "variance_factors": [
                {"sensor": v.sensor, "platform": v.platform, "factor": v.factor, "redundancy": v.redundancy, "sigma": v.sigma}
                for v in self.variance_factors
            ],
            "seconds": self.seconds,
        }


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def verify(place: str, executor: Executor, *, version: str | None = None, reporter: Reporter | None = None) -> Verified:
    """Check a version of a network, by default the newest.

    Raises
    ------
    StoreError, QueryError
        When there is no network, or no such version. What is wrong within a network is no error, but a finding.
    """
    started, reporter = time.monotonic(), reporter or Silent()
    try:
        snapshot = Snapshot.open(place, version)
        check = FORMS.get(snapshot.metadata.form)
    except SubminError:
        raise
    except DAMAGE as error:
        problem = Problem("", "metadata", f"the root cannot be understood: {first_line(error)}")
        return Verified(version or "", (problem,), (), time.monotonic() - started)
    if check is None:
        raise StoreError(f"{place}: form is {snapshot.metadata.form!r}; expected one of {', '.join(FORMS)}: use the release that wrote it")
    problems, tiles = check(snapshot, executor, reporter)
    return Verified(snapshot.version, tuple(problems), tuple(tiles), time.monotonic() - started)


def _factored(snapshot: Snapshot, executor: Executor, reporter: Reporter) -> tuple[list[Problem], list[TileHealth]]:
    """A network of cells and sub-MINs."""
    try:
        tiles, problems = stored_tiles(snapshot)
    except DAMAGE as error:
        return [Problem("", "unreadable", f"cells and tiles: {first_line(error)}")], []
    shared = Snapshot(snapshot.root, snapshot.place, replace(snapshot.cover))  # without what the cover has worked out: it travels
    arguments = [(shared, tile) for tile in tiles]
    handles = executor.submit_all(verify_tile, arguments, "verify-tile", reporter.stage("verifying tiles", len(tiles)))
    found: list[TileHealth] = executor.results(handles)
    problems += [problem for tile in found for problem in tile.problems]
    problems += verify_network(snapshot, [cell for tile in found for cell in tile.cells], not any(tile.unread for tile in found))
    problems += verify_reconciled(snapshot, executor, reporter)
    return problems, found


def _dense(snapshot: Snapshot, executor: Executor, reporter: Reporter) -> tuple[list[Problem], list[TileHealth]]:
    """A network of one vector of points."""
    handle = executor.submit(verify_dense, (snapshot,), "verify-dense")  # it has all cores
    executor.wait([handle], reporter.stage("verifying the network", 1))
    [(problems, tiles)] = executor.results([handle])
    return problems, tiles


FORMS: dict[str, Callable[[Snapshot, Executor, Reporter], tuple[list[Problem], list[TileHealth]]]] = {
    "factored": _factored,
    "dense": _dense,
}
"""How a network of each form is checked."""
