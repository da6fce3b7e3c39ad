"""Blocks of a catalogue made ready for a batch: whoever reads it sends rows; tasks make blocks of them, checked, hashed and adjusted."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from orchestration.executors import Executor
from orchestration.stage_one import BlockAdjustment, BlockRays, adjust_block
from submin.geodesy import Ellipsoid
from submin.network.network_image import NetworkImage
from submin.storage.block_images import images_of_blocks
from submin.storage.block_rows import BlockRows
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, defects

T = TypeVar("T")

BLOCKS_TOGETHER = 16
"""Blocks of a task, in batches of as many or more: their images are worked out at once."""


@dataclass(frozen=True)
class Incoming:
    """A block on its way into a network, with what can be told of it by itself.

    Attributes
    ----------
    block : as the catalogue has it; the numbers of its points and its hash are worked out
    reason : why it cannot come in, or None
    images : its images as a network has them; none of a block that cannot come in
    adjusted : its stage 1, where that is done: only of blocks of images
    """

    block: Block
    reason: str | None
    images: tuple[NetworkImage, ...]
    adjusted: BlockAdjustment | None = None

    @property
    def rays(self) -> BlockRays:
        """The block as stage 1 sees it."""
        return BlockRays.of(self.block, self.images)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(r,) False for the blunders that stage 1 has found."""
        return np.ones(len(self.block), dtype=np.bool_) if self.adjusted is None else self.adjusted.accepted

    def refused(self, reason: str) -> Incoming:
        """The same block, which cannot come in for another reason."""
        return Incoming(self.block, reason, ())


def read_catalogue(catalogue: Catalogue, executor: Executor, batch_blocks: int, here: Collection[str] = ()) -> Iterator[Incoming]:
    """Every block of a catalogue, in its order, adjusted by itself but for those ``here`` in the network; at most a batch is under way.

    Those whose task killed its workers, or was with one that did, come without their adjustment.

    Raises
    ------
    CatalogueError
        As `Catalogue.block_rows`.
    """
    ellipsoid = catalogue.metadata.ellipsoid
    together = min(BLOCKS_TOGETHER, max(batch_blocks, 1))
    ahead = -(-max(batch_blocks, 1) // together)
    groups = ((rows, ellipsoid, {each.block_id for each in rows}.intersection(here)) for rows in _groups(catalogue.block_rows(), together))
    for made in executor.stream(adjusted_from_rows, groups, "adjust", ahead=ahead, killed=ready_from_rows):
        yield from made


def ready(blocks: Iterable[Block]) -> Iterator[Incoming]:
    """Blocks that are here already, made ready here."""
    for group in _groups(blocks, BLOCKS_TOGETHER):
        yield from _ready(group)


def adjusted_from_rows(rows: Sequence[BlockRows], ellipsoid: Ellipsoid, here: Collection[str]) -> list[Incoming]:
    """A task: the blocks of some rows, made ready; those that can come in and are not ``here`` are adjusted by themselves."""
    return [
        come if come.reason is not None or come.block.block_id in here else replace(come, adjusted=adjust_block(come.rays, ellipsoid))
        for come in ready_from_rows(rows)
    ]


def ready_from_rows(rows: Sequence[BlockRows], *_: object) -> list[Incoming]:
    """The blocks of some rows, made ready. What is wrong with the values of one is the reason of that block, and no error."""
    return _ready([of_block.block() for of_block in rows])


def _ready(blocks: Sequence[Block]) -> list[Incoming]:
    for block in blocks:
        block.content_hash()  # kept in the block, as the numbers of its points are, it travels with it
    reasons = [defects(block) for block in blocks]
    images = iter(images_of_blocks([block for block, reason in zip(blocks, reasons, strict=True) if reason is None]))
    return [Incoming(block, reason, next(images) if reason is None else ()) for block, reason in zip(blocks, reasons, strict=True)]


def _groups(values: Iterable[T], size: int) -> Iterator[list[T]]:
    left = iter(values)
    while group := list(islice(left, size)):
        yield group
