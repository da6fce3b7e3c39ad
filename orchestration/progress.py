"""Progress of long work, on standard error: a bar where a person looks, nothing where none does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class Reporter(Protocol):
    """Told what is being done."""

    def begin(self, blocks: int) -> None:
        """A run of so many blocks begins."""
        ...

    def read(self, blocks: int) -> None:
        """So many more blocks have been read, and adjusted by themselves: ahead of those that are being fused, from another thread."""
        ...

    def stage(self, name: str, total: int) -> Callable[[], None]:
        """A stage of so many steps begins; the answer is to be called after each step."""
        ...

    def fused(self, blocks: int) -> None:
        """So many blocks have been committed (or rejected)."""
        ...


class Silent:
    """Reports nothing."""

    def begin(self, blocks: int) -> None:
        """See `Reporter.begin`."""

    def read(self, blocks: int) -> None:
        """See `Reporter.read`."""

    def stage(self, name: str, total: int) -> Callable[[], None]:
        """See `Reporter.stage`."""
        return lambda: None

    def fused(self, blocks: int) -> None:
        """See `Reporter.fused`."""


class Bars:
    """One bar for the blocks that are read and adjusted, one for the stage of the batch, and one for the blocks that are fused."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._read = progress.add_task("adjusting blocks", total=None, visible=False)
        self._stage = progress.add_task("", total=None, visible=False)
        self._blocks = progress.add_task("blocks fused", total=None, visible=False)

    def begin(self, blocks: int) -> None:
        """See `Reporter.begin`."""
        for bar in (self._read, self._blocks):
            self._progress.update(bar, total=blocks, completed=0, visible=True)

    def read(self, blocks: int) -> None:
        """See `Reporter.read`."""
        self._progress.advance(self._read, blocks)

    def stage(self, name: str, total: int) -> Callable[[], None]:
        """See `Reporter.stage`."""
        self._progress.update(self._stage, description=name, total=total, completed=0, visible=True)
        return lambda: self._progress.advance(self._stage)

    def fused(self, blocks: int) -> None:
        """See `Reporter.fused`."""
        self._progress.advance(self._blocks, blocks)


@contextmanager
def progress_bars(*, quiet: bool = False) -> Iterator[Reporter]:
    """Bars on standard error while the body runs; none when quiet or when standard error is not a terminal."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield Silent()
        return
    columns = (
        TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as progress:
        yield Bars(progress)
