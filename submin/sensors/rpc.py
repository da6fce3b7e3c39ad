"""Rational polynomial cameras (RPC00B) with a correction in image space: shift and affine drift.

A ground point is normalised, ``L = (longitude - lon_off) / lon_scale`` and likewise ``P`` (latitude) and ``H`` (height), and projected by

    sample_rpc = samp_off + samp_scale * p1(L, P, H) / p2(L, P, H)        line_rpc = line_off + line_scale * p3 / p4

with cubic polynomials in the RPC00B order of terms: 1, L, P, H, LP, LH, PH, LL, PP, HH, PLH, LLL, LPP, LHH, LLP, PPP, PHH, LLH, PPH, HHH
(STDI-0002, appendix E). The six adjustable parameters ``a0 a1 a2 b0 b1 b2``, in pixels, act on image coordinates scaled to -1..1 over the
image, ``s = (sample_rpc - centre) / half width`` and ``l`` likewise:

    sample = sample_rpc + a0 + a1 s + a2 l                                line = line_rpc + b0 + b1 s + b2 l

In an adjustment s and l are those of the *measured* coordinates: the correction is then linear in its parameters and the same wherever the
point is linearised. Taken at the predicted coordinates they would move with the datum, and cells linearised at different datums would
seem to know it.

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
from submin.sensors.base import Array, Ground, Index, Parameter, Projection

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


@numba.njit(cache=True, error_model="numpy")
def _ratio(num: Array, den: Array, lon: float, lat: float, h: float, out: Array) -> None:
    """Value and partials (4,) of num/den with respect to normalised longitude, latitude, height."""
    for k, c in enumerate((num, den)):
        value = (
            c[0] + lon * (c[1] + lat * (c[4] + h * c[10]) + h * c[5] + lon * (c[7] + lon * c[11] + lat * c[14] + h * c[17]))
            + lat * (c[2] + h * c[6] + lat * (c[8] + lon * c[12] + lat * c[15] + h * c[18]) + h * h * c[16])
            + h * (c[3] + h * (c[9] + lon * c[13] + h * c[19]))
        )  # fmt: skip
        by_lon = (
            c[1] + lat * (c[4] + h * c[10] + lat * c[12]) + h * (c[5] + h * c[13])
            + lon * (2.0 * (c[7] + lat * c[14] + h * c[17]) + 3.0 * lon * c[11])
        )  # fmt: skip
        by_lat = (
            c[2] + lon * (c[4] + h * c[10] + lon * c[14]) + h * (c[6] + h * c[16])
            + lat * (2.0 * (c[8] + lon * c[12] + h * c[18]) + 3.0 * lat * c[15])
        )  # fmt: skip
        by_h = (
            c[3] + lon * (c[5] + lat * c[10] + lon * c[17]) + lat * (c[6] + lat * c[18])
            + h * (2.0 * (c[9] + lon * c[13] + lat * c[16]) + 3.0 * h * c[19])
        )  # fmt: skip
        if k == 0:
            out[0], out[1], out[2], out[3] = value, by_lon, by_lat, by_h
        else:
            ratio = out[0] / value
            out[0] = ratio
            out[1] = (out[1] - ratio * by_lon) / value
            out[2] = (out[2] - ratio * by_lat) / value
            out[3] = (out[3] - ratio * by_h) / value


@numba.njit(cache=True, error_model="numpy")
def _raw(camera: Array, geodetic: Array, sample: Array, line: Array) -> None:
    """Unadjusted sample and line and their partials by longitude, latitude (per degree) and height (per metre): two rows of 4."""
    dlon = geodetic[0] - camera[_LON_OFF]
    dlon -= 360.0 * np.floor((dlon + 180.0) / 360.0)
    lon = dlon / camera[_LON_SC]
    lat = (geodetic[1] - camera[_LAT_OFF]) / camera[_LAT_SC]
    h = (geodetic[2] - camera[_H_OFF]) / camera[_H_SC]
    c = _COEFFICIENTS
    _ratio(camera[c : c + 20], camera[c + 20 : c + 40], lon, lat, h, line)
    _ratio(camera[c + 40 : c + 60], camera[c + 60 : c + 80], lon, lat, h, sample)
    for out, offset, scale in ((line, camera[_LINE_OFF], camera[_LINE_SC]), (sample, camera[_SAMP_OFF], camera[_SAMP_SC])):
        out[0] = offset + scale * out[0]
        out[1] *= scale / camera[_LON_SC]
        out[2] *= scale / camera[_LAT_SC]
        out[3] *= scale / camera[_H_SC]


@numba.njit(cache=True, error_model="numpy")
def _project(
    cameras: Array, parameters: Array, geodetic: Array, jacobian: Array, image: Index, point: Index, at: Array
) -> tuple[Array, Array, Array]:
    rays = len(image)
    predicted = np.empty((rays, 2))
    by_ground = np.empty((rays, 2, 3))
    by_parameters = np.zeros((rays, 2, 6))
    sample, line = np.empty(4), np.empty(4)
    for r in range(rays):
        camera, theta, j = cameras[image[r]], parameters[image[r]], point[r]
        _raw(camera, geodetic[j], sample, line)
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


@numba.njit(cache=True, error_model="numpy")
def _localise(cameras: Array, image: Index, samples: Array, lines: Array, heights: Array) -> Array:
    ground = np.empty((len(image), 3))
    sample, line = np.empty(4), np.empty(4)
    for r in range(len(image)):
        camera, g = cameras[image[r]], ground[r]
        g[0], g[1], g[2] = camera[_LON_OFF], camera[_LAT_OFF], heights[r]
        converged = False
        for _ in range(30):
            _raw(camera, g, sample, line)
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
        Parameter(f"{axis} {name}", "px", group, sigma, shared)
        for axis in ("sample", "line")
        for name, group, sigma, shared in (
            ("bias", "bias", 10.0, True),
            ("drift along samples", "drift along samples", 1.0, False),
            ("drift along lines", "drift along lines", 1.0, False),
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
            start = _COEFFICIENTS + TERMS * k
            packed[start : start + TERMS] = _coefficients(camera, name)
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

    def mean_height(self, cameras: Array) -> Array:
        """The height offset of each RPC."""
        return cameras[:, _H_OFF]


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
