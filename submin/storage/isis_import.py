"""Import of an ISIS control network with its cameras into a catalogue of frame images, tie points and weighted control.

Two inputs: the network, and a folder with the cameras (ISD files) and a table ``images.csv`` that names the camera of each serial number. A
network becomes one block, because that is how it was measured: its images are tied to one another.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError, InputError
from submin.formats.columns import integer, number, read_table, text
from submin.formats.isis_camera import IsdCamera, read_isd
from submin.formats.isis_network import ControlNetwork, NetworkPoint, read_network
from submin.geodesy import Ellipsoid, geocentric_to_geodetic, local_axes, rotate_covariance
from submin.sensors import Ground, sensor_named
from submin.sensors.footprint import footprints
from submin.storage.catalogue_schema import (
    Array,
    Block,
    CatalogueMetadata,
    ImageRecord,
    Index,
    PointTable,
    parse_utc,
    utc_text,
)
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.imports import ImportSummary, Taken, named, passes

FIRST_PIXEL = 1.0
"""Sample and line of the first pixel's centre in ISIS; here it is (0, 0)."""
WHOLE = 0.02
"""Images are taken as reduced n times when their scale against the detector is within this part of n."""

SIGMA_PX = 1.4
"""Of a measure for which the network states none, pixels: the weight that ISIS's own adjustment (jigsaw) gives it."""
SIGMA_POSITION_M = 1000.0
SIGMA_ATTITUDE_DEG = 2.0

_IMAGES = (
    text("serial_number"), text("isd"), text("image", False, blank=True), integer("image_samples", False), integer("image_lines", False),
    number("reduction", False), text("acquisition_utc", False, blank=True), text("pass_id", False, blank=True),
    text("licence", False, blank=True),
)  # fmt: skip


@dataclass(frozen=True)
class _Listed:
    """A row of the table of images with its camera."""

    image_id: str
    serial_number: str
    camera: IsdCamera
    size: tuple[int, int]
    reduction: float | None
    time: datetime | None
    pass_id: str
    licence: str


@dataclass(frozen=True)
class _Rays:
    """Measures (r,) of the network: point, image, coordinates with the first pixel's centre at (0, 0), sigmas, pixels."""

    point: Index
    image: Index
    observed: Array
    sigma: Array

    def of(self, images: Index) -> _Rays:
        """The same rays with their images numbered anew."""
        return replace(self, image=images[self.image])


def camera_priors(
    sigma_position: float = SIGMA_POSITION_M, sigma_attitude: float = SIGMA_ATTITUDE_DEG, sigma_focal: float = 0.0
) -> APriori:
    """What is believed of the cameras: sigmas of position (m), attitude (degrees) and focal length (mm), each image by itself; 0 is held.

    A thousand metres and two degrees are what the tracking and the attitude data of the sixties and seventies are worth.
    """
    sigmas = {"position": sigma_position, "attitude": float(np.radians(sigma_attitude)), "focal length": sigma_focal}
    return APriori(parameters={group: {"sigma": sigma, "common_to_pass": 0.0} for group, sigma in sigmas.items()})


