"""Where tasks run makes no difference; what is in flight is bounded; a scheduler at an address serves as well."""

from __future__ import annotations

import os
import signal
import threading
import time
import tracemalloc
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import dask
import distributed
import pytest
from distributed import Client, LocalCluster
from distributed.comm import inproc
from networks import SMALL, area_of, fuse
from threadpoolctl import threadpool_info, threadpool_limits

from orchestration import local_cluster
from orchestration.dask_executor import DaskExecutor
from orchestration.executors import STREAMED, SerialExecutor, ThreadExecutor, executor_for
from orchestration.read_ahead import batches_ahead
from submin.errors import ClusterError, InputError, KilledTaskError
from submin.simulation.region import simulate_region
from submin.storage.simulated import write_region


def double(value: int) -> int:
    return 2 * value


def nap(seconds: float) -> None:
    time.sleep(seconds)


def fail(value: int) -> int:
    raise InputError(f"value {value} is not wanted")


def fail_to_write(value: int) -> int:
    raise OSError(28, "No space left on device")


def kill_the_worker(value: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return value


def kill_for_three(value: int) -> int:
    return kill_the_worker(value) if value == 3 else double(value)


def kill_after_a_nap(value: int) -> int:
    time.sleep(0.5)
    return kill_the_worker(value)


def kill_for_two(value: int) -> int:
    return kill_the_worker(value) if value == 2 else double(value)


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=40) as started:
        yield started


def test_results_come_in_order_from_both(cluster: LocalCluster) -> None:
    with Client(cluster) as client:
        for executor in (SerialExecutor(), ThreadExecutor(2), DaskExecutor(client)):
            steps: list[int] = []
            first = executor.submit_all(double, [(k,) for k in range(20)], "double", lambda steps=steps: steps.append(1))
            again = executor.submit_all(double, [(handle,) for handle in first], "again", lambda: None)
            assert executor.results(again) == [4 * k for k in range(20)]
            assert len(steps) == 20


def test_what_tasks_took_is_told_once_by_their_names(cluster: LocalCluster) -> None:
    with Client(cluster) as client:
        for executor in (SerialExecutor(), ThreadExecutor(2), DaskExecutor(client)):
            executor.task_records()
            executor.submit_all(double, [(k,) for k in range(7)], "double", lambda: None)
            executor.submit_all(nap, [(0.05,), (0.1,)], "nap", lambda: None)
            records = executor.task_records()
            assert {name: records[name].tasks for name in records} == {"double": 7, "nap": 2}
            assert 0.1 <= records["nap"].longest < records["nap"].seconds
            assert records["nap"].seconds >= 0.15 and records["nap"].processor_seconds < 0.15
            assert records["double"].peak_memory_mb > 1.0
            assert executor.task_records() == {}


def test_threads_stop_at_an_error_and_say_it() -> None:
    begun: list[int] = []

    def some_fail(value: int) -> int:
        begun.append(value)
        time.sleep(0.02 * (value > 3))  # others are under way when the error is seen
        return fail(value) if value == 3 else double(value)

    with pytest.raises(InputError, match="value 3 is not wanted"):
        ThreadExecutor(1).submit_all(some_fail, [(k,) for k in range(100)], "some", lambda: None)
    assert begun[-1] < 99


def test_batches_come_in_order_one_ahead_and_errors_where_they_are() -> None:
    taken: list[int] = []

    def values() -> Iterator[int]:
        for value in range(10):
            taken.append(value)
            yield value
        raise InputError("the catalogue ends badly")

    found = []
    with pytest.raises(InputError, match="ends badly"):
        for batch in batches_ahead(values(), 4):
            found.append(batch)
            assert len(taken) <= 4 * (len(found) + 1)
    assert found == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert list(batches_ahead(iter(range(5)), 2)) == [[0, 1], [2, 3], [4]]
    assert list(batches_ahead([], 2)) == []


def test_whoever_stops_reading_does_not_wait_for_the_next_batch() -> None:
    taken: list[int] = []

    def values() -> Iterator[int]:
        for k in range(1000):
            taken.append(k)
            time.sleep(0.05 * (k >= 500))
            yield k

    def first_batch_only() -> None:
        for _ in batches_ahead(values(), 500):  # another one takes 25 s
            raise InputError("stopped")

    with pytest.raises(InputError, match="stopped"):
        first_batch_only()
    assert len(taken) < 510


