"""Batches: order, grouping and where they run leave the same network; every block, image and ray exactly once."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from icechunk import ForkSession
from networks import accepted_rays, area_of, by_image, fuse, rewrite, same_network

import submin
from orchestration.create import create
from orchestration.executors import Advance, SerialExecutor, executor_for
from orchestration.progress import Silent
from orchestration.reconcile import reconcile
from orchestration.run import run
from submin.errors import CatalogueError
from submin.simulation.region import SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.repository import versions
from submin.storage.snapshot import Snapshot


def test_every_ray_is_in_one_cell(region: SimulatedRegion, base: Path) -> None:
    image_ids = [image.image_id for image in region.images]
    expected = {(str(region.point_ids[p]), image_ids[i]) for p, i in zip(region.point, region.image, strict=True)}
    assert set(accepted_rays(base)) == expected


def test_the_same_command_again_does_nothing(region: SimulatedRegion, catalogue: Path, base: Path) -> None:
    before = Snapshot.open(str(base)).version
    again = fuse(catalogue, base, area_of(region))
    assert (again.fused, again.skipped, again.rejected) == (0, 12, ())
    assert Snapshot.open(str(base)).version == before == again.version


@pytest.mark.parametrize("batch_blocks", [1, 5])
def test_batches_leave_the_same_network(region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path, batch_blocks: int) -> None:
    network = tmp_path / "network"
    result = fuse(catalogue, network, area_of(region), batch_blocks=batch_blocks)
    assert result.fused == 12
    assert len(versions(str(network))) == 1 + -(-12 // batch_blocks)
    same_network(base, network)


def test_shuffled_single_images_leave_the_same_network(region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path) -> None:
    """Blocks of one image, in any order and in several batches: points wait for their second ray and move to their cell with it."""
    parts = [part for block in Catalogue.open(catalogue).blocks() for part in by_image(block)]
    order = np.random.default_rng(1).permutation(len(parts))
    shuffled = rewrite(catalogue, tmp_path / "catalogue", [parts[k] for k in order])
    network = tmp_path / "network"
    assert fuse(shuffled, network, area_of(region), batch_blocks=10).fused == 36
    same_network(base, network)


def test_workers_leave_the_same_network(region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path) -> None:
    network = tmp_path / "network"
    with executor_for(2) as executor:
        assert fuse(catalogue, network, area_of(region), executor=executor).fused == 12
    same_network(base, network)


class Keeping(SerialExecutor):
    """Keeps, as a cluster does, the forks that tasks were given, and those in what they give."""

    def __init__(self) -> None:
        self.forks: list[ForkSession] = []

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Advance) -> list[Any]:
        every = list(arguments)
        done = super().submit_all(function, every, name, advance)
        self._keep([*(value for args in every for value in args), *done])
        return done

    def submit(self, function: Callable[..., Any], arguments: tuple[Any, ...], name: str) -> Any:
        done = super().submit(function, arguments, name)
        self._keep([*arguments, done])
        return done

    def _keep(self, values: Iterable[Any]) -> None:
        for value in values:
            fork = getattr(value, "writes", value)
            if isinstance(fork, ForkSession):
                self.forks.append(fork)


def test_nothing_is_read_through_forks_that_wait(
    region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fork through which anything is read or written holds the names of all that a version has, and each task has its own."""
    opened, network, keeping = [], tmp_path / "network", Keeping()
    store = ForkSession.store.fget
    monkeypatch.setattr(ForkSession, "store", property(lambda fork: opened.append(fork) or store(fork)))
    fuse(catalogue, network, area_of(region), executor=keeping, batch_blocks=5)
    same_network(base, network)
    fused = len(keeping.forks)
    reconcile(str(network), keeping)
    tiles = len(Snapshot.open(str(network)).tile_numbers())
    assert fused > 3 * tiles and len(keeping.forks) - fused > 2 * tiles and len(opened) > 3 * tiles
    assert not {id(fork) for fork in opened} & {id(fork) for fork in keeping.forks}


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize(
    ("table", "column", "value", "said"),
    [
        ("measurements", "image_id", "nobody", r"measurements.parquet: row 1052: image_id is 'nobody', which the images table does not"),
        ("images", "camera", "{", r"images.parquet: row 36: image .* camera is not JSON"),
    ],
)
def test_an_error_at_the_end_of_a_catalogue_comes_before_the_first_commit(
    region: SimulatedRegion, catalogue: Path, tmp_path: Path, workers: int, table: str, column: str, value: str, said: str
) -> None:
    """Wherever the catalogue is looked through, beside the reading of the first blocks or before it."""
    bad = Path(shutil.copytree(catalogue, tmp_path / "catalogue"))
    rows = pq.read_table(bad / f"{table}.parquet")
    values = [*rows[column].to_pylist()[:-1], value]
    pq.write_table(rows.set_column(rows.schema.get_field_index(column), column, pa.array(values)), bad / f"{table}.parquet")
    with executor_for(workers) as executor, pytest.raises(CatalogueError, match=said):
        fuse(bad, tmp_path / "network", area_of(region), executor=executor, batch_blocks=1)
    assert Snapshot.open(str(tmp_path / "network")).number == 0


