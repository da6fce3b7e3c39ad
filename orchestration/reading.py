"""Blocks of a catalogue made ready for a batch: whoever reads it sends rows, and tasks make blocks of them, checked and hashed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

from orchestration.executors import Executor
from submin.network.network_image import NetworkImage
from submin.storage.block_images import images_of_blocks
from submin.storage.block_rows import BlockRows
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, defects

T = TypeVar("T")

BLOCKS_TOGETHER = 16
"""Blocks that are made ready together: their images are worked out at once."""


@dataclass(frozen=True)
class Incoming:
    """A block on its way into a network, with what can be told of it before its rays are adjusted.

    Attributes
    ----------
    block : as the catalogue has it; the numbers of its points and its hash are worked out
    reason : why it cannot come in, or None
    images : its images as a network has them; none of a block that cannot come in
    """

    block: Block
    reason: str | None
    images: tuple[NetworkImage, ...]

    def refused(self, reason: str) -> Incoming:
        """The same block, which cannot come in for another reason."""
        return Incoming(self.block, reason, ())


def read_catalogue(catalogue: Catalogue, executor: Executor, batch_blocks: int) -> Iterator[Incoming]:
    """Every block of a catalogue, in its order; at most a batch of them is under way.

    Raises
    ------
    CatalogueError
        As `Catalogue.block_rows`.
    """
    groups = ((rows,) for rows in _groups(catalogue.block_rows()))
    ahead = -(-max(batch_blocks, 1) // BLOCKS_TOGETHER)
    for made in executor.stream(ready_from_rows, groups, "read", ahead=ahead, past_kills=True):
        yield from made


def ready(blocks: Iterable[Block]) -> Iterator[Incoming]:
    """Blocks that are here already, made ready here."""
    for group in _groups(blocks):
        yield from _ready(group)


def ready_from_rows(rows: Sequence[BlockRows]) -> list[Incoming]:
    """A task: the blocks of some rows, made ready. What is wrong with the values of one is the reason of that block, and no error."""
    return _ready([of_block.block() for of_block in rows])


def _ready(blocks: Sequence[Block]) -> list[Incoming]:
    for block in blocks:
        block.content_hash()  # kept in the block, as the numbers of its points are, it travels with it
    reasons = [defects(block) for block in blocks]
    images = iter(images_of_blocks([block for block, reason in zip(blocks, reasons, strict=True) if reason is None]))
    return [Incoming(block, reason, next(images) if reason is None else ()) for block, reason in zip(blocks, reasons, strict=True)]


def _groups(values: Iterable[T]) -> Iterator[list[T]]:
    left = iter(values)
    while group := list(islice(left, BLOCKS_TOGETHER)):
        yield group
