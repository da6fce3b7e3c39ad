"""Correlation functions of distance that are positive definite in space, and what their parameters may be.

A function is valid when the matrix of its values between any points is positive semi-definite. That depends on the dimension: what is
valid in space is valid in the plane and on a line, not the other way round. Distances are chords between geocentric positions, so
functions must be valid in space (docs/mathematics.md, "Correlation functions").

Every family is ``A f(d)`` between different points, and one between a point and itself: ``1 - A`` is what a point's error has to itself
however near its neighbours are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError

Array = NDArray[np.float64]

SPACE = 3
"""Dimension in which a function must be valid unless another is said."""


@dataclass(frozen=True)
class Interval:
    """Values that a parameter may have; an end belongs to them when it is closed."""

    low: float
    high: float
    closed: tuple[bool, bool] = (True, True)

    def __contains__(self, value: object) -> bool:
        if not isinstance(value, int | float):
            return False
        above = value >= self.low if self.closed[0] else value > self.low
        below = value <= self.high if self.closed[1] else value < self.high
        return bool(above and below)

    def __str__(self) -> str:
        low = f"{'from' if self.closed[0] else 'above'} {self.low:.4g}"
        high = f"{'to' if self.closed[1] else 'and below'} {self.high:.4g}"
        return low if np.isinf(self.high) else f"{low} {high}"


POSITIVE = Interval(0.0, np.inf, (False, False))


@dataclass(frozen=True)
class Parameter:
    """A parameter of a family.

    Attributes
    ----------
    name, meaning : as in the formula; in words
    valid : the values for which the function is positive definite on a line, in the plane and in space
    search : the values, all valid in space, among which a fit looks; multiples of the largest distance for a length
    start : where it begins
    """

    name: str
    meaning: str
    valid: tuple[Interval, Interval, Interval]
    search: tuple[float, float]
    start: float
    length: bool = False


@dataclass(frozen=True)
class Family:
    """A family of correlation functions.

    Attributes
    ----------
    name : by which it is asked for
    formula : NumPy expression of the distance ``d`` and the parameters
    parameters : in the order in which `shape` takes them; `CORRELATED_PART` is the first one of every family and is not among them
    zero_floor : True when the function is exactly zero from the distance ``D`` on
    shape : f(d), one at distance zero
    """

    name: str
    formula: str
    parameters: tuple[Parameter, ...]
    zero_floor: bool
    shape: Callable[..., Array]

    @property
    def all_parameters(self) -> tuple[Parameter, ...]:
        """`CORRELATED_PART` and `parameters`."""
        return (CORRELATED_PART, *self.parameters)


@dataclass(frozen=True)
class Correlation:
    """A function of a family: ``A f(d)``.

    Parameters
    ----------
    family : Family
    values : tuple of float
        Of `Family.all_parameters`, lengths in metres.
    dimension : int
        1, 2 or 3: where the points may lie for which the function must be positive definite.

    Raises
    ------
    InputError
        When a value is not among those for which the function is positive definite.

    Examples
    --------
    >>> rho = Correlation(family_named("exponential"), (0.9, 1000.0))
    >>> rho(np.array([0.0, 1000.0])).round(4).tolist()
    [0.9, 0.3311]
    """

    family: Family
    values: tuple[float, ...]
    dimension: int = SPACE

    def __post_init__(self) -> None:
        wanted = self.family.all_parameters
        if len(self.values) != len(wanted):
            raise InputError(f"{self.family.name}: {len(self.values)} values; expected {len(wanted)}: {', '.join(p.name for p in wanted)}")
        if self.dimension not in (1, 2, 3):
            raise InputError(f"{self.family.name}: dimension is {self.dimension}; expected 1, 2 or 3")
        for parameter, value in zip(wanted, self.values, strict=True):
            valid = parameter.valid[self.dimension - 1]
            if value not in valid:
                raise InputError(
                    f"{self.family.name}: {parameter.name} is {value:g}; expected a number {valid}: "
                    f"else the function is not positive definite in {('one dimension', 'the plane', 'space')[self.dimension - 1]}"
                )

    def __call__(self, distance: Array) -> Array:
        """Correlation of the errors of different points at distances in metres, of any shape; at distance zero it is A, not one."""
        return self.values[0] * self.family.shape(np.asarray(distance, dtype=np.float64), *self.values[1:])

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name."""
        return {parameter.name: value for parameter, value in zip(self.family.all_parameters, self.values, strict=True)}

    @property
    def floor(self) -> float:
        """Distance in metres from which on the function is zero; infinite where it never is."""
        return self.parameters["D"] if self.family.zero_floor else np.inf


def _everywhere(interval: Interval) -> tuple[Interval, Interval, Interval]:
    return (interval, interval, interval)


LEAST_OWN_PART = 1e-6
"""Fits leave each point at least this part of its own variance: no matrix of correlations has a smaller eigenvalue."""

CORRELATED_PART = Parameter(
    "A", "correlation of points that are next to each other", _everywhere(Interval(0.0, 1.0, (False, True))),
    (0.001, 1.0 - LEAST_OWN_PART), 0.98,
)  # fmt: skip

_D = Parameter("D", "distance, m", _everywhere(POSITIVE), (0.01, 100.0), 1.0, length=True)
_FLOOR = Parameter("D", "distance from which the function is zero, m", _everywhere(POSITIVE), (0.01, 100.0), 2.0, length=True)


def _at_least(low: tuple[float, float, float], search_to: float, start: float, name: str, meaning: str) -> Parameter:
    line, plane, space = (Interval(value, np.inf, (True, False)) for value in low)
    return Parameter(name, meaning, (line, plane, space), (low[2], search_to), start)