def import_isis(
    network: str | Path,
    cameras: str | Path,
    out: str | Path,
    images_csv: str | Path | None = None,
    dataset: str | None = None,
    shared_ids: bool = False,
    sigma: float = SIGMA_PX,
    reduction: float | None = None,
    a_priori: APriori | None = None,
    overwrite: bool = False,
) -> ImportSummary:
    """Write a catalogue of an ISIS control network.

    Free points become tie points, constrained ones control with their a priori covariance, turned from geocentric to local axes. Images
    that no measure names are left out.

    Parameters
    ----------
    network
        Control network, PVL (``.pvl``, ``.pvl.gz``) or binary (``.net``).
    cameras
        Folder of the ISD files.
    out
        Folder of the catalogue.
    images_csv
        Table with ``serial_number``, ``isd`` (file name) and, where known, ``image`` (name; else the serial number), ``image_samples``,
        ``image_lines`` (pixels of the image as measured; else the ISD's), ``reduction``, ``acquisition_utc`` (else the time at the end of
        the serial number), ``pass_id``, ``licence``; else ``images.csv`` in the folder of the cameras.
    dataset
        Name of the catalogue; else that of the folder of ``images_csv``. Point ids are ``DATASET/PointId``.
    shared_ids
        Leave point ids as the network has them.
    sigma
        Standard deviation of measures for which the network states none, pixels of the image as measured.
    reduction
        How many times the images were reduced from the detector that the ISDs describe; else as ``images_csv`` says, else found from the
        a priori positions of the points.
    a_priori
        What is believed of the cameras; else `camera_priors`.
    overwrite
        Take the place of a catalogue in ``out``.

    Raises
    ------
    InputError
        When a file cannot be used: which, where, what was expected. Nothing is written then.
    """
    for name, value in (("sigma", sigma), ("reduction", 1.0 if reduction is None else reduction)):
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"{name} is {value}; expected a positive number")
    table = Path(images_csv) if images_csv is not None else Path(cameras) / "images.csv"
    dataset = dataset or table.resolve().parent.name
    net, listed = read_network(network), _read_images(table, Path(cameras))
    notes = [f"left out, as the network says: {count} {what}" for what, count in sorted(net.left_out.items())]
    rays = _rays(net, Path(network), table, listed, sigma)
    seen = np.bincount(rays.image, minlength=len(listed)) > 0
    if not seen.all():
        notes.append(f"left out, because no measure names them: {named(i.image_id for i, s in zip(listed, seen, strict=True) if not s)}")
    listed, rays = [i for i, s in zip(listed, seen, strict=True) if s], rays.of((np.cumsum(seen) - 1).astype(np.int32))
    ellipsoid, metadata = listed[0].camera.ellipsoid, _metadata(dataset, net, table, listed)

    prefix = "" if shared_ids else f"{dataset}/"
    control = _control(net, Path(network), prefix, ellipsoid)
    records = _records(table, net, rays, listed, dataset, reduction, notes)
    order = sorted(range(len(records)), key=lambda i: (records[i].acquired or "~", i))
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order))
    records, rays = [records[i] for i in order], rays.of(rank)
    point_ids = np.array([prefix + point.point_id for point in net.points], dtype=np.str_)
    a_priori = a_priori or camera_priors()
    block = Block(
        records[0].block_id, tuple(records), a_priori, point_ids[rays.point], rays.image,
        rays.observed[:, 0], rays.observed[:, 1], rays.sigma[:, 0], rays.sigma[:, 1],
    )  # fmt: skip
    with CatalogueWriter(out, metadata, overwrite) as writer:
        writer.write_images(records)
        writer.write_priors(a_priori)
        writer.write_block(block)
        if len(control):
            writer.write_points("control", control)
    return ImportSummary(
        catalogue=Path(out), dataset=dataset, blocks=1, passes=len({r.pass_id for r in records}), images=len(records),
        points=len(np.unique(rays.point)), rays=len(rays.point), notes=tuple(notes), control=len(control),
    )  # fmt: skip


def _read_images(path: Path, cameras: Path) -> list[_Listed]:
    table = read_table(path, _IMAGES)
    if not table.num_rows:
        raise CatalogueError(f"{path}: holds no images; expected at least one row")
    columns = {c.name: table[c.name].to_pylist() if c.name in table.schema.names else [None] * table.num_rows for c in _IMAGES}
    listed: list[_Listed] = []
    first_row: dict[tuple[str, str], int] = {}
    for row, values in enumerate(zip(*columns.values(), strict=True), start=1):
        entry = dict(zip(columns, values, strict=True))
        image_id = entry["image"] or entry["serial_number"]
        for name, value in (("serial_number", entry["serial_number"]), ("image", image_id)):
            if (name, value) in first_row:
                raise CatalogueError(f"{path}: row {row}: {name} {value!r} is that of row {first_row[name, value]} too; expected it once")
            first_row[name, value] = row
        try:
            camera = read_isd(cameras / entry["isd"])
        except InputError as error:
            raise CatalogueError(f"{path}: row {row}: {error}") from None
        stated = (entry["image_samples"], entry["image_lines"])
        size = (camera.size[0] if stated[0] is None else stated[0], camera.size[1] if stated[1] is None else stated[1])
        factor = entry["reduction"]
        if min(size) <= 0 or not (factor is None or (np.isfinite(factor) and factor > 0.0)):
            raise CatalogueError(f"{path}: row {row}: size is {size[0]} x {size[1]}, reduction {factor}; expected positive numbers")
        try:
            time = parse_utc(entry["acquisition_utc"]) if entry["acquisition_utc"] else _time_in(entry["serial_number"])
        except InputError as error:
            raise CatalogueError(f"{path}: row {row}: acquisition_utc: {error}") from None
        listed.append(_Listed(image_id, entry["serial_number"], camera, size, factor, time, entry["pass_id"] or "", entry["licence"] or ""))
    return listed


def _time_in(serial_number: str) -> datetime | None:
    """The time at the end of an ISIS serial number, ``APOLLO15/METRIC/1971-07-31T14:00:53.547``, if it ends in one."""
    try:
        return parse_utc(serial_number.rsplit("/", 1)[-1])
    except InputError:
        return None


