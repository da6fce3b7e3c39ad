"""What the whole network knows, by one factorisation of its cells; and whether tiles answer so."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

import submin
from submin.adjustment.elimination import Sums
from submin.network.sub_min import SubMin, add_sums, factor, joint_covariance, loadings, locate
from submin.query.planner import all_points, determined_parts, points_of_tile
from submin.storage.network import Network

Array = NDArray[np.float64]


def truth(now: Network, then: Network | None = None, held: Sequence[int] = ()) -> SubMin:
    """All images from the cells as they are now; with ``then`` as they were, but for those that the tiles ``held`` hold."""
    cells: dict[str, tuple[NDArray[np.int32], Sums]] = {}
    for network, wanted in ((now, True), (then, False)):
        if network is not None:
            for cell in network.cell_numbers():
                if then is None or bool({*network.cover.holders(cell)} & {*held}) == wanted:
                    cells[network.cover.cell_name(cell)] = network.cell_sums(cell)
    rows = np.unique(np.concatenate([images for images, _ in cells.values()])).astype(np.int32)
    images = now.image_set(rows)
    return factor(add_sums(list(cells.values()), rows, images.parameters), rows, images)


def points(network: Network, tiles: Sequence[int], state: SubMin) -> tuple[NDArray[np.str_], Array, Array]:
    """Ids, coordinates and joint covariance of all points that some tiles hold, by a state of all images."""
    cells = {s.cell.number: s for tile in tiles for s in points_of_tile(network, tile)}
    kept, parts = determined_parts(network, list(cells.values()))
    ids = np.concatenate([s.cell.point_ids[s.rows] for s in kept])
    own = np.concatenate([part.factors.own for part in parts])
    covariance = joint_covariance(loadings(parts, state.images, state.theta.shape[1]), own, state.covariance)
    order = np.argsort(ids)
    axes = (3 * order[:, None] + np.arange(3)).ravel()
    return ids[order], np.concatenate([locate(part, state) for part in parts])[order], covariance[np.ix_(axes, axes)]


def same(network: Network, tile: int, state: SubMin, tolerance: float = 1e-8) -> None:
    """A tile alone answers as a state of all images does."""
    answer = network.query(tile=network.cover.tile_name(tile))
    ids, at, covariance = points(network, [tile], state)
    assert answer.ids.tolist() == ids.tolist()
    assert len(ids) > 0
    np.testing.assert_allclose(answer.covariance, covariance, atol=tolerance * np.abs(covariance).max(), rtol=0.0)
    sigma = np.sqrt(np.diag(covariance))
    assert (np.abs(answer.geocentric - at).ravel() / sigma).max() < 1e-6


def excess(reported: Array, true: Array) -> float:
    """Largest eigenvalue of ``P_rep^-1 P_true``: above 1 more is claimed than is known."""
    return float(la.eigh(true, reported, eigvals_only=True)[-1])


def whole_network(place: Path) -> None:
    """Each tile alone, and all tiles together, answer as one factorisation of all cells."""
    network = submin.open(place)
    state = truth(network)
    for tile in network.snapshot.tile_numbers():
        if points_of_tile(network, tile):
            same(network, tile, state)
            assert network.query(tile=network.cover.tile_name(tile)).scope == "network"
    every = np.concatenate([s.cell.point_ids[s.rows] for s in all_points(network)])
    answer = network.query(points=every, policy="rigorous")
    _, at, covariance = points(network, network.snapshot.tile_numbers(), state)
    np.testing.assert_allclose(answer.covariance, covariance, atol=1e-9 * np.abs(covariance).max(), rtol=0.0)
    assert np.abs(answer.geocentric - at).max() < 1e-6
    assert answer.scope == "network"
