"""The ledger: what came into a network, when, and what became of it. It makes sure that everything counts exactly once."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np
import zarr

from submin.storage.arrays import append_table
from submin.storage.catalogue_schema import Block
from submin.storage.control_blocks import point_of_view, points_of
from submin.storage.snapshot import Snapshot

UNTESTED = (0.0, 0, 1.0, 0, -1)
"""The columns of a test in a line of a block that was not tested: nothing of it was in the network."""
VIEWS = 2
"""Images that a surveyed point has."""
_MEASURED = re.compile(r"\d+\.\d+|\bv\d+\b")


@dataclass(frozen=True)
class Entry:
    """One line of the ledger. The last line of a block that is not a rejection counts: a rejected newcomer leaves what is there.

    Attributes
    ----------
    block_id : the block; ``control:ID`` for a control point, ``control:set:...`` for a set of correlated ones
    content : hash of what came, see `Block.content_hash`; empty for a rejected block
    status : ``fused``, ``rejected`` or ``withdrawn``
    reason : why it was rejected, or which images are withdrawn from it
    version : that the line came with
    images, rays, rays_rejected : what the network has of the block
    d2, dof, probability, left_out, against : test by the network when the block came (`submin.network.innovation.BlockTest`): statistic,
        degrees of freedom, probability, common points left out, and number of the version; `UNTESTED` where nothing was in common
    kind : of the block, one of `BLOCK_KINDS`
    """

    block_id: str
    content: str
    status: str
    reason: str
    version: int
    images: int = 0
    rays: int = 0
    rays_rejected: int = 0
    d2: float = 0.0
    dof: int = 0
    probability: float = 1.0
    left_out: int = 0
    against: int = -1
    kind: str = "images"


def append_entries(ledger: zarr.Group, entries: Sequence[Entry]) -> None:
    """Append lines to the ledger's table."""
    if entries:
        columns = zip(*(astuple(entry) for entry in entries), strict=True)
        append_table(ledger, {f.name: np.array(values) for f, values in zip(fields(Entry), columns, strict=True)})


def blocks_in(snapshot: Snapshot) -> frozenset[str]:
    """Ids of the blocks that are in a version, without the rest of its ledger."""
    lines = snapshot.ledger(["block_id", "status"])
    last = {block: status for block, status in zip(*(c.tolist() for c in lines.values()), strict=True) if status != "rejected"}
    return frozenset(block for block, status in last.items() if status == "fused")


class Ledger:
    """What a version of a network holds, and what a run has added to it since.

    Attributes
    ----------
    entries : the line that counts of each block that is or was in the network
    rejections : reason of each block whose last line is a rejection
    block_of_image : block of every image that is not withdrawn
    """

    def __init__(self, lines: Iterable[Entry], block_of_image: dict[str, str]) -> None:
        self.entries: dict[str, Entry] = {}
        self.rejections: dict[str, str] = {}
        self.block_of_image = block_of_image
        for line in lines:
            if line.status == "rejected":
                self.rejections[line.block_id] = line.reason
            else:
                self.entries[line.block_id] = line
                self.rejections.pop(line.block_id, None)
        self._content = {e.block_id: e.content for e in self.entries.values() if e.status == "fused"}

    @classmethod
    def of(cls, snapshot: Snapshot) -> Ledger:
        """The ledger of a version."""
        table = snapshot.ledger([f.name for f in fields(Entry)])
        rows = zip(*(values.tolist() for values in table.values()), strict=True)
        images = snapshot.image_columns(["image_id", "block_id", "withdrawn"])
        here = images["withdrawn"] == 0
        return cls(
            [Entry(*row) for row in rows],
            dict(zip(images["image_id"][here].tolist(), images["block_id"][here].tolist(), strict=True)),
        )

    def holds(self, block: Block) -> bool:
        """True when the same block is in the network."""
        return block.block_id in self._content and self._content[block.block_id] == block.content_hash()

    def refusal(self, block: Block) -> str | None:
        """Why a block that is not the same as before cannot come in, whatever its measurements are, or None."""
        if block.block_id in self._content:
            if block.kind == "control":
                what = f"control point {block.point_ids[0]}" if block.joint is None else f"set of {len(points_of(block))} control points"
                return f"{what} is already in the network with other values; withdraw it first ('submin withdraw --control')"
            return f"block {block.block_id} is already in the network with other content; withdraw it first, or give the new one another id"
        for image in block.images:
            point = point_of_view(image.image_id)
            if image.image_id in self.block_of_image and point is not None:
                return (
                    f"point {point} is control of the network already, in block {self.block_of_image[image.image_id]}; "
                    f"a survey counts once; withdraw that first ('submin withdraw --control {point}')"
                )
            if image.image_id in self.block_of_image:
                return f"image {image.image_id} already came in block {self.block_of_image[image.image_id]}; an image counts once"
        return None

    def enter(self, block: Block) -> None:
        """A block is on its way in: nothing later in the run may bring it or its images again."""
        self._content[block.block_id] = block.content_hash()
        self.block_of_image.update((image.image_id, block.block_id) for image in block.images)

    def said(self, block_id: str, reason: str) -> bool:
        """True when the last line of a block is a rejection for the same reason; measured values and versions in it may be others."""
        return _MEASURED.sub("", self.rejections.get(block_id, "")) == _MEASURED.sub("", reason)

    def fused(self) -> tuple[Entry, ...]:
        """Blocks of images that are in the network."""
        return tuple(e for e in self.entries.values() if e.status == "fused" and e.kind == "images")

    def control_points(self) -> tuple[str, ...]:
        """Ids of the control points that are in the network, those of sets and of observed positions among them."""
        return tuple(sorted({point for image in self.block_of_image if (point := point_of_view(image)) is not None}))

    def control_sets(self) -> tuple[str, ...]:
        """Blocks of points with a joint covariance that are in the network."""
        return tuple(e.block_id for e in self.entries.values() if e.status == "fused" and e.kind != "images" and e.images > VIEWS)
