"""``python -m benchmarks`` lists the benchmarks; ``python -m benchmarks NAME [--json] [--scale F] [--workers N]`` runs one."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks import faults, main_job, stage_one
from benchmarks.machine import machine

BENCHMARKS: dict[str, tuple[str, Callable[..., list[dict[str, Any]]]]] = {
    "main-job": ("the rate of every station from rays to a committed network", main_job.measure),
    "stage-1": ("projection, and a triplet through stage 1: fast, and linear in rays", stage_one.measure),
    "faults": ("a run whose processes are killed leaves the network of an undisturbed one", faults.measure),
}


def command(
    name: Annotated[str | None, typer.Argument(help="Benchmark to run; without one they are listed.")] = None,
    scale: Annotated[float, typer.Option(help="Part of the full size.")] = 1.0,
    workers: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    kills: Annotated[int | None, typer.Option(min=1, help="faults: number of kills.")] = None,
    seed: Annotated[int | None, typer.Option(help="faults: seed of the moments; default: drawn, and said.")] = None,
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
    more = {option: value for option, value in (("kills", kills), ("seed", seed)) if value is not None}
    if more and name != "faults":
        raise typer.BadParameter(f"--{next(iter(more))} is an option of faults")
    rows = BENCHMARKS[name][1](scale, workers, **more)
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
