"""What a simulated experiment is made of: a layout that nothing random touches, and realisations of it with drawn errors and known truth.

A layout says which image sees which point. A realisation draws, from one generator of its seed,

    observed = f(x_true, theta_true) + noise        theta_true = K u,  u ~ N(0, I)

with ``K`` the a priori factor of `submin.adjustment.priors`, so a network that is told the same a priori model must come out consistent.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from submin.accuracy import ce90, le90
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori
from submin.geodesy import WGS84, Ellipsoid, geocentric_to_geodetic, geodetic_to_geocentric, local_axes
from submin.network.network_image import NetworkImage, a_priori_texts, image_set
from submin.sensors import width_of

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Ids = NDArray[np.str_]


@dataclass(frozen=True)
class SimulatedImage:
    """One image as the catalogue describes it: ``camera`` is JSON text, ``acquired`` ISO 8601 text in UTC, ``footprint`` WKB in degrees."""

    image_id: str
    block_id: str
    pass_id: str
    platform: str
    sensor: str
    camera: str
    width: int
    height: int
    acquired: str
    footprint: bytes

    @property
    def seconds(self) -> float:
        """Time of acquisition in seconds since 1970."""
        return datetime.datetime.fromisoformat(self.acquired).timestamp()


def simulated_image_set(images: Sequence[SimulatedImage], priors: Mapping[str, APriori], ellipsoid: Ellipsoid = WGS84) -> ImageSet:
    """Images with their cameras and a priori models (by block), read back from the text that a catalogue would hold."""
    texts = a_priori_texts([priors[image.block_id] for image in images], images)
    members = [
        NetworkImage(i.image_id, i.block_id, i.pass_id, i.sensor, i.camera, i.width, i.height, i.seconds, text)
        for i, text in zip(images, texts, strict=True)
    ]
    return image_set(members, ellipsoid, width_of(image.sensor for image in images))


@dataclass(frozen=True, eq=False)
class Survey:
    """Points whose coordinates somebody has surveyed, all with the same accuracy.

    Attributes
    ----------
    points : (k,) rows of the layout's points, ascending
    covariance : (3, 3) of each point's error in its local axes east, north, up, m2; zero for points that are known exactly
    """

    points: Index
    covariance: Array

    @classmethod
    def accurate_to(cls, points: NDArray[np.integer], metres: float) -> Survey:
        """Points with this CE90 and LE90."""
        sigma = metres / np.array([ce90(np.eye(2))[0], ce90(np.eye(2))[0], le90(1.0)[0]])
        return cls(points.astype(np.int32), np.diag(sigma**2))


@dataclass(frozen=True, eq=False)
class Layout:
    """An experiment without its errors: the same for every seed.

    Attributes
    ----------
    name : for people
    images : m images, ordered by block
    priors : a priori model by block
    point_ids : (n,) ascending
    truth : (n, 3) longitude, latitude (degrees) and ellipsoidal height (metres)
    area : (n,) name of the sub-area that each point belongs to
    image, point : (r,) rays: rows of ``images`` and ``point_ids``, sorted by image, then point
    sigma_px : of a measurement, sample and line each
    check : points to judge by; control : points that somebody may add to a network as control
    """

    name: str
    images: tuple[SimulatedImage, ...]
    priors: Mapping[str, APriori]
    point_ids: Ids
    truth: Array
    area: Ids
    image: Index
    point: Index
    sigma_px: float
    check: Survey
    control: Survey
    ellipsoid: Ellipsoid = WGS84

    @cached_property
    def image_set(self) -> ImageSet:
        """The images with their cameras and a priori models."""
        return simulated_image_set(self.images, self.priors, self.ellipsoid)

    def with_rays(self, measured: NDArray[np.bool_]) -> Layout:
        """The layout with a ray where ``measured`` (m, n) is true."""
        image, point = np.nonzero(measured)
        return replace(self, image=image.astype(np.int32), point=point.astype(np.int32))


@dataclass(frozen=True, eq=False)
class SimulatedScene:
    """A realisation of a layout: everything that a network may know, and the truth that it must not.

    Attributes
    ----------
    layout, seed
    theta : (m, p) true corrections of the images
    observed : (r, 2) measured sample and line, pixels
    surveyed : (n, 3) surveyor's errors of all points, in sigmas: a point that is check and control has one of them
    """

    layout: Layout
    seed: int
    theta: Array
    observed: Array
    surveyed: Array

    def coordinates(self, survey: Survey) -> Array:
        """Coordinates (k, 3) of surveyed points as the surveyor states them: longitude, latitude, height."""
        truth = self.layout.truth[survey.points]
        values, vectors = np.linalg.eigh(survey.covariance)
        enu = self.surveyed[survey.points] @ (vectors * np.sqrt(np.clip(values, 0.0, None))).T
        if not enu.any():
            return truth
        moved = geodetic_to_geocentric(truth, self.layout.ellipsoid) + np.einsum("nij,ni->nj", local_axes(truth), enu)
        return geocentric_to_geodetic(moved, self.layout.ellipsoid)


def realise(layout: Layout, seed: int) -> SimulatedScene:
    """Draw the errors of a layout; the same layout and seed give the same scene, bit by bit."""
    rng = np.random.default_rng(seed)
    images = layout.image_set
    theta = drawn_parameters(images, rng)
    ground = images.ground(geodetic_to_geocentric(layout.truth, layout.ellipsoid))
    exact = images.project(theta, ground, layout.image, layout.point).image
    noise = layout.sigma_px * rng.standard_normal(exact.shape)
    return SimulatedScene(layout, seed, theta, exact + noise, rng.standard_normal(layout.truth.shape))


def drawn_parameters(images: ImageSet, rng: np.random.Generator) -> Array:
    """True corrections (m, p) of images, drawn from their a priori model."""
    return np.asarray(images.prior @ rng.standard_normal(images.prior.shape[1])).reshape(len(images), images.parameters)


def visible(images: ImageSet, size: Array, truth: Array) -> NDArray[np.bool_]:
    """Which of m unadjusted images of these sizes (m, 2) (samples, lines) see which of n points (n, 3): (m, n)."""
    m, n = len(images), len(truth)
    image, point = (index.ravel().astype(np.int32) for index in np.indices((m, n)))
    place = images.project(
        np.zeros((m, images.parameters)), images.ground(geodetic_to_geocentric(truth, images.ellipsoid)), image, point
    ).image  # fmt: skip
    with np.errstate(invalid="ignore"):
        return np.asarray(((place >= -0.5) & (place < size[image] - 0.5)).all(axis=1)).reshape(m, n)


def utc(time: datetime.datetime) -> str:
    """ISO 8601 text of a time in UTC, to the millisecond."""
    return time.replace(tzinfo=None).isoformat(timespec="milliseconds") + "Z"
