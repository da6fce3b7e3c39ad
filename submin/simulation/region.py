"""A simulated region: three-line triplets in overlapping strips over an area, tie points, and rays with known truth.

The satellite flies a circle in the body-fixed frame (the rotation of the body is taken up by the azimuth of the track) and carries three
linear arrays that look forward, down and backward, as ZY-3 does. Each image gets an RPC fitted to this camera, and
**the RPC is the truth**: a ray is

    observed = RPC(x_true) + affine(theta_true) + noise        theta_true = K u,  u ~ N(0, I)

with ``K`` the a priori factor of `submin.adjustment.priors`, so a network that is told the same a priori model must come out consistent.
A block is a triplet, a pass is a strip, and images are ordered by block, so rays sorted by image are sorted by block.

Places in the region are given along and across the track, in kilometres from its centre: along grows in the direction of flight, across to
its left.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.geodesy import WGS84, Ellipsoid, geocentric_to_geodetic, geodetic_to_geocentric, local_axes
from submin.sensors import Ground
from submin.simulation.linear_array import SENSOR, ZY3_VIEWS, HeightRange, View, rpc_image, scene_camera
from submin.simulation.scene import SimulatedImage, drawn_parameters, simulated_image_set

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Ids = NDArray[np.str_]

BIAS = [c for c, parameter in enumerate(SENSOR.parameters) if parameter.group == "bias"]
FIRST_PASS = datetime.datetime(2012, 2, 1, 3, 30, tzinfo=datetime.UTC)
DAYS_BETWEEN_PASSES = 5
BLUNDER_PX = (5.0, 50.0)
OVERLAP_IN_STRIP = 0.1
"""Least overlap of neighbouring scenes of a strip, as a part of a scene."""


@dataclass(frozen=True)
class RegionDesign:
    """What to simulate: a rectangle of strips of triplets, its tie points and its errors.

    Parameters
    ----------
    longitude, latitude : float
        Centre of the region, degrees.
    width_km, height_km : float
        Extent across and along the track; scenes lie wholly within.
    coverage : float
        Wanted mean number of triplets over a place; the whole number of strips nearest to it is laid.
    strips : int, optional
        Number of strips (passes), instead of ``coverage``.
    scene_km : float
        Side of a scene.
    azimuth : float
        Direction of flight at the centre, degrees from north to east: a descending sun-synchronous pass by default.
    orbit_km : float
        Height of the orbit above the ground.
    views : tuple of View
        The linear arrays; all view the scene.
    point_spacing_km : float
        Mean distance between tie points.
    relief_m : float
        Heights lie between 0 and this.
    sigma_px : float
        Sigma of a measurement as the catalogue states it, sample and line each, pixels.
    noise_scale : float
        Real noise over stated sigma: 0 for perfect rays, 1 for honest ones.
    priors : APriori
        A priori model of the images, from which the true parameters are drawn.
    blunder_rate : float
        Part of the rays that are shifted by 5 to 50 pixels.
    bad_cameras : int
        Number of images whose true shift is off by ``bad_camera_sigmas`` times the sigma of the shift, in a random direction.
    bad_camera_sigmas : float
        See ``bad_cameras``.
    seed : int
        The same design and seed give the same region, bit by bit.

    Raises
    ------
    InputError
        When a value cannot be laid out.
    """

    longitude: float = 100.0
    latitude: float = 35.0
    width_km: float = 400.0
    height_km: float = 400.0
    coverage: float = 2.3
    strips: int | None = None
    scene_km: float = 50.0
    azimuth: float = 190.0
    orbit_km: float = 506.0
    views: tuple[View, ...] = ZY3_VIEWS
    point_spacing_km: float = 7.0
    relief_m: float = 2000.0
    sigma_px: float = 0.5
    noise_scale: float = 1.0
    priors: APriori = field(default_factory=APriori)
    blunder_rate: float = 0.002
    bad_cameras: int = 1
    bad_camera_sigmas: float = 12.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in (
            "width_km", "height_km", "coverage", "scene_km", "orbit_km", "point_spacing_km", "relief_m", "sigma_px",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"region: {name} is {value}; expected a positive number")
        for name in ("width_km", "height_km"):
            if getattr(self, name) < self.scene_km:
                raise InputError(f"region: {name} is {getattr(self, name)}; expected at least one scene ({self.scene_km} km)")
            if getattr(self, name) > 3000.0:
                raise InputError(f"region: {name} is {getattr(self, name)}; expected at most 3000 km, beyond which strips converge")
        if not abs(self.latitude) <= 75.0:
            raise InputError(f"region: latitude is {self.latitude}; expected -75 to 75 degrees (no strips over a pole)")
        if self.strips is not None and self.strips * self.scene_km < self.width_km:
            raise InputError(f"region: {self.strips} strips of {self.scene_km} km leave gaps in {self.width_km} km; expected more strips")
        if not 0.0 <= self.blunder_rate < 1.0:
            raise InputError(f"region: blunder_rate is {self.blunder_rate}; expected a part of the rays, 0 to below 1")
        if not self.noise_scale >= 0.0:
            raise InputError(f"region: noise_scale is {self.noise_scale}; expected 0 or more")
        images = len(self.views) * len(self.scene_across_km) * len(self.scene_along_km)
        if not 0 <= self.bad_cameras <= images:
            raise InputError(f"region: bad_cameras is {self.bad_cameras}; expected 0 to {images}, the number of images")

    @property
    def scene_along_km(self) -> Array:
        """Centres of the scenes of every strip along the track, in order of flight."""
        scenes = np.ceil((self.height_km / self.scene_km - OVERLAP_IN_STRIP) / (1.0 - OVERLAP_IN_STRIP) - 1e-9)
        return _centres(self.height_km, self.scene_km, max(1, int(scenes)))

    @property
    def scene_across_km(self) -> Array:
        """Centres of the strips across the track."""
        if self.strips is not None:
            return _centres(self.width_km, self.scene_km, self.strips)
        wanted = self.coverage * self.width_km * self.height_km / self.scene_km**2 / len(self.scene_along_km)
        return _centres(self.width_km, self.scene_km, max(round(wanted), int(np.ceil(self.width_km / self.scene_km - 1e-9))))


@dataclass(frozen=True, eq=False)
class SimulatedRegion:
    """A region with everything that a network may know, and the truth that it must not.

    Attributes
    ----------
    design : RegionDesign
    images : tuple of SimulatedImage
        Ordered by block; m images.
    point_ids : (n,)
        Ids of the n points that at least one image sees, ascending.
    truth : (n, 3)
        True longitude, latitude (degrees) and ellipsoidal height (metres).
    image, point : (r,)
        Places of each ray's image and point in ``images`` and ``point_ids``; rays are sorted by image, then point.
    sample, line, sigma_sample, sigma_line : (r,)
        Measurements and their stated sigmas, pixels.
    theta : (m, 6)
        True parameters of each image, own part and pass part together, pixels.
    blunder : (r,)
        True where the measurement is a blunder.
    bad_cameras : tuple of str
        Ids of the images whose true shift does not follow the a priori model.
    """

    design: RegionDesign
    images: tuple[SimulatedImage, ...]
    point_ids: Ids
    truth: Array
    image: Index
    point: Index
    sample: Array
    line: Array
    sigma_sample: Array
    sigma_line: Array
    theta: Array
    blunder: NDArray[np.bool_]
    bad_cameras: tuple[str, ...]

    @cached_property
    def image_set(self) -> ImageSet:
        """The images with their cameras and a priori models."""
        return _image_set(self.design, self.images)

    def packed_cameras(self) -> Array:
        """Cameras (m, c) as the sensor packs them."""
        return self.image_set.cameras


@dataclass(frozen=True)
class RegionFrame:
    """Sphere through the centre of a region, with the axes of the track: places along and across the track to directions and back.

    Attributes
    ----------
    radius : float
        Distance of the region's centre from the centre of the body, metres.
    axes : (3, 3)
        Rows: unit vectors up, along the track and to the left of it at the centre, geocentric.
    """

    radius: float
    axes: Array
    ellipsoid: Ellipsoid

    @classmethod
    def of(cls, design: RegionDesign, ellipsoid: Ellipsoid = WGS84) -> RegionFrame:
        """The frame of a design."""
        return cls.at(design.longitude, design.latitude, design.azimuth, ellipsoid)

    @classmethod
    def at(cls, longitude: float, latitude: float, azimuth: float, ellipsoid: Ellipsoid = WGS84) -> RegionFrame:
        """The frame about a centre, with the track's azimuth there; all in degrees."""
        centre = np.array([[longitude, latitude, 0.0]])
        position = geodetic_to_geocentric(centre, ellipsoid)[0]
        radius = float(np.linalg.norm(position))
        up = position / radius
        east, north, _ = local_axes(centre)[0]
        angle = np.radians(azimuth)
        along = np.sin(angle) * east + np.cos(angle) * north
        along -= up * (up @ along)
        along /= np.linalg.norm(along)
        return cls(radius, np.stack([up, along, np.cross(up, along)]), ellipsoid)

    def orbit_axes(self, across_km: float) -> Array:
        """Rows: where a strip's track crosses the line across through the centre, its direction there, and its left (pole of the orbit)."""
        up, along, left = self.axes
        angle = 1e3 * across_km / self.radius
        crossing = np.cos(angle) * up + np.sin(angle) * left
        return np.stack([crossing, along, np.cross(crossing, along)])

    def geodetic(self, along_km: Array, across_km: Array, height: Array) -> Array:
        """Geodetic coordinates (n, 3) of places in the region at ellipsoidal heights in metres."""
        up, along, left = self.axes
        a, c = 1e3 * along_km[:, None] / self.radius, 1e3 * across_km[:, None] / self.radius
        direction = np.cos(a) * (np.cos(c) * up + np.sin(c) * left) + np.sin(a) * along
        geodetic = geocentric_to_geodetic(self.radius * direction, self.ellipsoid)
        geodetic[:, 2] = height
        return geodetic


