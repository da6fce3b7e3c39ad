"""``submin import``: catalogues and control from other files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestration.commands.shared import Json, show

if TYPE_CHECKING:
    from submin.storage.gnss_import import GnssImport
    from submin.storage.imports import ImportSummary
    from submin.storage.sinex_import import SolutionImport

app = typer.Typer(no_args_is_help=True, help="Make a catalogue from other files.")


@app.command("rpc")
def import_rpc_command(
    images: Annotated[
        Path, typer.Option("--images", help="CSV with image_id and, where known, acquisition_utc, width, height, col0, row0, rpc.")
    ],
    rpc: Annotated[Path, typer.Option("--rpc", help="Folder of the RPC files.")],
    tracks: Annotated[Path, typer.Option("--tracks", help="CSV with track_id, image_id, col, row.")],
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")],
    blocks: Annotated[str, typer.Option("--blocks", help="What becomes a block: pass, image or all.")] = "pass",
    dataset: Annotated[str | None, typer.Option("--dataset", help="Prefix of the point ids; default: the folder of the CSV.")] = None,
    shared_ids: Annotated[bool, typer.Option("--shared-ids", help="Keep track ids as global point ids.")] = False,
    as_json: Json = False,
) -> None:
    """Make a catalogue from RPC files and tie tracks.

    Example: submin import rpc --images images.csv --rpc rpc --tracks tracks.csv.gz --blocks pass --out catalogue
    """
    from submin.storage.rpc_import import import_rpc

    if blocks not in ("pass", "image", "all"):
        raise typer.BadParameter(f"{blocks!r}; expected pass, image or all", param_hint="--blocks")
    made = import_rpc(images, rpc, tracks, catalogue, blocks=blocks, dataset=dataset, shared_ids=shared_ids)  # type: ignore[arg-type]
    _show_import(made, as_json)


@app.command("isis")
def import_isis_command(
    network: Annotated[Path, typer.Argument(help="ISIS control network: .pvl, .pvl.gz or .net.")],
    cameras: Annotated[
        Path, typer.Option("--cameras", help="Folder of the cameras: ISD files, and images.csv with serial_number and isd.")
    ],
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")],
    images: Annotated[Path | None, typer.Option("--images", help="Table of the images; default: images.csv beside the cameras.")] = None,
    dataset: Annotated[str | None, typer.Option("--dataset", help="Prefix of the point ids; default: the folder of the table.")] = None,
    shared_ids: Annotated[bool, typer.Option("--shared-ids", help="Keep the network's point ids as global point ids.")] = False,
    sigma: Annotated[float, typer.Option("--sigma", help="Of measures without one, pixels as measured.")] = 1.4,
    reduction: Annotated[
        float | None, typer.Option("--reduction", help="Times that images were reduced from the ISD's detector; default: found.")
    ] = None,
    sigma_position: Annotated[float, typer.Option("--sigma-position", help="A priori, of a camera's position, m.")] = 1000.0,
    sigma_attitude: Annotated[float, typer.Option("--sigma-attitude", help="A priori, of its attitude, degrees.")] = 2.0,
    sigma_focal: Annotated[float, typer.Option("--sigma-focal", help="A priori, of its focal length, mm; 0 holds it.")] = 0.0,
    as_json: Json = False,
) -> None:
    """Make a catalogue from an ISIS control network and its frame cameras: free points tie, constrained points are control.

    Example: submin import isis network.pvl --cameras isd --out catalogue
    """
    from submin.storage.isis_import import camera_priors, import_isis

    made = import_isis(
        network, cameras, catalogue, images_csv=images, dataset=dataset, shared_ids=shared_ids, sigma=sigma, reduction=reduction,
        a_priori=camera_priors(sigma_position, sigma_attitude, sigma_focal),
    )  # fmt: skip
    _show_import(made, as_json)


@app.command("gnss")
def import_gnss_command(
    file: Annotated[Path, typer.Argument(help="Measurements: DNA (.msr) or DynaML (.xml), perhaps gzipped.")],
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")],
    values: Annotated[
        Path | None,
        typer.Option("--values", help="CSV with cluster, type, from, to, component, the file's values and those to take instead."),
    ] = None,
    value_column: Annotated[str | None, typer.Option("--value-column", help="Column of --values to take; default: the last.")] = None,
    frame: Annotated[str | None, typer.Option("--frame", help="Of the catalogue; default: that of the file's header.")] = None,
    epoch: Annotated[str | None, typer.Option("--epoch", help="Of the catalogue; default: that of the file's header.")] = None,
    dataset: Annotated[str | None, typer.Option("--dataset", help="Prefix of the ids; default: the folder of the file.")] = None,
    shared_ids: Annotated[bool, typer.Option("--shared-ids", help="Keep station names as global point ids.")] = False,
    as_json: Json = False,
) -> None:
    """Make a catalogue of GNSS positions and baselines with full covariance. Nothing is transformed.

    Example: submin import gnss network.msr --values transformed.csv --out catalogue
    """
    from submin.storage.gnss_import import import_gnss

    made = import_gnss(
        file, catalogue, values=values, value_column=value_column, frame=frame, epoch=epoch, dataset=dataset, shared_ids=shared_ids
    )
    _show_gnss(made, as_json)


@app.command("sinex")
def import_sinex_command(
    file: Annotated[Path, typer.Argument(help="SINEX solution, or .msr or .xml with one cluster of positions; perhaps gzipped.")],
    control: Annotated[Path, typer.Option("--out", help="Table of control to write (.parquet).")],
    keep_constraints: Annotated[
        bool, typer.Option("--keep-constraints", help="Take the estimate as it stands, with its a priori constraint.")
    ] = False,
    frame: Annotated[str | None, typer.Option("--frame", help="Frame of the coordinates; a file that states another is refused.")] = None,
    epoch: Annotated[str | None, typer.Option("--epoch", help="Epoch of the coordinates; a file that states another is refused.")] = None,
    prefix: Annotated[str, typer.Option("--prefix", help="Goes before each station's name in its point id.")] = "",
    as_json: Json = False,
) -> None:
    """Write the positions of a geodetic solution as control with full covariance, its a priori constraint taken out.

    Example: submin import sinex solution.snx.gz --out control.parquet
    """
    from submin.storage.sinex_import import import_solution

    made = import_solution(file, control, keep_constraints=keep_constraints, frame=frame, epoch=epoch, prefix=prefix)
    _show_solution(made, as_json)


def _show_gnss(made: GnssImport, as_json: bool) -> None:
    values = {
        "catalogue": str(made.catalogue), "dataset": made.dataset, "frame": made.frame, "epoch": made.epoch, "clusters": made.clusters,
        "positions": made.positions, "baselines": made.baselines, "points": made.points, "ignored": made.ignored,
        "notes": list(made.notes),
    }  # fmt: skip
    text = (
        f"{made.catalogue}: {made.positions:,} positions and {made.baselines:,} baselines of {made.points:,} points in {made.clusters:,} "
        f"cluster{'s' * (made.clusters != 1)}, {' at '.join(filter(None, (made.frame, made.epoch)))}"
    )
    show(values, as_json, "\n".join([text, *(f"note: {note}" for note in made.notes)]))


def _show_solution(made: SolutionImport, as_json: bool) -> None:
    values = {
        "control": str(made.file), "points": made.points, "frame": made.frame, "epoch": made.epoch, "constraint": made.constraint,
        "constraint_share": made.constraint_share, "sigma_min_m": made.sigma_min, "sigma_max_m": made.sigma_max,
        "notes": list(made.notes),
    }  # fmt: skip
    where = " at ".join(filter(None, (made.frame, made.epoch)))
    text = (
        f"{made.file}: {made.points:,} points with joint covariance{f', {where}' if where else ''}; "
        f"standard deviations {1e3 * made.sigma_min:.3g} to {1e3 * made.sigma_max:.3g} mm"
    )
    show(values, as_json, "\n".join([text, *(f"note: {note}" for note in made.notes)]))


def _show_import(made: ImportSummary, as_json: bool) -> None:
    values = {
        "catalogue": str(made.catalogue), "dataset": made.dataset, "blocks": made.blocks, "passes": made.passes, "images": made.images,
        "points": made.points, "rays": made.rays, "control": made.control, "notes": list(made.notes),
    }  # fmt: skip
    text = (
        f"{made.catalogue}: {made.images} images in {made.blocks} block{'s' * (made.blocks != 1)} of {made.passes} passes, "
        f"{made.points:,} points, {made.rays:,} rays" + (f", {made.control:,} control points" if made.control else "")
    )
    show(values, as_json, "\n".join([text, *(f"note: {note}" for note in made.notes)]))
