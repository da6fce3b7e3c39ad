"""The gate of a network: blocks that have been adjusted by themselves are tested by what one version says of the points in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orchestration.stage_one import BlockAdjustment, BlockRays
from submin.adjustment.intersection import intersect
from submin.errors import NumericalError
from submin.network.cell import union_of_images
from submin.network.innovation import BlockTest
from submin.network.network_image import NetworkImage, image_set
from submin.network.sub_min import SubMin
from submin.query.block_innovation import block_test, common_points
from submin.sensors import width_of
from submin.storage.catalogue_schema import Block
from submin.storage.directory import Directory
from submin.storage.network import Network
from submin.storage.snapshot import Snapshot


@dataclass(frozen=True)
class Candidate:
    """A block before the gate: its rays, its own adjustment, and the cell (n,) of each of its n points (ids ascending) in the network."""

    rays: BlockRays
    adjusted: BlockAdjustment
    cells: NDArray[np.int64]


def common_cells(blocks: Sequence[Block], directory: Directory) -> list[NDArray[np.int64] | None]:
    """The cell of each point of each block (ids ascending) by the directory of a network, None where it has none of them."""
    if not len(directory) or not blocks:
        return [None] * len(blocks)
    of_blocks = [block.points[0] for block in blocks]
    cells = np.split(directory.cells_of(np.concatenate(of_blocks)), np.cumsum([len(ids) for ids in of_blocks])[:-1])
    return [of_block if (of_block >= 0).any() else None for of_block in cells]


def tested(candidates: Sequence[Candidate], snapshot: Snapshot) -> list[BlockTest | None]:
    """A task: the test of each of some blocks by one version of the network; None where nothing can be compared."""
    gate = Gate(snapshot, np.unique(np.concatenate([candidate.cells for candidate in candidates])))
    return [gate.test(candidate) for candidate in candidates]


class Gate:
    """Tests blocks by one version of a network; what several blocks ask for is read once."""

    def __init__(self, snapshot: Snapshot, cells: NDArray[np.int64]) -> None:
        """``cells`` : all that blocks will ask for, ascending."""
        self._snapshot, self._cells = snapshot, cells
        self._networks: dict[int, Network] = {}
        self._images: dict[int, tuple[NDArray[np.int32], NDArray[np.str_]]] = {}
        self._latest: tuple[tuple[int, int], SubMin] | None = None

    def test(self, candidate: Candidate) -> BlockTest | None:
        """Test a block; None where nothing can be compared."""
        block, estimate = candidate.rays, candidate.adjusted.estimate
        if estimate is None or not (candidate.cells >= 0).any():
            return None
        metadata = self._snapshot.metadata
        p = max(metadata.parameters, width_of(image.sensor for image in block.images))
        images = image_set(block.images, metadata.ellipsoid, p)
        _, rays = block.ordered(candidate.adjusted.accepted)
        try:
            common = common_points(
                self._network(p), block.ids, candidate.cells, images,
                lambda tile: self._mates(tile, block.images), lambda tile: self._sub_min(p, tile),
            )  # fmt: skip
            if common is None:
                return None
            return block_test(common, images, block.ids, rays, estimate.widened(p), lambda: intersect(images, rays, len(block.ids)))
        except NumericalError:  # what cannot be computed is no reason against the block
            return None

    def _sub_min(self, parameters: int, tile: int) -> SubMin:
        """A tile's sub-MIN; the latest one is kept, since neighbouring blocks ask for the same."""
        if self._latest is None or self._latest[0] != (parameters, tile):
            self._latest = None  # never two in memory
            self._latest = (parameters, tile), self._network(parameters).sub_min(tile, None)
        return self._latest[1]

    def _network(self, parameters: int) -> Network:
        """The network with so many parameters an image; the images of all cells that are asked for are read at once."""
        if parameters not in self._networks:
            base = self._snapshot
            network = Network.over(Snapshot(base.root, base.place, base.cover, parameters))
            network.image_set(union_of_images([network.cell(int(number)) for number in self._cells[self._cells >= 0]]))
            self._networks[parameters] = network
        return self._networks[parameters]

    def _mates(self, tile: int, block: Sequence[NetworkImage]) -> NDArray[np.int32]:
        """Rows of the tile's images that share a pass with an image of a block."""
        if tile not in self._images:
            rows = self._snapshot.tile_images(tile)
            self._images[tile] = rows, np.concatenate([run["pass_id"] for run in self._snapshot.image_rows(rows, ["pass_id"])])
        rows, passes = self._images[tile]
        return rows[np.isin(passes, [image.pass_id for image in block])]
