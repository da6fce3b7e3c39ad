"""The compiled part of the pushbroom sensor: pose of the camera in time, sight lines to points, the line that sweeps over a point.

See `submin.sensors.pushbroom` for the model and `submin.sensors.pushbroom_camera` for the packed camera.
"""

from __future__ import annotations

import numba
import numpy as np

from submin.sensors.base import Array, Index
from submin.sensors.pushbroom_camera import (
    ATTITUDE_ROW,
    ATTITUDES,
    FIRST_TIME,
    FOCAL,
    LAST_TIME,
    LEAST_SAMPLE,
    LINE_ROW,
    LINES,
    MOST_SAMPLE,
    ORIGIN_X,
    ORIGIN_Y,
    PER_LIGHT,
    PITCH,
    POSITION_ROW,
    POSITIONS,
    ROTATION,
    SCALE_HEIGHT,
    STEP_X,
    STEP_Y,
    TABLES,
    ZENITH_PATH,
)

LOWEST_SIGHT = 0.05
"""Sine of the elevation of the camera above the horizon of the point, 3 degrees: below, refraction is not what is modelled here."""
_NEWTON_STEPS = 30
_LAST_STEP = 1e-4
"""Lines: Newton converges quadratically, and sight lines bend by far less than a pixel in a pixel; after such a step 1e-9 is left."""

