"""One simulated region and the network of all its blocks, for tests that change copies of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from networks import SMALL, area_of, fuse

from submin.simulation.region import SimulatedRegion, simulate_region
from submin.storage.simulated import write_region


@pytest.fixture(scope="package")
def region() -> SimulatedRegion:
    return simulate_region(SMALL)


@pytest.fixture(scope="package")
def catalogue(region: SimulatedRegion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("region") / "catalogue"
    write_region(region, path)
    return path


@pytest.fixture(scope="package")
def complete(region: SimulatedRegion, catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The network of all blocks. Not to be changed."""
    network = tmp_path_factory.mktemp("complete") / "network"
    fuse(catalogue, network, area_of(region))
    return network


@pytest.fixture
def base(complete: Path, tmp_path: Path) -> Path:
    """A copy of the network of all blocks, to be changed."""
    return Path(shutil.copytree(complete, tmp_path / "base"))