# Largest beta for which the spectral density of (1 + b) / (b + exp(h)) is nowhere negative; found numerically, rounded down
# (tests/unit/test_correlation_families.py finds them again).
_CSM_BETA = (10.36, 8.49, 7.48)
# The spectral density of exp(-h) cos(2 pi h / q) is nowhere negative in n dimensions for q >= 2 pi cot(pi / 2n).
_DAMPED_Q = tuple(2.0 * np.pi / np.tan(np.pi / (2.0 * n)) for n in (1, 2, 3))

FAMILIES: dict[str, Family] = {
    family.name: family
    for family in (
        Family("exponential", "A * exp(-d / D)", (_D,), False, lambda d, reach: np.exp(-d / reach)),
        Family(
            "powered-exponential", "A * exp(-((d / D) ** g))",
            (_D, Parameter("g", "power", _everywhere(Interval(0.0, 2.0, (False, True))), (0.1, 2.0), 1.0)), False,
            lambda d, reach, power: np.exp(-((d / reach) ** power)),
        ),
        Family("gaussian", "A * exp(-((d / D) ** 2))", (_D,), False, lambda d, reach: np.exp(-((d / reach) ** 2))),
        Family(
            "matern-3/2", "A * (1 + sqrt(3) * d / D) * exp(-sqrt(3) * d / D)", (_D,), False,
            lambda d, reach: _matern(np.sqrt(3.0) * d / reach, 0.0),
        ),
        Family(
            "matern-5/2", "A * (1 + sqrt(5) * d / D + 5 / 3 * (d / D) ** 2) * exp(-sqrt(5) * d / D)", (_D,), False,
            lambda d, reach: _matern(np.sqrt(5.0) * d / reach, 1.0 / 3.0),
        ),
        Family(
            "cauchy", "A * (1 + (d / D) ** 2) ** -n", (_D, Parameter("n", "power", _everywhere(POSITIVE), (0.05, 20.0), 1.0)), False,
            lambda d, reach, power: (1.0 + (d / reach) ** 2) ** -power,
        ),
        Family(
            "spherical", "A * (1 - 1.5 * minimum(d / D, 1) + 0.5 * minimum(d / D, 1) ** 3)", (_FLOOR,), True,
            lambda d, reach: _spherical(np.minimum(d / reach, 1.0)),
        ),
        Family(
            "wendland", "A * maximum(1 - d / D, 0) ** 4 * (4 * d / D + 1)", (_FLOOR,), True,
            lambda d, reach: np.maximum(1.0 - d / reach, 0.0) ** 4 * (4.0 * d / reach + 1.0),
        ),
        Family(
            "askey", "A * maximum(1 - d / D, 0) ** l", (_FLOOR, _at_least((1.0, 1.5, 2.0), 20.0, 2.0, "l", "power")), True,
            lambda d, reach, power: np.maximum(1.0 - d / reach, 0.0) ** power,
        ),
        Family(
            "damped-cosine", "A * exp(-d / D) * cos(2 * pi * d / (q * D))",
            (
                _D,
                Parameter(
                    "q", "length of a wave over D",
                    (POSITIVE, *(Interval(q, np.inf, (True, False)) for q in _DAMPED_Q[1:])),  # type: ignore[arg-type]
                    (_DAMPED_Q[2], 200.0), 40.0,
                ),
            ),
            False, lambda d, reach, wave: np.exp(-d / reach) * np.cos(2.0 * np.pi * d / (wave * reach)),
        ),
        Family(
            "csm", "A * (a + (1 - a) * (1 + b) * exp(-d / D) / (1 + b * exp(-d / D)))",
            (
                _D,
                Parameter("a", "part that no distance takes away", _everywhere(Interval(0.0, 1.0, (True, False))), (0.0, 0.999), 0.2),
                Parameter(
                    "b", "how slowly it begins to fall",
                    tuple(Interval(-1.0, beta, (False, True)) for beta in _CSM_BETA),  # type: ignore[arg-type]
                    (-0.95, _CSM_BETA[2]), 1.0,
                ),
            ),
            False, lambda d, reach, rest, slow: _csm(np.exp(-d / reach), rest, slow),
        ),
    )
}  # fmt: skip
"""Families that are positive definite in space, by name. A new one is an entry here and a row in docs/correlation.md."""

TENT = ("tent", "linear")


def family_named(name: str) -> Family:
    """A family by its name.

    Raises
    ------
    InputError
        When there is none of that name, or it is the linear one, which is not positive definite in the plane.
    """
    if name in TENT:
        raise InputError(
            f"family is {name!r}, 1 - d / D down to zero, which is positive definite on a line only: in the plane and in space it gives "
            "covariances with negative eigenvalues; expected 'askey' or 'spherical', which fall to zero at D as well (in a plane, "
            "the product of a tent in each coordinate is valid, too)"
        )
    if name not in FAMILIES:
        raise InputError(f"family is {name!r}; expected auto or one of {', '.join(FAMILIES)}")
    return FAMILIES[name]


def _matern(h: Array, second: float) -> Array:
    return np.asarray((1.0 + h + second * h**2) * np.exp(-h))


def _spherical(h: Array) -> Array:
    return np.asarray(1.0 - 1.5 * h + 0.5 * h**3)


def _csm(decay: Array, a: float, b: float) -> Array:
    return np.asarray(a + (1.0 - a) * (1.0 + b) * decay / (1.0 + b * decay))


__all__ = ["FAMILIES", "SPACE", "Correlation", "Family", "Interval", "Parameter", "family_named"]
