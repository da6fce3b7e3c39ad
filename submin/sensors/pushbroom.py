"""A linear array that sweeps over the ground (pushbroom), described by its orbit, attitude, detector line and line times.

At time t the camera is at ``P(t)`` with velocity ``V(t)``; the rotation ``R(t)`` takes camera axes to body-fixed geocentric axes. Camera
axes: x along the scan, y along the detector line, z along the line of sight, to the ground. A ground point X is seen along ``w = X - P``;
two effects bend that, each where the description asks for it:

* refraction: the point is seen where it would be without air if it lay higher by ``zenith_path exp(-h / scale_height) / cos^2 z``, with z
  the zenith distance of the camera at the point. For flat layers this is exact to first order in the refractivity, and sphericity
  changes it by ``scale_height / radius``;
* aberration: ``d = w + |w| (V - rotation x w) / c``. In body-fixed axes ``V`` is the velocity against the rotating body; the second term
  is how far the body turns while the light travels. First order in ``V / c``; the second is 1e-9 rad.

In camera axes ``b = R' d``, corrected to ``b - theta x b`` with

    theta = (roll, pitch, yaw) + (rates) (t - t_mid)        t_mid: time of the middle line

that is, small rotations of the camera about its own axes: roll about x (along track), pitch about y (across track), yaw about z (line of
sight). In an adjustment t in ``theta`` is the time of the *measured* line (docs/decisions/005). In the focal plane the point is at
``F = f (b_x, b_y) / b_z``. The line is where F falls onto the detector line, ``F(t) = origin + sample step``: one equation for t, solved by
Newton, and one for the sample. Partials follow by implicit differentiation.

Between samples, positions are cubic Hermite polynomials of the given positions and velocities, and quaternions cubic Hermite
polynomials, normalised, with rates from a polynomial through the five nearest samples: both are smooth to the first derivative and of
fourth order. Line times are linear between the entries of the table and beyond its ends.

Nothing is extrapolated: a point that would be seen outside the sampled times, or further outside the image than ``MARGIN`` of its size
(at least ``MARGIN_PIXELS``), or from lower than ``LOWEST_SIGHT`` above the horizon, is not seen, and NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numba
import numpy as np

from submin.errors import InputError
from submin.geodesy import Ellipsoid
from submin.sensors.base import Array, Ground, Index, Parameter, Projection

MARGIN = 0.25
"""Part of the image's size by which a point may lie outside of it on each side: approximate points of an adjustment do."""
MARGIN_PIXELS = 2000.0
LOWEST_SIGHT = 0.05
"""Sine of the elevation of the camera above the horizon of the point, 3 degrees: below, refraction is not what is modelled here."""
SPEED_OF_LIGHT = 299792458.0

FARTHEST_ATTITUDES = 0.5
"""Radians between neighbouring attitude samples; further apart, a cubic says nothing precise about what is between."""
FINEST_LINE = 1e-7
"""Lines that a time must resolve in float64."""

_F, _ORIGIN_X, _ORIGIN_Y, _STEP_X, _STEP_Y, _PITCH = range(6)
_FIRST_TIME, _LAST_TIME, _LEAST_SAMPLE, _MOST_SAMPLE = range(6, 10)
_PER_LIGHT, _ROTATION, _ZENITH_PATH, _SCALE_HEIGHT, _MEAN_HEIGHT = range(10, 15)
_LINES, _POSITIONS, _ATTITUDES = 15, 16, 17
_TABLES = 18
_LINE_ROW, _POSITION_ROW, _ATTITUDE_ROW = 2, 7, 9

LOCALISED_METRES = 1e-7
"""Of height: what is left of the place itself after such a step is far less."""
_NEWTON_STEPS = 30
_LAST_STEP = 1e-4
"""Lines: Newton converges quadratically, and sight lines bend by far less than a pixel in a pixel; after such a step 1e-9 is left."""

_AT, _SPEED, _ACCELERATION, _SPIN, _UP, _STRAIGHT, _SIGHT, _MOTION, _LIGHT, _LIGHT_BY_TIME = range(10)
_SEEN, _SEEN_BY_TIME, _CORRECTED, _LENGTHS, _BY_SEEN, _BY_SIGHT, _RATES, _AXES = range(10, 18)
_WORK = 21
"""Rows of three numbers in which one ray is worked out; ``_AXES`` are three."""

