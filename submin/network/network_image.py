"""An image as the network knows it, and sets of them ready to be adjusted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori, ImagePrior
from submin.geodesy import Ellipsoid
from submin.sensors import sensor_named


@dataclass(frozen=True)
class NetworkImage:
    """One image.

    Attributes
    ----------
    image_id, block_id, pass_id, sensor : names
    camera : catalogue description, JSON text
    width, height : pixels
    seconds : time of acquisition, seconds since 1970; NaN when unknown
    a_priori : JSON text of the a priori model of its block; empty for an image that has nothing to adjust
    released : True once its camera was found to be bad and its prior given up
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


@lru_cache(maxsize=4096)
def _packed(sensor: str, camera: str, width: int, height: int) -> NDArray[np.float64]:
    return sensor_named(sensor).pack(json.loads(camera), width, height)


@lru_cache(maxsize=256)
def _a_priori(text: str) -> APriori | None:
    return APriori.from_mapping(json.loads(text)) if text else None


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
    priors = tuple(
        ImagePrior(i.block_id, i.pass_id, i.seconds, _a_priori(i.a_priori), sensor_named(i.sensor).parameters, i.released) for i in images
    )
    return ImageSet(tuple(i.image_id for i in images), tuple(i.sensor for i in images), packed, priors, parameters, ellipsoid)
