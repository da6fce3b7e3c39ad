"""Control points with a joint covariance: exact whatever comes first, counted once as a set, one bad point found."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as la
from networks import accepted_rays, area_of, fuse, same_network
from numpy.typing import NDArray
from whole_network import whole_network

import submin
from orchestration.check import check
from orchestration.control import add_control
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.info import describe
from orchestration.progress import Silent
from orchestration.reading import ready
from orchestration.reconcile import reconcile
from orchestration.run import fuse_blocks, run
from orchestration.withdraw import withdraw
from submin.adjustment import joint_errors
from submin.errors import InputError
from submin.geodesy import WGS84, geocentric_to_geodetic, geodetic_to_geocentric, local_axes
from submin.network.cell import linear_rays
from submin.network.observations import Cluster
from submin.sensors import SURVEYS
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region
from submin.storage import control_blocks
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import PointTable
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.control_blocks import observed_positions
from submin.storage.ledger import Ledger
from submin.storage.point_table import read_point_table
from submin.storage.simulated import write_region
from submin.storage.snapshot import Snapshot

HERE = SerialExecutor()
DESIGN = RegionDesign(width_km=80, height_km=80, point_spacing_km=9.5)
"""6 triplets, 64 points."""
TILE_KM, OVERLAP_KM = 50.0, 20.0
EVERYWHERE = (90.0, 30.0, 110.0, 40.0)
SPREAD = [3, 20, 21, 38, 45, 60]
"""Points in several tiles."""

Array = NDArray[np.float64]


def correlated(region: SimulatedRegion, which: list[int], seed: int = 0, common: float = 0.6, own: float = 0.25) -> PointTable:
    """Some points of the region as a survey has them, with errors of a random joint covariance (simulated)."""
    rng, n = np.random.default_rng(seed), 3 * len(which)
    loading = rng.normal(size=(n, 4)) * common
    covariance = loading @ loading.T + np.diag(own**2 * rng.uniform(0.3, 3.0, n))
    mixed = np.linalg.qr(rng.normal(size=(n, n)))[0] * own * 0.5
    covariance += mixed @ np.diag(rng.uniform(0.1, 1.0, n)) @ mixed.T
    errors = (np.linalg.cholesky(covariance) @ rng.normal(size=n)).reshape(-1, 3)
    return table(region, which, covariance, errors)


def table(region: SimulatedRegion, which: list[int], covariance: Array, errors: Array) -> PointTable:
    geodetic = geocentric_to_geodetic(geodetic_to_geocentric(region.truth[which], WGS84) + errors)
    own = covariance.reshape(len(which), 3, len(which), 3)[np.arange(len(which)), :, np.arange(len(which)), :]
    axes = local_axes(geodetic)
    enu = axes @ own @ np.swapaxes(axes, 1, 2)
    return PointTable(region.point_ids[which], geodetic, enu, np.full(len(which), "", dtype="U1"), covariance)


@pytest.fixture(scope="module")
def region() -> SimulatedRegion:
    return simulate_region(DESIGN)


@pytest.fixture(scope="module")
def catalogue(region: SimulatedRegion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("region") / "catalogue"
    write_region(region, path)
    return path


@pytest.fixture(scope="module")
def complete(region: SimulatedRegion, catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The network of all blocks, in several tiles. Not to be changed."""
    network = tmp_path_factory.mktemp("complete") / "network"
    fuse(catalogue, network, area_of(region), tile_km=TILE_KM, overlap_km=OVERLAP_KM)
    return network


@pytest.fixture
def base(complete: Path, tmp_path: Path) -> Path:
    """A copy of the network of all blocks, to be changed."""
    return Path(shutil.copytree(complete, tmp_path / "base"))


@pytest.fixture
def control(region: SimulatedRegion) -> PointTable:
    return correlated(region, SPREAD)


