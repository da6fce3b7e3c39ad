"""What a catalogue holds, as frozen values: metadata, images, blocks of rays, tables of points; and what may be wrong inside one block.

The layout on disk is that of docs ("Catalogue (input): a folder"); `submin.storage.catalogue` reads it and
`submin.storage.catalogue_writer` writes it. The centre of the first pixel is (0, 0) in sample and line.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.joint_errors import JointErrors
from submin.adjustment.priors import APriori
from submin.adjustment.rays import canonical_order
from submin.errors import CatalogueError, InputError
from submin.geodesy import WGS84, Ellipsoid
from submin.network.id_numbers import numbered
from submin.sensors import sensor_named
from submin.sensors.description import camera_values

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Ids = NDArray[np.str_]

FORMAT_VERSION = 1
FAR_OUTSIDE = 10.0
"""Measurements farther from the middle of their image than so many times its size are none of it."""
LEAST_RAYS = 3
"""A block with fewer rays ties nothing to anything: more likely a table cut short than a block."""
DEFAULT_SIGMA_PX = 0.5
"""Standard deviation of a measured image coordinate for which a catalogue gives none, pixels."""

COVARIANCE_COLUMNS = ("cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu")
SIGMA_COLUMNS = ("sigma_e", "sigma_n", "sigma_u")
CONTROL_PREFIX = "control:"
"""Begins the block and image ids of control points; no catalogue may use it."""
BLOCK_KINDS = ("images", "control", "observations")
POINT_KINDS = ("control", "check", "truth")

_COMPACT_UTC = re.compile(r"(\d{14})(\.\d+)?")
_MEASURED = ("sample", "line", "sigma_sample", "sigma_line")


def parse_utc(text: str) -> datetime:
    """The time that a text names: ``20141005160138`` or ISO 8601 with a time of day; without an offset it is UTC.

    Raises
    ------
    InputError
        When it names no time of day.

    Examples
    --------
    >>> parse_utc("20141005160138") == parse_utc("2014-10-05T18:01:38+02:00")
    True
    """
    compact = _COMPACT_UTC.fullmatch(text)
    if compact:
        digits = compact[1]
        text = f"{digits[:4]}-{digits[4:6]}-{digits[6:8]}T{digits[8:10]}:{digits[10:12]}:{digits[12:]}{compact[2] or ''}"
    try:
        if len(text) <= len("2014-10-05"):
            raise ValueError("a date alone does not order the images of a pass")
        time = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"time is {text!r}; expected 20141005160138 or ISO 8601 as in 2014-10-05T16:01:38Z") from None
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def utc_text(time: datetime) -> str:
    """ISO 8601 text in UTC, as the column ``acquired`` holds it.

    Examples
    --------
    >>> utc_text(parse_utc("20141005160138"))
    '2014-10-05T16:01:38Z'
    """
    return time.astimezone(UTC).replace(tzinfo=None).isoformat() + "Z"


@dataclass(frozen=True)
class CatalogueMetadata:
    """What holds for a whole catalogue (``catalogue.json``).

    Parameters
    ----------
    name : str
        Name of the catalogue.
    format_version : int
        Version of the layout.
    body, semimajor_axis, flattening
        The body and its ellipsoid; metres, and 0 for a sphere.
    frame, epoch : str
        Reference frame and epoch of coordinates, free text. A network takes only catalogues of its own.
    height_kind : str
        ``ellipsoidal``.

    Raises
    ------
    CatalogueError
        When the version is unknown, heights are not ellipsoidal, or the ellipsoid is none.
    """

    name: str
    format_version: int = FORMAT_VERSION
    body: str = "earth"
    semimajor_axis: float = WGS84.semimajor_axis
    flattening: float = WGS84.flattening
    frame: str = "WGS84"
    epoch: str = ""
    height_kind: str = "ellipsoidal"

    def __post_init__(self) -> None:
        for name in ("name", "body", "frame", "epoch", "height_kind"):
            value = getattr(self, name)
            if not isinstance(value, str) or (name != "epoch" and not value):
                raise CatalogueError(f"{name} is {value!r}; expected {'text' if name == 'epoch' else 'a text that is not empty'}")
        if self.format_version != FORMAT_VERSION:
            raise CatalogueError(
                f"format_version is {self.format_version!r}; expected {FORMAT_VERSION}: write it again with this version of submin"
            )
        if self.height_kind != "ellipsoidal":
            raise CatalogueError(
                f"height_kind is {self.height_kind!r}; expected 'ellipsoidal': add the geoid's undulation to orthometric heights first"
            )
        try:
            Ellipsoid(self.semimajor_axis, self.flattening)
        except TypeError:
            raise CatalogueError(
                f"semimajor_axis, flattening are {self.semimajor_axis!r}, {self.flattening!r}; expected two numbers"
            ) from None
        except InputError as error:
            raise CatalogueError(str(error)) from None

    @property
    def ellipsoid(self) -> Ellipsoid:
        """Ellipsoid to which longitude, latitude and height refer."""
        return Ellipsoid(self.semimajor_axis, self.flattening)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> CatalogueMetadata:
        """The metadata of a ``catalogue.json``; name and format version must be given, and another body than Earth needs its ellipsoid."""
        names = [f.name for f in fields(cls)]
        unknown = sorted(set(values) - set(names))
        if unknown:
            raise CatalogueError(f"unknown key {unknown[0]!r}; expected some of {', '.join(names)}")
        required = ["name", "format_version"]
        if values.get("body", "earth") != "earth":
            required += ["semimajor_axis", "flattening"]
        for name in required:
            if name not in values:
                raise CatalogueError(f"key {name!r} is missing; expected {', '.join(required)} and perhaps others of {', '.join(names)}")
        return cls(**values)

    def to_mapping(self) -> dict[str, Any]:
        """The content of ``catalogue.json``."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


