"""Hilbert's curve: an order of places in the plane in which what comes together lies together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEVELS = 8
"""Cells of the curve along a side: two to this power."""


def along_hilbert(places: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers (n,) along Hilbert's curve of the cells in which places (n, 2) lie; the curve fills the least square around all of them.

    Cells with following numbers have a side in common, so that any stretch of the curve is one compact piece of the plane (Hilbert 1891).
    """
    if not len(places):
        return np.empty(0, dtype=np.int64)
    low, side = places.min(axis=0), max(float(np.ptp(places, axis=0).max()), 1e-300)
    x, y = np.minimum(((places - low) / side * 2**LEVELS).astype(np.int64), 2**LEVELS - 1).T
    number = np.zeros(len(places), dtype=np.int64)
    for level in reversed(range(LEVELS)):
        size = 1 << level
        right, upper = (x & size) > 0, (y & size) > 0
        number += size * size * ((3 * right) ^ upper)
        # the curve within a lower quarter is the whole one with x and y in turn, in the right one turned by half a circle too
        turned = ~upper & right
        x, y = np.where(turned, 2**LEVELS - 1 - x, x), np.where(turned, 2**LEVELS - 1 - y, y)
        x, y = np.where(upper, x, y), np.where(upper, y, x)
    return number
