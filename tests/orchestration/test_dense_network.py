"""Dense networks on disk: clusters, control and blocks of images, each exactly once; what is stored is what is in memory."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dense_networks import assert_equal, mixed_cluster, position_cluster, simultaneous, truth, victoria
from networks import area_of, by_image, rewrite
from numpy.typing import NDArray

import submin
from orchestration import dense_run
from orchestration.adjust import adjust
from orchestration.check import check
from orchestration.create import create, fit_points
from orchestration.dense_run import DenseRunResult, add_dense_control, run_dense, withdraw_dense
from orchestration.diff import difference
from orchestration.info import describe
from orchestration.readjust import readjust_network
from submin.adjustment.priors import APriori
from submin.errors import BusyError, InputError, QueryError
from submin.geodesy import WGS84, geocentric_to_geodetic
from submin.network.observations import Cluster
from submin.network.pending import DenseNetwork
from submin.simulation.region import SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import CatalogueMetadata, PointTable
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.commit import commit
from submin.storage.dense_store import read_state
from submin.storage.network import Network
from submin.storage.repository import versions
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import writing

Array = NDArray[np.float64]
METADATA = CatalogueMetadata("survey")


def catalogue_of(clusters: Sequence[Cluster], path: Path, control: PointTable | None = None) -> Catalogue:
    with CatalogueWriter(path, METADATA) as writer:
        for cluster in clusters:
            writer.write_observations(cluster)
        if control is not None:
            writer.write_points("control", control)
    return Catalogue.open(path)


def network_of(
    clusters: Sequence[Cluster], folder: Path, batch: int = 500, control: PointTable | None = None
) -> tuple[Path, DenseRunResult]:
    catalogue, place = catalogue_of(clusters, folder / "catalogue", control), folder / "network"
    create(str(place), fit_points(catalogue), catalogue.metadata, None, None, "dense")
    return place, run_dense(catalogue, str(place), batch_blocks=batch)


@pytest.fixture(scope="module")
def survey() -> tuple[dict[str, Array], list[Cluster]]:
    """260 points in clusters: more than one panel of the covariance, and several chunks."""
    rng = np.random.default_rng(11)
    at = truth(rng, 260)
    ids = list(at)
    clusters = [mixed_cluster(rng, at, f"cluster {k:03d}", 0.1) for k in range(90)]
    return at, [*clusters, *(position_cluster(rng, at, f"positions {k}", ids[k::6]) for k in range(6))]


@pytest.fixture(scope="module")
def fused(survey: tuple[dict[str, Array], list[Cluster]], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DenseRunResult]:
    """The network of all clusters, in two batches, beside its catalogue. Not to be changed."""
    return network_of(survey[1], tmp_path_factory.mktemp("survey"), batch=60)


@pytest.fixture
def base(fused: tuple[Path, DenseRunResult], tmp_path: Path) -> Path:
    """A copy of it, to be changed."""
    return Path(shutil.copytree(fused[0], tmp_path / "base"))


def point_table(at: dict[str, Array], ids: Sequence[str], joint: Array | None = None) -> PointTable:
    geodetic = geocentric_to_geodetic(np.stack([at[i] for i in ids]), WGS84)
    return PointTable(np.array(ids), geodetic, np.tile(1e-4 * np.eye(3), (len(ids), 1, 1)), np.full(len(ids), ""), joint)


def same(one: Path, other: Path) -> None:
    """Equal points, positions, covariances and chi-square, beyond round-off."""
    a, b = (submin.open(place).query(tile="r000c000") for place in (one, other))
    np.testing.assert_array_equal(a.ids, b.ids)
    sigma = np.sqrt(np.diag(a.covariance))
    np.testing.assert_allclose((a.geocentric - b.geocentric).ravel(), 0.0, atol=2e-9)  # what a coordinate resolves
    np.testing.assert_allclose((a.covariance - b.covariance) / np.outer(sigma, sigma), 0.0, atol=1e-9)
    np.testing.assert_array_equal(a.rays, b.rays)
    facts, others = describe(submin.open(one)), describe(submin.open(other))
    assert facts["chi_square"] == pytest.approx(others["chi_square"], rel=1e-9)
    assert facts["degrees_of_freedom"] == others["degrees_of_freedom"]
    assert facts["blocks"] == others["blocks"]


def test_a_run_is_the_state_in_memory_and_the_least_squares(
    survey: tuple[dict[str, Array], list[Cluster]], fused: tuple[Path, DenseRunResult]
) -> None:  # fmt: skip
    at, clusters = survey
    place, done = fused
    assert (done.version, done.fused, done.skipped, done.rejected, done.pending) == ("v2", len(clusters), 0, (), ())
    stored = read_state(Snapshot.open(str(place)))
    memory = DenseNetwork()
    for start in range(0, len(clusters), 60):
        memory.add(clusters[start : start + 60])
    rows = memory.state.rows_of(stored.ids)
    np.testing.assert_allclose(stored.covariance(np.arange(len(stored))), memory.state.covariance(rows), rtol=0.0, atol=1e-18)
    np.testing.assert_allclose(stored.geocentric, memory.state.geocentric[rows], rtol=0.0, atol=2e-9)
    expected = simultaneous(clusters, at)
    assert_equal(stored, expected)
    assert done.chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    assert done.degrees_of_freedom == expected.redundancy


def test_a_query_is_the_marginal_of_the_state(
    survey: tuple[dict[str, Array], list[Cluster]], fused: tuple[Path, DenseRunResult], tmp_path: Path
) -> None:  # fmt: skip
    clusters, place = survey[1], fused[0]
    network, state = submin.open(place), read_state(Snapshot.open(str(place)))
    names = np.array(sorted(state.ids.tolist()))
    wanted = names[[250, 3, 77]]
    found = network.query(points=wanted)
    rows = state.rows_of(np.sort(wanted))
    np.testing.assert_array_equal(found.ids, np.sort(wanted))
    np.testing.assert_allclose(found.covariance, state.covariance(rows), rtol=0.0, atol=1e-18)
    np.testing.assert_array_equal(found.geocentric, state.geocentric[rows])
    assert (found.policy, found.scope, found.tiles, found.version) == ("tile", "network", ("r000c000",), "v2")
    assert len(found.blocks) == len(clusters)
    of_point = sum(int((c.from_ids == wanted[0]).sum() + (c.to_ids == wanted[0]).sum()) for c in clusters)
    assert found.rays[found.ids == wanted[0]] == of_point
    whole = network.query(tile="r000c000")
    np.testing.assert_array_equal(network.tile("r000c000").covariance(wanted.tolist()), found.covariance)
    low, high = np.median(whole.geodetic[:, :2], axis=0), whole.geodetic[:, :2].max(axis=0) + 1e-6
    part = network.query(bbox=(*low, *high))
    inside = (whole.geodetic[:, :2] >= low).all(axis=1)
    np.testing.assert_array_equal(part.ids, whole.ids[inside])
    assert 0 < len(part) < len(whole)
    alone = network.accuracy(bbox=(*low, *high))
    by_id, every = np.argsort(alone.ids), network.accuracy()
    np.testing.assert_array_equal(alone.ids[by_id], part.ids)
    np.testing.assert_allclose(alone.local_covariance[by_id], part.local_covariance, rtol=1e-12)
    np.testing.assert_allclose(every.ce90[np.argsort(every.ids)], whole.ce90, rtol=1e-12)
    few = network.query(tile="r000c000", max_points=7)
    assert len(few) == 7
    with pytest.raises(QueryError, match="max_points is 0; expected 1 or more"):
        network.query(tile="r000c000", max_points=0)
    for policy in ("rigorous", "ci"):
        with pytest.raises(QueryError, match="one tile and nothing to merge"):
            network.query(tile="r000c000", policy=policy)
    with pytest.raises(QueryError, match="1 of 2 points are not in the network or not yet determined: nowhere"):
        network.query(points=["p000", "nowhere"])
    whole.to_npz(tmp_path / "whole.npz")
    np.testing.assert_array_equal(np.load(tmp_path / "whole.npz")["covariance"], whole.covariance)


def test_the_same_again_is_skipped_and_other_content_rejected(survey: tuple[dict[str, Array], list[Cluster]], tmp_path: Path) -> None:
    at, clusters = survey
    place, first = network_of(clusters[30:], tmp_path)
    again = run_dense(Catalogue.open(tmp_path / "catalogue"), str(place))
    assert (again.version, again.fused, again.skipped) == (first.version, 0, len(clusters) - 30)
    changed = dataclasses.replace(clusters[40], values=clusters[40].values + 0.001)
    more = catalogue_of([changed, *clusters[:30]], tmp_path / "more")
    done = run_dense(more, str(place))
    assert (done.fused, done.skipped, len(done.rejected)) == (30, 0, 1)
    assert done.rejected[0].block_id == clusters[40].cluster_id
    assert "already in the network with other content; withdraw it first" in done.rejected[0].reason
    assert_equal(read_state(Snapshot.open(str(place))), simultaneous(clusters, at))
    version = done.version
    assert run_dense(more, str(place)).version == version, "a rejection that was said before is said again in the store"


def test_random_batches_are_all_at_once(data: Path, tmp_path: Path) -> None:
    """The real GNSS network: its positions come in some batch, and baselines before them wait."""
    clusters = victoria(data)
    whole, done = network_of(clusters, tmp_path / "whole")
    assert (done.points, done.degrees_of_freedom, done.pending) == (43, 288, ())
    rng = np.random.default_rng(4)
    order = rng.permutation(len(clusters))
    place = tmp_path / "parts"
    create(str(place), fit_points(Catalogue.open(tmp_path / "whole" / "catalogue")), METADATA, None, None, "dense")
    waiting = []
    for k, part in enumerate(np.array_split(order, 5)):
        step = run_dense(catalogue_of([clusters[i] for i in part], tmp_path / f"catalogue {k}"), str(place))
        waiting.append(len(step.pending))
    assert waiting[0] > 0
    assert waiting[-1] == 0
    same(place, whole)
    assert describe(submin.open(place, "v1"))["blocks_pending"] == waiting[0]


def test_what_is_withdrawn_was_never_there(survey: tuple[dict[str, Array], list[Cluster]], tmp_path: Path) -> None:
    at, clusters = survey
    control = point_table(at, ["p001", "p002"])
    place, done = network_of(clusters, tmp_path / "all", control=control)
    assert done.control_fused == 2
    gone = ["cluster 007", "cluster 070"]
    for name in gone:
        left = withdraw_dense(str(place), block=name)
    assert left.rays == len(next(c for c in clusters if c.cluster_id == gone[1]))
    withdraw_dense(str(place), control="p002")
    never, _ = network_of([c for c in clusters if c.cluster_id not in gone], tmp_path / "never", control=point_table(at, ["p001"]))
    same(place, never)
    assert describe(submin.open(place, done.version))["blocks"] == len(clusters), "an earlier version has changed"
    back = run_dense(Catalogue.open(tmp_path / "all" / "catalogue"), str(place))
    assert (back.fused, back.control_fused, back.rejected) == (2, 1, ())
    whole, _ = network_of(clusters, tmp_path / "whole", control=control)
    same(place, whole)
    for asked in ({"block": "nothing"}, {"control": "p003"}, {"block": "control:p001"}):
        with pytest.raises(InputError, match="is not in the network"):
            withdraw_dense(str(place), **asked)
    with pytest.raises(InputError, match="keeps points and no images"):
        withdraw_dense(str(place), image="image")


def test_correlated_control_is_one_set(survey: tuple[dict[str, Array], list[Cluster]], base: Path) -> None:
    (at, clusters), place = survey, base
    ids = ["p010", "p020", "p030"]
    joint = 1e-6 * (np.kron(np.ones((3, 3)), np.eye(3)) + np.eye(9))
    table = point_table(at, ids, joint)
    before = submin.open(place).query(tile="r000c000").covariance
    added = add_dense_control(table, str(place))
    assert (added.fused, added.skipped, added.rejected) == (3, 0, ())
    assert add_dense_control(table, str(place)).skipped == 3
    after = submin.open(place).query(tile="r000c000").covariance
    assert np.linalg.eigvalsh(before - after)[0] > -1e-9 * np.trace(before)
    set_of_points = Cluster("control:p010 and 2 more", np.array(ids), np.full(3, ""), np.stack([at[i] for i in ids]), joint)
    assert_equal_but_for_height(place, [*clusters, set_of_points], at)
    moved = dataclasses.replace(table, joint_covariance=2.0 * joint)
    assert "with other values" in add_dense_control(moved, str(place)).rejected[0].reason
    facts = describe(submin.open(place))
    assert facts["control_points"] == 3
    alone = add_dense_control(point_table(at, ["p020"]), str(place))
    assert "p020 is control of the network already" in alone.rejected[0].reason
    found = check(submin.open(place), point_table(at, [*ids, "p040", "p050"]), "rigorous")
    assert (found.control_left_out, found.accuracy.points, found.policy) == (3, 2, "tile")
    assert withdraw_dense(str(place), control="p030").rays == 3


def assert_equal_but_for_height(place: Path, clusters: Sequence[Cluster], at: dict[str, Array]) -> None:
    """Control goes through longitude, latitude and height: its positions differ by nanometres."""
    expected = simultaneous(clusters, at)
    found = submin.open(place).query(tile="r000c000")
    sigma = np.sqrt(np.diag(expected.covariance))
    np.testing.assert_allclose(found.geocentric.ravel(), (expected.origin.ravel() + expected.adjustment), rtol=0.0, atol=1e-8)
    np.testing.assert_allclose((found.covariance - expected.covariance) / np.outer(sigma, sigma), 0.0, atol=1e-9)


def test_what_cannot_come_in_is_told_and_the_rest_comes(survey: tuple[dict[str, Array], list[Cluster]], tmp_path: Path) -> None:
    at, clusters = survey
    far = dataclasses.replace(position_cluster(np.random.default_rng(0), at, "far", ["p005"]), values=at["p005"][None] + 2000.0)
    place, done = network_of([*clusters[-6:], far], tmp_path)
    assert [r.block_id for r in done.rejected] == ["far"]
    assert "point p005 is 3.5 km from where the network has it" in done.rejected[0].reason
    assert done.fused == 6
    assert (place / "writer.lock").exists()
    with writing(str(place)), pytest.raises(BusyError):
        run_dense(Catalogue.open(tmp_path / "catalogue"), str(place))
    other = tmp_path / "other"
    with CatalogueWriter(other, CatalogueMetadata("other", frame="ITRF2020")) as writer:
        writer.write_observations(clusters[0])
    with pytest.raises(InputError, match="frame is 'ITRF2020'"):
        run_dense(Catalogue.open(other), str(place))
    assert [v.name for v in versions(str(place))] == ["v1", "v0"]


def test_a_block_that_hardly_agrees_is_told(survey: tuple[dict[str, Array], list[Cluster]], base: Path, tmp_path: Path) -> None:
    at, clusters = survey
    good = position_cluster(np.random.default_rng(3), at, "good", ["p007", "p008"])
    wrong = dataclasses.replace(good, cluster_id="wrong", values=good.values + np.array([0.2, 0.0, 0.0]))
    done = run_dense(catalogue_of([good, wrong], tmp_path / "more"), str(base))
    assert [d.block_ids for d in done.doubtful] == [("wrong",)]
    assert done.doubtful[0].degrees_of_freedom == 6
    assert done.to_json()["blocks_doubtful"][0]["probability"] < 1e-6
    assert len(submin.open(base).query(tile="r000c000").blocks) == len(clusters) + 2


def test_a_change_that_is_not_committed_is_not_there(
    survey: tuple[dict[str, Array], list[Cluster]], fused: tuple[Path, DenseRunResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """A run that ends between two commits: the same command again completes it."""
    _, clusters = survey
    catalogue = catalogue_of(clusters, tmp_path / "catalogue")
    place = tmp_path / "network"
    create(str(place), fit_points(catalogue), catalogue.metadata, None, None, "dense")
    commits = []

    def second_fails(*arguments: Any) -> None:
        commits.append(arguments)
        if len(commits) == 2:
            raise KeyboardInterrupt
        commit(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(dense_run, "commit", second_fails)
        with pytest.raises(KeyboardInterrupt):
            run_dense(catalogue, str(place), batch_blocks=30)
    assert versions(str(place))[0].name == "v1"
    rest = run_dense(catalogue, str(place), batch_blocks=30)
    assert (rest.skipped, rest.fused) == (30, len(clusters) - 30)
    same(place, fused[0])


# -- blocks of images


@pytest.fixture(scope="module")
def images(region: SimulatedRegion, catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The catalogue of a region whose passes have no errors in common."""
    out = tmp_path_factory.mktemp("uncorrelated") / "catalogue"
    blocks = [dataclasses.replace(block, a_priori=APriori(common_to_pass=0.0)) for block in Catalogue.open(catalogue).blocks()]
    with CatalogueWriter(out, Catalogue.open(catalogue).metadata) as writer:
        writer.write_images(image for block in blocks for image in block.images)
        for block in blocks:
            writer.write_block(block)
        writer.write_priors(APriori(common_to_pass=0.0))
    return out


