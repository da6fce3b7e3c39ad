"""Programs that are started beside a trial, as a terminal would: commands of submin, a scheduler, its workers."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import psutil  # type: ignore[import-untyped]

ROOT = Path(__file__).parents[1]
# a signal that the caller ignores (a job in the background) would be ignored by the command too
SUBMIN = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from orchestration.cli import main; main()"
LONGEST = 300.0
"""Seconds after which a run counts as hanging."""


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


@contextmanager
def cluster(folder: Path, processes: int, name: str, port: int) -> Iterator[tuple[Command, Command]]:
    """A Dask scheduler and so many workers, in processes of their own, ready; what they print goes to files in a folder."""
    from distributed import Client

    address = f"tcp://127.0.0.1:{port}"
    serve = ["-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"]
    work = ["-m", "dask", "worker", address, "--nworkers", processes, "--nthreads", 1, "--no-dashboard"]
    with (
        Command(serve, folder / f"{name}-scheduler") as scheduler,
        Command([*work, "--local-directory", folder], folder / f"{name}-workers") as workers,
    ):
        with Client(address, timeout="60s") as client:
            client.wait_for_workers(processes, timeout=60)
        yield scheduler, workers


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