_compiled = numba.njit(cache=True, error_model="numpy")


@_compiled
def _segment(camera: Array, start: int, row: int, count: int, t: float) -> int:
    """Place in ``camera`` of the table's row that begins the interval of t; the first or last interval for a t outside."""
    first, last = camera[start], camera[start + row * (count - 1)]
    k = int((t - first) / (last - first) * (count - 1))
    k = min(max(k, 0), count - 2)
    while k > 0 and t < camera[start + row * k]:
        k -= 1
    while k < count - 2 and t >= camera[start + row * (k + 1)]:
        k += 1
    return start + row * k


@_compiled
def _line_of_time(camera: Array, t: float) -> tuple[float, float]:
    """Line at a time, and lines per second."""
    k = _segment(camera, _TABLES, _LINE_ROW, int(camera[_LINES]), t)
    rate = (camera[k + 3] - camera[k + 1]) / (camera[k + 2] - camera[k])
    return camera[k + 1] + rate * (t - camera[k]), rate


@_compiled
def _time_of_line(camera: Array, line: float) -> float:
    k, last = _TABLES, _TABLES + _LINE_ROW * (int(camera[_LINES]) - 2)
    ascending = camera[k + 3] > camera[k + 1]
    while k < last and (line >= camera[k + 3]) == ascending:
        k += _LINE_ROW
    time: float = camera[k] + (line - camera[k + 1]) * (camera[k + 2] - camera[k]) / (camera[k + 3] - camera[k + 1])
    return time


@_compiled
def _cubic(camera: Array, k: int, row: int, values: int, rates: int, i: int, h: float, u: float) -> tuple[float, float, float]:
    """Value and two derivatives by time of the i-th of the quantities at ``values`` of the rows at k and k + row, at the part u of h."""
    a, b = camera[k + values + i], camera[k + row + values + i]
    da, db = camera[k + rates + i] * h, camera[k + row + rates + i] * h
    c2, c3 = 3.0 * (b - a) - 2.0 * da - db, 2.0 * (a - b) + da + db
    return a + u * (da + u * (c2 + u * c3)), (da + u * (2.0 * c2 + 3.0 * u * c3)) / h, (2.0 * c2 + 6.0 * u * c3) / (h * h)


@_compiled
def _pose(camera: Array, t: float, work: Array) -> None:
    """Position with two derivatives, angular velocity in camera axes, and the rotation from camera to body-fixed axes, into ``work``."""
    start = _TABLES + _LINE_ROW * int(camera[_LINES])
    count = int(camera[_POSITIONS])
    k = _segment(camera, start, _POSITION_ROW, count, t)
    h = camera[k + _POSITION_ROW] - camera[k]
    u = (t - camera[k]) / h
    for i in range(3):
        work[_AT, i], work[_SPEED, i], work[_ACCELERATION, i] = _cubic(camera, k, _POSITION_ROW, 1, 4, i, h, u)
    k = _segment(camera, start + _POSITION_ROW * count, _ATTITUDE_ROW, int(camera[_ATTITUDES]), t)
    h = camera[k + _ATTITUDE_ROW] - camera[k]
    u = (t - camera[k]) / h
    x, dx, _ = _cubic(camera, k, _ATTITUDE_ROW, 1, 5, 0, h, u)
    y, dy, _ = _cubic(camera, k, _ATTITUDE_ROW, 1, 5, 1, h, u)
    z, dz, _ = _cubic(camera, k, _ATTITUDE_ROW, 1, 5, 2, h, u)
    w, dw, _ = _cubic(camera, k, _ATTITUDE_ROW, 1, 5, 3, h, u)
    s = 2.0 / (x * x + y * y + z * z + w * w)
    r = work[_AXES : _AXES + 3]
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
    r[1, 0], r[1, 1], r[1, 2] = s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)
    r[2, 0], r[2, 1], r[2, 2] = s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)
    # twice the vector part of conjugate(q) dq / |q|^2: growth of |q| is in the scalar part and drops out
    work[_SPIN, 0] = s * (w * dx - x * dw - y * dz + z * dy)
    work[_SPIN, 1] = s * (w * dy - y * dw - z * dx + x * dz)
    work[_SPIN, 2] = s * (w * dz - z * dw - x * dy + y * dx)


@_compiled
def _dot(a: Array, b: Array) -> float:
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


