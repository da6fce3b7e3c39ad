"""Worker processes on this machine, which come again when they are killed; where they cannot, a run must not wait for them for ever."""

from __future__ import annotations

import logging
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any

from orchestration.memory import KEPT_FREE, seldom_collected
from submin.query.warm_up import compile_kernels

GIVEN_UP = 120.0
"""Seconds without a single worker after which none is waited for: a killed one comes again in a few, on a busy machine in tens of them."""
LOOKED_EVERY = 1.0
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
MEMORY = {name: str(value) for name, _, value in KEPT_FREE}
SETTINGS = {
    "distributed.nanny.pre-spawn-environ": {**THREADS, **MEMORY},  # set before the workers load numpy
    # Dask would look at every stack a hundred times a second; what tasks took is in the run's record
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.terminate": False,
    # a worker that holds on to freed memory would stop taking tasks, and if all do the run would wait for ever
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.spill": False,
    # a killed worker may take long to come again where machines are busy; given up after this, it never would, and be waited for
    "distributed.deploy.lost-worker-timeout": "1 day",
}

LISTENING = {"protocol": ["tcp://", "inproc://"], "host": ["127.0.0.1", ""]}
"""Where the scheduler listens: for workers at a port of this machine, for the client, which is in its own process, without a copy.

What a task is given must therefore not be changed afterwards: a task that runs again is given the very arrays of the coordinator.
"""


class Deserted(threading.Event):
    """Set once there has been no worker for so long that none is waited for any more."""


@contextmanager
def local_cluster(workers: int) -> Iterator[tuple[Any, Deserted]]:
    """A Dask client of so many worker processes, one BLAS thread each; it is closed when all of them are gone for good."""
    import dask
    from distributed import Client, LocalCluster

    from orchestration.worker_setup import Prepared

    compile_kernels()
    with dask.config.set(SETTINGS):
        with _children_deaf_to_ctrl_c(), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # told where there is no network, on which nothing here depends
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=logging.CRITICAL,
                scheduler_kwargs=LISTENING,
            )  # fmt: skip
        with cluster, Client(_in_process(cluster)) as client, _watched(cluster, client) as deserted, seldom_collected():
            client.register_plugin(Prepared())
            yield client, deserted


def _in_process(cluster: Any) -> str:
    """The address at which the scheduler listens in this process."""
    found: list[str] = [listener.contact_address for listener in cluster.scheduler.listeners]
    return next(address for address in found if address.startswith("inproc://"))


@contextmanager
def _watched(cluster: Any, client: Any) -> Iterator[Deserted]:
    """Close the client once the cluster has had no worker for `GIVEN_UP` seconds: whoever waits for a task is then told."""
    deserted, done = Deserted(), threading.Event()

    def watch() -> None:
        last = time.monotonic()
        while not done.wait(LOOKED_EVERY):
            if cluster.scheduler.workers:
                last = time.monotonic()
            elif time.monotonic() - last > GIVEN_UP:
                deserted.set()
                client.close()
                return

    watcher = threading.Thread(target=watch, name="workers-watched", daemon=True)
    watcher.start()
    try:
        yield deserted
    finally:
        done.set()
        watcher.join()


@contextmanager
def _children_deaf_to_ctrl_c() -> Iterator[None]:
    """Processes that are started in the body, or later by threads that are, do not get the terminal's Ctrl-C.

    It goes to every process of the group; ending the workers is the coordinator's part. Here it comes when the body is left.
    """
    resource_tracker.ensure_running()  # where it starts, it would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
