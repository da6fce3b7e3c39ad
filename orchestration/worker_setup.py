"""What a worker process does once, when it starts; here because it needs Dask, which is loaded only where there is a cluster."""

from __future__ import annotations

import threading
from importlib import import_module
from typing import Any

from distributed import WorkerPlugin

from orchestration.memory import collect_seldom
from submin.query.warm_up import compile_kernels


class Prepared(WorkerPlugin):
    """Workers, also those that come again, begin to load what tasks need as soon as they start, and then look for garbage seldom."""

    def setup(self, worker: Any) -> None:
        """Called by Dask in each worker. A thread loads the kernels while the coordinator reads the catalogue; a task may come before."""
        threading.Thread(target=_prepare, name="prepare", daemon=True).start()


def _prepare() -> None:
    for tasks in ("reading", "gate", "tasks"):
        import_module(f"orchestration.{tasks}")
    compile_kernels()
    collect_seldom()
