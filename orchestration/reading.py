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
class ReadBlock:
    """A block with all that it tells alone; the numbers of its points and its hash are worked out.

    Attributes
    ----------
    block : as the catalogue has it
    defect : why it cannot be used, or None
    images : its images as a network has them; none of a block with a defect
    """

    block: Block
    defect: str | None
    images: tuple[NetworkImage, ...]


def read_catalogue(catalogue: Catalogue, executor: Executor) -> Iterator[ReadBlock]:
    """Every block of a catalogue, in its order, a bounded number at a time.

    Raises
    ------
    CatalogueError
        As `Catalogue.block_rows`.
    """
    for group in executor.stream(read_rows, ((group,) for group in _groups(catalogue.block_rows())), "read"):
        yield from group


def read_rows(rows: Sequence[BlockRows]) -> list[ReadBlock]:
    """The blocks of some rows."""
    return _looked_at([of_block.block() for of_block in rows])


def looked_at(blocks: Iterable[Block]) -> Iterator[ReadBlock]:
    """Blocks that are here already."""
    for group in _groups(blocks):
        yield from _looked_at(group)


def _looked_at(blocks: Sequence[Block]) -> list[ReadBlock]:
    for block in blocks:
        block.content_hash()
    of_block = [defects(block) for block in blocks]
    images = iter(images_of_blocks([block for block, defect in zip(blocks, of_block, strict=True) if defect is None]))
    return [ReadBlock(block, defect, next(images) if defect is None else ()) for block, defect in zip(blocks, of_block, strict=True)]


def _groups(values: Iterable[T]) -> Iterator[list[T]]:
    left = iter(values)
    while group := list(islice(left, BLOCKS_TOGETHER)):
        yield group
