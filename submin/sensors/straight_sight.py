"""Where straight lines of sight meet the ground of a given height: for any sensor that sees without refraction and aberration."""

from __future__ import annotations

import numpy as np

from submin.geodesy import Ellipsoid, geocentric_to_geodetic, local_axes
from submin.sensors.base import Array

MET_METRES = 1e-7
STEPS = 20


def meet(start: Array, along: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
    """Geodetic coordinates (r, 3), degrees and metres, at which lines of sight first come down to ellipsoidal heights.

    Parameters
    ----------
    start : (r, 3), geocentric metres, above these heights
    along : (r, 3), unit vectors in body-fixed axes
    heights : (r,), metres above the ellipsoid

    Returns
    -------
    NaN where a line misses the ground, leads away from it, begins below it, or is itself NaN.
    """
    distance = _first_crossing(start, along, heights, ellipsoid)
    reached = np.isfinite(distance)
    distance, along = np.where(reached, distance, 0.0), np.where(reached[:, None], along, 0.0)
    met = np.zeros(len(start), dtype=np.bool_)
    geodetic = np.empty((len(start), 3))
    for _ in range(STEPS):
        geodetic = geocentric_to_geodetic(start + distance[:, None] * along, ellipsoid)
        above = geodetic[:, 2] - heights
        met = np.abs(above) < MET_METRES
        if met[reached].all():
            break
        fall = np.einsum("rk,rk->r", local_axes(geodetic)[:, 2], along)
        distance = distance - np.divide(above, fall, out=np.zeros_like(above), where=reached & (fall != 0.0))
    geodetic[:, 2] = heights
    geodetic[~(reached & met)] = np.nan
    return geodetic


def _first_crossing(start: Array, along: Array, heights: Array, ellipsoid: Ellipsoid) -> Array:
    """Distances (r,) at which lines from outside first meet the ellipsoid whose axes are longer by these heights; NaN where they do not."""
    radii = np.array([ellipsoid.semimajor_axis, ellipsoid.semimajor_axis, ellipsoid.semiminor_axis]) + heights[:, None]
    s, d = start / radii, along / radii
    dd, sd, ss = (np.einsum("rk,rk->r", a, b) for a, b in ((d, d), (s, d), (s, s)))
    with np.errstate(invalid="ignore"):
        distance = (-sd - np.sqrt(sd**2 - dd * (ss - 1.0))) / dd
        return np.where((distance > 0.0) & (ss > 1.0), distance, np.nan)


__all__ = ["meet"]
