"""A block controlled by a network, against the network that has fused it; by exact algebra, linearised alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from networks import SMALL, area_of, fuse
from numpy.typing import NDArray

import submin
from submin.adjustment.control import ControlledEstimate, ControlledPrior, estimate, innovation_test
from submin.adjustment.elimination import LinearRays, Sums
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori
from submin.network.cell import Cell, linear_rays, summed
from submin.network.sub_min import SubMin, add_sums, factor
from submin.query.block_control import control_of_block
from submin.query.source import Index, NetworkSource, existing_cells
from submin.simulation.region import simulate_region
from submin.storage.network import Network
from submin.storage.simulated import write_region
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
CLEAN = replace(SMALL, blunder_rate=0.0, bad_cameras=0)
EVERYWHERE = (90.0, 30.0, 110.0, 40.0)
DESIGNS = {
    "images of a pass share half their variance": CLEAN,
    "independent images": replace(CLEAN, seed=4, priors=APriori(common_to_pass=0.0)),
    "correlated images of a block": replace(CLEAN, seed=6, priors=APriori(correlation="gaussian", correlation_parameter=100.0)),
}
BLOCK = "T001-001"


@dataclass(frozen=True)
class Without:
    """A network as if some of its images had never brought a ray, linearised where it is with them."""

    network: Network
    gone: Index

    @property
    def cover(self) -> Cover:
        return self.network.cover

    def cell_numbers(self) -> tuple[int, ...]:
        return self.network.cell_numbers()

    def cell(self, number: int) -> Cell:
        cell = self.network.cell(number)
        kept = ~np.isin(cell.images, self.gone)
        row = np.cumsum(kept) - 1
        rays = cell.rays.take(kept[cell.rays.image])
        return replace(
            cell, images=cell.images[kept], theta=cell.theta[kept], rays=replace(rays, image=row[rays.image].astype(np.int32))
        )  # fmt: skip

    def cell_sums(self, number: int) -> tuple[Index, Sums]:
        cell = self.cell(number)
        return cell.images, summed(cell, self.image_set(cell.images)).sums

    def sub_min(self, tile: int, images: Index | None) -> SubMin:
        parts = [self.cell_sums(cell) for cell in existing_cells(self, [tile])]
        rows = np.unique(np.concatenate([of_cell for of_cell, _ in parts])).astype(np.int32)
        return factor(add_sums(parts, rows, self.image_set(rows).parameters), rows, self.image_set(rows))

    def image_set(self, rows: Sequence[int] | Index) -> ImageSet:
        return self.network.image_set(rows)


@dataclass(frozen=True)
class Case:
    """A network with a block, the network without it, and the block's rays linearised as the network has them."""

    network: Network
    without: Without
    rows: Index
    images: ImageSet
    ids: NDArray[np.str_]
    linear: LinearRays
    origin: Array

    def moved(self, origin: Array) -> LinearRays:
        """The rays with other origins of their points' coordinates."""
        point = np.repeat(np.arange(len(origin)), np.diff(self.linear.first))
        shift = np.einsum("rck,rk->rc", self.linear.by_ground, (self.origin - origin)[point])
        return replace(self.linear, y=self.linear.y + shift)

    def adjusted(self, prior: ControlledPrior) -> tuple[ControlledEstimate, LinearRays]:
        origin = self.origin.copy()
        origin[prior.point] = prior.position
        linear, active = self.moved(origin), np.ones(len(prior.point), dtype=np.bool_)
        return estimate(linear, np.ones(len(linear.y)), prior, active, origin), linear

    def prior(self, policy: str = "rigorous") -> ControlledPrior:
        control = control_of_block(
            self.without, self.ids, self.network.snapshot.candidate_cells(self.ids), policy, self.network.snapshot.image_count()
        )  # fmt: skip
        assert control is not None
        return control.prior(self.images, self.ids)


