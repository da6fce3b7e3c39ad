"""Commands that only read a network: query, check, map, info, diff, history."""

from __future__ import annotations

import time
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from orchestration.commands.shared import Aoi, Box, Json, check_applies, check_range, out, show

if TYPE_CHECKING:
    from submin.storage.repository import Version

app = typer.Typer()


@app.command()
def query(
    network: Annotated[str, typer.Argument(help="Network to ask.")],
    bbox: Box = None,
    aoi: Aoi = None,
    points: Annotated[
        Path | None, typer.Option("--points", help="CSV or Parquet with a column point_id, or text with one id a line.")
    ] = None,
    tile: Annotated[str | None, typer.Option("--tile", help="Name of a tile: its sub-MIN alone.")] = None,
    policy: Annotated[str, typer.Option("--policy", help="auto, tile, ci, bci, split or rigorous.")] = "auto",
    at: Annotated[str | None, typer.Option("--at", help="Version, such as v12.")] = None,
    max_points: Annotated[int | None, typer.Option("--max-points", help="At most so many points, well spread and well determined.")] = None,
    on: Annotated[str | None, typer.Option("--on", metavar="DATE", help="Day on which points must be valid; default: today (UTC).")] = None,
    details: Annotated[
        bool, typer.Option("--details", help="Columns status, first_block, last_block, blocks, convergence and licences too.")
    ] = False,
    join: Annotated[
        Path | None, typer.Option("--join", help="Control from elsewhere, a query written as .parquet or .npz, that joins by ci.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--out", help="File to write: .parquet, .npz (joint covariance), .geojson, .csv or .gcp.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Control points of an area, with their joint covariance.

    Example: submin query network --bbox 99 34 101 36 --policy rigorous --out control.parquet
    """
    import submin
    from orchestration.create import read_area
    from orchestration.point_list import read_point_ids
    from submin.errors import InputError
    from submin.storage.validity import read_date

    if max_points is not None:
        check_range("--max-points", max_points, 1)
    day = None if on is None else date.fromisoformat(read_date(on, "--on"))
    if output is None:
        check_applies({"--details": details or None}, "--out")
    if join is not None and details:
        raise InputError("--details says what this network knows of its points, and --join brings others; leave one of them out")
    elsewhere = None if join is None else submin.read_control(join)
    started = time.monotonic()
    opened = submin.open(network, at)
    control = opened.query(
        bbox=bbox, area=None if aoi is None else read_area(aoi), points=None if points is None else read_point_ids(points),
        tile=tile, policy=policy, max_points=max_points, on=day,
    )  # fmt: skip
    answered = control.policy
    if elsewhere is not None:
        control = control.joined(elsewhere)
    if output is not None:
        control.write(output, opened.points(points=control.ids).details() if details else {})
    seconds = time.monotonic() - started
    values = {
        "points": len(control), "policy": control.policy, "tiles": list(control.tiles), "version": control.version, "scope": control.scope,
        "policy_asked": policy, "policy_of_network": answered, "joined": None if join is None else str(join),
        "blocks": len(control.blocks), "seconds": seconds, "out": None if output is None else str(output),
        "validity": list(control.validity),
    }  # fmt: skip
    if opened.dense is not None:
        values |= {"chi_square": opened.dense.points.chi_square, "degrees_of_freedom": opened.dense.points.redundancy}
    if not len(control):
        show(values, as_json, f"{network} {control.version}: no determined points there")
        return
    import numpy as np

    values |= {"ce90_median": float(np.median(control.ce90)), "le90_median": float(np.median(control.le90))}
    shown = "" if output is None else f"; written to {output}"
    chosen = f"policy {answered}{' (chosen by auto)' if policy == 'auto' else ''}"
    joined = "" if join is None else f", joined with {join} by ci"
    show(values, as_json, f"{len(control):,} points of {network} {control.version}, {chosen} over {len(control.tiles)} "
         f"tile{'s' if len(control.tiles) > 1 else ''}{joined} (scope: {control.scope}), "
         f"median CE90 {values['ce90_median']:.3g} m, LE90 {values['le90_median']:.3g} m, {seconds:.2f} s{shown}")  # fmt: skip


@app.command()
def check(
    network: Annotated[str, typer.Argument(help="Network to check.")],
    points: Annotated[Path, typer.Argument(help="Table of check points, by the ids of tie points.")],
    policy: Annotated[str, typer.Option("--policy", help="auto, tile, ci, bci, split or rigorous.")] = "rigorous",
    output: Annotated[Path | None, typer.Option("--out", help="Text file that takes the table too.")] = None,
    as_json: Json = False,
) -> None:
    """Compare a network with check points: errors, stated accuracy, per cent within it, NEES. Its own control is left out.

    Example: submin check network catalogue/check.parquet
    """
    import submin
    from orchestration.check import check as compare
    from orchestration.text_tables import as_wide_as
    from submin.formats.replacing import replacing
    from submin.storage.point_table import read_point_table

    result = compare(submin.open(network), read_point_table(points), policy)
    table = Table(title=escape(f"{network} {result.version} against {points.name}, policy {policy}"), title_justify="left")
    headings = ("area", "points", "hor. 50 %", "90 %", "95 %", "mean CE90", "within", "vert. 50 %", "90 %", "95 %", "mean LE90", "within")
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "area" else "right", no_wrap=True)
    for name, a in {"all": result.accuracy, **result.by_area}.items():
        lengths = (f"{v:.2f} m" for v in (a.horizontal_p50, a.horizontal_p90, a.horizontal_p95, a.mean_ce90))
        heights = (f"{v:.2f} m" for v in (a.vertical_p50, a.vertical_p90, a.vertical_p95, a.mean_le90))
        table.add_row(
            escape(name), f"{a.points:,}", *lengths, f"{a.per_cent_within_ce90:.1f} %", *heights, f"{a.per_cent_within_le90:.1f} %"
        )  # fmt: skip
    closing = (
        f"NEES per degree of freedom {result.nees_per_dof:.4f} (99 % band {result.nees_band[0]:.4f} to {result.nees_band[1]:.4f} "
        f"when the stated covariance is exact); {result.missing} check points are not determined in the network"
    )
    if result.control_left_out:
        closing += f"; {result.control_left_out} are control of the network, which cannot check itself, and were left out"
    width = as_wide_as(table)
    if output is not None:
        with replacing(output) as temporary, temporary.open("w", encoding="utf-8") as stream:
            plain = Console(file=stream, width=width)
            plain.print(table)
            plain.print(closing, soft_wrap=True)
    if as_json:
        show(result.to_json(), True, "")
    else:
        wide = Console(highlight=False, width=width)
        wide.print(table)
        wide.print(closing, soft_wrap=True)


@app.command("map")
def map_command(
    network: Annotated[str, typer.Argument(help="Network to draw.")],
    output: Annotated[Path, typer.Option("--out", help="PNG file to write.")],
    as_json: Json = False,
) -> None:
    """Draw a network: points by CE90, tiles and cells, footprints.

    Example: submin map network --out network.png
    """
    import submin
    from orchestration.network_map import draw_network
    from submin.storage.dense_reader import refuse_dense

    opened = submin.open(network)
    refuse_dense(opened.snapshot, "a map")
    draw_network(opened, output)
    show({"out": str(output)}, as_json, f"map written to {output}")


@app.command()
def info(
    network: Annotated[str, typer.Argument(help="Network to describe.")],
    at: Annotated[str | None, typer.Option("--at", help="Version, such as v12.")] = None,
    as_json: Json = False,
) -> None:
    """What a network holds.

    Example: submin info network
    """
    import submin
    from orchestration.info import describe

    values = describe(submin.open(network, at))
    table = Table(show_header=False, box=None)
    for key, value in values.items():
        shown = f"{value:,}" if isinstance(value, int) else f"{value:.3g}" if isinstance(value, float) else str(value)
        table.add_row(key.replace("_", " "), shown)
    if as_json:
        show(values, True, "")
    else:
        out.print(table)


@app.command()
def diff(
    network: Annotated[str, typer.Argument(help="Network.")],
    before: Annotated[str, typer.Argument(metavar="VERSION1", help="The one version, such as v11 or a tag.")],
    after: Annotated[str, typer.Argument(metavar="VERSION2", help="The other.")],
    as_json: Json = False,
) -> None:
    """Points that moved between two versions, by how much, against the CE90 and LE90 that the first one stated.

    Example: submin diff network v11 v12
    """
    import submin
    from orchestration.diff import difference

    found = difference(submin.open(network, before), submin.open(network, after))
    values = found.to_json()
    if as_json or not len(found.ids):
        show(values, as_json, f"{network}: {found.before} has {len(found.gone)} points, {found.after} has {len(found.new)}, none in common")
        return
    out.print(
        f"{network} {found.before} to {found.after}: {len(found.ids):,} points in both, {len(found.new):,} new, {len(found.gone):,} gone; "
        f"{values['beyond_stated']:,} moved by more than the CE90 or LE90 stated in {found.before}", soft_wrap=True,
    )  # fmt: skip
    table = Table(title_justify="left")
    for heading in ("", "moved 50 %", "90 %", "most", f"median stated in {found.before}", f"in {found.after}"):
        table.add_column(heading, justify="left" if not heading else "right")
    for name, stated in (("horizontal", "ce90_median"), ("vertical", "le90_median")):
        table.add_row(name, *(f"{values[name][q]:.3g} m" for q in ("p50", "p90", "max")), *(f"{v:.3g} m" for v in values[stated]))
    out.print(table)
    worst = Table(title="points that moved most, against what was stated", title_justify="left")
    for heading in ("point", "horizontal", "CE90", "up", "LE90"):
        worst.add_column(heading, justify="left" if heading == "point" else "right")
    for row in values["worst"]:
        worst.add_row(row["point_id"], *(f"{row[name]:.3g} m" for name in ("horizontal", "ce90", "vertical", "le90")))
    out.print(worst)


@app.command()
def history(network: Annotated[str, typer.Argument(help="Network.")], as_json: Json = False) -> None:
    """Versions of a network, the newest first.

    Example: submin history network
    """
    from submin.storage.repository import versions

    found = versions(network)
    values = {
        "versions": [{"version": v.name, "written": v.written.isoformat(), "message": v.message, "snapshot": v.snapshot,
                      "tags": list(v.tags)} for v in found]
    }  # fmt: skip
    show(values, as_json, "\n".join(f"{v.name:>6}  {v.written:%Y-%m-%d %H:%M:%S}  {v.message}{_tags(v)}" for v in found))


def _tags(version: Version) -> str:
    return f"  ({', '.join(version.tags)})" if version.tags else ""
