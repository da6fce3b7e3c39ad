"""Blocks are the same wherever they are made ready; what is sent for it is a block's own rows."""

from __future__ import annotations

import gzip
import pickle
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import pytest
from networks import area_of, fuse, rewrite

from orchestration import reading
from orchestration.executors import Executor, SerialExecutor, ThreadExecutor, executor_for
from orchestration.reading import BLOCKS_TOGETHER, Incoming, read_catalogue, ready
from orchestration.stage_one import BlockAdjustment, BlockRays, adjust_block
from submin.errors import CatalogueError
from submin.geodesy import Ellipsoid
from submin.simulation.region import SimulatedRegion
from submin.storage.block_images import network_images
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, defects


@pytest.fixture(scope="module")
def many(catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    """More blocks than are made ready together; in one of them a ray is far outside of its image, and one has none."""
    blocks = list(Catalogue.open(catalogue).blocks())
    parts = [part for block in blocks for part in _copies(block, 2 * BLOCKS_TOGETHER // len(blocks) + 1)]
    parts[3].sample[1] = -1e6
    parts[5] = _without_rays(parts[5])
    return Catalogue.open(rewrite(catalogue, tmp_path_factory.mktemp("many") / "catalogue", parts))


@pytest.fixture(scope="module")
def worker() -> Iterator[Executor]:
    with executor_for(1) as executor:
        yield executor


def _copies(block: Block, count: int) -> list[Block]:
    return [
        replace(
            block, block_id=f"{block.block_id}-{k}", sample=block.sample.copy(),
            images=tuple(replace(i, image_id=f"{i.image_id}-{k}", block_id=f"{block.block_id}-{k}") for i in block.images),
        )
        for k in range(count)
    ]  # fmt: skip


def _without_rays(block: Block) -> Block:
    of_rays = ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")
    return replace(block, **{name: getattr(block, name)[:0] for name in of_rays})


def same(one: Block, other: Block) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(Block) if f.name != "images") and (
        one.images == other.images and one.content_hash() == other.content_hash()
    )


def check(found: list[Incoming], catalogue: Catalogue) -> None:
    expected = list(catalogue.blocks())
    assert len(found) == len(expected) > 2 * BLOCKS_TOGETHER
    for come, block in zip(found, expected, strict=True):
        assert same(come.block, block)
        assert come.reason == defects(block)
        assert come.images == (network_images(block) if come.reason is None else ())
    reasons = [come.reason for come in found if come.reason is not None]
    assert len(reasons) == 2 and "sample is -1e+06" in reasons[0] and "has no measurements" in reasons[1]


def test_ready_here_and_by_a_worker(many: Catalogue, worker: Executor) -> None:
    for executor in (SerialExecutor(), worker):
        for batch_blocks in (1, 2000):
            check(list(read_catalogue(many, executor, batch_blocks)), many)
    check(list(ready(many.blocks())), many)


@pytest.mark.parametrize("sigma", [("sigma_sample", "sigma_line"), ()])
def test_any_table_that_the_coordinator_can_read_will_do(many: Catalogue, worker: Executor, tmp_path: Path, sigma: tuple[str, ...]) -> None:
    """As gzipped CSV, with or without sigmas."""
    copy = rewrite(many.path, tmp_path / "catalogue", list(many.blocks()))
    table = pq.read_table(copy / "measurements.parquet")
    kept = [name for name in table.column_names if not name.startswith("sigma") or name in sigma]
    with gzip.open(copy / "measurements.csv.gz", "wb") as file:
        pcsv.write_csv(table.select(kept), file)
    (copy / "measurements.parquet").unlink()
    opened = Catalogue.open(copy)
    check(list(read_catalogue(opened, worker, 2000)), opened)


def test_workers_leave_little_to_do(many: Catalogue, worker: Executor) -> None:
    """Numbers of points and hash travel with a block."""
    assert all({"points", "_content_hash"} <= set(vars(come.block)) for come in read_catalogue(many, worker, 2000))


def test_stage_one_goes_with_the_reading(many: Catalogue, worker: Executor) -> None:
    """But for what cannot come in, and what is in the network already."""
    here = {many.block_ids[1], many.block_ids[-1]}
    alone = {block.block_id: adjust_block(BlockRays.of(block), many.metadata.ellipsoid) for block in many.blocks() if not defects(block)}
    for executor in (SerialExecutor(), ThreadExecutor(2), worker):
        for come in read_catalogue(many, executor, 2000, here):
            if come.reason is not None or come.block.block_id in here:
                assert come.adjusted is None
                continue
            found, expected = come.adjusted, alone[come.block.block_id]
            assert found is not None and found.reason is None
            assert np.array_equal(found.accepted, expected.accepted) and np.array_equal(come.accepted, expected.accepted)
            assert found.estimate is not None and expected.estimate is not None
            assert np.array_equal(found.estimate.theta, expected.estimate.theta)
            assert np.array_equal(found.estimate.ground, expected.estimate.ground)


def test_what_the_network_has_is_not_adjusted_again(
    region: SimulatedRegion, catalogue: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    network = tmp_path / "network"
    blocks = list(Catalogue.open(catalogue).blocks())
    fuse(rewrite(catalogue, tmp_path / "first", blocks[:3]), network, area_of(region))
    seen = []

    def adjusted(block: BlockRays, ellipsoid: Ellipsoid) -> BlockAdjustment:
        seen.append(block.block_id)
        return adjust_block(block, ellipsoid)

    monkeypatch.setattr(reading, "adjust_block", adjusted)
    again = fuse(rewrite(catalogue, tmp_path / "more", blocks[:4]), network, area_of(region))
    assert (again.fused, again.skipped, seen) == (1, 3, [blocks[3].block_id])


def test_a_block_travels_without_the_names_of_its_rays(many: Catalogue) -> None:
    """Those of its points tell them; a block whose points are not numbered keeps them."""
    block = next(many.blocks())
    plain, names = len(pickle.dumps(block)), block.point_ids.copy()
    again = pickle.loads(pickle.dumps(block))
    assert "points" not in vars(block) and same(again, block)
    numbered = pickle.loads(pickle.dumps(block))
    assert "point_ids" not in vars(numbered) and np.array_equal(numbered.point_ids, names)
    assert len(pickle.dumps(numbered)) < plain
    assert same(replace(numbered, block_id=block.block_id), block)
    with pytest.raises(AttributeError, match="no attribute 'names'"):
        _ = numbered.names


def test_only_the_rows_of_the_block_are_sent(many: Catalogue) -> None:
    rows = [each for each in many.block_rows() if len(each.image)]
    with_batch = min(len(pickle.dumps(each.table, protocol=5)) for each in rows)  # a slice by itself brings the whole batch
    assert max(len(pickle.dumps(each, protocol=5)) for each in rows) < 0.2 * with_batch
    again = [pickle.loads(pickle.dumps(each, protocol=5)) for each in rows]
    assert all(same(one.block(), other.block()) for one, other in zip(again, rows, strict=True))


def test_an_error_of_the_table_is_the_readers(many: Catalogue, worker: Executor, tmp_path: Path) -> None:
    broken = rewrite(many.path, tmp_path / "catalogue", list(many.blocks()))
    table = pq.read_table(broken / "measurements.parquet")
    pq.write_table(pa.concat_tables([table, table.slice(0, 1)]), broken / "measurements.parquet")  # the first block comes back
    with pytest.raises(CatalogueError, match="comes back after"):
        list(read_catalogue(Catalogue.open(broken), worker, 2000))


def test_what_the_network_has_against_a_block_is_said_first(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    """Images that came in another block already, and beside it a ray far outside: the first decides, and is mended first."""
    blocks = list(Catalogue.open(catalogue).blocks())[:3]
    network = tmp_path / "network"
    fuse(rewrite(catalogue, tmp_path / "first", blocks), network, area_of(region))
    twin = replace(
        blocks[0], block_id="twin", sample=blocks[0].sample.copy(), images=tuple(replace(i, block_id="twin") for i in blocks[0].images)
    )
    twin.sample[0] = -1e6
    (rejected,) = fuse(rewrite(catalogue, tmp_path / "second", [twin]), network, area_of(region)).rejected
    assert rejected.reason.endswith("an image counts once")