@_compiled
def _cross(a: Array, b: Array) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_compiled
def _sight(camera: Array, t: float, ground: Array, excess: float, theta: Array, work: Array) -> tuple[float, float, float, float]:
    """Where the point is on the detector line at time t: sample, pixels off the line, and the derivatives of both by time.

    ``theta`` holds the rotations at that time and their derivatives by time. NaN where the camera does not look at the point from above.
    """
    _pose(camera, t, work)
    sight, up, speed, motion, spin, b = work[_SIGHT], work[_UP], work[_SPEED], work[_MOTION], work[_SPIN], work[_SEEN]
    r = work[_AXES : _AXES + 3]
    for i in range(3):
        sight[i] = ground[i] - work[_AT, i]
    straight = np.sqrt(_dot(sight, sight))
    height = -_dot(up, sight) / straight
    if not height > LOWEST_SIGHT:
        return np.nan, np.nan, np.nan, np.nan
    by_time = (_dot(up, speed) + height * _dot(sight, speed) / straight) / straight
    work[_STRAIGHT] = sight
    raised, raised_by_time = excess / height**2, -2.0 * excess * by_time / height**3
    for i in range(3):
        sight[i] += up[i] * raised
    distance = np.sqrt(_dot(sight, sight))
    turn, per_light = camera[_ROTATION], camera[_PER_LIGHT]
    d, dd = work[_LIGHT], work[_LIGHT_BY_TIME]
    for i in range(3):
        dd[i] = up[i] * raised_by_time - speed[i]
    distance_by_time = _dot(sight, dd) / distance
    motion[0], motion[1], motion[2] = speed[0] + turn * sight[1], speed[1] - turn * sight[0], speed[2]
    change_x, change_y = work[_ACCELERATION, 0] + turn * dd[1], work[_ACCELERATION, 1] - turn * dd[0]
    for i in range(3):
        d[i] = sight[i] + distance * per_light * motion[i]
        dd[i] += distance_by_time * per_light * motion[i]
    dd[0] += distance * per_light * change_x
    dd[1] += distance * per_light * change_y
    dd[2] += distance * per_light * work[_ACCELERATION, 2]
    for i in range(3):
        b[i] = r[0, i] * d[0] + r[1, i] * d[1] + r[2, i] * d[2]
    sx, sy, sz = _cross(spin, b)
    db = work[_SEEN_BY_TIME]
    for i in range(3):
        db[i] = r[0, i] * dd[0] + r[1, i] * dd[1] + r[2, i] * dd[2]
    db[0] -= sx
    db[1] -= sy
    db[2] -= sz
    tx, ty, tz = _cross(theta[:3], b)
    x, y, z = b[0] - tx, b[1] - ty, b[2] - tz
    if not z > 0.0:
        return np.nan, np.nan, np.nan, np.nan
    tx, ty, tz = _cross(theta[:3], db)
    rx, ry, rz = _cross(theta[3:], b)
    dx, dy, dz = db[0] - tx - rx, db[1] - ty - ry, db[2] - tz - rz
    f = camera[_F] / z
    work[_CORRECTED, 0], work[_CORRECTED, 1], work[_CORRECTED, 2] = x, y, z
    fx, fy = f * x - camera[_ORIGIN_X], f * y - camera[_ORIGIN_Y]
    fx_by_time, fy_by_time = f * (dx - x * dz / z), f * (dy - y * dz / z)
    ax, ay = camera[_STEP_X] / camera[_PITCH] ** 2, camera[_STEP_Y] / camera[_PITCH] ** 2
    work[_LENGTHS, 0], work[_LENGTHS, 1], work[_LENGTHS, 2] = straight, distance, height
    return ax * fx + ay * fy, -ay * fx + ax * fy, ax * fx_by_time + ay * fy_by_time, -ay * fx_by_time + ax * fy_by_time


