"""What benchmarks of the papers' experiments share: verdicts, networks of one tile, pooled errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

from orchestration.create import create, fit_catalogue
from orchestration.executors import SerialExecutor
from orchestration.progress import Silent
from orchestration.reading import ready
from orchestration.run import fuse_blocks
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block

Array = NDArray[np.float64]

MET, NOT_MET, DATA = "met", "NOT MET", "data"
ONE_TILE_KM = 2000.0
"""Side of a core that holds everything."""


def widened(half_width: float, runs: int, full: int) -> float:
    """Half-width of a band for the mean over fewer realisations than it was made for.

    Errors within a realisation hang together, so it is realisations that count and not points: the scatter goes with the square root of
    their number. More of them than at full scale do not make a band narrower: what is wanted is what is wanted.
    """
    return half_width * float(np.sqrt(max(1.0, full / runs)))


def rejections_allowed(part: float, trials: int, runs: int, full: int) -> float:
    """Largest part of trials in which something rare may happen that happens in ``part`` of them at most.

    Over fewer realisations than the full number a single one weighs more: what a Poisson number stays below with probability 0.999.
    """
    if runs >= full:
        return part
    return max(part, float(poisson.ppf(0.999, part * trials)) / trials)


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
    return {"claim": claim, "wanted": remark, "found": found, "verdict": DATA}


def network_of(catalogue: Catalogue, place: Path, batches: Iterable[Sequence[Block]], tile_km: float = ONE_TILE_KM) -> str:
    """A new network with these blocks fused in this order, a batch to a commit; its place."""
    area, _, _ = fit_catalogue(catalogue)
    create(str(place), area, catalogue.metadata, tile_km, min(100.0, 0.5 * tile_km))
    for batch in batches:
        tally = fuse_blocks(ready(batch), str(place), SerialExecutor(), len(batch), Silent())
        if tally.rejected:
            raise RuntimeError(f"rejected: {tally.rejected[0].block_id}: {tally.rejected[0].reason}")
    return str(place)
