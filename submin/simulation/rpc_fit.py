"""Rational polynomial cameras (RPC00B) fitted to any ground-to-image function.

With the constant of each denominator fixed to 1, ``num(x) / den(x) = y`` becomes linear in the other 39 coefficients,
``num(x) - y (den(x) - 1) = y`` (the "direct" solution of Tao and Hu, 2001, PE&RS 67(12), terrain-independent form). Cameras of narrow view
do not need most of these coefficients, so the equations are nearly singular, and a small ridge draws what the grid cannot tell towards
zero, denominators towards 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError, NumericalError

Array = NDArray[np.float64]

RIDGE = 1e-9
"""Weight of the ridge relative to one grid node: a coefficient near 1 loses some 1e-9 of itself, far below a thousandth of a pixel."""

GRID = (12, 12, 5)
"""Nodes of the fitting grid in longitude, latitude and height."""


def fit_rpc(
    project: Callable[[Array], Array],
    longitude_range: tuple[float, float],
    latitude_range: tuple[float, float],
    height_range: tuple[float, float],
    *,
    grid: tuple[int, int, int] = GRID,
    ridge: float = RIDGE,
) -> tuple[dict[str, Any], float]:
    """RPC of a ground-to-image function over a box of longitude, latitude and height, and the RMS of the fit.

    Parameters
    ----------
    project : callable
        Maps geodetic coordinates (n, 3), degrees, degrees, metres, to sample and line (n, 2) in pixels, centre of the first pixel (0, 0).
    longitude_range, latitude_range, height_range : (float, float)
        Smallest and largest value of the box, degrees, degrees and metres. Across the antimeridian let the longitudes run on beyond 180.
    grid : (int, int, int)
        Nodes in longitude, latitude and height; at least 4 each, for a cubic.
    ridge : float
        Weight of the regularisation (see `RIDGE`).

    Returns
    -------
    camera : dict
        GDAL's names as `submin.sensors.rpc.RpcSensor.pack` takes them (numbers, lists of 20 coefficients), and ``origin`` (0, 0).
    rms_px : float
        Root mean square of the misfit at the grid, pixels, per coordinate: ``sqrt(sum(ds^2 + dl^2) / 2n)``.

    Raises
    ------
    InputError
        When a range is not increasing, the grid is too coarse, or ``project`` gives something that is not finite or of the wrong shape.
    NumericalError
        When a fitted denominator passes through zero inside the box: the function is not one that an RPC can follow.

    Examples
    --------
    >>> camera, rms_px = fit_rpc(lambda g: 1000.0 * g[:, :2] + 0.1 * g[:, 2:], (10.0, 10.5), (50.0, 50.5), (0.0, 500.0))
    >>> rms_px < 1e-3, camera["LONG_OFF"], camera["HEIGHT_SCALE"]
    (True, 10.25, 250.0)
    """
    ranges = {"longitude_range": longitude_range, "latitude_range": latitude_range, "height_range": height_range}
    for name, (low, high) in ranges.items():
        if not (np.isfinite([low, high]).all() and low < high):
            raise InputError(f"RPC fit: {name} is ({low}, {high}); expected two increasing finite numbers")
    if min(grid) < 4:
        raise InputError(f"RPC fit: grid is {grid}; expected at least 4 nodes in each direction")

    box = np.array(list(ranges.values()), dtype=np.float64)
    ground_offset, ground_scale = box.mean(axis=1), 0.5 * (box[:, 1] - box[:, 0])
    normalised = np.stack(np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in grid), indexing="ij"), axis=-1).reshape(-1, 3)
    geodetic = ground_offset + ground_scale * normalised
    image = _checked_image(project(geodetic), geodetic)

    low, high = image.min(axis=0), image.max(axis=0)
    image_offset, image_scale = 0.5 * (low + high), 0.5 * (high - low)
    if not (image_scale > 0.0).all():
        raise InputError("RPC fit: sample or line is the same all over the box; expected a camera that resolves the ground")
    terms = cubic_terms(normalised)
    ratios = [_fit_ratio(terms, (image[:, k] - image_offset[k]) / image_scale[k], ridge) for k in range(2)]

    fitted = np.stack([terms @ num / (terms @ den) for num, den in ratios], axis=1)
    misfit = image_offset + image_scale * fitted - image
    (sample_num, sample_den), (line_num, line_den) = ratios
    camera = {
        "LINE_OFF": float(image_offset[1]), "SAMP_OFF": float(image_offset[0]),
        "LAT_OFF": float(ground_offset[1]), "LONG_OFF": float(ground_offset[0]), "HEIGHT_OFF": float(ground_offset[2]),
        "LINE_SCALE": float(image_scale[1]), "SAMP_SCALE": float(image_scale[0]),
        "LAT_SCALE": float(ground_scale[1]), "LONG_SCALE": float(ground_scale[0]), "HEIGHT_SCALE": float(ground_scale[2]),
        "LINE_NUM_COEFF": line_num.tolist(), "LINE_DEN_COEFF": line_den.tolist(),
        "SAMP_NUM_COEFF": sample_num.tolist(), "SAMP_DEN_COEFF": sample_den.tolist(),
        "origin": [0.0, 0.0],
    }  # fmt: skip
    return camera, float(np.sqrt(np.mean(misfit**2)))


def cubic_terms(normalised: Array) -> Array:
    """The twenty RPC00B terms (n, 20) of normalised longitude, latitude and height (n, 3), in the order of STDI-0002, appendix E."""
    lon, lat, h = normalised.T
    return np.stack(
        [
            np.ones_like(lon), lon, lat, h, lon * lat, lon * h, lat * h, lon**2, lat**2, h**2,
            lat * lon * h, lon**3, lon * lat**2, lon * h**2, lon**2 * lat, lat**3, lat * h**2, lon**2 * h, lat**2 * h, h**3,
        ],
        axis=1,
    )  # fmt: skip


def _fit_ratio(terms: Array, value: Array, ridge: float) -> tuple[Array, Array]:
    """Coefficients (20,) of numerator and denominator that follow ``value`` (n,), itself scaled to -1..1."""
    design = np.concatenate([terms, -value[:, None] * terms[:, 1:]], axis=1)
    unknowns = design.shape[1]
    # The ridge as further rows of one orthogonal factorisation: normal equations would square a condition number of 1e5.
    rows = np.concatenate([design, np.sqrt(ridge * len(value)) * np.eye(unknowns)])
    q, r = np.linalg.qr(rows)
    solution = np.linalg.solve(r, q[: len(value)].T @ value)
    numerator, denominator = solution[:20], np.concatenate([[1.0], solution[20:]])
    if not (terms @ denominator > 0.0).all():
        raise NumericalError("RPC fit: a denominator passes through zero in the box; fit a smaller box or raise the ridge")
    return numerator, denominator


def _checked_image(image: Array, geodetic: Array) -> Array:
    image = np.asarray(image, dtype=np.float64)
    if image.shape != (len(geodetic), 2):
        raise InputError(f"RPC fit: project gave an array of shape {image.shape}; expected {(len(geodetic), 2)}, sample and line a row")
    bad = ~np.isfinite(image).all(axis=1)
    if bad.any():
        lon, lat, height = geodetic[int(np.argmax(bad))]
        raise InputError(
            f"RPC fit: project gave no finite sample and line at longitude {lon:g}, latitude {lat:g}, height {height:g}; "
            "expected the camera to see the whole box"
        )
    return image
