"""Time and memory that a run is expected to take: rates measured on simulated regions, per ray, per tile and by the cube of parameters.

The rates are those of 144 three-line triplets (432 images, 22,000 and 88,000 rays) over 4, 9 and 25 tiles, in one process with one
thread (docs/tiles.md). Other machines, sensors and blunder rates differ by a factor: it is an estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BASIS = (
    "rates of simulated three-line triplets on one core of an AMD EPYC at one thread, without other load; "
    "memory as measured there: 370 MB a process and seven matrices of the largest tile's parameters"
)
WORKERS = (1, 2, 4, 8)

SECONDS_A_BLOCK = 1.6e-3
SECONDS_A_RAY = 1.5e-5
"""Adjusting its block, and registering it."""
SECONDS_A_TILE = 0.14
SECONDS_A_HELD_RAY = 1.7e-5
"""Each ray in each tile that holds it, every time that the tile is judged."""
SECONDS_A_CUBE = 4.4e-10
"""For the cube of a tile's parameters: the Cholesky factors of its adjustment and of its sub-MIN."""
SECONDS_A_BATCH = 0.5
"""Registration and the commit, which only the coordinator does."""
PROCESS_MB = 370.0
MATRICES_A_TILE = 7.0
"""Square matrices of a tile's parameters that are held at once, at most."""


@dataclass(frozen=True)
class TileLoad:
    """What a tile has to do in a run.

    Attributes
    ----------
    parameters : of all images that it then sees; rays : that it then holds
    batches : number of batches that bring it something
    """

    parameters: int
    rays: int
    batches: int


@dataclass(frozen=True)
class Expectation:
    """Seconds and megabytes expected of a run, by number of workers."""

    workers: int
    seconds: float
    memory_mb: float


def expected(blocks: int, rays: int, batches: int, tiles: Sequence[TileLoad]) -> tuple[Expectation, ...]:
    """Time and memory, for each number of `WORKERS`, of a run that fuses so many blocks and rays in so many batches.

    Stage 1 and the tiles are shared among the workers; no batch is faster than its largest tile, and its commit is the coordinator's.
    One worker works in the process of the coordinator; more are processes beside it.
    """
    each = np.array([_seconds(tile) for tile in tiles])
    shared = SECONDS_A_BLOCK * blocks + SECONDS_A_RAY * rays + float(each.sum())
    largest = MATRICES_A_TILE * 8e-6 * max((tile.parameters for tile in tiles), default=0) ** 2
    return tuple(
        Expectation(
            n, SECONDS_A_BATCH * batches + max(shared / n, float(each.max(initial=0.0))),
            PROCESS_MB * (n + (n > 1)) + min(n, max(len(tiles), 1)) * largest,
        )
        for n in WORKERS
    )  # fmt: skip


def _seconds(tile: TileLoad) -> float:
    """Of all updates of a tile, which grows evenly from batch to batch."""
    grown = np.arange(1, tile.batches + 1) / max(tile.batches, 1)
    rays, parameters = grown * tile.rays, grown * tile.parameters
    return float((SECONDS_A_TILE + SECONDS_A_HELD_RAY * rays + SECONDS_A_CUBE * parameters**3).sum())
