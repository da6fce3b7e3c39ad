"""Variance factors by sensor: 1 where stated sigmas are true, and as large as they are wrong where they are not."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from networks import area_of, fuse

from orchestration.executors import SerialExecutor
from orchestration.verify import verify
from submin.network.variance_factor import Fits, pooled
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.simulated import write_region


def test_a_platform_that_measures_worse_than_it_says_is_found(tmp_path: Path) -> None:
    """Half of the blocks are of a platform whose measurements are 1.5 times as inaccurate as stated."""
    region = simulate_region(RegionDesign(width_km=120, height_km=120, point_spacing_km=9.5, blunder_rate=0.0, bad_cameras=0, seed=4))
    write_region(region, tmp_path / "true")
    source = Catalogue.open(tmp_path / "true")
    with CatalogueWriter(tmp_path / "stated", source.metadata) as writer:
        blocks = []
        for k, block in enumerate(source.blocks()):
            scale = 1.5 if k % 2 else 1.0
            images = tuple(dataclasses.replace(image, platform="worse" if k % 2 else "good") for image in block.images)
            blocks.append(dataclasses.replace(
                block, images=images, sigma_sample=block.sigma_sample / scale, sigma_line=block.sigma_line / scale
            ))  # fmt: skip
        writer.write_images(image for block in blocks for image in block.images)
        for block in blocks:
            writer.write_block(block)
        writer.write_priors(source.default_prior, source.priors)
    fuse(tmp_path / "stated", tmp_path / "network", area_of(region))
    found = verify(str(tmp_path / "network"), SerialExecutor())
    assert found.ok
    good, worse = found.variance_factors
    assert [(v.sensor, v.platform) for v in (good, worse)] == [("rpc", "good"), ("rpc", "worse")]
    assert good.redundancy > 300
    assert worse.redundancy > 300
    assert good.factor == pytest.approx(1.0, abs=2.5 * good.sigma)
    assert worse.factor == pytest.approx(2.25, abs=2.5 * 2.25 * worse.sigma)
    values = found.to_json()["variance_factors"]
    assert [v["platform"] for v in values] == ["good", "worse"]
    assert [v["factor"] for v in values] == [good.factor, worse.factor]


def test_fits_of_tiles_add_and_groups_are_told_apart() -> None:
    a, b = ("rpc", "a"), ("rpc", "b")
    shares = np.array([[8.0, 3.0], [3.0, 5.0]])
    parts = [Fits((a, b), shares @ [1.0, 2.25], shares), Fits((b,), np.array([2.25 * 4.0]), np.array([[4.0]]))]
    one, other = pooled(parts)
    assert (one.factor, other.factor) == (pytest.approx(1.0), pytest.approx(2.25))
    assert (one.redundancy, other.redundancy) == (11.0, 12.0)
    assert one.sigma == pytest.approx(np.sqrt(2.0 * np.linalg.inv([[8.0, 3.0], [3.0, 9.0]])[0, 0]))
    (alone,) = pooled([Fits((a,), np.array([12.0]), np.array([[24.0]]))])
    assert (alone.factor, alone.sigma) == (0.5, pytest.approx(np.sqrt(2.0 / 24.0)))
    assert pooled([]) == ()