@_compiled
def _by_sight(camera: Array, along: float, across: float, theta: Array, work: Array) -> None:
    """Partials of ``along fx + across fy`` (focal plane) by the corrected direction b in camera axes and by the refracted sight line."""
    x, y, z = work[_CORRECTED, 0], work[_CORRECTED, 1], work[_CORRECTED, 2]
    by_seen, by_sight = work[_BY_SEEN], work[_BY_SIGHT]
    f = camera[_F] / z
    by_seen[0], by_seen[1], by_seen[2] = f * along, f * across, -f * (along * x + across * y) / z
    tx, ty, tz = _cross(by_seen, theta[:3])
    qx, qy, qz = by_seen[0] - tx, by_seen[1] - ty, by_seen[2] - tz
    r, sight, motion = work[_AXES : _AXES + 3], work[_SIGHT], work[_MOTION]
    for i in range(3):
        by_sight[i] = r[i, 0] * qx + r[i, 1] * qy + r[i, 2] * qz
    per_light, distance = camera[_PER_LIGHT], work[_LENGTHS, 1]
    along_motion = per_light * _dot(by_sight, motion) / distance
    turn = per_light * distance * camera[_ROTATION]
    q0, q1 = by_sight[0], by_sight[1]
    for i in range(3):
        by_sight[i] += along_motion * sight[i]
    by_sight[0] -= turn * q1
    by_sight[1] += turn * q0


@_compiled
def _by_ground(camera: Array, geodetic: Array, jacobian: Array, excess: float, work: Array, out: Array) -> None:
    """Partials by the ground point of what has the partials ``work[_BY_SIGHT]`` by the refracted sight line."""
    by_sight = work[_BY_SIGHT]
    for i in range(3):
        out[i] = by_sight[i]
    if excess == 0.0:
        return
    lon, lat = np.radians(geodetic[0]), np.radians(geodetic[1])
    sin_lon, cos_lon, sin_lat, cos_lat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    up, line = work[_UP], work[_STRAIGHT]
    straight, height = work[_LENGTHS, 0], work[_LENGTHS, 2]
    raised = excess / height**2
    radian = np.pi / 180.0
    sight_east = radian * cos_lat * (cos_lon * by_sight[1] - sin_lon * by_sight[0])
    sight_north = radian * (cos_lat * by_sight[2] - sin_lat * (cos_lon * by_sight[0] + sin_lon * by_sight[1]))
    line_east = radian * cos_lat * (cos_lon * line[1] - sin_lon * line[0]) / straight
    line_north = radian * (cos_lat * line[2] - sin_lat * (cos_lon * line[0] + sin_lon * line[1])) / straight
    vertical = _dot(by_sight, up)
    for i in range(3):
        height_by_point = -(line_east * jacobian[0, i] + line_north * jacobian[1, i]) - (up[i] + height * line[i] / straight) / straight
        raised_by_point = -raised * (jacobian[2, i] / camera[_SCALE_HEIGHT] + 2.0 * height_by_point / height)
        out[i] += vertical * raised_by_point + raised * (sight_east * jacobian[0, i] + sight_north * jacobian[1, i])


@_compiled
def _rotations(theta: Array, t: float, fixed: bool, out: Array) -> None:
    """Rotations (3) at time t after mid scan and their derivatives (3) by the time of the ray."""
    for i in range(3):
        out[i] = theta[i] + theta[3 + i] * t
        out[3 + i] = 0.0 if fixed else theta[3 + i]


@_compiled
def _sweep(camera: Array, ground: Array, excess: float, theta: Array, measured: float, out: Array, work: Array) -> tuple[float, float]:
    """Time at which the detector line sweeps over the point, and its sample; NaN when it never does.

    ``measured`` is the time at which corrections are evaluated, NaN for that of the ray itself; ``out`` gets them. After it ``work``
    is that of the ray.
    """
    fixed = not np.isnan(measured)
    first, last = camera[_FIRST_TIME], camera[_LAST_TIME]
    t = min(max(measured, first), last) if fixed else 0.0
    if fixed:
        _rotations(theta, measured, True, out)
    clipped = False
    for _ in range(_NEWTON_STEPS):
        if not fixed:
            _rotations(theta, t, False, out)
        sample, miss, sample_by_time, miss_by_time = _sight(camera, t, ground, excess, out, work)
        step = -miss / miss_by_time
        if not np.isfinite(step):
            break
        inside = first <= t + step <= last
        if abs(step * _line_of_time(camera, t)[1]) < _LAST_STEP:
            work[_RATES, 0], work[_RATES, 1] = sample_by_time, miss_by_time
            return (t + step, sample + sample_by_time * step) if inside else (np.nan, np.nan)
        if clipped and not inside:
            break
        clipped = not inside
        t = min(max(t + step, first), last)
    return np.nan, np.nan


