"""Blocks are the same wherever they are made ready; what is sent for it is a block's own rows."""

from __future__ import annotations

import pickle
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from networks import rewrite

from orchestration.executors import SerialExecutor, executor_for
from orchestration.reading import BLOCKS_TOGETHER, ReadBlock, looked_at, read_catalogue
from submin.errors import CatalogueError
from submin.storage.block_images import network_images
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, defects


@pytest.fixture(scope="module")
def many(catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    """More blocks than are made ready together; in one of them a ray is far outside of its image."""
    blocks = list(Catalogue.open(catalogue).blocks())
    parts = [part for block in blocks for part in _copies(block, 2 * BLOCKS_TOGETHER // len(blocks) + 1)]
    parts[3].sample[1] = -1e6
    return Catalogue.open(rewrite(catalogue, tmp_path_factory.mktemp("many") / "catalogue", parts))


def _copies(block: Block, count: int) -> list[Block]:
    return [
        replace(
            block, block_id=f"{block.block_id}-{k}", sample=block.sample.copy(),
            images=tuple(replace(i, image_id=f"{i.image_id}-{k}", block_id=f"{block.block_id}-{k}") for i in block.images),
        )
        for k in range(count)
    ]  # fmt: skip


def same(one: Block, other: Block) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Block) if f.name != "images") and (
        one.images == other.images and one.content_hash() == other.content_hash()
    )


def check(found: list[ReadBlock], catalogue: Catalogue) -> None:
    expected = list(catalogue.blocks())
    assert len(found) == len(expected) > 2 * BLOCKS_TOGETHER
    for read, block in zip(found, expected, strict=True):
        assert same(read.block, block)
        assert read.defect == defects(block)
        assert read.images == (network_images(block) if read.defect is None else ())
    (bad,) = (read for read in found if read.defect is not None)
    assert bad.defect is not None and "sample is -1e+06" in bad.defect


def test_read_here_and_by_workers(many: Catalogue) -> None:
    check(list(read_catalogue(many, SerialExecutor())), many)
    check(list(looked_at(many.blocks())), many)
    with executor_for(2) as executor:
        check(list(read_catalogue(many, executor)), many)


def test_workers_leave_little_to_do(many: Catalogue) -> None:
    """Numbers of points and hash travel with a block."""
    with executor_for(1) as executor:
        assert all({"points", "_content_hash"} <= set(vars(read.block)) for read in read_catalogue(many, executor))


def test_only_the_rows_of_the_block_are_sent(many: Catalogue) -> None:
    whole = sum(path.stat().st_size for path in many.path.glob("measurements.*"))
    rows = list(many.block_rows())
    sent = [len(pickle.dumps(each.table, protocol=5)) for each in rows], [len(pickle.dumps(each, protocol=5)) for each in rows]
    assert max(sent[1]) < 0.2 * min(sent[0]) and max(sent[1]) < whole  # a slice by itself brings the whole batch
    again = [pickle.loads(pickle.dumps(each, protocol=5)) for each in rows]
    assert all(same(one.block(), other.block()) for one, other in zip(again, rows, strict=True))


def test_an_error_of_the_table_comes_where_it_is(many: Catalogue, tmp_path: Path) -> None:
    broken = rewrite(many.path, tmp_path / "catalogue", list(many.blocks()))
    table = pq.read_table(broken / "measurements.parquet")
    last = table.slice(0, 1)  # the first block comes back
    pq.write_table(pa.concat_tables([table, last]), broken / "measurements.parquet")
    with executor_for(1) as executor, pytest.raises(CatalogueError, match="comes back after"):
        list(read_catalogue(Catalogue.open(broken), executor))
