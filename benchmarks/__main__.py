"""``python -m benchmarks`` lists the benchmarks; ``python -m benchmarks NAME [--json] [--scale F] [--workers N] [--out DIR]`` runs one."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks import (
    china,
    cluster,
    continuity,
    correlation,
    dense_update,
    faults,
    five_blocks,
    main_job,
    peers,
    query,
    scaling,
    stage_one,
    sub_min,
    worldview,
)
from benchmarks.comparison import DATA, MET
from benchmarks.machine import machine
from orchestration.text_tables import as_wide_as

BENCHMARKS: dict[str, tuple[str, Callable[..., list[dict[str, Any]]]]] = {
    "main-job": ("the rate of every station from rays to a committed network", main_job.measure),
    "stage-1": ("projection, and a triplet through stage 1: fast, and linear in rays", stage_one.measure),
    "dense-update": ("a dense network's update in the time of BLAS's own; a thousand updates lose no digits", dense_update.measure),
    "sub-min": ("memory of a sub-MIN, a batch on one thread, low-rank update against factorisation, drift", sub_min.measure),
    "query": ("small questions to a network of 500,000 points: joint covariances in one tile and across two, maps", query.measure),
    "faults": ("a run whose processes are killed leaves the network of an undisturbed one", faults.measure),
    "cluster": ("what a run costs beside its tasks: scheduler, coordinator and store", cluster.measure),
    "five-blocks": ("Tables 2 and 3 of the 2008 paper; sequential = simultaneous; consistent", five_blocks.measure),
    "continuity": ("what a tile border does to the result, by policy and overlap, against the monolithic network", continuity.measure),
    "correlation": ("correlation functions in place of a covariance: factor of consistency and storage, by family", correlation.measure),
    "china": (
        "26,406 images of a simulated campaign over China through the product's commands, one more triplet, its system solved once",
        china.measure,
    ),
    "scaling": ("blocks per second for one and two workers, and for one tenth of China to three of it", scaling.measure),
    "peers": ("GTSAM and a sparse simultaneous adjustment against ours on the same rays, 62 to 60,000 points", peers.measure),
    "worldview": ("Tables 3 to 6 of the 2010 paper; pair = cell = simultaneous; time a pair", worldview.measure),
}

WITH_OUT = ("five-blocks", "worldview", "correlation", "continuity", "peers", "china", "scaling", "query", "faults")

GOOD = (MET, DATA, faults.IDENTICAL, "")
"""Verdicts that ask for nothing; the paper's own lines have none."""


def command(
    name: Annotated[str | None, typer.Argument(help="Benchmark to run; without one they are listed.")] = None,
    scale: Annotated[
        float,
        typer.Option(help="Part of the full size; five-blocks, worldview: of the realisations; continuity, correlation: of the area."),
    ] = 1.0,
    workers: Annotated[int, typer.Option(help="Worker processes.")] = 2,
    kills: Annotated[int | None, typer.Option(min=1, help="faults: number of kills.")] = None,
    seed: Annotated[int | None, typer.Option(help="faults: seed of the moments; default: drawn, and said.")] = None,
    network: Annotated[Path | None, typer.Option(help="query: a network that is there already, in place of a new one.")] = None,
    figures: Annotated[
        Path | None,
        typer.Option("--out", help=f"Folder for figures and records, of {', '.join(WITH_OUT)}."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")] = False,
) -> None:
    """Run a benchmark and print it beside the machine that it ran on. Exit code 1 when something that is asked for is not met."""
    out = Console(highlight=False)
    if name is None:
        for key, (claim, _) in BENCHMARKS.items():
            out.print(f"{key:<14} {claim}")
        return
    if name not in BENCHMARKS:
        raise typer.BadParameter(f"{name!r}; expected one of {', '.join(BENCHMARKS)}")
    more: dict[str, Any] = {option: value for option, value in (("kills", kills), ("seed", seed)) if value is not None}
    if more and name != "faults":
        raise typer.BadParameter(f"--{next(iter(more))} is an option of faults")
    if network is not None:
        if name != "query":
            raise typer.BadParameter("--network is an option of query")
        more["network"] = network
    if figures is not None:
        if name not in WITH_OUT:
            raise typer.BadParameter(f"--out is an option of {', '.join(WITH_OUT)}")
        more["out"] = figures
    rows = BENCHMARKS[name][1](scale, workers, **more)
    host = machine()
    if as_json:
        sys.stdout.write(json.dumps({"benchmark": name, "scale": scale, "machine": host, "rows": rows}) + "\n")
    else:
        for columns, alike in groupby(rows, tuple):  # rows of other columns are another table
            table = Table(*columns)
            for row in alike:
                table.add_row(*(f"{v:,.4g}" if isinstance(v, float) else f"{v:,}" if isinstance(v, int) else str(v) for v in row.values()))
            Console(highlight=False, width=as_wide_as(table)).print(table)
        out.print(", ".join(f"{key} {value}" for key, value in host.items()), soft_wrap=True)
    if any(row.get("verdict", MET) not in GOOD for row in rows):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(command)