def test_blocks_of_images_come_as_their_points(region: SimulatedRegion, images: Path, tmp_path: Path) -> None:
    opened, dense = Catalogue.open(images), tmp_path / "dense"
    create(str(dense), area_of(region), opened.metadata, None, None, "dense")
    done = run_dense(opened, str(dense), batch_blocks=5)
    assert (done.fused, done.rejected, done.version) == (12, (), "v3")
    network = submin.open(dense)
    facts = describe(network)
    # a block's rays are counted once, whatever of them stayed in its own adjustment
    assert facts["variance_factor"] == pytest.approx(1.0, abs=0.2)
    found = network.query(tile="r000c000")
    row = {str(i): k for k, i in enumerate(region.point_ids)}
    at = np.array([row[str(i)] for i in found.ids])
    error = (found.geocentric - _geocentric(region)[at]).ravel()
    nees = float(error @ np.linalg.solve(found.covariance, error)) / error.size
    assert nees == pytest.approx(1.0, abs=0.25)
    assert run_dense(opened, str(dense)).skipped == 12
    block = next(opened.blocks())
    same_images = dataclasses.replace(block, block_id="again", images=tuple(dataclasses.replace(i, block_id="again") for i in block.images))
    twice = run_dense(Catalogue.open(rewrite(images, tmp_path / "twice", [same_images])), str(dense))
    assert "an image counts once" in twice.rejected[0].reason
    assert withdraw_dense(str(dense), block=block.block_id).images == len(block.images)
    assert run_dense(opened, str(dense)).fused == 1


