"""Commands that make a network and change it: create, run, reconcile, control add, withdraw, tag."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestration.commands.shared import MOST_WORKERS, Aoi, Box, Json, NoReconcile, Scheduler, Workers, check_range, counted, show

if TYPE_CHECKING:
    from orchestration.reconcile import ReconcileResult
    from submin.storage.catalogue import Catalogue

LARGEST_INNOVATION = 1e-3
"""Blocks less improbable than that are not even doubtful."""

app = typer.Typer()
control_app = typer.Typer(no_args_is_help=True, help="Surveyed control points.")
app.add_typer(control_app, name="control")


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
    form: Annotated[str, typer.Option("--form", help="factored: images and points; dense: one tile of points alone.")] = "factored",
    frame: Annotated[
        str | None, typer.Option("--frame", help="Frame of the coordinates; default WGS84, with --fit the catalogue's.")
    ] = None,
    epoch: Annotated[str | None, typer.Option("--epoch", help="Epoch of the frame; with --fit the catalogue's.")] = None,
    max_parameters: Annotated[
        int, typer.Option("--max-parameters", min=60, help="A tile that sees more image parameters (6 an image) is split into four.")
    ] = 2500,
    thin_metres: Annotated[
        float | None, typer.Option("--thin-metres", help="Report one point in each square of this side; all points keep what they know.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Make an empty network over an area.

    Example: submin create network --bbox 97 33 103 37 --tile-km 100 --overlap-km 50
    """
    from orchestration.create import create as make
    from orchestration.create import fit_catalogue, fit_points, read_area
    from submin.errors import InputError
    from submin.query.asked import box_area
    from submin.storage.catalogue import Catalogue
    from submin.storage.catalogue_schema import CatalogueMetadata

    if sum(value is not None for value in (bbox, aoi, fit)) != 1:
        raise InputError("give the area by exactly one of --bbox, --aoi and --fit")
    metadata = CatalogueMetadata(name="network", frame=frame or "WGS84", epoch=epoch or "")
    if fit is not None:
        fitted = Catalogue.open(fit)
        metadata = fitted.metadata
        for option, value, theirs in (("--frame", frame, metadata.frame), ("--epoch", epoch, metadata.epoch)):
            if value is not None and value != theirs:
                raise InputError(f"{option} is {value!r}, but that of the catalogue given by --fit is {theirs!r}; leave {option} out")
        if form != "dense" and not fitted.images:
            raise InputError(f"{fit}: has no images, so no footprints to fit tiles to; give the area by --bbox or --aoi, or --form dense")
        if form == "dense":
            area = fit_catalogue(fitted)[0] if fitted.images else fit_points(fitted)
        else:
            area, core, shared = fit_catalogue(fitted)
            tile_km = core if tile_km is None else tile_km
            overlap_km = min(shared, 0.5 * tile_km) if overlap_km is None else overlap_km
    else:
        area = box_area(bbox) if bbox is not None else read_area(aoi)  # type: ignore[arg-type]
    made = make(network, area, metadata, tile_km, overlap_km, form, max_parameters, thin_metres)
    cover = made.cover
    thinned = "" if thin_metres is None else f", one point reported in each square of {thin_metres:g} m"
    tiles = "one vector of points" if form == "dense" else (
        f"{counted(cover.tile_count, 'tile')} ({cover.rows} rows, {cover.columns} columns), "
        f"cores of {cover.core / 1000:g} km, overlap {cover.overlap / 1000:g} km"
    )  # fmt: skip
    show(made.to_json(), as_json, f"{network}: {tiles}, frame {metadata.frame}{thinned}")


