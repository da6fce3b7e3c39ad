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

    def stage(self, name: str, total: int) -> Callable[[], None]:
        """See `Reporter.stage`."""
        return lambda: None

    def fused(self, blocks: int) -> None:
        """See `Reporter.fused`."""


class Bars:
    """One bar for the blocks of the run, one for the stage of the batch."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._stage = progress.add_task("", total=None, visible=False)
        self._blocks = progress.add_task("blocks", total=None, visible=False)

    def begin(self, blocks: int) -> None:
        """See `Reporter.begin`."""
        self._progress.update(self._blocks, total=blocks, completed=0, visible=True)

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
