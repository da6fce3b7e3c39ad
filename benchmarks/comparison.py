"""What benchmarks of the papers' experiments share: verdicts, networks of one tile, pooled errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orchestration.create import create, fit_catalogue
from orchestration.executors import SerialExecutor
from orchestration.progress import Silent
from orchestration.run import fuse_blocks
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block

Array = NDArray[np.float64]

MET, NOT_MET = "met", "NOT MET"
ONE_TILE_KM = 2000.0
"""Side of a core that holds everything."""


def verdict(met: bool) -> str:
    """The word for it."""
    return MET if met else NOT_MET


def statement(claim: str, wanted: str, found: float, met: bool) -> dict[str, Any]:
    """A row that holds one number against what is wanted of it."""
    return {"claim": claim, "wanted": wanted, "found": found, "verdict": verdict(met)}


def between(claim: str, low: float, high: float, found: float) -> dict[str, Any]:
    """A row for a number that must lie within limits."""
    return statement(claim, f"{low:g} to {high:g}", found, bool(low <= found <= high))


def below(claim: str, limit: float, found: float) -> dict[str, Any]:
    """A row for a number that must not exceed a limit."""
    return statement(claim, f"{limit:g} or less", found, bool(found <= limit))


def data(claim: str, remark: str, found: float) -> dict[str, Any]:
    """A row for a number of which nothing is wanted."""
    return {"claim": claim, "wanted": remark, "found": found, "verdict": "data"}


def network_of(catalogue: Catalogue, place: Path, batches: Iterable[Sequence[Block]], tile_km: float = ONE_TILE_KM) -> str:
    """A new network with these blocks fused in this order, a batch to a commit; its place."""
    area, _, _ = fit_catalogue(catalogue)
    create(str(place), area, catalogue.metadata, tile_km, min(100.0, 0.5 * tile_km))
    for batch in batches:
        tally = fuse_blocks(batch, str(place), SerialExecutor(), len(batch), Silent())
        if tally.rejected:
            raise RuntimeError(f"rejected: {tally.rejected[0].block_id}: {tally.rejected[0].reason}")
    return str(place)
