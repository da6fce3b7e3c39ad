"""The command that hands a network to other programs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from orchestration.commands.shared import Aoi, Box, Json, check_range, show

app = typer.Typer()


@app.command()
def export(
    network: Annotated[str, typer.Argument(help="Network to export.")],
    output: Annotated[Path, typer.Option("--out", help="Parquet file to write.")],
    bbox: Box = None,
    aoi: Aoi = None,
    tile: Annotated[str | None, typer.Option("--tile", help="Name of a tile: its sub-MIN alone.")] = None,
    family: Annotated[str, typer.Option("--family", help="Family of correlation functions; auto: the one that enlarges least.")] = "auto",
    rank: Annotated[int, typer.Option("--rank", help="Vectors kept beside the functions.")] = 0,
    floor_km: Annotated[
        float | None,
        typer.Option("--floor-km", help="Distance from which on the functions are zero, at most; for families with zero floor."),
    ] = None,
    policy: Annotated[str, typer.Option("--policy", help="auto, tile, ci, bci, split or rigorous.")] = "auto",
    at: Annotated[str | None, typer.Option("--at", help="Version, such as v12.")] = None,
    max_points: Annotated[int | None, typer.Option("--max-points", help="At most so many points, well spread.")] = None,
    as_json: Json = False,
) -> None:
    """Control points with a compact joint covariance: a 3 x 3 block a point, correlation functions of distance, and a factor.

    The factor makes it consistent: expanded, it claims no more accuracy than the network has. Layout: docs/correlation.md.

    Example: submin export network --out compact.parquet --family exponential --rank 8
    """
    import numpy as np

    import submin
    from orchestration.create import read_area

    if max_points is not None:
        check_range("--max-points", max_points, 1)
    check_range("--rank", rank, 0)
    started = time.monotonic()
    exported = submin.open(network, at).export(
        output, bbox=bbox, area=None if aoi is None else read_area(aoi), tile=tile, policy=policy, max_points=max_points,
        family=family, rank=rank, floor=None if floor_km is None else 1000.0 * floor_km,
    )  # fmt: skip
    compact, n = exported.covariance, len(exported)
    enlarged = float(np.sqrt(compact.inflation.mean()))
    seconds, triangle = time.monotonic() - started, 3 * n * (3 * n + 1) // 2
    values = {
        "points": n, "policy": exported.metadata["policy"], "version": exported.metadata["version"], "scope": exported.metadata["scope"],
        "family": compact.family.name, "functions": [function.parameters for function in compact.functions], "kappa": compact.kappa,
        "factor": compact.factor, "rank": compact.rank, "sigma_inflation": enlarged, "numbers": compact.numbers,
        "numbers_of_full_triangle": triangle, "seconds": seconds, "out": str(output),
    }  # fmt: skip
    beside = f" beside {compact.rank} vectors (kappa {compact.kappa:.3g} without)" if compact.rank else " (kappa)"
    show(values, as_json, f"{n:,} points of {network} {values['version']}: {compact.family.name}, factor {compact.factor:.3g}{beside}, "
         f"sigmas enlarged by {enlarged:.3g} times; {compact.numbers:,} numbers instead of {triangle:,}, {seconds:.1f} s; "
         f"written to {output}")  # fmt: skip
