"""What is kept in memory: the latest used, as much as there is room for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp

from submin.query.kept import Kept, byte_size


@dataclass(frozen=True)
class Two:
    one: np.ndarray
    other: tuple[np.ndarray, ...]
    name: str = "two"


def numbers(count: int) -> np.ndarray:
    return np.zeros(count)


def test_sizes_are_those_of_all_arrays() -> None:
    sparse = sp.csr_array(np.eye(3))
    assert byte_size(numbers(4)) == 32
    assert byte_size(Two(numbers(1), (numbers(2), np.zeros(5, dtype=np.int32)))) == 8 + 16 + 20
    assert byte_size([numbers(1), "text", 7, None]) == 8
    assert byte_size(sparse) == sparse.data.nbytes + sparse.indices.nbytes + sparse.indptr.nbytes


def test_the_latest_used_stay() -> None:
    kept: Kept[np.ndarray] = Kept(100)
    for key in "abc":
        kept.put(key, numbers(4))
    assert kept.get("a") is not None
    kept.put("d", numbers(4))
    assert [key in kept for key in "abcd"] == [True, False, True, True]
    assert kept.get("b") is None
    assert kept.size == 96


def test_what_is_put_again_takes_the_place_of_what_was_there() -> None:
    kept: Kept[np.ndarray] = Kept(100)
    kept.put("a", numbers(4))
    again = kept.put("a", numbers(10))
    assert kept.get("a") is again
    assert kept.size == 80


def test_what_is_larger_than_all_the_room_is_given_back_and_not_kept() -> None:
    kept: Kept[np.ndarray] = Kept(100)
    kept.put("a", numbers(4))
    large = numbers(20)
    assert kept.put("b", large) is large
    assert "a" in kept and "b" not in kept


@pytest.mark.parametrize("seed", range(5))
def test_there_is_never_more_than_the_room(seed: int) -> None:
    rng, kept = np.random.default_rng(seed), Kept[np.ndarray](1000)
    sizes: dict[int, int] = {}
    for _ in range(200):
        key, size = int(rng.integers(12)), int(rng.integers(1, 160))
        kept.put(key, numbers(size))
        sizes[key] = 8 * size
        assert kept.size <= 1000
    assert kept.size == sum(sizes[key] for key in sizes if (found := kept.get(key)) is not None and found.nbytes == sizes[key])