class Dense:
    """All unknowns of a network at once, with the plain normal equations of its image rays, and control added by its covariance."""

    def __init__(self, place: Path) -> None:
        network = submin.open(place)
        rows = np.arange(network.snapshot.image_count(), dtype=np.int32)
        images = network.image_set(rows)
        seen = ~np.isin(images.sensors, SURVEYS) & (network.snapshot.image_columns(["withdrawn"])["withdrawn"] == 0)
        p, kept = images.parameters, np.flatnonzero(seen)
        prior = images.take(kept).prior.toarray()
        place_of = np.full(len(rows), -1)
        place_of[kept] = np.arange(len(kept))
        cells = [network.cell(number) for number in network.cell_numbers()]
        ids = np.concatenate([cell.point_ids for cell in cells])
        self.origin = np.concatenate([cell.origin for cell in cells])
        a, b, y, shift = [np.empty((0, len(kept) * p))], [np.empty((0, 3 * len(ids)))], [np.empty(0)], 0
        for cell in cells:
            linear = linear_rays(cell, network.image_set(cell.images))
            use = np.flatnonzero(cell.rays.accepted & seen[cell.images[cell.rays.image]])
            by_parameters, by_ground = np.zeros((len(use), 2, len(kept), p)), np.zeros((len(use), 2, len(ids), 3))
            at = np.arange(len(use))
            by_parameters[at, :, place_of[cell.images[cell.rays.image[use]]]] = linear.by_parameters[use]
            by_ground[at, :, shift + cell.rays.point[use]] = linear.by_ground[use]
            a.append(by_parameters.reshape(2 * len(use), -1))
            b.append(by_ground.reshape(2 * len(use), -1))
            y.append(linear.y[use].ravel())
            shift += len(cell)
        design = np.concatenate([np.concatenate(a) @ prior, np.concatenate(b)], axis=1)
        q = prior.shape[1]
        self.q, self.ids = q, ids
        # a square root instead of normal equations: the points of few rays are badly conditioned
        self.rows = np.concatenate([np.eye(q, design.shape[1]), design])
        self.y = np.concatenate([np.zeros(q), *y])

    def control_rows(self, points: PointTable) -> tuple[NDArray[np.intp], Array]:
        row = np.array([int(np.flatnonzero(self.ids == name)[0]) for name in points.point_ids])
        at = self.q + (3 * row[:, None] + np.arange(3)).ravel()
        return at, (geodetic_to_geocentric(points.geodetic, WGS84) - self.origin[row]).ravel()

    def solve(self, tables: list[tuple[PointTable, Array]]) -> tuple[Array, Array]:
        """Positions and joint covariance of all unknowns; each table with the covariance (3n, 3n) that it is believed to have."""
        design, y = [self.rows], [self.y]
        for points, covariance in tables:
            at, observed = self.control_rows(points)
            h = np.zeros((len(at), self.rows.shape[1]))
            h[np.arange(len(at)), at] = 1.0
            root = np.linalg.cholesky(covariance)
            design.append(la.solve_triangular(root, h, lower=True))
            y.append(la.solve_triangular(root, observed, lower=True))
        q, r = np.linalg.qr(np.concatenate(design))
        inverse = la.solve_triangular(r, np.eye(len(r)))
        return inverse @ (q.T @ np.concatenate(y)), inverse @ inverse.T

    def ground(self, x: Array, covariance: Array, ids: NDArray[np.str_]) -> tuple[Array, Array]:
        order = np.array([int(np.flatnonzero(self.ids == name)[0]) for name in ids])
        at = self.q + (3 * order[:, None] + np.arange(3)).ravel()
        return self.origin[order] + x[at].reshape(-1, 3), covariance[np.ix_(at, at)]


def by_itself(points: PointTable) -> Array:
    """Joint covariance of points taken for uncorrelated, geocentric."""
    axes = local_axes(points.geodetic)
    return la.block_diag(*(np.swapaxes(axes, 1, 2) @ points.covariance_enu @ axes))


