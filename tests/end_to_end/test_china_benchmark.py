"""The benchmark of China at a small scale: every stage runs, the network is what its own system says, and the held back block comes in."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.china import STAGE_NAMES, STREAMED, whole
from benchmarks.china_figure import COORDINATOR, parts_of, plot
from benchmarks.comparison import MET
from benchmarks.held_back import held_back
from benchmarks.product import submin_json
from submin.storage.catalogue import Catalogue

SCALE = 0.002


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("china")


def test_a_small_part_goes_through_every_stage(folder: Path) -> None:
    stages, tasks, found = whole(folder, SCALE, 0)
    assert [row["stage"] for row in stages] == list(STAGE_NAMES)
    assert stages[1]["blocks"] == stages[0]["blocks"] - STREAMED
    assert {row["task"] for row in tasks} >= {"adjust", "update-tile", "factor-tile", "collect-tile", "distribute-tile"}
    told = {row["claim"]: row["verdict"] for row in found}
    assert [told[claim] for claim in told if "against it" in claim or "mosaic" in claim] == [MET] * 3
    assert [Catalogue.open(single).block_count for single in (folder / "singles").iterdir()] == [1] * STREAMED

    rows = [*stages, *tasks]
    parts = dict(parts_of(rows, "run", 1))
    assert COORDINATOR in parts and sum(parts.values()) == pytest.approx(stages[1]["seconds"], rel=0.5)
    plot(rows, 1, folder / "figures")
    assert (folder / "figures" / "china.png").stat().st_size > 10_000


def test_what_is_held_back_and_the_rest_are_the_whole(folder: Path) -> None:
    made = submin_json("simulate", "china", "--out", folder / "whole", "--scale", 0.0005)
    folders = held_back(folder / "whole", [1, 3], folder / "others", folder / "each")
    whole_one, *parts = (Catalogue.open(place) for place in (folder / "whole", folder / "others", *folders))
    assert [part.block_ids for part in parts[1:]] == [(whole_one.block_ids[at],) for at in (1, 3)]
    assert made["blocks"] == whole_one.block_count == sum(part.block_count for part in parts)
    hashes = {block.block_id: block.content_hash() for part in parts for block in part.blocks()}
    assert hashes == {block.block_id: block.content_hash() for block in whole_one.blocks()}


def test_a_command_that_fails_says_what_it_said(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"exit code 2.*no such folder"):
        submin_json("run", tmp_path / "nothing", tmp_path / "network")
