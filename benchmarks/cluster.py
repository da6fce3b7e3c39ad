"""What a run costs beside its tasks: scheduler, coordinator and store, by task, ray, tile and array. docs/cluster.md reckons with it.

Seconds are processor time of the coordinator, with the scheduler, which shares its process on a local cluster, so that other load on
the machine counts little.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import icechunk
import numpy as np
import zarr

from orchestration.create import create, fit_catalogue
from orchestration.executors import Executor, executor_for
from orchestration.reconcile import ReconcileResult, reconcile
from orchestration.run import run
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.arrays import append_table, group_of, write_record
from submin.storage.catalogue import Catalogue
from submin.storage.commit import begin_change, commit
from submin.storage.simulated import write_region
from submin.storage.snapshot import Snapshot

Rows = list[dict[str, Any]]
TASKS, POINTS, IDS = 3000, 4_000_000, 1000
TILES = (100, 400)
ARRAYS_A_TILE = 10


def measure(scale: float, workers: int) -> Rows:
    """Rows of what was done, how often, seconds of each; at scale 1 a region of 300 km x 300 km, and a directory of 4 million points."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        with executor_for(max(workers, 1)) as executor:
            network, rows = _run(place, scale, executor)
            return [*_tasks(network, int(TASKS * scale), executor), *rows, *_directory(network, int(POINTS * scale)), *_commits(place)]


def _seconds(work: Callable[[], Any]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started


def _row(what: str, size: int, unit: str, seconds: float) -> dict[str, Any]:
    return {"what": what, "size": size, "unit": unit, "processor seconds": seconds, "ms each": 1e3 * seconds / size}


def _count(what: str, number: float, unit: str, tiles: int) -> dict[str, Any]:
    return {"what": what, "number": number, "unit": unit, "tiles": tiles}


def given(value: Any) -> Any:
    """A task that does nothing."""
    return value


def _tasks(network: str, tasks: int, executor: Executor) -> Rows:
    session, _ = begin_change(network, Snapshot.open(network).number)

    def through(arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        return executor.results(executor.submit_all(given, arguments, "given", lambda: None))

    through([(k,) for k in range(50)])  # workers have loaded what they need
    rows = [_row("empty tasks and their answers", tasks, "tasks", _seconds(lambda: through([(k,) for k in range(tasks)])))]
    forks: list[Any] = []
    seconds = _seconds(lambda: forks.extend(through([(session.fork(),) for _ in range(tasks // 10)])))
    rows.append(_row("tasks that take a fork of the session and give it back", tasks // 10, "tasks", seconds))
    rows.append(_row("forks merged", tasks // 10, "tasks", _seconds(lambda: session.merge(*forks))))
    return rows


def _run(place: Path, scale: float, executor: Executor) -> tuple[str, Rows]:
    """Coordinator and store of a run: blocks of some 2,000 rays, in one batch, then the reconciliation."""
    side, network = 300.0 * scale**0.5, str(place / "network")
    write_region(simulate_region(RegionDesign(width_km=side, height_km=side, point_spacing_km=2.2)), place / "catalogue")
    catalogue = Catalogue.open(place / "catalogue")
    create(network, fit_catalogue(catalogue)[0], catalogue.metadata, 60.0, 20.0)
    rays = sum(len(block) for block in catalogue.blocks())
    rows = [_row("coordinator of a run, catalogue to commit", rays, "rays", _seconds(lambda: run(catalogue, network, executor)))]
    first = Snapshot.open(network)
    tiles = len(first.tile_numbers())
    images = sum(len(first.tile_images(tile)) for tile in first.tile_numbers())
    before = _bytes(place / "network")
    rows.append(_count("images that tiles see", images / tiles, "images a tile", tiles))
    rows += [_count(f"{part} of a run", size / tiles, "bytes a tile", tiles) for part, size in before.items()]
    reconciled: list[ReconcileResult] = []
    seconds = _seconds(lambda: reconciled.append(reconcile(network, executor)))
    rows.append(_row("coordinator of a reconciliation", tiles, "tiles", seconds))
    rows.append(_count("largest front", reconciled[0].largest_front, "vectors", tiles))
    after = _bytes(place / "network")
    rows += [_count(f"{part} of a reconciliation", (size - before[part]) / tiles, "bytes a tile", tiles) for part, size in after.items()]
    return network, rows


def _bytes(network: Path) -> dict[str, int]:
    return {part: sum(f.stat().st_size for f in (network / part).iterdir()) for part in ("chunks", "manifests", "snapshots")}


def _directory(network: str, points: int) -> Rows:
    """The look for some points' cells in the directory of a large network."""
    rng = np.random.default_rng(1)
    session, base = begin_change(network, Snapshot.open(network).number)
    root = zarr.open_group(session.store, mode="r+")
    hashes, cells = rng.integers(0, 1 << 63, points).astype(np.uint64), np.zeros(points, dtype=np.int64)
    append_table(group_of(root, "directory"), {"hash": hashes, "cell": cells})
    commit(session, base.number + 1, "a large directory")
    ids = np.array([f"P{k}" for k in range(IDS)])
    large = Snapshot.open(network)
    return [
        _row(
            f"cells of {IDS:,} points looked up, by points in the directory", points, "points", _seconds(lambda: large.candidate_cells(ids))
        )
    ]


def _commits(place: Path) -> Rows:
    """A commit that changes one tile of many."""
    rows: Rows = []
    for tiles in TILES:
        folder = place / f"of-{tiles}"
        storage, rng = icechunk.local_filesystem_storage(str(folder)), np.random.default_rng(tiles)
        first = icechunk.Repository.create(storage).writable_session("main")
        root = zarr.create_group(first.store)
        for k in range(tiles):
            write_record(root, f"tile-{k}", {f"part-{j}": rng.standard_normal(200) for j in range(ARRAYS_A_TILE)})
        seconds = _seconds(partial(first.commit, "all"))
        rows.append(_row(f"first commit of {tiles} tiles of {ARRAYS_A_TILE} arrays", tiles, "tiles", seconds))
        session = icechunk.Repository.open(storage).writable_session("main")
        write_record(zarr.open_group(session.store, mode="r+"), "tile-0", {"part-0": rng.standard_normal(200)})
        rows.append(_row(f"commit that changes one of {tiles} tiles", 1, "commits", _seconds(partial(session.commit, "one"))))
        snapshot = max((folder / "snapshots").iterdir(), key=lambda path: path.stat().st_mtime_ns).stat().st_size
        rows.append(_count(f"snapshot of {tiles} tiles", snapshot / tiles / ARRAYS_A_TILE, "bytes an array", tiles))
    return rows
