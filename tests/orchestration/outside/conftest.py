"""A wide simulated region, and networks of some of its blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from growing import HERE, quiet
from networks import area_of, rewrite

from orchestration.create import create
from orchestration.run import run
from submin.simulation.region import RegionDesign, SimulatedRegion, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.simulated import write_region

DESIGN = RegionDesign(width_km=190, height_km=190, point_spacing_km=10.0)
"""35 triplets in 7 passes, images of 52 km."""


@pytest.fixture(scope="package")
def region() -> SimulatedRegion:
    return simulate_region(DESIGN)


@pytest.fixture(scope="package")
def catalogue(region: SimulatedRegion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("wide") / "catalogue"
    write_region(region, path)
    return path


@pytest.fixture(scope="package")
def blocks(catalogue: Path) -> list[Block]:
    return list(Catalogue.open(catalogue).blocks())


@pytest.fixture
def fuse(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> Callable[..., Path]:
    """Fuse some blocks into a network, made over the region when there is none."""

    def run_blocks(blocks: Sequence[Block], name: str = "network", tile_km: float = 40.0, overlap_km: float = 15.0, **more: int) -> Path:
        place, number = tmp_path / name, len(list(tmp_path.iterdir()))
        if not place.exists():
            create(str(place), area_of(region), Catalogue.open(catalogue).metadata, tile_km, overlap_km, **more)
        result = run(Catalogue.open(rewrite(catalogue, tmp_path / f"blocks-{number}", list(blocks))), str(place), HERE)
        assert result.fused == len(blocks)
        return place

    return run_blocks


@pytest.fixture
def few(region: SimulatedRegion, blocks: list[Block]) -> list[Block]:
    return quiet(blocks, region)[:16]
