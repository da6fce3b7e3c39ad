"""Stage 1 of one block, by command: controlled by a network, by surveyed points of its catalogue, or by virtual control."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orchestration.run import check_frames
from orchestration.stage_one import BlockRays, adjust_block
from submin.accuracy import accuracy_against_truth, nees_per_dof
from submin.adjustment.control import ControlledPrior, correlated, covariance_factor, surveyed, uncontrolled
from submin.adjustment.controlled_adjustment import FAR_METRES, ControlledAdjustment, adjust_controlled
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import Rays, sorted_rays
from submin.adjustment.virtual_control import adjust_virtually, virtual_control
from submin.errors import InputError, SubminError
from submin.geodesy import geodetic_to_geocentric, local_axes
from submin.network.network_image import image_set
from submin.query.block_control import control_of_block
from submin.query.control_set import ControlSet
from submin.query.planner import DETERMINED_METRES
from submin.sensors import width_of
from submin.storage.adjusted import NO_COVARIANCE, AdjustedCameras, AdjustedWriter
from submin.storage.block_images import network_images
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, CatalogueMetadata, PointTable, defects
from submin.storage.ledger import Ledger
from submin.storage.network import Network
from submin.storage.point_table import RULE_0
from submin.storage.snapshot import Snapshot

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

DEFAULT_POINTS = 2000
"""Control points that a block takes from a network, and points that are written with their joint covariance (288 MB), at most."""
MOST_CHECKED = 2000
"""Check points that are compared with their joint covariance, at most."""
CONTRADICTED = 1e-3
"""Control whose innovation is as improbable as this, all together, is said to contradict the block."""


@dataclass(frozen=True)
class VirtualDesign:
    """Virtual control to make: ``grid`` x ``grid`` points an image, see `submin.adjustment.virtual_control`; height None: the cameras'."""

    grid: int
    sigma_px: float
    weight: str = "plain"
    height: float | None = None


@dataclass(frozen=True)
class Adjusted:
    """A block as it was adjusted.

    Attributes
    ----------
    cameras : with their joint covariance
    points : adjusted points, well spread if there are more than were asked for; with virtual control their covariance is NaN
    values : keys of ``submin adjust --json``
    """

    cameras: AdjustedCameras
    points: ControlSet
    values: dict[str, Any]

    @property
    def partly(self) -> bool:
        """True when control was left out, or contradicts the block."""
        return bool(self.values["control_rejected"]) or self.values["status"] == "contradicted"


@dataclass(frozen=True)
class _Judged:
    """A block ready to be adjusted: its images, its points (ids ascending), its rays as stage 1 has judged them, and where points start."""

    block: Block
    images: ImageSet
    ids: NDArray[np.str_]
    rays: Rays
    start: Array


def adjust(
    catalogue: Catalogue,
    block_id: str,
    network: str | None = None,
    *,
    version: str | None = None,
    policy: str = "auto",
    most: int = DEFAULT_POINTS,
    virtual: VirtualDesign | None = None,
) -> Adjusted:
    """Adjust one block of a catalogue.

    Parameters
    ----------
    network : that controls it with its common points and their joint covariance; None: the catalogue's ``control`` table, if there is one
    version, policy : of the network's answer, see `submin.storage.network.Network.query`
    most : control points, and points of the result, at most
    virtual : virtual control in place of control and a priori model; nothing is said of accuracy then

    Raises
    ------
    InputError
        When the block cannot be adjusted (the reason why a run would reject it), is in the network already, or options contradict.
    """
    started = time.monotonic()
    if virtual is not None and network is not None:
        raise InputError("virtual control and a network are given; expected one: virtual control is for blocks without control")
    block = catalogue.block(block_id)
    judged = _judged(block, catalogue, network, version)
    check = catalogue.points("check")
    if virtual is not None:
        adjusted = _virtually(judged, virtual, catalogue.metadata, check, most)
    else:
        adjusted = _with_control(judged, catalogue, network, version, policy, check, most)
    adjusted.values["seconds"] = time.monotonic() - started
    return adjusted


def named(block_id: str) -> str:
    """A block in a sentence, also when its id says already that it is one."""
    return block_id if block_id.lower().startswith("block") else f"block {block_id}"


def write(adjusted: Adjusted, out: str | Path) -> None:
    """Write the folder of a result: cameras, covariance, points, report.

    Raises
    ------
    InputError
        When the folder is not empty or cannot be written.
    """
    with AdjustedWriter(out, adjusted.cameras.covariance is not None, {"command": "submin adjust"}) as writer:
        writer.write_cameras(adjusted.cameras)
        writer.write_points(adjusted.points)
        writer.write_report(adjusted.values)


