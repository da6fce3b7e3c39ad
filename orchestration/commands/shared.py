"""What commands share: options, and how values are shown."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

out = Console(highlight=False)

MOST_WORKERS = 1024

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
Box = Annotated[
    tuple[float, float, float, float] | None, typer.Option("--bbox", metavar="W S E N", help="West, south, east, north in degrees.")
]
Aoi = Annotated[Path | None, typer.Option("--aoi", help="GeoJSON file with the area.")]
Seed = Annotated[int, typer.Option("--seed", help="Of the random numbers; the same seed gives the same catalogue.")]
Workers = Annotated[int, typer.Option("--workers", help="Processes of a local Dask cluster; 0 runs without one.")]
Scheduler = Annotated[str | None, typer.Option("--scheduler", help="Address of a running Dask scheduler.")]
NoReconcile = Annotated[
    bool, typer.Option("--no-reconcile", help="Leave what lies outside of each tile as it was; see 'submin reconcile'.")
]


def show(values: dict[str, Any], as_json: bool, text: str) -> None:
    """One JSON object, or text for people."""
    if as_json:
        sys.stdout.write(json.dumps(values) + "\n")
    elif text:
        out.print(text, soft_wrap=True)


def check_range(option: str, value: int, least: int, most: int | None = None) -> None:
    """Refuse the value of an option that is out of its range."""
    if value < least or (most is not None and value > most):
        from submin.errors import InputError

        raise InputError(f"{option} is {value}; expected {least} {'or more' if most is None else f'to {most}'}")


def check_applies(given: Mapping[str, object], needed: str) -> None:
    """Refuse options (None: not given) that say something only beside another one."""
    for option, value in given.items():
        if value is not None:
            from submin.errors import InputError

            raise InputError(f"{option} is given without {needed}, where it says nothing; give {needed} too, or leave {option} out")


def counted(number: int, noun: str) -> str:
    """Such as 1 block, 2,000 blocks."""
    return f"{number:,} {noun}{'s' * (number != 1)}"
