"""Where tasks run: here, one after another, or on a Dask cluster. The same tasks, the same results."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from submin.adjustment.warm_up import compile_kernels
from submin.errors import InputError

Advance = Callable[[], None]


class Executor(Protocol):
    """Runs tasks. A *handle* stands for a result that stays where it was made; it can be an argument of a later task."""

    workers: int

    def share(self, value: Any) -> Any:
        """Make a value known to all workers once; the answer is a handle."""
        ...

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """Run a function for every tuple of arguments, a bounded number at a time; handles in the same order, all done."""
        ...

    def results(self, handles: Sequence[Any]) -> list[Any]:
        """The values of some handles."""
        ...

    def peak_memory_mb(self) -> float:
        """Largest resident memory so far, megabytes: this process and its workers together."""
        ...


def own_peak_memory_mb() -> float:
    """Largest resident memory of this process so far, megabytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


class SerialExecutor:
    """Runs every task here and at once."""

    workers = 1

    def share(self, value: Any) -> Any:
        """See `Executor.share`."""
        return value

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """See `Executor.submit_all`."""
        done = []
        for args in arguments:
            done.append(function(*args))
            advance()
        return done

    def results(self, handles: Sequence[Any]) -> list[Any]:
        """See `Executor.results`."""
        return list(handles)

    def peak_memory_mb(self) -> float:
        """See `Executor.peak_memory_mb`."""
        return own_peak_memory_mb()


class DaskExecutor:
    """Runs tasks on a Dask cluster, at most three a worker in flight, so that memory does not grow with the number of tasks."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.workers = max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)

    def share(self, value: Any) -> Any:
        """See `Executor.share`."""
        return self.client.scatter([value], broadcast=True)[0]

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """See `Executor.submit_all`."""
        from distributed import as_completed

        waiting = iter(range(len(arguments)))
        handles: list[Any] = [None] * len(arguments)

        def submit_next() -> Any:
            k = next(waiting, None)
            if k is None:
                return None
            handles[k] = self.client.submit(function, *arguments[k], pure=False, key=f"{name}-{os.urandom(6).hex()}")
            return handles[k]

        first = [f for f in (submit_next() for _ in range(3 * self.workers)) if f is not None]
        running: Any = as_completed(first)
        for future in running:
            if future.status != "finished":
                future.result()  # raises the task's error here
            advance()
            following = submit_next()
            if following is not None:
                running.add(following)
        return handles

    def results(self, handles: Sequence[Any]) -> list[Any]:
        """See `Executor.results`."""
        return list(self.client.gather(list(handles)))

    def peak_memory_mb(self) -> float:
        """See `Executor.peak_memory_mb`."""
        return own_peak_memory_mb() + float(sum(self.client.run(own_peak_memory_mb).values()))


@contextmanager
def executor_for(workers: int = 0, scheduler: str | None = None) -> Iterator[Executor]:
    """Serial for no workers; a local cluster of so many processes, one BLAS thread each; or the cluster at an address.

    Raises
    ------
    InputError
        When no scheduler answers at the address.
    """
    if scheduler is None and workers <= 0:
        yield SerialExecutor()
        return
    import dask
    from distributed import Client, LocalCluster

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout="10s")
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {scheduler!r} ({error}); start one with 'dask scheduler'") from None
        with client:
            yield DaskExecutor(client)
        return
    compile_kernels()
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    with (
        # set before the workers load numpy
        dask.config.set({"distributed.nanny.pre-spawn-environ": threads, "distributed.worker.memory.terminate": False}),
        LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=40) as cluster,
        Client(cluster) as client,
    ):
        yield DaskExecutor(client)