@_compiled
def _project(
    cameras: Array, parameters: Array, geocentric: Array, geodetic: Array, jacobian: Array, image: Index, point: Index, at: Array
) -> tuple[Array, Array, Array]:
    rays = len(image)
    predicted = np.full((rays, 2), np.nan)
    by_ground = np.full((rays, 2, 3), np.nan)
    by_parameters = np.full((rays, 2, 6), np.nan)
    work, rotations = np.empty((_WORK, 3)), np.empty(6)
    by_point, by_theta = np.empty((2, 3)), np.empty((2, 3))
    for r in range(rays):
        camera, theta, j = cameras[image[r]], parameters[image[r]], point[r]
        lon, lat = np.radians(geodetic[j, 0]), np.radians(geodetic[j, 1])
        sin_lon, cos_lon, sin_lat, cos_lat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
        up = work[_UP]
        up[0], up[1], up[2] = cos_lat * cos_lon, cos_lat * sin_lon, sin_lat
        excess = camera[_ZENITH_PATH] * np.exp(-geodetic[j, 2] / camera[_SCALE_HEIGHT])
        fixed = len(at) > 0
        measured = _time_of_line(camera, at[r, 1]) if fixed else np.nan
        t, sample = _sweep(camera, geocentric[j], excess, theta, measured, rotations, work)
        if not camera[_LEAST_SAMPLE] <= sample <= camera[_MOST_SAMPLE]:
            continue
        line, line_rate = _line_of_time(camera, t)
        predicted[r, 0], predicted[r, 1] = sample, line
        step_x, step_y = camera[_STEP_X] / camera[_PITCH] ** 2, camera[_STEP_Y] / camera[_PITCH] ** 2
        for k in range(2):
            along, across = (step_x, step_y) if k == 0 else (-step_y, step_x)
            _by_sight(camera, along, across, rotations, work)
            by_theta[k, 0], by_theta[k, 1], by_theta[k, 2] = _cross(work[_BY_SEEN], work[_SEEN])
            _by_ground(camera, geodetic[j], jacobian[j], excess, work, by_point[k])
        since = measured if fixed else t
        sample_by_time, miss_by_time = work[_RATES, 0], work[_RATES, 1]
        for i in range(3):
            by_time = -by_point[1, i] / miss_by_time
            by_ground[r, 0, i] = by_point[0, i] + sample_by_time * by_time
            by_ground[r, 1, i] = line_rate * by_time
            by_time = -by_theta[1, i] / miss_by_time
            by_parameters[r, 0, i] = by_theta[0, i] + sample_by_time * by_time
            by_parameters[r, 1, i] = line_rate * by_time
            by_parameters[r, 0, 3 + i] = by_parameters[r, 0, i] * since
            by_parameters[r, 1, 3 + i] = by_parameters[r, 1, i] * since
    return predicted, by_ground, by_parameters


@_compiled
def _geodetic(x: float, y: float, z: float, semimajor: float, flattening: float) -> tuple[float, float, float]:
    """Longitude, latitude (radians) and height of geocentric coordinates."""
    e2 = flattening * (2.0 - flattening)
    p = np.sqrt(x * x + y * y)
    lat = np.arctan2(z, p * (1.0 - e2))
    prime_vertical = semimajor
    for _ in range(4):  # each round leaves e2^2 of the error for heights far below the radius; the start is right to e2 h / a
        reduced = np.arctan2((1.0 - flattening) * np.sin(lat), np.cos(lat))
        lat = np.arctan2(z + e2 / (1.0 - flattening) * semimajor * np.sin(reduced) ** 3, p - e2 * semimajor * np.cos(reduced) ** 3)
        prime_vertical = semimajor / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    height = p * cos_lat + z * sin_lat - prime_vertical * (1.0 - e2 * sin_lat * sin_lat)
    return np.arctan2(y, x), lat, height


@_compiled
def _to_ellipsoid(at: Array, direction: Array, semimajor: float, semiminor: float) -> float:
    """Distance along a unit direction to the near side of an ellipsoid; NaN when it is missed."""
    stretch = semimajor / semiminor
    az, dz = at[2] * stretch, direction[2] * stretch
    a = direction[0] ** 2 + direction[1] ** 2 + dz * dz
    b = at[0] * direction[0] + at[1] * direction[1] + az * dz
    c = at[0] ** 2 + at[1] ** 2 + az * az - semimajor**2
    distance: float = (-b - np.sqrt(b * b - a * c)) / a
    return distance