def test_a_stream_comes_in_order_and_is_bounded(cluster: LocalCluster) -> None:
    with Client(cluster) as client:
        for executor, most in ((SerialExecutor(), 1), (ThreadExecutor(2), STREAMED * 2), (DaskExecutor(client), STREAMED * 2)):
            asked: list[int] = []
            for ahead in (None, 3):
                asked.clear()
                taken = []
                arguments = ((asked.append(k) or executor.share(k),) for k in range(40))
                for value in executor.stream(double, arguments, "stream", ahead=ahead):
                    taken.append(value)
                    assert len(asked) <= len(taken) - 1 + min(most, ahead or most)
                assert taken == [2 * k for k in range(40)]


def test_an_error_in_a_stream_is_the_callers(cluster: LocalCluster) -> None:
    with Client(cluster) as client:
        for executor in (SerialExecutor(), ThreadExecutor(2), DaskExecutor(client)):
            with pytest.raises(InputError, match="value 0 is not wanted"):
                list(executor.stream(fail, [(0,), (1,)], "fail"))


def test_what_tasks_were_given_is_not_kept() -> None:
    """Memory of the coordinator must not grow with the number of tasks: neither client nor scheduler may keep their messages."""
    count, size = 40, 200_000
    with executor_for(1) as executor:
        executor.submit_all(len, [(bytes(size),)], "warm up", lambda: None)
        tracemalloc.start()
        try:
            handles = executor.submit_all(len, [(bytes(size + k),) for k in range(count)], "length", lambda: None)
            assert executor.results(handles) == [size + k for k in range(count)]
            del handles
            executor.give_back()
            kept = tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()
    assert kept < 0.25 * count * size


def test_tasks_in_flight_are_bounded(cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch) -> None:
    with Client(cluster) as client:
        executor = DaskExecutor(client)
        submitted: list[Any] = []
        most = 0
        plain = client.submit

        def counted(*args: Any, **kwargs: Any) -> Any:
            nonlocal most
            future = plain(*args, **kwargs)
            submitted.append(future)
            most = max(most, sum(f.status == "pending" for f in submitted))
            return future

        monkeypatch.setattr(client, "submit", counted)
        executor.submit_all(double, [(k,) for k in range(60)], "double", lambda: None)
        assert len(submitted) == 60
        assert most <= 3 * executor.workers


def test_an_error_of_a_task_is_the_callers(cluster: LocalCluster) -> None:
    with Client(cluster) as client, pytest.raises(InputError, match="value 0 is not wanted"):
        DaskExecutor(client).submit_all(fail, [(0,)], "fail", lambda: None)


def test_a_run_on_a_scheduler_at_an_address(cluster: LocalCluster, tmp_path: Path) -> None:
    region = simulate_region(SMALL)
    write_region(region, tmp_path / "catalogue")
    with executor_for(scheduler=cluster.scheduler_address) as executor:
        assert executor.workers == 2
        assert fuse(tmp_path / "catalogue", tmp_path / "network", area_of(region), executor=executor).fused == 12


def test_no_scheduler_at_the_address_is_said() -> None:
    with pytest.raises(InputError, match="no Dask scheduler answers at"), executor_for(scheduler="tcp://127.0.0.1:9"):
        pass


def test_what_killed_workers_held_is_computed_again() -> None:
    """Shared values and results of tasks, after every worker has been killed at once."""
    with executor_for(2) as executor:
        shared = executor.share(21)
        doubled = executor.submit_all(double, [(shared,)], "double", lambda: None)
        workers = set(executor.client.run(os.getpid).values())  # type: ignore[attr-defined]
        assert len(workers) == 2
        for pid in workers:
            os.kill(pid, signal.SIGKILL)
        assert executor.results(executor.submit_all(double, [(doubled[0],), (shared,)], "again", lambda: None)) == [84, 42]
        assert executor.results([shared]) == [21]
        assert not workers & set(executor.client.run(os.getpid).values())  # type: ignore[attr-defined]


def test_workers_that_do_not_come_again_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[LocalCluster] = []
    monkeypatch.setattr(local_cluster, "GIVEN_UP", 0.5)
    monkeypatch.setattr(distributed, "LocalCluster", lambda **options: started.append(LocalCluster(**options)) or started[0])
    with executor_for(2) as executor:
        (cluster,) = started
        closing = threading.Timer(1.0, lambda: [cluster.sync(nanny.close) for nanny in cluster.workers.values()])
        closing.start()
        with pytest.raises(ClusterError, match="all workers were lost and did not come again.*give the same command again"):
            executor.submit_all(nap, [(60.0,), (60.0,)], "nap", lambda: None)
        closing.join()


