"""Parameters of correlation functions, two ways: close to the correlations, and for the least factor of consistency.

A function that goes well through the correlations can need a large factor, because the factor is decided by the direction in which it
falls most short, mostly a difference between neighbours. So the fit by least squares is only where the second one starts: a descent
(Nelder and Mead) on the mean variance of the bound. Every parameter stays within the values for which its function is positive
definite in space. What the descent finds need not be the least; what it finds is a bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.optimize as so
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from submin.correlation.assembly import COMPONENTS, correlation_matrices
from submin.correlation.consistency import inflation, leading, lower_factors
from submin.correlation.families import Correlation, Family
from submin.errors import NumericalError

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

BINS = 40
FITTED_POINTS = 120
"""A fit for consistency looks at no more points; the factor is that of all."""
STEPS = (250, 250)
"""Of the descent, for each parameter of a function up to three; the second time from a fresh simplex."""
FIRST_STEPS = (80,)
"""The same of a descent that only tells families apart."""
REACHES = (0.15, 0.6, 2.5)
"""First guesses of a length over the largest distance."""
_TOLERANCE = 1e-4


class Binned(NamedTuple):
    """Correlations against distance: mean distance (k,), mean correlations (3, k) of the components, weight (k,) of a bin."""

    distance: Array
    correlation: Array
    weight: Array


def binned(covariance: Array, geocentric: Array, bins: int = BINS) -> Binned:
    """Correlations of the components, averaged over pairs of points at about the same distance; short distances weigh more.

    Parameters
    ----------
    covariance : (3n, 3n), whitened
    geocentric : (n, 3), m
    """
    n = len(geocentric)
    chord, (i, j) = pdist(geocentric), np.triu_indices(n, 1)
    of_component = covariance.reshape(3, n, 3, n)[np.arange(COMPONENTS), :, np.arange(COMPONENTS), :][:, i, j]
    place = np.minimum((bins * chord / chord.max()).astype(np.int64), bins - 1)
    count = np.bincount(place, minlength=bins)
    there = count > 0
    distance, *correlation = (np.bincount(place, values, bins)[there] / count[there] for values in (chord, *of_component))
    return Binned(distance, np.stack(correlation), 1.0 / (distance + distance[0]))


def least_squares(family: Family, seen: Binned, floor: float | None = None, own_part: bool = True) -> tuple[Correlation, ...]:
    """A function for each component that goes through its correlations.

    Parameters
    ----------
    floor : metres from which on a function with zero floor must be zero at the latest
    own_part : False takes `LEAST_OWN_PART` as what a point has to itself, and fits the rest
    """
    search = _Search(family, float(seen.distance.max()), floor)
    fixed = 0 if own_part else 1
    functions = []
    for correlation in seen.correlation:

        def residuals(free: Array, correlation: Array = correlation) -> Array:
            rho = search.function(np.concatenate([search.low[:fixed], free]))
            return np.asarray(np.sqrt(seen.weight) * (rho(seen.distance) - correlation))

        limits = (search.low[fixed:], search.high[fixed:])
        found = [so.least_squares(residuals, start[fixed:], bounds=limits) for start in search.starts()]
        best = min(found, key=lambda one: float(one.cost))
        functions.append(search.function(np.concatenate([search.low[:fixed], best.x])))
    return tuple(functions)


def least_inflation(
    functions: Sequence[Correlation],
    covariance: Array,
    geocentric: Array,
    rank: int = 0,
    floor: float | None = None,
    steps: Sequence[int] = STEPS,
) -> tuple[Correlation, ...]:
    """Functions of the same family with which the consistent bound has a smaller mean variance; without vectors that is kappa.

    Parameters
    ----------
    functions : where the descent starts, one for each component
    covariance : (3n, 3n), whitened; geocentric : (n, 3), m
    rank : vectors that the bound will have beside the functions
    floor : metres from which on a function with zero floor must be zero at the latest
    steps : of each descent, for each parameter of a function up to three
    """
    search = _Search(functions[0].family, float(pdist(geocentric).max()), floor)
    width = len(search.low)

    def cost(free: Array) -> float:
        try:
            factors = lower_factors(correlation_matrices([search.function(part) for part in free.reshape(COMPONENTS, width)], geocentric))
        except NumericalError:
            return np.inf
        return float(np.log(inflation(*leading(covariance, factors, rank + 1, _TOLERANCE))))

    limits = list(zip(np.tile(search.low, COMPONENTS), np.tile(search.high, COMPONENTS), strict=True))
    begin = np.concatenate([search.free(function) for function in functions])
    shorter = begin.copy()
    shorter[1::width] -= np.log(6.0)  # correlations that fall sooner promise less of what is common, and more of differences
    at = min((np.clip(start, *np.array(limits).T) for start in (begin, shorter)), key=cost)
    for most in steps:
        options = {"maxfev": most * min(width, 3), "xatol": 1e-3, "fatol": 1e-4, "adaptive": True, "initial_simplex": _simplex(at, limits)}
        at = so.minimize(cost, at, method="Nelder-Mead", bounds=limits, options=options).x
    return tuple(search.function(part) for part in at.reshape(COMPONENTS, width))


def typical_points(geocentric: Array, most: int = FITTED_POINTS) -> Rows:
    """Rows of points that stand for all, ascending: some that are far from each other, and the nearest neighbour of each."""
    n = len(geocentric)
    if n <= most:
        return np.arange(n)
    chosen = np.zeros(most // 2, dtype=np.int64)
    nearest = np.full(n, np.inf)
    for k in range(len(chosen)):
        chosen[k] = np.argmax(nearest) if k else 0
        nearest = np.minimum(nearest, np.linalg.norm(geocentric - geocentric[chosen[k]], axis=1))
    _, neighbours = cKDTree(geocentric).query(geocentric[chosen], 2)
    return np.unique(np.concatenate([chosen, neighbours[:, 1]]))


def _simplex(at: Array, limits: Sequence[tuple[float, float]]) -> Array:
    """Corners around a place, each step inwards where outwards would leave the limits."""
    corners = np.tile(at, (len(at) + 1, 1))
    for k, (low, high) in enumerate(limits):
        step = min(0.5, 0.2 * (high - low))
        corners[k + 1, k] += step if at[k] + step <= high else -step
    return corners


class _Search:
    """Free numbers of a function between their limits: log of the own part, log of lengths, other parameters as they are."""

    def __init__(self, family: Family, extent: float, floor: float | None) -> None:
        self.family, self.extent = family, extent
        low, high = np.array([p.search for p in family.all_parameters]).T
        lengths = np.array([p.length for p in family.all_parameters])
        low, high = np.where(lengths, low * extent, low), np.where(lengths, high * extent, high)
        if floor is not None:
            high = np.where(lengths, floor, high)
            low = np.minimum(low, 0.5 * high)
        self.lengths = lengths
        one, other = self._free(low), self._free(high)
        self.low, self.high = np.minimum(one, other), np.maximum(one, other)

    def _free(self, values: Array) -> Array:
        free = np.where(self.lengths, np.log(np.where(self.lengths, values, 1.0)), values)
        free[0] = np.log(1.0 - values[0])
        return np.asarray(free)

    def free(self, function: Correlation) -> Array:
        return np.clip(self._free(np.array(function.values)), self.low, self.high)

    def function(self, free: Array) -> Correlation:
        values = np.where(self.lengths, np.exp(np.where(self.lengths, free, 0.0)), free)
        values[0] = -np.expm1(free[0])
        return Correlation(self.family, tuple(values.tolist()))

    def starts(self) -> list[Array]:
        """Within the limits, a starting place for each of `REACHES`."""
        begin = np.array([p.start for p in self.family.all_parameters])
        inside = 1e-6 * (self.high - self.low)
        return [
            np.clip(self._free(np.where(self.lengths, reach * self.extent, begin)), self.low + inside, self.high - inside)
            for reach in REACHES
        ]


__all__ = ["Binned", "binned", "least_inflation", "least_squares", "typical_points"]
