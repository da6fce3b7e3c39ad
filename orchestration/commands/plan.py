"""The command that says what a run would do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from orchestration.commands.shared import Json, check_range, counted, out, show

if TYPE_CHECKING:
    from orchestration.plan import Plan

NAMED = 5
"""Tiles and blocks that are named in the text; --json names all."""

app = typer.Typer()


@app.command()
def plan(
    catalogue: Annotated[Path, typer.Argument(help="Catalogue of image blocks; they may have no measurements yet.")],
    network: Annotated[str, typer.Argument(help="Network that would take them.")],
    batch_blocks: Annotated[int, typer.Option("--batch-blocks", help="Blocks that one commit would hold.")] = 500,
    as_json: Json = False,
) -> None:
    """What a run would do: tiles, blocks per tile, what lies outside, memory and time expected. Writes nothing.

    Example: submin plan catalogue network
    """
    from orchestration.plan import plan as make
    from orchestration.progress import progress_bars
    from submin.storage.catalogue import Catalogue

    check_range("--batch-blocks", batch_blocks, 1)
    with progress_bars(quiet=as_json) as reporter:
        made = make(Catalogue.open(catalogue), network, batch_blocks=batch_blocks, reporter=reporter)
    values = made.to_json()
    show(values, as_json, "\n".join(_lines(network, made)))
    if not as_json and made.tiles:
        table = Table(title="expected, an estimate", title_justify="left")
        for heading in ("workers", "time", "memory"):
            table.add_column(heading, justify="right")
        for e in made.expected:
            table.add_row(
                str(e.workers), f"{e.seconds:,.0f} s" if e.seconds < 600 else f"{e.seconds / 3600:,.1f} h", f"{e.memory_mb:,.0f} MB"
            )
        out.print(table)
        out.print(f"basis: {values['basis']}", soft_wrap=True)


def _lines(network: str, made: Plan) -> list[str]:
    lines = [
        f"{network}: {counted(made.blocks, 'block')}, {made.new:,} new, {made.already_there:,} already there, "
        f"{len(made.refused):,} would be rejected"
    ]
    lines += [f"would reject {r.block_id}: {r.reason}" for r in made.refused[:NAMED]]
    lines += [f"... and {len(made.refused) - NAMED:,} more (--json names them)"] if len(made.refused) > NAMED else []
    if not made.tiles:
        return [*lines, "nothing would come in"]
    values = made.to_json()
    blocks, parameters = values["blocks_per_tile"], values["parameters_per_tile"]
    lines.append(
        f"{counted(made.images, 'image')} for {counted(len(made.tiles), 'tile')} (the area has {made.tiles_of_the_area:,}); "
        f"blocks per tile: median {blocks['median']:g}, at most {blocks['most']:,} ({blocks['tile']}); "
        f"image parameters: at most {parameters['most']:,} ({parameters['tile']}), limit {made.limit:,}"
    )
    if made.unmeasured:
        lines.append(f"{counted(made.unmeasured, 'block')} without measurements yet: a run rejects them as they are")
    if made.rays_outside:
        lines.append(
            f"{made.rays_outside:,} of {counted(made.rays, 'ray')} are on points outside the area, "
            f"in {counted(made.blocks_outside_in_part, 'block')}; the nearest core takes them"
        )
    for names, what in ((made.split, "would be split"), (made.over_limit, "beyond the limit, and cannot be split any more")):
        if names:
            more = f" and {len(names) - NAMED:,} more" if len(names) > NAMED else ""
            lines.append(f"{counted(len(names), 'tile')} {what}: {', '.join(names[:NAMED])}{more}")
    return lines
