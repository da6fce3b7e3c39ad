"""Covariance Intersection of several tiles at once is no worse than of two at a time, in whatever order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np
import pytest
from networks import SMALL, area_of, fuse
from numpy.typing import NDArray
from property.random_information import random_functionals, random_information, trace_of

import submin
from submin.query.covariance_intersection import intersection_weights
from submin.query.padded_tiles import padded_tiles
from submin.query.planner import determined_parts, points_named
from submin.simulation.region import simulate_region
from submin.storage.simulated import write_region

Array = NDArray[np.float64]

NO_WORSE = 1.0 + 1e-6
"""Weights are optimal to this part of the trace."""


def pairwise(information: list[Array], merge: Callable[[Array], Array]) -> Iterator[Array]:
    """What merging two at a time gives, in every order and grouping."""
    if len(information) == 1:
        yield information[0]
        return
    for i, j in combinations(range(len(information)), 2):
        rest = [part for k, part in enumerate(information) if k not in (i, j)]
        yield from pairwise([*rest, merge(np.stack([information[i], information[j]]))], merge)


def compared(information: Array, functionals: Array) -> tuple[float, list[float]]:
    """Trace of all merged at once, and of every way of merging two at a time; each step takes the weights that are best for it."""

    def merge(parts: Array) -> Array:
        return np.asarray(np.tensordot(intersection_weights(parts, functionals), parts, axes=1))

    at_once = trace_of(intersection_weights(information, functionals), information, functionals)
    return at_once, [float(np.trace(np.linalg.solve(merged, functionals))) for merged in pairwise(list(information), merge)]


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("tiles", "ways"), [(3, 3), (4, 18)])
def test_at_once_is_no_worse_than_two_at_a_time(tiles: int, ways: int, seed: int) -> None:
    rng = np.random.default_rng(500 + seed)
    information = random_information(rng, tiles, int(rng.integers(4, 15)))
    at_once, traces = compared(information, random_functionals(rng, information.shape[1]))
    assert len(traces) == ways
    assert at_once <= min(traces) * NO_WORSE


def test_three_alike_that_know_one_direction_each_get_a_third() -> None:
    information = np.stack([np.eye(3) + 99.0 * np.diag(row) for row in np.eye(3)])
    at_once, traces = compared(information, np.eye(3))
    assert at_once == pytest.approx(3.0 / 34.0, rel=1e-9)
    assert traces == pytest.approx([at_once] * 3, rel=1e-6)


def test_four_tiles_of_a_network_at_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("at-once")
    region = simulate_region(SMALL)
    write_region(region, folder / "catalogue")
    fuse(folder / "catalogue", folder / "network", area_of(region))
    network = submin.open(folder / "network")
    corner = [number for number in network.cell_numbers() if len(network.cover.holders(number)) == 4]
    cell = network.cell(max(corner, key=lambda number: len(network.cell(number))))
    _, parts = determined_parts(network, points_named(network, cell.point_ids, np.full(len(cell), cell.number))[0])
    padded = padded_tiles(network, network.cover.holders(cell.number))
    at_once, traces = compared(padded.of_tiles, padded.functionals(parts))
    assert at_once <= min(traces) * NO_WORSE
    assert max(traces) > at_once  # the order of merging matters, so there is something to be no worse than
