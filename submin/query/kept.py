"""What was made of a version before, kept in memory up to a number of bytes: a version never changes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

import numpy as np
import scipy.sparse as sp

T = TypeVar("T")


class Kept(Generic[T]):
    """Values by key. The latest used are kept, as many as fit; a value that is larger than all the room is not."""

    def __init__(self, most: int) -> None:
        """``most``: bytes of the arrays of all values together."""
        self._most, self._bytes = most, 0
        self._values: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()

    def __contains__(self, key: Hashable) -> bool:
        return key in self._values

    @property
    def size(self) -> int:
        """Bytes that are kept."""
        return self._bytes

    def get(self, key: Hashable) -> T | None:
        """The value of a key, or None."""
        if key not in self._values:
            return None
        self._values.move_to_end(key)
        return self._values[key][0]

    def put(self, key: Hashable, value: T) -> T:
        """Keep a value, which must not change any more; it is given back."""
        size = byte_size(value)
        if size <= self._most:
            self._bytes += size - self._values.pop(key, (None, 0))[1]
            self._values[key] = value, size
        while self._bytes > self._most:
            self._bytes -= self._values.popitem(last=False)[1][1]
        return value


def byte_size(value: object) -> int:
    """Bytes of the arrays in a value: an array, a tuple, or an object with arrays among its attributes."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, sp.csr_array):
        return int(value.data.nbytes + value.indices.nbytes + value.indptr.nbytes)
    if isinstance(value, tuple | list):
        return sum(map(byte_size, value))
    return sum(map(byte_size, vars(value).values())) if hasattr(value, "__dict__") else 0