def _judged(block: Block, catalogue: Catalogue, network: str | None, version: str | None) -> _Judged:
    ellipsoid = catalogue.metadata.ellipsoid
    for image in block.images:
        image.pack()
    reason = defects(block)
    parameters = width_of(image.sensor for image in block.images)
    if network is not None:
        snapshot = Snapshot.open(network, version)
        check_frames(catalogue, snapshot)
        _refuse_known(block, Ledger.of(snapshot), network)
        parameters = max(parameters, snapshot.metadata.parameters)
    if reason is None:
        outcome = adjust_block(BlockRays.of(block), ellipsoid)
        reason = outcome.reason
    if reason is not None:
        raise InputError(f"{named(block.block_id)}: {reason}")
    images = image_set(network_images(block), ellipsoid, parameters)
    ids, point = np.unique(block.point_ids, return_inverse=True)
    rays = sorted_rays(point.astype(np.int32), block.image, block.observed, block.sigma, outcome.accepted)
    return _Judged(block, images, ids, rays, intersect(images, rays, len(ids)))


def _refuse_known(block: Block, ledger: Ledger, network: str) -> None:
    for image in block.images:
        if image.image_id in ledger.block_of_image:
            raise InputError(
                f"{network}: image {image.image_id} is in the network already, in {named(ledger.block_of_image[image.image_id])}: its rays "
                "are in that control, and would count twice; use 'submin readjust'"
            )


def _with_control(
    judged: _Judged, catalogue: Catalogue, network: str | None, version: str | None, policy: str, check: PointTable | None, most: int
) -> Adjusted:
    prior_of, source = _control(judged, catalogue, network, version, policy, most)
    try:
        result = adjust_controlled(judged.images, judged.rays, judged.start, prior_of)
    except SubminError as error:
        raise InputError(f"{named(judged.block.block_id)}: {error}") from None
    found, ids = result.estimate, judged.ids
    count = np.bincount(judged.rays.point[judged.rays.accepted], minlength=len(ids))
    controlled = np.zeros(len(ids), dtype=np.bool_)
    controlled[result.prior.point[result.active]] = True
    weak = np.trace(found.own, axis1=1, axis2=2)
    known = np.isfinite(found.ground).all(axis=1) & (np.where(np.isfinite(weak), weak, np.inf) < DETERMINED_METRES**2)
    known &= (count > 1) | controlled
    shown = _spread(np.flatnonzero(known), controlled, count, found.ground, most)
    points = _point_set(judged, shown, found.ground[shown], found.ground_covariance(shown), count, catalogue.metadata, source)
    values = _values(judged, result, int(known.sum()), len(shown), source)
    apart = known & ~(controlled & (source.kind == "survey"))  # a surveyed point cannot check itself
    values["check"] = None if check is None else _checked(judged, check, np.flatnonzero(apart), found.ground, found.ground_covariance)
    rays = np.bincount(judged.rays.image[judged.rays.accepted], minlength=len(judged.images))
    return Adjusted(AdjustedCameras(judged.images, found.theta, found.covariance, result.released, rays), points, values)


@dataclass(frozen=True)
class _Source:
    """Where control comes from, for people and for the metadata of the result."""

    kind: str
    network: str = ""
    version: str = ""
    policy: str = "none"
    tiles: tuple[str, ...] = ()


def _control(
    judged: _Judged, catalogue: Catalogue, network: str | None, version: str | None, policy: str, most: int
) -> tuple[Callable[[ImageSet], ControlledPrior], _Source]:
    """What is known of the block before its rays, for any state of its images; and from where."""
    p = judged.images.parameters
    if network is not None:
        opened = Network(network, version, p)
        if opened.dense is not None:
            return _dense_control(judged, opened, policy, most)
        cells = opened.snapshot.candidate_cells(judged.ids)
        control = control_of_block(opened, judged.ids, cells, policy, opened.snapshot.image_count(), most)
        if control is not None:
            tiles = tuple(opened.cover.tile_name(t) for t in control.tiles)
            source = _Source("network", network, opened.version, control.policy, tiles)
            return (lambda images: control.prior(images, judged.ids)), source
        return (lambda images: uncontrolled(images.prior, p)), _Source("network", network, opened.version)
    table = catalogue.points("control")
    if table is None:
        return (lambda images: uncontrolled(images.prior, p)), _Source("none")
    _, point, row = np.intersect1d(judged.ids, table.point_ids, return_indices=True)
    position = geodetic_to_geocentric(table.geodetic[row], catalogue.metadata.ellipsoid)
    if table.joint_covariance is not None:
        at = (3 * row[:, None] + np.arange(3)).ravel()
        joint = table.joint_covariance[np.ix_(at, at)]
        try:
            covariance_factor(joint)
        except SubminError:
            raise InputError(
                f"{catalogue.path}/control: the joint covariance (covariance_row) of {len(row)} points is not positive semi-definite; "
                "expected the one that an adjustment gave"
            ) from None
        return (lambda images: correlated(images.prior, p, point, position, joint)), _Source("survey", policy="survey")
    axes = local_axes(table.geodetic[row])
    covariance = np.swapaxes(axes, 1, 2) @ table.covariance_enu[row] @ axes
    return (lambda images: surveyed(images.prior, p, point, position, covariance)), _Source("survey", policy="survey")


