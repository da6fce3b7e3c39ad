"""Faults: processes of a run are killed at random moments, and the same command is given again.

Every time the network must be that of an undisturbed run, and a reader that queries all the time must see whole versions only. The tests
use the same trials with fewer kills (``tests/end_to_end/test_faults.py``). Linux only, as it looks up processes.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import random
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import psutil  # type: ignore[import-untyped]
from rich.console import Console

import submin
from orchestration.create import create, fit_catalogue
from submin.query.control_set import ControlSet
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.network_store import Snapshot, versions
from submin.storage.simulated import write_region
from submin.storage.writer_lock import LOCK_FILE

ROOT = Path(__file__).parents[1]
# a signal that the caller ignores (a job in the background) would be ignored by the command too
SUBMIN = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from orchestration.cli import main; main()"
EVERYWHERE = (-180.0, -90.0, 180.0, 90.0)
LONGEST = 300.0
"""Seconds after which a run counts as hanging."""
LONGEST_COMMIT = 0.02
"""Seconds that a small commit takes at most, from the first list of what it holds to the new version."""
IDENTICAL = "identical"
"""Verdict on a trial without faults."""
STAGES = ("read", "adjust", "update-tile", "factor-tile", "collect-tile", "distribute-tile")
"""Tasks of a run, by the names that the cluster gives them."""
IN_STAGE, IN_COMMIT, AFTER_COMMIT = "worker in ", "coordinator in a commit", "coordinator after a commit"
KINDS = ("one worker", "all workers", *(IN_STAGE + stage for stage in STAGES), "coordinator", IN_COMMIT, AFTER_COMMIT, "scheduler")
"""What is killed. At the moment given, but in a stage the worker that is next busy with a task of it.

Runs whose scheduler is killed, whose worker is killed in a stage, or whose coordinator is killed at a commit, are on a cluster of processes
that were started by Dask's own commands; the others on a local one.
"""
Moment = Callable[["Command", Path], None]
"""Waits until it is time to kill; it is given the running command and its network."""


class Command:
    """A program in a process group of its own, as a terminal starts it; what it prints goes to files."""

    def __init__(self, words: Sequence[object], log: Path) -> None:
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
        self._log = log
        with log.with_suffix(".out").open("wb") as out, log.with_suffix(".err").open("wb") as err:
            self.process = subprocess.Popen(
                [sys.executable, *map(str, words)], stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True,
                env=os.environ | {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )  # fmt: skip

    def __enter__(self) -> Command:
        return self

    def __exit__(self, *_: object) -> None:
        """Kill what is left of the group."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    @property
    def out(self) -> str:
        """What it has printed."""
        return self._log.with_suffix(".out").read_text()

    @property
    def err(self) -> str:
        """What it has printed to standard error."""
        return self._log.with_suffix(".err").read_text()

    def wait(self, seconds: float = LONGEST) -> int:
        """Its exit code.

        Raises
        ------
        subprocess.TimeoutExpired
            When it does not end.
        """
        return self.process.wait(seconds)

    def workers(self) -> list[psutil.Process]:
        """Worker processes that it has started."""
        return [p for p in psutil.Process(self.process.pid).children(recursive=True) if any("spawn_main" in word for word in p.cmdline())]


def submin_command(*words: object, log: Path) -> Command:
    """``submin WORDS``, started."""
    return Command(["-c", SUBMIN, *words], log)


def wait_until(condition: Callable[[], bool], command: Command, seconds: float = LONGEST) -> None:
    """Look every few milliseconds until a condition holds.

    Raises
    ------
    RuntimeError
        When the command ends before, or the time is over.
    """
    end = time.monotonic() + seconds
    while not condition():
        if command.process.poll() is not None or time.monotonic() > end:
            raise RuntimeError(f"what was waited for did not happen; exit code {command.process.poll()}: {command.err}")
        time.sleep(0.005)


@dataclass(frozen=True)
class Scene:
    """What every trial begins with.

    Attributes
    ----------
    folder : for networks and logs; catalogue : simulated; empty : network to copy
    batch_blocks, workers : of every run
    """

    folder: Path
    catalogue: Path
    empty: Path
    batch_blocks: int
    workers: int

    def network(self, name: str) -> Path:
        """A new copy of the empty network."""
        return Path(shutil.copytree(self.empty, self.folder / name))

    def run(self, network: Path | str, name: str, *where: object) -> Command:
        """``submin run``, started; on a local cluster unless told where."""
        return submin_command(
            "run", self.catalogue, network, "--batch-blocks", self.batch_blocks, "--json", *(where or ("--workers", self.workers)),
            log=self.folder / name,
        )  # fmt: skip


