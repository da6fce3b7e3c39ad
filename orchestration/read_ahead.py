"""What comes next is made while what came last is worked on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice, takewhile
from threading import Event
from typing import TypeVar

T = TypeVar("T")


def batches_ahead(values: Iterable[T], size: int) -> Iterator[list[T]]:
    """Values in lists of so many, the last one shorter; a thread makes the next list while one is worked on, and not more than that.

    An error of ``values`` is raised where their list would come. Whoever wants no more lists waits for one value at most.
    """
    stopped = Event()
    left = takewhile(lambda _: not stopped.is_set(), values)

    def next_batch() -> list[T]:
        return list(islice(left, size))

    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as reader:
        try:
            following = reader.submit(next_batch)
            while batch := following.result():
                following = reader.submit(next_batch)
                yield batch
        finally:
            stopped.set()