def simulate_region(design: RegionDesign) -> SimulatedRegion:
    """Simulate a region: images, points, true parameters, and a ray for every point in every image whose format holds it.

    Every random number comes from one generator of ``design.seed``, in a fixed order.
    """
    rng = np.random.default_rng(design.seed)
    images, scene = region_images(design)
    names, along, across, truth = _tie_points(design, rng)
    image_set = _image_set(design, images)
    theta, bad = _true_parameters(design, image_set, rng)

    ray_image, ray_point = _candidates(design, scene, along, across, theta)
    ground = Ground.at(geodetic_to_geocentric(truth))
    exact = SENSOR.project(image_set.cameras, theta, ground, ray_image, ray_point).image
    size = np.array([[i.width, i.height] for i in images], dtype=np.float64)[ray_image]
    inside = _inside(exact, size)
    ray_image, ray_point, exact, size = ray_image[inside], ray_point[inside], exact[inside], size[inside]
    measured, blunder = _measure(design, exact, size, rng)

    seen, point = np.unique(ray_point, return_inverse=True)
    sigma = np.full(len(ray_image), design.sigma_px)
    return SimulatedRegion(
        design=design,
        images=images,
        point_ids=names[seen],
        truth=truth[seen],
        image=ray_image,
        point=point.astype(np.int32),
        sample=np.ascontiguousarray(measured[:, 0]),
        line=np.ascontiguousarray(measured[:, 1]),
        sigma_sample=sigma,
        sigma_line=sigma.copy(),
        theta=theta,
        blunder=blunder,
        bad_cameras=tuple(images[i].image_id for i in bad),
    )


