"""The command that checks a network: verify."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from orchestration.commands.shared import MOST_WORKERS, Json, Scheduler, Workers, check_range, counted, out, show

app = typer.Typer()


@app.command()
def verify(
    network: Annotated[str, typer.Argument(help="Network to check.")],
    workers: Workers = 0,
    scheduler: Scheduler = None,
    at: Annotated[str | None, typer.Option("--at", help="Version, such as v12.")] = None,
    as_json: Json = False,
) -> None:
    """Check that a network is sound: every sum against its rays, every factor against its sums, every block counted once.

    Nothing is changed. Exit code 0: sound; 1: problems found (docs/quality.md says what each kind means, and what to do).

    Example: submin verify network --workers 2
    """
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.verify import verify as check

    check_range("--workers", workers, 0, MOST_WORKERS)
    with progress_bars(quiet=as_json) as reporter, executor_for(workers, scheduler) as executor:
        found = check(network, executor, version=at, reporter=reporter)
    if as_json:
        show(found.to_json(), True, "")
    else:
        for problem in found.problems:
            where = f"tile {problem.tile}: " if problem.tile else ""
            out.print(escape(f"{problem.kind}: {where}{problem.detail}"), soft_wrap=True)
        state = "sound" if found.ok else counted(len(found.problems), "problem")
        out.print(
            escape(f"{network} {found.version}: {state}; {counted(len(found.tiles), 'tile')}, {found.seconds:.1f} s"), soft_wrap=True
        )  # fmt: skip
        if found.tiles:
            table = Table(show_header=False, box=None)
            for name, meaning in _MEANINGS.items():
                if found.worst(name) == found.worst(name):  # a dense network has no cells, an empty one nothing to compare
                    table.add_row(meaning, f"{found.worst(name):.1e}")
            for factor in found.variance_factors:
                kind = " of ".join(filter(None, (factor.sensor, factor.platform)))
                table.add_row(escape(f"variance factor, {kind}"), f"{factor.factor:.3f} +- {factor.sigma:.3f}")
            out.print(table)
    if not found.ok:
        raise typer.Exit(1)


_MEANINGS = {
    "condition": "condition of a tile's information, at most",
    "sums_error": "cells against their rays, at most",
    "factor_error": "sub-MINs against their cells, at most",
    "symmetric_error": "triangles of a covariance, at most",
    "replay_error": "sub-MINs against a replay from the rays, at most",
}