@app.command()
def run(
    catalogue: Annotated[Path, typer.Argument(help="Catalogue of image blocks.")],
    network: Annotated[str, typer.Argument(help="Network that takes them.")],
    workers: Workers = 0,
    scheduler: Scheduler = None,
    batch_blocks: Annotated[int, typer.Option("--batch-blocks", help="Blocks that one commit holds.")] = 2000,
    sequential: Annotated[bool, typer.Option("--sequential", help="Fuse block by block, in the order of the catalogue.")] = False,
    innovation: Annotated[
        float,
        typer.Option("--innovation", help="Reject a block that contradicts the network as only this part of good ones does; 0: none."),
    ] = 1e-6,
    no_reconcile: NoReconcile = False,
    as_json: Json = False,
) -> None:
    """Fuse every block of a catalogue that the network does not have yet. The same command again continues, or says that nothing is left.

    Then every tile gets what lies outside of it, unless --no-reconcile is given.

    Example: submin run catalogue network --workers 2
    """
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.reconcile import reconcile_changes
    from orchestration.run import run as fuse
    from orchestration.stopping import resumable
    from submin.storage.catalogue import Catalogue
    from submin.storage.dense_reader import is_dense
    from submin.storage.snapshot import Snapshot

    check_range("--workers", workers, 0, MOST_WORKERS)
    check_range("--batch-blocks", batch_blocks, 1)
    if not 0.0 <= innovation <= LARGEST_INNOVATION:
        from submin.errors import InputError

        raise InputError(f"--innovation is {innovation:g}; expected 0 to {LARGEST_INNOVATION:g}")
    opened = Catalogue.open(catalogue)
    if is_dense(Snapshot.open(network)):
        _run_dense(opened, network, 1 if sequential else batch_blocks, as_json)
        return
    with resumable(network), progress_bars(quiet=as_json) as reporter, executor_for(workers, scheduler) as executor:
        result = fuse(opened, network, executor, batch_blocks=1 if sequential else batch_blocks, reporter=reporter, innovation=innovation)
        outside = None if no_reconcile else reconcile_changes(network, executor, reporter)
    lines = [f"{network} {result.version}: {result.fused} blocks fused, {result.skipped} already there, {len(result.rejected)} rejected"]
    if result.control_fused or result.observations_fused:
        lines.append(f"{result.control_fused} control points and {result.observations_fused} clusters of observed positions added")
    if result.rays_used:
        lines.append(
            f"{result.rays_used:,} rays used, {result.rays_rejected:,} rejected as blunders, RMS {result.ray_rms_px:.3f} px; "
            f"{result.seconds:.1f} s, {result.peak_memory_mb:.0f} MB"
        )
    if not (result.fused or result.control_fused or result.observations_fused or result.rejected):
        lines[0] = f"{network} {result.version}: nothing is left to do, all {result.skipped} blocks are in the network"
    lines += [f"bad camera {f.image_id}: {f.reason}" for f in result.flagged]
    lines += [
        f"doubtful block {d.block_id}: d2 against v{d.against} is {d.test.d2:.1f} with {d.test.dof} degrees of freedom "
        f"(probability {d.test.probability:.1e}); it was fused"
        for d in result.doubtful
    ]
    lines += [f"not used: {c.reason}" for c in result.contradicted]
    lines += [f"rejected block {r.block_id}: {r.reason}" for r in result.rejected]
    lines += [f"tile {t}: the judgement of its rays did not settle; they are used as last judged" for t in result.unsettled_tiles]
    _show_change(result.to_json(), outside, as_json, lines, network)
    if result.rejected:
        raise typer.Exit(1)


def _show_change(values: dict[str, Any], outside: ReconcileResult | None, as_json: bool, lines: list[str], network: str) -> None:
    """Show what a change did, and what came to the tiles from outside after it."""
    if outside is not None:
        values = values | {"version": outside.version, "reconciled": outside.to_json()}
        lines = [*lines, _said(outside, network)]
    show(values, as_json, "\n".join(lines))


def _said(outside: ReconcileResult, network: str) -> str:
    stay = f", {counted(outside.untouched, 'tile')} as before" if outside.untouched else ""
    return (
        f"{network} {outside.version}: {counted(outside.tiles, 'tile')} reconciled with what lies outside{stay}; "
        f"{outside.seconds:.1f} s, {outside.peak_memory_mb:.0f} MB"
    )


