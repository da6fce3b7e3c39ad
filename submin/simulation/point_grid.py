"""Places of tie points all over a body: one in every field of a grid that is nearly square everywhere, jittered by its number.

Rows are of equal latitude, and each has as many fields as keep them about as wide as they are high. A field has one number on the whole
body, and its point is a function of that number and the seed: whoever looks at a part of the ground finds the same points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.simulation.keyed_random import keyed_uniform
from submin.simulation.region import terrain_height

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

KM_OF_DEGREE = 111.32
JITTER = 0.8
"""Part of a field, about its middle, in which its point may lie."""


@dataclass(frozen=True)
class PointGrid:
    """A grid of fields of so many kilometres, and the heights of the ground there, from 0 to ``relief_m`` (metres).

    Raises
    ------
    InputError
        When the spacing or the relief is not positive.
    """

    spacing_km: float
    relief_m: float
    seed: int

    def __post_init__(self) -> None:
        for name in ("spacing_km", "relief_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"grid of points: {name} is {value}; expected a positive number")

    @property
    def _step(self) -> float:
        return 180.0 / self._rows

    @property
    def _rows(self) -> int:
        return max(1, round(180.0 * KM_OF_DEGREE / self.spacing_km))

    @cached_property
    def _first(self) -> Numbers:
        """Number of the first field of each row, and after the last row the number of all fields."""
        latitude = np.radians(-90.0 + self._step * (np.arange(self._rows) + 0.5))
        fields = np.maximum(1, np.round(2 * self._rows * np.cos(latitude))).astype(np.int64)
        return np.concatenate([[0], np.cumsum(fields)])

    @property
    def fields(self) -> int:
        """Number of fields on the whole body."""
        return int(self._first[-1])

    def numbers_in(self, west: float, south: float, east: float, north: float) -> Numbers:
        """Numbers of the fields that a box of longitude and latitude (degrees, less than 360 wide) meets, ascending but on the rim."""
        low, high = np.clip(np.floor((np.array([south, north]) + 90.0) / self._step), 0, self._rows - 1).astype(np.int64)
        row = np.arange(low, high + 1)
        first, width = self._first[row], np.diff(self._first)[row]
        start = np.floor((west + 180.0) / 360.0 * width).astype(np.int64)
        count = np.minimum(np.floor((east + 180.0) / 360.0 * width).astype(np.int64) - start + 1, width)
        of_row = np.repeat(np.arange(len(row)), count)
        column = start[of_row] + np.arange(len(of_row)) - np.repeat(np.cumsum(count) - count, count)
        return np.asarray(first[of_row] + column % width[of_row], dtype=np.int64)

    def geodetic(self, number: Numbers) -> Array:
        """Longitude, latitude (degrees) and height (metres) (n, 3) of the points of fields (n,)."""
        row = np.searchsorted(self._first, number, side="right") - 1
        column, width = number - self._first[row], np.diff(self._first)[row]
        across, along = (0.5 + JITTER * (keyed_uniform(self.seed, "place", number, k) - 0.5) for k in range(2))
        longitude, latitude = -180.0 + 360.0 * (column + across) / width, -90.0 + self._step * (row + along)
        return np.stack([longitude, latitude, self.heights(longitude, latitude)], axis=1)

    def heights(self, longitude: Array, latitude: Array) -> Array:
        """Heights (n,) of the ground, metres: waves of 60 to 170 km."""
        east = KM_OF_DEGREE * longitude * np.cos(np.radians(latitude))
        return terrain_height(KM_OF_DEGREE * latitude, east, self.relief_m)

    @staticmethod
    def ids(number: Numbers) -> NDArray[np.str_]:
        """Names of points, ten characters each."""
        return np.char.mod("P%09d", number)
