"""One sub-MIN of a network by itself, as it is and with a block that is not in the network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from submin.errors import QueryError
from submin.network.network_image import image_set
from submin.query.control_set import ControlSet
from submin.query.planner import Selection, answer, points_of_tile
from submin.query.with_block import BlockRays, TileWithBlock, with_block
from submin.sensors import width_of
from submin.storage.block_images import network_images
from submin.storage.catalogue_schema import Block

if TYPE_CHECKING:
    from submin.storage.network import Network

Array = NDArray[np.float64]


class TileView:
    """One sub-MIN of a network, by itself."""

    def __init__(self, network: Network, number: int) -> None:
        self._network, self._number = network, number

    @property
    def name(self) -> str:
        """Name of the tile."""
        return self._network.cover.tile_name(self._number)

    def query(self, ids: Sequence[str] | None = None) -> ControlSet:
        """Control points of this sub-MIN alone: those named, or all that it holds."""
        return self._network.query(points=ids, tile=self.name, policy="tile")

    def covariance(self, ids: Sequence[str]) -> Array:
        """Joint covariance (3n, 3n) of points, geocentric square metres, in the order of their ids ascending, from this sub-MIN alone."""
        return self.query(ids).covariance

    def with_block(self, block: Block) -> TilePreview:
        """What a block that is not in the network would bring to this sub-MIN alone: fused in memory, nothing is written.

        Its rays are taken as they are, where a run would judge them; points that the network holds in other tiles only take no part.

        Raises
        ------
        QueryError
            When an image of the block is in the network already, or none of its rays falls into the tile.
        """
        images = network_images(block)
        opened = self._network
        width = width_of(image.sensor for image in images)
        if width > opened.snapshot.metadata.parameters:
            opened = opened.at(opened.version, width)
        names = opened.snapshot.image_columns(["image_id"])["image_id"] if opened.snapshot.image_count() else np.empty(0, dtype="U1")
        twice = [image.image_id for image in images if image.image_id in names]
        if twice:
            raise QueryError(f"image {twice[0]} of block {block.block_id} is in the network already; expected a block that is not")
        ids = np.unique(block.point_ids)
        rays = BlockRays(
            image_set(images, opened.snapshot.metadata.ellipsoid, opened.snapshot.metadata.parameters), block.point_ids, block.image,
            block.observed, block.sigma,
        )  # fmt: skip
        elsewhere = ids[opened.directory.cells_of(ids) >= 0]
        return TilePreview(opened, with_block(opened, self._number, rays, elsewhere, opened.snapshot.image_count()))


class TilePreview:
    """One sub-MIN with a block in it that is not in the network."""

    def __init__(self, network: Network, source: TileWithBlock) -> None:
        self._network, self._source = network, source

    @property
    def chi_square(self) -> float:
        """By how much the block adds to the weighted squares of the tile: chi-square when block and tile agree."""
        return self._source.fused.chi_square

    @property
    def redundancy(self) -> int:
        """Degrees of freedom of ``chi_square``."""
        return self._source.fused.redundancy

    @property
    def rank(self) -> int:
        """Directions, at most, in which the block changes what is known of the images."""
        return self._source.fused.rank

    def query(self, ids: Sequence[str] | None = None) -> ControlSet:
        """Control points of this sub-MIN with the block: those named, or all that the tile and the block determine.

        Raises
        ------
        QueryError
            When a point named is not in the tile, or not determined.
        """
        selections = points_of_tile(self._source, self._source.tile)
        if ids is not None:
            wanted = np.unique(np.asarray(ids, dtype=np.str_))
            selections = [Selection(s.cell, s.rows[np.isin(s.cell.point_ids[s.rows], wanted)]) for s in selections]
            selections = [s for s in selections if len(s.rows)]
            found = np.concatenate([s.cell.point_ids[s.rows] for s in selections] or [wanted[:0]])
            missing = np.setdiff1d(wanted, found)
            if len(missing):
                raise QueryError(f"{len(missing)} of {len(wanted)} points are not determined in the tile, {missing[0]} among them")
        return self._network.control_set(answer(self._source, selections, "tile", self._source.tile))
