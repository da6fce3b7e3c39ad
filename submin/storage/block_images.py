"""The images of a block of a catalogue as a network has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from submin.adjustment.joint_errors import JointErrors
from submin.adjustment.priors import JointRows
from submin.network.network_image import JointPlace, NetworkImage, a_priori_texts
from submin.storage.catalogue_schema import Block


def network_images(block: Block) -> tuple[NetworkImage, ...]:
    """The images of a block of a catalogue as a network has them."""
    return images_of_blocks([block])[0]


def images_of_blocks(blocks: Sequence[Block]) -> list[tuple[NetworkImage, ...]]:
    """The images of blocks of a catalogue as a network has them, worked out for all of them at once."""
    records = [image for block in blocks for image in block.images]
    texts = iter(a_priori_texts([block.a_priori for block in blocks for _ in block.images], records))
    found = []
    for block in blocks:
        images = tuple(
            NetworkImage(i.image_id, i.block_id, i.pass_id, i.sensor, i.camera, i.width, i.height, i.seconds, next(texts))
            for i in block.images
        )
        found.append(images if block.joint is None else _joined(images, block.joint, block.content_hash()))
    return found


def _joined(images: Sequence[NetworkImage], joint: JointErrors, record: str) -> tuple[NetworkImage, ...]:
    """Views of correlated points with their rows of the common factor: two of a point's first view, the third of the other."""
    joined = []
    for k, image in enumerate(images):
        place = JointPlace(record, 3 * (k // 2) + 2 * (k % 2), 2 - k % 2, joint.part)
        rows = joint.factor[place.first : place.first + place.rows]
        joined.append(replace(image, a_priori=place.to_text(), joint=JointRows(rows, joint.part)))
    return tuple(joined)
