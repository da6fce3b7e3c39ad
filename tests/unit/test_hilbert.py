"""Hilbert's curve goes through every cell once, from neighbour to neighbour, and stretches of it are compact."""

from __future__ import annotations

import numpy as np

from submin.simulation.hilbert import LEVELS, along_hilbert

SIDE = 2**LEVELS
GRID = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2).astype(float)


def test_every_cell_once_each_beside_the_last() -> None:
    number = along_hilbert(GRID)
    assert np.array_equal(np.sort(number), np.arange(SIDE**2))
    steps = np.abs(np.diff(GRID[np.argsort(number)], axis=0))
    assert np.array_equal(steps.sum(axis=1), np.ones(SIDE**2 - 1))


def test_stretches_are_compact() -> None:
    """The box around a stretch of k cells holds at most eight times as many: rows of such a grid would have boxes of a whole side."""
    path = GRID[np.argsort(along_hilbert(GRID))]
    for cells in (100, 1000, 7000):
        boxes = [np.prod(np.ptp(path[k : k + cells], axis=0) + 1.0) for k in range(0, SIDE**2 - cells, 777)]
        assert max(boxes) <= 8 * cells
        assert np.median(boxes) <= 3 * cells


def test_scale_and_place_do_not_matter_and_one_place_or_none_is_enough() -> None:
    places = np.random.default_rng(3).uniform(size=(500, 2))
    number = along_hilbert(places)
    assert np.array_equal(along_hilbert(1024.0 * places - 4096.0), number)
    assert along_hilbert(places[:1]).tolist() == [0]
    assert along_hilbert(places[:0]).tolist() == []