def region_images(design: RegionDesign) -> tuple[tuple[SimulatedImage, ...], Array]:
    """Images of a design, ordered by block, and the centres (m, 2) of their scenes along and across the track, kilometres.

    Nothing here is random: all seeds share their images.
    """
    frame = RegionFrame.of(design)
    scenes = [_Scene(s, k, float(x), float(y)) for s, y in enumerate(design.scene_across_km) for k, x in enumerate(design.scene_along_km)]
    images = tuple(image for scene in scenes for image in _triplet(design, frame, scene))
    centres = np.array([(scene.along_km, scene.across_km) for scene in scenes])
    return images, np.repeat(centres, len(design.views), axis=0)


def terrain_height(along_km: Array, across_km: Array, relief_m: float) -> Array:
    """Heights (n,) in metres, from 0 to ``relief_m``: three smooth waves of 60 to 170 km, the same for every design."""
    waves = (
        0.5 * np.sin(2.0 * np.pi * (along_km / 170.0 + 0.1))
        + 0.3 * np.sin(2.0 * np.pi * (across_km / 110.0 - along_km / 300.0))
        + 0.2 * np.cos(2.0 * np.pi * (along_km + across_km) / 60.0)
    )
    return np.asarray(0.5 * relief_m * (1.0 + waves))


class _Scene(NamedTuple):
    strip: int
    number: int
    along_km: float
    across_km: float


