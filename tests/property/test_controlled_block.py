"""A block controlled by a network, against the network that has fused it; by exact algebra, linearised alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.linalg as la
from networks import SMALL, area_of, fuse
from numpy.typing import NDArray

import submin
from submin.adjustment.control import ControlledEstimate, ControlledPrior, correlated, estimate, innovation_test, surveyed
from submin.adjustment.elimination import LinearRays, Sums
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori
from submin.errors import NumericalError
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
class Without(NetworkSource):
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


STEP = 1e4
"""The estimate is linear: a large step keeps round-off of geocentric coordinates small."""


def exact(case: Case, prior: ControlledPrior, covariance: Array) -> tuple[Array, Array]:
    """Stated and true covariance of corrections and points, when the control's errors have this one (3k, 3k), one datum after another.

    The estimate is linear in measurements, control and the images' expected corrections, and errors of these are all that it has.
    """

    def answer(y: Array, control: Array, theta: Array) -> Array:
        known = replace(prior, position=prior.position + control.reshape(-1, 3), theta=theta.reshape(prior.theta.shape))
        origin = case.origin.copy()
        origin[prior.point] = known.position
        linear = case.moved(origin)
        active = np.ones(len(prior.point), dtype=np.bool_)
        found = estimate(replace(linear, y=linear.y + y.reshape(-1, 2)), np.ones(len(linear.y)), known, active, origin)
        return np.concatenate([found.theta.ravel(), (found.ground - case.origin).ravel()])

    start = [np.zeros(case.linear.y.size), np.zeros(3 * len(prior.point)), prior.theta.ravel()]
    base, maps = answer(*start), []
    for which, values in enumerate(start):
        columns = [
            (answer(*(part + STEP * (np.arange(len(part)) == k) if at == which else part for at, part in enumerate(start))) - base) / STEP
            for k in range(len(values))
        ]
        maps.append(np.array(columns).T)
    a_priori = case.images.prior.toarray()
    by_rays, by_control, by_images = maps
    true = by_rays @ by_rays.T + by_control @ covariance @ by_control.T + by_images @ a_priori @ a_priori.T @ by_images.T

    found, _ = case.adjusted(prior)
    every = np.arange(len(case.ids))
    root = np.concatenate([found.image_root, found.ground_root(every)])
    stated = root @ root.T
    stated[found.theta.size :, found.theta.size :] = found.ground_covariance(every)
    return stated, true


@pytest.mark.parametrize("case", ["independent images"], indirect=True)
def test_control_without_its_correlations_claims_too_much(case: Case) -> None:
    """The whole covariance of the control is what makes the answer consistent; 3 x 3 blocks of it are not enough."""
    prior = case.prior()
    k, joint = np.arange(len(prior.point)), prior.covariance
    blocks = joint.reshape(len(k), 3, len(k), 3)[k, :, k, :]
    kept = case.images.prior, case.images.parameters, prior.point, prior.position
    largest = {}
    for name, known in {"full": correlated(*kept, joint), "factored": prior, "diagonal": surveyed(*kept, blocks)}.items():
        stated, true = exact(case, known, joint)
        largest[name] = float(la.eigh(true, stated, eigvals_only=True)[-1])
    assert largest["full"] <= 1.0 + 1e-6
    assert largest["factored"] <= 1.0 + 1e-6
    assert largest["diagonal"] > 5.0, largest


@pytest.mark.parametrize("case", ["independent images"], indirect=True)
def test_a_dense_covariance_is_as_good_as_a_factored_one(case: Case) -> None:
    """What a query wrote to a file controls as the network itself does."""
    prior = case.prior()
    one, _ = case.adjusted(prior)
    other, _ = case.adjusted(correlated(case.images.prior, case.images.parameters, prior.point, prior.position, prior.covariance))
    every = np.arange(len(case.ids))
    sigma = np.sqrt(np.diag(one.ground_covariance(every)))
    close(other.ground.ravel(), one.ground.ravel(), sigma)
    close(other.ground_covariance(every), one.ground_covariance(every), sigma * sigma[:, None])
    np.testing.assert_allclose(other.statistic, one.statistic, rtol=1e-6, atol=1e-9)
    assert other.chi_square == pytest.approx(one.chi_square, rel=1e-9)


@pytest.mark.parametrize("case", ["independent images"], indirect=True)
def test_singular_control(case: Case) -> None:
    """Points with one error in common, and points without error: the limits of regular control, which inverting P would not reach."""
    prior = case.prior()
    k = len(prior.point)
    common = np.tile(np.eye(3), (k, k)) * 4.0
    for joint, ridge in ((common, 1e-9 * np.eye(3 * k)), (np.zeros((3 * k, 3 * k)), 1e-12 * np.eye(3 * k))):
        kept = case.images.prior, case.images.parameters, prior.point, prior.position
        singular, _ = case.adjusted(correlated(*kept, joint))
        regular, _ = case.adjusted(correlated(*kept, joint + ridge))
        sigma = np.sqrt(np.diag(singular.covariance))
        close(singular.theta.ravel(), regular.theta.ravel(), sigma, 1e-4)
        close(singular.covariance, regular.covariance, sigma * sigma[:, None], 1e-4)
    held = singular.ground[prior.point]
    np.testing.assert_allclose(held, prior.position, rtol=0, atol=1e-6)
    assert np.abs(singular.ground_covariance(prior.point)).max() < 1e-12
    with pytest.raises(NumericalError, match="is not positive semi-definite"):
        correlated(*kept, common - np.eye(3 * k))
