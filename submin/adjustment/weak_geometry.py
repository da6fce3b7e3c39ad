"""How well the rays of a point meet: the angle between them, whatever the sensor.

A ray is the line along which a ground point can move without moving in the image: the null vector of its partials (2, 3). An observation
along one axis only (a height, the third coordinate of a surveyed point) has a plane instead; a ray meets it at the angle between the two.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays
from submin.adjustment.point_basis import Array, Offsets

WEAK_DEGREES = 3.0
"""Rays that meet at less place their point along them twenty times worse than across (1 / tan 3 degrees): reported as weak."""
UNDETERMINED_DEGREES = 0.02
"""Rays that meet at less place it three thousand times worse, kilometres for pixels of a metre: reported as not determined."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _largest_angles(first: Offsets, weight: Array, by_ground: Array) -> Array:
    """Largest angle (n,), radians, between two accepted rays of each point."""
    angles = np.full(len(first) - 1, np.nan)
    most = 1
    for j in range(len(first) - 1):
        most = max(most, first[j + 1] - first[j])
    axis, line = np.empty((most, 3)), np.empty(most, np.bool_)
    for j in range(len(first) - 1):
        n = 0
        for i in range(first[j], first[j + 1]):
            if not weight[i] > 0.0:
                continue
            b = by_ground[i]
            axis[n, 0] = b[0, 1] * b[1, 2] - b[0, 2] * b[1, 1]
            axis[n, 1] = b[0, 2] * b[1, 0] - b[0, 0] * b[1, 2]
            axis[n, 2] = b[0, 0] * b[1, 1] - b[0, 1] * b[1, 0]
            length = np.sqrt(axis[n, 0] ** 2 + axis[n, 1] ** 2 + axis[n, 2] ** 2)
            line[n] = length > 0.0
            if not line[n]:
                for c in range(3):
                    axis[n, c] = b[0, c] + b[1, c]  # one of the two rows is empty
                length = np.sqrt(axis[n, 0] ** 2 + axis[n, 1] ** 2 + axis[n, 2] ** 2)
            for c in range(3):
                axis[n, c] /= length
            for k in range(n):
                cosine = abs(axis[n, 0] * axis[k, 0] + axis[n, 1] * axis[k, 1] + axis[n, 2] * axis[k, 2])
                x = axis[n, 1] * axis[k, 2] - axis[n, 2] * axis[k, 1]
                y = axis[n, 2] * axis[k, 0] - axis[n, 0] * axis[k, 2]
                z = axis[n, 0] * axis[k, 1] - axis[n, 1] * axis[k, 0]
                sine = np.sqrt(x * x + y * y + z * z)
                if line[n] and line[k]:
                    angle = np.arctan2(sine, cosine)
                elif line[n] or line[k]:
                    angle = np.arctan2(cosine, sine)
                else:
                    continue
                if not angle <= angles[j]:
                    angles[j] = angle
            n += 1
    return angles


def convergence_angles(linear: LinearRays, weight: Array) -> Array:
    """Largest angle (n,), degrees from 0 to 90, between two accepted rays (weight (r,) above 0) of each point; NaN for one with fewer.

    Rays that run opposite ways are taken as the lines that they are.
    """
    return np.degrees(_largest_angles(linear.first, weight, linear.by_ground))


def weak_points(angles: Array) -> NDArray[np.bool_]:
    """Points (n,) whose rays meet at less than `WEAK_DEGREES`, or of which fewer than two rays are left."""
    return ~(angles >= WEAK_DEGREES)