def make_scene(folder: Path, side_km: float, batch_blocks: int, workers: int) -> Scene:
    """A square region and an empty network over it."""
    write_region(simulate_region(RegionDesign(width_km=side_km, height_km=side_km)), folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    area, _, _ = fit_catalogue(catalogue)
    create(str(folder / "empty"), area, catalogue.metadata, 60.0, 20.0)
    return Scene(folder, folder / "catalogue", folder / "empty", batch_blocks, workers)


@dataclass(frozen=True, eq=False)
class Content:
    """What two networks are compared by: ledger, rays, the rigorous answer for all points, and what each tile answers alone."""

    ledger: tuple[tuple[object, ...], ...]
    rays: tuple[tuple[str, str, bool], ...]
    control: ControlSet
    tiles: tuple[ControlSet, ...]

    @classmethod
    def of(cls, network: Path | str) -> Content:
        """Of the newest version."""
        opened = submin.open(network)
        snapshot, rays = opened.snapshot, []
        images = snapshot.image_columns(["image_id"])["image_id"]
        for number in snapshot.cell_numbers():
            cell = snapshot.cell(number, with_sums=False)
            names = images[cell.images[cell.rays.image]]
            rays += list(zip(cell.point_ids[cell.rays.point].tolist(), names.tolist(), cell.rays.accepted.tolist(), strict=True))
        # rays_rejected is a block's count at its own version, before later blocks
        table = snapshot.ledger(["block_id", "content", "status", "images", "rays"])
        ledger = zip(*(column.tolist() for column in table.values()), strict=True)
        tiles = tuple(opened.query(tile=snapshot.cover.tile_name(tile)) for tile in snapshot.tile_numbers())
        return cls(tuple(sorted(ledger)), tuple(sorted(rays)), opened.query(bbox=EVERYWHERE, policy="rigorous"), tiles)

    def faults(self, other: Content) -> list[str]:
        """What is wrong with another network that should be the same."""
        found = []
        if self.ledger != other.ledger or len({row[0] for row in other.ledger}) < len(other.ledger):
            found.append("another ledger")
        if self.rays != other.rays or len({row[:2] for row in other.rays}) < len(other.rays):
            found.append("other rays")
        differences = self.differences(other)
        if np.isnan(differences).any():
            found.append("other points")
        elif not max(differences) <= 1e-9:
            found.append("another answer")
        return found

    def differences(self, other: Content) -> tuple[float, float]:
        """Largest difference of coordinates, in standard deviations, and of the covariance, as a correlation. NaN: other points."""
        if len(self.tiles) != len(other.tiles):
            return np.nan, np.nan
        pairs = zip((self.control, *self.tiles), (other.control, *other.tiles), strict=True)
        moved, spread = np.array([differences(one, another) for one, another in pairs]).max(axis=0)  # which keeps NaN
        return float(moved), float(spread)


def differences(one: ControlSet, other: ControlSet) -> tuple[float, float]:
    """As `Content.differences`, of two answers."""
    if one.ids.tolist() != other.ids.tolist():
        return np.nan, np.nan
    sigma = np.sqrt(np.diag(one.covariance))
    moved = np.abs(one.geocentric - other.geocentric).ravel() / sigma
    spread = np.abs(one.covariance - other.covariance) / sigma / sigma[:, None]
    return float(moved.max(initial=0.0)), float(spread.max(initial=0.0))


@dataclass(frozen=True)
class Readings:
    """What a reader saw: number of answers, versions, and everything that was wrong."""

    answers: int
    versions: tuple[str, ...]
    faults: tuple[str, ...]


def _reading(place: str, version: str | None = None) -> tuple[str, str]:
    """A version, and the fingerprint of all that it answers: ids, coordinates, covariance, blocks, ledger."""
    network = submin.open(place, version)
    control = network.query(bbox=EVERYWHERE, policy="rigorous")
    if control.version != network.version:
        raise ValueError(f"asked {network.version}, answered by {control.version}")
    lines = network.snapshot.ledger(["block_id", "version"])
    if sorted(control.blocks) != sorted(lines["block_id"].tolist()):
        raise ValueError(f"{network.version} answers from blocks that are not those of its ledger")
    fused = max((v.number for v in versions(place) if v.number <= network.snapshot.number and "fused" in v.message), default=0)
    if int(lines["version"].max(initial=0)) != fused:
        raise ValueError(f"the ledger of {network.version} ends with version {lines['version'].max(initial=0)}")
    digest = hashlib.sha256("\n".join([*control.ids.tolist(), *control.blocks, *lines["block_id"].tolist()]).encode())
    digest.update(control.geocentric.tobytes())
    digest.update(control.covariance.tobytes())
    return network.version, f"{len(control)} points, {digest.hexdigest()}"


def _read_all_the_time(place: str, stop: Event) -> Readings:
    """Query until told to stop. In the end every version that was seen is asked once more, at rest: each answer must have been that one."""
    seen: dict[str, set[str]] = {}
    answers, last, faults = 0, -1, set()
    while not (stop.is_set() and answers):
        started = time.monotonic()
        try:
            version, answer = _reading(place)
            number = int(version.removeprefix("v"))
            if number < last:
                faults.add(f"v{last} was followed by {version}")
            last = number
            seen.setdefault(version, set()).add(answer)
            answers += 1
        except Exception as error:
            faults.add(f"{type(error).__name__}: {error}")
            if stop.is_set():
                break
        time.sleep(max(2.0 * (time.monotonic() - started), 0.02))  # most of a processor is for the run
    for version, given in seen.items():
        if given != {_reading(place, version)[1]}:
            faults.add(f"{version} gave other answers than it does at rest: {sorted(given)}")
    return Readings(answers, tuple(seen), tuple(sorted(faults)))


def _serve(stop: Event, connection: Connection) -> None:
    """Body of the reader process: one network after the other."""
    while True:
        connection.send(_read_all_the_time(connection.recv(), stop))


class Reader:
    """A process that opens and queries a network all the time."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._stop = context.Event()
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._stop, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()
        self._connection.close()

    @contextmanager
    def reading(self, network: Path) -> Iterator[Callable[[], Readings]]:
        """Read a network while the body runs; what is given ends the reading, and says what was read."""
        readings: list[Readings] = []

        def ended() -> Readings:
            if not readings:
                self._stop.set()
                try:
                    readings.append(self._connection.recv())
                except EOFError:
                    readings.append(Readings(0, (), ("the reader has died",)))
            return readings[0]

        self._stop.clear()
        self._connection.send(str(network))
        try:
            yield ended
        finally:
            ended()


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


@contextmanager
def cluster(scene: Scene, name: str, port: int) -> Iterator[tuple[Command, Command]]:
    """A Dask scheduler and its workers in processes of their own, ready."""
    from distributed import Client

    address = f"tcp://127.0.0.1:{port}"
    serve = ["-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"]
    work = ["-m", "dask", "worker", address, "--nworkers", scene.workers, "--nthreads", 1, "--no-dashboard"]
    with (
        Command(serve, scene.folder / f"{name}-scheduler") as scheduler,
        Command([*work, "--local-directory", scene.folder], scene.folder / f"{name}-workers") as workers,
    ):
        with Client(address, timeout="60s") as client:
            client.wait_for_workers(scene.workers, timeout=60)
        yield scheduler, workers


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


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
                scheduler, _ = stack.enter_context(cluster(scene, name, port))
            where = ("--scheduler", address)
        first = stack.enter_context(scene.run(network, f"{name}-first", *where))
        wait_until(lambda: begun(network), first)
        began = time.monotonic()
        moment(first, network)
        busy = busy_worker(str(where[1]), kind.removeprefix(IN_STAGE), first) if kind.startswith(IN_STAGE) else None
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
            stack.enter_context(cluster(scene, f"{name}-again", port))
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


def busy_worker(address: str, stage: str, command: Command) -> int:
    """Process of the worker that is busy with a task of a stage; waits for one.

    Raises
    ------
    TooLate
        When the command ends before.
    """
    from distributed import Client

    with Client(address, timeout="60s") as client:
        processes = client.run(os.getpid)
        while command.process.poll() is None:
            for worker, keys in client.processing().items():
                if any(str(key).startswith(f"{stage}-") for key in keys):
                    return int(processes[worker])
            time.sleep(0.001)
    raise TooLate


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
    """A random moment of a run of so many batches and seconds that suits what is killed."""
    if kind == IN_COMMIT:
        return in_commit(rng.randrange(batches), rng.uniform(0.0, LONGEST_COMMIT))
    if kind == AFTER_COMMIT:
        return after_commit(rng.randint(1, batches - 1))
    return after(rng.uniform(0.0, seconds))


def measure(scale: float, workers: int, kills: int = 30, seed: int | None = None) -> list[dict[str, Any]]:
    """Rows of kill, moment, what was found, and the differences; at scale 1 the region is 120 km x 120 km, 12 blocks in 6 batches.

    Without workers runs are of one process, the coordinator, and that is killed.
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
            stack.enter_context(cluster(scene, "cluster", port))
        standing = Standing(f"tcp://127.0.0.1:{port}" if workers else "", stack.enter_context(Reader()))
        stack.enter_context(suppress(KeyboardInterrupt))  # ends with the rows so far
        while len(rows) < kills:
            kind, name = kinds[len(rows) % len(kinds)], f"kill-{len(rows) + 1}"
            try:
                moment = drawn(kind, batches, seconds, rng)
                done = trial(scene, undisturbed, kind, moment, name, rng, standing)
            except TooLate:
                shutil.rmtree(scene.folder / name)
                continue
            rows.append({"kill": len(rows) + 1, **done.to_row()})
            say.print(", ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in rows[-1].values()), soft_wrap=True)
    return rows
