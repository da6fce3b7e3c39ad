"""Preloaded by Dask workers of a test: what is done with one block ends its process, as a fault in a compiled library does."""

from __future__ import annotations

import os
from typing import Any

from orchestration import gate, reading, stage_one
from submin.network.innovation import BlockTest

CRASHES = "TEST_BLOCK_THAT_CRASHES"
"""Environment variable with the block's id."""
DOING = "TEST_WHAT_CRASHES"
"""Environment variable with what is done then: ``adjustment``, or ``test by the network``."""


def dask_setup(worker: Any) -> None:
    adjust_block, test = stage_one.adjust_block, gate.Gate.test

    def adjusting(block: stage_one.BlockRays, *rest: Any) -> stage_one.BlockAdjustment:
        _crash("adjustment", block)
        return adjust_block(block, *rest)

    def testing(self: gate.Gate, candidate: gate.Candidate) -> BlockTest | None:
        _crash("test by the network", candidate.rays)
        return test(self, candidate)

    stage_one.adjust_block = reading.adjust_block = adjusting
    gate.Gate.test = testing  # type: ignore[method-assign]


def _crash(doing: str, block: stage_one.BlockRays) -> None:
    if (doing, block.block_id) == (os.environ[DOING], os.environ[CRASHES]):
        os.abort()