def _rays(net: ControlNetwork, path: Path, table: Path, listed: Sequence[_Listed], sigma: float) -> _Rays:
    """All measures of a network, in its order."""
    image_of = {image.serial_number: k for k, image in enumerate(listed)}
    point, image, observed, sigmas = [], [], [], []
    for k, of_point in enumerate(net.points):
        met: set[int] = set()
        for measure in of_point.measures:
            place = f"{path}: point {of_point.point_id}"
            at = image_of.get(measure.serial_number)
            if at is None:
                raise CatalogueError(f"{place}: serial number is {measure.serial_number!r}; expected one of {table}")
            if at in met:
                raise CatalogueError(f"{place} is measured twice in {measure.serial_number}; expected one measure")
            stated = [sigma if s is None else s for s in (measure.sigma_sample, measure.sigma_line)]
            if not min(stated) > 0.0:
                raise CatalogueError(f"{place}: sigmas of the measure in {measure.serial_number} are {stated}; expected positive numbers")
            met.add(at)
            point.append(k)
            image.append(at)
            observed.append((measure.sample - FIRST_PIXEL, measure.line - FIRST_PIXEL))
            sigmas.append(stated)
    if not point:
        raise CatalogueError(f"{path}: holds no measure that counts; expected measures of points in images")
    return _Rays(np.array(point, dtype=np.int32), np.array(image, dtype=np.int32), np.array(observed), np.array(sigmas))


def _metadata(dataset: str, net: ControlNetwork, table: Path, listed: Sequence[_Listed]) -> CatalogueMetadata:
    """Body, ellipsoid and frame, on which all cameras must agree."""
    first = listed[0]
    for other in listed[1:]:
        for name in ("ellipsoid", "frame"):
            if getattr(other.camera, name) != getattr(first.camera, name):
                raise CatalogueError(
                    f"{table}: {name} of {other.image_id} is {getattr(other.camera, name)}, and of {first.image_id} "
                    f"{getattr(first.camera, name)}; expected one body and frame"
                )
    ellipsoid = first.camera.ellipsoid
    return CatalogueMetadata(
        dataset, body=net.target.lower() or "unknown", semimajor_axis=ellipsoid.semimajor_axis, flattening=ellipsoid.flattening,
        frame=first.camera.frame,
    )  # fmt: skip


def _control(net: ControlNetwork, path: Path, prefix: str, ellipsoid: Ellipsoid) -> PointTable:
    """The constrained points with their covariance in local axes."""
    points = [point for point in net.points if point.kind != "Free"]
    places, covariances = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    for k, point in enumerate(points):
        places[k], covariances[k] = _surveyed(point, path)
    geodetic = geocentric_to_geodetic(places, ellipsoid)
    ids = np.array([prefix + point.point_id for point in points], dtype=np.str_)
    return PointTable(ids, geodetic, rotate_covariance(covariances, local_axes(geodetic)), np.full(len(points), ""))


def _surveyed(point: NetworkPoint, path: Path) -> tuple[Array, Array]:
    """Geocentric coordinates (3,) and covariance (3, 3) of a point that is no free one."""
    place = f"{path}: point {point.point_id}"
    if point.kind == "Fixed":
        raise CatalogueError(f"{place} is Fixed, without any error; expected Constrained with its AprioriCovarianceMatrix, or Free")
    if point.a_priori is None or point.covariance is None:
        missing = "AprioriX, AprioriY, AprioriZ" if point.a_priori is None else "AprioriCovarianceMatrix"
        raise CatalogueError(f"{place} is Constrained without {missing}; expected it, or PointType Free")
    covariance = np.zeros((3, 3))
    covariance[np.triu_indices(3)] = point.covariance
    covariance += np.triu(covariance, 1).T
    if not np.linalg.eigvalsh(covariance)[0] > 0.0:
        raise CatalogueError(
            f"{place}: AprioriCovarianceMatrix is {list(point.covariance)}; expected a positive definite matrix (m2), constrained in all "
            "three coordinates, or PointType Free"
        )
    return np.array(point.a_priori), covariance


