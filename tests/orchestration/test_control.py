"""Surveyed control: counted once, in any order, with its whole covariance, and withdrawn without a trace."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from networks import area_of, fuse, same_network

import submin
from orchestration.control import add_control
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.run import run
from orchestration.withdraw import withdraw
from submin.errors import InputError
from submin.geodesy import WGS84, Ellipsoid, geodetic_to_geocentric, local_axes
from submin.simulation.region import SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import PointTable
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.control_blocks import control_blocks

HERE = SerialExecutor()
MOON = Ellipsoid(1737400.0, 0.0)
EVERYWHERE = (90.0, 30.0, 110.0, 40.0)


def surveyed(region: SimulatedRegion, which: list[int], seed: int = 0, metres: float = 0.5) -> PointTable:
    """Some points of the region as a survey has them, with errors of a full covariance."""
    rng = np.random.default_rng(seed)
    covariance, errors = np.empty((len(which), 3, 3)), np.empty((len(which), 3))
    for k in range(len(which)):
        factor = metres * rng.normal(size=(3, 3))
        covariance[k] = factor @ factor.T + 0.04 * np.eye(3)
        errors[k] = np.linalg.cholesky(covariance[k]) @ rng.normal(size=3)
    truth = region.truth[which].copy()
    truth[:, 0] += errors[:, 0] / (111320.0 * np.cos(np.radians(truth[:, 1])))
    truth[:, 1] += errors[:, 1] / 111320.0
    truth[:, 2] += errors[:, 2]
    return PointTable(region.point_ids[which], truth, covariance, np.full(len(which), "", dtype="U1"))


@pytest.fixture
def control(region: SimulatedRegion) -> PointTable:
    return surveyed(region, [3, 40, 41, 77, 90, 150])


def test_control_does_what_the_covariance_says(complete: Path, base: Path, region: SimulatedRegion, control: PointTable) -> None:
    """Against the update of a joint covariance by observed coordinates: ``P - P H' (H P H' + C)^-1 H P``."""
    before = submin.open(complete).query(bbox=EVERYWHERE, policy="rigorous")
    added = add_control(control, "test", str(base), HERE)
    assert (added.fused, added.skipped, added.rejected, added.version) == (6, 0, (), "v2")
    after = submin.open(base).query(bbox=EVERYWHERE, policy="rigorous")
    assert after.ids.tolist() == before.ids.tolist()

    rows = np.searchsorted(before.ids, control.point_ids)
    axes = local_axes(control.geodetic)
    h = (3 * rows[:, None] + np.arange(3)).ravel()
    c = np.zeros((len(h), len(h)))
    for k in range(len(rows)):
        c[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = axes[k].T @ control.covariance_enu[k] @ axes[k]
    p = before.covariance
    gain = np.linalg.solve(p[np.ix_(h, h)] + c, p[h]).T
    misclosure = (geodetic_to_geocentric(control.geodetic, before.ellipsoid) - before.geocentric[rows]).ravel()
    expected, expected_p = before.geocentric.ravel() + gain @ misclosure, p - gain @ p[h]
    sigma = np.sqrt(np.diag(expected_p))
    # the network linearises anew where control has moved it; the formula does not
    assert np.abs((after.geocentric.ravel() - expected) / sigma).max() < 1e-3
    assert np.abs((after.covariance - expected_p) / sigma / sigma[:, None]).max() < 1e-3
    assert np.median(after.ce90) < 0.25 * np.median(before.ce90)
    error = after.geocentric - geodetic_to_geocentric(region.truth[np.searchsorted(region.point_ids, after.ids)], after.ellipsoid)
    nees = error.ravel() @ np.linalg.solve(after.covariance, error.ravel()) / error.size
    assert 0.8 < nees < 1.2


def test_control_first_or_last_is_the_same(
    region: SimulatedRegion, catalogue: Path, base: Path, control: PointTable, tmp_path: Path
) -> None:
    add_control(control, "test", str(base), HERE)
    first = tmp_path / "first"
    opened = Catalogue.open(catalogue)
    create(str(first), area_of(region), opened.metadata, 60.0, 20.0)
    add_control(control, "test", str(first), HERE)
    alone = submin.open(first).query(bbox=EVERYWHERE, policy="rigorous")
    assert alone.ids.tolist() == sorted(control.point_ids.tolist())
    order = np.argsort(control.point_ids)
    np.testing.assert_allclose(alone.local_covariance, control.covariance_enu[order], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(alone.geodetic, control.geodetic[order], rtol=0, atol=1e-8)
    run(opened, str(first), HERE, batch_blocks=5)
    same_network(base, first)


def test_withdrawn_control_was_never_there(complete: Path, base: Path, control: PointTable) -> None:
    add_control(control, "test", str(base), HERE)
    for point_id in control.point_ids:
        done = withdraw(str(base), HERE, control=str(point_id))
        assert (done.images, done.rays) == (0, 2)
    same_network(base, complete)
    assert add_control(control, "test", str(base), HERE).fused == 6  # it can come again


def test_one_view_of_a_control_point_cannot_be_withdrawn(base: Path, control: PointTable) -> None:
    add_control(control, "test", str(base), HERE)
    with pytest.raises(InputError, match="is a view of a control point; withdraw the point with --control"):
        withdraw(str(base), HERE, image=f"control:{control.point_ids[0]}:0")


def test_a_control_point_is_known_by_what_was_surveyed(control: PointTable) -> None:
    """Not by eigenvectors, of which another machine may find others."""
    (one, *_), (other, *_) = (list(control_blocks(control, ellipsoid, "test")) for ellipsoid in (WGS84, MOON))
    assert one.images != other.images
    assert one.content_hash() == other.content_hash()
    moved = PointTable(control.point_ids, control.geodetic + 1e-9, control.covariance_enu, control.area)
    assert next(iter(control_blocks(moved, WGS84, "test"))).content_hash() != one.content_hash()


def test_control_counts_once(base: Path, region: SimulatedRegion, control: PointTable) -> None:
    add_control(control, "test", str(base), HERE)
    again = add_control(control, "test", str(base), HERE)
    assert (again.fused, again.skipped, again.version) == (0, 6, "v2")
    other = surveyed(region, [3], seed=9)
    refused = add_control(other, "test", str(base), HERE)
    assert [r.point_id for r in refused.rejected] == [str(region.point_ids[3])]
    assert "already in the network with other values; withdraw it first" in refused.rejected[0].reason


def test_control_of_a_catalogue_is_fused_with_it(
    region: SimulatedRegion, catalogue: Path, base: Path, control: PointTable, tmp_path: Path
) -> None:  # fmt: skip
    source = Catalogue.open(catalogue)
    with CatalogueWriter(tmp_path / "with", source.metadata) as writer:
        writer.write_images(source.images)
        for block in source.blocks():
            writer.write_block(block)
        writer.write_priors(source.default_prior, source.priors)
        writer.write_points("control", control)
    result = fuse(tmp_path / "with", tmp_path / "network", area_of(region))
    assert (result.fused, result.control_fused, result.rejected) == (12, 6, ())
    add_control(control, "test", str(base), HERE)
    same_network(base, tmp_path / "network")
    assert fuse(tmp_path / "with", tmp_path / "network", area_of(region)).control_fused == 0


def test_control_elsewhere_is_refused(base: Path, region: SimulatedRegion) -> None:
    moved = surveyed(region, [3])
    moved.geodetic[0, 1] += 0.02  # 2 km
    (refused,) = add_control(moved, "test", str(base), HERE).rejected
    assert re.search(rf"point {region.point_ids[3]} is measured 2\.\d km from where other rays place it", refused.reason)
    far = PointTable(np.array(["far"]), np.array([[10.0, 10.0, 0.0]]), np.eye(3)[None], np.array([""]))
    (refused,) = add_control(far, "test", str(base), HERE).rejected
    assert "outside the area" in refused.reason
    assert len(submin.open(base).query(bbox=EVERYWHERE)) > 100
