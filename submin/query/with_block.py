"""What a block would bring to a tile: its rays fused into the tile's sub-MIN as it is, without touching the network.

Points that the tile has keep their registration and linearisation, new images are taken where their cameras put them, and no ray is judged:
what a run would make of the block differs by second-order terms and by blunders. So it is an answer before the fact, not a network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.new_rays import NewRays
from submin.adjustment.rays import sorted_rays
from submin.errors import QueryError
from submin.geodesy import geocentric_to_geodetic
from submin.network.cell import Cell, RegisteredPoints, empty_cell, summed, with_rays
from submin.network.low_rank import Fused, fuse, new_rays
from submin.network.replay import joined
from submin.network.sub_min import SubMin, add_sums, marginal
from submin.query.block_control import both
from submin.query.source import Index, NetworkSource, existing_cells
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Ids = NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class BlockRays:
    """A block that is not in the network: images with their a priori model, and rays, one row each.

    Attributes
    ----------
    images : the block's m images
    point_ids : (r,) ; image : (r,) index into ``images``; observed, sigma : (r, 2)
    """

    images: ImageSet
    point_ids: Ids
    image: Index
    observed: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class TileWithBlock(NetworkSource):
    """A tile with a block fused into it, as something to query: a `NetworkSource` whose cells and sub-MIN hold the block.

    Attributes
    ----------
    source, tile : the network and the number of its tile
    images : the block's; their rows follow those of the network, from ``first`` on
    cells : by number, those in which the block has points
    fused : the sub-MIN with the block, and what the block changed
    """

    source: NetworkSource
    tile: int
    images: ImageSet
    first: int
    cells: dict[int, Cell]
    fused: Fused

    @property
    def cover(self) -> Cover:
        """Tiles and cells."""
        return self.source.cover

    def cell_numbers(self) -> tuple[int, ...]:
        """Cells that hold points, ascending."""
        return tuple(sorted({*self.source.cell_numbers(), *self.cells}))

    def existing(self, numbers: Sequence[int]) -> tuple[int, ...]:
        """Those of some cells that hold points, in their order."""
        there = {*self.source.existing(numbers), *self.cells}
        return tuple(number for number in numbers if number in there)

    def cell(self, number: int) -> Cell:
        """A cell without its sums."""
        return self.cells[number] if number in self.cells else self.source.cell(number)

    def cell_sums(self, number: int) -> tuple[Index, Sums]:
        """A cell's images and its sums."""
        if number not in self.cells:
            return self.source.cell_sums(number)
        cell = summed(self.cells[number], self.image_set(self.cells[number].images))
        return cell.images, cell.sums

    def sub_min(self, tile: int, images: Index | None) -> SubMin:
        """The tile's sub-MIN with the block, or its marginal on some images."""
        if tile != self.tile:
            raise QueryError(f"the block was joined to tile {self.cover.tile_name(self.tile)} alone; ask the network for other tiles")
        return self.fused.sub_min if images is None else marginal(self.fused.sub_min, images)

    def with_outside(self, tiles: Sequence[int], images: Index) -> SubMin | None:
        """None: a block is joined to what the tile itself holds."""
        return None

    def image_set(self, rows: Sequence[int] | Index) -> ImageSet:
        """Images of these rows (ascending); the block's follow the network's."""
        return _image_set(self.source, self.images, self.first, rows)


def _image_set(source: NetworkSource, block: ImageSet, first: int, rows: Sequence[int] | Index) -> ImageSet:
    """Images of some rows (ascending) of the network and, from ``first`` on, of the block."""
    wanted = np.asarray(rows, dtype=np.int32)
    return both(source.image_set(wanted[wanted < first]), block.take(wanted[wanted >= first] - first))


