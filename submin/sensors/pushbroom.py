"""A linear array that sweeps over the ground (pushbroom), described by its orbit, attitude, detector line and line times.

At time t the camera is at ``P(t)`` with velocity ``V(t)``; the rotation ``R(t)`` takes camera axes to body-fixed geocentric axes. Camera
axes: x along the scan, y along the detector line, z along the line of sight, to the ground. A ground point X is seen along ``w = X - P``;
two effects bend that, each where the description asks for it:

* refraction: the point is seen where it would be without air if it lay higher by ``zenith_path exp(-h / scale_height) / cos^2 z``, with z
  the zenith distance of the camera at the point. For flat layers this is exact to first order in the refractivity; that layers are
  round changes it by a part ``tan^2 z scale_height / radius``;
* aberration: ``d = w + |w| (V - rotation x w) / c``. In body-fixed axes ``V`` is the velocity against the rotating body; the second term
  is how far the body turns while the light travels. First order in ``V / c``; the second is 1e-9 rad.

In camera axes ``b = R' d``, corrected to ``b - theta x b`` with

    theta = (roll, pitch, yaw) + (rates) (t - t_mid)        t_mid: time of the middle line

that is, small rotations of the camera about its own axes: roll about x (along track), pitch about y (across track), yaw about z (line of
sight). In an adjustment t in ``theta`` is the time of the *fitted* line, the measured one less its residual (docs/decisions/018). In the
focal plane the point is at ``F = f (b_x, b_y) / b_z``. The line is where F falls onto the detector line, ``F(t) = origin + sample step``:
one equation for t, solved by Newton, and one for the sample. Partials follow by implicit differentiation.

Between samples, positions are cubic Hermite polynomials of the given positions and velocities, and quaternions cubic Hermite
polynomials, normalised, with rates from a polynomial through the five nearest samples: both are smooth to the first derivative and of
fourth order. Line times are linear between the entries of the table and beyond its ends.

Nothing is extrapolated: a point that would be seen outside the sampled times, or further outside the image than ``MARGIN`` of its size
(at least ``MARGIN_PIXELS``), or from lower than ``LOWEST_SIGHT`` above the horizon, is not seen, and NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from submin.geodesy import Ellipsoid, geocentric_to_geodetic, local_axes
from submin.sensors.base import Array, Drift, Ground, Index, Parameter, Projection
from submin.sensors.pushbroom_camera import (
    LINE_ROW,
    LINES,
    MEAN_HEIGHT,
    PER_LIGHT,
    ROTATION,
    SCALE_HEIGHT,
    TABLES,
    ZENITH_PATH,
    packed_camera,
)
from submin.sensors.pushbroom_sight import LOWEST_SIGHT, looks, project

LOCALISED_METRES = 1e-7
"""Of height: what is left of the place itself after such a step is far less."""
_STEPS = 6
"""The first is off by the metres of refraction; each leaves a part of 1e-5."""


class PushbroomSensor:
    """The linear array with corrections of attitude and of attitude rate (see the module for the model).

    The camera is a mapping with

    * ``position``: ``times`` (n seconds), ``values`` (n x 3, metres, body-fixed geocentric), ``velocities`` (n x 3, m/s, in the same
      rotating axes)
    * ``attitude``: ``times`` (k seconds), ``values`` (k x 4): quaternions x, y, z, w that take camera axes to body-fixed axes
    * ``lines``: ``times`` and ``values``, two or more each: lines and the times of their middles, linear between; both monotonic, and
      times that fall with the line make a reverse scan
    * ``focal_length`` (mm), ``detector``: ``origin`` (x, y in mm in the focal plane: centre of sample 0) and ``step`` (x, y in mm from one
      sample to the next)
    * ``mean_height`` (metres): near which the ground is expected
    * optional ``aberration``: ``rotation_rate`` (rad/s) of the body about its third axis
    * optional ``refraction``: ``zenith_path`` (metres: integral of the refractivity from height 0 upwards) and ``scale_height`` (metres)

    All times are seconds from one epoch, near the scan. Samples need no even spacing; they must cover all lines of the image, and should
    cover the margin around it (`MARGIN`): no point is seen outside of them.
    """

    name = "pushbroom"
    unit = "pixel"
    parameters: tuple[Parameter, ...] = (
        Parameter("attitude roll", "rad", "attitude", 5e-6),
        Parameter("attitude pitch", "rad", "attitude", 5e-6),
        Parameter("attitude yaw", "rad", "attitude", 5e-6),
        Parameter("rate roll", "rad/s", "rate", 5e-7, drift=Drift(0, 1)),
        Parameter("rate pitch", "rad/s", "rate", 5e-7, drift=Drift(1, 1)),
        Parameter("rate yaw", "rad/s", "rate", 5e-7, drift=Drift(2, 1)),
    )

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        """Packed camera of a description: 18 numbers, then the tables of line times, positions and attitudes.

        Raises
        ------
        InputError
            When an entry is missing, not finite, of the wrong shape, out of order, or does not cover the lines of the image.
        """
        return packed_camera(camera, width, height)

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """See `Sensor.project`."""
        where = np.empty((0, 2)) if at is None else at
        return Projection(*project(cameras, parameters, ground.geocentric, ground.geodetic, ground.jacobian, image, point, where))

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """See `Sensor.localise`."""
        position, speed, light = looks(cameras, image, samples, lines)
        geodetic = np.full((len(image), 3), np.nan)
        sighted = np.isfinite(light).all(axis=1)
        headers, h = cameras[image[sighted], :TABLES], heights[sighted]
        geodetic[sighted] = _cut(headers, position[sighted], speed[sighted], light[sighted], h, ellipsoid)
        geodetic[:, 2] = heights
        return geodetic

    def drift_by_pixel(self, cameras: Array) -> Array:
        """See `DriftingSensor.drift_by_pixel`: a rate acts on time, which passes with the lines; here at the mean of their rates."""
        row, first = np.arange(len(cameras)), np.full(len(cameras), TABLES)
        last = TABLES + LINE_ROW * (cameras[:, LINES].astype(np.int64) - 1)
        seconds, lines = (cameras[row, last + k] - cameras[row, first + k] for k in range(2))
        return np.column_stack([np.zeros(len(cameras)), seconds / lines])

    def mean_height(self, cameras: Array) -> Array:
        """The height that each description gives."""
        return cameras[:, MEAN_HEIGHT]


def _cut(cameras: Array, position: Array, speed: Array, light: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
    """Where light that arrives from these unit directions (r, 3) left the ground of these ellipsoidal heights: geodetic (r, 3)."""
    excess = cameras[:, ZENITH_PATH] * np.exp(-heights / cameras[:, SCALE_HEIGHT])
    per_light, turn = cameras[:, PER_LIGHT, None], cameras[:, ROTATION, None] * np.array([0.0, 0.0, 1.0])
    sight = _along(light, per_light * speed)
    distance = _to_ellipsoid(position, sight, ellipsoid.semimajor_axis + heights, ellipsoid.semiminor_axis + heights)
    raised = np.zeros(len(heights))
    miss = np.full(len(heights), np.nan)
    for _ in range(_STEPS):
        sight = _along(light, per_light * (speed - np.cross(turn, distance[:, None] * sight)))
        geodetic = geocentric_to_geodetic(position + distance[:, None] * sight, ellipsoid)
        fall = -np.einsum("rk,rk->r", local_axes(geodetic)[:, 2], sight)
        fall[~(fall > LOWEST_SIGHT)] = np.nan
        # the point lies below by ``raised``, on the same normal; its zenith distance is that of the straight line to it
        drop = distance * fall + raised
        raised = excess * (distance**2 + raised * (drop + distance * fall)) / drop**2
        miss = geodetic[:, 2] - heights - raised
        distance = distance + miss / fall
    geodetic[~(np.abs(miss) < LOCALISED_METRES)] = np.nan
    return geodetic


def _along(light: Array, motion: Array) -> Array:
    """Unit sight lines (r, 3) of light that arrives from unit directions, with motion in parts of the speed of light."""
    across = np.einsum("rk,rk->r", light, motion)
    length = across + np.sqrt(1.0 - np.einsum("rk,rk->r", motion, motion) + across**2)
    return np.asarray(length[:, None] * light - motion)


def _to_ellipsoid(position: Array, direction: Array, semimajor: Array, semiminor: Array) -> Array:
    """Distances (r,) along unit directions to the near sides of ellipsoids; NaN where they are missed or behind."""
    stretch = np.stack([np.ones_like(semimajor), np.ones_like(semimajor), semimajor / semiminor], axis=1)
    p, d = position * stretch, direction * stretch
    a, b = np.einsum("rk,rk->r", d, d), np.einsum("rk,rk->r", p, d)
    root = b**2 - a * (np.einsum("rk,rk->r", p, p) - semimajor**2)
    distance = np.full(len(a), np.nan)
    met = (root >= 0.0) & (b < 0.0)
    distance[met] = (-b[met] - np.sqrt(root[met])) / a[met]
    return distance