def test_changed_content_and_returning_images_are_rejected(region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())
    moved = dataclasses.replace(blocks[0], sample=blocks[0].sample + 0.25)
    stolen = [dataclasses.replace(image, block_id="other") for image in blocks[1].images]
    other = dataclasses.replace(blocks[1], block_id="other", images=tuple(stolen))
    version = Snapshot.open(str(base)).number
    result = fuse(rewrite(catalogue, tmp_path / "catalogue", [moved, other, blocks[2]]), base, area_of(region))
    assert (result.fused, result.skipped) == (0, 1)
    reasons = {r.block_id: r.reason for r in result.rejected}
    assert "already in the network with other content" in reasons[blocks[0].block_id]
    assert f"already came in block {blocks[1].block_id}" in reasons["other"]
    # the rejection is entered once
    assert Snapshot.open(str(base)).number == version + 1
    assert fuse(tmp_path / "catalogue", base, area_of(region)).rejected == result.rejected
    assert Snapshot.open(str(base)).number == version + 1


def test_a_bad_block_does_not_stop_the_others(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())
    line = blocks[3].line.copy()
    line[7] = np.nan
    blocks[3] = dataclasses.replace(blocks[3], line=line)
    network = tmp_path / "network"
    result = fuse(rewrite(catalogue, tmp_path / "catalogue", blocks), network, area_of(region))
    assert result.fused == 11
    assert [r.block_id for r in result.rejected] == [blocks[3].block_id]
    assert str(blocks[3].point_ids[7]) in result.rejected[0].reason
    assert "nan" in result.rejected[0].reason


def test_one_id_at_two_places_rejects_the_later_block(region: SimulatedRegion, catalogue: Path, base: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())
    last = blocks[-1]
    ids = last.point_ids.astype(object)
    swapped = {ids[0]: "P-elsewhere"}
    first = next(p for p in blocks[0].point_ids if p not in set(last.point_ids))
    renamed = np.array([str(first) if p in swapped else str(p) for p in ids], dtype=np.str_)
    blocks[-1] = dataclasses.replace(last, point_ids=renamed)
    result = fuse(rewrite(catalogue, tmp_path / "catalogue", blocks), tmp_path / "network", area_of(region))
    assert [r.block_id for r in result.rejected] == [last.block_id]
    assert str(first) in result.rejected[0].reason
    assert "km" in result.rejected[0].reason