@_compiled
def _localise(cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, semimajor: float, flattening: float) -> Array:
    ground = np.full((len(image), 3), np.nan)
    work = np.empty((_WORK, 3))
    sight, seen, motion = work[_SIGHT], work[_SEEN], work[_MOTION]
    for r in range(len(image)):
        camera = cameras[image[r]]
        ground[r, 2] = heights[r]
        t = _time_of_line(camera, lines[r])
        if not (camera[_FIRST_TIME] <= t <= camera[_LAST_TIME] and camera[_LEAST_SAMPLE] <= samples[r] <= camera[_MOST_SAMPLE]):
            continue
        _pose(camera, t, work)
        axes, at, speed = work[_AXES : _AXES + 3], work[_AT], work[_SPEED]
        seen[0] = camera[_ORIGIN_X] + samples[r] * camera[_STEP_X]
        seen[1] = camera[_ORIGIN_Y] + samples[r] * camera[_STEP_Y]
        seen[2] = camera[_F]
        norm = np.sqrt(_dot(seen, seen))
        for i in range(3):
            work[_LIGHT, i] = _dot(axes[i], seen) / norm
        excess = camera[_ZENITH_PATH] * np.exp(-heights[r] / camera[_SCALE_HEIGHT])
        distance, raised = 0.0, 0.0
        sight[:] = 0.0
        for step in range(_NEWTON_STEPS):
            # direction and distance depend on each other by the turn of the body, distance and height by refraction: both a few 1e-6
            turn, per_light = camera[_ROTATION], camera[_PER_LIGHT]
            motion[0] = per_light * (speed[0] + turn * distance * sight[1])
            motion[1] = per_light * (speed[1] - turn * distance * sight[0])
            motion[2] = per_light * speed[2]
            across = _dot(work[_LIGHT], motion)
            length = across + np.sqrt(1.0 - _dot(motion, motion) + across * across)
            for i in range(3):
                sight[i] = length * work[_LIGHT, i] - motion[i]
            if step == 0:
                distance = _to_ellipsoid(at, sight, semimajor + heights[r], semimajor * (1.0 - flattening) + heights[r])
                if not distance > 0.0:
                    break
            x, y, z = at[0] + distance * sight[0], at[1] + distance * sight[1], at[2] + distance * sight[2]
            lon, lat, height = _geodetic(x, y, z, semimajor, flattening)
            up = work[_UP]
            up[0], up[1], up[2] = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
            descent = -_dot(up, sight)
            if not descent > LOWEST_SIGHT:
                break
            # the point lies below by ``raised``, on the same normal; its zenith distance is that of the straight line to it
            straight = np.sqrt(distance**2 + raised * (2.0 * distance * descent + raised))
            raised = excess * (straight / (distance * descent + raised)) ** 2
            miss = height - heights[r] - raised
            distance += miss / descent
            if step > 1 and abs(miss) < LOCALISED_METRES:
                ground[r, 0], ground[r, 1] = np.degrees(lon), np.degrees(lat)
                break
    return ground


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
        Parameter("rate roll", "rad/s", "rate", 5e-7),
        Parameter("rate pitch", "rad/s", "rate", 5e-7),
        Parameter("rate yaw", "rad/s", "rate", 5e-7),
    )

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        """Packed camera of a description: 18 numbers, then the tables of line times, positions and attitudes.

        Raises
        ------
        InputError
            When an entry is missing, not finite, of the wrong shape, out of order, or does not cover the lines of the image.
        """
        if not (width > 0 and height > 0 and np.isfinite([width, height]).all()):
            raise InputError(f"pushbroom: image size is {width} x {height}; expected positive numbers of pixels")
        line_times, lines = _table(camera, "lines", 2)
        times, positions = _table(camera, "position", 2, 3)
        velocities = _array(camera, "position", "velocities", positions.shape)
        turns, quaternions = _table(camera, "attitude", 2, 4)
        if line_times[0] > line_times[-1]:
            line_times, lines = line_times[::-1], lines[::-1]
        _require_ascending("lines, times", line_times)
        _require_ascending("lines, values", lines if lines[-1] > lines[0] else -lines)
        _require_ascending("position, times", times)
        _require_ascending("attitude, times", turns)
        middle = _linear(0.5 * (height - 1.0), lines, line_times)
        _require_resolved(line_times, lines, max(abs(times[0]), abs(times[-1]), abs(middle)))

        reach_samples, reach_lines = margins(width, height)
        first, last = sorted(_linear(line, lines, line_times) for line in (0.0, height - 1.0))
        _require_cover("position", times, first, last)
        _require_cover("attitude", turns, first, last)
        earliest, latest = sorted(_linear(line, lines, line_times) for line in (-reach_lines, height - 1.0 + reach_lines))

        header = np.empty(_TABLES)
        origin, step = _array(camera, "detector", "origin", (2,)), _array(camera, "detector", "step", (2,))
        header[_F] = _positive(camera, "focal_length")
        header[_ORIGIN_X:_STEP_X], header[_STEP_X:_PITCH] = origin, step
        header[_PITCH] = np.hypot(*step)
        if not header[_PITCH] > 0.0:
            raise InputError("pushbroom: detector, step is 0, 0; expected the way from one sample to the next, in millimetres")
        header[_FIRST_TIME] = max(earliest, times[0], turns[0]) - middle
        header[_LAST_TIME] = min(latest, times[-1], turns[-1]) - middle
        header[_LEAST_SAMPLE], header[_MOST_SAMPLE] = -reach_samples, width - 1.0 + reach_samples
        aberration, refraction = camera.get("aberration") is not None, camera.get("refraction") is not None
        header[_PER_LIGHT] = 1.0 / SPEED_OF_LIGHT if aberration else 0.0
        header[_ROTATION] = _array(camera, "aberration", "rotation_rate", ()) if aberration else 0.0
        header[_ZENITH_PATH] = _array(camera, "refraction", "zenith_path", ()) if refraction else 0.0
        header[_SCALE_HEIGHT] = _positive(camera["refraction"], "scale_height", "refraction, ") if refraction else np.inf
        header[_MEAN_HEIGHT] = _array(camera, "", "mean_height", ())
        header[_LINES], header[_POSITIONS], header[_ATTITUDES] = len(lines), len(times), len(turns)
        quaternions = _continuous(quaternions)
        tables = (
            np.column_stack([line_times - middle, lines]),
            np.column_stack([times - middle, positions, velocities]),
            np.column_stack([turns - middle, quaternions, _rates(turns - middle, quaternions)]),
        )
        return np.concatenate([header, *(table.ravel() for table in tables)])

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """See `Sensor.project`."""
        where = np.empty((0, 2)) if at is None else at
        return Projection(*_project(cameras, parameters, ground.geocentric, ground.geodetic, ground.jacobian, image, point, where))

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """See `Sensor.localise`."""
        return np.asarray(_localise(cameras, image, samples, lines, heights, ellipsoid.semimajor_axis, ellipsoid.flattening))

    def mean_height(self, cameras: Array) -> Array:
        """The height that each description gives."""
        return cameras[:, _MEAN_HEIGHT]


