"""A set of images to be adjusted together: packed cameras of any sensors, and what is believed of them a priori."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.priors import ImagePrior, prior_factor, prior_variance
from submin.geodesy import WGS84, Ellipsoid
from submin.sensors import DriftingSensor, Ground, Projection, sensor_named

Array = NDArray[np.float64]
Index = NDArray[np.int32]


@dataclass(frozen=True)
class Drifts:
    """Parameters of images that are another one times a factor that grows along the image (`submin.sensors.Drift`).

    Attributes
    ----------
    of : (m, p) number of the other parameter, -1 for one that is no drift; axis : (m, p) along which the factor grows
    by_pixel : (m, 2) by how much it grows a pixel along each axis
    """

    of: Index
    axis: Index
    by_pixel: Array


@dataclass(frozen=True)
class ImageSet:
    """Images with their cameras and a priori model.

    Attributes
    ----------
    ids : names of the m images
    sensors : name of each image's sensor model
    cameras : (m, c) packed cameras; rows of sensors with fewer numbers are padded with NaN
    priors : what the a priori factor needs, by image
    parameters : adjustable parameters kept for each image, those of its sensor first
    ellipsoid : of the body that they look at
    """

    ids: tuple[str, ...]
    sensors: tuple[str, ...]
    cameras: Array
    priors: tuple[ImagePrior, ...]
    parameters: int
    ellipsoid: Ellipsoid = WGS84

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def prior(self) -> sp.csr_array:
        """A priori factor K (m p, q), see `prior_factor`."""
        return prior_factor(self.priors, self.parameters)

    @cached_property
    def prior_variance(self) -> Array:
        """A priori variances (m, p) of the images' parameters."""
        return prior_variance(self.prior, self.parameters)

    @cached_property
    def drifts(self) -> Drifts:
        """Which parameters drift over the image."""
        of, axis = np.full((2, len(self), self.parameters), -1, dtype=np.int32)
        by_pixel = np.zeros((len(self), 2))
        for name in set(self.sensors):
            sensor, rows = sensor_named(name), np.flatnonzero(np.array(self.sensors) == name)
            drifts = {k: parameter.drift for k, parameter in enumerate(sensor.parameters) if parameter.drift is not None}
            for k, drift in drifts.items():
                of[rows, k], axis[rows, k] = drift.of, drift.axis
            if drifts:
                by_pixel[rows] = cast(DriftingSensor, sensor).drift_by_pixel(self.cameras[rows])
        return Drifts(of, axis, by_pixel)

    @cached_property
    def in_pixels(self) -> NDArray[np.bool_]:
        """True (m,) for images whose coordinates are pixels; a survey's are metres."""
        return np.array([sensor_named(name).unit == "pixel" for name in self.sensors], dtype=np.bool_)

    def take(self, rows: Sequence[int] | NDArray[np.integer]) -> ImageSet:
        """The images of these rows, in this order."""
        return ImageSet(
            tuple(self.ids[i] for i in rows),
            tuple(self.sensors[i] for i in rows),
            self.cameras[np.asarray(rows, dtype=np.int64)],
            tuple(self.priors[i] for i in rows),
            self.parameters,
            self.ellipsoid,
        )

    def release(self, which: NDArray[np.bool_]) -> ImageSet:
        """The same images with the priors of some (m,) released: their positions are left to the network."""
        return replace(self, priors=tuple(replace(p, released=p.released or bool(w)) for p, w in zip(self.priors, which, strict=True)))

    def ground(self, geocentric: Array) -> Ground:
        """Ground points (n, 3) in metres in the forms that sensors need."""
        return Ground.at(geocentric, self.ellipsoid)

    def project(self, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """Image coordinates of rays and their partials; see `submin.sensors.Sensor.project`."""
        names = set(self.sensors)
        if len(names) == 1 and len(sensor_named(self.sensors[0]).parameters) == self.parameters:
            return sensor_named(self.sensors[0]).project(self.cameras, parameters, ground, image, point, at)
        rays = len(image)
        whole = Projection(np.empty((rays, 2)), np.empty((rays, 2, 3)), np.zeros((rays, 2, self.parameters)))
        of_image = np.array(self.sensors, dtype=np.str_)
        for name in names:
            sensor, chosen = sensor_named(name), of_image[image] == name
            where = None if at is None else at[chosen]
            part = sensor.project(self.cameras, parameters, ground, image[chosen], point[chosen], where)
            whole.image[chosen], whole.by_ground[chosen] = part.image, part.by_ground
            whole.by_parameters[chosen, :, : len(sensor.parameters)] = part.by_parameters
        return whole

    def localise(self, image: Index, observed: Array) -> Array:
        """Geodetic coordinates (r, 3) of image coordinates (r, 2) at each camera's mean height, unadjusted cameras."""
        ground = np.full((len(image), 3), np.nan)
        of_image = np.array(self.sensors)
        for name in set(self.sensors):
            sensor, rays = sensor_named(name), of_image[image] == name
            heights = sensor.mean_height(self.cameras)[image[rays]]
            samples, lines = np.ascontiguousarray(observed[rays, 0]), np.ascontiguousarray(observed[rays, 1])
            ground[rays] = sensor.localise(self.cameras, image[rays], samples, lines, heights, self.ellipsoid)
        return ground