@pytest.mark.parametrize("tile_km", [TILE_KM, 400.0])
def test_correlated_control_is_the_adjustment_of_everything_at_once(
    region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path, control: PointTable, tile_km: float
) -> None:
    """Against plain least squares of all rays and the whole covariance; in the tiled network the set lies in several tiles."""
    network = base if tile_km == TILE_KM else tmp_path / "one tile"
    if network != base:
        fuse(catalogue, network, area_of(region), tile_km=tile_km, overlap_km=OVERLAP_KM)
    alone = replace(correlated(region, [5, 50], seed=4), joint_covariance=None)
    assert add_control(control, "test", str(network), HERE).fused == 6
    assert add_control(alone, "test", str(network), HERE).fused == 2
    answer = submin.open(network).query(bbox=EVERYWHERE, policy="rigorous")
    assert (len(answer.tiles) > 1) == (tile_km == TILE_KM)
    if tile_km == TILE_KM:
        assert len(set(answer.tile_of_point[np.isin(answer.ids, control.point_ids)].tolist())) > 1
    dense = Dense(network)
    assert control.joint_covariance is not None
    x, p = dense.ground(*dense.solve([(control, control.joint_covariance), (alone, by_itself(alone))]), answer.ids)
    sigma = np.sqrt(np.diag(p))
    assert np.abs((answer.geocentric - x).ravel() / sigma).max() < 1e-7  # geocentric coordinates have 1e-9 m
    assert np.abs((answer.covariance - p) / sigma / sigma[:, None]).max() < 1e-9


def same_answers(one: Path, other: Path) -> None:
    """As `same_network`, for networks with other numbers in them: of geocentric metres the last digit is 1e-9 m."""
    assert accepted_rays(one) == accepted_rays(other)
    first, second = submin.open(one), submin.open(other)
    for question in [
        {"bbox": EVERYWHERE, "policy": "rigorous"},
        *({"tile": first.cover.tile_name(t)} for t in first.snapshot.tile_numbers()),
    ]:
        a, b = first.query(**question), second.query(**question)
        sigma = np.sqrt(np.diag(a.covariance))
        assert (np.abs(a.geocentric - b.geocentric).ravel() - 2e-9 < 1e-9 * sigma).all()
        assert (np.abs(a.covariance - b.covariance) / sigma / sigma[:, None]).max() < 1e-9


def worst_ratio(reported: Array, true: Array) -> float:
    """Largest eigenvalue of ``P_rep^-1 P_true``: above 1 where more accuracy is claimed than there is."""
    return float(la.eigh(true, reported, eigvals_only=True, subset_by_index=[len(true) - 1] * 2)[0])


def test_what_is_claimed_is_true_and_ignoring_the_correlation_would_not_be(base: Path, control: PointTable, tmp_path: Path) -> None:
    assert control.joint_covariance is not None
    ratios = []
    for points in (control, replace(control, joint_covariance=None)):
        network = tmp_path / f"network-{len(ratios)}"
        shutil.copytree(base, network)
        add_control(points, "test", str(network), HERE)
        answer = submin.open(network).query(bbox=EVERYWHERE, policy="rigorous")
        dense = Dense(network)
        believed = control.joint_covariance if points.joint_covariance is not None else by_itself(points)
        _, claimed = dense.solve([(points, believed)])
        at, _ = dense.control_rows(points)
        # an estimate with the weights of what is believed, and its covariance with the errors that there are
        gain = claimed[:, at] @ np.linalg.inv(believed)
        true = claimed + gain @ (control.joint_covariance - believed) @ gain.T
        _, of_points = dense.ground(np.zeros(len(claimed)), true, answer.ids)
        ratios.append(worst_ratio(answer.covariance, of_points))
    assert ratios[0] <= 1.0 + 1e-6
    assert ratios[1] > 1.5


