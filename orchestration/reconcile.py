"""Reconcile a network: one pass up and one down a tree of its tiles, after which each tile alone answers as the whole network.

Workers compute and write to forks of the coordinator's session, as in every change; one commit ends it (decision 014).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import icechunk
import numpy as np
import scipy.sparse as sp
import zarr
from numpy.typing import NDArray

from orchestration.executors import Executor
from orchestration.progress import Reporter, Silent
from orchestration.task_record import TaskRecord
from submin.adjustment.symmetric import between, fill_symmetric
from submin.errors import InputError
from submin.network.outside_messages import Elimination, Message, State, complete, eliminate, front_of
from submin.network.sub_min import add_sums
from submin.network.whitened_vectors import Vectors, vectors_of
from submin.storage.commit import begin_change, commit, unread
from submin.storage.dense_reader import is_dense
from submin.storage.reconciled import (
    ImageDirectory,
    ReconciledStore,
    drop_trees,
    holders_of_shared,
    note_shared_names,
    shared_names,
    write_elimination,
    write_tile_state,
    write_tree,
)
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import writing
from submin.tiling.tile_tree import TileTree, TreeNode, trees_of


@dataclass(frozen=True)
class ReconcileResult:
    """What a reconciliation did; the keys of ``submin reconcile --json``.

    Attributes
    ----------
    version : of the network afterwards; tiles : reconciled, untouched : whose states stand as they are
    parts : connected parts of the network; largest_front : vectors of the largest front
    tasks : what tasks took, by their names
    """

    version: str
    tiles: int
    untouched: int
    parts: int
    largest_front: int
    seconds: float
    peak_memory_mb: float
    tasks: Mapping[str, TaskRecord]

    def to_json(self) -> dict[str, Any]:
        """Plain values, as programs rely on them."""
        return {**vars(self), "tasks": {name: record.to_json() for name, record in sorted(self.tasks.items())}}


@dataclass(frozen=True, eq=False)
class NodeDone:
    """A node on the way down: the state of its front, and what was written of it."""

    state: State
    writes: icechunk.ForkSession


def reconcile(place: str, executor: Executor, reporter: Reporter | None = None) -> ReconcileResult:
    """Give every tile of a network what lies outside of it. Parts in which nothing changed since the last time keep their states.

    Raises
    ------
    InputError
        When the network is dense: it has one tile, and nothing outside.
    BusyError, ConflictError
        When another process is writing to the network; nothing is written then.
    """
    started, reporter = time.monotonic(), reporter or Silent()
    with writing(place):
        session, base = begin_change(place, Snapshot.open(place).number)
        if is_dense(base):
            raise InputError(f"{place}: is a dense network, whose one tile holds every point; there is nothing to reconcile")
        known, names = ReconciledStore.of(base), shared_names(base)
        vectors, trees = plan_trees(base, executor, reporter)
        kept = {tree.tiles: name for tree in trees if (name := _standing(known, tree, vectors)) is not None}
        new = [tree for tree in trees if tree.tiles not in kept]
        front = max((len(node.interior) + len(node.boundary) for tree in new for node in tree.nodes), default=0)
        untouched = sum(len(tiles) for tiles in kept)
        version = base.number
        if new or set(kept.values()) != set(known.trees()):
            version += 1
            made = {}
            for k, tree in enumerate(new):
                made[f"v{version}p{k}"] = tree, *_reconcile_tree(session, base, f"v{version}p{k}", tree, vectors, executor, reporter)
            for _, _, writes in made.values():
                session.merge(*writes)
            root = zarr.open_group(session.store, mode="r+")
            note_shared_names(root, names)
            for name, (tree, whole, _) in made.items():
                of_tiles = [vectors[tile] for tile in tree.tiles]
                members = np.unique(np.concatenate([v.images for v in of_tiles])).astype(np.int64)
                attributes = {
                    "version": version, "images": base.image_count(), "released": sorted(known.released.intersection(members.tolist())),
                    "chi_square": whole.chi_square, "redundancy": whole.redundancy,
                }  # fmt: skip
                write_tree(root, name, tree, members, holders_of_shared(tree.tiles, of_tiles), attributes)
            drop_trees(root, {*kept.values(), *made}, [base.cover.tile_name(tile) for tile in vectors])
            root.attrs["version"] = version
            commit(session, version, f"{len(vectors) - untouched} tiles reconciled")
    return ReconcileResult(
        f"v{version}",
        len(vectors) - untouched,
        untouched,
        len(trees),
        front,
        time.monotonic() - started,
        executor.peak_memory_mb(),
        executor.task_records(),
    )


def reconcile_changes(place: str, executor: Executor, reporter: Reporter | None = None) -> ReconcileResult | None:
    """Reconcile a network after a change; None where nothing lies outside of a tile, or nothing has changed."""
    latest = Snapshot.open(place)
    tiles = latest.tile_numbers()
    if len(tiles) < 2 or ReconciledStore.of(latest).current(tiles):
        return None
    executor.give_back()  # what the change has left
    done = reconcile(place, executor, reporter)
    return done if done.version != latest.version else None


def plan_trees(base: Snapshot, executor: Executor, reporter: Reporter) -> tuple[dict[int, Vectors], tuple[TileTree, ...]]:
    """The vectors of every tile, and a tree for each connected part of the network."""
    directory, names = ImageDirectory(base), shared_names(base)
    held = {tile: base.tile_images(tile) for tile in base.tile_numbers()}
    arguments = [(directory.whole(images), images, base.metadata.parameters, names) for images in held.values()]
    handles = executor.submit_all(vectors_of, arguments, "vectors", reporter.stage("naming vectors", len(held)))
    vectors = dict(zip(held, executor.results(handles), strict=True))
    return vectors, trees_of(tuple(vectors), [of_tile.names for of_tile in vectors.values()], _middles(base, vectors))


def _middles(base: Snapshot, tiles: Iterable[int]) -> NDArray[np.float64]:
    outlines = np.array([base.cover.core_outline(tile) for tile in tiles]).reshape(-1, 5, 2)
    return np.asarray(0.5 * (outlines[:, 0] + outlines[:, 2]))


def _standing(known: ReconciledStore, tree: TileTree, vectors: Mapping[int, Vectors]) -> str | None:
    """Name under which a part of the network is kept as it still is, or None."""
    states = [known.tile(tile) for tile in tree.tiles]
    names = {state.tree for state in states if state is not None}
    if len(names) != 1 or None in states:
        return None
    (name,) = names
    before = known.tree(name)
    same = before.tiles == set(tree.tiles) and all(
        state is not None and np.array_equal(state.vectors.names, vectors[tile].names)
        for tile, state in zip(tree.tiles, states, strict=True)
    )
    return name if same and known.stands(before) else None


def _reconcile_tree(
    session: icechunk.Session, base: Snapshot, name: str, tree: TileTree, vectors: Mapping[int, Vectors], executor: Executor,
    reporter: Reporter,
) -> tuple[Message, list[icechunk.ForkSession]]:  # fmt: skip
    """Messages up and states down one tree: what its root says of the whole part, and what was written."""
    shared = executor.share(Snapshot(base.root, base.place, replace(base.cover, area=b"")))
    nodes, messages = tree.nodes, collected(tree, shared, vectors, executor)
    executor.wait(messages, reporter.stage("collecting from tiles", len(nodes)))
    (whole,) = executor.results(messages[-1:])
    writes: list[Any] = []

    def down(k: int, above: Any) -> None:
        """Depth first, so that what a node has given is freed soon: the handles are let go here, once they are arguments."""
        node = nodes[k]
        if not node.children:
            task = (session.fork(), shared, name, k, node, vectors[node.tile], above)
            writes.append(executor.submit(distribute_tile, task, "distribute-tile"))
            return
        below = [messages[c] for c in node.children]
        state = executor.submit(distribute_node, (session.fork(), name, k, node, below, above), "distribute-node")
        writes.append(executor.submit(writes_of, (state,), "writes-of"))
        for child in node.children:
            messages[child] = None
            down(child, state)

    down(len(nodes) - 1, None)
    executor.wait(writes, reporter.stage("distributing to tiles", len(nodes)))
    return whole, executor.results(writes)


def collected(tree: TileTree, shared: Any, vectors: Mapping[int, Vectors], executor: Executor) -> list[Any]:
    """Messages of all nodes of a tree, children before parents; ``shared`` is the version (or a handle of it) with the cells."""
    messages: list[Any] = []
    for node in tree.nodes:
        if node.children:
            messages.append(executor.submit(collect_node, (node, [messages[c] for c in node.children]), "collect-node"))
        else:
            messages.append(executor.submit(collect_tile, (shared, node, vectors[node.tile]), "collect-tile"))
    return messages


def collect_tile(base: Snapshot, node: TreeNode, vectors: Vectors) -> Message:
    """What the own cells of a tile say of the vectors that other tiles hold too."""
    return eliminate_tile(base, node, vectors)[1]


def collect_node(node: TreeNode, messages: Sequence[Message]) -> Message:
    """What the tiles below a node say of the vectors that tiles outside hold too."""
    return eliminate_node(node, messages)[1]


def distribute_node(
    writes: icechunk.ForkSession, tree: str, place: int, node: TreeNode, messages: Sequence[Message], above: NodeDone | None
) -> NodeDone:
    """The posterior state of a node's front, from that of the node above; its elimination is kept, for queries over several tiles."""
    writes = unread(writes)  # what a task was given stays in memory as long as what it gives
    done, _ = eliminate_node(node, messages)
    write_elimination(zarr.open_group(writes.store, mode="r+"), tree, place, done)
    return NodeDone(complete(done, None if above is None else above.state), unread(writes))


