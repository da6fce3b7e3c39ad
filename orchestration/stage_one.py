"""Stage 1: blocks adjusted each by itself, free of any network, so that blunders are found before they tie anything.

What comes out depends on the block alone, so it can be worked out while earlier blocks are still on their way into the network.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.adjustment import BundleEstimate, adjust
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import blind_image, intersect
from submin.adjustment.rays import Rays, canonical_order
from submin.adjustment.status import Cause, Status
from submin.errors import SubminError
from submin.geodesy import Ellipsoid
from submin.network.network_image import NetworkImage, image_set
from submin.sensors import width_of
from submin.storage.block_images import network_images
from submin.storage.catalogue_schema import Block

Flags = NDArray[np.bool_]

LEAST_AGREEING = 0.5
"""Part of a block's rays that its own adjustment must accept: fewer are no blunders in a good block."""


@dataclass(frozen=True)
class BlockRays:
    """A block as stage 1 sees it: its images, the ids of its points (ascending), and its rays by point and image."""

    block_id: str
    images: tuple[NetworkImage, ...]
    ids: NDArray[np.str_]
    point: NDArray[np.int32]
    image: NDArray[np.int32]
    observed: NDArray[np.float64]
    sigma: NDArray[np.float64]

    @classmethod
    def of(cls, block: Block, images: tuple[NetworkImage, ...] | None = None) -> BlockRays:
        """A block of a catalogue; ``images`` where they are known already, as the network will have them."""
        return cls(
            block.block_id, network_images(block) if images is None else images, *block.points, block.image, block.observed, block.sigma
        )

    def image_set(self, ellipsoid: Ellipsoid) -> ImageSet:
        """Its images, with as many parameters as the widest of their sensors has."""
        return image_set(self.images, ellipsoid, width_of(image.sensor for image in self.images))

    def ordered(self, accepted: Flags) -> tuple[NDArray[np.intp], Rays]:
        """Its rays in canonical order, and their places in the block; ``accepted`` (r,) is in the block's order."""
        order = canonical_order(self.point, self.image, self.observed)
        return order, Rays(self.point[order], self.image[order], self.observed[order], self.sigma[order], accepted[order])


@dataclass(frozen=True)
class BlockAdjustment:
    """Stage 1 of one block.

    Attributes
    ----------
    block_id : the block
    accepted : (r,) False for blunders, in the block's order
    reason : why the whole block is not accepted, or None
    estimate : where cameras and points are; None where nothing was adjusted, because no point has two rays
    """

    block_id: str
    accepted: Flags
    reason: str | None
    estimate: BundleEstimate | None = None


def adjust_block(block: BlockRays, ellipsoid: Ellipsoid) -> BlockAdjustment:
    """A task: stage 1 of one block, its blunders rejected, or the reason for which nothing comes of it."""
    every = np.ones(len(block.image), dtype=np.bool_)
    try:
        images, (order, rays) = block.image_set(ellipsoid), block.ordered(every)
        start = intersect(images, rays, len(block.ids))
        lost = np.flatnonzero(~np.isfinite(start).all(axis=1))
        blind = (int(rays.image[np.searchsorted(rays.point, lost[0])]), int(lost[0])) if len(lost) else blind_image(images, rays)
        if blind is not None:
            return BlockAdjustment(block.block_id, every, Status(Cause.UNSEEN, False, 0, *blind).message(images.ids, block.ids))
        if np.bincount(rays.point).max() < 2:
            return BlockAdjustment(block.block_id, every, None)
        result = adjust(images, rays, start, to_rest=False)
        if result.status.cause not in (Cause.CONVERGED, Cause.FEW_AGREE):  # that few agree is told from the rays, settled or not
            return BlockAdjustment(block.block_id, every, result.status.message(images.ids, block.ids))
        accepted = np.empty_like(every)
        accepted[order] = result.accepted
        return BlockAdjustment(block.block_id, accepted, disagreement(accepted), result.estimate)
    except SubminError as error:
        return BlockAdjustment(block.block_id, every, str(error))


def disagreement(accepted: Flags) -> str | None:
    """Why a block whose rays contradict each other stays out: its points would be registered where they are not, against good blocks."""
    if accepted.sum() >= LEAST_AGREEING * len(accepted):
        return None
    return (
        f"only {accepted.sum()} of the block's {len(accepted)} rays agree with each other; "
        "check the order of sample and line, the point ids and the cameras"
    )
