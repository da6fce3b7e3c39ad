"""What tasks take: each process notes it by the name of the task, and the coordinator asks for the notes at the end of a run."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from orchestration.memory import own_peak_memory_mb

T = TypeVar("T")


@dataclass(frozen=True)
class TaskRecord:
    """What all tasks of one name took.

    Attributes
    ----------
    tasks : their number; seconds : all of them together, longest : the longest one, by the clock
    processor_seconds : of their threads while they ran
    peak_memory_mb : largest resident memory, when one of them was done, of a process since it began
    """

    tasks: int = 0
    seconds: float = 0.0
    longest: float = 0.0
    processor_seconds: float = 0.0
    peak_memory_mb: float = 0.0

    def __add__(self, other: TaskRecord) -> TaskRecord:
        return TaskRecord(
            self.tasks + other.tasks, self.seconds + other.seconds, max(self.longest, other.longest),
            self.processor_seconds + other.processor_seconds, max(self.peak_memory_mb, other.peak_memory_mb),
        )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Plain values, as programs rely on them."""
        return asdict(self)


_NOTES: dict[str, TaskRecord] = {}
"""Of this process, by the name of the task."""
_WRITING = threading.Lock()


def recorded(name: str, function: Callable[..., T], *arguments: Any) -> T:
    """The value of a function; what it took is noted under a name."""
    clock, processor = time.perf_counter(), time.thread_time()
    try:
        return function(*arguments)
    finally:
        seconds = time.perf_counter() - clock
        note = TaskRecord(1, seconds, seconds, time.thread_time() - processor, own_peak_memory_mb())
        with _WRITING:
            _NOTES[name] = _NOTES.get(name, TaskRecord()) + note


def taken_notes() -> dict[str, TaskRecord]:
    """The notes of this process, which begins anew."""
    notes = dict(_NOTES)
    _NOTES.clear()
    return notes


def added(records: Iterable[Mapping[str, TaskRecord]]) -> dict[str, TaskRecord]:
    """Notes of several processes as those of one."""
    total: dict[str, TaskRecord] = {}
    for notes in records:
        for name, record in notes.items():
            total[name] = total.get(name, TaskRecord()) + record
    return total