def margins(width: float, height: float) -> tuple[float, float]:
    """Samples and lines by which a point may lie outside of an image of that size on each side."""
    return max(MARGIN * width, MARGIN_PIXELS), max(MARGIN * height, MARGIN_PIXELS)


def _array(camera: Mapping[str, Any], table: str, name: str, shape: tuple[int, ...]) -> Array:
    """A finite array of that shape; -1 stands for any length. Raises `InputError`."""
    entry = f"{table}, {name}" if table else name
    whole = camera.get(table) if table else camera
    if not isinstance(whole, Mapping) or name not in whole:
        raise InputError(f"pushbroom: {entry} is missing; expected {_of_shape(shape)}")
    try:
        values = np.asarray(whole[name], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"pushbroom: {entry} is not numbers; expected {_of_shape(shape)}") from None
    if values.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, values.shape, strict=True)):
        raise InputError(f"pushbroom: {entry} has the shape {values.shape}; expected {_of_shape(shape)}")
    if not np.isfinite(values).all():
        raise InputError(f"pushbroom: {entry} holds a value that is not finite; expected {_of_shape(shape)}")
    return values


def _of_shape(shape: tuple[int, ...]) -> str:
    return "one number" if not shape else " x ".join("any" if n < 0 else str(n) for n in shape) + " numbers"


