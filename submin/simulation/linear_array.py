"""Linear arrays on a circular orbit, such as the three lines of ZY-3, and images of them with an RPC fitted to the camera.

The satellite flies a circle in the body-fixed frame (the rotation of the body is taken up by the azimuth of the track) and its arrays look
forward, down or backward.
"""

from __future__ import annotations

import datetime
import json
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from submin.geodesy import WGS84, Ellipsoid, geodetic_to_geocentric
from submin.sensors import sensor_named
from submin.sensors.footprint import footprints
from submin.simulation.rpc_fit import fit_rpc
from submin.simulation.scene import SimulatedImage, utc

Array = NDArray[np.float64]

SENSOR = sensor_named("rpc")
GRAVITY_PARAMETER = 3.986004418e14
"""GM of the Earth, m3/s2 (NIMA TR8350.2): it only sets the times between images."""


class View(NamedTuple):
    """One linear array of a three-line camera: name, pitch (degrees, forward positive), size of a pixel on the ground (metres)."""

    name: str
    pitch: float
    pixel: float


ZY3_VIEWS = (View("FWD", 22.0, 3.5), View("NAD", 0.0, 2.1), View("BWD", -22.0, 3.5))


@dataclass(frozen=True)
class LinearArrayCamera:
    """A linear array across the track, pitched by a fixed angle, on a circular orbit in the body-fixed frame.

    Attributes
    ----------
    orbit_axes : (3, 3)
        Rows: unit vectors to the place where the orbit angle is 0, along the track there, and the pole of the orbit.
    orbit_radius : float
        Metres.
    pitch : float
        Radians, forward positive.
    pixel_angle : float
        Tangent of the angle between two pixels at the centre of the array.
    line_angle : float
        Angle that the satellite flies from line to line, radians.
    first_angle : float
        Angle of the orbit at the centre of the first line, radians.
    width : int
        Pixels of a line.
    """

    orbit_axes: Array
    orbit_radius: float
    pitch: float
    pixel_angle: float
    line_angle: float
    first_angle: float
    width: int
    ellipsoid: Ellipsoid = WGS84

    def orbit_angle(self, geocentric: Array) -> Array:
        """Angles of the orbit (n,), radians, at which the array's plane sweeps over points (n, 3).

        The plane holds a point where ``(X - S) . n = 0``; with X at the angle ``phi`` and the distance ``rho`` in the plane of the orbit
        this is ``rho sin(pitch - tau + phi) = R sin(pitch)``, solved in closed form.
        """
        start, along, _ = self.orbit_axes
        x, y = geocentric @ start, geocentric @ along
        return np.asarray(self.pitch + np.arctan2(y, x) - np.arcsin(self.orbit_radius * np.sin(self.pitch) / np.hypot(x, y)))

    def project(self, geodetic: Array) -> Array:
        """Sample and line (n, 2), pixels, of geodetic coordinates (n, 3); samples grow to the right of the flight."""
        geocentric = geodetic_to_geocentric(geodetic, self.ellipsoid)
        start, along, pole = self.orbit_axes
        angle = self.orbit_angle(geocentric)
        # From the satellite a point lies in the array's plane, so its distance along the optical axis is all that is left to find.
        down = self.orbit_radius - np.hypot(geocentric @ start, geocentric @ along) * np.cos(
            angle - np.arctan2(geocentric @ along, geocentric @ start)
        )
        sample = 0.5 * (self.width - 1) - (geocentric @ pole) / (down / np.cos(self.pitch)) / self.pixel_angle
        return np.stack([sample, (angle - self.first_angle) / self.line_angle], axis=1)

    def seconds(self, line: float) -> float:
        """Seconds from where the orbit angle is 0 to the time of a line."""
        return float((self.first_angle + line * self.line_angle) * np.sqrt(self.orbit_radius**3 / GRAVITY_PARAMETER))


class HeightRange(NamedTuple):
    """Heights of the ground under an image, metres: least and largest that its RPC is fitted to, and the one of its footprint between."""

    low: float
    mean: float
    high: float


def scene_camera(
    orbit_axes: Array, orbit_radius: float, view: View, centre: Array, scene: tuple[float, float], ellipsoid: Ellipsoid = WGS84
) -> tuple[LinearArrayCamera, int]:
    """Camera whose image of a scene has its centre on a ground point, and its number of lines.

    Parameters
    ----------
    orbit_axes, orbit_radius : see `LinearArrayCamera`
    centre : (1, 3), geocentric, metres; it should lie near the plane of the orbit
    scene : width and length of the scene, across and along the track, metres
    """
    pitch = float(np.radians(view.pitch))
    # A first camera without the scale, only to aim and to measure the distance along the optical axis.
    aiming = LinearArrayCamera(orbit_axes, orbit_radius, pitch, 1.0, 1.0, 0.0, 1, ellipsoid)
    angle = float(aiming.orbit_angle(centre)[0])
    satellite = orbit_radius * (np.cos(angle) * orbit_axes[0] + np.sin(angle) * orbit_axes[1])
    distance = float(np.linalg.norm(centre[0] - satellite))
    pixels, lines = (round(side / view.pixel) for side in scene)
    line_angle = view.pixel / float(np.linalg.norm(centre))
    first = angle - 0.5 * (lines - 1) * line_angle
    return LinearArrayCamera(orbit_axes, orbit_radius, pitch, view.pixel / distance, line_angle, first, pixels, ellipsoid), lines


def rpc_image(
    camera: LinearArrayCamera, lines: int, box: tuple[Array, Array], heights: HeightRange, *,
    image_id: str, block_id: str, pass_id: str, platform: str, acquired: datetime.datetime,
) -> SimulatedImage:  # fmt: skip
    """An image of so many lines, with the RPC that follows its camera over a box of the ground.

    ``box`` has the least and the largest longitude and latitude, degrees; across the antimeridian longitudes run on beyond 180.
    """
    low, high = box
    rpc, _ = fit_rpc(
        camera.project, (float(low[0]), float(high[0])), (float(low[1]), float(high[1])), (heights.low, heights.high)
    )  # fmt: skip
    size, height = np.array([[camera.width, lines]], dtype=np.float64), np.array([heights.mean])
    packed = SENSOR.pack(rpc, camera.width, lines)[None]
    (footprint,) = footprints(SENSOR, packed, np.zeros((1, 2)), size, height, camera.ellipsoid)
    return SimulatedImage(
        image_id, block_id, pass_id, platform, SENSOR.name, json.dumps(rpc), camera.width, lines, utc(acquired), footprint
    )  # fmt: skip
