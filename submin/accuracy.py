"""Accuracy in the terms of the field: CE90 and LE90, relative accuracy, comparison with truth, consistency (NEES).

Formulas: docs/mathematics.md, sections 6.1 and 6.2. Covariances are m2, radii and errors m, local axes east, north, up. A covariance may be
semi-definite (a point known without error has CE90 0); round-off that makes an eigenvalue negative by less than `ROUND_OFF` of the
largest counts as zero, anything more negative is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.stats import chi2, norm

from submin.errors import InputError, NumericalError

Array = NDArray[np.float64]

ROUND_OFF = 1e-12
"""Negative eigenvalues down to this part of the largest are round-off."""

CIRCULAR_PROBABILITIES = (0.1, 0.999999)
"""Probabilities for which the radial curve is built to better than 1e-8; rarer ones would need a finer quadrature."""

_CURVE_NODES = 513
_QUADRATURE_NODES = 1024
_NEWTON_STEPS = 8


def ce90(covariance: Array) -> Array:
    """Radius (n,) in metres of the circle that holds the horizontal error with probability 0.9, by the exact radial distribution.

    Parameters
    ----------
    covariance : (n, 2, 2) or (2, 2), m2
        Horizontal covariances; the axes do not matter. One matrix gives an array of one.

    Raises
    ------
    NumericalError
        When a covariance is not finite or not positive semi-definite.

    Examples
    --------
    >>> ce90(np.diag([1.0, 1.0])).round(4).tolist()
    [2.146]
    """
    return circular_error(covariance, 0.9)


def circular_error(covariance: Array, probability: float = 0.9) -> Array:
    """Radius (n,) in metres of the circle that holds the horizontal error with this probability.

    With the principal sigmas ``s1 >= s2`` of a covariance the radius is ``k(s2 / s1) s1``; the curve k of a probability is solved once.

    Parameters
    ----------
    covariance : (n, 2, 2) or (2, 2), m2
    probability : float
        From 0.1 to 0.999999.

    Raises
    ------
    InputError
        When the probability is outside this range or the shape is another.
    NumericalError
        When a covariance is not finite or not positive semi-definite.
    """
    low, high = CIRCULAR_PROBABILITIES
    if not low <= probability <= high:
        raise InputError(f"circular error: probability is {probability}; expected {low} to {high}")
    p = np.asarray(covariance, dtype=np.float64)
    if p.ndim not in (2, 3) or p.shape[-2:] != (2, 2):
        raise InputError(f"circular error: covariance has shape {p.shape}; expected (n, 2, 2) or (2, 2)")
    p = p.reshape(-1, 2, 2)
    _require("circular error: covariance", p, np.all(np.isfinite(p), axis=(1, 2)), "finite values")
    mean = 0.5 * (p[:, 0, 0] + p[:, 1, 1])
    difference = np.hypot(0.5 * (p[:, 0, 0] - p[:, 1, 1]), 0.5 * (p[:, 0, 1] + p[:, 1, 0]))
    largest, smallest = mean + difference, mean - difference
    _require("circular error: covariance", p, smallest >= -ROUND_OFF * np.abs(largest), "no negative eigenvalue")
    ratio = np.sqrt(np.divide(np.maximum(smallest, 0.0), largest, out=np.zeros_like(largest), where=largest > 0.0))
    return np.asarray(_radial_curve(float(probability))(ratio) * np.sqrt(largest))


def le90(variance: Array | float) -> Array:
    """Half-width (n,) in metres of the interval that holds the vertical error with probability 0.9: 1.6449 sigma.

    See `linear_error`.
    """
    return linear_error(variance, 0.9)


def linear_error(variance: Array | float, probability: float = 0.9) -> Array:
    """Half-width (n,) in metres of the interval about zero that holds an error of this variance (n,), m2, with this probability.

    Raises
    ------
    InputError
        When the probability is not between 0 and 1.
    NumericalError
        When a variance is negative or not finite.

    Examples
    --------
    >>> linear_error(np.array([0.0, 1.0, 4.0]), 0.9).round(4).tolist()
    [0.0, 1.6449, 3.2897]
    """
    _require_probability("linear error", probability)
    v = np.atleast_1d(np.asarray(variance, dtype=np.float64))
    _require("linear error: variance", v, np.isfinite(v) & (v >= 0.0), "a finite number, 0 or more")
    return np.asarray(norm.ppf(0.5 * (1.0 + probability)) * np.sqrt(v))


def relative_covariance(covariance: Array, i: int, j: int) -> Array:
    """Covariance (3, 3) in m2 of the vector from point i to point j: ``P_ii + P_jj - P_ij - P_ji``.

    Where the errors of two points are nearly equal the difference can lose its definiteness to round-off: eigenvalues that are negative
    by no more than the round-off of ``P_ii + P_jj`` are set to zero.

    Parameters
    ----------
    covariance : (3n, 3n), m2
        Joint covariance, point-major, in axes common to all points.
    i, j : int
        Places of the points, 0 to n - 1.

    Raises
    ------
    InputError
        When the matrix is not (3n, 3n) or a place not one of its points.
    NumericalError
        When the blocks of the pair hold a value that is not finite, or are not a positive semi-definite joint covariance.
    """
    p = np.asarray(covariance, dtype=np.float64)
    if p.ndim != 2 or p.shape[0] != p.shape[1] or p.shape[0] % 3:
        raise InputError(f"relative covariance: covariance has shape {p.shape}; expected (3n, 3n)")
    points = len(p) // 3
    for place in (i, j):
        if not 0 <= place < points:
            raise InputError(f"relative covariance: point {place} does not exist; expected 0 to {points - 1} ({points} points)")
    at_i, at_j = slice(3 * i, 3 * i + 3), slice(3 * j, 3 * j + 3)
    own = p[at_i, at_i] + p[at_j, at_j]
    relative = own - (p[at_i, at_j] + p[at_j, at_i])
    if not np.isfinite(relative).all():
        raise NumericalError(f"relative covariance: points {i} and {j} give {relative.tolist()} m2; expected finite values")
    values, vectors = np.linalg.eigh(relative)
    if values[0] >= 0.0:
        return np.asarray(relative)
    if values[0] < -ROUND_OFF * np.trace(own):
        raise NumericalError(
            f"relative covariance: points {i} and {j} give eigenvalue {values[0]:g} m2; expected a positive semi-definite joint covariance"
        )
    return np.asarray((vectors * np.clip(values, 0.0, None)) @ vectors.T)


@dataclass(frozen=True)
class AccuracyTable:
    """Errors against truth beside the accuracy that was claimed. Lengths in metres, percentiles linear between order statistics.

    Attributes
    ----------
    points : number of points compared
    horizontal_p50, horizontal_p90, horizontal_p95 : percentiles of the radial horizontal error
    mean_ce90 : mean of the claimed CE90
    per_cent_within_ce90 : part of the points with a radial error of at most their own CE90, per cent
    vertical_p50, vertical_p90, vertical_p95 : percentiles of the absolute vertical error
    mean_le90 : mean of the claimed LE90
    per_cent_within_le90 : part of the points with a vertical error of at most their own LE90, per cent
    """

    points: int
    horizontal_p50: float
    horizontal_p90: float
    horizontal_p95: float
    mean_ce90: float
    per_cent_within_ce90: float
    vertical_p50: float
    vertical_p90: float
    vertical_p95: float
    mean_le90: float
    per_cent_within_le90: float

    def to_mapping(self) -> dict[str, Any]:
        """The keys of ``submin check --json``: ``points``, ``horizontal`` and ``vertical``."""
        return {
            "points": self.points,
            "horizontal": {
                "p50": self.horizontal_p50,
                "p90": self.horizontal_p90,
                "p95": self.horizontal_p95,
                "mean_ce90": self.mean_ce90,
                "per_cent_within": self.per_cent_within_ce90,
            },
            "vertical": {
                "p50": self.vertical_p50,
                "p90": self.vertical_p90,
                "p95": self.vertical_p95,
                "mean_le90": self.mean_le90,
                "per_cent_within": self.per_cent_within_le90,
            },
        }


def accuracy_against_truth(errors_enu: Array, covariance_enu_blocks: Array) -> AccuracyTable:
    """Percentiles of the errors of points, and how many lie within their own CE90 and LE90.

    Parameters
    ----------
    errors_enu : (n, 3), m
        Estimate minus truth, in local axes of each point.
    covariance_enu_blocks : (n, 3, 3), m2
        Covariance of these errors in the same axes; where the truth has errors of its own, theirs added.

    Raises
    ------
    InputError
        When there is no point or the shapes do not match.
    NumericalError
        When an error is not finite or a covariance not positive semi-definite.
    """
    errors = np.asarray(errors_enu, dtype=np.float64)
    blocks = np.asarray(covariance_enu_blocks, dtype=np.float64)
    if errors.ndim != 2 or errors.shape[1] != 3 or blocks.shape != (len(errors), 3, 3):
        raise InputError(f"accuracy: errors have shape {errors.shape}, covariances {blocks.shape}; expected (n, 3) and (n, 3, 3)")
    if not len(errors):
        raise InputError("accuracy: there is no point to compare; expected at least one point with known truth")
    _require("accuracy: error of point", errors, np.all(np.isfinite(errors), axis=1), "finite numbers", "m")
    horizontal, vertical = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])
    circular, linear = ce90(blocks[:, :2, :2]), le90(blocks[:, 2, 2])
    horizontal_p50, horizontal_p90, horizontal_p95 = (float(v) for v in np.percentile(horizontal, (50, 90, 95)))
    vertical_p50, vertical_p90, vertical_p95 = (float(v) for v in np.percentile(vertical, (50, 90, 95)))
    return AccuracyTable(
        points=len(errors),
        horizontal_p50=horizontal_p50,
        horizontal_p90=horizontal_p90,
        horizontal_p95=horizontal_p95,
        mean_ce90=float(circular.mean()),
        per_cent_within_ce90=100.0 * float((horizontal <= circular).mean()),
        vertical_p50=vertical_p50,
        vertical_p90=vertical_p90,
        vertical_p95=vertical_p95,
        mean_le90=float(linear.mean()),
        per_cent_within_le90=100.0 * float((vertical <= linear).mean()),
    )


def nees_per_dof(errors: Array, covariance: Array) -> float:
    """Normalised estimation error squared per degree of freedom, ``e' P^-1 e / m``: near 1 where the covariance tells the truth.

    Parameters
    ----------
    errors : (m,), m
        Stacked errors, point-major: m = 3n for n points.
    covariance : (m, m), m2
        Joint covariance of these errors, in the same axes. Only its lower triangle is read.

    Raises
    ------
    InputError
        When there is no error or the shapes do not match.
    NumericalError
        When a value is not finite or the covariance is not positive definite.
    """
    e, p = np.asarray(errors, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    if e.ndim != 1 or not len(e) or p.shape != (len(e), len(e)):
        raise InputError(f"NEES: errors have shape {e.shape}, covariance {p.shape}; expected (m,) and (m, m) with m above 0")
    if not (np.isfinite(e).all() and np.isfinite(p).all()):
        raise NumericalError("NEES: errors or covariance hold a value that is not finite")
    try:
        factor = cholesky(p, lower=True, check_finite=False)
    except LinAlgError as error:
        raise NumericalError(f"NEES: the covariance ({len(e)} x {len(e)}) is not positive definite: {error}") from None
    whitened = solve_triangular(factor, e, lower=True, check_finite=False)
    return float(whitened @ whitened) / len(e)


def nees_band(dof: int, probability: float = 0.99) -> tuple[float, float]:
    """Interval, equal tails, that holds the NEES per degree of freedom of a consistent covariance with this probability.

    Raises
    ------
    InputError
        When ``dof`` is not positive or the probability not between 0 and 1.
    """
    _require_probability("NEES band", probability)
    if not dof > 0:
        raise InputError(f"NEES band: dof is {dof}; expected a positive number of degrees of freedom")
    low, high = chi2.ppf((0.5 * (1.0 - probability), 0.5 * (1.0 + probability)), dof) / dof
    return float(low), float(high)


@lru_cache(maxsize=16)
def _radial_curve(probability: float) -> CubicSpline:
    """Curve ``k(r)``, r = s2 / s1 from 0 to 1: radius over s1 that holds this probability.

    With the angle psi taken in the plane where the error is circular, the probability outside radius k is the mean over psi of
    ``exp(-k^2 / (2 (cos^2 psi + r^2 sin^2 psi)))``. It equals the integral of docs/mathematics.md 6.1, but stays smooth down to r = 0, so
    the midpoint rule of this periodic function reaches round-off.
    """
    # Denser nodes near r = 0, where the curve of a small probability bends most.
    ratio = np.linspace(0.0, 1.0, _CURVE_NODES) ** 2
    psi = (np.arange(_QUADRATURE_NODES) + 0.5) * (0.5 * np.pi / _QUADRATURE_NODES)
    exponent = 0.5 / (np.cos(psi) ** 2 + np.outer(ratio**2, np.sin(psi) ** 2))
    target = np.log1p(-probability)
    # The logarithm of the mean is convex and falling in k^2 and r = 0 has the smallest radius: Newton from there never oversteps the root.
    squared = np.full(_CURVE_NODES, norm.ppf(0.5 * (1.0 + probability)) ** 2)
    for _ in range(_NEWTON_STEPS):
        outside = np.exp(-squared[:, None] * exponent)
        mean = outside.mean(axis=1)
        squared += (np.log(mean) - target) * mean / (exponent * outside).mean(axis=1)
    k = np.sqrt(squared)
    # End slopes are exact: the curve is even in r, and exchanging the two axes gives k(r) = r k(1 / r), hence k'(1) = k(1) / 2.
    return CubicSpline(ratio, k, bc_type=((1, 0.0), (1, 0.5 * k[-1])))


def _require_probability(what: str, probability: float) -> None:
    if not 0.0 < probability < 1.0:
        raise InputError(f"{what}: probability is {probability}; expected a number between 0 and 1")


def _require(what: str, values: Array, good: NDArray[np.bool_], expected: str, unit: str = "m2") -> None:
    """Raise `NumericalError` naming the first of ``values`` (n, ...) that is not good (n,)."""
    if not good.all():
        i = int(np.argmin(good))
        raise NumericalError(f"{what} {i} is {values[i].tolist()} {unit}; expected {expected}")
