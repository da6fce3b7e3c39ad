"""The description of a pushbroom camera as a packed row of numbers: a header, then tables of line times, positions and attitudes.

Times in the row are seconds after mid scan. Samples of attitude get rates with them, so that what is between two samples is known from
those two alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from submin.errors import InputError
from submin.sensors.base import Array

MARGIN = 0.25
"""Part of the image's size by which a point may lie outside of it on each side: approximate points of an adjustment do."""
MARGIN_PIXELS = 2000.0
SPEED_OF_LIGHT = 299792458.0
FARTHEST_ATTITUDES = 0.5
"""Radians between neighbouring attitude samples; further apart, a cubic says nothing precise about what is between."""
FINEST_LINE = 1e-7
"""Lines that a time must resolve in float64."""

FOCAL, ORIGIN_X, ORIGIN_Y, STEP_X, STEP_Y, PITCH = range(6)
FIRST_TIME, LAST_TIME, LEAST_SAMPLE, MOST_SAMPLE = range(6, 10)
PER_LIGHT, ROTATION, ZENITH_PATH, SCALE_HEIGHT, MEAN_HEIGHT = range(10, 15)
LINES, POSITIONS, ATTITUDES = 15, 16, 17
TABLES = 18
LINE_ROW, POSITION_ROW, ATTITUDE_ROW = 2, 7, 9
"""Numbers in a row of each table: time and line; time, position and velocity; time, quaternion and its rate."""


def packed_camera(camera: Mapping[str, Any], width: float, height: float) -> Array:
    """Packed row of a description; see `submin.sensors.pushbroom.PushbroomSensor` for what that holds.

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

    header = np.empty(TABLES)
    origin, step = _array(camera, "detector", "origin", (2,)), _array(camera, "detector", "step", (2,))
    header[FOCAL] = _positive(camera, "focal_length")
    header[ORIGIN_X:STEP_X], header[STEP_X:PITCH] = origin, step
    header[PITCH] = np.hypot(*step)
    if not header[PITCH] > 0.0:
        raise InputError("pushbroom: detector, step is 0, 0; expected the way from one sample to the next, in millimetres")
    header[FIRST_TIME] = max(earliest, times[0], turns[0]) - middle
    header[LAST_TIME] = min(latest, times[-1], turns[-1]) - middle
    header[LEAST_SAMPLE], header[MOST_SAMPLE] = -reach_samples, width - 1.0 + reach_samples
    aberration, refraction = camera.get("aberration") is not None, camera.get("refraction") is not None
    header[PER_LIGHT] = 1.0 / SPEED_OF_LIGHT if aberration else 0.0
    header[ROTATION] = _array(camera, "aberration", "rotation_rate", ()) if aberration else 0.0
    header[ZENITH_PATH] = _array(camera, "refraction", "zenith_path", ()) if refraction else 0.0
    header[SCALE_HEIGHT] = _positive(camera["refraction"], "scale_height", "refraction, ") if refraction else np.inf
    header[MEAN_HEIGHT] = _array(camera, "", "mean_height", ())
    header[LINES], header[POSITIONS], header[ATTITUDES] = len(lines), len(times), len(turns)
    quaternions = _continuous(quaternions)
    tables = (
        np.column_stack([line_times - middle, lines]),
        np.column_stack([times - middle, positions, velocities]),
        np.column_stack([turns - middle, quaternions, _rates(turns - middle, quaternions)]),
    )
    return np.concatenate([header, *(table.ravel() for table in tables)])


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
