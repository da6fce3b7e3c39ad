"""``submin simulate``: catalogues of simulated images, with truth."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestration.commands.shared import MOST_WORKERS, Json, Seed, Workers, check_range, counted, show

if TYPE_CHECKING:
    from submin.simulation.campaign import Campaign
    from submin.simulation.scene import Layout

COUNTRIES = "footprints_world/naturalearth_lowres/naturalearth_lowres.shp"

app = typer.Typer(no_args_is_help=True, help="Make a catalogue of simulated images, with truth.")


@app.command("region")
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


@app.command("five-blocks")
def simulate_five_blocks_command(
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")], seed: Seed = 0, as_json: Json = False
) -> None:
    """Simulate the 2008 MIN paper's experiment: 18 frame images in 5 blocks, 62 points, and four surveyed ones as control-external.

    Example: submin simulate five-blocks --out catalogue
    """
    from submin.simulation.five_blocks import five_blocks

    simulate_layout(five_blocks(), catalogue, seed, as_json)


@app.command("worldview")
def simulate_worldview_command(
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")], seed: Seed = 0, as_json: Json = False
) -> None:
    """Simulate the 2010 paper's experiment: 50 WorldView-1 pairs, 1,347 points, 101 of them surveyed, nine of these in control-external.

    Example: submin simulate worldview --out catalogue
    """
    from submin.simulation.worldview import worldview

    simulate_layout(worldview(), catalogue, seed, as_json)


@app.command("china")
def simulate_china_command(
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")],
    scale: Annotated[float, typer.Option("--scale", help="Part of China about its middle, by triplets; above 1 several, up to 10.")] = 1.0,
    seed: Seed = 0,
    error: Annotated[
        str, typer.Option("--error", help="Shift of images (15 m): independent, common to a pass, or mixed (half of its variance each).")
    ] = "mixed",
    workers: Workers = 0,
    as_json: Json = False,
) -> None:
    """Simulate ZY-3 over China: 8,802 three-line triplets in some 730 passes, 3 million points, 17.6 million rays, 8,000 check points.

    The outline of China is read from the shared data (SUBMIN_DATA). The catalogue is the same for any number of workers.

    Example: submin simulate china --out catalogue --scale 0.01 --workers 2
    """
    from orchestration.simulate import shared_data
    from submin.formats.outlines import named_polygons
    from submin.simulation.china import check_asked, china

    check_range("--seed", seed, 0)
    check_range("--workers", workers, 0, MOST_WORKERS)
    check_asked(scale, error)
    outline = named_polygons(shared_data(COUNTRIES), "name")["China"]
    write_simulated(china(outline, scale, seed, error), catalogue, workers, as_json)


@app.command("footprints")
def simulate_footprints_command(
    catalogue: Annotated[Path, typer.Option("--out", help="Catalogue to make.")],
    region: Annotated[
        str, typer.Option("--region", help="Real scenes: australia (372 of Landsat) or morocco (234 of WorldView, GeoEye).")
    ] = "australia",
    scale: Annotated[float, typer.Option("--scale", help="Part of the scenes, those nearest to the middle.")] = 1.0,
    seed: Seed = 0,
    error: Annotated[str, typer.Option("--error", help="Shift of images: independent, common to a pass, or mixed.")] = "mixed",
    workers: Workers = 0,
    as_json: Json = False,
) -> None:
    """Simulate images whose footprints are those of real scenes: how they overlap is real, their measurements and errors are not.

    The outlines are read from the shared data (SUBMIN_DATA). The catalogue is the same for any number of workers.

    Example: submin simulate footprints --out catalogue --region morocco
    """
    from orchestration.simulate import shared_data
    from submin.errors import InputError
    from submin.formats.outlines import landsat_outlines, named_polygons, satellite_scenes
    from submin.simulation.china import ERRORS, check_error
    from submin.simulation.footprints import REGIONS, australia, morocco

    check_range("--seed", seed, 0)
    check_range("--workers", workers, 0, MOST_WORKERS)
    check_error(error)
    if region not in REGIONS:
        raise InputError(f"--region is {region!r}; expected one of {', '.join(REGIONS)}")
    if region == "morocco":
        campaign = morocco(satellite_scenes(shared_data("footprints_world/maxar_open_data_scenes.jsonl.gz")), scale, seed, ERRORS[error])
    else:
        land = named_polygons(shared_data(COUNTRIES), "name")["Australia"]
        campaign = australia(landsat_outlines(shared_data("footprints_world/wrs2_descending.csv.gz")), land, scale, seed, ERRORS[error])
    write_simulated(campaign, catalogue, workers, as_json)


def write_simulated(campaign: Campaign, catalogue: Path, workers: int, as_json: bool) -> None:
    """Write the catalogue of a campaign and say what it holds."""
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.simulate import simulate_campaign

    started = time.perf_counter()
    with progress_bars(quiet=as_json) as reporter, executor_for(workers) as executor:
        size = simulate_campaign(campaign, catalogue, executor, reporter)
        seconds, memory = time.perf_counter() - started, executor.peak_memory_mb()
    passes = len({scene.pass_id for scene in campaign.scenes})
    values = {
        "catalogue": str(catalogue), "simulated": True, **asdict(size), "passes": passes, "seconds": round(seconds, 2),
        "peak_memory_mb": round(memory, 1),
    }  # fmt: skip
    show(values, as_json, f"{catalogue}: {campaign.name}: {counted(size.images, 'image')} in {counted(size.blocks, 'block')} of "
         f"{passes:,} passes, {counted(size.points, 'point')}, {counted(size.rays, 'ray')}, "
         f"{counted(size.check_points, 'check point')}; {seconds:.1f} s, {memory:,.0f} MB of memory")  # fmt: skip


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