def test_a_task_that_kills_its_workers_is_named() -> None:
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        executor_for(1) as executor,
        pytest.raises(ClusterError, match=r"2 workers that ran the same task \(update-tile\) were killed.*fewer workers") as said,
    ):
        executor.submit_all(kill_the_worker, [(1,)], "update-tile", lambda: None)
    assert "\n" not in str(said.value)


def test_past_a_task_that_kills_its_workers() -> None:
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}), executor_for(1) as executor:
        (killed,) = executor.attempt_all(kill_the_worker, [(1,)], "adjust", lambda: None)
        assert isinstance(killed, KilledTaskError)
        assert (killed.task, killed.workers) == ("adjust", 2)
        steps: list[int] = []
        outcomes = executor.attempt_all(kill_for_three, [(k,) for k in range(5)], "adjust", lambda: steps.append(1))
        assert isinstance(outcomes[3], KilledTaskError)
        # one that waited on the worker of another may be blamed too
        assert all(outcome == 2 * k or isinstance(outcome, KilledTaskError) for k, outcome in enumerate(outcomes))
        assert outcomes[0] == 0
        assert len(steps) == 5
        with pytest.raises(InputError, match="value 0 is not wanted"):
            executor.attempt_all(fail, [(0,)], "fail", lambda: None)


def test_a_stream_goes_on_past_killed_workers() -> None:
    """A task may have waited on the worker of another one that kills: its value is found here, where that is asked for."""
    with dask.config.set({"distributed.scheduler.allowed-failures": 1}), executor_for(1) as executor:
        values = executor.stream(kill_for_two, ((k,) for k in range(6)), "stream", killed=double)
        assert list(values) == [0, 2, 4, 6, 8, 10]
        with pytest.raises(KilledTaskError, match=r"2 workers that ran the same task \(stream\)"):
            list(executor.stream(kill_the_worker, [(1,)], "stream"))


def test_tasks_beside_a_stream_that_kills_their_worker_are_done() -> None:
    """They wait on the worker that a task of the stream kills until it is given up, are blamed as often, and get another start."""
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), executor_for(1) as executor:
        values = executor.stream(kill_after_a_nap, ((k,) for k in range(2)), "stream", killed=double)
        with ThreadPoolExecutor(1) as beside:
            first = beside.submit(next, values)
            time.sleep(0.1)  # the stream's task runs when the others come
            handles = executor.submit_all(double, [(k,) for k in range(3)], "beside", lambda: None)
            assert executor.results(handles) == [0, 2, 4]
            assert first.result() == 0
        assert list(values) == [2]


def test_a_local_cluster_needs_no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dask asks the system for the way to the outside before it listens inside this process, and warns where there is none."""

    def nowhere() -> str:
        warnings.warn("no way out", RuntimeWarning, stacklevel=1)
        return "127.0.0.1"

    monkeypatch.setattr(inproc.global_manager, "_ip", None)
    monkeypatch.setattr(inproc, "get_ip", nowhere)
    with executor_for(1) as executor:
        assert executor.results(executor.submit_all(double, [(4,)], "double", lambda: None)) == [8]
        assert executor.client.scheduler.address.startswith("inproc://127.0.0.1/")  # type: ignore[attr-defined]


def test_an_input_or_output_error_of_a_task_is_no_lost_scheduler(cluster: LocalCluster) -> None:
    with Client(cluster) as client, pytest.raises(OSError, match="No space left"):
        DaskExecutor(client).submit_all(fail_to_write, [(1,)], "fail", lambda: None)


def test_tasks_here_share_the_cores_with_no_threads_of_blas() -> None:
    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"), executor_for(0) as executor:
        assert threads() == {2}
        seen = executor.submit_all(threads, [(), ()], "look", lambda: None)
        assert executor.results(seen) == [{1}, {1}]
        alone = executor.submit_all(threads, [()], "look", lambda: None)
        assert executor.results(alone) == [{1}]
        assert list(executor.stream(threads, [(), ()], "look")) == [{1}, {1}]
        beside = executor.stream(threads, [()] * 20, "look")
        assert next(beside) == {1}
        assert executor.results(executor.submit_all(threads, [()], "look", lambda: None)) == [{1}]
        assert list(beside) == [{1}] * 19  # also once the others have ended
        assert executor.results([executor.submit(threads, (), "look")]) == [{2}]
        assert threads() == {2}
