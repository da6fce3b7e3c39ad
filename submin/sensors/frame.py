"""Frame cameras: one perspective centre an image, a focal plane with lens distortion, and seven adjustable parameters.

A ground point X is seen from the perspective centre C. With ``G`` the rotation from the body-fixed axes to the camera, its third row the
line of sight,

    u = G d,    d = X - C,    x = f u1 / u3,    y = f u2 / u3        ideal coordinates in the focal plane, mm, from the principal point

The lens moves ideal to measured coordinates. The calibration states the polynomial for one of the two directions; the other one is found
by Newton's method. With rr = x^2 + y^2,

    g(x, y) = (1 + k1 rr + k2 rr^2 + k3 rr^3) (x, y) + (j1 rr + j2 rr^2) (-sin phi, cos phi)

(radial terms, and decentering along the direction phi; Brown 1966). An affine map takes measured millimetres to sample and line.

The adjustable parameters are those of the 2008 MIN paper, Table 1: the position moves along the axes in track (i), cross track (c) and
radial (r), ``C + p1 i + p2 c + p3 r``; the camera turns by alpha about i, beta about c and kappa about its line of sight l,

    u = G R(l, -kappa) R(c, -beta) R(i, -alpha) d            R(a, w) turns by w about a, right-handed

and the focal length is ``f + p7``. All are physical: nothing is evaluated at measured coordinates (decision 005 is about polynomials).

A point behind the camera, or outside the field in which the distortion is one-to-one, is not seen: NaN. The centre of the first pixel is
(0, 0).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numba
import numpy as np

from submin.errors import InputError
from submin.geodesy import Ellipsoid
from submin.sensors.base import Array, Ground, Index, Parameter, Projection
from submin.sensors.straight_sight import meet

DIRECTIONS = ("measured to ideal", "ideal to measured")
"""What the polynomial of a lens distortion maps, and to what."""

_POSITION, _ROTATION, _SIGHT, _AXES, _FOCAL, _POINT, _RADIAL = 0, 3, 9, 12, 21, 22, 24
_DECENTERING, _TO_MEASURED, _REACH2, _SAMPLE, _LINE, _HEIGHT = 27, 31, 32, 33, 36, 39
PACKED = 40

ORTHONORMAL = 1e-6
"""Rotations and axes as files state them, with so many digits at least."""
NEWTON_STEPS = 30
NEWTON_MM = 1e-8
"""A Newton step this small was the last one: what it leaves is its square."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn(axis: Array, angle: float, out: Array) -> None:
    """Rotation matrix by an angle about a unit vector."""
    c, s = np.cos(angle), np.sin(angle)
    for a in range(3):
        for b in range(3):
            out[a, b] = (1.0 - c) * axis[a] * axis[b]
        out[a, a] += c
    out[0, 1] -= s * axis[2]
    out[1, 0] += s * axis[2]
    out[0, 2] += s * axis[1]
    out[2, 0] -= s * axis[1]
    out[1, 2] -= s * axis[0]
    out[2, 1] += s * axis[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _product(one: Array, other: Array, out: Array) -> None:
    for a in range(3):
        for b in range(3):
            out[a, b] = one[a, 0] * other[0, b] + one[a, 1] * other[1, b] + one[a, 2] * other[2, b]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rate(axis: Array, matrix: Array, out: Array) -> None:
    """Derivative of ``R(axis, -w) matrix`` by w where it is ``matrix``: ``-axis x`` each column."""
    for b in range(3):
        out[0, b] = axis[2] * matrix[1, b] - axis[1] * matrix[2, b]
        out[1, b] = axis[0] * matrix[2, b] - axis[2] * matrix[0, b]
        out[2, b] = axis[1] * matrix[0, b] - axis[0] * matrix[1, b]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _attitudes(cameras: Array, parameters: Array) -> Array:
    """Matrices (m, 4, 3, 3) that give u from d, and its derivatives by alpha, beta and kappa."""
    out = np.empty((len(cameras), 4, 3, 3))
    turned, next_turn, left, derivative = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    by_alpha, by_beta = np.empty((3, 3)), np.empty((3, 3))
    for m in range(len(cameras)):
        camera = cameras[m]
        ground_to_camera = camera[_ROTATION:_AXES].reshape(3, 3)
        in_track, cross_track, sight = camera[_AXES : _AXES + 3], camera[_AXES + 3 : _AXES + 6], camera[_SIGHT:_AXES]
        _turn(in_track, -parameters[m, 3], turned)
        _rate(in_track, turned, by_alpha)
        _turn(cross_track, -parameters[m, 4], next_turn)
        _product(next_turn, turned, left)
        _rate(cross_track, left, by_beta)
        _product(next_turn, by_alpha, derivative)
        _turn(sight, -parameters[m, 5], next_turn)
        _product(next_turn, left, turned)
        _product(ground_to_camera, turned, out[m, 0])
        _rate(sight, turned, left)
        _product(ground_to_camera, left, out[m, 3])
        _product(next_turn, derivative, left)
        _product(ground_to_camera, left, out[m, 1])
        _product(next_turn, by_beta, left)
        _product(ground_to_camera, left, out[m, 2])
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bend(camera: Array, x: float, y: float, out: Array) -> None:
    """The distortion polynomial at (x, y), mm: g and its partials, ``out`` = gx, gy, dgx/dx, dgx/dy, dgy/dx, dgy/dy."""
    k1, k2, k3 = camera[_RADIAL], camera[_RADIAL + 1], camera[_RADIAL + 2]
    rr = x * x + y * y
    radial = 1.0 + rr * (k1 + rr * (k2 + rr * k3))
    by_rr = k1 + rr * (2.0 * k2 + rr * 3.0 * k3)
    for c in range(2):
        j1, j2 = camera[_DECENTERING + c], camera[_DECENTERING + 2 + c]
        own = x if c == 0 else y
        along = 2.0 * (own * by_rr + j1 + 2.0 * j2 * rr)
        out[c] = own * radial + rr * (j1 + rr * j2)
        out[2 + 2 * c] = along * x + (radial if c == 0 else 0.0)
        out[3 + 2 * c] = along * y + (radial if c == 1 else 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unbend(camera: Array, x: float, y: float, out: Array) -> None:
    """Where the polynomial is (x, y): as `_bend`, of the inverse; NaN where there is no such place within reach."""
    gx, gy = x, y
    converged = False
    for _ in range(NEWTON_STEPS):
        _bend(camera, gx, gy, out)
        determinant = out[2] * out[5] - out[3] * out[4]
        ex, ey = x - out[0], y - out[1]
        dx, dy = (out[5] * ex - out[3] * ey) / determinant, (out[2] * ey - out[4] * ex) / determinant
        gx, gy = gx + dx, gy + dy
        if abs(dx) < NEWTON_MM and abs(dy) < NEWTON_MM:
            converged = True
            break
    if not (converged and gx * gx + gy * gy <= camera[_REACH2]):
        out[:] = np.nan
        return
    _bend(camera, gx, gy, out)
    determinant = out[2] * out[5] - out[3] * out[4]
    xx, xy, yx, yy = out[2], out[3], out[4], out[5]
    out[0], out[1] = gx, gy
    out[2], out[3], out[4], out[5] = yy / determinant, -xy / determinant, -yx / determinant, xx / determinant


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _through_lens(camera: Array, x: float, y: float, to_measured: bool, out: Array) -> None:
    """Ideal to measured coordinates (mm, from the principal point), or back, with partials; NaN out of reach. ``out`` as of `_bend`."""
    if (camera[_TO_MEASURED] > 0.0) == to_measured:
        if x * x + y * y <= camera[_REACH2]:
            _bend(camera, x, y, out)
        else:
            out[:] = np.nan
    else:
        _unbend(camera, x, y, out)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(cameras: Array, parameters: Array, geocentric: Array, image: Index, point: Index) -> tuple[Array, Array, Array]:
    rays = len(image)
    predicted, by_ground, by_parameters = np.empty((rays, 2)), np.empty((rays, 2, 3)), np.empty((rays, 2, 7))
    attitudes = _attitudes(cameras, parameters)
    d, u, lens, w, by_u = np.empty(3), np.empty(3), np.empty(6), np.empty(3), np.empty((2, 3))
    for r in range(rays):
        m = image[r]
        camera, theta, attitude = cameras[m], parameters[m], attitudes[m]
        for k in range(3):
            d[k] = geocentric[point[r], k] - camera[_POSITION + k]
            for a in range(3):
                d[k] -= theta[a] * camera[_AXES + 3 * a + k]
        for k in range(3):
            u[k] = attitude[0, k, 0] * d[0] + attitude[0, k, 1] * d[1] + attitude[0, k, 2] * d[2]
        focal = camera[_FOCAL] + theta[6]
        if not (u[2] > 0.0 and focal > 0.0):
            predicted[r], by_ground[r], by_parameters[r] = np.nan, np.nan, np.nan
            continue
        tx, ty = u[0] / u[2], u[1] / u[2]
        _through_lens(camera, focal * tx, focal * ty, True, lens)
        mx, my = lens[0] + camera[_POINT], lens[1] + camera[_POINT + 1]
        for c in range(2):
            at = _SAMPLE + 3 * c
            predicted[r, c] = camera[at] + camera[at + 1] * mx + camera[at + 2] * my
            by_x = camera[at + 1] * lens[2] + camera[at + 2] * lens[4]
            by_y = camera[at + 1] * lens[3] + camera[at + 2] * lens[5]
            by_u[c, 0], by_u[c, 1] = by_x * focal / u[2], by_y * focal / u[2]
            by_u[c, 2] = -(by_u[c, 0] * tx + by_u[c, 1] * ty)
            by_parameters[r, c, 6] = by_x * tx + by_y * ty
            for k in range(3):
                by_ground[r, c, k] = by_u[c, 0] * attitude[0, 0, k] + by_u[c, 1] * attitude[0, 1, k] + by_u[c, 2] * attitude[0, 2, k]
            for a in range(3):
                by_parameters[r, c, a] = 0.0
                for k in range(3):
                    by_parameters[r, c, a] -= by_ground[r, c, k] * camera[_AXES + 3 * a + k]
        for a in range(3):
            turned = attitude[1 + a]
            for k in range(3):
                w[k] = turned[k, 0] * d[0] + turned[k, 1] * d[1] + turned[k, 2] * d[2]
            for c in range(2):
                by_parameters[r, c, 3 + a] = by_u[c, 0] * w[0] + by_u[c, 1] * w[1] + by_u[c, 2] * w[2]
    return predicted, by_ground, by_parameters


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _directions(cameras: Array, image: Index, samples: Array, lines: Array) -> Array:
    """Directions (r, 3) in body-fixed axes, unit vectors, into which unadjusted cameras look at image coordinates; NaN out of reach."""
    out, lens = np.empty((len(image), 3)), np.empty(6)
    for r in range(len(image)):
        camera = cameras[image[r]]
        ds, dl = samples[r] - camera[_SAMPLE], lines[r] - camera[_LINE]
        sx, sy, lx, ly = camera[_SAMPLE + 1], camera[_SAMPLE + 2], camera[_LINE + 1], camera[_LINE + 2]
        mx = (ly * ds - sy * dl) / (sx * ly - sy * lx) - camera[_POINT]
        my = (sx * dl - lx * ds) / (sx * ly - sy * lx) - camera[_POINT + 1]
        _through_lens(camera, mx, my, False, lens)
        x, y, f = lens[0], lens[1], camera[_FOCAL]
        length = np.sqrt(x * x + y * y + f * f)
        for k in range(3):
            out[r, k] = (x * camera[_ROTATION + k] + y * camera[_ROTATION + 3 + k] + f * camera[_SIGHT + k]) / length
    return out


class FrameSensor:
    """The frame sensor (see the module for the model and the order of parameters)."""

    name = "frame"
    unit = "pixel"
    parameters: tuple[Parameter, ...] = (
        Parameter("position in track", "m", "position", 6.0, shared=True),
        Parameter("position cross track", "m", "position", 10.0, shared=True),
        Parameter("position radial", "m", "position", 4.0, shared=True),
        Parameter("attitude alpha", "rad", "attitude", 15e-6, shared=True),
        Parameter("attitude beta", "rad", "attitude", 15e-6, shared=True),
        Parameter("attitude kappa", "rad", "attitude", 100e-6, shared=True),
        Parameter("focal length", "mm", "focal length", 0.3, shared=True),
    )
    """Sigmas are those of the 2008 MIN paper, Table 1, blocks 1 to 4, for a focal length of 3 m; state your own in ``priors.json``."""

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        """Packed camera (40,) of a description.

        ===================  =========================================================================================
        ``position``         geocentric metres
        ``rotation``         from body-fixed to camera axes: 3 x 3, or a quaternion with the scalar first
        ``looks_along``      ``+z`` (default) or ``-z``: the camera axis that points at the ground
        ``focal_length``     millimetres
        ``principal_point``  x and y in the focal plane, millimetres; default 0, 0
        ``mm_to_pixel``      2 x 3: sample at focal-plane coordinates (0, 0), and by millimetre of x and of y; likewise line
        ``distortion``       optional: ``radial`` (k1, k2, k3), ``decentering`` (j1, j2, phi), and ``direction``, one of `DIRECTIONS`
        ``velocity``         optional: direction of flight in body-fixed axes, of any length
        ``axes``             optional, instead: unit vectors in track, cross track and radial, in rows
        ``height``           of mean ground, metres above the ellipsoid
        ===================  =========================================================================================

        Radial is away from the centre of the body, cross track completes a right-handed triad in track, cross track, radial. Without
        velocity and axes, in track is where the top of the image points, or the camera looks when that is nearer to the horizon.

        Raises
        ------
        InputError
            When a value is missing, not finite or of the wrong shape, a rotation is none, the lens distortion is not one-to-one over
            the image, or the camera is at the centre of the body.
        """
        packed = np.empty(PACKED)
        position = _numbers(camera, "position", (3,), "geocentric metres")
        if not np.linalg.norm(position) > 0.0:
            raise InputError("frame: position is the centre of the body; expected geocentric metres")
        rotation = _rotation(camera)
        sight = camera.get("looks_along", "+z")
        if sight not in ("+z", "-z"):
            raise InputError(f"frame: looks_along is {sight!r}; expected '+z' or '-z', the camera axis that points at the ground")
        rotation[2] *= 1.0 if sight == "+z" else -1.0
        to_pixel = _numbers(camera, "mm_to_pixel", (2, 3), "sample and line, each at the origin and by mm of x and y")
        if abs(np.linalg.det(to_pixel[:, 1:])) <= 1e-12 * np.abs(to_pixel[:, 1:]).max() ** 2:
            raise InputError(f"frame: mm_to_pixel is {to_pixel.tolist()}; expected x and y of the focal plane to go different ways")
        packed[_POSITION:_ROTATION], packed[_ROTATION:_AXES] = position, rotation.ravel()
        packed[_AXES:_FOCAL] = _axes(camera, position, rotation, to_pixel).ravel()
        packed[_FOCAL] = _numbers(camera, "focal_length", (), "millimetres")
        if not packed[_FOCAL] > 0.0:
            raise InputError(f"frame: focal_length is {packed[_FOCAL]:g}; expected a positive number of millimetres")
        packed[_POINT:_RADIAL] = _numbers(camera, "principal_point", (2,), "x and y, millimetres", default=(0.0, 0.0))
        packed[_SAMPLE:_HEIGHT] = to_pixel.ravel()
        packed[_HEIGHT] = _numbers(camera, "height", (), "metres above the ellipsoid")
        if not (width > 0 and height > 0 and np.isfinite([width, height]).all()):
            raise InputError(f"frame: image size is {width} x {height}; expected positive numbers of pixels")
        _pack_lens(camera.get("distortion"), packed)
        _check_field(packed, width, height)
        return packed

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """See `Sensor.project`."""
        return Projection(*_project(cameras, parameters, ground.geocentric, image, point))

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """See `Sensor.localise`."""
        return meet(cameras[image, _POSITION:_ROTATION], _directions(cameras, image, samples, lines), heights, ellipsoid)

    def mean_height(self, cameras: Array) -> Array:
        """The height of mean ground that each description states."""
        return cameras[:, _HEIGHT]


def _numbers(camera: Mapping[str, Any], name: str, shape: tuple[int, ...], what: str, default: tuple[float, ...] | None = None) -> Array:
    expected = f"{'one number' if not shape else ' x '.join(map(str, shape)) + ' numbers'} ({what})"
    if name not in camera and default is None:
        raise InputError(f"frame: {name} is missing; expected {expected}")
    value = camera.get(name, default)
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"frame: {name} is {value!r}; expected {expected}") from None
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise InputError(f"frame: {name} is {value!r}; expected {expected}, all finite")
    return numbers


def _rotation(camera: Mapping[str, Any]) -> Array:
    """Rotation (3, 3) from body-fixed to camera axes, of a matrix or a quaternion."""
    if np.shape(camera.get("rotation", ())) == (4,):
        q = _numbers(camera, "rotation", (4,), "quaternion, scalar first")
        if abs(np.linalg.norm(q) - 1.0) > ORTHONORMAL:
            raise InputError(f"frame: rotation is a quaternion of length {np.linalg.norm(q):.6g}; expected a unit quaternion, scalar first")
        return quaternion_rotation(q)
    return _orthonormal(_numbers(camera, "rotation", (3, 3), "body-fixed to camera, or 4 of a quaternion"), "rotation")


def quaternion_rotation(quaternion: Array) -> Array:
    """Rotation matrix (3, 3) of a quaternion (4,), scalar first, that turns coordinates as SPICE's quaternions do: ``v' = q v q*``.

    Examples
    --------
    >>> quaternion_rotation(np.array([1.0, 0.0, 0.0, 1.0])).round(3).tolist()  # a quarter turn about z
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array([
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ])  # fmt: skip


def _orthonormal(matrix: Array, name: str) -> Array:
    """The rotation nearest to a matrix that is one but for its last digits."""
    left, stretch, right = np.linalg.svd(matrix)
    if np.abs(stretch - 1.0).max() > ORTHONORMAL or np.linalg.det(matrix) < 0.0:
        raise InputError(
            f"frame: {name} has determinant {np.linalg.det(matrix):.6g} and stretches by {stretch[-1]:.6g} to {stretch[0]:.6g}; "
            "expected three rows that are unit vectors at right angles, right-handed"
        )
    return np.asarray(left @ right)


def _axes(camera: Mapping[str, Any], position: Array, rotation: Array, to_pixel: Array) -> Array:
    """Unit vectors (3, 3) in track, cross track and radial, in rows."""
    if "axes" in camera:
        return _orthonormal(_numbers(camera, "axes", (3, 3), "unit vectors in track, cross track, radial, in rows"), "axes")
    radial = position / np.linalg.norm(position)
    if "velocity" in camera:
        ahead = _numbers(camera, "velocity", (3,), "direction of flight, geocentric")
    else:
        up_the_image = np.linalg.solve(to_pixel[:, 1:], np.array([0.0, -1.0])) @ rotation[:2]
        tops = (up_the_image / np.linalg.norm(up_the_image), rotation[2])
        ahead = min(tops, key=lambda axis: abs(axis @ radial))
    in_track = ahead - (ahead @ radial) * radial
    if not np.linalg.norm(in_track) > ORTHONORMAL * np.linalg.norm(ahead):
        raise InputError(f"frame: velocity is {ahead.tolist()}, straight up or down; expected a direction of flight, or 'axes'")
    in_track /= np.linalg.norm(in_track)
    return np.stack([in_track, np.cross(radial, in_track), radial])


def _pack_lens(distortion: Any, packed: Array) -> None:
    """Enter the distortion: radial and decentering coefficients, direction, and the squared radius within which it is one-to-one."""
    packed[_RADIAL:_TO_MEASURED], packed[_TO_MEASURED], packed[_REACH2] = 0.0, 1.0, np.inf
    if distortion is None:
        return
    if not isinstance(distortion, Mapping):
        raise InputError(f"frame: distortion is {distortion!r}; expected an object with radial, decentering and direction")
    direction = distortion.get("direction")
    if direction not in DIRECTIONS:
        raise InputError(f"frame: direction of the distortion is {direction!r}; expected {' or '.join(map(repr, DIRECTIONS))}")
    k = _numbers(distortion, "radial", (3,), "k1, k2, k3: mm^-2, mm^-4, mm^-6", default=(0.0, 0.0, 0.0))
    j1, j2, phi = _numbers(distortion, "decentering", (3,), "j1, j2: mm^-1, mm^-3; phi: radians", default=(0.0, 0.0, 0.0))
    packed[_RADIAL:_DECENTERING] = k
    packed[_DECENTERING:_TO_MEASURED] = -j1 * np.sin(phi), j1 * np.cos(phi), -j2 * np.sin(phi), j2 * np.cos(phi)
    packed[_TO_MEASURED] = float(direction == "ideal to measured")
    # r (1 + k1 r^2 + k2 r^4 + k3 r^6) grows until its derivative is zero
    turning = np.roots(np.array([7.0, 5.0, 3.0, 1.0]) * [*k[::-1], 1.0])
    real = turning[(np.abs(turning.imag) <= 1e-9 * np.abs(turning)) & (turning.real > 0.0)].real
    packed[_REACH2] = real.min(initial=np.inf)


def _check_field(packed: Array, width: float, height: float) -> None:
    """Refuse a distortion that is not one-to-one over the image."""
    corners = np.array([(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)])
    seen = _directions(packed[None], np.zeros(4, dtype=np.int32), corners[:, 0].copy(), corners[:, 1].copy())
    if not np.isfinite(seen).all():
        s, t = corners[int(np.argmin(np.isfinite(seen).all(axis=1)))]
        raise InputError(
            f"frame: the lens distortion is not one-to-one at the corner of the image (sample {s:g}, line {t:g}); "
            "expected coefficients for millimetres from the principal point, and mm_to_pixel that matches the size of the image"
        )


__all__ = ["DIRECTIONS", "FrameSensor", "quaternion_rotation"]