def _dense_control(judged: _Judged, network: Network, policy: str, most: int) -> tuple[Callable[[ImageSet], ControlledPrior], _Source]:
    """Points of a dense network, with their joint covariance: nothing of the block is in it, nor of its passes."""
    p, place = judged.images.parameters, network.snapshot.place
    common = np.empty(0, dtype=np.str_) if network.dense is None else network.dense.held(judged.ids)
    if not len(common):
        return (lambda images: uncontrolled(images.prior, p)), _Source("network", place, network.version)
    found = network.query(points=common, policy=policy, max_points=most)
    point = np.searchsorted(judged.ids, found.ids)
    source = _Source("network", place, found.version, found.policy, found.tiles)
    return (lambda images: correlated(images.prior, p, point, found.geocentric, found.covariance)), source


def _values(judged: _Judged, result: ControlledAdjustment, points: int, shown: int, source: _Source) -> dict[str, Any]:
    found, test = result.estimate, result.test
    ids = judged.ids[result.prior.point]
    left_out = np.flatnonzero(~result.active)
    used = int(result.active.sum())
    contradicted = bool(test.dof and test.probability < CONTRADICTED) or len(left_out) > used
    return {
        "block": judged.block.block_id, "images": len(judged.images), "points": points, "points_written": shown,
        "control_points": used, "control_from": source.kind, "network": source.network or None, "version": source.version or None,
        "policy": source.policy, "tiles": list(source.tiles),
        "chi_square": found.chi_square, "redundancy": found.redundancy,
        "variance_factor": found.chi_square / found.redundancy if found.redundancy else None,
        "status": "contradicted" if contradicted else "controlled" if used else "uncontrolled",
        "innovation": {"d2": test.d2, "dof": test.dof, "probability": test.probability},
        "control_rejected": [
            {"point_id": str(ids[k]), "reason": _why(result.statistic[k], result.dof[k])} for k in left_out
        ],
        "images_flagged": [
            {"image_id": judged.images.ids[i], "reason": f"its corrections contradict its a priori model (test statistic "
             f"{result.image_statistic[i]:.1f}); its prior is no longer used"}
            for i in np.flatnonzero(result.released)
        ],
        "rejected_rays": _rejected(judged), "rays": int(judged.rays.accepted.sum()), "iterations": result.iterations, "use": RULE_0,
    }  # fmt: skip


def _why(statistic: float, dof: int) -> str:
    """Why a control point was left out."""
    found = (
        f"the block contradicts it: chi-square {statistic:.1f} with {dof} degrees of freedom"
        if np.isfinite(statistic)
        else f"the block's rays pass it by more than {FAR_METRES / 1000.0:g} km"
    )
    return f"{found}; another point, a blunder in its only ray, or a wrong covariance: it was used as a tie point"


def _rejected(judged: _Judged) -> list[dict[str, str]]:
    gone = np.flatnonzero(~judged.rays.accepted)
    return [{"point_id": str(judged.ids[judged.rays.point[r]]), "image_id": judged.images.ids[judged.rays.image[r]]} for r in gone]


