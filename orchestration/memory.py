"""Memory of a process."""

from __future__ import annotations

import ctypes
import resource
from pathlib import Path


def own_peak_memory_mb() -> float:
    """Largest resident memory of this process so far, megabytes."""
    try:  # getrusage would count what the process that started this one had
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024.0
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def give_back() -> None:
    """Give freed memory of this process back to the system, where its C library (glibc) can: what a batch leaves in pieces would stay."""
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    except (OSError, AttributeError):
        return
