"""Where tasks run: here, one after another, or on a Dask cluster. The same tasks, the same results."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from threadpoolctl import ThreadpoolController

from orchestration.local_cluster import Deserted, local_cluster
from orchestration.memory import give_back, keep_freed, own_peak_memory_mb, seldom_collected, share_heaps
from orchestration.task_record import TaskRecord, added, recorded, taken_notes
from submin.errors import ClusterError, InputError, KilledTaskError

SETTINGS = {
    # Dask would warn at 10 MB and ask to scatter; `DaskExecutor.share` says why not
    "distributed.admin.large-graph-warning-threshold": "1GB",
    # for those who look for faults Dask keeps the last thousand messages to and from the scheduler: with them what tasks were given
    "distributed.admin.low-level-log-length": 1,
}
STREAMED = 4
"""Results of a stream that a worker may be ahead of whoever takes them."""
BESIDE = -1
"""Priority of a stream's tasks: what a worker does when it would wait."""
Advance = Callable[[], None]
T = TypeVar("T")


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


class DaskExecutor:
    """Runs tasks on a Dask cluster, at most three a worker in flight, so that memory does not grow with the number of tasks.

    Every handle is the result of a task: what a lost worker held is computed again.
    """

    def __init__(self, client: Any, deserted: Deserted | None = None) -> None:
        """``deserted`` tells of workers of this machine, where they are, whether all are gone for good."""
        self.client = client
        self._deserted, self.beside = deserted, deserted is not None
        self.workers = max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
        self._address = client.scheduler.address
        self._streams, self._second_starts = 0, set[str]()

    def share(self, value: Any) -> Any:
        """See `Executor.share`. A task, since scattered values are gone for good with the workers that hold them."""
        return self.submit_all(_same, [(value,)], "share", lambda: None)[0]

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """See `Executor.submit_all`."""
        return self._run(function, arguments, name, advance, past_kills=False)

    def attempt_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        """See `Executor.attempt_all`."""
        handles = self._run(function, arguments, name, advance, past_kills=True)
        try:
            return self.results(handles)
        except KilledTaskError:
            return [self._attempt(handle) for handle in handles]

    def _run(
        self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance, *, past_kills: bool
    ) -> list[Any]:
        """Handles of all tasks, done; of those that killed their workers too where the run goes past them."""
        from distributed import KilledWorker, as_completed

        waiting = iter(range(len(arguments)))
        handles: list[Any] = [None] * len(arguments)
        beside = self._streams > 0
        again: set[int] = set()

        def submit_next() -> Any:
            k = next(waiting, None)
            if k is None:
                return None
            handles[k] = self._start(function, arguments[k], name)
            # a loss from here on cancels the handle; one before it is seen here, and nowhere else
            self._check_scheduler()
            return handles[k]

        def started_again(killed: Any) -> Any:
            """A task of a stream on the same worker may be to blame, which then has had its last try, too."""
            k = handles.index(killed)
            if not (beside or self._streams) or k in again:
                return None
            again.add(k)
            handles[k] = self._start(function, arguments[k], name)
            self._second_starts.add(handles[k].key)
            return handles[k]

        try:
            with self._losses_said():
                running: Any = as_completed([f for f in (submit_next() for _ in range(3 * self.workers)) if f is not None])
                for future in running:
                    killed = future.status == "error" and isinstance(future.exception(), KilledWorker)
                    if killed and (second := started_again(future)) is not None:
                        running.add(second)
                        continue
                    if future.status != "finished" and not (past_kills and killed):
                        _raise_error_of(future)
                    advance()
                    following = submit_next()
                    if following is not None:
                        running.add(following)
        except BaseException:
            for handle in handles:  # what waits at the workers need not be done
                if handle is not None:
                    handle.release()
            raise
        return handles

    def submit(self, function: Callable[..., Any], arguments: tuple[Any, ...], name: str) -> Any:
        """See `Executor.submit`."""
        with self._losses_said():
            return self._start(function, arguments, name)

    def _start(self, function: Callable[..., Any], arguments: tuple[Any, ...], name: str, priority: int = 0) -> Any:
        key = f"{name}-{os.urandom(6).hex()}"
        return self.client.submit(recorded, name, function, *arguments, pure=False, key=key, priority=priority)

    def wait(self, handles: Sequence[Any], advance: Advance) -> None:
        """See `Executor.wait`."""
        from distributed import as_completed

        with self._losses_said():
            self._check_scheduler()
            for future in as_completed(handles):
                if future.status != "finished":
                    _raise_error_of(future)
                advance()

    def stream(
        self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], name: str, *, ahead: int | None = None,
        killed: Callable[..., Any] | None = None,
    ) -> Iterator[Any]:  # fmt: skip
        """See `Executor.stream`."""
        from distributed import KilledWorker

        def value(handle: Any, args: tuple[Any, ...]) -> Any:
            try:
                return handle.result()
            except KilledWorker:
                if killed is None:
                    raise
                return recorded(name, killed, *args)

        most = min(STREAMED * self.workers, ahead or STREAMED * self.workers)
        waiting: deque[tuple[Any, tuple[Any, ...]]] = deque()
        with self._losses_said(), self._streaming():
            for args in arguments:
                waiting.append((self._start(function, args, name, priority=BESIDE), args))
                self._check_scheduler()
                if len(waiting) == most:
                    yield value(*waiting.popleft())
            while waiting:
                yield value(*waiting.popleft())

    @contextmanager
    def _streaming(self) -> Iterator[None]:
        self._streams += 1
        try:
            yield
        finally:
            self._streams -= 1

    def _attempt(self, handle: Any) -> Any:
        try:
            return self.results([handle])[0]
        except KilledTaskError as error:
            return error

    def results(self, handles: Sequence[Any]) -> list[Any]:
        """See `Executor.results`."""
        with self._losses_said():
            return list(self.client.gather(list(handles)))

    def give_back(self) -> None:
        """See `Executor.give_back`."""
        give_back()
        with self._losses_said():
            self._check_scheduler()
            self.client.run(give_back, on_error="ignore")

    def peak_memory_mb(self) -> float:
        """See `Executor.peak_memory_mb`."""
        with self._losses_said():
            self._check_scheduler()
            return own_peak_memory_mb() + float(sum(self.client.run(own_peak_memory_mb, on_error="ignore").values()))

    def task_records(self) -> dict[str, TaskRecord]:
        """See `Executor.task_records`."""
        with self._losses_said():
            self._check_scheduler()
            return added(self.client.run(taken_notes, on_error="ignore").values())

    @contextmanager
    def _losses_said(self) -> Iterator[None]:
        """What Dask raises when processes are lost, as one error that says it. Errors of tasks pass."""
        from distributed import KilledWorker
        from distributed.client import ClosedClientError
        from distributed.comm.core import CommClosedError

        try:
            yield
        except KilledWorker as error:
            workers = (error.allowed_failures + 1) * (2 if error.task in self._second_starts else 1)
            raise KilledTaskError(str(error.task).rpartition("-")[0], workers) from None
        except (CancelledError, CommClosedError, ClosedClientError):
            raise self._lost() from None
        except OSError:
            self._check_scheduler()  # a connection that could not be made
            raise

    def _check_scheduler(self) -> None:
        if self.client.status != "running":
            raise self._lost()

    def _lost(self) -> ClusterError:
        if self._deserted is not None and self._deserted.is_set():
            return ClusterError(
                "all workers were lost and did not come again, as when a machine has run out of memory",
                "end what else runs there, or take smaller batches, and give the same command again",
            )
        return ClusterError(f"the Dask scheduler at {self._address} was lost", "start a cluster and give the same command again")


def _raise_error_of(future: Any) -> None:
    """Raise here what a task has raised. One that was cancelled is not asked: its client may be closing, and would never answer."""
    if future.status == "cancelled":
        raise CancelledError(future.key)
    future.result()


def _same(value: T) -> T:
    return value


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
