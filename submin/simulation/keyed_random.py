"""Random numbers that belong to names: the same seed, stream and key give the same number, whoever asks, in any order.

So an image, a pass or a point of the ground has its error wherever it is needed, and parts of a simulation that know nothing of one another
agree. Keys go through the finaliser of SplitMix64 (Steele, Lea and Flood, 2014, OOPSLA), once for each of their parts.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bits = NDArray[np.uint64]

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


def keyed_uniform(seed: int, stream: str, *keys: NDArray[Any] | int) -> Array:
    """Numbers from 0 to below 1, uniform; ``keys`` are whole numbers of 64 bits, arrays that broadcast.

    Examples
    --------
    >>> a = keyed_uniform(7, "height", np.arange(5), 2)
    >>> b = keyed_uniform(7, "height", np.array([3]), 2)
    >>> bool(a[3] == b[0]), len(set(a.tolist()))
    (True, 5)
    """
    return np.asarray((_bits(seed, stream, keys) >> np.uint64(11)) * 2.0**-53, dtype=np.float64)


def keyed_normal(seed: int, stream: str, *keys: NDArray[Any] | int) -> Array:
    """Pairs (..., 2) of independent standard normal numbers, by Box and Muller (1958, Ann. Math. Stat. 29)."""
    bits = _bits(seed, stream, keys)
    radius = np.sqrt(-2.0 * np.log1p(-((bits >> np.uint64(11)) * 2.0**-53)))
    angle = 2.0 * np.pi * ((_mixed(bits + _STEP) >> np.uint64(11)) * 2.0**-53)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def key_of(name: str) -> int:
    """A key of 64 bits for a name."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "little")


def _bits(seed: int, stream: str, keys: tuple[NDArray[Any] | int, ...]) -> Bits:
    state = np.array(key_of(f"{seed}/{stream}"), dtype=np.uint64)
    for key in keys:
        part = np.asarray(key)
        state = _mixed(state + _STEP ^ _mixed(part.astype(np.uint64) + _STEP))
    return state


def _mixed(state: Bits) -> Bits:
    with np.errstate(over="ignore"):
        state = (state ^ (state >> np.uint64(30))) * _FIRST
        state = (state ^ (state >> np.uint64(27))) * _SECOND
    return np.asarray(state ^ (state >> np.uint64(31)))
