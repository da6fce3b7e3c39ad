"""Tasks on a Dask cluster: a bounded number in flight, started again where workers are lost."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import Any, TypeVar

from orchestration.executors import STREAMED, Advance
from orchestration.local_cluster import Deserted
from orchestration.memory import give_back, own_peak_memory_mb
from orchestration.task_record import TaskRecord, added, recorded, taken_notes
from submin.errors import ClusterError, KilledTaskError

SETTINGS = {
    # Dask would warn at 10 MB and ask to scatter; `DaskExecutor.share` says why not
    "distributed.admin.large-graph-warning-threshold": "1GB",
    # for those who look for faults Dask keeps the last thousand messages to and from the scheduler: with them what tasks were given
    "distributed.admin.low-level-log-length": 1,
}
BESIDE = -1
"""Priority of a stream's tasks: what a worker does when it would wait."""
T = TypeVar("T")


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
