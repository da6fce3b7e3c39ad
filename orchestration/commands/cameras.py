"""Commands that give adjusted cameras: adjust, readjust."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orchestration.commands.shared import Json, check_applies, check_range, counted, show

app = typer.Typer()


@app.command()
def adjust(
    catalogue: Annotated[Path, typer.Argument(help="Catalogue that holds the block.")],
    block: Annotated[str, typer.Option("--block", help="Id of the block.")],
    output: Annotated[Path, typer.Option("--out", help="Folder to write: cameras, their covariance, points, report.")],
    network: Annotated[
        str | None, typer.Option("--network", help="Network that controls it; without one the catalogue's control table does, if any.")
    ] = None,
    policy: Annotated[
        str | None, typer.Option("--policy", help="Of the network's answer: auto, tile, ci, bci, split or rigorous; default auto.")
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
    policy: Annotated[str, typer.Option("--policy", help="Of the network's points: auto, tile, ci, bci, split or rigorous.")] = "auto",
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
