"""A block is tested by the network before it is accepted: what contradicts it as a whole stays out, with the reason; all else comes in."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from networks import area_of, fuse, rewrite, same_network

import submin
from orchestration.cli import main
from orchestration.executors import SerialExecutor, executor_for
from orchestration.run import RunResult, run
from orchestration.stage_one import BlockRays
from orchestration.withdraw import withdraw
from submin.adjustment.control import ControlledPrior
from submin.network.network_image import image_set
from submin.query.block_control import control_of_block
from submin.query.block_innovation import common_points
from submin.simulation.region import SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.snapshot import Snapshot

HERE = SerialExecutor()
LAST = 7


def warped(block: Block) -> Block:
    """Systematic errors of the scanner: five pixels along lines, three waves over the image, the same in all images."""
    height = np.array([image.height for image in block.images])[block.image]
    return dataclasses.replace(block, line=block.line + 5.0 * np.sin(6.0 * np.pi * block.line / height))


def displaced(block: Block) -> Block:
    """All cameras of the block off by six sigmas, together: the block itself is whole."""
    return dataclasses.replace(block, sample=block.sample + 60.0, line=block.line - 60.0)


def stretched(block: Block) -> Block:
    """A wrong scale: images as large as they are not."""
    middle = np.array([0.5 * image.width for image in block.images])[block.image]
    return dataclasses.replace(block, sample=block.sample + 3e-3 * (block.sample - middle))


@pytest.fixture(scope="module")
def blocks(catalogue: Path) -> list[Block]:
    return list(Catalogue.open(catalogue).blocks())


@pytest.fixture(scope="module")
def others(region: SimulatedRegion, catalogue: Path, blocks: list[Block], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The network of all blocks but one. Not to be changed."""
    folder = tmp_path_factory.mktemp("others")
    fuse(rewrite(catalogue, folder / "catalogue", [b for k, b in enumerate(blocks) if k != LAST]), folder / "network", area_of(region))
    return folder / "network"


@pytest.fixture
def network(others: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(others, tmp_path / "network"))


def come(catalogue: Path, network: Path, folder: Path, block: Block, **options: float) -> RunResult:
    if not folder.exists():
        rewrite(catalogue, folder, [block])
    return run(Catalogue.open(folder), str(network), HERE, **options)


def test_what_the_tile_knows_of_the_block_is_that_of_the_joined_network(others: Path, blocks: list[Block]) -> None:
    """From stored covariances, against the tile factored again with the block's images joined to it."""
    block = BlockRays.of(blocks[LAST])
    network = submin.open(others)
    ids = block.ids
    cells = network.snapshot.candidate_cells(ids)
    images = image_set(block.images, network.cover.ellipsoid, 6)
    passes = network.snapshot.image_columns(["pass_id"])["pass_id"]
    mates = np.isin(passes, [image.pass_id for image in block.images])
    assert mates.any()

    def mates_in(tile: int) -> np.ndarray:
        rows = network.snapshot.tile_images(tile)
        return rows[mates[rows]]

    common = common_points(network, ids, cells, images, mates_in, lambda tile: network.sub_min(tile, None))
    assert common is not None
    assert len(common.mates) > 0
    held = np.where(np.isin(ids, common.ids), cells, -1)
    joined = control_of_block(network, ids, held, "tile", network.snapshot.image_count())
    assert joined is not None
    found, expected = common.prior(images, ids), joined.prior(images, ids)
    assert np.array_equal(found.point, expected.point)
    assert len(found.point) > 10
    sigma = np.sqrt((expected.images**2).sum(axis=1)).reshape(expected.theta.shape)
    assert np.abs(expected.theta / sigma).max() > 0.1  # the pass is known to some extent
    assert np.abs((found.theta - expected.theta) / sigma).max() < 1e-6

    def joint(prior: ControlledPrior) -> np.ndarray:
        root = np.concatenate([prior.loading.reshape(3 * len(prior.point), -1), prior.images])
        return np.asarray(root @ root.T)

    a, b = joint(found), joint(expected)
    scale = np.sqrt(np.diag(b))
    assert np.abs((a - b) / scale / scale[:, None]).max() < 1e-6
    k = 3 * len(found.point)
    assert np.abs(b[:k, k:] / scale[:k, None] / scale[k:]).max() > 0.1  # and correlated with the points
    assert np.abs(found.position - expected.position).max() < 1e-6


