"""What is withdrawn leaves a network as if it had never been fused, and can come again."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from damages import Store
from networks import area_of, fuse, rewrite, same_network

import submin
from orchestration.control import add_control
from orchestration.executors import SerialExecutor
from orchestration.info import describe
from orchestration.run import run
from orchestration.verify import verify
from orchestration.withdraw import withdraw
from submin.errors import BusyError, InputError
from submin.simulation.region import SimulatedRegion
from submin.storage.arrays import group_of, hash_ids, read_table, set_rows
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, PointTable
from submin.storage.commit import begin_change, commit
from submin.storage.ledger import Ledger, blocks_in
from submin.storage.ray_totals import summed_cells
from submin.storage.repository import versions
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import writing

HERE = SerialExecutor()


@pytest.fixture
def blocks(catalogue: Path) -> list[Block]:
    return list(Catalogue.open(catalogue).blocks())


def without_image(block: Block, image_id: str) -> Block:
    """The block as it is when one of its images was never measured."""
    k = next(i for i, image in enumerate(block.images) if image.image_id == image_id)
    rays = block.image != k
    return dataclasses.replace(
        block, images=block.images[:k] + block.images[k + 1 :], image=(block.image - (block.image > k))[rays],
        **{name: getattr(block, name)[rays] for name in ("point_ids", "sample", "line", "sigma_sample", "sigma_line")},
    )  # fmt: skip


@pytest.mark.parametrize("gone", [0, 4, 11])
def test_a_withdrawn_block_was_never_there(
    region: SimulatedRegion, catalogue: Path, base: Path, blocks: list[Block], tmp_path: Path, gone: int
) -> None:  # fmt: skip
    done = withdraw(str(base), HERE, block=blocks[gone].block_id)
    assert (done.images, done.rays, done.version) == (3, len(blocks[gone]), "v2")
    rest = rewrite(catalogue, tmp_path / "rest", blocks[:gone] + blocks[gone + 1 :])
    fuse(rest, tmp_path / "never", area_of(region))
    same_network(base, tmp_path / "never")
    assert describe(submin.open(base))["images"] == 33
    assert describe(submin.open(base))["blocks"] == 11


def test_a_withdrawn_block_comes_again(region: SimulatedRegion, catalogue: Path, base: Path, complete: Path, blocks: list[Block]) -> None:
    for block in blocks[:2]:
        withdraw(str(base), HERE, block=block.block_id)
    again = fuse(catalogue, base, area_of(region))
    assert (again.fused, again.skipped, again.rejected) == (2, 10, ())
    same_network(base, complete)
    assert [v.message for v in versions(str(base))][1:3] == [f"block {b.block_id} withdrawn" for b in (blocks[1], blocks[0])]


def test_what_is_in_a_network(region: SimulatedRegion, catalogue: Path, base: Path, blocks: list[Block], tmp_path: Path) -> None:
    """Not what was withdrawn; still what has been refused since with other content."""
    withdraw(str(base), HERE, block=blocks[0].block_id)
    other = dataclasses.replace(blocks[1], line=blocks[1].line + 1.0)
    (refused,) = fuse(rewrite(catalogue, tmp_path / "other", [other]), base, area_of(region)).rejected
    assert refused.block_id == blocks[1].block_id
    now = Snapshot.open(str(base))
    assert blocks_in(now) == {entry.block_id for entry in Ledger.of(now).fused()} == {block.block_id for block in blocks[1:]}


def test_a_withdrawn_image_was_never_there(
    region: SimulatedRegion, catalogue: Path, base: Path, blocks: list[Block], tmp_path: Path
) -> None:  # fmt: skip
    image_id = blocks[2].images[1].image_id
    done = withdraw(str(base), HERE, image=image_id)
    assert (done.images, done.rays) == (1, int((blocks[2].image == 1).sum()))
    less = [*blocks[:2], without_image(blocks[2], image_id), *blocks[3:]]
    fuse(rewrite(catalogue, tmp_path / "less", less), tmp_path / "never", area_of(region))
    same_network(base, tmp_path / "never")


def test_the_same_block_does_not_bring_a_withdrawn_image_back_but_another_one_does(
    region: SimulatedRegion, catalogue: Path, base: Path, complete: Path, blocks: list[Block], tmp_path: Path
) -> None:
    image = blocks[2].images[1]
    withdraw(str(base), HERE, image=image.image_id)
    assert fuse(catalogue, base, area_of(region)).skipped == 12
    assert image.image_id not in Ledger.of(Snapshot.open(str(base))).block_of_image
    rays = blocks[2].image == 1
    alone = Block(
        "alone", (dataclasses.replace(image, block_id="alone"),), blocks[2].a_priori, blocks[2].point_ids[rays],
        np.zeros(rays.sum(), dtype=np.int32), blocks[2].sample[rays], blocks[2].line[rays],
        blocks[2].sigma_sample[rays], blocks[2].sigma_line[rays],
    )  # fmt: skip
    assert fuse(rewrite(catalogue, tmp_path / "alone", [alone]), base, area_of(region)).fused == 1
    same_network(base, complete)  # images of a block are not correlated here, so its name does not matter


def test_the_last_image_takes_its_block_along(base: Path, blocks: list[Block]) -> None:
    for image in blocks[5].images:
        withdraw(str(base), HERE, image=image.image_id)
    entry = Ledger.of(Snapshot.open(str(base))).entries[blocks[5].block_id]
    assert (entry.status, entry.images, entry.rays) == ("withdrawn", 0, 0)


def test_a_network_of_which_all_is_withdrawn_is_empty_and_can_be_filled(
    region: SimulatedRegion, catalogue: Path, complete: Path, blocks: list[Block], tmp_path: Path
) -> None:
    network = tmp_path / "network"
    fuse(rewrite(catalogue, tmp_path / "two", blocks[:2]), network, area_of(region))
    for block in blocks[:2]:
        withdraw(str(network), HERE, block=block.block_id)
    snapshot = Snapshot.open(str(network))
    assert (snapshot.cell_numbers(), snapshot.tile_numbers(), snapshot.flags()) == ((), (), set())
    assert len(submin.open(network).query(bbox=(90, 30, 110, 40))) == 0
    assert describe(submin.open(network))["points"] == 0
    assert fuse(catalogue, network, area_of(region)).fused == 12
    same_network(network, complete)


@pytest.mark.parametrize("stated", [None, {"version": 0, "rays": 3, "accepted": 2, "pixel_rays": 2, "square_px": 1.0}])
def test_totals_of_rays_follow_from_the_cells_again(base: Path, blocks: list[Block], stated: dict[str, Any] | None) -> None:
    """Where there are none, or where they are of before the cells changed, as another release leaves them."""
    before = Snapshot.open(str(base))
    session, _ = begin_change(str(base), before.number)
    root = zarr.open_group(session.store, mode="r+")
    root.attrs.update({"rays": stated} if stated else {})
    if stated is None:
        del root.attrs["rays"]
    root.attrs["version"] = before.number + 1
    commit(session, before.number + 1, "another release")
    counted = Snapshot.open(str(base))
    assert counted.ray_totals() == summed_cells(counted.root)
    withdraw(str(base), HERE, block=blocks[3].block_id)
    after = Snapshot.open(str(base))
    assert dict(after.root.attrs)["rays"]["version"] == after.number
    found, expected = after.ray_totals(), summed_cells(after.root)
    assert (found.rays, found.accepted, found.pixel_rays) == (expected.rays, expected.accepted, expected.pixel_rays)
    assert 0 < found.rays < before.ray_totals().rays
    assert found.square_px == pytest.approx(expected.square_px, rel=1e-9)


def test_a_bad_camera_leaves_with_its_block(region: SimulatedRegion, base: Path) -> None:
    (bad,) = region.bad_cameras
    assert Snapshot.open(str(base)).flags()
    withdraw(str(base), HERE, block=bad.rsplit("-", 1)[0])
    assert not Snapshot.open(str(base)).flags()
    assert describe(submin.open(base))["images_flagged"] == ""


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ({"block": "T099-099"}, "block 'T099-099' is not in the network"),
        ({"image": "nothing"}, "image 'nothing' is not in the network"),
        ({"control": "P000001"}, "control point 'P000001' is not in the network"),
        ({"block": "control:P000001"}, "is not in the network"),
        ({"block": "T000-000", "image": "x"}, "give exactly one of --block, --image and --control"),
        ({}, "give exactly one of --block, --image and --control"),
    ],
)
def test_what_is_not_there_cannot_be_withdrawn(complete: Path, what: dict[str, str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        withdraw(str(complete), HERE, **what)  # type: ignore[arg-type]
    assert Snapshot.open(str(complete)).number == 1


def test_nothing_is_withdrawn_or_added_while_another_writes(base: Path, blocks: list[Block], region: SimulatedRegion) -> None:
    control = PointTable(region.point_ids[:1], region.truth[:1], np.eye(3)[None], np.array([""]))
    with writing(str(base)):
        with pytest.raises(BusyError, match="is writing to this network"):
            withdraw(str(base), HERE, block=blocks[0].block_id)
        with pytest.raises(BusyError, match="is writing to this network"):
            add_control(control, "test", str(base), HERE)
    assert Snapshot.open(str(base)).number == 1
    assert withdraw(str(base), HERE, block=blocks[0].block_id).version == "v2"


def test_twice_is_once(base: Path, blocks: list[Block]) -> None:
    withdraw(str(base), HERE, block=blocks[0].block_id)
    with pytest.raises(InputError, match="is not in the network"):
        withdraw(str(base), HERE, block=blocks[0].block_id)
    with pytest.raises(InputError, match="is not in the network"):
        withdraw(str(base), HERE, image=blocks[0].images[0].image_id)


def test_a_withdrawal_mends_where_the_directory_has_its_points(base: Path, catalogue: Path, complete: Path, blocks: list[Block]) -> None:
    """As docs/quality.md advises: else the block, when it comes again, would not find them, and begin them anew."""
    shared = np.intersect1d(blocks[0].point_ids, np.concatenate([block.point_ids for block in blocks[1:]]))
    store = Store(base)
    directory = group_of(store.root, "directory")
    table = read_table(directory)
    wrong = np.flatnonzero(np.isin(table["hash"], hash_ids(shared)))
    set_rows(directory, "cell", wrong, table["cell"][wrong] + 1)
    store.commit()
    assert {problem.kind for problem in verify(str(base), HERE).problems} == {"directory"}
    withdraw(str(base), HERE, block=blocks[0].block_id)
    assert verify(str(base), HERE).ok
    run(Catalogue.open(catalogue), str(base), HERE)
    assert verify(str(base), HERE).ok
    same_network(base, complete)
