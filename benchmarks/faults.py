"""Faults: processes of a run are killed at random moments, and the same command is given again.

Every time the network must be that of an undisturbed run, and a reader that queries all the time must see whole versions only. The tests
use the same trials with fewer kills (``tests/end_to_end/test_faults.py``). Linux only, as it looks up processes.
"""

from __future__ import annotations

import json
import os
import random
import secrets
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]
from rich.console import Console

from benchmarks.fault_scene import Content, Scene, make_scene
from benchmarks.reader import Reader, Readings
from benchmarks.record import write_record
from benchmarks.started import Command, cluster, free_port, wait_until
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import LOCK_FILE

LONGEST_COMMIT = 0.02
"""Seconds that a small commit takes at most, from the first list of what it holds to the new version."""
IDENTICAL = "identical"
"""Verdict on a trial without faults."""
STAGES = ("adjust", "update-tile", "factor-tile", "collect-tile", "distribute-tile")
"""Tasks of a run, by the names that the cluster gives them."""
IN_STAGE, IN_COMMIT, AFTER_COMMIT = "worker in ", "coordinator in a commit", "coordinator after a commit"
KINDS = ("one worker", "all workers", *(IN_STAGE + stage for stage in STAGES), "coordinator", IN_COMMIT, AFTER_COMMIT, "scheduler")
"""What is killed. At the moment given, but in a stage the worker that is next busy with a task of it.

Runs whose scheduler is killed, whose worker is killed in a stage, or whose coordinator is killed at a commit, are on a cluster of processes
that were started by Dask's own commands; the others on a local one.
"""
Moment = Callable[["Command", Path], None]
"""Waits until it is time to kill; it is given the running command and its network."""


@dataclass(frozen=True)
class Standing:
    """What serves one trial after the other: the address of a cluster's scheduler, if there is one, and a reader."""

    address: str
    reader: Reader


@dataclass(frozen=True)
class Trial:
    """One kill and what came of it.

    Attributes
    ----------
    kind : of `KINDS`
    moment : seconds after the run had begun; version : of the network just after the kill; seconds : from the kill to the complete network
    coordinates, covariance : differences from the undisturbed network, see `Content.differences`
    readings : of the reader; faults : everything that was not as it must be, those of the reader included
    """

    kind: str
    moment: float
    version: str
    seconds: float
    coordinates: float
    covariance: float
    readings: Readings
    faults: tuple[str, ...]

    def to_row(self) -> dict[str, Any]:
        """A line of the table."""
        return {
            "killed": self.kind, "after_s": self.moment, "found": self.version, "to_end_s": self.seconds,
            "coordinates_sigma": self.coordinates, "covariance": self.covariance,
            "answers": self.readings.answers, "versions_read": len(self.readings.versions),
            "verdict": "; ".join(self.faults) or IDENTICAL,
        }  # fmt: skip


class TooLate(Exception):
    """The run had ended before the moment of the kill."""


