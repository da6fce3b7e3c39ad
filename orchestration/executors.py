"""Where tasks run: here, one after another or in threads, or on a Dask cluster. The same tasks, the same results."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Protocol

from threadpoolctl import ThreadpoolController

from orchestration.local_cluster import local_cluster
from orchestration.memory import give_back, keep_freed, own_peak_memory_mb, seldom_collected, share_heaps
from orchestration.task_record import TaskRecord, recorded, taken_notes
from submin.errors import InputError

STREAMED = 4
"""Results of a stream that a worker may be ahead of whoever takes them."""
Advance = Callable[[], None]


class Executor(Protocol):
    """Runs tasks. A *handle* stands for a result that stays where it was made; it can be an argument of a later task."""

    workers: int
    beside: bool
    """Whether tasks run in processes beside this one, which see the same files."""

    def share(self, value: Any) -> Any:
        """Make a value known to all workers once; the answer is a handle."""
        ...

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """Run a function for every tuple of arguments, a bounded number at a time; handles in the same order, all done."""
        ...

    def submit(self, function: Callable[..., Any], arguments: tuple[Any, ...], name: str) -> Any:
        """A handle of what a function will give once its arguments are there. Nothing bounds how many are under way."""
        ...

    def wait(self, handles: Sequence[Any], advance: Advance) -> None:
        """Wait until all of some handles are done."""
        ...

    def stream(
        self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], name: str, *, ahead: int | None = None,
        killed: Callable[..., Any] | None = None,
    ) -> Iterator[Any]:  # fmt: skip
        """The values of a function for tuples of arguments, in their order, a bounded number of them at a time: none is kept.

        On a cluster they are worked out where nothing else is to be done. ``ahead`` bounds the number further. Of a task whose workers
        were killed again and again, or which waited on such a worker, the value is that of ``killed``, called here; without it that is
        an error.
        """
        ...

    def attempt_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """As `submit_all`, but the values; that of a task whose workers were killed again and again is the `KilledTaskError`.

        Such a task need not be to blame: it may have waited on the worker of another one that is.
        """
        ...

    def results(self, handles: Sequence[Any]) -> list[Any]:
        """The values of some handles."""
        ...

    def give_back(self) -> None:
        """Give memory that was freed back to the system, here and where tasks run: between two batches."""
        ...

    def peak_memory_mb(self) -> float:
        """Largest resident memory so far, megabytes: this process and its workers together."""
        ...

    def task_records(self) -> dict[str, TaskRecord]:
        """What tasks took by their names since this was asked last; those of lost workers are not told."""
        ...


class SerialExecutor:
    """Runs every task here and at once."""

    workers = 1
    beside = False

    def share(self, value: Any) -> Any:
        """See `Executor.share`."""
        return value

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """See `Executor.submit_all`."""
        done = []
        for args in arguments:
            done.append(recorded(name, function, *args))
            advance()
        return done

    def submit(self, function: Callable[..., Any], arguments: tuple[Any, ...], name: str) -> Any:
        """See `Executor.submit`."""
        return recorded(name, function, *arguments)

    def wait(self, handles: Sequence[Any], advance: Advance) -> None:
        """See `Executor.wait`."""
        for _ in handles:
            advance()

    def stream(
        self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], name: str, *, ahead: int | None = None,
        killed: Callable[..., Any] | None = None,
    ) -> Iterator[Any]:  # fmt: skip
        """See `Executor.stream`."""
        return (recorded(name, function, *args) for args in arguments)

    def attempt_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """See `Executor.attempt_all`. Nothing outlives a crash here."""
        return self.submit_all(function, arguments, name, advance)

    def results(self, handles: Sequence[Any]) -> list[Any]:
        """See `Executor.results`."""
        return list(handles)

    def give_back(self) -> None:
        """See `Executor.give_back`."""
        give_back()

    def peak_memory_mb(self) -> float:
        """See `Executor.peak_memory_mb`."""
        return own_peak_memory_mb()

    def task_records(self) -> dict[str, TaskRecord]:
        """See `Executor.task_records`."""
        return taken_notes()


class ThreadExecutor(SerialExecutor):
    """Runs tasks here, some side by side: for small work that is not worth a cluster. Compiled kernels, BLAS and reads do not wait."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._libraries = ThreadpoolController()
        self._counting, self._inside = threading.Lock(), 0

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """See `Executor.submit_all`. BLAS takes one thread in each task: with several they wait for one another, and for all else.

        One task of much dense algebra is for `submit`, which leaves it all cores.
        """
        with self._one_thread_of_blas(), self._pool(name) as pool:
            handles = [pool.submit(recorded, name, function, *args) for args in arguments]
            try:
                done = []
                for handle in handles:
                    done.append(handle.result())
                    advance()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            return done

    def stream(
        self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], name: str, *, ahead: int | None = None,
        killed: Callable[..., Any] | None = None,
    ) -> Iterator[Any]:  # fmt: skip
        """See `Executor.stream`."""
        most = min(STREAMED * self._threads, ahead or STREAMED * self._threads)
        waiting: deque[Any] = deque()
        with self._one_thread_of_blas(), self._pool(name) as pool:
            try:
                for args in arguments:
                    waiting.append(pool.submit(recorded, name, function, *args))
                    if len(waiting) == most:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    @contextmanager
    def _one_thread_of_blas(self) -> Iterator[None]:
        """In the body BLAS takes one thread, everywhere in this process: from when the first comes in until the last has left."""
        with self._counting:
            self._inside += 1
            if self._inside == 1:
                self._limit = self._libraries.limit(limits=1, user_api="blas")
        try:
            yield
        finally:
            with self._counting:
                self._inside -= 1
                if not self._inside:
                    self._limit.restore_original_limits()

    def _pool(self, name: str) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._threads, thread_name_prefix=name)


@contextmanager
def executor_for(workers: int = 0, scheduler: str | None = None) -> Iterator[Executor]:
    """Threads of this process for no workers; a local cluster of so many processes, one BLAS thread each; or the cluster at an address.

    Settings of this process's memory stay as they are then: its threads share heaps, and with no workers beside they keep what is freed.

    Raises
    ------
    InputError
        When no scheduler answers at the address.
    """
    if scheduler is None and workers <= 0:
        keep_freed()
        with seldom_collected():
            yield ThreadExecutor(os.cpu_count() or 1)
        return
    share_heaps()
    import dask
    from distributed import Client

    from orchestration.dask_executor import SETTINGS, DaskExecutor

    if scheduler is not None:
        # what Dask logs of a lost scheduler, with tracebacks, is raised too
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        try:
            client = Client(scheduler, timeout="10s")
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {scheduler!r} ({error}); start one with 'dask scheduler'") from None
        with dask.config.set(SETTINGS), client, seldom_collected():
            yield DaskExecutor(client)
        return
    with dask.config.set(SETTINGS), local_cluster(workers) as (client, deserted):
        yield DaskExecutor(client, deserted)
