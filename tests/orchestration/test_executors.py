"""Where tasks run makes no difference; what is in flight is bounded; a scheduler at an address serves as well."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from distributed import Client, LocalCluster
from networks import SMALL, area_of, fuse

from orchestration.executors import DaskExecutor, SerialExecutor, executor_for
from submin.errors import InputError
from submin.simulation.region import simulate_region
from submin.storage.simulated import write_region


def double(value: int) -> int:
    return 2 * value


def fail(value: int) -> int:
    raise InputError(f"value {value} is not wanted")


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=40) as started:
        yield started


def test_results_come_in_order_from_both(cluster: LocalCluster) -> None:
    with Client(cluster) as client:
        for executor in (SerialExecutor(), DaskExecutor(client)):
            steps: list[int] = []
            first = executor.submit_all(double, [(k,) for k in range(20)], "double", lambda steps=steps: steps.append(1))
            again = executor.submit_all(double, [(handle,) for handle in first], "again", lambda: None)
            assert executor.results(again) == [4 * k for k in range(20)]
            assert len(steps) == 20


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
