"""Every row of docs/bad-input.md, given to the real command line: exit code, message, and nothing half done."""

from __future__ import annotations

import json
import resource
import shutil
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import icechunk
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import zarr
from bad_input import CASES  # the package: all modules of cases enter theirs
from bad_input.disks import disk, limited
from bad_input.world import BOX, ROWS, Row, World
from command_calls import Call
from networks import accepted_rays, area_of

import submin
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.run import run
from submin.query.warm_up import compile_kernels
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.repository import versions
from submin.storage.simulated import write_region
from submin.storage.snapshot import Snapshot

TINY = RegionDesign(width_km=60, height_km=60, point_spacing_km=9.5)
"""4 triplets, 36 points, 300 rays about 100 degrees east, 35 degrees north."""
BLOCKS = 4


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalogue, an empty network over it, and one that holds it; nobody writes here."""
    folder = tmp_path_factory.mktemp("origin")
    region = simulate_region(TINY)
    write_region(region, folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    for name in ("network", "fused"):
        create(str(folder / name), area_of(region), catalogue.metadata, 60.0, 20.0)
    run(catalogue, str(folder / "fused"), SerialExecutor())
    compile_kernels()  # what is compiled is also written, and could not be on a full disk
    return folder


@pytest.fixture
def world(tmp_path: Path, origin: Path) -> World:
    return World(tmp_path, origin)


def state(folder: Path) -> dict[str, tuple[bool, int, int]]:
    """Every file and folder below a folder, with size and time: what any writing would change."""
    return {
        str(path.relative_to(folder)): (path.is_dir(), 0 if path.is_dir() else path.stat().st_size, path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
    }


def test_the_page_and_the_cases_are_the_same() -> None:
    assert sorted(ROWS) == sorted(CASES)


@pytest.mark.parametrize("name", CASES)
def test_each_case(name: str, world: World, call: Call) -> None:
    words, row = CASES[name](world), ROWS[name]
    (refused if row.code == 2 else rejected_alone)(world, words, row, call)


def refused(world: World, words: list[Any], row: Row, call: Call) -> None:
    """Exit code 2, one line on standard error, and nothing written."""
    network = world.folder / "network"
    before, known = state(world.folder), len(versions(str(network))) if network.exists() else 0
    with world.around():
        code, out, err = call(*words)
        at = 2 if words[0] in ("import", "simulate", "control") else 1
        as_json = call(*words[:at], "--json", *words[at:])
    assert (code, out) == (2, "")
    assert err.startswith("submin: ") and err.endswith("\n") and err.count("\n") == 1
    message = err.removeprefix("submin: ").removesuffix("\n")
    assert row.says(message), message
    assert as_json[0] == 2
    assert row.says(json.loads(as_json[1])["error"])
    if world.leaves_chunks:
        assert len(versions(str(network))) == known
    else:
        assert state(world.folder) == before


def rejected_alone(world: World, words: list[Any], row: Row, call: Call) -> None:
    """Exit code 1, the block named with its reason in JSON and in text, and all other blocks in the network."""
    network = str(words[2])
    blocks = set(Catalogue.open(world.catalogue).block_ids)
    code, out, err = call(*words, "--json")
    assert (code, err) == (1, "")
    values = json.loads(out)
    assert [r["block_id"] for r in values["blocks_rejected"]] == list(world.rejected)
    for rejected in values["blocks_rejected"]:
        assert row.says(rejected["reason"]), rejected["reason"]
    ledger = Snapshot.open(network).ledger(["block_id", "status"])
    fused = {str(b) for b, s in zip(ledger["block_id"], ledger["status"], strict=True) if s == "fused"}
    assert blocks - set(world.rejected) <= fused
    assert values["blocks_fused"] + values["blocks_skipped"] == len(blocks) - len(world.rejected)

    code, out, err = call(*words)
    assert (code, err) == (1, "")
    lines = [line for line in out.splitlines() if line.startswith("rejected block ")]
    assert len(lines) == len(world.rejected)
    for line, block in zip(lines, world.rejected, strict=True):
        assert row.says(line.removeprefix(f"rejected block {block}: ")), line
    known = len(versions(network))
    assert call(*words)[1].splitlines()[-len(lines) :] == lines
    assert len(versions(network)) == known  # the same again writes nothing


def not_finite(group: zarr.Group, path: str = "") -> list[str]:
    """Arrays of a store that hold something that is no number."""
    found = []
    for name, member in group.members():
        if isinstance(member, zarr.Group):
            found += not_finite(member, f"{path}/{name}")
        elif isinstance(member, zarr.Array) and member.dtype.kind == "f" and not np.isfinite(np.asarray(member[...])).all():
            found.append(f"{path}/{name}")
    return found


@pytest.mark.parametrize("apart", [0.0, 1e-7, 1e-3])
@pytest.mark.parametrize("alone", [True, False])
def test_two_images_of_one_viewpoint_leave_no_nonsense(apart: float, alone: bool, world: World) -> None:
    """They are no error: their points wait for an image from another direction, or are as uncertain as they are."""
    block = world.block(0)
    columns = world.columns("images")
    first, second, *others = [i for i, b in zip(columns["image_id"], columns["block_id"], strict=True) if b == block]
    camera = json.loads(columns["camera"][columns["image_id"].index(first)])
    camera["LINE_NUM_COEFF"][3] += apart
    columns["camera"][columns["image_id"].index(second)] = json.dumps(camera)
    world.put("images", columns)
    rays = world.columns("measurements")
    seen = {p: (s, t) for p, i, s, t in zip(rays["point_id"], rays["image_id"], rays["sample"], rays["line"], strict=True) if i == first}
    for k, (point, image) in enumerate(zip(rays["point_id"], rays["image_id"], strict=True)):
        if image == second and point in seen:
            rays["sample"][k], rays["line"][k] = seen[point]
    world.put("measurements", rays)
    world.rows("measurements", lambda row: row["image_id"] not in others and (row["image_id"] != second or row["point_id"] in seen))
    world.rows("images", lambda row: row["image_id"] not in others)
    if alone:
        for stem in ("images", "measurements"):
            world.rows(stem, lambda row: row["block_id"] == block)
    result = run(Catalogue.open(world.catalogue), str(world.network), SerialExecutor())
    assert result.rejected == () and result.unsettled_tiles == ()
    repository = icechunk.Repository.open(icechunk.local_filesystem_storage(str(world.network)))
    assert not_finite(zarr.open_group(repository.readonly_session("main").store, mode="r")) == []
    control = submin.open(world.network).query(bbox=(99.0, 34.0, 101.0, 36.0), policy="rigorous")
    assert np.isfinite(control.geocentric).all() and np.isfinite(control.covariance).all()
    if alone:
        assert len(control) == 0 or apart > 0.0
        assert control.le90.min(initial=np.inf) > 10.0


def test_a_billion_tiles_are_refused_at_once(world: World, call: Call) -> None:
    words = CASES["a billion tiles"](world)
    call(*words)
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert call(*words)[0] == 2
    assert time.monotonic() - started < 1.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10_000  # kB


@pytest.mark.parametrize("how", ["full file system", "limit of file size"])
def test_a_full_disk_leaves_the_last_version_and_the_same_command_continues(how: str, world: World, origin: Path, call: Call) -> None:
    catalogue, first = world.catalogue, Catalogue.open(world.catalogue).block_ids[:2]
    part = shutil.copytree(catalogue, world.folder / "part")
    for stem in ("images", "measurements"):
        table = pq.read_table(part / f"{stem}.parquet")
        pq.write_table(table.filter(pc.is_in(table["block_id"], pa.array(first))), part / f"{stem}.parquet")
    with disk(world.folder / "disk") if how == "full file system" else nullcontext(limited) as full:
        network = (world.folder / "disk" if how == "full file system" else world.folder) / "network"
        shutil.copytree(origin / "network", network)
        assert call("run", part, network, "--no-reconcile")[0] == 0
        query = ("query", network, *BOX, "--policy", "rigorous", "--out", world.folder / "control.npz")
        assert call(*query)[0] == 0
        before = np.load(world.folder / "control.npz")["covariance"]
        for room in (0, 2_000, 20_000):  # the first write fails, or a later one
            with full(room):
                code, _, err = call("run", catalogue, network, "--no-reconcile")
            assert (code, err.count("\n")) == (2, 1)
            assert ROWS["disk full in the middle of a commit"].says(err.strip().removeprefix("submin: "))
            assert [v.name for v in versions(str(network))] == ["v1", "v0"]
            assert call(*query)[0] == 0
            np.testing.assert_array_equal(np.load(world.folder / "control.npz")["covariance"], before)
        code, out, _ = call("run", catalogue, network, "--no-reconcile", "--json")
        assert code == 0
        assert (json.loads(out)["version"], json.loads(out)["blocks_fused"]) == ("v2", BLOCKS - 2)
        assert accepted_rays(network) == accepted_rays(origin / "fused")
