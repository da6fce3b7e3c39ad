"""Rational polynomial cameras (RPC00B) with a correction in image space: shift and affine drift.

A ground point is normalised, ``L = (longitude - lon_off) / lon_scale`` and likewise ``P`` (latitude) and ``H`` (height), and projected by

    sample_rpc = samp_off + samp_scale * p1(L, P, H) / p2(L, P, H)        line_rpc = line_off + line_scale * p3 / p4

with cubic polynomials in the RPC00B order of terms: 1, L, P, H, LP, LH, PH, LL, PP, HH, PLH, LLL, LPP, LHH, LLP, PPP, PHH, LLH, PPH, HHH
(STDI-0002, appendix E). The six adjustable parameters ``a0 a1 a2 b0 b1 b2``, in pixels, act on image coordinates scaled to -1..1 over the
image, ``s = (sample_rpc - centre) / half width`` and ``l`` likewise:

    sample = sample_rpc + a0 + a1 s + a2 l                                line = line_rpc + b0 + b1 s + b2 l

In an adjustment s and l are those of the *fitted* coordinates, the measured ones less their residual: the correction is then linear in its
parameters. With the coordinates that the unadjusted camera predicts they would move with the datum, and cells linearised at different
datums would seem to know it (docs/decisions/005). With measured ones their errors would add up, and make images a little too large and a
network too small (docs/decisions/018).

The centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.geodesy import Ellipsoid
from submin.sensors.base import Array, Drift, Ground, Index, Parameter, Projection

SCALARS = (
    "LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF",
    "LINE_SCALE", "SAMP_SCALE", "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE",
)  # fmt: skip
POLYNOMIALS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
TERMS = 20

_LINE_OFF, _SAMP_OFF, _LAT_OFF, _LON_OFF, _H_OFF, _LINE_SC, _SAMP_SC, _LAT_SC, _LON_SC, _H_SC = range(10)
_COEFFICIENTS = 10
_CENTRE_SAMPLE, _CENTRE_LINE, _HALF_WIDTH, _HALF_HEIGHT = range(90, 94)
PACKED = 94

LOCALISED_PIXELS = 1e-6
"""Far below any measurement, and far above the spacing of longitudes in float64 (a few 1e-9 pixels)."""


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _raw(camera: Array, geodetic: Array, terms: Array, sums: Array, sample: Array, line: Array) -> None:
    """Unadjusted sample and line and their partials by longitude, latitude (per degree) and height (per metre): two rows of 4.

    ``terms`` (4, 20) and ``sums`` (4, 4) are work space: the terms of a cubic polynomial and their partials, and what they come to in each
    of the four polynomials. These are worked on side by side, their sums in registers: one instruction takes all four.
    """
    dlon = geodetic[0] - camera[_LON_OFF]
    dlon -= 360.0 * np.floor((dlon + 180.0) / 360.0)
    lon = dlon / camera[_LON_SC]
    lat = (geodetic[1] - camera[_LAT_OFF]) / camera[_LAT_SC]
    h = (geodetic[2] - camera[_H_OFF]) / camera[_H_SC]
    _terms(lon, lat, h, terms)
    v0 = v1 = v2 = v3 = x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = z0 = z1 = z2 = z3 = 0.0
    for t in range(TERMS):
        c = _COEFFICIENTS + 4 * t
        c0, c1, c2, c3 = camera[c], camera[c + 1], camera[c + 2], camera[c + 3]
        v, x, y, z = terms[0, t], terms[1, t], terms[2, t], terms[3, t]
        v0, v1, v2, v3 = v0 + v * c0, v1 + v * c1, v2 + v * c2, v3 + v * c3
        x0, x1, x2, x3 = x0 + x * c0, x1 + x * c1, x2 + x * c2, x3 + x * c3
        y0, y1, y2, y3 = y0 + y * c0, y1 + y * c1, y2 + y * c2, y3 + y * c3
        z0, z1, z2, z3 = z0 + z * c0, z1 + z * c1, z2 + z * c2, z3 + z * c3
    sums[0, 0], sums[0, 1], sums[0, 2], sums[0, 3] = v0, v1, v2, v3
    sums[1, 0], sums[1, 1], sums[1, 2], sums[1, 3] = x0, x1, x2, x3
    sums[2, 0], sums[2, 1], sums[2, 2], sums[2, 3] = y0, y1, y2, y3
    sums[3, 0], sums[3, 1], sums[3, 2], sums[3, 3] = z0, z1, z2, z3
    for out, offset, scale, k in ((line, camera[_LINE_OFF], camera[_LINE_SC], 0), (sample, camera[_SAMP_OFF], camera[_SAMP_SC], 2)):
        part = scale / sums[0, k + 1]
        ratio = sums[0, k] / sums[0, k + 1]
        out[0] = offset + scale * ratio
        out[1] = (sums[1, k] - ratio * sums[1, k + 1]) * part / camera[_LON_SC]
        out[2] = (sums[2, k] - ratio * sums[2, k + 1]) * part / camera[_LAT_SC]
        out[3] = (sums[3, k] - ratio * sums[3, k + 1]) * part / camera[_H_SC]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _terms(lon: float, lat: float, h: float, t: Array) -> None:
    """Terms of a cubic polynomial in RPC00B order, and their partials by longitude, latitude and height (4, 20); zeros stay zero."""
    ll, pp, hh = lon * lon, lat * lat, h * h
    t[0, 0], t[0, 1], t[0, 2], t[0, 3], t[0, 4] = 1.0, lon, lat, h, lon * lat
    t[0, 5], t[0, 6], t[0, 7], t[0, 8], t[0, 9] = lon * h, lat * h, ll, pp, hh
    t[0, 10], t[0, 11], t[0, 12], t[0, 13], t[0, 14] = lon * lat * h, ll * lon, lon * pp, lon * hh, ll * lat
    t[0, 15], t[0, 16], t[0, 17], t[0, 18], t[0, 19] = pp * lat, lat * hh, ll * h, pp * h, hh * h
    t[1, 1], t[1, 4], t[1, 5], t[1, 7], t[1, 10] = 1.0, lat, h, 2.0 * lon, lat * h
    t[1, 11], t[1, 12], t[1, 13], t[1, 14], t[1, 17] = 3.0 * ll, pp, hh, 2.0 * lon * lat, 2.0 * lon * h
    t[2, 2], t[2, 4], t[2, 6], t[2, 8], t[2, 10] = 1.0, lon, h, 2.0 * lat, lon * h
    t[2, 12], t[2, 14], t[2, 15], t[2, 16], t[2, 18] = 2.0 * lon * lat, ll, 3.0 * pp, hh, 2.0 * lat * h
    t[3, 3], t[3, 5], t[3, 6], t[3, 9], t[3, 10] = 1.0, lon, lat, 2.0 * h, lon * lat
    t[3, 13], t[3, 16], t[3, 17], t[3, 18], t[3, 19] = 2.0 * lon * h, 2.0 * lat * h, ll, pp, 3.0 * hh


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(
    cameras: Array, parameters: Array, geodetic: Array, jacobian: Array, image: Index, point: Index, at: Array
) -> tuple[Array, Array, Array]:
    rays = len(image)
    predicted = np.empty((rays, 2))
    by_ground = np.empty((rays, 2, 3))
    by_parameters = np.zeros((rays, 2, 6))
    sample, line, terms, sums = np.empty(4), np.empty(4), np.zeros((4, TERMS)), np.empty((4, 4))
    for r in range(rays):
        camera, theta, j = cameras[image[r]], parameters[image[r]], point[r]
        _raw(camera, geodetic[j], terms, sums, sample, line)
        fixed = len(at) > 0
        s = ((at[r, 0] if fixed else sample[0]) - camera[_CENTRE_SAMPLE]) / camera[_HALF_WIDTH]
        t = ((at[r, 1] if fixed else line[0]) - camera[_CENTRE_LINE]) / camera[_HALF_HEIGHT]
        predicted[r, 0] = sample[0] + theta[0] + theta[1] * s + theta[2] * t
        predicted[r, 1] = line[0] + theta[3] + theta[4] * s + theta[5] * t
        ss, st = 1.0 + theta[1] / camera[_HALF_WIDTH], theta[2] / camera[_HALF_HEIGHT]
        ts, tt = theta[4] / camera[_HALF_WIDTH], 1.0 + theta[5] / camera[_HALF_HEIGHT]
        if fixed:
            ss, st, ts, tt = 1.0, 0.0, 0.0, 1.0
        for k in range(3):
            ds = sample[1] * jacobian[j, 0, k] + sample[2] * jacobian[j, 1, k] + sample[3] * jacobian[j, 2, k]
            dt = line[1] * jacobian[j, 0, k] + line[2] * jacobian[j, 1, k] + line[3] * jacobian[j, 2, k]
            by_ground[r, 0, k] = ss * ds + st * dt
            by_ground[r, 1, k] = ts * ds + tt * dt
        by_parameters[r, 0, 0] = by_parameters[r, 1, 3] = 1.0
        by_parameters[r, 0, 1] = by_parameters[r, 1, 4] = s
        by_parameters[r, 0, 2] = by_parameters[r, 1, 5] = t
    return predicted, by_ground, by_parameters


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _localise(cameras: Array, image: Index, samples: Array, lines: Array, heights: Array) -> Array:
    ground = np.empty((len(image), 3))
    sample, line, terms, sums = np.empty(4), np.empty(4), np.zeros((4, TERMS)), np.empty((4, 4))
    for r in range(len(image)):
        camera, g = cameras[image[r]], ground[r]
        g[0], g[1], g[2] = camera[_LON_OFF], camera[_LAT_OFF], heights[r]
        converged = False
        for _ in range(30):
            _raw(camera, g, terms, sums, sample, line)
            es, el = samples[r] - sample[0], lines[r] - line[0]
            if abs(es) < LOCALISED_PIXELS and abs(el) < LOCALISED_PIXELS:
                converged = True
                break
            determinant = sample[1] * line[2] - sample[2] * line[1]
            g[0] += (line[2] * es - sample[2] * el) / determinant
            g[1] += (sample[1] * el - line[1] * es) / determinant
        if not converged:
            g[0] = g[1] = np.nan
    return ground


class RpcSensor:
    """The RPC sensor with shift and affine drift in image space (see the module for the model and the order of parameters)."""

    name = "rpc"
    unit = "pixel"
    parameters: tuple[Parameter, ...] = tuple(
        Parameter(f"{axis} {name}", "px", group, sigma, shared, drift)
        for of, axis in ((0, "sample"), (3, "line"))
        for name, group, sigma, shared, drift in (
            ("bias", "bias", 10.0, True, None),
            ("drift along samples", "drift along samples", 1.0, False, Drift(of, 0)),
            ("drift along lines", "drift along lines", 1.0, False, Drift(of, 1)),
        )
    )

    def pack(self, camera: Mapping[str, Any], width: float, height: float) -> Array:
        """Packed camera (94,) of a description: GDAL's RPC names, and ``origin``, the (sample, line) of the image's first pixel.

        Raises
        ------
        InputError
            When a value is missing, not finite, of the wrong length or off the globe, or a scale is not positive.
        """
        packed = np.empty(PACKED)
        for k, name in enumerate(SCALARS):
            packed[k] = _number(camera, name)
            if name.endswith("SCALE") and not packed[k] > 0.0:
                raise InputError(f"RPC: {name} is {packed[k]:g}; expected a positive number")
        longitude, latitude = packed[_LON_OFF], packed[_LAT_OFF]
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
            raise InputError(
                f"RPC: LONG_OFF, LAT_OFF are {longitude:g}, {latitude:g}; expected degrees on a globe"
                + ("; they look swapped" if abs(longitude) <= 90.0 and abs(latitude) <= 360.0 else "")
            )
        for k, name in enumerate(POLYNOMIALS):
            packed[_COEFFICIENTS + k : _COEFFICIENTS + 4 * TERMS : 4] = _coefficients(camera, name)  # term by term, four at a time
        if not (width > 0 and height > 0 and np.isfinite([width, height]).all()):
            raise InputError(f"RPC: image size is {width} x {height}; expected positive numbers of pixels")
        origin = _origin(camera)
        packed[_CENTRE_SAMPLE] = origin[0] + 0.5 * (width - 1.0)
        packed[_CENTRE_LINE] = origin[1] + 0.5 * (height - 1.0)
        packed[_HALF_WIDTH], packed[_HALF_HEIGHT] = 0.5 * width, 0.5 * height
        return packed

    def project(self, cameras: Array, parameters: Array, ground: Ground, image: Index, point: Index, at: Array | None = None) -> Projection:
        """See `Sensor.project`."""
        where = np.empty((0, 2)) if at is None else at
        return Projection(*_project(cameras, parameters, ground.geodetic, ground.jacobian, image, point, where))

    def localise(self, cameras: Array, image: Index, samples: Array, lines: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
        """See `Sensor.localise`."""
        return np.asarray(_localise(cameras, image, samples, lines, heights))

    def drift_by_pixel(self, cameras: Array) -> Array:
        """See `DriftingSensor.drift_by_pixel`: coordinates are scaled to the image."""
        return np.asarray(1.0 / cameras[:, [_HALF_WIDTH, _HALF_HEIGHT]])

    def mean_height(self, cameras: Array) -> Array:
        """The height offset of each RPC."""
        return cameras[:, _H_OFF].copy()  # contiguous, as heights of rays are: the kernel is compiled once


def image_centres(cameras: Array) -> Array:
    """Sample and line (m, 2) of the middle of each image, of packed cameras (m, 94)."""
    return cameras[:, [_CENTRE_SAMPLE, _CENTRE_LINE]]


def _number(camera: Mapping[str, Any], name: str) -> float:
    if name not in camera:
        raise InputError(f"RPC: {name} is missing; expected one number")
    try:
        value = float(camera[name])
    except (TypeError, ValueError):
        raise InputError(f"RPC: {name} is {camera[name]!r}; expected one number") from None
    if not np.isfinite(value):
        raise InputError(f"RPC: {name} is {value}; expected a finite number")
    return value


def _origin(camera: Mapping[str, Any]) -> NDArray[np.float64]:
    value = camera.get("origin", (0.0, 0.0))
    try:
        origin = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        origin = np.empty(0)
    if origin.shape != (2,) or not np.isfinite(origin).all():
        raise InputError(f"RPC: origin is {value!r}; expected the sample and line of the image's first pixel, two finite numbers")
    return origin


def _coefficients(camera: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    if name not in camera:
        raise InputError(f"RPC: {name} is missing; expected {TERMS} coefficients")
    try:
        values = np.asarray(camera[name], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"RPC: {name} holds something that is not a number; expected {TERMS} coefficients") from None
    if values.shape != (TERMS,):
        raise InputError(f"RPC: {name} has {values.size} coefficients; expected {TERMS}")
    if not np.isfinite(values).all():
        raise InputError(f"RPC: {name} holds a value that is not finite; expected {TERMS} finite coefficients")
    return values
