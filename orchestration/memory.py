"""Memory of a process."""

from __future__ import annotations

import ctypes
import gc
import resource
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

SELDOM = (50_000, 50, 100)
"""Thresholds of the garbage collector where many small objects live long: with its own it would walk through all of them every time."""


def own_peak_memory_mb() -> float:
    """Largest resident memory of this process so far, megabytes."""
    try:  # getrusage would count what the process that started this one had
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024.0
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


SHARED_HEAPS = (("MALLOC_ARENA_MAX", -8, 1),)
"""Settings of glibc by the name in a process's environment and by their number in its malloc.h: new threads share the heaps that are there.
What each of many threads kept in pieces of its own would never come together."""
KEPT_FREE = (*SHARED_HEAPS, ("MALLOC_MMAP_THRESHOLD_", -3, 32 << 20), ("MALLOC_TRIM_THRESHOLD_", -1, 256 << 20))
"""The same, and heaps keep what is freed, but for the largest arrays: else each would be cleared anew, page by page, by the system."""


def share_heaps() -> None:
    """Let threads share heaps, from now on in this process, where its C library (glibc) can."""
    _set(SHARED_HEAPS)


def keep_freed() -> None:
    """Keep freed memory for what is asked for next, from now on in this process, where its C library (glibc) can; see `give_back`."""
    _set(KEPT_FREE)


def _set(settings: Sequence[tuple[str, int, int]]) -> None:
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    for _, parameter, value in settings:
        mallopt(parameter, value)


def collect_seldom() -> None:
    """Leave what exists now out of garbage collection, and look for garbage in cycles seldom; `give_back` looks for it."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*SELDOM)


@contextmanager
def seldom_collected() -> Iterator[None]:
    """`collect_seldom` in the body."""
    before = gc.get_threshold()
    collect_seldom()
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


def give_back() -> None:
    """Give freed memory of this process back to the system, where its C library (glibc) can: what a batch leaves in pieces would stay."""
    gc.collect()
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    except (OSError, AttributeError):
        return
