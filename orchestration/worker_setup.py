"""What a worker process does once, when it starts; here because it needs Dask, which is loaded only where there is a cluster."""

from __future__ import annotations

from typing import Any

from distributed import WorkerPlugin

from orchestration.memory import collect_seldom


class SeldomCollected(WorkerPlugin):
    """Workers, also those that come again, look for garbage in cycles as seldom as their coordinator."""

    def setup(self, worker: Any) -> None:
        """Called by Dask in each worker."""
        collect_seldom()
