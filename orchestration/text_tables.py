"""How wide a table of text must be."""

from __future__ import annotations

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

WIDEST = 10_000
"""Characters; a limit that no table comes near."""


def as_wide_as(table: Table) -> int:
    """Characters that a table needs so that nothing in it is folded or cut off, whatever the terminal is."""
    console = Console(width=WIDEST)
    return Measurement.get(console, console.options, table).maximum
