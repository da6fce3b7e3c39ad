"""A simulated campaign: scenes over a part of a body, and the rays of each scene without any of the others.

Everything random belongs to a name (`submin.simulation.keyed_random`): a camera's error to its image and its pass, a place to its field of
the point grid, a measurement to its point and image. So each scene is simulated by itself, in any order and by any number of processes, and
neighbouring scenes see the same points. As in `submin.simulation.region` **the RPC is the truth**,

    observed = RPC(x_true) + affine(theta_true) + noise        theta_true = K u,  u ~ N(0, I)

A block is a scene: the images of one or more linear arrays of one place, taken in one pass.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.geodesy import WGS84, geocentric_to_geodetic, geodetic_to_geocentric
from submin.sensors import Ground
from submin.simulation.keyed_random import key_of, keyed_normal, keyed_uniform
from submin.simulation.linear_array import SENSOR, HeightRange, View, rpc_image, scene_camera
from submin.simulation.point_grid import PointGrid
from submin.simulation.scene import SimulatedImage, simulated_image_set

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Numbers = NDArray[np.int64]
Ids = NDArray[np.str_]

FIRST_PASS = datetime.datetime(2012, 1, 11, 3, 30, tzinfo=datetime.UTC)
SURVEY_SIGMA = 0.1
"""Of a check point, metres along each axis."""
RPC_MARGIN = 0.05
"""Part of a scene by which the box of its RPC is wider on each side."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What is seen of one place in one pass: a block of images.

    Attributes
    ----------
    block_id, pass_id : names
    orbit_axes : (3, 3), see `submin.simulation.linear_array.LinearArrayCamera`
    along, across : place of its centre: angle of the orbit, and angle to its left, radians
    width_km, length_km : extent across and along the track
    views : the linear arrays, an image each
    day : of the pass, after the first one
    outline : of what its images show, where that is not all of their format: WKB, longitude and latitude in degrees
    """

    block_id: str
    pass_id: str
    orbit_axes: Array
    along: float
    across: float
    width_km: float
    length_km: float
    views: tuple[View, ...]
    day: float
    outline: bytes = b""

    def directions(self, forward_km: Array, left_km: Array) -> Array:
        """Directions (n, 3) from the middle of the body, so far from the scene's centre along and across the track, on a mean sphere."""
        start, along, pole = self.orbit_axes
        a = (self.along + forward_km / MEAN_RADIUS_KM)[:, None]
        c = (self.across + left_km / MEAN_RADIUS_KM)[:, None]
        return np.asarray(np.cos(c) * (np.cos(a) * start + np.sin(a) * along) + np.sin(c) * pole)

    def geodetic(self, forward_km: Array, left_km: Array, height: float = 0.0) -> Array:
        """Longitude, latitude and height (n, 3) of places so far from the scene's centre along and across the track."""
        geodetic = geocentric_to_geodetic(1e3 * MEAN_RADIUS_KM * self.directions(forward_km, left_km), WGS84)
        geodetic[:, 2] = height
        return geodetic


MEAN_RADIUS_KM = 6371.0


