"""`submin adjust`: new blocks controlled by a network or by surveyed points, through the product's own path."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import scipy.linalg as la
from networks import SMALL, area_of, by_image, fuse, rewrite
from numpy.typing import NDArray

import submin
from orchestration.adjust import Adjusted, VirtualDesign, adjust, named, write
from submin.accuracy import nees_band
from submin.adjustment.control import ControlledPrior, surveyed
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.formats.tables import read_parquet
from submin.geodesy import geodetic_to_geocentric
from submin.query.block_control import NetworkControl
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, PointTable
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.repository import versions
from submin.storage.simulated import write_region
from tests.orchestration.test_mixed_sensors import with_frames

Array = NDArray[np.float64]
CLEAN = replace(SMALL, blunder_rate=0.0, bad_cameras=0, seed=7)
BLOCK = "T001-001"


@dataclass(frozen=True)
class World:
    """A simulated region, its catalogue, and a network of all its blocks but one."""

    region: SimulatedRegion
    catalogue: Catalogue
    network: str

    def error(self, adjusted: Adjusted) -> Array:
        """Errors (3n,) of the adjusted points, geocentric metres."""
        truth = self.region.truth[np.searchsorted(self.region.point_ids, adjusted.points.ids)]
        return (adjusted.points.geocentric - geodetic_to_geocentric(truth)).ravel()

    def camera_error(self, adjusted: Adjusted) -> Array:
        rows = [k for k, image in enumerate(self.region.images) if image.block_id == BLOCK]
        return (adjusted.cameras.theta - self.region.theta[rows]).ravel()

    def with_block(self, folder: Path, block: Block) -> Catalogue:
        return Catalogue.open(rewrite(self.catalogue.path, folder, [block]))


def make(design: RegionDesign, folder: Path) -> World:
    region = simulate_region(design)
    write_region(region, folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    rewrite(catalogue.path, folder / "part", [block for block in catalogue.blocks() if block.block_id != BLOCK])
    assert not fuse(folder / "part", folder / "network", area_of(region)).rejected
    return World(region, catalogue, str(folder / "network"))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return make(CLEAN, tmp_path_factory.mktemp("adjust"))


def test_a_controlled_block_is_as_if_it_had_been_fused(world: World, tmp_path: Path) -> None:
    """Up to the second order: the network linearises anew with the block, stage 1 leaves it as it is."""
    adjusted = adjust(world.catalogue, BLOCK, world.network, policy="rigorous")
    assert (adjusted.values["status"], adjusted.partly) == ("controlled", False)
    assert adjusted.values["control_points"] == adjusted.values["points"] == len(adjusted.points)
    assert fuse(world.catalogue.path, tmp_path / "fused", area_of(world.region)).fused == 12
    fused = submin.open(tmp_path / "fused").query(points=adjusted.points.ids, policy="rigorous")
    sigma = np.sqrt(np.diag(fused.covariance))
    assert np.abs((adjusted.points.geocentric - fused.geocentric).ravel() / sigma).max() < 1e-3
    assert np.abs((adjusted.points.covariance - fused.covariance) / sigma / sigma[:, None]).max() < 1e-4
    assert [v.name for v in versions(world.network)] == ["v1", "v0"]  # nothing went in


def test_what_is_written_can_be_read(world: World, tmp_path: Path) -> None:
    adjusted = adjust(world.catalogue, BLOCK, world.network)
    write(adjusted, tmp_path / "out")
    points = read_parquet(tmp_path / "out" / "points.parquet")
    np.testing.assert_array_equal(points["covariance"], adjusted.points.covariance)
    np.testing.assert_array_equal(points["ids"], adjusted.points.ids)
    cameras = pq.read_table(tmp_path / "out" / "cameras.parquet")
    rows = cameras.to_pylist()
    assert [row["image_id"] for row in rows[::6]] == list(adjusted.cameras.images.ids)
    assert rows[0]["parameter"] == "sample bias" and rows[0]["unit"] == "px"
    assert [row["correction"] for row in rows] == adjusted.cameras.theta.ravel().tolist()
    stored = np.load(tmp_path / "out" / rows[0]["covariance_file"])
    np.testing.assert_array_equal(stored["covariance"], adjusted.cameras.covariance)
    np.testing.assert_allclose([row["sigma"] ** 2 for row in rows], np.diag(stored["covariance"])[[row["covariance_row"] for row in rows]])
    assert stored["parameter"].tolist() == [row["parameter"] for row in rows]
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["block"] == BLOCK and report["version"] == "v1"
    for metadata in (cameras.schema.metadata, pq.read_schema(tmp_path / "out" / "points.parquet").metadata):
        assert b"never enter it into a network" in metadata[b"use"]
    with pytest.raises(InputError, match="is not empty"):
        write(adjusted, tmp_path / "out")


def test_each_image_alone_can_be_controlled(world: World, tmp_path: Path) -> None:
    """One image has one ray a point: no tie, nothing to reject free of control, all of it from the network."""
    whole = adjust(world.catalogue, BLOCK, world.network, policy="rigorous")
    for k, block in enumerate(by_image(world.catalogue.block(BLOCK))):
        alone = adjust(world.with_block(tmp_path / str(k), block), block.block_id, world.network, policy="rigorous")
        assert alone.values["control_points"] > 10
        assert alone.values["innovation"]["dof"] == 2 * alone.values["control_points"]
        sigma = np.sqrt(np.diag(alone.cameras.covariance))  # type: ignore[arg-type]
        mine = world.camera_error(whole)[6 * k : 6 * k + 6]
        truth = whole.cameras.theta[k] - mine
        assert np.abs((alone.cameras.theta[0] - truth) / sigma).max() < 4.0


def test_wrong_matches_in_a_single_image_are_named_and_harmless(world: World, tmp_path: Path) -> None:
    block = by_image(world.catalogue.block(BLOCK))[1]
    good = adjust(world.with_block(tmp_path / "good", block), block.block_id, world.network)
    sample = block.sample.copy()
    wrong = np.array([2, 7, 11])
    sample[wrong] += [40.0, -25.0, 12.0]
    bad = adjust(world.with_block(tmp_path / "bad", replace(block, sample=sample)), block.block_id, world.network)
    assert {r["point_id"] for r in bad.values["control_rejected"]} == set(block.point_ids[wrong].tolist())
    assert bad.partly and bad.values["status"] == "controlled"
    sigma = np.sqrt(np.diag(bad.cameras.covariance))  # type: ignore[arg-type]
    assert np.abs((bad.cameras.theta - good.cameras.theta).ravel() / sigma).max() < 1.5


def test_a_camera_that_is_far_off_is_found_by_the_control(world: World, tmp_path: Path) -> None:
    block = by_image(world.catalogue.block(BLOCK))[1]
    moved = adjust(world.with_block(tmp_path / "moved", replace(block, line=block.line + 90.0)), block.block_id, world.network)
    assert [flag["image_id"] for flag in moved.values["images_flagged"]] == [block.images[0].image_id]
    assert not moved.values["control_rejected"]
    good = adjust(world.with_block(tmp_path / "good", block), block.block_id, world.network)
    bias = [0, 3]
    assert np.abs(moved.cameras.theta - good.cameras.theta)[0, bias] == pytest.approx([0.0, 90.0], abs=2.0)


def test_control_elsewhere_is_said_to_contradict(world: World, tmp_path: Path) -> None:
    """Point ids of other places: most control must go, and the result says so."""
    block = world.catalogue.block(BLOCK)
    names = np.unique(block.point_ids)
    swapped = dict(zip(names.tolist(), np.roll(names, 5).tolist(), strict=True))
    wrong = replace(block, point_ids=np.array([swapped[name] for name in block.point_ids.tolist()]))
    adjusted = adjust(world.with_block(tmp_path / "wrong", wrong), BLOCK, world.network)
    assert (adjusted.values["status"], adjusted.partly) == ("contradicted", True)
    assert len(adjusted.values["control_rejected"]) > adjusted.values["control_points"]


def test_fewer_points_on_request(world: World) -> None:
    few = adjust(world.catalogue, BLOCK, world.network, most=12)
    assert (few.values["control_points"], len(few.points)) == (12, 12)
    every = adjust(world.catalogue, BLOCK, world.network, policy=few.values["policy"])
    at = np.searchsorted(every.points.ids, few.points.ids)
    rows = (3 * at[:, None] + np.arange(3)).ravel()
    best = every.points.covariance[np.ix_(rows, rows)]
    # less control, never a smaller covariance (linearised elsewhere)
    assert la.eigh(best, few.points.covariance, eigvals_only=True)[-1] < 1.0 + 1e-3


def with_points(world: World, folder: Path, **points: PointTable) -> Catalogue:
    with CatalogueWriter(folder, world.catalogue.metadata) as writer:
        block = world.catalogue.block(BLOCK)
        writer.write_images(block.images)
        writer.write_block(block)
        writer.write_priors(world.catalogue.default_prior)
        for kind, table in points.items():
            writer.write_points(kind, table)  # type: ignore[arg-type]
    return Catalogue.open(folder)


def truth_of(world: World, ids: NDArray[np.str_], sigma: float, moved: float = 0.0) -> PointTable:
    truth = world.region.truth[np.searchsorted(world.region.point_ids, ids)].copy()
    truth[:, 2] += moved
    return PointTable(ids, truth, np.tile(sigma**2 * np.eye(3), (len(ids), 1, 1)), np.full(len(ids), "", dtype="U1"))


def test_surveyed_control_and_check_points_of_a_catalogue(world: World, tmp_path: Path) -> None:
    ids = np.unique(world.catalogue.block(BLOCK).point_ids)
    control, check = ids[::4], np.setdiff1d(ids, ids[::4])
    free = adjust(with_points(world, tmp_path / "free"), BLOCK)
    assert (free.values["status"], free.values["check"]) == ("uncontrolled", None)
    held = adjust(with_points(world, tmp_path / "held", control=truth_of(world, control, 0.1), check=truth_of(world, check, 0.1)), BLOCK)
    assert (held.values["status"], held.values["control_points"]) == ("controlled", len(control))
    assert held.values["check"]["points"] == len(check)
    assert held.values["check"]["horizontal"]["mean_ce90"] < 0.2 * np.mean(free.points.ce90)
    assert 0.5 < held.values["check"]["nees_per_dof"] < 1.6
    # check points take no part, wherever they are
    far = adjust(
        with_points(world, tmp_path / "far", control=truth_of(world, control, 0.1), check=truth_of(world, check, 0.1, 50.0)), BLOCK
    )  # fmt: skip
    np.testing.assert_array_equal(far.points.geocentric, held.points.geocentric)
    np.testing.assert_array_equal(far.points.covariance, held.points.covariance)
    assert far.values["check"]["vertical"]["p50"] > 45.0
    # a joint covariance that says the same gives the same
    table = truth_of(world, control, 0.1)
    joint = adjust(with_points(world, tmp_path / "joint", control=replace(table, joint_covariance=0.01 * np.eye(3 * len(control)))), BLOCK)
    sigma = np.sqrt(np.diag(held.points.covariance))
    assert np.abs((joint.points.geocentric - held.points.geocentric).ravel() / sigma).max() < 1e-6
    assert np.abs((joint.points.covariance - held.points.covariance) / sigma / sigma[:, None]).max() < 1e-8


def test_check_points_that_are_too_many_are_counted(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ids = np.unique(world.catalogue.block(BLOCK).point_ids)
    catalogue = with_points(world, tmp_path / "catalogue", check=truth_of(world, ids, 0.1))
    every = adjust(catalogue, BLOCK).values["check"]
    assert every["left_out"] == 0
    monkeypatch.setattr("orchestration.adjust.MOST_CHECKED", 7)
    few = adjust(catalogue, BLOCK).values["check"]
    assert (few["points"], few["left_out"]) == (7, every["points"] - 7)
    virtual = adjust(catalogue, BLOCK, virtual=VirtualDesign(3, 7.5)).values["check"]  # without covariance nothing is large
    assert virtual["points"] >= every["points"] and virtual["left_out"] == 0


@pytest.mark.parametrize(("block_id", "expected"), [("T-7", "block T-7"), ("block 5", "block 5"), ("Block_5", "Block_5")])
def test_a_block_is_called_one_once(block_id: str, expected: str) -> None:
    assert named(block_id) == expected


def diagonal(self: NetworkControl, block: ImageSet, points: NDArray[np.str_]) -> ControlledPrior:
    """The control with 3 x 3 covariances only: what must not be done."""
    whole = FULL(self, block, points)
    k = np.arange(len(whole.point))
    own = whole.covariance.reshape(len(k), 3, len(k), 3)[k, :, k, :]
    return surveyed(block.prior, block.parameters, whole.point, whole.position, own)


FULL = NetworkControl.prior


def test_nees_tells_the_whole_covariance_from_its_diagonal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nees = {"full": 0.0, "diagonal": 0.0}
    dof = 0
    for seed in range(12):
        world = make(replace(CLEAN, seed=100 + seed, priors=APriori(common_to_pass=0.0)), tmp_path / str(seed))
        for name, prior in (("full", FULL), ("diagonal", diagonal)):
            monkeypatch.setattr(NetworkControl, "prior", prior)
            adjusted = adjust(world.catalogue, BLOCK, world.network, policy="rigorous")
            error = np.concatenate([world.error(adjusted)])
            nees[name] += float(error @ np.linalg.solve(adjusted.points.covariance, error))
        dof += error.size
    low, high = nees_band(dof)
    assert low < nees["full"] / dof < high, nees["full"] / dof
    # about 2.1, ten half-widths of the band above 1
    assert nees["diagonal"] / dof > 1.0 + 6.0 * (high - 1.0), nees["diagonal"] / dof


def test_a_block_that_is_in_the_network_is_refused(world: World) -> None:
    with pytest.raises(InputError, match=r"image T000-001-FWD is in the network already, in block T000-001: .* use 'submin readjust'"):
        adjust(world.catalogue, "T000-001", world.network)


def test_without_common_points_a_block_is_uncontrolled(world: World, tmp_path: Path) -> None:
    block = world.catalogue.block(BLOCK)
    other = replace(block, point_ids=np.char.add("other/", block.point_ids))
    adjusted = adjust(world.with_block(tmp_path / "other", other), BLOCK, world.network)
    assert (adjusted.values["status"], adjusted.values["control_points"]) == ("uncontrolled", 0)
    assert adjusted.values["innovation"]["dof"] == 0
    # the images know of their pass what the network knows of it: a smaller covariance than by themselves
    free = adjust(world.with_block(tmp_path / "free", other), BLOCK)
    assert np.trace(adjusted.cameras.covariance) <= np.trace(free.cameras.covariance) * (1.0 + 1e-9)  # type: ignore[arg-type]


def test_virtual_control_leaves_everything_out_that_states_accuracy(world: World, tmp_path: Path) -> None:
    ids = np.unique(world.catalogue.block(BLOCK).point_ids)
    catalogue = with_points(world, tmp_path / "catalogue", check=truth_of(world, ids, 0.1))
    adjusted = adjust(catalogue, BLOCK, virtual=VirtualDesign(3, 7.5, "balanced"))
    write(adjusted, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"cameras.parquet", "points.parquet", "report.json"}
    cameras, points = (pq.read_table(tmp_path / "out" / f"{name}.parquet") for name in ("cameras", "points"))
    assert points.column_names == ["point_id", "x", "y", "z", "longitude", "latitude", "height", "rays"]
    assert not {"sigma", "covariance_file", "covariance_row"} & set(cameras.column_names)
    for table in (cameras, points):
        assert b"no accuracy is stated" in table.schema.metadata[b"accuracy"]
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["status"], report["virtual_points"]) == ("regularised", 27)
    assert (report["chi_square"], report["redundancy"], report["variance_factor"]) == (None, None, None)
    assert report["check"]["points"] == len(points) and "nees_per_dof" not in report["check"]
    assert report["check"]["rms_up"] < 60.0
    with pytest.raises(InputError, match="virtual control and a network are given"):
        adjust(world.catalogue, BLOCK, world.network, virtual=VirtualDesign(3, 7.5))


def test_a_block_of_several_sensors_in_a_network_of_one(world: World, tmp_path: Path) -> None:
    """Frame images beside RPC images: wider than any image of the network."""
    block = with_frames(world.catalogue.block(BLOCK), world.region)
    catalogue = world.with_block(tmp_path / "mixed", block)
    adjusted = adjust(catalogue, BLOCK, world.network, policy="rigorous")
    assert (adjusted.values["images"], adjusted.values["status"]) == (5, "controlled")
    assert set(adjusted.cameras.images.sensors) == {"rpc", "frame"}
    error = world.error(adjusted)
    nees = float(error @ np.linalg.solve(adjusted.points.covariance, error))
    low, high = nees_band(error.size, 0.999)
    assert low < nees / error.size < high
    write(adjusted, tmp_path / "out")
    rows = pq.read_table(tmp_path / "out" / "cameras.parquet").to_pylist()
    assert {row["unit"] for row in rows} >= {"px", "m", "rad"}
    alone = adjust(world.catalogue, BLOCK, world.network, policy="rigorous")
    assert np.median(adjusted.points.le90) < np.median(alone.points.le90)