def test_order_does_not_matter(region: SimulatedRegion, catalogue: Path, base: Path, control: PointTable, tmp_path: Path) -> None:
    """Control before, between and after the images gives the same network."""
    add_control(control, "test", str(base), HERE)
    opened = Catalogue.open(catalogue)
    blocks = list(opened.blocks())
    for name, before in (("first", 0), ("between", 3)):
        network = str(tmp_path / name)
        create(network, area_of(region), opened.metadata, TILE_KM, OVERLAP_KM)
        if before:
            fuse_blocks(ready(blocks[:before]), network, HERE, before, Silent())
        add_control(control, "test", network, HERE)
        if not before:
            alone = submin.open(network).query(bbox=EVERYWHERE, policy="rigorous")
            order = np.argsort(control.point_ids)
            at = (3 * order[:, None] + np.arange(3)).ravel()
            assert control.joint_covariance is not None
            np.testing.assert_allclose(alone.covariance, control.joint_covariance[np.ix_(at, at)], rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(alone.geodetic, control.geodetic[order], rtol=0.0, atol=1e-8)
        fuse_blocks(ready(blocks[before:]), network, HERE, 4, Silent())
        same_network(base, Path(network))


def test_a_set_is_withdrawn_as_a_whole(complete: Path, base: Path, control: PointTable) -> None:
    add_control(control, "test", str(base), HERE)
    done = withdraw(str(base), HERE, control=str(control.point_ids[2]))
    others = "and the 5 points that its errors are correlated with (block control:set:"
    assert done.what.startswith(f"control point {control.point_ids[2]} {others}")
    assert (done.images, done.rays) == (0, 12)
    same_network(base, complete)
    assert describe(submin.open(base))["control_points"] == 0
    assert add_control(control, "test", str(base), HERE).fused == 6  # it can come again
    (block,) = Ledger.of(Snapshot.open(str(base))).control_sets()
    assert withdraw(str(base), HERE, block=block).rays == 12
    assert describe(submin.open(base))["control_sets"] == 0


def test_a_survey_counts_once(base: Path, region: SimulatedRegion, control: PointTable) -> None:
    single = replace(correlated(region, [12], seed=2), joint_covariance=None)
    add_control(single, "test", str(base), HERE)
    assert add_control(control, "test", str(base), HERE).fused == 6
    snapshot = Snapshot.open(str(base))
    ledger = Ledger.of(snapshot)
    (name,) = ledger.control_sets()
    assert ledger.entries[name].kind == "control"
    assert [e.kind for e in ledger.fused()] == ["images"] * 6
    about = describe(submin.open(base))
    assert (about["control_points"], about["control_sets"], about["blocks"], about["images"]) == (7, 1, 6, 18)

    backwards = np.arange(18).reshape(6, 3)[::-1].ravel()
    assert control.joint_covariance is not None
    same = PointTable(
        control.point_ids[::-1], control.geodetic[::-1], control.covariance_enu[::-1], control.area,
        control.joint_covariance[np.ix_(backwards, backwards)],
    )  # fmt: skip
    again = add_control(same, "test", str(base), HERE)
    assert (again.fused, again.skipped, again.rejected, again.version) == (0, 6, (), "v3")

    (refused,) = add_control(correlated(region, SPREAD, seed=5), "test", str(base), HERE).rejected
    assert "set of 6 control points is already in the network with other values; withdraw it first" in refused.reason
    (refused,) = add_control(correlated(region, [3, 4], seed=6), "test", str(base), HERE).rejected
    assert refused.points == (str(region.point_ids[3]), str(region.point_ids[4]))
    assert f"point {region.point_ids[3]} is control of the network already, in block {name}; a survey counts once" in refused.reason
    (refused,) = add_control(correlated(region, [8, 12], seed=7), "test", str(base), HERE).rejected
    assert f"point {region.point_ids[12]} is control of the network already, in block control:{region.point_ids[12]}" in refused.reason
    (refused,) = add_control(replace(correlated(region, [20], seed=7), joint_covariance=None), "test", str(base), HERE).rejected
    assert f"in block {name}" in refused.reason


def test_the_split_does_not_show(base: Path, control: PointTable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """How much of the covariance the rays have, and how much the shifts, is ours to choose: answers are the same."""
    networks = []
    for share in (0.5, 0.02, 0.97):
        network = Path(shutil.copytree(base, tmp_path / str(share)))

        def split(covariance: Array, share: float = share) -> joint_errors.JointErrors:
            return joint_errors.joint_errors(covariance, share)

        monkeypatch.setattr(control_blocks, "joint_errors", split)
        add_control(control, "test", str(network), HERE)
        networks.append(network)
    for other in networks[1:]:
        same_answers(networks[0], other)


def test_a_joint_covariance_without_correlation_is_control_point_by_point(base: Path, control: PointTable, tmp_path: Path) -> None:
    other = Path(shutil.copytree(base, tmp_path / "other"))
    add_control(replace(control, joint_covariance=by_itself(control)), "test", str(base), HERE)
    add_control(replace(control, joint_covariance=None), "test", str(other), HERE)
    same_answers(base, other)


@pytest.mark.parametrize("seed", range(4))
def test_a_sound_set_is_not_flagged(base: Path, region: SimulatedRegion, seed: int) -> None:
    added = add_control(correlated(region, [*range(0, 64, 5)], seed), "test", str(base), HERE)
    assert (added.rejected, added.contradicted) == ((), ())
    rejected = sum(not used for (_, image), used in accepted_rays(base).items() if image.startswith("control:"))
    assert rejected == 0


@pytest.mark.parametrize("which", [2, 9])
def test_a_bad_point_is_found_and_spoils_no_other(base: Path, region: SimulatedRegion, tmp_path: Path, which: int) -> None:
    """Twenty sigma of the point when the others are known: without the correlation it would hide in the common errors."""
    points = correlated(region, [*range(0, 64, 5)], seed=1, common=3.0, own=0.8)
    assert points.joint_covariance is not None
    alone = 1.0 / np.sqrt(np.diag(np.linalg.inv(points.joint_covariance)))
    wrong = geodetic_to_geocentric(points.geodetic, WGS84)
    wrong[which] += 20.0 * alone[3 * which : 3 * which + 3]
    bad = replace(points, geodetic=geocentric_to_geodetic(wrong, WGS84))
    bad = replace(bad, covariance_enu=_own(bad, points.joint_covariance))
    added = add_control(bad, "test", str(base), HERE)
    assert [c.point_id for c in added.contradicted] == [str(points.point_ids[which])]
    reason = added.contradicted[0].reason
    assert re.search(r"lies -?[\d.]+ m east, -?[\d.]+ m north, -?[\d.]+ m up of where the network has it \(test statistic \d", reason)
    assert added.to_json()["control_flagged"] == [{"point_id": str(points.point_ids[which]), "reason": reason}]
    lost = {image for (_, image), used in accepted_rays(base).items() if image.startswith("control:") and not used}
    assert lost == {f"control:{points.point_ids[which]}:{n}" for n in (0, 1)}

    answer = submin.open(base).query(bbox=EVERYWHERE, policy="rigorous")
    left = np.arange(len(points)) != which
    dense = Dense(base)
    at = np.repeat(left, 3)
    sound = PointTable(points.point_ids[left], points.geodetic[left], points.covariance_enu[left], points.area[left])
    x, p = dense.ground(*dense.solve([(sound, points.joint_covariance[np.ix_(at, at)])]), answer.ids)
    sigma = np.sqrt(np.diag(p))
    assert np.abs((answer.geocentric - x).ravel() / sigma).max() < 1e-7
    assert np.abs((answer.covariance - p) / sigma / sigma[:, None]).max() < 1e-9


def test_a_run_takes_correlated_control_and_a_check_leaves_it_out(
    region: SimulatedRegion, catalogue: Path, base: Path, control: PointTable, tmp_path: Path
) -> None:  # fmt: skip
    source = Catalogue.open(catalogue)
    with CatalogueWriter(tmp_path / "with", source.metadata) as writer:
        writer.write_images(source.images)
        for block in source.blocks():
            writer.write_block(block)
        writer.write_priors(source.default_prior, source.priors)
        writer.write_points("control", control)
    result = fuse(tmp_path / "with", tmp_path / "network", area_of(region), tile_km=TILE_KM, overlap_km=OVERLAP_KM)
    assert (result.fused, result.control_fused, result.rejected, result.contradicted) == (6, 6, (), ())
    assert result.to_json()["control_flagged"] == []
    add_control(read_point_table(tmp_path / "with" / "control.parquet", "definite"), "test", str(base), HERE)
    same_network(base, tmp_path / "network")
    again = run(Catalogue.open(tmp_path / "with"), str(tmp_path / "network"), HERE)
    assert (again.fused, again.control_fused, again.version) == (0, 0, result.version)

    truth = PointTable(region.point_ids, region.truth, np.full((64, 3, 3), 1e-6) + 1e-4 * np.eye(3), np.full(64, "", dtype="U1"))
    found = check(submin.open(base), truth, "rigorous")
    assert (found.control_left_out, found.missing) == (6, 0)
    assert found.nees_per_dof < found.nees_band[1]


def test_observed_positions_are_correlated_control(base: Path, control: PointTable, tmp_path: Path) -> None:
    other = Path(shutil.copytree(base, tmp_path / "other"))
    assert control.joint_covariance is not None
    values = geodetic_to_geocentric(control.geodetic, WGS84)
    nowhere = np.full(6, "", dtype="U1")
    block = observed_positions(Cluster("session 7", control.point_ids, nowhere, values, control.joint_covariance), WGS84, "obs")
    tally = fuse_blocks(ready([block]), str(other), HERE, 1, Silent())
    assert (tally.fused, tally.control, tally.observations) == (0, 0, 1)
    ledger = Ledger.of(Snapshot.open(str(other)))
    assert ledger.entries["session 7"].kind == "observations"
    assert set(ledger.control_points()) == set(control.point_ids.tolist())
    add_control(control, "test", str(base), HERE)
    same_answers(base, other)
    assert withdraw(str(other), HERE, block="session 7").rays == 12


def test_baselines_belong_into_the_dense_form(control: PointTable) -> None:
    ends = np.array(["", "", "A", "", "", ""])
    assert control.joint_covariance is not None
    cluster = Cluster("s", control.point_ids, ends, np.full((6, 3), 4e6), control.joint_covariance)
    with pytest.raises(InputError, match=f"obs: cluster s: baseline from {control.point_ids[2]} to A; .*--form dense"):
        observed_positions(cluster, WGS84, "obs")
    twice = Cluster("s", control.point_ids[[0, 1, 1]], np.full(3, "", dtype="U1"), np.full((3, 3), 4e6), np.eye(9))
    with pytest.raises(InputError, match=f"position of {control.point_ids[1]} comes twice"):
        observed_positions(twice, WGS84, "obs")


def test_a_covariance_that_is_none_is_refused_before_anything_is_written(base: Path, control: PointTable) -> None:
    n = 3 * len(control)
    common = np.tile(np.eye(3), (len(control), 1))  # an error of all points and none of any: as good as no datum
    assert control.joint_covariance is not None
    for joint, message in (
        (common @ common.T, "joint covariance \\(covariance_row\\) of 6 points is not positive definite|singular to working precision"),
        (np.diag(np.arange(n) - 0.5), "not positive definite"),
        (1e14 * common @ common.T + control.joint_covariance, "singular to working precision .* with a datum"),
    ):
        bad = replace(control, covariance_enu=_own(control, joint), joint_covariance=joint)
        with pytest.raises(InputError, match=message):
            add_control(bad, "survey.parquet", str(base), HERE)
    with pytest.raises(InputError, match=r"survey.parquet: row 1: the covariance of point .* is not that in the joint one"):
        add_control(replace(control, joint_covariance=2.0 * control.joint_covariance), "survey.parquet", str(base), HERE)
    far = replace(control, geodetic=control.geodetic + np.array([0.0, 0.02, 0.0]))
    far = replace(far, covariance_enu=_own(far, control.joint_covariance))
    (refused,) = add_control(far, "test", str(base), HERE).rejected
    assert "km from where other rays place it" in refused.reason
    assert len(refused.points) == 6
    assert Ledger.of(Snapshot.open(str(base))).control_points() == ()


def _own(points: PointTable, joint: Array) -> Array:
    n, axes = len(points), local_axes(points.geodetic)
    return np.asarray(axes @ joint.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :] @ np.swapaxes(axes, 1, 2))


def test_a_reconciled_network_has_the_errors_that_control_points_share(base: Path, control: PointTable) -> None:
    """The vectors of a set are held by tiles that see some of its points."""
    add_control(control, "control", str(base), HERE)
    reconcile(str(base), HERE)
    whole_network(base)
    withdraw(str(base), HERE, control=str(control.point_ids[0]))
    reconcile(str(base), HERE)
    whole_network(base)
