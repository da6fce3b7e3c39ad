"""The folder of a small catalogue."""

from __future__ import annotations

from pathlib import Path

import pytest
from catalogues import IMAGES, block, points

from submin.adjustment.priors import APriori
from submin.storage.catalogue import CatalogueMetadata
from submin.storage.catalogue_writer import CatalogueWriter


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with CatalogueWriter(tmp_path / "catalogue", CatalogueMetadata("test", epoch="2020.0")) as writer:
        writer.write_images(IMAGES)
        writer.write_block(block("A"))
        writer.write_block(block("B", 2))
        writer.write_priors(APriori(bias_px=5.0), {"B": APriori(drift_px=0.1)})
        writer.write_points("control", points())
        writer.write_points("truth", points(7))
    return tmp_path / "catalogue"
