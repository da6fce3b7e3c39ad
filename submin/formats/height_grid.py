"""Grids of heights on disk: a NumPy archive (.npz) of ``longitudes`` (k,), ``latitudes`` (l,) and ``heights`` (l, k).

Axes are in degrees and ascend, heights in metres above the ellipsoid; NaN where nothing is known.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from submin.adjustment.heights import HeightPrior, height_grid
from submin.errors import InputError

_ARRAYS = ("longitudes", "latitudes", "heights")


def read_height_grid(path: str | Path, sigma: float) -> HeightPrior:
    """The surface of a grid, and how far points may be from it (sigma, metres).

    Raises
    ------
    InputError
        When the file cannot be read, lacks an array, or its arrays are no grid.
    """
    try:
        archive = np.load(path, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError("a single array")
        with archive:
            missing = [name for name in _ARRAYS if name not in archive]
            if missing:
                raise InputError(f"{path}: array {missing[0]!r} is missing; expected {', '.join(_ARRAYS)}")
            longitudes, latitudes, heights = (np.asarray(archive[name], dtype=np.float64) for name in _ARRAYS)
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as a grid of heights ({error}); expected .npz with {', '.join(_ARRAYS)}") from None
    try:
        return height_grid(longitudes, latitudes, heights, sigma)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
