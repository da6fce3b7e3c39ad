"""Preloaded by Dask workers of a test: the adjustment of one block ends its process, as a fault in a compiled library does."""

from __future__ import annotations

import os
from typing import Any

from orchestration import tasks

CRASHES = "TEST_BLOCK_THAT_CRASHES"
"""Environment variable with the block's id."""


def dask_setup(worker: Any) -> None:
    adjust_block = tasks.adjust_block

    def crashing(block: tasks.BlockRays, *rest: Any) -> tasks.BlockAdjustment:
        if block.block_id == os.environ[CRASHES]:
            os.abort()
        return adjust_block(block, *rest)

    tasks.adjust_block = crashing