@dataclass(frozen=True, eq=False)
class CampaignDesign:
    """What all scenes of a campaign have in common.

    Attributes
    ----------
    seed : of everything random
    outline : where tie points are, longitude and latitude in degrees
    grid : their places and heights
    matched : part of the points in sight of a scene that its images match
    priors : a priori model of the images, from which the true parameters are drawn; without correlation within a block
    sigma_px : of a measurement, sample and line each, pixels
    noise_scale : real noise over stated sigma: 0 for perfect rays, 1 for honest ones
    orbit_km : height of the orbit over the equator
    platform : name of the satellite

    Raises
    ------
    InputError
        When images of a block are correlated, or a number is out of its range.
    """

    outline: BaseGeometry
    grid: PointGrid
    seed: int = 0
    matched: float = 1.0
    priors: APriori = field(default_factory=lambda: APriori(bias_m=15.0))
    sigma_px: float = 0.5
    noise_scale: float = 1.0
    orbit_km: float = 506.0
    platform: str = "SIM-3LINE"

    def __post_init__(self) -> None:
        if self.priors.correlation != "none":
            raise InputError(f"campaign: correlation is {self.priors.correlation!r}; expected 'none': errors are drawn image by image")
        if not 0.0 < self.matched <= 1.0:
            raise InputError(f"campaign: matched is {self.matched}; expected a part of the points, above 0 to 1")
        for name in ("sigma_px", "orbit_km"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(f"campaign: {name} is {getattr(self, name)}; expected a positive number")
        if not self.noise_scale >= 0.0:
            raise InputError(f"campaign: noise_scale is {self.noise_scale}; expected 0 or more")

    @property
    def orbit_radius(self) -> float:
        """Metres."""
        return WGS84.semimajor_axis + 1e3 * self.orbit_km


@dataclass(frozen=True, eq=False)
class Campaign:
    """Scenes in the order of their catalogue, neighbours together.

    Attributes
    ----------
    name : for people
    check_points : number of points that are surveyed
    area : gives the sub-area (n,) of places (n, 3)
    """

    name: str
    design: CampaignDesign
    scenes: tuple[Scene, ...]
    check_points: int
    area: Callable[[Array], Ids]


@dataclass(frozen=True, eq=False)
class SceneRays:
    """A scene with what a network may know, and the truth that it must not.

    Attributes
    ----------
    images : its m images
    number : (r,) field of the point grid of each ray; image : (r,) row of its image; rays are sorted by image, then point
    observed : (r, 2) sample and line, pixels
    theta : (m, 6) true parameters of the images, pixels
    """

    images: tuple[SimulatedImage, ...]
    number: Numbers
    image: Index
    observed: Array
    theta: Array

    @cached_property
    def points(self) -> Numbers:
        """Fields of the points that the scene measures, ascending."""
        return np.unique(self.number)


def simulate_scene(design: CampaignDesign, scene: Scene) -> SceneRays:
    """The images of a scene and their rays.

    A point is measured in the images that see it, where at least two of the scene do (one, in a scene of one image).
    """
    low, high = _box(scene)
    images = tuple(_images(design, scene, (low, high)))
    members = simulated_image_set(images, {scene.block_id: design.priors})
    theta = true_parameters(design.seed, images, members)
    number = np.sort(design.grid.numbers_in(low[0], low[1], high[0], high[1]))
    number = number[keyed_uniform(design.seed, "match", number, key_of(scene.block_id)) < design.matched]
    geodetic = design.grid.geodetic(number)
    inside = shapely.contains_xy(design.outline, geodetic[:, 0], geodetic[:, 1])
    if scene.outline:
        inside &= shapely.contains_xy(shapely.from_wkb(scene.outline), geodetic[:, 0], geodetic[:, 1])
    number, geodetic = number[inside], geodetic[inside]
    m, n = len(images), len(number)
    image, point = (index.ravel().astype(np.int32) for index in np.indices((m, n)))
    exact = SENSOR.project(members.cameras, theta, Ground.at(geodetic_to_geocentric(geodetic)), image, point).image
    size = np.array([[i.width, i.height] for i in images], dtype=np.float64)[image]
    seen = ((exact >= -0.5) & (exact < size - 0.5)).all(axis=1)
    seen &= (np.bincount(point[seen], minlength=n) >= min(2, m))[point]
    image, point, exact = image[seen], point[seen], exact[seen]
    names = np.array([key_of(i.image_id) for i in images], dtype=np.uint64)
    noise = keyed_normal(design.seed, "measurement", number[point], names[image])
    return SceneRays(images, number[point], image, exact + design.noise_scale * design.sigma_px * noise, theta)


def true_parameters(seed: int, images: tuple[SimulatedImage, ...], members: ImageSet) -> Array:
    """True parameters (m, 6) of images, pixels: each one's own part, and the part of its pass, drawn from the a priori model."""
    theta = np.zeros((len(images), len(SENSOR.parameters)))
    pairs = np.arange((len(SENSOR.parameters) + 1) // 2)
    for k, (image, prior) in enumerate(zip(images, members.priors, strict=True)):
        if prior.a_priori is None:
            continue
        stated = [prior.a_priori.of(parameter) for parameter in SENSOR.parameters]
        sigma, common = np.array([s.sigma for s in stated]), np.array([s.common_to_pass for s in stated])
        own, shared = (
            keyed_normal(seed, stream, key_of(name), pairs).ravel()[: len(sigma)]
            for stream, name in (("image", image.image_id), ("pass", image.pass_id))
        )
        theta[k] = sigma * (np.sqrt(1.0 - common) * own + np.sqrt(common) * shared)
    return theta


def _box(scene: Scene) -> tuple[Array, Array]:
    """Least and largest longitude and latitude of a scene with some margin, degrees; longitudes may run on beyond 180."""
    half = np.array([0.5 * scene.length_km, 0.5 * scene.width_km]) * [[-1, -1], [-1, 0], [-1, 1], [0, 1], [1, 1], [1, 0], [1, -1], [0, -1]]
    outline = scene.geodetic(half[:, 0], half[:, 1])[:, :2]
    outline[:, 0] = outline[0, 0] + (outline[:, 0] - outline[0, 0] + 180.0) % 360.0 - 180.0
    low, high = outline.min(axis=0), outline.max(axis=0)
    margin = RPC_MARGIN * (high - low)
    return low - margin, high + margin


def _images(design: CampaignDesign, scene: Scene, box: tuple[Array, Array]) -> list[SimulatedImage]:
    relief, here = design.grid.relief_m, np.zeros(1)
    heights = HeightRange(-0.1 * relief, 0.5 * relief, 1.1 * relief)
    centre = geodetic_to_geocentric(scene.geodetic(here, here, heights.mean))
    images = []
    for view in scene.views:
        camera, lines = scene_camera(
            scene.orbit_axes, design.orbit_radius, view, centre, (1e3 * scene.width_km, 1e3 * scene.length_km)
        )  # fmt: skip
        time = FIRST_PASS + datetime.timedelta(days=scene.day, milliseconds=round(1e3 * camera.seconds(0.5 * (lines - 1))))
        images.append(
            rpc_image(
                camera, lines, box, heights, image_id=f"{scene.block_id}-{view.name}", block_id=scene.block_id, pass_id=scene.pass_id,
                platform=design.platform, acquired=time,
            )
        )  # fmt: skip
    return [replace(image, footprint=scene.outline) for image in images] if scene.outline else images
