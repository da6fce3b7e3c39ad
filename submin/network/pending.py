"""Which sets of observations can be fused: those whose points are all determined by sets that can be fused. The others wait."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.errors import InputError
from submin.network.dense_sub_min import BlockInnovation, DenseSubMin
from submin.network.observations import Cluster, PointObservations, Stack

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
Flags = NDArray[np.bool_]

WEAK = 1e-3
"""Heights fix a point when they see its directions better than this part of a unit vector: the curvature of the earth does not count."""
FREE = 1e-6
"""Part of a unit vector above which a direction that is not fixed moves a point."""


@dataclass(frozen=True)
class FusedBlocks:
    """Blocks that were fused together (mostly one), and how they agreed with what was there."""

    block_ids: tuple[str, ...]
    innovation: BlockInnovation


class DenseNetwork:
    """A dense sub-MIN with all the blocks behind it: those fused, and those that wait because a point of theirs is not determined yet.

    The state is a function of the set of blocks, beyond round-off: a block is fused with the first version that determines all its points.

    Attributes
    ----------
    state : the sub-MIN of the blocks that can be fused
    blocks : every block by its name
    """

    def __init__(self, blocks: Iterable[PointObservations] = (), state: DenseSubMin | None = None) -> None:
        """With ``state``, the network goes on from one that was kept: that of those of the blocks that it names."""
        self.blocks: dict[str, PointObservations] = {}
        self.state = DenseSubMin() if state is None else state
        if state is None:
            self.add(blocks)
        else:
            self.blocks = {block.block_id: block for block in blocks}

    @property
    def pending(self) -> tuple[str, ...]:
        """Blocks that wait, by name."""
        return tuple(sorted(set(self.blocks) - set(self.state.blocks)))

    def add(self, blocks: Iterable[PointObservations]) -> list[FusedBlocks]:
        """Add blocks, and fuse every one that can be, earlier ones too.

        Raises
        ------
        InputError
            When a block is there already, fused or waiting, or its covariance is not positive definite; nothing is changed then.
        """
        given = list(blocks)
        new = dict(self.blocks)
        for block in given:
            if block.block_id in new:
                raise InputError(f"block {block.block_id} is already in the network; expected a new one: a block counts once")
            check_regular(block)
            new[block.block_id] = block
        self.blocks = new
        every, fused = list(new.values()), set(self.state.blocks)
        ready = [block for block, can in zip(every, fusable(every), strict=True) if can and block.block_id not in fused]
        return [FusedBlocks(block.block_ids, self.state.fuse(block)) for block in in_order(ready, self.state.ids.tolist())]

    def without(self, names: Iterable[str]) -> DenseNetwork:
        """The network of all other blocks, fused anew: as if these had never come.

        Raises
        ------
        InputError
            When one of them is not in the network.
        """
        gone = set(names)
        for name in sorted(gone - set(self.blocks)):
            raise InputError(f"block {name} is not in the network; expected one that was fused, or waits")
        return DenseNetwork(block for name, block in self.blocks.items() if name not in gone)


def check_regular(block: PointObservations) -> None:
    """Refuse a block whose covariance is not positive definite.

    Raises
    ------
    InputError
        With the name of the block.
    """
    covariance = np.asarray(block.covariance)
    if not np.allclose(covariance, covariance.T, rtol=1e-9, atol=1e-9 * float(np.abs(covariance).max(initial=0.0))):
        raise InputError(f"block {block.block_id}: its covariance is not symmetric; expected square metres, the same on both sides")
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise InputError(f"block {block.block_id}: its covariance is not positive definite; expected a regular one") from None


def fusable(blocks: Sequence[PointObservations]) -> Flags:
    """True (k,) for the blocks of the largest set that determines every point it is about.

    It does not depend on the order of the blocks, and more blocks never make it smaller: the union of two such sets is one.
    """
    kept = np.ones(len(blocks), dtype=bool)
    while kept.any():
        chosen = [block for block, k in zip(blocks, kept, strict=True) if k]
        ids = [block.point_ids for block in chosen]
        points, place = np.unique(np.concatenate(ids), return_inverse=True)
        lost = ~_determined(chosen, points, ())[place]
        owner = np.repeat(np.arange(len(chosen)), [len(i) for i in ids])
        bad = np.bincount(owner[lost], minlength=len(chosen)) > 0
        if not bad.any():
            break
        kept[np.flatnonzero(kept)[bad]] = False
    return kept


def in_order(blocks: Sequence[PointObservations], known: Iterable[str]) -> list[PointObservations]:
    """Fusable blocks in an order in which each determines its own new points, given those before; those that cannot alone, stacked."""
    have, order = set(known), list[PointObservations]()
    about: dict[str, list[int]] = defaultdict(list)
    for k, block in enumerate(blocks):
        for point in block.point_ids.tolist():
            about[point].append(k)
    left, queue = dict.fromkeys(range(len(blocks))), deque(range(len(blocks)))
    while queue:
        k = queue.popleft()
        if k not in left or not _determined([blocks[k]], blocks[k].point_ids, have).all():
            continue
        del left[k]
        order.append(blocks[k])
        found = [point for point in blocks[k].point_ids.tolist() if point not in have]
        have.update(found)
        queue.extend(other for point in found for other in about[point] if other in left)
    return order + [Stack(tuple(group)) for group in _connected([blocks[k] for k in left], have)]


def _connected(blocks: Sequence[PointObservations], have: Collection[str]) -> list[list[PointObservations]]:
    """Groups of blocks that hang together by points that are not known."""
    if not blocks:
        return []
    unknown = [[point for point in block.point_ids.tolist() if point not in have] for block in blocks]
    points, column = np.unique(np.concatenate([np.array(u, dtype=np.str_) for u in unknown]), return_inverse=True)
    row = np.repeat(np.arange(len(blocks)), [len(u) for u in unknown])
    size = len(blocks) + len(points)
    joined = sp.coo_array((np.ones(len(row)), (row, len(blocks) + column)), shape=(size, size))
    _, group = sp.csgraph.connected_components(joined, directed=False)
    return [[block for block, g in zip(blocks, group[: len(blocks)], strict=True) if g == one] for one in np.unique(group[: len(blocks)])]


def _determined(blocks: Sequence[PointObservations], points: Ids, known: Collection[str]) -> Flags:
    """True (n,) for those of some points (ascending, all that the blocks are about) that the blocks fix, given known ones.

    Positions and baselines are vectors: points that they join move as one, and are fixed when one of them is. What is left moves by a
    translation for each such body; heights fix those translations that they see (their design, summed over the points of a body).
    """
    n = len(points)
    start, end = [np.flatnonzero(np.isin(points, list(known)))] if known else [], list[NDArray[np.int64]]()
    end = [np.full(len(s), n) for s in start]  # the ground, to which all that is known is fixed
    others = list[sp.coo_array]()
    for block in blocks:
        if isinstance(block, Cluster):
            start.append(np.searchsorted(points, block.from_ids))
            end.append(np.where(block.positions, n, np.searchsorted(points, block.to_ids)))
        else:
            h = block.design().tocoo()
            at = np.searchsorted(points, block.point_ids)
            others.append(sp.coo_array((h.data, (h.row, 3 * at[h.col // 3] + h.col % 3)), shape=(h.shape[0], 3 * n)))
    row = np.concatenate(start) if start else np.empty(0, dtype=np.int64)
    column = np.concatenate(end) if end else np.empty(0, dtype=np.int64)
    joined = sp.coo_array((np.ones(len(row)), (row, column)), shape=(n + 1, n + 1))
    bodies, body = sp.csgraph.connected_components(joined, directed=False)
    fixed = np.zeros(bodies, dtype=bool)
    fixed[body[n]] = True
    if others and not fixed.all():
        free = np.flatnonzero(~fixed)
        number = np.full(bodies, -1)
        number[free] = np.arange(len(free))
        h = sp.coo_array(sp.vstack(others))
        to = number[body[h.col // 3]]
        seen = to >= 0
        shape = (h.shape[0], 3 * len(free))
        views = sp.coo_array((h.data[seen], (h.row[seen], 3 * to[seen] + h.col[seen] % 3)), shape=shape).toarray()
        _, strength, directions = np.linalg.svd(views, full_matrices=True)
        weak = directions[np.concatenate([strength, np.zeros(shape[1] - len(strength))]) < WEAK]
        moves = np.linalg.norm(weak.reshape(len(weak), len(free), 3), axis=(0, 2))
        fixed[free[moves < FREE]] = True
    return np.asarray(fixed[body[:n]])
