"""A joint covariance in a few numbers a point: own covariances, three functions of distance, a factor, and perhaps a few vectors.

    P <= factor P_hat + V V'

P_hat is what `submin.correlation.assembly` makes of each point's own covariance and the functions; the factor and the vectors make it a
bound for the whole of P (`submin.correlation.consistency`): whatever is computed from it claims no more accuracy than there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from submin.correlation.assembly import assemble, correlation_matrices, own_blocks, symmetric_roots, unwhitened, whitened
from submin.correlation.consistency import consistent_bound
from submin.correlation.families import FAMILIES, Correlation, Family, family_named
from submin.correlation.fitting import FIRST_STEPS, STEPS, binned, least_inflation, least_squares, typical_points
from submin.errors import InputError

Array = NDArray[np.float64]

AUTO = "auto"
MOST_POINTS = 3000
"""The joint covariance has three times as many rows (648 MB), and a factor is certified by a Cholesky factorisation of that size."""
DESCENDED = 3
"""Families between which ``auto`` chooses in the end."""
LEAST_POINTS = 3
"""Below, a function of distance has nothing to be fitted to."""


@dataclass(frozen=True, eq=False)
class CompactCovariance:
    """What a joint covariance was condensed to.

    Attributes
    ----------
    geocentric : (n, 3), m
    blocks : (n, 3, 3), m2, geocentric axes: the covariance of each point alone, exact
    axes : (3, 3), rows are the axes common to all points, along which the functions hold
    functions : correlations of the components along these axes
    factor : of P_hat beside the vectors; ``factor P_hat + V V'`` is the bound
    kappa : of P_hat alone; ``kappa P_hat`` is a bound as well
    vectors : V (3n, r), m, geocentric axes, point-major
    """

    geocentric: Array
    blocks: Array
    axes: Array
    functions: tuple[Correlation, ...]
    factor: float
    kappa: float
    vectors: Array

    def __len__(self) -> int:
        return len(self.geocentric)

    @property
    def rank(self) -> int:
        """Number of vectors."""
        return int(self.vectors.shape[1])

    @property
    def family(self) -> Family:
        """Of the functions."""
        return self.functions[0].family

    @property
    def inflation(self) -> Array:
        """Variance (n,) of the bound over the true one, summed over a point's three coordinates."""
        added = (self.vectors.reshape(len(self), 3, -1) ** 2).sum(axis=(1, 2))
        return np.asarray(self.factor + added / np.trace(self.blocks, axis1=1, axis2=2))

    @property
    def numbers(self) -> int:
        """Numbers that describe the covariance: six a point, the functions' parameters, the factor, the vectors."""
        return 6 * len(self) + sum(len(function.values) for function in self.functions) + 1 + self.vectors.size


def condense(
    covariance: Array, geocentric: Array, axes: Array, family: str = AUTO, rank: int = 0, floor: float | None = None
) -> CompactCovariance:
    """Condense a joint covariance to own covariances and correlation functions, with the factor that makes it a bound.

    Parameters
    ----------
    covariance : (3n, 3n), m2, geocentric axes, point-major
    geocentric : (n, 3), m
    axes : (3, 3), rows are axes common to all points, such as east, north and up in their middle
    family : name of a family, or ``auto``: the one whose bound has the least mean variance
    rank : number of vectors beside the functions
    floor : metres from which on the functions must be zero at the latest; only for families with zero floor

    Raises
    ------
    InputError
        When the family is unknown or not positive definite in space, there are too few or too many points, or rank or floor are out of
        range.
    NumericalError
        When a point's own covariance is not positive definite.
    """
    n = len(geocentric)
    families = check_asked(family, rank, floor)
    check_size(n)
    if not 0 <= rank < 3 * n:
        raise InputError(f"rank is {rank}; expected 0 to {3 * n - 1} for {n} points")
    blocks = own_blocks(covariance)
    _, inverse = symmetric_roots(blocks)
    of_all = whitened(covariance, inverse, axes)
    rows = typical_points(geocentric)
    most = min(rank, 3 * len(rows) - 1)
    part = of_all[np.ix_(*[(np.arange(3)[:, None] * n + rows).ravel()] * 2)]
    at = geocentric[rows]
    seen = binned(of_all, geocentric)

    def fitted(start: Sequence[Correlation], steps: Sequence[int]) -> tuple[float, tuple[Correlation, ...]]:
        functions = least_inflation(start, part, at, most, floor, steps)
        return consistent_bound(part, correlation_matrices(functions, at), most).inflation, functions

    candidates = [least_squares(one, seen, floor) for one in families]
    if len(candidates) > DESCENDED:  # a short descent tells which families are worth a long one
        ranked = sorted((fitted(start, FIRST_STEPS) for start in candidates), key=itemgetter(0))
        candidates = [functions for _, functions in ranked[:DESCENDED]]
    _, best = min((fitted(start, STEPS) for start in candidates), key=itemgetter(0))
    return bounded(covariance, geocentric, axes, best, rank)


def bounded(covariance: Array, geocentric: Array, axes: Array, functions: Sequence[Correlation], rank: int = 0) -> CompactCovariance:
    """Condense a joint covariance with functions that are known; arguments as in `condense`."""
    blocks = own_blocks(covariance)
    roots, inverse = symmetric_roots(blocks)
    bound = consistent_bound(whitened(covariance, inverse, axes), correlation_matrices(functions, geocentric), rank)
    vectors = unwhitened(bound.vectors, roots, axes)
    return CompactCovariance(geocentric, blocks, axes, tuple(functions), bound.factor, bound.alone, vectors)


def check_asked(family: str, rank: int, floor: float | None) -> list[Family]:
    """Families that are asked for, before anything is computed.

    Raises
    ------
    InputError
        When there are none, or rank or floor are out of range.
    """
    families = list(FAMILIES.values()) if family == AUTO else [family_named(family)]
    if rank < 0:
        raise InputError(f"rank is {rank}; expected 0 or more")
    if floor is None:
        return families
    if not (np.isfinite(floor) and floor > 0.0):
        raise InputError(f"floor is {floor:g} m; expected a positive number")
    with_floor = [one for one in families if one.zero_floor]
    if not with_floor:
        names = ", ".join(one.name for one in FAMILIES.values() if one.zero_floor)
        raise InputError(f"a floor is asked for, and family {family!r} is zero at no distance; expected auto or one of {names}")
    return with_floor


def check_size(points: int) -> None:
    """Refuse a number of points for which no joint covariance is condensed.

    Raises
    ------
    InputError
        When there are fewer than `LEAST_POINTS` or more than `MOST_POINTS`.
    """
    if points < LEAST_POINTS:
        raise InputError(f"{points} points; expected {LEAST_POINTS} or more to fit functions of distance to: ask for a larger area")
    if points > MOST_POINTS:
        raise InputError(
            f"more than {MOST_POINTS:,} points, whose joint covariance would be too large to condense; expected {MOST_POINTS:,} or fewer: "
            "export by --bbox, --aoi or --tile, or thin with --max-points"
        )


def expand(compact: CompactCovariance) -> Array:
    """The bound (3n, 3n), m2, geocentric axes, point-major: ``factor P_hat + V V'``.

    Raises
    ------
    NumericalError
        When a point's own covariance is not positive definite.
    """
    joint = assemble(compact.blocks, compact.geocentric, compact.functions, compact.axes)
    joint *= compact.factor
    joint += compact.vectors @ compact.vectors.T
    return joint


__all__ = ["AUTO", "MOST_POINTS", "CompactCovariance", "bounded", "check_size", "condense", "expand"]