def writes_of(done: NodeDone) -> icechunk.ForkSession:
    """The part of a node's result that goes back to the coordinator; the state stays with the workers."""
    return done.writes


def distribute_tile(
    writes: icechunk.ForkSession, base: Snapshot, tree: str, place: int, node: TreeNode, vectors: Vectors, above: NodeDone | None
) -> icechunk.ForkSession:
    """The posterior state of a tile's vectors, written."""
    writes = unread(writes)
    done, _ = eliminate_tile(base, node, vectors)
    root = zarr.open_group(writes.store, mode="r+")
    write_elimination(root, tree, place, done)
    state = complete(done, None if above is None else above.state)
    write_tile_state(root, base.cover.tile_name(node.tile), tree, place, vectors, state)
    return unread(writes)


def eliminate_tile(base: Snapshot, node: TreeNode, vectors: Vectors) -> tuple[Elimination, Message]:
    """Eliminate, from a tile's own cells, the vectors that no other tile holds."""
    cells = [base.cell_sums(number) for number in base.cover.cells_owned(node.tile)]
    sums = add_sums([cell for cell in cells if len(cell[0])], vectors.images, base.metadata.parameters)
    order = np.searchsorted(vectors.names, np.concatenate([node.interior, node.boundary]))
    prior = sp.csr_array(vectors.prior[:, order])
    information = between(prior, fill_symmetric(sums.information), transposed=True)
    return eliminate(node.interior, node.boundary, information, prior.T @ sums.vector, sums.misclosure, sums.redundancy)


def eliminate_node(node: TreeNode, messages: Sequence[Message]) -> tuple[Elimination, Message]:
    """Eliminate, from what the tiles below a node say, the vectors that no tile outside holds."""
    front = front_of(np.concatenate([node.interior, node.boundary]), messages)
    chi_square, redundancy = sum(message.chi_square for message in messages), sum(message.redundancy for message in messages)
    return eliminate(node.interior, node.boundary, *front, chi_square, redundancy)
