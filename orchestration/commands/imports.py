"""``submin import``: catalogues and control from other files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestration.commands.shared import Json, show

if TYPE_CHECKING:
    from submin.storage.imports import ImportSummary

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