@pytest.mark.parametrize("harm", [warped, displaced, stretched], ids=lambda harm: harm.__name__)
def test_a_block_that_contradicts_the_network_stays_out(
    harm: Callable[[Block], Block], catalogue: Path, network: Path, blocks: list[Block], tmp_path: Path
) -> None:
    bad = harm(blocks[LAST])
    result = come(catalogue, network, tmp_path / "bad", bad)
    (refused,) = result.rejected
    assert refused.block_id == bad.block_id
    assert "contradicts the network v1 as a whole: d2 is" in refused.reason
    assert "degrees of freedom, and would be above" in refused.reason
    assert "give the same command again" in refused.reason
    ledger = Snapshot.open(str(network)).ledger()
    last = {name: column[-1] for name, column in ledger.items()}
    assert (last["block_id"], last["status"], last["against"]) == (bad.block_id, "rejected", 1)
    assert last["probability"] < 1e-6
    assert last["d2"] > 2.0 * last["dof"] > 0
    # the same command again says the same and writes nothing
    again = come(catalogue, network, tmp_path / "bad", bad)
    assert [r.block_id for r in again.rejected] == [bad.block_id]
    assert (again.version, Snapshot.open(str(network)).number) == ("v2", 2)


def test_switched_off_it_comes_in_and_is_called_doubtful(catalogue: Path, network: Path, blocks: list[Block], tmp_path: Path) -> None:
    bad = displaced(blocks[LAST])
    result = come(catalogue, network, tmp_path / "bad", bad, innovation=0.0)
    assert (result.fused, result.rejected) == (1, ())
    (doubtful,) = result.to_json()["blocks_doubtful"]
    assert (doubtful["block_id"], doubtful["against"]) == (bad.block_id, "v1")
    assert doubtful["probability"] < 1e-6


def test_it_comes_again_when_what_it_contradicts_has_left(
    region: SimulatedRegion, catalogue: Path, blocks: list[Block], tmp_path: Path
) -> None:
    """The first block decides; when it is the bad one, those that follow are refused until it is withdrawn."""
    bad = displaced(blocks[LAST])
    network = tmp_path / "network"
    neighbour = max((b for b in blocks if b.block_id != bad.block_id), key=lambda b: len(set(b.point_ids) & set(bad.point_ids)))
    fuse(rewrite(catalogue, tmp_path / "bad", [bad]), network, area_of(region))
    good = rewrite(catalogue, tmp_path / "good", [neighbour])
    assert [r.block_id for r in run(Catalogue.open(good), str(network), HERE).rejected] == [neighbour.block_id]
    withdraw(str(network), HERE, block=bad.block_id)
    assert run(Catalogue.open(good), str(network), HERE).fused == 1


def test_good_blocks_come_in_and_their_test_is_kept(
    complete: Path, catalogue: Path, network: Path, blocks: list[Block], tmp_path: Path
) -> None:
    result = come(catalogue, network, tmp_path / "good", blocks[LAST])
    assert (result.fused, result.rejected, result.doubtful) == (1, (), ())
    ledger = Snapshot.open(str(network)).ledger()
    assert ledger["against"].tolist() == [-1] * 11 + [1]
    assert ledger["probability"][-1] > 1e-3
    assert 0.5 < ledger["d2"][-1] / ledger["dof"][-1] < 2.0
    same_network(network, complete)


def test_a_bad_camera_and_a_blunder_are_no_reason_against_a_block(
    catalogue: Path, network: Path, blocks: list[Block], tmp_path: Path
) -> None:
    block = blocks[LAST]
    line, sample = block.line.copy(), block.sample.copy()
    line[block.image == 1] += 90.0
    sample[np.flatnonzero(block.image == 0)[:2]] += 25.0
    result = come(catalogue, network, tmp_path / "bad", dataclasses.replace(block, line=line, sample=sample))
    assert (result.fused, result.rejected) == (1, ())
    assert [flagged.image_id for flagged in result.flagged] == [block.images[1].image_id]


def test_workers_decide_the_same(catalogue: Path, network: Path, blocks: list[Block], tmp_path: Path) -> None:
    bad = rewrite(catalogue, tmp_path / "bad", [warped(blocks[LAST])])
    with executor_for(1) as executor:
        (refused,) = run(Catalogue.open(bad), str(network), executor).rejected
    assert "as a whole" in refused.reason


def test_the_option(
    catalogue: Path, network: Path, blocks: list[Block], tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    def call(*words: str) -> tuple[int, dict]:
        monkeypatch.setattr(sys, "argv", ["submin", *words, "--json"])
        with pytest.raises(SystemExit) as end:
            main()
        return int(end.value.code or 0), json.loads(capsys.readouterr().out)

    bad = rewrite(catalogue, tmp_path / "bad", [displaced(blocks[LAST])])
    code, values = call("run", str(bad), str(network), "--innovation", "0.5")
    assert (code, values["error"]) == (2, "--innovation is 0.5; expected 0 to 0.001")
    code, values = call("run", str(bad), str(network))
    assert (code, len(values["blocks_rejected"]), values["blocks_doubtful"]) == (1, 1, [])
    code, values = call("run", str(bad), str(network), "--innovation", "0")
    assert (code, values["blocks_fused"], len(values["blocks_doubtful"])) == (0, 1, 1)
