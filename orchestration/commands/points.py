"""Commands about the points of a network: what is known of them, and until when they are valid."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orchestration.commands.shared import Aoi, Box, Json, counted, show

app = typer.Typer()

Points = Annotated[Path | None, typer.Option("--points", help="CSV or Parquet with a column point_id, or text with one id a line.")]


@app.command()
def points(
    network: Annotated[str, typer.Argument(help="Network to ask.")],
    output: Annotated[Path, typer.Option("--out", help="File to write: .parquet, .csv or .geojson.")],
    bbox: Box = None,
    aoi: Aoi = None,
    ids: Points = None,
    tile: Annotated[str | None, typer.Option("--tile", help="Name of a tile: all points that it holds.")] = None,
    status: Annotated[str | None, typer.Option("--status", help="Only internal, external, check, pending or undetermined points.")] = None,
    at: Annotated[str | None, typer.Option("--at", help="Version, such as v12.")] = None,
    as_json: Json = False,
) -> None:
    """What is known of every point beside its coordinates: rays, blocks, convergence, status, dates, licences. No covariance.

    Example: submin points network --bbox 99 34 101 36 --out points.csv
    """
    import submin
    from orchestration.create import read_area
    from orchestration.point_list import read_point_ids
    from submin.formats.metadata_tables import check_suffix, write_columns
    from submin.query.point_metadata import STATUSES

    check_suffix(output)
    opened = submin.open(network, at)
    found = opened.points(
        bbox=bbox, area=None if aoi is None else read_area(aoi), points=None if ids is None else read_point_ids(ids), tile=tile
    )
    chosen = found if status is None else found.with_status(status)
    metadata = {"version": found.version, "frame": opened.snapshot.metadata.frame, "epoch": found.epoch}
    write_columns(output, chosen.columns(), metadata)
    counts = {name: int((chosen.status == name).sum()) for name in STATUSES}
    values = {"points": len(chosen), "version": found.version, "status": counts, "out": str(output)}
    shown = ", ".join(f"{count:,} {name}" for name, count in counts.items() if count)
    show(
        values, as_json, f"{network} {found.version}: {counted(len(chosen), 'point')}{f' ({shown})' if shown else ''}; written to {output}"
    )


@app.command()
def retire(
    network: Annotated[str, typer.Argument(help="Network that has the points.")],
    ids: Annotated[Path, typer.Option("--points", help="CSV or Parquet with a column point_id, or text with one id a line.")],
    valid_to: Annotated[str | None, typer.Option("--valid-to", metavar="DATE", help="Last day, as 2026-05-31; none takes it back.")] = None,
    valid_from: Annotated[str | None, typer.Option("--valid-from", metavar="DATE", help="First day; none takes it back.")] = None,
    reason: Annotated[str, typer.Option("--reason", help="Why, for those who ask later.")] = "",
    as_json: Json = False,
) -> None:
    """Say until when points are valid: answers for areas and tiles leave them out on other days. Their rays stay.

    Example: submin retire network --points quarry.txt --valid-to 2026-05-31 --reason "quarry extended"
    """
    from orchestration.point_list import read_point_ids
    from orchestration.retire import retire as change

    done = change(network, read_point_ids(ids), valid_to=valid_to, valid_from=valid_from, reason=reason)
    what = f"dates of {counted(done.changed, 'point')} written" if done.changed else "nothing to do, the dates are there already"
    show(done.to_json(), as_json, f"{network} {done.version}: {what}")
