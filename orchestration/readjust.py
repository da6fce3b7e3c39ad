"""MIN++ by command: cameras of images that a network has, from its final points."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orchestration.run import check_frames
from submin.errors import InputError
from submin.query.planner import check_policy
from submin.query.readjustment import Readjusted, coupled_images, readjust
from submin.sensors import SURVEYS
from submin.storage.adjusted import AdjustedCameras, AdjustedWriter
from submin.storage.arrays import group_of, read_record
from submin.storage.catalogue import Catalogue
from submin.storage.dense_reader import refuse_dense
from submin.storage.ledger import Ledger
from submin.storage.network import Network
from submin.storage.point_table import RULE_0


@dataclass(frozen=True)
class ReadjustResult:
    """What was readjusted; the keys of ``submin readjust --json``.

    Attributes
    ----------
    policies, tiles : that the points of the groups come from; a group without accepted rays has none
    blocks, images, groups : how many; images of a group are adjusted together and have a joint covariance
    blocks_missing : blocks of the catalogue that the network does not have
    rays : accepted ones of these images
    """

    version: str
    policies: tuple[str, ...]
    tiles: tuple[str, ...]
    deweight: float | None
    blocks: int
    images: int
    groups: int
    rays: int
    images_released: tuple[str, ...]
    blocks_missing: tuple[str, ...]
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        status = "resection" if self.deweight is None else "de-weighted"
        return {
            "version": self.version, "policies": list(self.policies), "tiles": list(self.tiles), "deweight": self.deweight,
            "status": status, "blocks": self.blocks, "images": self.images, "groups": self.groups, "rays": self.rays,
            "images_released": list(self.images_released), "blocks_missing": list(self.blocks_missing), "use": RULE_0,
            "seconds": self.seconds,
        }  # fmt: skip


def readjust_network(
    catalogue: Catalogue, network: str, out: str | Path, *, block: str | None = None, policy: str = "auto",
    deweight: float | None = None, version: str | None = None,
) -> ReadjustResult:  # fmt: skip
    """Readjust the blocks of a catalogue that a network has, or one of them, group by group, and write their cameras.

    Raises
    ------
    InputError
        When the frame is another, the network has none of the blocks (or not the one named), ``deweight`` is below 1, the policy is
        unknown, or it is ``tile`` and no one tile holds the points of a group.
    """
    started = time.monotonic()
    if deweight is not None and not (np.isfinite(deweight) and deweight >= 1.0):
        raise InputError(f"--deweight is {deweight:g}; expected 1 or more: the factor of the images' a priori sigmas")
    check_policy(policy)
    opened = Network(network, version)
    refuse_dense(opened.snapshot, "readjustment")
    check_frames(catalogue, opened.snapshot)
    fused = {entry.block_id for entry in Ledger.of(opened.snapshot).fused()}
    asked = catalogue.block_ids if block is None else (catalogue.block(block).block_id,)
    missing = tuple(name for name in asked if name not in fused)
    wanted = set(asked) - set(missing)
    if not wanted:
        named = f"block {block!r} is not" if block is not None else f"no block of {catalogue.path}, which has {len(asked)}, is"
        raise InputError(f"{network} {opened.version}: {named} in the network; 'submin adjust' controls new blocks")
    block_of, groups = _groups(opened, wanted)
    cells = _cells_of(opened, {int(row) for group in groups for row in group})
    released: list[str] = []
    policies: set[str] = set()
    tiles: set[int] = set()
    images = rays = 0
    metadata = {"command": "submin readjust", "version": opened.version, "policy_asked": policy}
    with AdjustedWriter(out, True, metadata if deweight is None else metadata | {"deweight": f"{deweight:g}"}) as writer:
        for found in readjust(opened, groups, cells, policy, deweight):
            cameras = _cameras_of(found, np.isin(block_of[found.rows], list(wanted)))
            writer.write_cameras(cameras)
            if found.tiles:
                policies.add(found.policy)
                tiles.update(found.tiles)
            images, rays = images + len(cameras.images), rays + int(cameras.rays.sum())
            released += [name for name, r in zip(cameras.images.ids, cameras.released, strict=True) if r]
        result = ReadjustResult(
            opened.version, tuple(sorted(policies)), tuple(opened.cover.tile_name(t) for t in sorted(tiles)), deweight, len(wanted), images,
            len(groups), rays, tuple(released), missing, time.monotonic() - started,
        )  # fmt: skip
        writer.write_report(result.to_json())
    return result


def _groups(network: Network, wanted: set[str]) -> tuple[NDArray[np.str_], list[NDArray[np.int32]]]:
    """Block (m,) of each image of the network, and groups of coupled images of which one is of a wanted block."""
    columns = network.snapshot.image_columns(["block_id", "sensor", "withdrawn"])
    block_of = columns["block_id"]
    usable = (columns["withdrawn"] == 0) & ~np.isin(columns["sensor"], SURVEYS)
    priors = network.image_set(np.arange(len(block_of), dtype=np.int32)).priors
    groups = coupled_images(priors, usable)
    return block_of, [group for group in groups if not wanted.isdisjoint(block_of[group].tolist())]


def _cells_of(network: Network, rows: set[int]) -> dict[int, list[int]]:
    """Cells in which each of some images has rays."""
    cells: dict[int, list[int]] = {}
    root, cover = network.snapshot.root, network.cover
    for number in network.cell_numbers():
        seen = read_record(group_of(root, "cells/" + cover.cell_name(number)), ["images"])["images"]
        for row in rows.intersection(seen.tolist()):
            cells.setdefault(row, []).append(number)
    return cells


def _cameras_of(found: Readjusted, chosen: NDArray[np.bool_]) -> AdjustedCameras:
    """Those of the images of a group that were asked for."""
    rows, p = np.flatnonzero(chosen), found.images.parameters
    at = (p * rows[:, None] + np.arange(p)).ravel()
    images = found.images.take(rows)
    released = np.array([prior.released for prior in images.priors], dtype=np.bool_)
    return AdjustedCameras(images, found.theta[rows], found.covariance[np.ix_(at, at)], released, found.rays[rows])