def _positive(camera: Mapping[str, Any], name: str, of: str = "") -> float:
    value = float(_array(camera, "", name, ()))
    if not value > 0.0:
        raise InputError(f"pushbroom: {of}{name} is {value:g}; expected a positive number")
    return value


def _table(camera: Mapping[str, Any], name: str, least: int, columns: int | None = None) -> tuple[Array, Array]:
    """Times and values of a table of at least so many rows."""
    times = _array(camera, name, "times", (-1,))
    if len(times) < least:
        raise InputError(f"pushbroom: {name} has {len(times)} times; expected {least} or more")
    return times, _array(camera, name, "values", (len(times),) if columns is None else (len(times), columns))


def _require_ascending(what: str, values: Array) -> None:
    falls = np.flatnonzero(np.diff(values) <= 0.0)
    if len(falls):
        k = falls[0]
        raise InputError(f"pushbroom: {what}: entry {k + 2} ({abs(values[k + 1]):.9g}) is not beyond entry {k + 1} ({abs(values[k]):.9g})")


def _require_cover(what: str, times: Array, first: float, last: float) -> None:
    if times[0] > first or times[-1] < last:
        raise InputError(
            f"pushbroom: {what} is sampled from {times[0]:.6f} to {times[-1]:.6f} s; "
            f"expected samples that cover all lines, {first:.6f} to {last:.6f} s"
        )


def _require_resolved(line_times: Array, lines: Array, largest: float) -> None:
    finest = np.abs(np.diff(lines) / np.diff(line_times)).max() * np.spacing(largest)
    if finest > FINEST_LINE:
        raise InputError(
            f"pushbroom: times run to {largest:.3g} s, where float64 resolves {finest:.1g} line; "
            "expected seconds from an epoch near the scan"
        )


def _linear(x: float, xs: Array, ys: Array) -> float:
    """Linear interpolation, and extrapolation by the first and last interval."""
    order = slice(None) if xs[-1] > xs[0] else slice(None, None, -1)
    xs, ys = xs[order], ys[order]
    k = int(np.clip(np.searchsorted(xs, x, side="right") - 1, 0, len(xs) - 2))
    return float(ys[k] + (x - xs[k]) * (ys[k + 1] - ys[k]) / (xs[k + 1] - xs[k]))


def _continuous(quaternions: Array) -> Array:
    """Unit quaternions with the signs that make neighbours close; the signs given are arbitrary."""
    norms = np.linalg.norm(quaternions, axis=1)
    if not (np.abs(norms - 1.0) < 1e-3).all():
        k = int(np.abs(norms - 1.0).argmax())
        raise InputError(f"pushbroom: attitude, quaternion {k + 1} has the length {norms[k]:.6g}; expected 1")
    unit = quaternions / norms[:, None]
    cosines = np.sum(unit[1:] * unit[:-1], axis=1)
    angles = 2.0 * np.arccos(np.minimum(np.abs(cosines), 1.0))
    if angles.max() > FARTHEST_ATTITUDES:
        k = int(angles.argmax())
        raise InputError(
            f"pushbroom: attitude samples {k + 1} and {k + 2} are {np.degrees(angles[k]):.1f} degrees apart; expected at most "
            f"{np.degrees(FARTHEST_ATTITUDES):.0f}: sample more often"
        )
    signs = np.concatenate([[1.0], np.cumprod(np.where(cosines < 0.0, -1.0, 1.0))])
    return np.asarray(unit * signs[:, None])


def _rates(times: Array, values: Array) -> Array:
    """Derivatives (n, c) at the samples (n, c), of the polynomial through the five nearest in order (fewer when there are fewer)."""
    n = len(times)
    width = min(5, n)
    starts = np.clip(np.arange(n) - width // 2, 0, n - width)
    nodes = starts[:, None] + np.arange(width)
    offsets = times[nodes] - times[:, None]
    scale = np.abs(offsets).max(axis=1)
    powers = (offsets / scale[:, None])[:, None, :] ** np.arange(width)[None, :, None]
    wanted = np.zeros((n, width, 1))
    wanted[:, 1, 0] = 1.0 / scale
    weights = np.linalg.solve(powers, wanted)[..., 0]
    return np.asarray(np.einsum("nk,nkc->nc", weights, values[nodes]))