@dataclass(frozen=True)
class ImageRecord:
    """One image: a row of ``images.parquet``.

    Attributes
    ----------
    image_id, block_id, pass_id : the image, the block it is adjusted in, and the pass whose errors it shares
    platform : satellite
    sensor : name of its model in ``submin.sensors.SENSORS``
    camera : JSON text of that model
    width, height : size in pixels
    acquired : time, ISO 8601 in UTC, or empty
    footprint : polygon as WKB, longitude and latitude in degrees, or empty
    licence : free text
    """

    image_id: str
    block_id: str
    pass_id: str
    platform: str
    sensor: str
    camera: str
    width: int
    height: int
    acquired: str = ""
    footprint: bytes = b""
    licence: str = ""

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise InputError(f"image {self.image_id}: size is {self.width} x {self.height}; expected positive numbers of pixels")
        if self.acquired:
            parse_utc(self.acquired)

    @property
    def seconds(self) -> float:
        """Time of the image in seconds since 1970, UTC; NaN when it is not known."""
        return parse_utc(self.acquired).timestamp() if self.acquired else float("nan")

    def pack(self) -> Array:
        """Packed camera, see `submin.sensors.Sensor.pack`.

        Raises
        ------
        InputError
            Naming the image, when the sensor is unknown, the text is not JSON, or the sensor model refuses it.
        """
        try:
            camera = camera_values(self.camera)
            if not isinstance(camera, dict):
                raise InputError(f"camera is {type(camera).__name__}; expected a JSON object")
            return sensor_named(self.sensor).pack(camera, self.width, self.height)
        except json.JSONDecodeError as error:
            raise InputError(f"image {self.image_id}: camera is not JSON ({error})") from None
        except InputError as error:
            raise InputError(f"image {self.image_id}: {error}") from None
        except (TypeError, ValueError, LookupError) as error:  # a sensor model that met what it did not expect
            raise InputError(f"image {self.image_id}: camera cannot be used by sensor {self.sensor!r} ({error})") from None

    @property
    def _content(self) -> dict[str, Any]:
        try:
            camera = camera_values(self.camera)
        except json.JSONDecodeError:
            camera = self.camera
        return {
            "image_id": self.image_id, "pass_id": self.pass_id, "sensor": self.sensor, "camera": camera,
            "width": self.width, "height": self.height, "seconds": self.seconds if self.acquired else None,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Block:
    """Images that are adjusted together, with their rays.

    Attributes
    ----------
    block_id : str
    images : its m images, in catalogue order
    a_priori : what is believed of their cameras before any measurement; None when they have nothing to adjust
    point_ids : (r,) ground point of each ray
    image : (r,) index into ``images``
    sample, line : (r,) measured image coordinates, pixels
    sigma_sample, sigma_line : (r,) their standard deviations, pixels
    content : what the block is made of, where that is not images and rays as they are: identifies it instead of them
    kind : one of `BLOCK_KINDS`
    joint : covariance of the shifts of its views, view by view, where it is one of correlated points
    source, first_row : file that holds the rays, and its row of the first one, for messages; empty when they come from no file
    """

    block_id: str
    images: tuple[ImageRecord, ...]
    a_priori: APriori | None
    point_ids: Ids
    image: Index
    sample: Array
    line: Array
    sigma_sample: Array
    sigma_line: Array
    content: str = ""
    source: str = ""
    first_row: int = 1
    kind: str = "images"
    joint: JointErrors | None = None

    def __post_init__(self) -> None:
        shapes = {name: np.shape(getattr(self, name)) for name in ("point_ids", "image", *_MEASURED)}
        if len(set(shapes.values())) != 1 or len(shapes["image"]) != 1:
            raise InputError(f"block {self.block_id}: arrays have shapes {shapes}; expected one length, a ray each")
        if len(self.image) and not (self.image.min() >= 0 and self.image.max() < len(self.images)):
            raise InputError(f"block {self.block_id}: image holds {self.image.max()}; expected indices into {len(self.images)} images")

    def __len__(self) -> int:
        return len(self.image)

    def __getstate__(self) -> dict[str, Any]:
        """Once points are numbered a block travels without the name of each ray's: two fifths of its bytes."""
        return {name: value for name, value in vars(self).items() if name != "point_ids" or "points" not in vars(self)}

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """The names of the rays' points of a block that has travelled without them; hardly anybody asks."""
            if name == "point_ids" and "points" in vars(self):
                ids, point = self.points
                return ids[point]
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @cached_property
    def points(self) -> tuple[Ids, Index]:
        """Ids (n,) of the ground points, ascending, and the place (r,) of each ray's point among them."""
        ids, point = numbered(self.point_ids)
        return ids, point.astype(np.int32)

    @property
    def observed(self) -> Array:
        """Sample and line (r, 2) of each ray, pixels."""
        return np.column_stack([self.sample, self.line])

    @property
    def sigma(self) -> Array:
        """Standard deviations (r, 2) of these, pixels."""
        return np.column_stack([self.sigma_sample, self.sigma_line])

    def content_hash(self) -> str:
        """Hexadecimal BLAKE2b of what an adjustment of the block depends on.

        That is image ids, passes, cameras, sizes, times, the a priori model and the rays. Neither the order of images or rays nor the
        layout of a camera's JSON text leaves a trace.
        """
        return self._content_hash

    @cached_property
    def _content_hash(self) -> str:
        if self.content:
            return hashlib.blake2b(self.content.encode(), digest_size=32).hexdigest()
        order = sorted(range(len(self.images)), key=lambda i: self.images[i].image_id)
        rank = np.empty(len(order), dtype="<i4")
        rank[order] = np.arange(len(order))
        points, point = self.points
        measured = [np.asarray(getattr(self, name), dtype="<f8") + 0.0 for name in _MEASURED]  # + 0.0: one sign of zero
        rays = canonical_order(point, rank[self.image], np.column_stack(measured))
        head = {
            "images": [self.images[i]._content for i in order],
            "a_priori": None if self.a_priori is None else self.a_priori.to_mapping(),
            "points": points.tolist(),
        }
        digest = hashlib.blake2b(json.dumps(head, sort_keys=True).encode(), digest_size=32)
        for column in (point.astype("<i4"), rank[self.image], *measured):
            digest.update(np.ascontiguousarray(column[rays]).tobytes())
        return digest.hexdigest()


def defects(block: Block) -> str | None:
    """Why a block cannot be used as it is, in one line, or None: an error inside one block rejects that block and no other."""
    if not len(block):
        return "the block has no measurements; measure it, or remove its images"

    def ray(r: int) -> str:
        place = f"{block.source}: row {block.first_row + r}: " if block.source else ""
        return f"{place}point {block.point_ids[r]} in image {block.images[block.image[r]].image_id}"

    for name in _MEASURED:
        values = getattr(block, name)
        bad = ~np.isfinite(values)
        if bad.any():
            r = int(np.argmax(bad))
            return f"{ray(r)}: {name} is {values[r]}; expected a finite number of pixels"
    for name, sizes in (("sample", [i.width for i in block.images]), ("line", [i.height for i in block.images])):
        first, size = _first_pixels(block.images, name)[block.image], np.array(sizes, dtype=np.float64)[block.image]
        bad = np.abs(getattr(block, name) - first - 0.5 * size) > FAR_OUTSIDE * size
        if bad.any():
            r = int(np.argmax(bad))
            least, most = first[r], first[r] + size[r] - 1.0
            found = getattr(block, name)[r]
            return f"{ray(r)}: {name} is {found:g}; expected one of the image ({least:g} to {most:g}), or a little outside it"
    for name in ("sigma_sample", "sigma_line"):
        values = getattr(block, name)
        bad = values <= 0.0
        if bad.any():
            r = int(np.argmax(bad))
            return f"{ray(r)}: {name} is {values[r]}; expected a positive number of pixels"
    repeated = first_repeated(block.points[1], block.image)
    if repeated is not None:
        r = repeated[1]
        return f"{ray(r)} is measured twice, the second time at sample {block.sample[r]}, line {block.line[r]}; expected one ray"
    counts = np.bincount(block.image, minlength=len(block.images))
    if (counts == 0).any():
        return f"image {block.images[int(np.argmin(counts))].image_id} has no measurements; expected some in every image of the block"
    if block.a_priori is not None and len(block) < LEAST_RAYS:
        found = f"{len(block)} ray{'s' * (len(block) > 1)}"
        return f"the block has {found}; expected at least {LEAST_RAYS}: measure more, or join it to another block"
    for image in block.images:
        models = () if block.a_priori is None or image.acquired else map(block.a_priori.of, sensor_named(image.sensor).parameters)
        for model in models:
            if model.sigma > 0.0 and model.correlation in ("exponential", "gaussian"):
                return f"image {image.image_id} has no time; the {model.correlation} correlation of the priors needs column 'acquired'"
    return None


def _first_pixels(images: Sequence[ImageRecord], name: str) -> Array:
    """Sample or line (m,) of the first pixel of each image: of an RPC, in the pixel frame that it states."""
    cameras = [camera_values(image.camera) if image.sensor == "rpc" else {} for image in images]
    return np.array([float(camera.get("origin", (0.0, 0.0))[name == "line"]) for camera in cameras])


def first_repeated(point: NDArray[np.integer], image: NDArray[np.integer]) -> tuple[int, int] | None:
    """Rows (earlier, later) of the first ray, in row order, that repeats the point and image of an earlier one."""
    order = np.lexsort((image, point))  # stable: rows of one pair stay in row order
    same = (np.diff(point[order]) == 0) & (np.diff(image[order]) == 0)
    if not same.any():
        return None
    at = np.flatnonzero(same)
    first = at[np.argmin(order[at + 1])]
    return int(order[first]), int(order[first + 1])


@dataclass(frozen=True, eq=False)
class PointTable:
    """Ground points with their accuracy: control, check points, or simulated truth.

    Attributes
    ----------
    point_ids : (n,)
    geodetic : (n, 3), longitude and latitude in degrees, height in metres above the ellipsoid
    covariance_enu : (n, 3, 3), covariance of each point in its local axes east, north, up, m2
    area : (n,) name of a sub-area, or empty
    joint_covariance : (3n, 3n), covariance of all points in geocentric axes, point-major, m2; None for uncorrelated points
    """

    point_ids: Ids
    geodetic: Array
    covariance_enu: Array
    area: Ids
    joint_covariance: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.point_ids)
        expected = {"point_ids": (n,), "geodetic": (n, 3), "covariance_enu": (n, 3, 3), "area": (n,), "joint_covariance": (3 * n, 3 * n)}
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise InputError(f"points: {name} has shape {np.shape(value)}; expected {shape}")

    def __len__(self) -> int:
        return len(self.point_ids)


@dataclass(frozen=True)
class CatalogueSummary:
    """Sizes of a catalogue that was found free of structural errors; ``clusters`` are those of ``observations`` without images."""

    blocks: int
    images: int
    rays: int
    clusters: int = 0
    observations: int = 0


__all__ = [
    "COVARIANCE_COLUMNS", "DEFAULT_SIGMA_PX", "FORMAT_VERSION", "POINT_KINDS", "SIGMA_COLUMNS",
    "Block", "CatalogueMetadata", "CatalogueSummary", "ImageRecord", "PointTable", "defects", "first_repeated", "parse_utc", "utc_text",
]  # fmt: skip
