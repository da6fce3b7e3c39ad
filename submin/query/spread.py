"""A given number of points out of many, well spread over the plane and well determined."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from submin.adjustment.point_basis import Array
from submin.errors import QueryError

Rows = NDArray[np.int64]

HALVINGS = 30
LEAST_DISTANCE = 1e-6
"""Least distance tried, over the extent of all points: what is left to choose then lies at a few places."""


def check_most(most: int) -> None:
    """Raise `QueryError` for fewer than one point."""
    if most < 1:
        raise QueryError(f"max_points is {most}; expected 1 or more")


def spread_rows(place: Array, variance: Array, ids: NDArray[np.str_], most: int) -> Rows:
    """Rows (k,), ascending, of ``min(most, n)`` points, far from each other and of small variance.

    Points are taken from the best to the worst, each that is not near one taken before; the distance that counts as near is the least one
    by which no more are taken than wanted. So no point is farther than that from a chosen one, and a good point comes before its
    neighbours. What is left to choose goes to the largest gaps (farthest-point traversal: Gonzalez 1985, Theoretical Computer Science 38).
    The result depends on the points alone, not on their order.

    Parameters
    ----------
    place : (n, 2) metres in a plane
    variance : (n,) of each point, any unit; compared to six digits, so that round-off does not choose
    ids : (n,) different ids: they decide between equal points
    most : 1 or more

    Raises
    ------
    QueryError
        When ``most`` is below 1.
    """
    check_most(most)
    n = len(ids)
    if n <= most:
        return np.arange(n)
    better = np.lexsort((ids, np.round(np.log(variance), 6)))
    at = np.ascontiguousarray(place[better] - place.min(axis=0))
    extent = float(at.max()) + 1.0
    low, high = LEAST_DISTANCE * extent, 2.0 * extent
    chosen = np.zeros(1, dtype=np.int64)
    for _ in range(HALVINGS):
        distance = 0.5 * (low + high)
        found = _apart(at, distance, most)
        if len(found) > most:
            low = distance
            continue
        high = distance
        if len(found) > len(chosen):
            chosen = found
        if len(found) == most:
            break
    return np.sort(better[_filled(at, chosen, most)])


@numba.njit(cache=True, error_model="numpy")
def _apart(at: Array, distance: float, most: int) -> Rows:
    """Rows that are not nearer than ``distance`` to one before them; no more than ``most`` and one of them are looked for."""
    size = 16
    while size < 4 * most:
        size *= 2
    # chosen points by squares of that side, several squares to a list: who is near is in one of nine
    head, link, rows = np.full(size, -1, np.int64), np.empty(most + 1, np.int64), np.empty(most + 1, np.int64)
    n = 0
    for j in range(len(at)):
        column, row = np.int64(at[j, 0] / distance), np.int64(at[j, 1] / distance)
        near = False
        for square in range(9):
            c, r = column + square // 3 - 1, row + square % 3 - 1
            k = head[(c * 73856093 ^ r * 19349663) & (size - 1)]
            while k >= 0 and not near:
                other = rows[k]
                near = (at[j, 0] - at[other, 0]) ** 2 + (at[j, 1] - at[other, 1]) ** 2 < distance**2
                k = link[k]
            if near:
                break
        if not near:
            here = (column * 73856093 ^ row * 19349663) & (size - 1)
            rows[n], link[n], head[here] = j, head[here], n
            n += 1
            if n > most:
                break
    return rows[:n]


@numba.njit(cache=True, error_model="numpy")
def _filled(at: Array, chosen: Rows, most: int) -> Rows:
    """``chosen`` rows, and after them those that are farthest from all before, the first of equals, until there are ``most``."""
    n, k = len(at), len(chosen)
    rows = np.empty(most, np.int64)
    rows[:k] = chosen
    gap = np.full(n, np.inf)
    for i in range(most):
        if i >= k:
            rows[i] = np.argmax(gap)
        x, y = at[rows[i], 0], at[rows[i], 1]
        for j in range(n):
            gap[j] = min(gap[j], (at[j, 0] - x) ** 2 + (at[j, 1] - y) ** 2)
        gap[rows[i]] = -1.0
    return rows
