"""What every sensor model answers: where a ground point falls in an image, and how that depends on point and image parameters.

A sensor works on many rays of many images at once: cameras are rows of one array, rays name a camera row and a ground row. A new
sensor is one file with one object that keeps this protocol, and one row in ``submin.sensors.SENSORS``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from submin.geodesy import WGS84, Ellipsoid, geodetic_with_jacobian

Array = NDArray[np.float64]
Index = NDArray[np.int32]


@dataclass(frozen=True)
class Ground:
    """Ground points in the forms that sensor models need.

    Attributes
    ----------
    geocentric : (n, 3), metres
    geodetic : (n, 3), longitude and latitude in degrees, height in metres above the ellipsoid
    jacobian : (n, 3, 3), partials of ``geodetic`` with respect to ``geocentric``
    """

    geocentric: Array
    geodetic: Array
    jacobian: Array

    @classmethod
    def at(cls, geocentric: Array, ellipsoid: Ellipsoid = WGS84) -> Ground:
        """Ground points from geocentric coordinates (n, 3) in metres."""
        return cls(np.ascontiguousarray(geocentric), *geodetic_with_jacobian(geocentric, ellipsoid))


@dataclass(frozen=True)
class Projection:
    """Image coordinates of rays and their partials; whoever asked for them may change the arrays.

    Attributes
    ----------
    image : (r, 2), predicted sample and line in pixels
    by_ground : (r, 2, 3), partials with respect to the geocentric coordinates of the point, pixels per metre
    by_parameters : (r, 2, p), partials with respect to the adjustable parameters of the image, pixels per unit
    """

    image: Array
    by_ground: Array
    by_parameters: Array


@dataclass(frozen=True)
class Drift:
    """What an adjustable parameter is another one, no drift itself, times a factor that grows evenly along the image: a place, or time.

    Attributes
    ----------
    of : number of the other parameter
    axis : along which the factor grows: 0 with the sample, 1 with the line
    """

    of: int
    axis: int


@dataclass(frozen=True)
class Parameter:
    """One adjustable parameter of an image: a correction that is zero for the unadjusted camera.

    Attributes
    ----------
    name : for people, and for priors: "sample bias", "position in track"
    unit : "px", "m", "rad"
    group : parameters of a kind, which priors may name together: "bias", "position", "attitude"
    sigma : a priori, in its unit, where the priors of a block say nothing
    shared : True when the images of a pass can share an error in it
    drift : set for a parameter that is another one times a factor
    """

    name: str
    unit: str
    group: str
    sigma: float
    shared: bool = False
    drift: Drift | None = None


class Sensor(Protocol):
    """A sensor model. ``name`` is the word in the column ``sensor`` of a catalogue."""

    name: str
    unit: str
    """In which image coordinates are measured: ``pixel`` or ``metre``."""
    parameters: tuple[Parameter, ...]
    """The adjustable parameters of an image."""

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        """Row of numbers that describes one camera, from its catalogue description; raises `InputError` when it is incomplete.

        The description is not to be changed: others read the same object.
        """
        ...

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """Project ray r: point ``point[r]`` into image ``image[r]``; NaN where the camera does not see the point.

        A correction that varies over the image is evaluated at the image coordinates ``at`` (r, 2), by default at the predicted ones.

        ``cameras`` (m, c) holds packed cameras, ``parameters`` (m, p) the corrections of the images' adjustable parameters: those of the
        sensor first, and perhaps more columns, which are not its own.
        """
        ...

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """Longitude, latitude (degrees) and height (r, 3) of image coordinates at given ellipsoidal heights, unadjusted cameras.

        A place that cannot be reached (camera looking away from it) comes back as NaN.
        """
        ...

    def mean_height(self, cameras: Array) -> Array:
        """Height (m,) in metres near which each camera's ground is expected."""
        ...


class DriftingSensor(Sensor, Protocol):
    """A sensor some of whose parameters are a `Drift`."""

    def drift_by_pixel(self, cameras: Array) -> Array:
        """By how much (m, 2) the factor of a drift grows a pixel, with the sample and with the line.

        ``cameras`` (m, c) are packed. The factor's unit is that of the other parameter over that of the drift: none, or seconds
        (docs/decisions/018).
        """
        ...