def _records(
    table: Path, net: ControlNetwork, rays: _Rays, listed: Sequence[_Listed], dataset: str, reduction: float | None, notes: list[str]
) -> list[ImageRecord]:
    """Rows of the catalogue's table of images, in the order of the table that was read."""
    ellipsoid = listed[0].camera.ellipsoid
    known = np.array([point.a_priori is not None for point in net.points])
    places = np.array([point.a_priori or (np.nan, np.nan, np.nan) for point in net.points])
    usable = known[rays.point]
    heights = np.array([image.camera.reference_height for image in listed])
    if usable.any():
        above = geocentric_to_geodetic(places[rays.point[usable]], ellipsoid)[:, 2]
        count = np.bincount(rays.image[usable], minlength=len(listed))
        total = np.bincount(rays.image[usable], above, len(listed))
        heights[count > 0] = total[count > 0] / count[count > 0]
    measured = replace(
        rays, point=rays.point[usable], image=rays.image[usable], observed=rays.observed[usable], sigma=rays.sigma[usable]
    )  # fmt: skip
    factors = _reductions(table, measured, places, listed, heights, reduction, notes)
    pass_ids = passes([Taken(i.camera.platform, i.time, i.pass_id) for i in listed], dataset, notes)
    records = [
        ImageRecord(
            image.image_id, dataset, pass_ids[k], image.camera.platform, "frame",
            json.dumps(image.camera.description(image.size, factors[k], float(heights[k]))), *image.size,
            utc_text(image.time) if image.time else "", licence=image.licence,
        )
        for k, image in enumerate(listed)
    ]  # fmt: skip
    packed = np.stack([record.pack() for record in records])
    if len(measured.point):
        notes.append(_misfit(packed, measured, places, ellipsoid, listed))
    size = np.array([image.size for image in listed], dtype=np.float64)
    outlines = footprints(sensor_named("frame"), packed, np.zeros((len(listed), 2)), size, heights, ellipsoid)
    if b"" in outlines:
        notes.append(
            f"no footprint, because the image reaches beyond the limb: "
            f"{named(i.image_id for i, outline in zip(listed, outlines, strict=True) if not outline)}"
        )
    return [replace(record, footprint=outline) for record, outline in zip(records, outlines, strict=True)]


def _reductions(
    table: Path, rays: _Rays, places: Array, listed: Sequence[_Listed], heights: Array, stated: float | None, notes: list[str]
) -> list[float]:
    """How many times each image was reduced from the detector of its ISD: as stated, as listed, or found from a priori positions."""
    if stated is not None:
        return [stated] * len(listed)
    listed_factors = [image.reduction for image in listed]
    if all(factor is not None for factor in listed_factors):
        return [factor for factor in listed_factors if factor is not None]
    found = _scale(rays, places, listed, heights)
    if found is None:
        return [factor or 1.0 for factor in listed_factors]
    whole = max(round(found), 1)
    if abs(found - whole) > WHOLE * whole:
        raise CatalogueError(
            f"{table}: the measures are {found:.3f} times coarser than the detectors that the ISDs describe, by the a priori positions of "
            "the points; expected a whole number: give it (--reduction, or a column reduction of the table of images), or check the cameras"
        )
    if whole > 1:
        notes.append(f"the images are taken as reduced {whole} times from the detectors of the ISDs (measured: {found:.3f})")
    return [factor or float(whole) for factor in listed_factors]


def _scale(rays: _Rays, places: Array, listed: Sequence[_Listed], heights: Array) -> float | None:
    """Scale of points projected at the detector's full resolution against the measures, about each image's centroid; None without any.

    Images of which the reduction is listed have no say in that of the others.
    """
    cameras = [i.camera.description(i.size, 1.0, float(h)) for i, h in zip(listed, heights, strict=True)]
    full = _project(np.stack([sensor_named("frame").pack(c, *i.size) for c, i in zip(cameras, listed, strict=True)]), rays, places, listed)
    unlisted = np.array([image.reduction is None for image in listed])
    seen = np.isfinite(full).all(axis=1) & unlisted[rays.image]
    spreads = []
    for values in (full[seen], rays.observed[seen]):
        image = rays.image[seen]
        count = np.maximum(np.bincount(image, minlength=len(listed)), 1)
        centre = np.stack([np.bincount(image, values[:, c], len(listed)) / count for c in range(2)], axis=1)
        spreads.append(float(np.sum((values - centre[image]) ** 2)))
    return float(np.sqrt(spreads[0] / spreads[1])) if min(spreads) > 0.0 else None


def _project(packed: Array, rays: _Rays, places: Array, listed: Sequence[_Listed]) -> Array:
    ground = Ground.at(places[rays.point], listed[0].camera.ellipsoid)
    sensor = sensor_named("frame")
    theta = np.zeros((len(packed), len(sensor.parameters)))
    return sensor.project(packed, theta, ground, rays.image, np.arange(len(rays.point), dtype=np.int32)).image


def _misfit(packed: Array, rays: _Rays, places: Array, ellipsoid: Ellipsoid, listed: Sequence[_Listed]) -> str:
    """How far the measures lie from the a priori positions, cameras unadjusted."""
    off = np.linalg.norm(_project(packed, rays, places, listed) - rays.observed, axis=1)
    medians = {image.image_id: float(np.nanmedian(off[rays.image == k])) for k, image in enumerate(listed) if (rays.image == k).any()}
    worst = max(medians, key=lambda name: medians[name])
    return (
        f"before any adjustment measures lie {np.nanmedian(off):.1f} px (median) from the a priori positions of their points, "
        f"most in {worst}, {medians[worst]:.1f} px"
    )


__all__ = ["camera_priors", "import_isis"]