def with_block(source: NetworkSource, tile: int, block: BlockRays, elsewhere: Ids, network_images: int) -> TileWithBlock:
    """Fuse a block into a tile's sub-MIN, in memory.

    Points that the tile holds gain the block's rays. Points new to the network are registered from the block's rays, and belong where they
    lie; those outside the tile, and points that the network has in other tiles (``elsewhere``), do not take part: a tile is its cells.

    Parameters
    ----------
    elsewhere : ids of the block's points that are in the network, in whatever tile
    network_images : number of images in the network

    Raises
    ------
    QueryError
        When no ray of the block falls into the tile.
    """
    rows = np.arange(network_images, network_images + len(block.images), dtype=np.int32)
    image_set = partial(_image_set, source, block.images, network_images)
    held = source.some_cells(existing_cells(source, [tile]))
    arrivals = {cell.number: np.isin(block.point_ids, cell.point_ids) for cell in held}
    here = np.any(list(arrivals.values()), axis=0) if arrivals else np.zeros(len(block.point_ids), dtype=np.bool_)
    new = ~here & ~np.isin(block.point_ids, elsewhere)
    new_ids, origin, place = _registered(block, new, source.cover)
    p, by_number = block.images.parameters, {cell.number: cell for cell in held}
    cells = {}
    for number in source.cover.cells_held(tile):
        gaining, lying = arrivals.get(number), place == number
        if lying.any() or (gaining is not None and gaining.any()):
            known = by_number[number] if number in by_number else empty_cell(number, p)
            chosen = np.isin(block.point_ids, new_ids[lying]) | (False if gaining is None else gaining)
            cells[number] = _joined_cell(known, block, rows, chosen, new_ids, origin)
    if not cells:
        raise QueryError(f"no ray of the block falls into tile {source.cover.tile_name(tile)}; name a tile that the block overlaps")
    rays = _together([new_rays(cell, image_set(cell.images), cell.images >= network_images) for cell in cells.values()])
    before = source.sub_min(tile, None)
    images = np.unique(np.concatenate([before.images, *(cell.images for cell in cells.values())])).astype(np.int32)

    def sums() -> Sums:
        return add_sums([source.cell_sums(number) for number in existing_cells(source, [tile])], before.images, p)

    return TileWithBlock(source, tile, block.images, network_images, cells, fuse(before, rays, images, image_set(images), sums))


def _registered(block: BlockRays, new: NDArray[np.bool_], cover: Cover) -> tuple[Ids, Array, NDArray[np.int64]]:
    """Ids (k,), ascending, positions (k, 3) and cells (k,) of the points of some of the block's rays; -1 where its cameras see none."""
    ids, point = np.unique(block.point_ids[new], return_inverse=True)
    every = np.ones(int(new.sum()), dtype=np.bool_)
    rays = sorted_rays(point.astype(np.int32), block.image[new].astype(np.int32), block.observed[new], block.sigma[new], every)
    origin = intersect(block.images, rays, len(ids)) if len(ids) else np.empty((0, 3))
    reached = np.isfinite(origin).all(axis=1)
    place = np.full(len(ids), -1, dtype=np.int64)
    if reached.any():
        geodetic = geocentric_to_geodetic(origin[reached], cover.ellipsoid)
        place[reached] = cover.cells_of(geodetic[:, 0], geodetic[:, 1])
    return ids, origin, place


def _joined_cell(cell: Cell, block: BlockRays, rows: Index, chosen: NDArray[np.bool_], new_ids: Ids, new_origin: Array) -> Cell:
    """A cell with some of the block's rays, on its points and on new ones."""
    ids, point = np.unique(block.point_ids[chosen], return_inverse=True)
    origin = np.zeros((len(ids), 3))  # of points that the cell has, its own holds
    _, at, of = np.intersect1d(ids, new_ids, return_indices=True)
    origin[at] = new_origin[of]
    arriving = RegisteredPoints(
        ids, origin, point.astype(np.int32), rows[block.image[chosen]], block.observed[chosen], block.sigma[chosen]
    )  # fmt: skip
    return with_rays(cell, arriving)


def _together(parts: Sequence[NewRays]) -> NewRays:
    """New rays of several cells as one set."""
    linear = joined([part.linear for part in parts])
    return NewRays(linear, np.concatenate([part.weight for part in parts]), np.concatenate([part.new for part in parts]))
