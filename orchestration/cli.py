"""The command line: ``submin COMMAND``.

Exit codes: 0 done; 1 done in part (some blocks rejected; each is named with its reason); 2 wrong usage or bad input, nothing written,
or the cluster was lost (what was committed stays); 130 and 143 stopped by Ctrl-C and by SIGTERM (what was committed stays).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from orchestration.stopping import Stopped, signals_stop

if TYPE_CHECKING:
    from submin.simulation.scene import Layout
    from submin.storage.imports import ImportSummary
    from submin.storage.network_store import Version

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich",
    help="Ground-control networks for a continent: blocks of satellite images in, control points with joint covariance out.",
)  # fmt: skip
control_app = typer.Typer(no_args_is_help=True, help="Surveyed control points.")
import_app = typer.Typer(no_args_is_help=True, help="Make a catalogue from other files.")
simulate_app = typer.Typer(no_args_is_help=True, help="Make a catalogue of simulated images, with truth.")
app.add_typer(import_app, name="import")
app.add_typer(simulate_app, name="simulate")
app.add_typer(control_app, name="control")

out = Console(highlight=False)

MOST_WORKERS = 1024
USAGE_ERROR: type[typer.BadParameter] = typer.BadParameter.__mro__[1]
"""Base of all that the parser raises; newer releases of typer keep it in a private package."""

Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
Box = Annotated[
    tuple[float, float, float, float] | None, typer.Option("--bbox", metavar="W S E N", help="West, south, east, north in degrees.")
]
Aoi = Annotated[Path | None, typer.Option("--aoi", help="GeoJSON file with the area.")]
Seed = Annotated[int, typer.Option("--seed", help="Of the random numbers; the same seed gives the same catalogue.")]
Workers = Annotated[int, typer.Option("--workers", help="Processes of a local Dask cluster; 0 runs without one.")]
Scheduler = Annotated[str | None, typer.Option("--scheduler", help="Address of a running Dask scheduler.")]


def show(values: dict[str, Any], as_json: bool, text: str) -> None:
    """One JSON object, or text for people."""
    if as_json:
        sys.stdout.write(json.dumps(values) + "\n")
    elif text:
        out.print(text, soft_wrap=True)


def check_range(option: str, value: int, least: int, most: int | None = None) -> None:
    """Refuse the value of an option that is out of its range."""
    if value < least or (most is not None and value > most):
        from submin.errors import InputError

        raise InputError(f"{option} is {value}; expected {least} {'or more' if most is None else f'to {most}'}")


def check_applies(given: Mapping[str, object], needed: str) -> None:
    """Refuse options (None: not given) that say something only beside another one."""
    for option, value in given.items():
        if value is not None:
            from submin.errors import InputError

            raise InputError(f"{option} is given without {needed}, where it says nothing; give {needed} too, or leave {option} out")


def counted(number: int, noun: str) -> str:
    """Such as 1 block, 2,000 blocks."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


@import_app.command("rpc")
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


@import_app.command("isis")
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


