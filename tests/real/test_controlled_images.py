"""Real images controlled one by one: 16 WorldView-3 images make a network, three more are adjusted by it, one of them with a bad camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
from networks import fuse, rewrite

import submin
from orchestration.adjust import adjust
from orchestration.readjust import readjust_network
from submin.query import rigorous
from submin.sensors import sensor_named
from submin.storage.catalogue import Catalogue
from submin.storage.rpc_import import import_rpc

NAME = "wv3_jax068"
AREA = shapely.box(-81.6655, 30.3475, -81.6620, 30.3502)
APART = ("JAX_068_003_RGB", "JAX_068_007_RGB", "JAX_068_016_RGB")
BAD_CAMERA = "JAX_068_016_RGB"


@pytest.fixture(scope="module")
def catalogue(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    source, folder = data / NAME, tmp_path_factory.mktemp("jacksonville") / "catalogue"
    import_rpc(source / "images.csv", source / "rpc_raw", source / "tracks.csv.gz", folder, blocks="image")
    return Catalogue.open(folder)


@pytest.fixture(scope="module")
def network(catalogue: Catalogue, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of all images but three."""
    folder = tmp_path_factory.mktemp("controlled")
    part = rewrite(catalogue.path, folder / "part", [block for block in catalogue.blocks() if block.block_id not in APART])
    assert fuse(part, folder / "network", AREA, tile_km=0.15, overlap_km=0.05).fused == 16
    return str(folder / "network")


@pytest.mark.parametrize("block", APART)
def test_an_image_is_controlled_as_if_it_had_been_fused(block: str, catalogue: Catalogue, network: str, tmp_path: Path) -> None:
    adjusted = adjust(catalogue, block, network, policy="rigorous")
    values = adjusted.values
    assert values["status"] == "controlled" and values["control_points"] > 200
    assert len(values["control_rejected"]) < 0.02 * values["control_points"]  # wrong matches, which nothing else could see
    assert [flag["image_id"] for flag in values["images_flagged"]] == [name for name in [block] if name == BAD_CAMERA]
    assert np.hypot(*adjusted.cameras.theta[0, [0, 3]]) == pytest.approx(38.0 if block == BAD_CAMERA else 1.0, abs=1.0)
    assert values["innovation"]["probability"] > 0.01

    together = rewrite(catalogue.path, tmp_path / "part", [b for b in catalogue.blocks() if b.block_id not in APART or b.block_id == block])
    fuse(together, tmp_path / "network", AREA, tile_km=0.15, overlap_km=0.05)
    fused = submin.open(tmp_path / "network").query(points=adjusted.points.ids, policy="rigorous")
    assert fused.ids.tolist() == adjusted.points.ids.tolist()
    sigma = np.sqrt(np.diag(fused.covariance)).reshape(-1, 3)
    off = np.abs(adjusted.points.geocentric - fused.geocentric) / sigma
    # a fused blunder is judged with all rays of its point, so a few points may differ
    assert np.quantile(off, 0.95) < 0.05
    ratio = adjusted.points.point_covariance.trace(axis1=1, axis2=2) / fused.point_covariance.trace(axis1=1, axis2=2)
    assert np.median(ratio) == pytest.approx(1.0, abs=1e-3)


def test_readjusted_images_are_those_of_the_sub_min(catalogue: Catalogue, network: str, tmp_path: Path) -> None:
    """Against the corrections and covariance that the network has in factored form."""
    result = readjust_network(catalogue, network, tmp_path / "out", policy="rigorous")
    assert (result.images, len(result.blocks_missing)) == (16, 3)
    opened = submin.open(network)
    state = rigorous.estimate(opened, opened.snapshot.tile_numbers(), np.arange(16, dtype=np.int32), [])
    ids = opened.snapshot.image_columns(["image_id"])["image_id"]
    rows = pq.read_table(tmp_path / "out" / "cameras.parquet").to_pylist()
    names = [parameter.name for parameter in sensor_named("rpc").parameters]
    at = np.array([6 * ids.tolist().index(row["image_id"]) + names.index(row["parameter"]) for row in rows])
    assert sorted(at.tolist()) == list(range(6 * 16))
    sigma = np.sqrt(np.diag(state.covariance)[at])
    assert (np.abs(np.array([row["correction"] for row in rows]) - state.theta.ravel()[at]) / sigma).max() < 1e-8
    assert np.abs(np.array([row["sigma"] for row in rows]) / sigma - 1.0).max() < 1e-8