def test_readers_keep_their_version(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    network = tmp_path / "network"
    blocks = list(Catalogue.open(catalogue).blocks())
    fuse(rewrite(catalogue, tmp_path / "first", blocks[:6]), network, area_of(region))
    reader = submin.open(network)
    before = reader.query(bbox=(90, 30, 110, 40), policy="rigorous")
    fuse(catalogue, network, area_of(region))
    after = reader.query(bbox=(90, 30, 110, 40), policy="rigorous")
    assert np.array_equal(before.covariance, after.covariance)
    assert submin.open(network).version == "v2"
    assert np.array_equal(submin.open(network).at("v1").query(bbox=(90, 30, 110, 40), policy="rigorous").covariance, before.covariance)


@pytest.mark.parametrize("batch_blocks", [1, 500])
def test_the_block_in_error_is_rejected_and_none_that_comes_after_it(
    region: SimulatedRegion, catalogue: Path, tmp_path: Path, batch_blocks: int
) -> None:
    """A good block, one that has a point of it elsewhere, and a good one that measures this point too."""
    blocks = list(Catalogue.open(catalogue).blocks())
    first, second = next((a, b) for a in blocks for b in blocks if a is not b and len(set(a.point_ids) & set(b.point_ids)) > 5)
    stranger = next(b for b in blocks if not set(b.point_ids) & set(first.point_ids))
    shared = sorted(set(first.point_ids) & set(second.point_ids))[0]
    ids = np.array([shared if p == stranger.point_ids[0] else str(p) for p in stranger.point_ids], dtype=np.str_)
    bad = dataclasses.replace(stranger, point_ids=ids)
    network = tmp_path / "network"
    mixed = rewrite(catalogue, tmp_path / "mixed", [first, bad, second])
    result = fuse(mixed, network, area_of(region), batch_blocks=batch_blocks)
    assert [r.block_id for r in result.rejected] == [stranger.block_id]
    assert f"point {shared} is measured" in result.rejected[0].reason
    version = Snapshot.open(str(network)).number
    again = fuse(mixed, network, area_of(region), batch_blocks=batch_blocks)
    # the later block's rays have moved the place that it is compared with, by little; that is no news for the ledger
    assert (again.fused, again.skipped, [r.block_id for r in again.rejected]) == (0, 2, [stranger.block_id])
    assert f"point {shared} is measured" in again.rejected[0].reason
    assert Snapshot.open(str(network)).number == version


def test_a_blunder_of_kilometres_costs_its_ray_and_not_its_block(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())
    counts = {p: int((blocks[4].point_ids == p).sum()) for p in set(blocks[4].point_ids.tolist())}
    k = next(k for k, p in enumerate(blocks[4].point_ids) if counts[str(p)] == 3)
    sample = blocks[4].sample.copy()
    sample[k] += 1500.0  # three kilometres
    blocks[4] = dataclasses.replace(blocks[4], sample=sample)
    result = fuse(rewrite(catalogue, tmp_path / "catalogue", blocks), tmp_path / "network", area_of(region))
    assert (result.fused, result.rejected) == (12, ())
    image = blocks[4].images[blocks[4].image[k]].image_id
    assert accepted_rays(tmp_path / "network")[str(blocks[4].point_ids[k]), image] is False


def test_a_rejection_is_entered_once_whatever_comes_with_it(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())
    line = blocks[0].line.copy()
    line[0] = np.nan
    bad = dataclasses.replace(blocks[0], line=line)
    for count in (3, 5):
        fuse(rewrite(catalogue, tmp_path / f"catalogue-{count}", [bad, *blocks[1:count]]), tmp_path / "network", area_of(region))
    status = Snapshot.open(str(tmp_path / "network")).ledger(["status"])["status"].tolist()
    assert (status.count("rejected"), status.count("fused")) == (1, 4)


class AnotherRun(Silent):
    """Runs another catalogue to its end while this run has looked at the network, and not yet locked it."""

    def __init__(self, catalogue: Path, network: Path) -> None:
        self.catalogue, self.network = catalogue, network

    def begin(self, blocks: int) -> None:
        run(Catalogue.open(self.catalogue), str(self.network), SerialExecutor())


def test_a_run_that_ends_between_look_and_lock_counts_once_and_is_not_ours(
    region: SimulatedRegion, catalogue: Path, complete: Path, tmp_path: Path
) -> None:
    (bad,) = region.bad_cameras
    blocks = list(Catalogue.open(catalogue).blocks())
    ours = [block for block in blocks if block.block_id != bad.rsplit("-", 1)[0]][:3]
    some, network = rewrite(catalogue, tmp_path / "some", ours), tmp_path / "network"
    create(str(network), area_of(region), Catalogue.open(catalogue).metadata, 60.0, 20.0)
    result = run(Catalogue.open(some), str(network), SerialExecutor(), reporter=AnotherRun(catalogue, network))
    assert (result.fused, result.skipped, result.flagged, result.version) == (0, 3, (), "v1")
    same_network(network, complete)
