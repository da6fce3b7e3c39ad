"""A small network as tests of the store write it: what is in it means nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from shapely.geometry import box

from submin.adjustment.elimination import Sums
from submin.adjustment.rays import Rays
from submin.network.cell import Cell
from submin.network.sub_min import SubMin
from submin.storage.arrays import append_table, group_of
from submin.storage.commit import begin_change, commit
from submin.storage.repository import create_network
from submin.storage.schema import IMAGE_COLUMNS, NetworkMetadata
from submin.storage.snapshot import Snapshot
from submin.tiling.area import cover_area

COVER = cover_area(box(5.0, 43.0, 5.5, 43.4), 20e3, 4e3)
METADATA = NetworkMetadata("provence", "Earth", "ITRF2014", "2010.0", 6378137.0, 1.0 / 298.257223563, COVER.to_mapping())


def new(tmp_path: Path) -> str:
    place = str(tmp_path / "network")
    create_network(place, METADATA)
    return place


def write(place: str, version: int, change: Any) -> None:
    """Commit one version: ``change`` gets the root."""
    session, _ = begin_change(place, Snapshot.open(place).number)
    root = zarr.open_group(session.store, mode="r+")
    change(root)
    root.attrs["version"] = version
    commit(session, version, f"batch {version}")


def random_cell(number: int, seed: int = 1, points: int = 5) -> Cell:
    rng = np.random.default_rng(seed)
    images = np.sort(rng.choice(50, 4, replace=False)).astype(np.int32)
    point = np.repeat(np.arange(points, dtype=np.int32), 3)
    rays = Rays(
        point, rng.integers(0, 4, len(point)).astype(np.int32), rng.normal(5e3, 1e3, (len(point), 2)),
        rng.uniform(0.3, 1.0, (len(point), 2)), rng.uniform(size=len(point)) < 0.7,
    )  # fmt: skip
    return Cell(
        number, np.array([f"SET/点{i}" for i in range(points)]), rng.normal(0.0, 4e6, (points, 3)), rng.normal(0.0, 4e6, (points, 3)),
        images, rng.normal(size=(4, 6)), rays,
        Sums(np.tril(rng.normal(size=(24, 24))), rng.normal(size=24), 12.5, 17),
    )  # fmt: skip


def image_columns(count: int, first: int = 0) -> dict[str, NDArray[Any]]:
    kinds: dict[str, NDArray[Any]] = {}
    for name, kind in IMAGE_COLUMNS.items():
        if kind == "text":
            kinds[name] = np.array([f"{name} {first + k}" for k in range(count)])
        else:
            kinds[name] = np.arange(first, first + count).astype(kind)
    return kinds | {"licence": np.full(count, ""), "released": (np.arange(first, first + count) % 2).astype(np.uint8)}


# Creating and opening


def with_versions(tmp_path: Path, last: int) -> str:
    """A network of versions 0 to ``last``, each with one image more."""
    place = new(tmp_path)
    for number in range(1, last + 1):
        write(place, number, lambda root, number=number: append_table(group_of(root, "images"), image_columns(1, number - 1)))
    return place


def sub_min(images: int, seed: int = 1) -> SubMin:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6 * images, 6 * images))
    rows = np.sort(rng.choice(10 * images, images, replace=False)).astype(np.int32)
    return SubMin(rows, rng.normal(size=(images, 6)), root @ root.T, 101.5, 99)