def _triplet(design: RegionDesign, frame: RegionFrame, scene: _Scene) -> list[SimulatedImage]:
    """Images of one scene, one a view."""
    half = 0.5 * design.scene_km
    along, across = scene.along_km + half * np.array([-1, -1, 1, 1]), scene.across_km + half * np.array([-1, 1, 1, -1])
    outline = frame.geodetic(along, across, np.zeros(4))
    # On the antimeridian the longitudes of a scene run on beyond 180.
    outline[:, 0] = design.longitude + (outline[:, 0] - design.longitude + 180.0) % 360.0 - 180.0
    low, high = outline[:, :2].min(axis=0), outline[:, :2].max(axis=0)
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)
    block = f"T{scene.strip:03d}-{scene.number:03d}"

    axes, orbit_radius = frame.orbit_axes(scene.across_km), frame.radius + 1e3 * design.orbit_km
    middle = geodetic_to_geocentric(
        frame.geodetic(np.array([scene.along_km]), np.array([scene.across_km]), np.array([0.5 * design.relief_m])), frame.ellipsoid
    )
    heights = HeightRange(-0.1 * design.relief_m, 0.5 * design.relief_m, 1.1 * design.relief_m)
    images = []
    for view in design.views:
        camera, lines = scene_camera(axes, orbit_radius, view, middle, (1e3 * design.scene_km, 1e3 * design.scene_km), frame.ellipsoid)
        seconds = camera.seconds(0.5 * (lines - 1))
        acquired = FIRST_PASS + datetime.timedelta(days=DAYS_BETWEEN_PASSES * scene.strip, milliseconds=round(1e3 * seconds))
        images.append(
            rpc_image(
                camera, lines, (low, high), heights, image_id=f"{block}-{view.name}", block_id=block, pass_id=f"pass-{scene.strip:03d}",
                platform="SIM-3LINE", acquired=acquired,
            )
        )  # fmt: skip
    return images


def _tie_points(design: RegionDesign, rng: np.random.Generator) -> tuple[Ids, Array, Array, Array]:
    """Ids, places along and across (km), and true geodetic coordinates (n, 3) of a jittered grid that fills the region."""
    rows = max(1, round(design.height_km / design.point_spacing_km))
    columns = max(1, round(design.width_km / design.point_spacing_km))
    row, column = (index.ravel() for index in np.indices((rows, columns)))
    jitter = rng.uniform(0.1, 0.9, (2, rows * columns))
    along = design.height_km * ((row + jitter[0]) / rows - 0.5)
    across = design.width_km * ((column + jitter[1]) / columns - 0.5)
    truth = RegionFrame.of(design).geodetic(along, across, terrain_height(along, across, design.relief_m))
    return np.char.mod("P%06d", np.arange(len(row))), along, across, truth


def _image_set(design: RegionDesign, images: Sequence[SimulatedImage]) -> ImageSet:
    return simulated_image_set(images, {image.block_id: design.priors for image in images})


def _true_parameters(design: RegionDesign, images: ImageSet, rng: np.random.Generator) -> tuple[Array, Index]:
    """True parameters (m, 6) drawn from the a priori model, and the places of the bad cameras."""
    theta = drawn_parameters(images, rng)
    bad = np.sort(rng.choice(len(images), design.bad_cameras, replace=False)).astype(np.int32)
    direction = rng.uniform(0.0, 2.0 * np.pi, design.bad_cameras)
    shift = design.bad_camera_sigmas * design.priors.bias_px * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    theta[bad[:, None], BIAS] += shift
    return theta, bad


def _candidates(design: RegionDesign, scene: Array, along: Array, across: Array, theta: Array) -> tuple[Index, Index]:
    """Image and point of every ray that may fall into a format, sorted by image, then point: a generous cut on the ground."""
    coarsest = max(view.pixel for view in design.views)
    # Relief moves a point by half its height at most, and the true parameters shift the format.
    margin = 2.0 + 1e-3 * (design.relief_m + coarsest * float(np.abs(theta).sum(axis=1).max()))
    reach = 0.5 * design.scene_km + margin
    points = [np.flatnonzero((np.abs(a - along) < reach) & (np.abs(c - across) < reach)).astype(np.int32) for a, c in scene.tolist()]
    return np.repeat(np.arange(len(scene), dtype=np.int32), [len(of_image) for of_image in points]), np.concatenate(points)


def _measure(design: RegionDesign, exact: Array, size: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
    """Measurements (r, 2) with noise and blunders, and which are blunders (r,)."""
    rays = len(exact)
    measured = exact + design.noise_scale * design.sigma_px * rng.standard_normal((rays, 2))
    blunder = rng.random(rays) < design.blunder_rate
    length, direction = rng.uniform(*BLUNDER_PX, rays), rng.uniform(0.0, 2.0 * np.pi, rays)
    shift = length[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    # A wrong match is still a place in the image: shifts that would leave it go the other way.
    shift = np.where((measured + shift < -0.5) | (measured + shift >= size - 0.5), -shift, shift)
    return np.where(blunder[:, None], measured + shift, measured), blunder


def _inside(image: Array, size: Array) -> NDArray[np.bool_]:
    """Whether sample and line (r, 2) fall on the format, whose first pixel reaches from -0.5 to 0.5."""
    return np.asarray(((image >= -0.5) & (image < size - 0.5)).all(axis=1))


def _centres(extent: float, scene: float, count: int) -> Array:
    """Centres of ``count`` scenes that fill an extent from edge to edge."""
    half = 0.5 * (extent - scene) if count > 1 else 0.0
    return np.linspace(-half, half, count)
