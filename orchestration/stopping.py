"""Ends that come from outside: Ctrl-C, SIGTERM, a cluster that is lost. What is committed is said, and how to go on.

Imports nothing that takes time: the command line must answer to Ctrl-C while it loads the rest.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

PATIENCE_SECONDS = 10.0
SOON_SECONDS = 0.05
"""After which a signal that came at a bad moment is sent once more: a finaliser, or a collection of garbage, has ended by then."""
SIGNALS = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}


class Stopped(BaseException):
    """A signal asks the command to end. Not an `Exception`: nothing on the way may take it for an error of its own."""

    def __init__(self, number: int, note: str = "") -> None:
        super().__init__(f"stopped by {SIGNALS[signal.Signals(number)]}{note}")
        self.number = number

    @property
    def exit_code(self) -> int:
        """As shells expect it: 130 or 143."""
        return 128 + self.number


@contextmanager
def signals_stop() -> Iterator[None]:
    """While the body runs, the first of `SIGNALS` raises `Stopped` where the program is.

    Where that is a finaliser, Python would print what is raised and go on: then the signal is sent once more, soon after. So it is where
    a callback of the garbage collector runs, which is not broken off: what it had begun (Dask times every collection) it could not end
    afterwards, and Python would print that. (Code that swallows every exception in another way swallows this one too.) Later signals
    leave the program to clean up in peace, for so long as that may take; then they end the process as it is, which loses nothing that
    is committed.
    """
    first: float | None = None
    again: list[threading.Timer] = []

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if first is None:
            if _in_the_collector(frame):
                send_again(number)
                return
            first = time.monotonic()
            raise Stopped(number)
        if time.monotonic() - first > PATIENCE_SECONDS:
            os._exit(Stopped(number).exit_code)

    def send_again(number: int) -> None:
        again.append(threading.Timer(SOON_SECONDS, signal.pthread_kill, (threading.main_thread().ident, number)))
        again[-1].daemon = True
        again[-1].start()

    def swallowed(what: sys.UnraisableHookArgs) -> None:
        nonlocal first
        if not isinstance(what.exc_value, Stopped):
            said(what)
            return
        first = None
        send_again(what.exc_value.number)

    # a signal that is ignored already (a job in the background) stays ignored
    before = {each: signal.signal(each, stop) for each in SIGNALS if signal.getsignal(each) is not signal.SIG_IGN}
    said, sys.unraisablehook = sys.unraisablehook, swallowed
    try:
        yield
    finally:
        first = first or time.monotonic()  # what comes from here on must not break off what follows
        for timer in again:
            timer.cancel()
            timer.join()
        sys.unraisablehook = said
        for each, handler in before.items():
            signal.signal(each, handler)


def _in_the_collector(frame: FrameType | None) -> bool:
    """True where a callback of the garbage collector runs."""
    codes = {getattr(callback, "__code__", None) for callback in gc.callbacks}  # a method gives that of its function
    while frame is not None and frame.f_code not in codes:
        frame = frame.f_back
    return frame is not None


@contextmanager
def resumable(place: str) -> Iterator[None]:
    """For a body that the same command continues: when it is ended from outside, the message says what of it is in the network.

    Raises
    ------
    Stopped, ClusterError
        Those of the body, with that said.
    """
    from submin.errors import ClusterError

    try:
        yield
    except Stopped as stopped:
        raise Stopped(stopped.number, f"; {_committed(place)}; give the same command again to continue") from None
    except ClusterError as error:
        raise ClusterError(f"{error.problem}; {_committed(place)}", error.remedy) from None


def _committed(place: str) -> str:
    from submin.errors import SubminError
    from submin.storage.snapshot import Snapshot

    try:
        return f"everything committed stays ({place} is at {Snapshot.open(place).version})"
    except SubminError:
        return "nothing was written"
