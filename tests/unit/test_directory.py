"""The directory: the cell of every point, the last entry of a point, and nothing for others."""

from __future__ import annotations

import numpy as np
import pytest

from submin.network import id_hash
from submin.storage.arrays import hash_ids
from submin.storage.directory import Directory


def made(ids: np.ndarray, cells: np.ndarray) -> Directory:
    return Directory(hash_ids(ids), cells)


@pytest.mark.parametrize("wanted", [1, 30, 4000])
@pytest.mark.parametrize("largest_sieve", [1 << 24, 1 << 6])
def test_every_point_is_found_where_it_came_last(wanted: int, largest_sieve: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(id_hash, "LARGEST_SIEVE", largest_sieve)
    rng = np.random.default_rng(wanted)
    ids = np.array([f"P{k:05d}" for k in rng.integers(0, 3000, 5000)])
    cells = rng.integers(0, 900, len(ids))
    last = dict(zip(ids.tolist(), cells.tolist(), strict=True))
    asked = np.array([f"P{k:05d}" for k in rng.integers(0, 6000, wanted)])
    assert made(ids, cells).cells_of(asked).tolist() == [last.get(point, -1) for point in asked.tolist()]


def test_of_nothing_and_in_nothing() -> None:
    none = np.empty(0, dtype="U1")
    assert made(none, np.empty(0, dtype=np.int64)).cells_of(np.array(["a", "b"])).tolist() == [-1, -1]
    assert made(np.array(["a"]), np.array([7])).cells_of(none).tolist() == []