@pytest.fixture(scope="module", params=DESIGNS)
def case(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("controlled")
    region = simulate_region(DESIGNS[request.param])
    write_region(region, folder / "catalogue")
    assert not fuse(folder / "catalogue", folder / "network", area_of(region)).rejected
    network = submin.open(folder / "network")
    columns = network.snapshot.image_columns(["block_id"])
    rows = np.flatnonzero(columns["block_id"] == BLOCK).astype(np.int32)
    pieces: list[tuple[NDArray[np.str_], NDArray[np.int32], Array, Array, Array, NDArray[np.str_], Array]] = []
    for number in network.cell_numbers():
        cell = network.cell(number)
        linear = linear_rays(cell, network.image_set(cell.images))
        mine = np.isin(cell.images, rows)[cell.rays.image] & cell.rays.accepted
        image = np.searchsorted(rows, cell.images[cell.rays.image[mine]]).astype(np.int32)
        pieces.append((
            cell.point_ids[cell.rays.point[mine]], image, linear.by_ground[mine], linear.by_parameters[mine], linear.y[mine],
            cell.point_ids, cell.origin,
        ))  # fmt: skip
    names, image, by_ground, by_parameters, y = (np.concatenate([piece[k] for piece in pieces]) for k in range(5))
    ids, point = np.unique(names, return_inverse=True)
    order = np.lexsort((image, point))
    where = {str(name): at for piece in pieces for name, at in zip(piece[5], piece[6], strict=True)}
    linear = LinearRays(
        np.searchsorted(point[order], np.arange(len(ids) + 1)), image[order], by_ground[order], by_parameters[order], y[order]
    )  # fmt: skip
    origin = np.array([where[str(name)] for name in ids])
    return Case(network, Without(network, rows), rows, network.image_set(rows), ids, linear, origin)


def close(one: Array, other: Array, sigma: Array, limit: float = 1e-8) -> None:
    assert np.abs((one - other) / sigma).max() < limit


def together(source: NetworkSource, tiles: Sequence[str]) -> SubMin:
    """Images of some tiles adjusted together."""
    cells = [source.cell_sums(cell) for cell in existing_cells(source, [source.cover.tile_number(tile) for tile in tiles])]
    rows = np.unique(np.concatenate([of_cell for of_cell, _ in cells])).astype(np.int32)
    return factor(add_sums(cells, rows, 6), rows, source.image_set(rows))


def test_a_controlled_block_is_the_block_fused(case: Case) -> None:
    """Points, cameras, their joint covariances and the weighted squares, with the query's rigorous answer as control."""
    prior = case.prior()
    assert 5 < len(prior.point) <= len(case.ids)
    found, linear = case.adjusted(prior)
    fused = case.network.query(points=case.ids, policy="rigorous")
    assert fused.ids.tolist() == case.ids.tolist()
    sigma = np.sqrt(np.diag(fused.covariance))
    every = np.arange(len(case.ids))
    close(found.ground.ravel(), fused.geocentric.ravel(), sigma)
    close(found.ground_covariance(every), fused.covariance, sigma * sigma[:, None])

    after, before = (together(source, fused.tiles) for source in (case.network, case.without))
    at = (6 * np.searchsorted(after.images, case.rows)[:, None] + np.arange(6)).ravel()
    spread = np.sqrt(np.diag(after.covariance)[at])
    close(found.theta.ravel(), after.theta.ravel()[at], spread)
    close(found.covariance, after.covariance[np.ix_(at, at)], spread * spread[:, None])

    active = np.ones(len(prior.point), dtype=np.bool_)
    test = innovation_test(linear, np.ones(len(linear.y)), prior, active, found)
    free = estimate(linear, np.ones(len(linear.y)), prior, ~active, case.origin)
    assert found.chi_square == pytest.approx(after.chi_square - before.chi_square, rel=1e-8)
    assert found.redundancy == after.redundancy - before.redundancy
    assert (test.d2, test.dof) == (pytest.approx(found.chi_square - free.chi_square, rel=1e-8), found.redundancy - free.redundancy)
