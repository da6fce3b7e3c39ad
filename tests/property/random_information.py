"""Random estimates to be merged: what they know, and what is asked of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def random_information(rng: np.random.Generator, tiles: int, size: int) -> Array:
    """Information of some estimates, each with the a priori I, that know different directions to very different precision."""
    factors = rng.normal(size=(tiles, size, size)) * 10.0 ** rng.uniform(-3.0, 2.0, (tiles, size, 1))
    factors *= rng.random((tiles, size, 1)) < 0.6
    return np.asarray(np.eye(size) + np.swapaxes(factors, 1, 2) @ factors)


def random_functionals(rng: np.random.Generator, size: int) -> Array:
    seen = rng.normal(size=(int(rng.integers(1, 2 * size)), size))
    return np.asarray(seen.T @ seen)


def trace_of(weights: Array, information: Array, functionals: Array) -> float:
    return float(np.trace(np.linalg.solve(np.tensordot(weights, information, axes=1), functionals)))
