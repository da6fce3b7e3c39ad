"""An image as the network knows it, and sets of them ready to be adjusted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori, ImagePrior, JointRows
from submin.errors import InputError, StoreError
from submin.geodesy import WGS84, Ellipsoid
from submin.sensors import sensor_named
from submin.sensors.description import camera_values
from submin.sensors.footprint import ground_pixels
from submin.sensors.rpc import image_centres

CAMERAS_KEPT = 8192
"""Parsed cameras that a process keeps: those of a batch."""


@dataclass(frozen=True)
class NetworkImage:
    """One image.

    Attributes
    ----------
    image_id, block_id, pass_id, sensor : names
    camera : catalogue description, JSON text
    width, height : pixels
    seconds : time of acquisition, seconds since 1970; NaN when unknown
    a_priori : JSON text of its a priori model (in pixels), or of its `JointPlace`; empty for an image that has nothing to adjust
    released : True once its camera was found to be bad and its prior given up
    joint : rows of a common factor, of a view of correlated control
    """

    image_id: str
    block_id: str
    pass_id: str
    sensor: str
    camera: str
    width: int
    height: int
    seconds: float
    a_priori: str
    released: bool = False
    joint: JointRows | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class JointPlace:
    """Where the a priori model of a view of correlated control is kept.

    Attributes
    ----------
    record : name of the factor of its set; first, rows : its rows of it; part : see `JointRows`
    """

    record: str
    first: int
    rows: int
    part: float

    def to_text(self) -> str:
        """What the image's ``a_priori`` holds."""
        return json.dumps({_JOINT: asdict(self)})

    @classmethod
    def from_text(cls, a_priori: str) -> JointPlace | None:
        """The place that an image's ``a_priori`` names, or None."""
        return cls(**json.loads(a_priori)[_JOINT]) if a_priori.startswith(f'{{"{_JOINT}"') else None


_JOINT = "joint"


@lru_cache(maxsize=CAMERAS_KEPT)
def _packed(sensor: str, camera: str, width: int, height: int) -> NDArray[np.float64]:
    return sensor_named(sensor).pack(camera_values(camera), width, height)


class CatalogueImage(Protocol):
    """What a catalogue says of the camera of an image."""

    @property
    def image_id(self) -> str:
        """Name of the image."""

    @property
    def sensor(self) -> str:
        """Name of its sensor model."""

    @property
    def camera(self) -> str:
        """Description of its camera, JSON text."""

    @property
    def width(self) -> int:
        """Samples."""

    @property
    def height(self) -> int:
        """Lines."""


def a_priori_texts(models: Sequence[APriori | None], images: Sequence[CatalogueImage]) -> list[str]:
    """What images have in ``a_priori``: the model of each one's block, in its own pixels where that states the shift of RPCs in metres.

    Raises
    ------
    InputError
        When a camera is not what its sensor model expects, or does not see the ground in the middle of its image.
    """
    in_metres = [k for k, model in enumerate(models) if model is not None and model.bias_m is not None and images[k].sensor == "rpc"]
    pixel = dict(zip(in_metres, _ground_pixels([images[k] for k in in_metres]), strict=True))
    for k in in_metres:
        if not np.isfinite(pixel[k]):
            raise InputError(
                f"image {images[k].image_id}: its camera does not see the ground in the middle of the image, so a shift stated in metres "
                "(bias_m of the priors) has no size in pixels; mend the camera, or state bias_px"
            )
    return ["" if model is None else _text(model.in_pixels(pixel[k]) if k in pixel else model) for k, model in enumerate(models)]


def _ground_pixels(images: Sequence[CatalogueImage]) -> list[float]:
    """Size of a pixel of each of some RPC images (whose ground is on WGS84) in its middle, metres; NaN where it sees no ground."""
    if not images:
        return []
    cameras = np.array([_packed(i.sensor, i.camera, i.width, i.height) for i in images])
    found: list[float] = ground_pixels(sensor_named("rpc"), cameras, image_centres(cameras), WGS84).tolist()
    return found


@lru_cache(maxsize=4096)
def _text(model: APriori) -> str:
    return json.dumps(model.to_mapping(), sort_keys=True)


@lru_cache(maxsize=256)
def _a_priori(text: str) -> APriori | None:
    return APriori.from_mapping(json.loads(text)) if text and JointPlace.from_text(text) is None else None


def _prior(image: NetworkImage) -> ImagePrior:
    if image.joint is None and JointPlace.from_text(image.a_priori) is not None:
        raise StoreError(f"image {image.image_id} has lost its part of a joint covariance; the store is damaged")
    return ImagePrior(
        image.block_id, image.pass_id, image.seconds, _a_priori(image.a_priori), sensor_named(image.sensor).parameters, image.released,
        image.joint,
    )  # fmt: skip


def image_set(images: Sequence[NetworkImage], ellipsoid: Ellipsoid, parameters: int) -> ImageSet:
    """The images with packed cameras and a priori models, ``parameters`` adjustable ones kept for each.

    Raises
    ------
    InputError
        When a camera's description is not what its sensor model expects.
    """
    cameras = [_packed(i.sensor, i.camera, i.width, i.height) for i in images]
    packed = np.full((len(images), max((len(c) for c in cameras), default=0)), np.nan)
    for row, camera in zip(packed, cameras, strict=True):
        row[: len(camera)] = camera
    priors = image_priors(images)
    return ImageSet(tuple(i.image_id for i in images), tuple(i.sensor for i in images), packed, priors, parameters, ellipsoid)


def image_priors(images: Sequence[NetworkImage]) -> tuple[ImagePrior, ...]:
    """What is believed a priori of some images; their cameras are not looked at."""
    return tuple(_prior(image) for image in images)
