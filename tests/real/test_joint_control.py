"""Real geodetic solutions as control of a factored network: the covariance that comes out is the one that the files state."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely

import submin
from orchestration.control import add_control
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.run import run
from submin.errors import InputError
from submin.geodesy import WGS84, geodetic_to_geocentric
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import CatalogueMetadata
from submin.storage.gnss_import import import_gnss
from submin.storage.point_table import read_point_table
from submin.storage.sinex_import import import_solution

HERE = SerialExecutor()
AUSTRALIA = shapely.box(93.0, -50.0, 179.9, 0.0)


def test_the_58_station_solution_lies_in_a_tiled_network_as_it_is(data: Path, tmp_path: Path) -> None:
    import_gnss(data / "apr_itrf2008_continental" / "apr.ITRF2008.04.06.2020.msr.gz", tmp_path / "catalogue", shared_ids=True)
    catalogue = Catalogue.open(tmp_path / "catalogue")
    (cluster,) = catalogue.observations()
    network = str(tmp_path / "network")
    create(network, AUSTRALIA, catalogue.metadata, 4000.0, 500.0)
    result = run(catalogue, network, HERE)
    assert (result.observations_fused, result.rejected, result.contradicted) == (1, (), ())
    # stations outside the area belong to the nearest tiles
    answer = submin.open(network).query(points=cluster.from_ids, policy="rigorous")
    assert len(answer) == len(cluster) == 58 and len(answer.tiles) > 1
    order = np.argsort(cluster.from_ids)
    at = (3 * order[:, None] + np.arange(3)).ravel()
    stated = cluster.covariance[np.ix_(at, at)]
    sigma = np.sqrt(np.diag(stated))
    assert np.abs((answer.covariance - stated) / sigma / sigma[:, None]).max() < 1e-9
    assert np.abs(answer.geocentric - cluster.values[order]).max() < 2e-9
    assert run(catalogue, network, HERE).version == result.version


def test_a_sinex_solution_is_control_as_it_is(data: Path, tmp_path: Path) -> None:
    import_solution(data / "sinex_full_covariance" / "TEST_ITRF05.SNX", tmp_path / "control.parquet")
    points = read_point_table(tmp_path / "control.parquet", "definite")
    assert points.joint_covariance is not None
    area = shapely.box(*points.geodetic[:, :2].min(axis=0) - 0.2, *points.geodetic[:, :2].max(axis=0) + 0.2)
    network = str(tmp_path / "network")
    create(network, area, CatalogueMetadata("sinex"), 1000.0, 300.0)
    assert add_control(points, "control.parquet", network, HERE).fused == len(points)
    answer = submin.open(network).query(points=points.point_ids, policy="rigorous")
    order = np.argsort(points.point_ids)
    at = (3 * order[:, None] + np.arange(3)).ravel()
    stated = points.joint_covariance[np.ix_(at, at)]
    sigma = np.sqrt(np.diag(stated))
    assert np.abs((answer.covariance - stated) / sigma / sigma[:, None]).max() < 1e-9
    assert np.abs(answer.geocentric - geodetic_to_geocentric(points.geodetic[order], WGS84)).max() < 2e-9


def test_baselines_are_refused_before_anything_is_written(data: Path, tmp_path: Path) -> None:
    folder = data / "dynadjust_gnss_network"
    import_gnss(folder / "gnss-network.msr", tmp_path / "catalogue", values=folder / "measured_gda2020.csv", shared_ids=True)
    catalogue = Catalogue.open(tmp_path / "catalogue")
    network = str(tmp_path / "network")
    create(network, AUSTRALIA, catalogue.metadata, 4000.0, 500.0)
    with pytest.raises(InputError, match=r"observations: cluster .*: baseline from \S+ to \S+; expected positions: .*--form dense"):
        run(catalogue, network, HERE)
    assert submin.open(network).version == "v0"