def trial(
    scene: Scene, undisturbed: Content, kind: str, moment: Moment, name: str, rng: random.Random, standing: Standing | None = None
) -> Trial:  # fmt: skip
    """Kill processes of a run, give the same command again, and compare.

    Raises
    ------
    TooLate
        When the run has ended before the moment.
    """
    network, faults = scene.network(name), []
    with ExitStack() as stack:
        read = stack.enter_context((standing.reader if standing else stack.enter_context(Reader())).reading(network))
        where: tuple[object, ...] = ()
        if outside := scene.workers > 0 and (kind in ("scheduler", IN_COMMIT, AFTER_COMMIT) or kind.startswith(IN_STAGE)):
            if standing is not None and standing.address and kind != "scheduler":
                address = standing.address
            else:
                port = free_port()
                address = f"tcp://127.0.0.1:{port}"
                scheduler, _ = stack.enter_context(cluster(scene.folder, scene.workers, name, port))
            where = ("--scheduler", address)
        # connected before the run begins: the first tasks of some stages are over soon
        next_busy = stack.enter_context(busy_workers(str(where[1]), kind.removeprefix(IN_STAGE))) if kind.startswith(IN_STAGE) else None
        first = stack.enter_context(scene.run(network, f"{name}-first", *where))
        wait_until(lambda: begun(network), first)
        began = time.monotonic()
        moment(first, network)
        busy = next_busy(first) if next_busy else None
        if first.process.poll() is not None:
            raise TooLate
        workers = [] if outside else first.workers()
        passed = time.monotonic() - began
        if kind.startswith("coordinator"):
            first.process.kill()
        elif kind == "scheduler":
            scheduler.process.kill()
        elif busy is not None:
            os.kill(busy, signal.SIGKILL)
        else:
            for worker in workers if kind == "all workers" else [rng.choice(workers)]:
                worker.kill()
        killed = time.monotonic()
        found = Snapshot.open(str(network))
        complete = len(found.ledger(["block_id"])["block_id"]) == len(undisturbed.ledger)
        code = first.wait()
        if kind.startswith("coordinator"):
            _, alive = psutil.wait_procs(workers, timeout=10)
            if alive:
                faults.append(f"{len(alive)} workers outlived their coordinator")
        elif kind == "scheduler":
            lines = first.err.splitlines()
            said = len(lines) == 1 and "was lost; everything committed stays" in lines[0]
            # a run that needed its scheduler no more ends as ever
            if not (code == 2 and said) and not (code == 0 and not lines and complete):
                faults.append(f"exit code {code} without its scheduler: {first.err}")
            scheduler.wait()
            stack.enter_context(cluster(scene.folder, scene.workers, f"{name}-again", port))
        elif code != 0 or first.err:
            faults.append(f"exit code {code} without its workers: {first.err}")
        else:
            seconds = time.monotonic() - killed
        again = stack.enter_context(scene.run(network, f"{name}-again", *where))
        code = again.wait()
        if kind == "scheduler" or kind.startswith("coordinator"):
            seconds = time.monotonic() - killed
        if code != 0 or again.err:
            faults.append(f"the same command again: exit code {code}: {again.err}")
        elif "worker" in kind and json.loads(again.out)["blocks_fused"]:
            faults.append("the run had ended before it was complete")
        readings = read()
    content = Content.of(network)
    coordinates, covariance = undisturbed.differences(content)
    faults += undisturbed.faults(content) + [f"reader: {fault}" for fault in readings.faults]
    shutil.rmtree(network)
    return Trial(kind, passed, found.version, seconds, coordinates, covariance, readings, tuple(faults))


@contextmanager
def busy_workers(address: str, stage: str) -> Iterator[Callable[[Command], int]]:
    """Gives the process of the worker that is next busy with a task of a stage; waits for one.

    It raises `TooLate` when the command ends before.
    """
    from distributed import Client

    with Client(address, timeout="60s") as client:
        processes = client.run(os.getpid)

        def next_busy(command: Command) -> int:
            while command.process.poll() is None:
                for worker, keys in client.processing().items():
                    if any(str(key).startswith(f"{stage}-") for key in keys):
                        # one that was killed in the trial before may have come again since
                        return int((processes if worker in processes else client.run(os.getpid))[worker])
                time.sleep(0.001)
            raise TooLate

        yield next_busy


def begun(network: Path) -> bool:
    """True from the moment when a run has taken the network's lock."""
    lock = network / LOCK_FILE
    return lock.exists() and lock.stat().st_size > 0


def after_commit(number: int) -> Moment:
    """The moment when a version is there."""

    def wait(command: Command, network: Path) -> None:
        seen = 0

        def there() -> bool:
            nonlocal seen
            last, seen = seen, (network / "refs" / "branch.main" / "ref.json").stat().st_mtime_ns
            return seen != last and Snapshot.open(str(network)).number >= number

        wait_until(there, command)

    return wait


