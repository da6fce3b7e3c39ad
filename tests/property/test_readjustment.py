"""MIN++: cameras from final points, against the one adjustment that gave these points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.linalg as la
from networks import SMALL, area_of, fuse
from numpy.typing import NDArray

import submin
from submin.adjustment.priors import APriori
from submin.network.cell import factors
from submin.network.sub_min import GroundPart, SubMin, add_sums, factor, loadings
from submin.query.readjustment import Readjusted, coupled_images, readjust
from submin.query.source import existing_cells
from submin.simulation.region import simulate_region
from submin.storage.network import Network
from submin.storage.simulated import write_region

Array = NDArray[np.float64]
DESIGNS = {
    "bias common to a pass, a bad camera, blunders": SMALL,
    "independent images": replace(SMALL, seed=4, blunder_rate=0.0, bad_cameras=0, priors=APriori(common_to_pass=0.0)),
}


@dataclass(frozen=True)
class Case:
    """A network, its groups of images, and in which cells each image has rays."""

    network: Network
    groups: list[NDArray[np.int32]]
    cells: dict[int, list[int]]

    def readjusted(self, policy: str = "rigorous", deweight: float | None = None) -> list[Readjusted]:
        return list(readjust(self.network, self.groups, self.cells, policy, deweight))

    def together(self, tiles: tuple[int, ...]) -> SubMin:
        """Images of some tiles in one adjustment."""
        sums = [self.network.cell_sums(cell) for cell in existing_cells(self.network, tiles)]
        rows = np.unique(np.concatenate([of_cell for of_cell, _ in sums])).astype(np.int32)
        return factor(add_sums(sums, rows, 6), rows, self.network.image_set(rows))

    def cross(self, state: SubMin, rows: NDArray[np.int32], ids: NDArray[np.str_]) -> Array:
        """Cov(theta, X) of images and points in one adjustment: ``M U'``."""
        parts, names = [], []
        for number in np.unique(self.network.snapshot.candidate_cells(ids)):
            cell = self.network.cell(int(number))
            chosen = np.flatnonzero(np.isin(cell.point_ids, ids))
            linear, found = factors(cell, self.network.image_set(cell.images), chosen)
            parts.append(GroundPart(cell.origin[chosen], replace(linear, image=cell.images[linear.image]), found))
            names.append(cell.point_ids[chosen])
        order = np.argsort(np.concatenate(names))
        u = loadings(parts, state.images, 6)[(3 * order[:, None] + np.arange(3)).ravel()]
        at = (6 * np.searchsorted(state.images, rows)[:, None] + np.arange(6)).ravel()
        return np.asarray((u @ state.covariance[:, at]).T)


@pytest.fixture(scope="module", params=DESIGNS)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("readjusted")
    region = simulate_region(DESIGNS[request.param])
    write_region(region, folder / "catalogue")
    result = fuse(folder / "catalogue", folder / "network", area_of(region), tile_km=80.0, overlap_km=30.0)
    assert not result.rejected
    assert set(region.bad_cameras) <= {image.image_id for image in result.flagged}
    network = submin.open(folder / "network")
    count = network.snapshot.image_count()
    cells: dict[int, list[int]] = {}
    for number in network.cell_numbers():
        for row in network.cell(number).images.tolist():
            cells.setdefault(row, []).append(number)
    priors = network.image_set(np.arange(count, dtype=np.int32)).priors
    return Case(network, coupled_images(priors, np.ones(count, dtype=np.bool_)), cells)


def test_images_are_grouped_by_what_couples_them(case: Case) -> None:
    columns = case.network.snapshot.image_columns(["block_id", "pass_id"])
    shared = case.network.image_set([0]).priors[0].a_priori.common_to_pass > 0.0  # type: ignore[union-attr]
    by = columns["pass_id" if shared else "block_id"]
    expected = [set(np.flatnonzero(by == name).tolist()) for name in dict.fromkeys(by.tolist())]
    assert [set(group.tolist()) for group in case.groups] == expected


@pytest.mark.parametrize("policy", ["rigorous", "auto"])
def test_readjusted_cameras_are_those_of_one_adjustment(case: Case, policy: str) -> None:
    """Corrections, their joint covariance, and their covariance with the points of the network."""
    found = case.readjusted(policy)
    assert sorted(np.concatenate([f.rows for f in found]).tolist()) == list(range(case.network.snapshot.image_count()))
    for group in found:
        state = case.together(group.tiles)
        at = (6 * np.searchsorted(state.images, group.rows)[:, None] + np.arange(6)).ravel()
        sigma = np.sqrt(np.diag(state.covariance)[at])
        assert np.abs((group.theta.ravel() - state.theta.ravel()[at]) / sigma).max() < 1e-8
        assert np.abs((group.covariance - state.covariance[np.ix_(at, at)]) / sigma / sigma[:, None]).max() < 1e-8
        assert group.gain is not None
        if policy == "rigorous":
            points = case.network.query(points=group.points, policy="rigorous")
            assert points.tiles == tuple(case.network.cover.tile_name(t) for t in group.tiles)
            order = np.argsort(group.points)
            gain = group.gain.reshape(len(at), -1, 3)[:, order].reshape(len(at), -1)
            spread = np.sqrt(np.diag(points.covariance))
            expected = case.cross(state, group.rows, points.ids)
            assert np.abs((gain @ points.covariance - expected) / sigma[:, None] / spread).max() < 1e-8


def test_deweighting_is_close_and_never_exact(case: Case) -> None:
    """Control that the images have made themselves counts their rays twice, however large the factor (Dolloff et al. 2010, appendix A).

    No estimate from these data is better than one adjustment, so a stated covariance below that one's claims too much.
    """
    exact = case.readjusted()
    moved, claimed = {}, {}
    for f in (1.0, 10.0, 100.0):
        pairs = list(zip(exact, case.readjusted(deweight=f), strict=True))
        sigma = np.concatenate([np.sqrt(np.diag(e.covariance)) for e, _ in pairs])
        moved[f] = float(np.mean(np.abs(np.concatenate([(d.theta - e.theta).ravel() for e, d in pairs])) / sigma))
        claimed[f] = max(float(la.eigh(e.covariance, d.covariance, eigvals_only=True)[-1]) for e, d in pairs)
    print(moved, claimed)
    assert min(moved.values()) > 1e-3
    assert min(claimed.values()) > 1.0 + 1e-3
    assert moved[1.0] > moved[10.0] and claimed[1.0] > claimed[10.0]
