"""Signals raise once, leave cleaning up in peace, and end what does not end."""

from __future__ import annotations

import gc
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from orchestration.stopping import Stopped, resumable, signals_stop
from submin.errors import ClusterError, InputError

SWALLOWS = """
import signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from orchestration import stopping
stopping.PATIENCE_SECONDS = 1.0
with stopping.signals_stop():
    while True:
        try:
            print("at work", flush=True)
            time.sleep(60)
        except BaseException as error:
            print(type(error).__name__, flush=True)
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_signal_raises(number: signal.Signals, code: int) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # not ignored, wherever the tests are started
    before = signal.getsignal(number)
    with pytest.raises(Stopped) as stopped, signals_stop():
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)  # cleaning up goes on
            cleaned = True
    assert cleaned
    assert stopped.value.exit_code == code
    assert signal.getsignal(number) is before


class Finalised:
    """A signal comes while it is finalised, `times` times."""

    times = 1

    def __del__(self) -> None:
        if Finalised.times:
            Finalised.times -= 1
            going.append(Finalised())
            signal.raise_signal(signal.SIGTERM)


going: list[Finalised] = []


@pytest.mark.parametrize("times", [1, 3])
def test_a_signal_that_a_finaliser_swallows_is_not_lost(times: int, capsys: pytest.CaptureFixture[str]) -> None:
    """As between two batches, when garbage is collected: Python would print it, and the run would go on to its end."""
    before = sys.unraisablehook
    Finalised.times = times
    going.append(Finalised())
    with pytest.raises(Stopped) as stopped, signals_stop():
        for _ in range(500):
            going.clear()
            time.sleep(0.01)
    assert stopped.value.exit_code == 143
    assert sys.unraisablehook is before
    assert capsys.readouterr().err == ""


class Timing:
    """Times collections as Dask does: cannot end one that it did not begin. Signals come while it does, once in each phase."""

    def __init__(self) -> None:
        self.begun, self.left = False, ["start", "stop"]

    def __call__(self, phase: str, info: dict[str, int]) -> None:
        self.measure(phase)

    def measure(self, phase: str) -> None:
        if phase in self.left:
            self.left.remove(phase)
            signal.raise_signal(signal.SIGTERM)
        assert self.begun == (phase == "stop")
        self.begun = phase == "start"


@pytest.mark.parametrize("phases", [["start"], ["stop"], ["start", "stop"]])
def test_a_callback_of_the_collector_is_not_broken_off(phases: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda of: told.append(of.exc_type))
    timing = Timing()
    timing.left = list(phases)
    callback = timing.__call__
    gc.collect()
    gc.callbacks.append(callback)
    try:
        with pytest.raises(Stopped) as stopped, signals_stop():
            gc.collect()
            after = len(timing.left)
            time.sleep(5.0)
    finally:
        gc.callbacks.remove(callback)
    assert (stopped.value.exit_code, after, timing.begun, told) == (143, 0, False, [])


class Failing:
    """Another error comes while it is finalised."""

    def __del__(self) -> None:
        raise ZeroDivisionError


def test_what_else_a_finaliser_raises_is_told_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda of: told.append(of.exc_type))
    with signals_stop():
        Failing()
    assert told == [ZeroDivisionError]


def test_a_program_that_swallows_the_first_signal_ends_with_a_later_one() -> None:
    with subprocess.Popen([sys.executable, "-c", SWALLOWS], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]) as program:
        try:
            assert program.stdout is not None
            lines = program.stdout
            assert lines.readline() == "at work\n"
            program.send_signal(signal.SIGINT)
            assert [lines.readline(), lines.readline()] == ["Stopped\n", "at work\n"]
            program.send_signal(signal.SIGINT)
            time.sleep(0.3)
            assert program.poll() is None
            time.sleep(1.0)
            program.send_signal(signal.SIGINT)
            assert program.wait(10) == 130
        finally:
            program.kill()


def test_what_is_not_there_was_not_written(tmp_path: Path) -> None:
    with pytest.raises(ClusterError, match="^lost; nothing was written; try again$"), resumable(str(tmp_path / "network")):
        raise ClusterError("lost", "try again")
    with pytest.raises(InputError, match="^bad$"), resumable(str(tmp_path / "network")):
        raise InputError("bad")
