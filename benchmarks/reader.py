"""A reader that queries a network all the time: it must see whole versions only."""

from __future__ import annotations

import hashlib
import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path

import submin
from benchmarks.fault_scene import EVERYWHERE
from submin.storage.repository import versions


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