def test_a_dense_network_controls_new_images(region: SimulatedRegion, images: Path, tmp_path: Path) -> None:
    opened, dense = Catalogue.open(images), tmp_path / "dense"
    blocks = list(opened.blocks())
    create(str(dense), area_of(region), opened.metadata, None, None, "dense")
    run_dense(Catalogue.open(rewrite(images, tmp_path / "some", blocks[1:])), str(dense))
    controlled = adjust(opened, blocks[0].block_id, network=str(dense))
    assert controlled.values["control_points"] > 10
    assert controlled.values["policy"] == "tile"


def test_blocks_of_one_pass_are_correlated_and_refused(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    blocks = by_image(next(Catalogue.open(catalogue).blocks()))[:2]
    shared = [dataclasses.replace(block, images=tuple(dataclasses.replace(i, pass_id="one pass") for i in block.images)) for block in
              list(Catalogue.open(catalogue).blocks())[:2]]  # fmt: skip
    assert blocks
    opened = Catalogue.open(rewrite(catalogue, tmp_path / "shared", shared))
    dense = tmp_path / "dense"
    create(str(dense), area_of(region), opened.metadata, None, None, "dense")
    done = run_dense(opened, str(dense))
    assert done.fused == 1
    assert f"share errors of pass one pass with those of block {shared[0].block_id}" in done.rejected[0].reason


def test_what_needs_images_is_refused(survey: tuple[dict[str, Array], list[Cluster]], images: Path, tmp_path: Path) -> None:
    _, clusters = survey
    place, _ = network_of(clusters[-3:], tmp_path)
    with pytest.raises(InputError, match="dense network, which keeps points and no images; readjustment"):
        readjust_network(Catalogue.open(images), str(place), tmp_path / "out")
    with pytest.raises(InputError, match="a covariance between tiles expects a factored one"):
        submin.open(place).cross_covariance("r000c000", "r000c000", ["p000"], ["p001"])
    with pytest.raises(InputError, match="--tile-km and --overlap-km say nothing of a dense network"):
        create(str(tmp_path / "other"), fit_points(Catalogue.open(tmp_path / "catalogue")), METADATA, 10.0, None, "dense")
    baselines = [dataclasses.replace(c) for c in clusters[:60] if not c.positions.any()]
    with pytest.raises(InputError, match="places no point"):
        fit_points(catalogue_of(baselines, tmp_path / "baselines"))


def test_versions_differ_by_what_came(survey: tuple[dict[str, Array], list[Cluster]], tmp_path: Path) -> None:
    _, clusters = survey
    place, _ = network_of([*clusters[-6:], *clusters[:50]], tmp_path, batch=6)
    network = submin.open(place)
    found = difference(network.at("v1"), network)
    assert len(found.ids) == 260
    assert isinstance(network, Network)
    assert 0.0 < found.horizontal.max() < 1.0
    assert json.dumps(found.to_json())


def _geocentric(region: SimulatedRegion) -> Array:
    from submin.geodesy import geodetic_to_geocentric

    return geodetic_to_geocentric(region.truth, WGS84)
