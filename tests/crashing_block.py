"""Preloaded by Dask workers of a test: the adjustment of one block ends its process, as a fault in a compiled library does."""

from __future__ import annotations

import os
from typing import Any

from orchestration import reading, stage_one

CRASHES = "TEST_BLOCK_THAT_CRASHES"
"""Environment variable with the block's id."""


def dask_setup(worker: Any) -> None:
    adjust_block = stage_one.adjust_block

    def crashing(block: stage_one.BlockRays, *rest: Any) -> stage_one.BlockAdjustment:
        if block.block_id == os.environ[CRASHES]:
            os.abort()
        return adjust_block(block, *rest)

    stage_one.adjust_block = reading.adjust_block = crashing
