"""The images of a block of a catalogue as a network has them."""

from __future__ import annotations

import json

from submin.network.network_image import NetworkImage
from submin.storage.catalogue_schema import Block


def network_images(block: Block) -> tuple[NetworkImage, ...]:
    """The images of a block of a catalogue as a network has them."""
    a_priori = "" if block.a_priori is None else json.dumps(block.a_priori.to_mapping(), sort_keys=True)
    return tuple(
        NetworkImage(i.image_id, i.block_id, i.pass_id, i.sensor, i.camera, i.width, i.height, i.seconds, a_priori) for i in block.images
    )
