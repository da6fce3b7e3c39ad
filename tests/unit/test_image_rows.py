"""Images of a catalogue: given as they were written, in any order, with their cameras out of memory."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from submin.errors import StoreError
from submin.storage import image_rows, spilled
from submin.storage.catalogue_schema import CatalogueMetadata, ImageRecord
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.image_rows import ImageRows

IMAGES = [
    ImageRecord(
        f"image {k}", f"block {k // 3}", f"pass {k // 30}", "", "rpc", f"camera {k} of München" * (1 + k % 7), 1000 + k, 800,
        "2020-01-01T10:00:00Z" if k % 2 else "", bytes(range(k % 5)),
    )
    for k in range(100)
]  # fmt: skip


def written(images: list[ImageRecord], folder: Path) -> Path:
    with CatalogueWriter(folder, CatalogueMetadata("test")) as writer:
        writer.write_images(images)
    return folder / "images.parquet"


@pytest.fixture(scope="module", params=[0, 2000, 1 << 20], ids=["in a file", "from some on in a file", "in memory"])
def rows(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[ImageRows]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(image_rows, "BATCH_IMAGES", 7)
        patch.setattr(spilled, "MOST_IN_MEMORY", request.param)
        yield ImageRows.read(written(IMAGES, tmp_path_factory.mktemp("images") / "catalogue"))


def test_images_are_given_one_by_one_some_and_all(rows: ImageRows) -> None:
    assert len(rows) == 100 and list(rows) == IMAGES
    assert rows[3] == IMAGES[3] and rows[-1] == IMAGES[-1]
    assert rows[5:20:2] == tuple(IMAGES[5:20:2])
    order = np.random.default_rng(1).permutation(100)
    assert rows.take(order) == tuple(IMAGES[k] for k in order) and rows.take([]) == ()
    with pytest.raises(IndexError):
        rows[100]


def test_blocks_are_named_in_the_order_of_the_table(rows: ImageRows) -> None:
    assert rows.blocks == tuple(f"block {k}" for k in range(34))
    assert [rows.blocks[k] for k in rows.block_of] == [image.block_id for image in IMAGES]
    assert rows.ids.to_pylist() == [image.image_id for image in IMAGES]


def test_no_images() -> None:
    none = ImageRows.none()
    assert len(none) == 0 and list(none) == [] and none.blocks == () and len(none.ids) == 0


def test_cameras_are_not_in_memory(tmp_path: Path) -> None:
    count, length = 5000, 5000  # more than stays in memory
    path = written([replace(IMAGES[0], image_id=f"i{k}", camera=f"{k}:".ljust(length)) for k in range(count)], tmp_path / "catalogue")
    gc.collect()
    before = pa.total_allocated_bytes()
    tracemalloc.start()
    try:
        rows = ImageRows.read(path)
        gc.collect()
        kept = tracemalloc.get_traced_memory()[0] + pa.total_allocated_bytes() - before
    finally:
        tracemalloc.stop()
    assert kept < 0.05 * count * length
    assert rows[count - 1].camera == f"{count - 1}:".ljust(length)


def test_a_full_disk_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(IMAGES, tmp_path / "catalogue")

    def full(buffering: int) -> Any:
        return open("/dev/full", "wb", buffering=buffering)

    monkeypatch.setattr(spilled, "MOST_IN_MEMORY", 0)
    monkeypatch.setattr(spilled.tempfile, "TemporaryFile", full)
    with pytest.raises(StoreError, match=r"cameras cannot be kept there \(No space left on device\); make room, or set TMPDIR"):
        ImageRows.read(path)
