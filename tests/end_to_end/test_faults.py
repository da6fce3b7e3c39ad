"""Processes that are killed or stopped, two coordinators: the network stays whole, one message says what to do, and it can be done."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path

import crashing_block
import icechunk
import numpy as np
import psutil
import pytest
import shapely
from networks import rewrite, same_network

from benchmarks.fault_scene import EVERYWHERE, Content, Scene, make_scene
from benchmarks.faults import IN_COMMIT, IN_STAGE, KINDS, Moment, TooLate, after, after_commit, begun, in_commit, trial, undisturbed_run
from benchmarks.started import cluster, free_port, submin_command, wait_until
from orchestration.batch import KILLED
from orchestration.create import create
from orchestration.executors import SerialExecutor, executor_for
from orchestration.progress import Silent
from orchestration.reconcile import reconcile
from orchestration.run import run
from submin.errors import BusyError, ClusterError, ConflictError, StoreError
from submin.storage.catalogue import Catalogue
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import LOCK_FILE, writing

SEED = 20260601


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("faults"), 80.0, 2, 2)


@pytest.fixture(scope="module")
def undisturbed(scene: Scene) -> tuple[Content, float]:
    return undisturbed_run(scene)


@pytest.mark.parametrize(
    ("kind", "moment"),
    [
        *((kind, after_commit(1)) for kind in ("one worker", "all workers", "coordinator", "scheduler", IN_STAGE + "update-tile")),
        (IN_STAGE + "distribute-tile", after_commit(1)), (IN_COMMIT, in_commit(1, 0.0)),
    ],
)  # fmt: skip
def test_a_killed_process_changes_nothing(scene: Scene, undisturbed: tuple[Content, float], kind: str, moment: Moment) -> None:
    """Killed when the first of three batches is committed, or later. The trial checks the network, the messages, orphans and the reader."""
    assert kind in KINDS
    done = trial(scene, undisturbed[0], kind, moment, kind.replace(" ", "-"), random.Random(SEED))
    assert done.faults == ()
    assert done.version in (("v3",) if "distribute" in kind else ("v1", "v2"))  # the fourth reconciles what the third has completed
    assert done.readings.answers > 5
    assert len(done.readings.versions) >= 2  # it did read while versions were written


def test_a_coordinator_killed_at_a_random_moment(scene: Scene, undisturbed: tuple[Content, float]) -> None:
    moment, done = random.SystemRandom().uniform(0.0, 0.8 * undisturbed[1]), None
    while done is None:
        try:
            done = trial(scene, undisturbed[0], "coordinator", after(moment), f"random-{moment:.3f}", random.Random(SEED))
        except TooLate:  # the machine is faster than it was when nothing disturbed the run
            moment *= 0.5
    assert done.faults == (), f"killed after {moment:.3f} s"


@pytest.mark.parametrize(("number", "code", "name"), [(signal.SIGINT, 130, "Ctrl-C"), (signal.SIGTERM, 143, "SIGTERM")])
def test_a_stopped_run_says_how_to_go_on(
    scene: Scene, undisturbed: tuple[Content, float], number: signal.Signals, code: int, name: str
) -> None:
    network = scene.network(name)
    with scene.run(network, f"{name}-first") as command:
        after_commit(1)(command, network)
        workers = command.workers()
        assert len(workers) == 2
        if number == signal.SIGINT:
            os.killpg(command.process.pid, number)  # a terminal's Ctrl-C goes to workers too
        else:
            command.process.send_signal(number)
        assert command.wait(15) == code
        _, alive = psutil.wait_procs(workers, timeout=5)
        assert alive == []
        version = Snapshot.open(str(network)).version
        message = f"stopped by {name}; everything committed stays ({network} is at {version}); give the same command again to continue"
        assert command.err == f"submin: {message}\n"
        assert json.loads(command.out) == {"error": message}
    with scene.run(network, f"{name}-again", "--workers", 0) as again:
        assert again.wait() == 0, again.err
    assert undisturbed[0].faults(Content.of(network)) == []


@pytest.mark.parametrize("doing", ["adjustment", "test by the network"])
def test_a_block_that_crashes_its_worker_each_time_is_rejected(
    doing: str, scene: Scene, undisturbed: tuple[Content, float], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The fourth of six, in the second batch, where it shares its task with the third. Once it crashes no more it comes in."""
    blocks = list(Catalogue.open(scene.catalogue).blocks())
    bad = blocks[3].block_id
    name = f"crash-{doing.replace(' ', '-')}"
    network = scene.network(name)
    with monkeypatch.context() as environment:
        environment.setenv(crashing_block.CRASHES, bad)
        environment.setenv(crashing_block.DOING, doing)
        environment.setenv("DASK_DISTRIBUTED__WORKER__PRELOAD", crashing_block.__file__)
        environment.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "1")
        with scene.run(network, name) as command:
            assert command.wait() == 1, command.err
            assert command.err == ""
            said = json.loads(command.out)
    reason = f"its {doing} {KILLED}"
    assert said["blocks_fused"] == 5
    assert said["blocks_rejected"] == [{"block_id": bad, "reason": reason}]
    lines = Snapshot.open(str(network)).ledger(["block_id", "status", "reason"])
    assert [tuple(str(lines[name][k]) for name in lines) for k in np.flatnonzero(lines["block_id"] == bad)] == [(bad, "rejected", reason)]
    without = scene.network(f"{name}-without")
    run(Catalogue.open(rewrite(scene.catalogue, tmp_path / "without", blocks[:3] + blocks[4:])), str(without), SerialExecutor())
    reconcile(str(without), SerialExecutor())
    same_network(network, without)
    with scene.run(network, f"{name}-no-more", "--workers", 0) as command:
        assert command.wait() == 0, command.err
    assert undisturbed[0].faults(Content.of(network)) == ["another ledger"]  # with the rejection
    same_network(network, scene.folder / "undisturbed")