def in_commit(number: int, seconds: float) -> Moment:
    """So many seconds after the commit of the version after this one has begun: it lists what was written before it names the version."""

    def wait(command: Command, network: Path) -> None:
        after_commit(number)(command, network)
        before = lists(network)
        while lists(network) == before and command.process.poll() is None:
            pass
        time.sleep(seconds)

    def lists(network: Path) -> int:
        return sum(1 for _ in (network / "manifests").glob("*"))

    return wait


def undisturbed_run(scene: Scene) -> tuple[Content, float]:
    """The network that every trial must leave, and the seconds of its run, with a reader as in the trials."""
    network = scene.network("undisturbed")
    with Reader() as reader, reader.reading(network) as read, scene.run(network, "undisturbed-run") as command:
        if command.wait() != 0:
            raise RuntimeError(command.err)
        seconds = float(json.loads(command.out)["seconds"])
        if faults := read().faults:
            raise RuntimeError(f"the reader of an undisturbed run: {faults}")
    return Content.of(network), seconds


def after(seconds: float) -> Moment:
    """So many seconds after the run has begun."""
    return lambda command, network: time.sleep(seconds)


def drawn(kind: str, batches: int, seconds: float, rng: random.Random) -> Moment:
    """A random moment of a run of so many batches that suits what is killed; one that is counted in seconds is before ``seconds``."""
    if kind == IN_COMMIT:
        return in_commit(rng.randrange(batches), rng.uniform(0.0, LONGEST_COMMIT))
    if kind == AFTER_COMMIT:
        return after_commit(rng.randint(1, batches - 1))
    return after(rng.uniform(0.0, seconds))


def measure(scale: float, workers: int, kills: int = 30, seed: int | None = None, out: Path | None = None) -> list[dict[str, Any]]:
    """Rows of kill, moment, what was found, and the differences; at scale 1 the region is 120 km x 120 km, 12 blocks in 6 batches.

    Kinds of kills come in turn. Without workers runs are of one process, the coordinator, and that is killed. ``out``: folder for
    ``faults.json``.
    """
    seed = secrets.randbelow(1_000_000) if seed is None else seed
    rng, say = random.Random(seed), Console(stderr=True, highlight=False)
    say.print(f"moments drawn with --seed {seed}")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        scene = make_scene(Path(folder), 120.0 * scale**0.5, 2, workers)
        undisturbed, seconds = undisturbed_run(scene)
        say.print(f"undisturbed: {seconds:.1f} s, {len(undisturbed.ledger)} blocks, {len(undisturbed.control):,} points")
        batches = -(-len(undisturbed.ledger) // scene.batch_blocks)
        port, kinds = free_port(), KINDS if workers else ("coordinator", IN_COMMIT, AFTER_COMMIT)
        if workers:
            stack.enter_context(cluster(scene.folder, scene.workers, "cluster", port))
        standing = Standing(f"tcp://127.0.0.1:{port}" if workers else "", stack.enter_context(Reader()))
        stack.enter_context(suppress(KeyboardInterrupt))  # ends with the rows so far
        latest = seconds
        while len(rows) < kills:
            kind, name = kinds[len(rows) % len(kinds)], f"kill-{len(rows) + 1}"
            try:
                moment = drawn(kind, batches, latest, rng)
                done = trial(scene, undisturbed, kind, moment, name, rng, standing)
            except TooLate:
                latest *= 0.5 if kind.startswith(IN_STAGE) else 1.0  # tasks of some stages are over soon
                shutil.rmtree(scene.folder / name)
                continue
            latest = seconds
            rows.append({"kill": len(rows) + 1, "seed": seed, **done.to_row()})
            if out is not None:
                write_record(out, "faults", scale, workers, rows)
            say.print(", ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in rows[-1].values()), soft_wrap=True)
    return rows