_AT, _SPEED, _ACCELERATION, _SPIN, _UP, _STRAIGHT, _SIGHT, _MOTION, _LIGHT, _LIGHT_BY_TIME = range(10)
_SEEN, _SEEN_BY_TIME, _CORRECTED, _LENGTHS, _BY_SEEN, _BY_SIGHT, _RATES, _AXES = range(10, 18)
_WORK = 21
"""Rows of three numbers in which one ray is worked out; ``_AXES`` are three."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


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
    k = _segment(camera, TABLES, LINE_ROW, int(camera[LINES]), t)
    rate = (camera[k + 3] - camera[k + 1]) / (camera[k + 2] - camera[k])
    return camera[k + 1] + rate * (t - camera[k]), rate


@_compiled
def _time_of_line(camera: Array, line: float) -> float:
    k, last = TABLES, TABLES + LINE_ROW * (int(camera[LINES]) - 2)
    ascending = camera[k + 3] > camera[k + 1]
    while k < last and (line >= camera[k + 3]) == ascending:
        k += LINE_ROW
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
    start = TABLES + LINE_ROW * int(camera[LINES])
    count = int(camera[POSITIONS])
    k = _segment(camera, start, POSITION_ROW, count, t)
    h = camera[k + POSITION_ROW] - camera[k]
    u = (t - camera[k]) / h
    for i in range(3):
        work[_AT, i], work[_SPEED, i], work[_ACCELERATION, i] = _cubic(camera, k, POSITION_ROW, 1, 4, i, h, u)
    k = _segment(camera, start + POSITION_ROW * count, ATTITUDE_ROW, int(camera[ATTITUDES]), t)
    h = camera[k + ATTITUDE_ROW] - camera[k]
    u = (t - camera[k]) / h
    x, dx, _ = _cubic(camera, k, ATTITUDE_ROW, 1, 5, 0, h, u)
    y, dy, _ = _cubic(camera, k, ATTITUDE_ROW, 1, 5, 1, h, u)
    z, dz, _ = _cubic(camera, k, ATTITUDE_ROW, 1, 5, 2, h, u)
    w, dw, _ = _cubic(camera, k, ATTITUDE_ROW, 1, 5, 3, h, u)
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
    turn, per_light = camera[ROTATION], camera[PER_LIGHT]
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
    f = camera[FOCAL] / z
    work[_CORRECTED, 0], work[_CORRECTED, 1], work[_CORRECTED, 2] = x, y, z
    fx, fy = f * x - camera[ORIGIN_X], f * y - camera[ORIGIN_Y]
    fx_by_time, fy_by_time = f * (dx - x * dz / z), f * (dy - y * dz / z)
    ax, ay = camera[STEP_X] / camera[PITCH] ** 2, camera[STEP_Y] / camera[PITCH] ** 2
    work[_LENGTHS, 0], work[_LENGTHS, 1], work[_LENGTHS, 2] = straight, distance, height
    return ax * fx + ay * fy, -ay * fx + ax * fy, ax * fx_by_time + ay * fy_by_time, -ay * fx_by_time + ax * fy_by_time


@_compiled
def _by_sight(camera: Array, along: float, across: float, theta: Array, work: Array) -> None:
    """Partials of ``along fx + across fy`` (focal plane) by the corrected direction b in camera axes and by the refracted sight line."""
    x, y, z = work[_CORRECTED, 0], work[_CORRECTED, 1], work[_CORRECTED, 2]
    by_seen, by_sight = work[_BY_SEEN], work[_BY_SIGHT]
    f = camera[FOCAL] / z
    by_seen[0], by_seen[1], by_seen[2] = f * along, f * across, -f * (along * x + across * y) / z
    tx, ty, tz = _cross(by_seen, theta[:3])
    qx, qy, qz = by_seen[0] - tx, by_seen[1] - ty, by_seen[2] - tz
    r, sight, motion = work[_AXES : _AXES + 3], work[_SIGHT], work[_MOTION]
    for i in range(3):
        by_sight[i] = r[i, 0] * qx + r[i, 1] * qy + r[i, 2] * qz
    per_light, distance = camera[PER_LIGHT], work[_LENGTHS, 1]
    along_motion = per_light * _dot(by_sight, motion) / distance
    turn = per_light * distance * camera[ROTATION]
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
        raised_by_point = -raised * (jacobian[2, i] / camera[SCALE_HEIGHT] + 2.0 * height_by_point / height)
        out[i] += vertical * raised_by_point + raised * (sight_east * jacobian[0, i] + sight_north * jacobian[1, i])


@_compiled
def _rotations(theta: Array, t: float, fixed: bool, out: Array) -> None:
    """Rotations (3) at time t after mid scan and their derivatives (3) by the time of the ray."""
    for i in range(3):
        out[i] = theta[i] + theta[3 + i] * t
        out[3 + i] = 0.0 if fixed else theta[3 + i]


@_compiled
def _sweep(
    camera: Array, ground: Array, excess: float, theta: Array, fixed: bool, measured: float, out: Array, work: Array
) -> tuple[float, float]:
    """Time at which the detector line sweeps over the point, and its sample; NaN when it never does.

    Corrections are evaluated at the time ``measured`` when they are ``fixed`` there, else at that of the ray; ``out`` gets them. After it
    ``work`` is that of the ray.
    """
    first, last = camera[FIRST_TIME], camera[LAST_TIME]
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
def project(
    cameras: Array, parameters: Array, geocentric: Array, geodetic: Array, jacobian: Array, image: Index, point: Index, at: Array
) -> tuple[Array, Array, Array]:
    """Image coordinates of rays and their partials by ground point and parameters; no row in ``at`` stands for the predicted ones."""
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
        excess = camera[ZENITH_PATH] * np.exp(-geodetic[j, 2] / camera[SCALE_HEIGHT])
        fixed = len(at) > 0
        measured = _time_of_line(camera, at[r, 1]) if fixed else np.nan
        t, sample = _sweep(camera, geocentric[j], excess, theta, fixed, measured, rotations, work)
        if not camera[LEAST_SAMPLE] <= sample <= camera[MOST_SAMPLE]:
            continue
        line, line_rate = _line_of_time(camera, t)
        predicted[r, 0], predicted[r, 1] = sample, line
        step_x, step_y = camera[STEP_X] / camera[PITCH] ** 2, camera[STEP_Y] / camera[PITCH] ** 2
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
def looks(cameras: Array, image: Index, samples: Array, lines: Array) -> tuple[Array, Array, Array]:
    """Position, velocity and the unit direction in which each pixel looks, (r, 3) in body-fixed axes; NaN outside of image and samples."""
    position, speed, direction = np.full((3, len(image), 3), np.nan)
    work = np.empty((_WORK, 3))
    seen = work[_SEEN]
    for r in range(len(image)):
        camera = cameras[image[r]]
        t = _time_of_line(camera, lines[r])
        if not (camera[FIRST_TIME] <= t <= camera[LAST_TIME] and camera[LEAST_SAMPLE] <= samples[r] <= camera[MOST_SAMPLE]):
            continue
        _pose(camera, t, work)
        seen[0] = camera[ORIGIN_X] + samples[r] * camera[STEP_X]
        seen[1] = camera[ORIGIN_Y] + samples[r] * camera[STEP_Y]
        seen[2] = camera[FOCAL]
        norm = np.sqrt(_dot(seen, seen))
        for i in range(3):
            position[r, i], speed[r, i] = work[_AT, i], work[_SPEED, i]
            direction[r, i] = _dot(work[_AXES + i], seen) / norm
    return position, speed, direction