def _virtually(judged: _Judged, design: VirtualDesign, metadata: CatalogueMetadata, check: PointTable | None, most: int) -> Adjusted:
    images, accepted = judged.images, judged.rays.accepted
    first = np.array([json.loads(image.camera).get("origin", (0.0, 0.0)) for image in judged.block.images], dtype=np.float64)
    size = np.array([(image.width, image.height) for image in judged.block.images], dtype=np.float64)
    rays = np.bincount(judged.rays.image[accepted], minlength=len(images))
    control = virtual_control(images, first, size, rays, design.grid, design.sigma_px, design.weight, design.height)
    try:
        found = adjust_virtually(images, judged.rays, judged.start, control)
    except InputError:
        raise
    except SubminError as error:
        raise InputError(f"{named(judged.block.block_id)}: {error}") from None
    count = np.bincount(judged.rays.point[accepted], minlength=len(judged.ids))
    known = np.flatnonzero(np.isfinite(found.ground).all(axis=1) & (count > 1))
    shown = _spread(known, np.zeros(len(judged.ids), dtype=np.bool_), count, found.ground, most)
    unknown = np.full((3 * len(shown), 3 * len(shown)), np.nan)
    points = _point_set(judged, shown, found.ground[shown], unknown, count, metadata, _Source("virtual", policy="virtual control"))
    values = {
        "block": judged.block.block_id, "images": len(images), "points": len(known), "points_written": len(shown),
        "control_points": 0, "virtual_points": len(control.image), "control_from": "virtual", "weight": design.weight,
        "chi_square": None, "redundancy": None, "variance_factor": None, "status": "regularised",
        "accuracy": NO_COVARIANCE, "control_rejected": [], "images_flagged": [], "rejected_rays": _rejected(judged),
        "rays": int(accepted.sum()), "iterations": found.iterations, "use": RULE_0,
        "check": None if check is None else _checked(judged, check, known, found.ground, None),
    }  # fmt: skip
    none = np.zeros(len(images), dtype=np.bool_)
    return Adjusted(AdjustedCameras(images, found.theta, None, none, rays), points, values)


def _spread(rows: NDArray[np.int64], first: Flags, count: NDArray[np.int64], ground: Array, most: int) -> NDArray[np.int64]:
    """At most so many of some points (rows): control ahead of others, then by an even grid, those with most rays ahead."""
    if len(rows) <= most:
        return rows
    at = ground[rows] - ground[rows].min(axis=0)
    side = max(float(at.max()), 1.0) / max(np.sqrt(most), 1.0)
    square = np.unique(np.floor(at / side), axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort((rows, -count[rows], ~first[rows]))
    turn = np.empty(len(rows), dtype=np.int64)  # the first of every square, then the second of every square
    by_square = order[np.argsort(square[order], kind="stable")]
    starts = np.searchsorted(square[by_square], np.arange(square.max() + 1))
    turn[by_square] = np.arange(len(rows)) - starts[square[by_square]]
    return np.asarray(np.sort(rows[np.lexsort((turn, ~first[rows]))[:most]]))


def _point_set(
    judged: _Judged, rows: NDArray[np.int64], ground: Array, covariance: Array, count: NDArray[np.int64], metadata: CatalogueMetadata,
    source: _Source,
) -> ControlSet:  # fmt: skip
    return ControlSet(
        ids=judged.ids[rows], geocentric=np.ascontiguousarray(ground), covariance=covariance, ellipsoid=metadata.ellipsoid,
        frame=metadata.frame, epoch=metadata.epoch, policy=source.policy, tiles=source.tiles,
        tile_of_point=np.full(len(rows), "", dtype="U1"), rays=count[rows], version=source.version, blocks=(judged.block.block_id,),
        scope="tiles",
    )  # fmt: skip


def _checked(
    judged: _Judged, check: PointTable, rows: NDArray[np.int64], ground: Array, covariance_of: Callable[[NDArray[np.int64]], Array] | None
) -> dict[str, Any] | None:
    """Errors of adjusted points (rows) against check points, which take no part in the adjustment; ``left_out`` counts those too many."""
    _, at, row = np.intersect1d(judged.ids[rows], check.point_ids, return_indices=True)
    if not len(at):
        return None
    compared = len(at) if covariance_of is None else min(len(at), MOST_CHECKED)
    left_out, at, row = len(at) - compared, at[:compared], row[:compared]
    chosen, axes = rows[at], local_axes(check.geodetic[row])
    error = ground[chosen] - geodetic_to_geocentric(check.geodetic[row], judged.images.ellipsoid)
    enu = np.einsum("nij,nj->ni", axes, error)
    if covariance_of is None:
        rms = np.sqrt((enu**2).mean(axis=0)).tolist()
        return {"points": len(at), "left_out": left_out} | dict(zip(("rms_east", "rms_north", "rms_up"), rms, strict=True))
    joint = covariance_of(chosen)
    k = np.arange(len(at))
    joint.reshape(len(k), 3, len(k), 3)[k, :, k, :] += np.swapaxes(axes, 1, 2) @ check.covariance_enu[row] @ axes
    own = axes @ joint.reshape(len(k), 3, len(k), 3)[k, :, k, :] @ np.swapaxes(axes, 1, 2)
    return accuracy_against_truth(enu, own).to_mapping() | {"nees_per_dof": nees_per_dof(error.ravel(), joint), "left_out": left_out}