@app.command()
def reconcile(
    network: Annotated[str, typer.Argument(help="Network to reconcile.")],
    workers: Workers = 0,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Give every tile what lies outside of it: each alone then answers as the whole network. What changed nothing stays as it is.

    Example: submin reconcile network --workers 2
    """
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.reconcile import reconcile as exchange
    from orchestration.stopping import resumable

    check_range("--workers", workers, 0, MOST_WORKERS)
    with resumable(network), progress_bars(quiet=as_json) as reporter, executor_for(workers, scheduler) as executor:
        done = exchange(network, executor, reporter)
    text = _said(done, network) if done.tiles else f"{network} {done.version}: nothing has changed since it was reconciled"
    show(done.to_json(), as_json, text)


def _run_dense(catalogue: Catalogue, network: str, batch_blocks: int, as_json: bool) -> None:
    """Run into a dense network: in this process, its update is one product of matrices."""
    from orchestration.dense_run import run_dense
    from orchestration.progress import progress_bars
    from orchestration.stopping import resumable

    with resumable(network), progress_bars(quiet=as_json) as reporter:
        done = run_dense(catalogue, network, batch_blocks=batch_blocks, reporter=reporter)
    counts = f"{counted(done.control_fused, 'control point')} added, {done.skipped} already there, {len(done.rejected)} rejected"
    lines = [f"{network} {done.version}: {counted(done.fused, 'block')} fused, {counts}"]
    if not (done.fused or done.control_fused or done.rejected):
        lines[0] = f"{network} {done.version}: nothing is left to do, all {counted(done.skipped, 'block')} are in the network"
    lines.append(f"{counted(done.points, 'point')}; chi-square {done.chi_square:.6g} with {done.degrees_of_freedom:,} degrees of freedom")
    if done.pending:
        few = ", ".join(done.pending[:5]) + ", ..." * (len(done.pending) > 5)
        lines.append(f"{counted(len(done.pending), 'block')} waiting for points that are not determined yet: {few}")
    lines += [f"doubtful: {', '.join(d.block_ids)}: d2 {d.d2:.1f} with {d.degrees_of_freedom} degrees of freedom (probability "
              f"{d.probability:.2g}) against what was there; it was fused" for d in done.doubtful]  # fmt: skip
    lines += [f"rejected block {r.block_id}: {r.reason}" for r in done.rejected]
    show(done.to_json(), as_json, "\n".join(lines))
    if done.rejected:
        raise typer.Exit(1)


@control_app.command("add")
def control_add(
    network: Annotated[str, typer.Argument(help="Network that takes them.")],
    points: Annotated[Path, typer.Argument(help="Table of surveyed points with their covariance or sigmas, or a joint covariance.")],
    workers: Workers = 0,
    scheduler: Scheduler = None,
    no_reconcile: NoReconcile = False,
    as_json: Json = False,
) -> None:
    """Add surveyed control points, known by the ids of tie points or new ones. The same file again does nothing.

    Example: submin control add network control.parquet
    """
    from orchestration.control import add_control
    from orchestration.dense_run import add_dense_control
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.reconcile import reconcile_changes
    from orchestration.stopping import resumable
    from submin.storage.dense_reader import is_dense
    from submin.storage.point_table import check_stated_frame, read_point_table
    from submin.storage.snapshot import Snapshot

    table, snapshot = read_point_table(points, "definite"), Snapshot.open(network)
    check_stated_frame(points, snapshot.metadata.frame, snapshot.metadata.epoch)
    dense = is_dense(snapshot)
    with resumable(network), progress_bars(quiet=as_json) as reporter, executor_for(0 if dense else workers, scheduler) as executor:
        added = add_dense_control(table, network, reporter) if dense else add_control(table, str(points), network, executor, reporter)
        outside = None if dense or no_reconcile else reconcile_changes(network, executor, reporter)
    lines = [
        f"{network} {added.version}: {added.fused} control points added, {added.skipped} already there, {len(added.rejected)} rejected"
    ]
    lines += [f"rejected {r.point_id}: {r.reason}" for r in added.rejected]
    lines += [f"not used: {c.reason}" for c in added.contradicted]
    _show_change(added.to_json(), outside, as_json, lines, network)
    if added.rejected or added.contradicted:
        raise typer.Exit(1)


@app.command()
def withdraw(
    network: Annotated[str, typer.Argument(help="Network to withdraw from.")],
    block: Annotated[str | None, typer.Option("--block", help="Id of a block, with all its images.")] = None,
    image: Annotated[str | None, typer.Option("--image", help="Id of one image; the rest of its block stays.")] = None,
    control: Annotated[str | None, typer.Option("--control", help="Id of a control point; correlated ones leave together.")] = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    no_reconcile: NoReconcile = False,
    as_json: Json = False,
) -> None:
    """Withdraw a block, an image or a control point, as if it had never been fused. It can come again.

    Example: submin withdraw network --image IMAGE_17
    """
    from orchestration.dense_run import withdraw_dense
    from orchestration.executors import executor_for
    from orchestration.progress import progress_bars
    from orchestration.reconcile import reconcile_changes
    from orchestration.stopping import resumable
    from orchestration.withdraw import withdraw as take
    from submin.storage.dense_reader import is_dense
    from submin.storage.snapshot import Snapshot

    if is_dense(Snapshot.open(network)):
        with resumable(network):
            left = withdraw_dense(network, block=block, image=image, control=control)
        show(left.to_json(), as_json, f"{network} {left.version}: {left.what} withdrawn with {counted(left.rays, 'observation')}")
        return
    with resumable(network), progress_bars(quiet=as_json) as reporter, executor_for(workers, scheduler) as executor:
        done = take(network, executor, block=block, image=image, control=control, reporter=reporter)
        outside = None if no_reconcile else reconcile_changes(network, executor, reporter)
    said = f"{network} {done.version}: {done.what} withdrawn with {done.rays:,} rays; {counted(len(done.tiles), 'tile')} judged again"
    _show_change(done.to_json(), outside, as_json, [said], network)


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
    from submin.storage.repository import tag_version

    version = tag_version(network, name, at)
    show({"version": version.name, "tags": list(version.tags)}, as_json, f"{network} {version.name} is tagged {name}")