def test_ctrl_c_while_the_program_loads_is_one_line_too(scene: Scene) -> None:
    network = scene.network("early")
    with scene.run(network, "early") as command:
        # numpy is the first large library that comes
        wait_until(lambda: any("numpy" in part.path for part in psutil.Process(command.process.pid).memory_maps()), command)
        os.killpg(command.process.pid, signal.SIGINT)
        assert command.wait(15) == 130
        assert command.err.startswith("submin: stopped by Ctrl-C")
        assert command.err.count("\n") == 1


def test_one_coordinator_at_a_time(scene: Scene) -> None:
    """The second is refused at once; a lock whose holder is killed is gone."""
    network = scene.network("two")
    with scene.run(network, "two-first", "--workers", 0) as first:
        wait_until(lambda: begun(network), first)
        first.process.send_signal(signal.SIGSTOP)  # so that it cannot end before the second comes
        with scene.run(network, "two-second", "--workers", 0) as second:
            assert second.wait(20) == 2
            for said in (f"process {first.process.pid} on ", "since 20", "is writing to this network; wait until it ends, or stop it"):
                assert said in second.err
            assert second.err.count("\n") == 1
            assert "is writing to this network" in json.loads(second.out)["error"]
        with pytest.raises(BusyError), writing(str(network)):
            pass
        before = Snapshot.open(str(network)).version
        first.process.kill()
        first.wait()
    with writing(str(network)), pytest.raises(BusyError, match=f"process {os.getpid()} on"), writing(str(network)):
        pass
    assert Snapshot.open(str(network)).version == before


def test_without_the_lock_the_commit_decides(
    scene: Scene, undisturbed: tuple[Content, float], monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """As on object stores: another run commits while the first is at work, and nothing of the first one's batch comes in."""
    monkeypatch.setattr("orchestration.run.writing", lambda place: nullcontext())
    network, catalogue = str(scene.network("conflict")), Catalogue.open(scene.catalogue)

    class AnotherRun(Silent):
        def stage(self, name, total):  # type: ignore[no-untyped-def]
            if name == "factoring tiles" and Snapshot.open(network).number == 0:
                assert run(catalogue, network, SerialExecutor()).fused == 6
            return super().stage(name, total)

    with pytest.raises(ConflictError, match="nothing of this batch was written"):
        run(catalogue, network, SerialExecutor(), batch_blocks=2, reporter=AnotherRun())
    assert Snapshot.open(network).version == "v1"
    reconcile(network, SerialExecutor())
    assert undisturbed[0].faults(Content.of(Path(network))) == []
    assert run(catalogue, network, SerialExecutor()).fused == 0


def test_a_lost_scheduler_is_said_whatever_is_asked_next(scene: Scene) -> None:
    """Also long after the loss, when the client has given up: Dask itself would wait for ever then."""
    port = free_port()
    with (
        cluster(scene.folder, scene.workers, "lost", port) as (scheduler, _),
        executor_for(scheduler=f"tcp://127.0.0.1:{port}") as executor,
    ):
        client = executor.client  # type: ignore[attr-defined]
        client._timeout = 1.0  # the seconds for which it tries to connect again
        handle = executor.share(3)
        assert executor.results([handle]) == [3]
        scheduler.process.kill()
        for status in ("connecting", "closed"):
            end = time.monotonic() + 15
            while client.status != status and time.monotonic() < end:
                time.sleep(0.005)
            assert client.status == status
            for ask in (
                lambda: executor.share(4), lambda: executor.results([handle]), executor.peak_memory_mb,
                lambda: executor.submit_all(abs, [(handle,)], "abs", lambda: None),
            ):  # fmt: skip
                with pytest.raises(ClusterError, match=f"the Dask scheduler at tcp://127.0.0.1:{port} was lost; start a cluster"):
                    ask()


def test_a_store_that_lost_a_file_is_one_line(scene: Scene, undisturbed: tuple[Content, float], tmp_path: Path) -> None:
    network = Path(shutil.copytree(scene.folder / "undisturbed", tmp_path / "network"))
    for chunk in (network / "chunks").iterdir():
        chunk.unlink()
    with submin_command("query", network, "--bbox", *EVERYWHERE, log=tmp_path / "query") as command:
        assert command.wait() == 2
        assert command.err.startswith("submin: the network cannot be read (")
        assert command.err.endswith("); where its store answers, 'submin verify' tells what of it is damaged\n")
        assert command.err.count("\n") == 1


def test_the_lock_file_is_no_network_and_disturbs_none(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for place in (tmp_path / "folder", tmp_path / "nowhere"):
        with pytest.raises(StoreError, match="network"), writing(str(place)):
            pass
    assert list(tmp_path.rglob("*")) == [tmp_path / "folder"]
    (tmp_path / "folder" / LOCK_FILE).touch()
    with pytest.raises(StoreError, match="not a network"):
        Snapshot.open(str(tmp_path / "folder"))

    network = scene.network("locked")
    with writing(str(network)):
        storage = icechunk.local_filesystem_storage(str(network))
        icechunk.Repository.open(storage).garbage_collect(datetime.now(UTC))
        assert Snapshot.open(str(network)).version == "v0"
        assert json.loads((network / LOCK_FILE).read_bytes())["pid"] == os.getpid()
    assert (network / LOCK_FILE).read_bytes() == b""  # nobody's
    with pytest.raises(StoreError, match="already exists"):
        create(str(network), shapely.box(99.0, 34.0, 100.0, 35.0), Catalogue.open(scene.catalogue).metadata, 60.0, 20.0)
