"""Networks that were reconciled and then grow; every tile of theirs is compared with the sources that it may know."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from whole_network import same, truth

import submin
from orchestration.executors import SerialExecutor
from orchestration.reconcile import reconcile
from submin.query.planner import points_of_tile
from submin.simulation.region import SimulatedRegion
from submin.storage.catalogue_schema import Block

HERE = SerialExecutor()


def quiet(blocks: Sequence[Block], region: SimulatedRegion) -> list[Block]:
    """The blocks without their blunders and bad cameras' rays: nothing is rejected later that was accepted before."""
    wrong = {
        (str(region.point_ids[p]), region.images[i].image_id)
        for p, i in zip(region.point[region.blunder], region.image[region.blunder], strict=True)
    }
    clean = []
    for block in blocks:
        if {image.image_id for image in block.images} & set(region.bad_cameras):
            continue
        names = [image.image_id for image in block.images]
        good = np.array([(str(p), names[i]) not in wrong for p, i in zip(block.point_ids, block.image, strict=True)])
        clean.append(with_rays(block, good))
    return clean


def with_rays(block: Block, rays: NDArray[np.bool_]) -> Block:
    """Some of a block's rays."""
    fields = ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")
    return dataclasses.replace(block, **{name: getattr(block, name)[rays] for name in fields})


class Growing:
    """A network that was reconciled, and what came after."""

    def __init__(self, place: Path, version: str) -> None:
        self.network, self.then = submin.open(place), submin.open(place).at(version)

    def tiles(self) -> Iterator[int]:
        """Tiles whose state of then is in use."""
        none = np.empty(0, dtype=np.int32)
        for tile in self.network.snapshot.tile_numbers():
            if points_of_tile(self.network, tile) and self.network.with_outside([tile], none) is not None:
                yield tile

    def touched(self) -> list[int]:
        """Those of them that hold what came."""
        new = self.then.snapshot.image_count()
        return [tile for tile in self.tiles() if (self.network.snapshot.tile_images(tile) >= new).any()]

    def check(self) -> int:
        """Of these tiles four that hold what came, and two others, answer by the very sources that they may know; how many there are."""
        tiles, touched = list(self.tiles()), self.touched()
        others = [tile for tile in tiles if tile not in touched]
        for tile in (*touched[:2], *touched[-2:], *others[:1], *others[-1:]):
            same(self.network, tile, truth(self.network, self.then, [tile]))
        assert touched
        return len(tiles)


def with_more(fuse: Callable[..., Path], first: Sequence[Block], more: Sequence[Block], **cover: float) -> Growing:
    place = fuse(first, **cover)
    reconcile(str(place), HERE)
    fuse(more, **cover)
    return Growing(place, "v2")


def ends_of_a_pass(fuse: Callable[..., Path], few: Sequence[Block]) -> tuple[Growing, list[int]]:
    """The first block of a pass is there, then the last comes, without those between; and tiles that get it and do not hold the pass."""
    of_pass = [k for k, block in enumerate(few) if block.images[0].pass_id == few[0].images[0].pass_id]
    rest = [block for k, block in enumerate(few) if k not in of_pass[1:]]
    growing = with_more(fuse, rest, [few[of_pass[-1]]])
    pass_rows = np.flatnonzero(growing.network.snapshot.image_columns(["pass_id"])["pass_id"] == few[0].images[0].pass_id)
    strange = []
    for tile in growing.touched():
        state = growing.network._reconciled.tile(tile)
        if state is not None and not np.isin(state.vectors.images, pass_rows).any():
            strange.append(tile)
    assert strange
    return growing, strange
