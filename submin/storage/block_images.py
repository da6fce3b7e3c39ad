"""The images of a block of a catalogue as a network has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from submin.adjustment.joint_errors import JointErrors
from submin.adjustment.priors import JointRows
from submin.network.network_image import JointPlace, NetworkImage, a_priori_text
from submin.storage.catalogue_schema import Block


def network_images(block: Block) -> tuple[NetworkImage, ...]:
    """The images of a block of a catalogue as a network has them."""
    images = tuple(
        NetworkImage(
            i.image_id, i.block_id, i.pass_id, i.sensor, i.camera, i.width, i.height, i.seconds,
            a_priori_text(block.a_priori, i.image_id, i.sensor, i.camera, i.width, i.height),
        )
        for i in block.images
    )  # fmt: skip
    return images if block.joint is None else _joined(images, block.joint, block.content_hash())


def _joined(images: Sequence[NetworkImage], joint: JointErrors, record: str) -> tuple[NetworkImage, ...]:
    """Views of correlated points with their rows of the common factor: two of a point's first view, the third of the other."""
    joined = []
    for k, image in enumerate(images):
        place = JointPlace(record, 3 * (k // 2) + 2 * (k % 2), 2 - k % 2, joint.part)
        rows = joint.factor[place.first : place.first + place.rows]
        joined.append(replace(image, a_priori=place.to_text(), joint=JointRows(rows, joint.part)))
    return tuple(joined)
