"""``python -m benchmarks`` lists the benchmarks; ``python -m benchmarks NAME [--json] [--scale F] [--workers N]`` runs one."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks import main_job
from benchmarks.machine import machine

BENCHMARKS: dict[str, tuple[str, Callable[[float, int], list[dict[str, Any]]]]] = {
    "main-job": ("the rate of every station from rays to a committed network", main_job.measure),
}


def command(
    name: Annotated[str | None, typer.Argument(help="Benchmark to run; without one they are listed.")] = None,
    scale: Annotated[float, typer.Option(help="Part of the full size.")] = 1.0,
    workers: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Run a benchmark and print it beside the machine that it ran on."""
    out = Console(highlight=False)
    if name is None:
        for key, (claim, _) in BENCHMARKS.items():
            out.print(f"{key:<14} {claim}")
        return
    if name not in BENCHMARKS:
        raise typer.BadParameter(f"{name!r}; expected one of {', '.join(BENCHMARKS)}")
    rows = BENCHMARKS[name][1](scale, workers)
    host = machine()
    if as_json:
        sys.stdout.write(json.dumps({"benchmark": name, "scale": scale, "machine": host, "rows": rows}) + "\n")
        return
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(f"{v:,.4g}" if isinstance(v, float) else f"{v:,}" if isinstance(v, int) else str(v) for v in row.values()))
    out.print(table)
    out.print(", ".join(f"{key} {value}" for key, value in host.items()), soft_wrap=True)


if __name__ == "__main__":
    typer.run(command)