@simulate_app.command("region")
def simulate_region_command(
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")],
    scale: Annotated[float, typer.Option("--scale", help="Part of the 400 km x 400 km in area.")] = 1.0,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Simulate three-line triplets over a region: some 150 blocks, 0.2 % blunders, one bad camera.

    Example: submin simulate region --out catalogue --scale 0.25
    """
    from submin.errors import InputError
    from submin.simulation.region import RegionDesign, simulate_region
    from submin.storage.simulated import write_region

    if not 0.01 <= scale <= 100.0:
        raise InputError(f"--scale is {scale:g}; expected 0.01 to 100")
    check_range("--seed", seed, 0)
    side = 400.0 * scale**0.5
    region = simulate_region(RegionDesign(width_km=side, height_km=side, seed=seed))
    write_region(region, catalogue)
    values = {
        "catalogue": str(catalogue), "simulated": True, "images": len(region.images), "blocks": len({i.block_id for i in region.images}),
        "points": len(region.point_ids), "rays": len(region.image), "blunders": int(region.blunder.sum()),
        "bad_cameras": list(region.bad_cameras),
    }  # fmt: skip
    show(values, as_json, f"{catalogue}: simulated {values['images']} images in {values['blocks']} blocks, {values['points']:,} points, "
         f"{values['rays']:,} rays, of which {values['blunders']} blunders; bad camera: {', '.join(region.bad_cameras)}")  # fmt: skip


@simulate_app.command("five-blocks")
def simulate_five_blocks_command(
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")], seed: Seed = 0, as_json: Json = False
) -> None:
    """Simulate the 2008 MIN paper's experiment: 18 frame images in 5 blocks, 62 points, and four surveyed ones as control-external.

    Example: submin simulate five-blocks --out catalogue
    """
    from submin.simulation.five_blocks import five_blocks

    simulate_layout(five_blocks(), catalogue, seed, as_json)


@simulate_app.command("worldview")
def simulate_worldview_command(
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")], seed: Seed = 0, as_json: Json = False
) -> None:
    """Simulate the 2010 paper's experiment: 50 WorldView-1 pairs, 1,347 points, 101 of them surveyed, nine of these in control-external.

    Example: submin simulate worldview --out catalogue
    """
    from submin.simulation.worldview import worldview

    simulate_layout(worldview(), catalogue, seed, as_json)


def simulate_layout(layout: Layout, catalogue: Path, seed: int, as_json: bool) -> None:
    """Write a realisation of a layout and say what it holds."""
    from submin.simulation.scene import realise
    from submin.storage.simulated import write_scene

    check_range("--seed", seed, 0)
    write_scene(realise(layout, seed), catalogue)
    values = {
        "catalogue": str(catalogue), "simulated": True, "images": len(layout.images), "blocks": len(layout.priors),
        "points": len(layout.point_ids), "rays": len(layout.image), "check_points": len(layout.check.points),
        "external_control": layout.point_ids[layout.control.points].tolist(),
    }  # fmt: skip
    show(values, as_json, f"{catalogue}: simulated {values['images']} images in {values['blocks']} blocks, {values['points']:,} points, "
         f"{values['rays']:,} rays; external control, not in a run by itself: {catalogue}/control-external.parquet")  # fmt: skip


@app.command()
def create(
    network: Annotated[str, typer.Argument(help="Folder or s3:// URL of the new network.")],
    bbox: Box = None,
    aoi: Aoi = None,
    fit: Annotated[
        Path | None, typer.Option("--fit", help="Catalogue whose footprints give the area, and tile sizes that suit them.")
    ] = None,
    tile_km: Annotated[float | None, typer.Option("--tile-km", help="Side of a core; default 100, or 4 footprints with --fit.")] = None,
    overlap_km: Annotated[float | None, typer.Option("--overlap-km", help="Width that neighbours share, below the core's.")] = None,
    form: Annotated[str, typer.Option("--form", help="Form of the sub-MINs.")] = "factored",
    frame: Annotated[str, typer.Option("--frame", help="Frame of the coordinates; with --fit the catalogue's.")] = "WGS84",
    epoch: Annotated[str, typer.Option("--epoch", help="Epoch of the frame; with --fit the catalogue's.")] = "",
    max_parameters: Annotated[
        int, typer.Option("--max-parameters", min=60, help="A tile that sees more image parameters (6 an image) is split into four.")
    ] = 2500,
    as_json: Json = False,
) -> None:
    """Make an empty network over an area.

    Example: submin create network --bbox 97 33 103 37 --tile-km 100 --overlap-km 50
    """
    from orchestration.create import create as make
    from orchestration.create import fit_catalogue, read_area
    from submin.errors import InputError
    from submin.storage.catalogue import Catalogue
    from submin.storage.catalogue_schema import CatalogueMetadata
    from submin.storage.network import box_area

    if sum(value is not None for value in (bbox, aoi, fit)) != 1:
        raise InputError("give the area by exactly one of --bbox, --aoi and --fit")
    metadata = CatalogueMetadata(name="network", frame=frame, epoch=epoch)
    if fit is not None:
        fitted = Catalogue.open(fit)
        area, core, shared = fit_catalogue(fitted)
        metadata, tile_km = fitted.metadata, core if tile_km is None else tile_km
        overlap_km = min(shared, 0.5 * tile_km) if overlap_km is None else overlap_km
    else:
        area = box_area(bbox) if bbox is not None else read_area(aoi)  # type: ignore[arg-type]
    made = make(network, area, metadata, tile_km, overlap_km, form, max_parameters)
    cover = made.cover
    show(made.to_json(), as_json, f"{network}: {cover.rows} x {cover.columns} tiles, cores of {cover.core / 1000:g} km, "
         f"overlap {cover.overlap / 1000:g} km, frame {metadata.frame}")  # fmt: skip


@app.command()
def run(
    catalogue: Annotated[Path, typer.Argument(help="Catalogue of image blocks.")],
    network: Annotated[str, typer.Argument(help="Network that takes them.")],
    workers: Workers = 0,
    scheduler: Scheduler = None,
    batch_blocks: Annotated[int, typer.Option("--batch-blocks", help="Blocks that one commit holds.")] = 500,
    sequential: Annotated[bool, typer.Option("--sequential", help="Fuse block by block, in the order of the catalogue.")] = False,
    as_json: Json = False,
) -> None:
    """Fuse every block of a catalogue that the network does not have yet. The same command again continues, or says that nothing is left.

    Example: submin run catalogue network --workers 2
    """
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.run import run as fuse
    from orchestration.stopping import resumable
    from submin.storage.catalogue import Catalogue

    check_range("--workers", workers, 0, MOST_WORKERS)
    check_range("--batch-blocks", batch_blocks, 1)
    opened = Catalogue.open(catalogue)
    with resumable(network), progress_bars(quiet=as_json) as reporter, executor_for(workers, scheduler) as executor:
        result = fuse(opened, network, executor, batch_blocks=1 if sequential else batch_blocks, reporter=reporter)
    lines = [f"{network} {result.version}: {result.fused} blocks fused, {result.skipped} already there, {len(result.rejected)} rejected"]
    if result.rays_used:
        lines.append(
            f"{result.rays_used:,} rays used, {result.rays_rejected:,} rejected as blunders, RMS {result.ray_rms_px:.3f} px; "
            f"{result.seconds:.1f} s, {result.peak_memory_mb:.0f} MB"
        )
    if not result.fused and not result.rejected:
        lines[0] = f"{network} {result.version}: nothing is left to do, all {result.skipped} blocks are in the network"
    lines += [f"bad camera {f.image_id}: {f.reason}" for f in result.flagged]
    lines += [f"rejected block {r.block_id}: {r.reason}" for r in result.rejected]
    lines += [f"tile {t}: the judgement of its rays did not settle; they are used as last judged" for t in result.unsettled_tiles]
    show(result.to_json(), as_json, "\n".join(lines))
    if result.rejected:
        raise typer.Exit(1)


@control_app.command("add")
def control_add(
    network: Annotated[str, typer.Argument(help="Network that takes them.")],
    points: Annotated[Path, typer.Argument(help="Table of surveyed points with their covariance or sigmas.")],
    workers: Workers = 0,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Add surveyed control points, known by the ids of tie points or new ones. The same file again does nothing.

    Example: submin control add network control.parquet
    """
    from orchestration.control import add_control
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.stopping import resumable
    from submin.storage.point_table import read_point_table

    table = read_point_table(points, "definite")
    with resumable(network), progress_bars(quiet=as_json) as reporter, executor_for(workers, scheduler) as executor:
        added = add_control(table, str(points), network, executor, reporter)
    lines = [
        f"{network} {added.version}: {added.fused} control points added, {added.skipped} already there, {len(added.rejected)} rejected"
    ]
    lines += [f"rejected {r.point_id}: {r.reason}" for r in added.rejected]
    show(added.to_json(), as_json, "\n".join(lines))
    if added.rejected:
        raise typer.Exit(1)


@app.command()
def withdraw(
    network: Annotated[str, typer.Argument(help="Network to withdraw from.")],
    block: Annotated[str | None, typer.Option("--block", help="Id of a block, with all its images.")] = None,
    image: Annotated[str | None, typer.Option("--image", help="Id of one image; the rest of its block stays.")] = None,
    control: Annotated[str | None, typer.Option("--control", help="Id of a control point.")] = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Withdraw a block, an image or a control point, as if it had never been fused. It can come again.

    Example: submin withdraw network --image IMAGE_17
    """
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.stopping import resumable
    from orchestration.withdraw import withdraw as take

    with resumable(network), progress_bars(quiet=as_json) as reporter, executor_for(workers, scheduler) as executor:
        done = take(network, executor, block=block, image=image, control=control, reporter=reporter)
    show(done.to_json(), as_json, f"{network} {done.version}: {done.what} withdrawn with {done.rays:,} rays; "
         f"{len(done.tiles)} tiles judged again")  # fmt: skip


@app.command()
def query(
    network: Annotated[str, typer.Argument(help="Network to ask.")],
    bbox: Box = None,
    aoi: Aoi = None,
    points: Annotated[
        Path | None, typer.Option("--points", help="CSV or Parquet with a column point_id, or text with one id a line.")
    ] = None,
    tile: Annotated[str | None, typer.Option("--tile", help="Name of a tile: its sub-MIN alone.")] = None,
    policy: Annotated[str, typer.Option("--policy", help="auto, tile, ci or rigorous.")] = "auto",
    at: Annotated[str | None, typer.Option("--at", help="Version, such as v12.")] = None,
    max_points: Annotated[int | None, typer.Option("--max-points", help="At most so many points, well spread.")] = None,
    output: Annotated[
        Path | None, typer.Option("--out", help="File to write: .parquet, .npz (joint covariance), .geojson or .csv.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Control points of an area, with their joint covariance.

    Example: submin query network --bbox 99 34 101 36 --policy rigorous --out control.parquet
    """
    import submin
    from orchestration.create import read_area
    from orchestration.point_list import read_point_ids

    if max_points is not None:
        check_range("--max-points", max_points, 1)
    started = time.monotonic()
    control = submin.open(network, at).query(
        bbox=bbox, area=None if aoi is None else read_area(aoi), points=None if points is None else read_point_ids(points),
        tile=tile, policy=policy, max_points=max_points,
    )  # fmt: skip
    if output is not None:
        control.write(output)
    seconds = time.monotonic() - started
    values = {
        "points": len(control), "policy": control.policy, "tiles": list(control.tiles), "version": control.version, "scope": control.scope,
        "blocks": len(control.blocks), "seconds": seconds, "out": None if output is None else str(output),
    }  # fmt: skip
    if not len(control):
        show(values, as_json, f"{network} {control.version}: no determined points there")
        return
    import numpy as np

    values |= {"ce90_median": float(np.median(control.ce90)), "le90_median": float(np.median(control.le90))}
    shown = "" if output is None else f"; written to {output}"
    show(values, as_json, f"{len(control):,} points of {network} {control.version}, policy {control.policy} over {len(control.tiles)} "
         f"tile{'s' if len(control.tiles) > 1 else ''} (scope: {control.scope}), "
         f"median CE90 {values['ce90_median']:.3g} m, LE90 {values['le90_median']:.3g} m, {seconds:.2f} s{shown}")  # fmt: skip


@app.command()
def adjust(
    catalogue: Annotated[Path, typer.Argument(help="Catalogue that holds the block.")],
    block: Annotated[str, typer.Option("--block", help="Id of the block.")],
    output: Annotated[Path, typer.Option("--out", help="Folder to write: cameras, their covariance, points, report.")],
    network: Annotated[
        str | None, typer.Option("--network", help="Network that controls it; without one the catalogue's control table does, if any.")
    ] = None,
    policy: Annotated[
        str | None, typer.Option("--policy", help="Of the network's answer: auto, tile, ci or rigorous; default auto.")
    ] = None,
    at: Annotated[str | None, typer.Option("--at", help="Version of the network, such as v12.")] = None,
    max_points: Annotated[
        int, typer.Option("--max-points", help="Control points taken, and points written with joint covariance, at most.")
    ] = 2000,
    virtual_control: Annotated[
        int | None,
        typer.Option("--virtual-control", metavar="N", help="N x N virtual control points an image: no accuracy is stated then."),
    ] = None,
    virtual_sigma: Annotated[
        float | None, typer.Option("--virtual-sigma", help="Positioning accuracy of an image, pixels; default 7.5.")
    ] = None,
    virtual_weight: Annotated[
        str | None, typer.Option("--virtual-weight", help="plain, the default, or balanced (times tie points over virtual ones).")
    ] = None,
    virtual_height: Annotated[
        float | None, typer.Option("--virtual-height", help="Height of the virtual points, m; default: each camera's mean height.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Adjust one new block: cameras and points with their covariance, controlled by a network. Nothing goes into the network.

    Example: submin adjust catalogue --block PASS_7 --network network --out adjusted
    """
    from orchestration.adjust import VirtualDesign, named, write
    from orchestration.adjust import adjust as stage_one
    from submin.storage.adjusted import refuse_occupied
    from submin.storage.catalogue import Catalogue

    check_range("--max-points", max_points, 1)
    design = None
    if virtual_control is None:
        virtual = {"--virtual-sigma": virtual_sigma, "--virtual-weight": virtual_weight, "--virtual-height": virtual_height}
        check_applies(virtual, "--virtual-control")
    else:
        sigma = 7.5 if virtual_sigma is None else virtual_sigma
        design = VirtualDesign(virtual_control, sigma, virtual_weight or "plain", virtual_height)
    if network is None:
        check_applies({"--policy": policy, "--at": at}, "--network")
    refuse_occupied(output)
    done = stage_one(Catalogue.open(catalogue), block, network, version=at, policy=policy or "auto", most=max_points, virtual=design)
    write(done, output)
    values = done.values
    factor = "" if values["variance_factor"] is None else f", variance factor {values['variance_factor']:.3g}"
    lines = [
        f"{named(block)}: {counted(values['images'], 'image')}, {counted(values['points'], 'point')}, "
        f"{counted(values['control_points'], 'control point')}, {counted(len(values['rejected_rays']), 'ray')} rejected{factor}; "
        f"{values['status']}; written to {output}"
    ]
    if "innovation" in values and values["innovation"]["dof"]:
        test = values["innovation"]
        lines.append(
            f"control against block: chi-square {test['d2']:.1f}, {test['dof']} degrees of freedom, probability {test['probability']:.2g}"
        )
    lines += [values["accuracy"]] if design is not None else []
    if values["check"] and values["check"]["left_out"]:
        lines.append(f"{values['check']['points']:,} check points compared, the first by id; {values['check']['left_out']:,} left out")
    lines += [f"bad camera {f['image_id']}: {f['reason']}" for f in values["images_flagged"]]
    lines += [f"control point {r['point_id']}: {r['reason']}" for r in values["control_rejected"]]
    show({**values, "out": str(output)}, as_json, "\n".join(lines))
    if done.partly:
        raise typer.Exit(1)


@app.command()
def readjust(
    catalogue: Annotated[Path, typer.Argument(help="Catalogue whose blocks the network has.")],
    network: Annotated[str, typer.Argument(help="Network with them.")],
    output: Annotated[Path, typer.Option("--out", help="Folder to write: cameras and their covariance.")],
    block: Annotated[str | None, typer.Option("--block", help="One block only.")] = None,
    policy: Annotated[str, typer.Option("--policy", help="Of the network's points: auto, tile, ci or rigorous.")] = "auto",
    deweight: Annotated[
        float | None,
        typer.Option("--deweight", metavar="F", help="For comparison: a priori covariance x F^2 instead of the rigorous form."),
    ] = None,
    at: Annotated[str | None, typer.Option("--at", help="Version of the network, such as v12.")] = None,
    as_json: Json = False,
) -> None:
    """Cameras of earlier blocks from the final network (MIN++), as one adjustment of everything would have them.

    Example: submin readjust catalogue network --out cameras
    """
    from orchestration.readjust import readjust_network
    from submin.storage.adjusted import refuse_occupied
    from submin.storage.catalogue import Catalogue

    refuse_occupied(output)
    done = readjust_network(Catalogue.open(catalogue), network, output, block=block, policy=policy, deweight=deweight, version=at)
    values = done.to_json()
    lines = [
        f"{counted(done.images, 'image')} of {counted(done.blocks, 'block')}, from the points of {network} {done.version} "
        f"({values['status']}; policy {', '.join(done.policies) or 'none'} over {counted(len(done.tiles), 'tile')}); written to {output}"
    ]
    lines += [f"camera {name}: its a priori model was given up, as the network did" for name in done.images_released]
    if done.blocks_missing:
        lines.append(f"not in the network: {counted(len(done.blocks_missing), 'block')}, such as {', '.join(done.blocks_missing[:5])}")
    show({**values, "out": str(output)}, as_json, "\n".join(lines))


@app.command()
def check(
    network: Annotated[str, typer.Argument(help="Network to check.")],
    points: Annotated[Path, typer.Argument(help="Table of check points, by the ids of tie points.")],
    policy: Annotated[str, typer.Option("--policy", help="auto, tile, ci or rigorous.")] = "rigorous",
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

    draw_network(submin.open(network), output)
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
def tag(
    network: Annotated[str, typer.Argument(help="Network.")],
    name: Annotated[str, typer.Argument(help="Name to give, a word such as delivered-2026.")],
    at: Annotated[str | None, typer.Option("--at", help="Version; default: the newest.")] = None,
    as_json: Json = False,
) -> None:
    """Give a version a name that stays; --at takes it wherever it takes a version.

    Example: submin tag network delivered-2026 --at v12
    """
    from submin.storage.network_store import tag_version

    version = tag_version(network, name, at)
    show({"version": version.name, "tags": list(version.tags)}, as_json, f"{network} {version.name} is tagged {name}")


@app.command()
def history(network: Annotated[str, typer.Argument(help="Network.")], as_json: Json = False) -> None:
    """Versions of a network, the newest first.

    Example: submin history network
    """
    from submin.storage.network_store import versions

    found = versions(network)
    values = {
        "versions": [{"version": v.name, "written": v.written.isoformat(), "message": v.message, "snapshot": v.snapshot,
                      "tags": list(v.tags)} for v in found]
    }  # fmt: skip
    show(values, as_json, "\n".join(f"{v.name:>6}  {v.written:%Y-%m-%d %H:%M:%S}  {v.message}{_tags(v)}" for v in found))


def _tags(version: Version) -> str:
    return f"  ({', '.join(version.tags)})" if version.tags else ""


def main() -> None:
    """Run the command line; an error, or a signal to stop, is one line on standard error."""
    try:
        with signals_stop():
            from submin.errors import SubminError  # the first import that takes time

            try:
                sys.exit(app(prog_name="submin", standalone_mode=False))
            except (SubminError, OSError, USAGE_ERROR) as error:
                _fail(" ".join(_message(error).split()), 2)
    except Stopped as stopped:
        _fail(str(stopped), stopped.exit_code)


def _fail(message: str, code: int) -> NoReturn:
    if message:  # a group of commands without one has printed its help
        Console(stderr=True, highlight=False, markup=False).print(f"submin: {message}", soft_wrap=True)
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps({"error": message}) + "\n")
    sys.exit(code)


def _message(error: Exception) -> str:
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        return f"{name}cannot be read or written ({error.strerror or error}); check path, permissions and free space"
    if isinstance(error, USAGE_ERROR):
        context, said = getattr(error, "ctx", None), str(error.format_message()).rstrip(".")
        return f"{said}; see '{context.command_path if context else 'submin'} --help'" if said else ""
    return str(error)


if __name__ == "__main__":
    main()
