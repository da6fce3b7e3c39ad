"""Is what was reconciled sound? It is made again from the cells of its version, and compared number by number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orchestration.executors import Executor
from orchestration.progress import Reporter
from orchestration.reconcile import collected, eliminate_node, eliminate_tile, plan_trees
from submin.network.outside_messages import Elimination, Message, State, complete, unpacked_state
from submin.network.whitened_vectors import Vectors
from submin.storage.problems import DAMAGE, Problem, first_line
from submin.storage.reconciled import ReconciledStore, read_elimination
from submin.storage.snapshot import Snapshot
from submin.tiling.tile_tree import TileTree, TreeNode

Array = NDArray[np.float64]

TOLERANCE = 1e-8
"""Of the largest number of an array: what other machines and libraries may make of the same cells."""


@dataclass(frozen=True, eq=False)
class Checked:
    """A node on the way down: the state of its front made anew, and what is wrong with what is kept of it."""

    state: State
    problems: tuple[Problem, ...]


def verify_reconciled(snapshot: Snapshot, executor: Executor, reporter: Reporter) -> list[Problem]:
    """Check all states and eliminations that a version keeps, each against the version at which it was made.

    Problems are found, never raised.
    """
    problems: list[Problem] = []
    try:
        trees = ReconciledStore.of(snapshot).trees()
        for name, tree in trees.items():
            then = snapshot if tree.version == snapshot.number else Snapshot.open(snapshot.place, f"v{tree.version}")
            vectors, planned = plan_trees(then, executor, reporter)
            same = [other for other in planned if set(other.tiles) == tree.tiles]
            if not same:
                problems.append(Problem("", "stale-state", f"{name}: its {len(tree.tiles)} tiles are no connected part of v{tree.version}"))
                continue
            problems += _of_tree(snapshot, then, name, same[0], vectors, executor, reporter)
    except DAMAGE as error:
        problems.append(Problem("", "unreadable", f"what was reconciled: {first_line(error)}"))
    return problems


def _of_tree(
    snapshot: Snapshot, then: Snapshot, name: str, tree: TileTree, vectors: dict[int, Vectors], executor: Executor, reporter: Reporter
) -> list[Problem]:
    kept, cells = (executor.share(Snapshot(s.root, s.place, replace(s.cover, area=b""))) for s in (snapshot, then))
    nodes, messages = tree.nodes, collected(tree, cells, vectors, executor)
    found: list[Any] = []

    def down(k: int, above: Any) -> None:
        node = nodes[k]
        below = [messages[c] for c in node.children]
        checked = executor.submit(check_node, (kept, cells, name, k, node, vectors.get(node.tile), below, above), "verify-node")
        found.append(executor.submit(problems_of, (checked,), "problems-of"))
        for child in node.children:
            messages[child] = None
            down(child, checked)

    down(len(nodes) - 1, None)
    executor.wait(found, reporter.stage("verifying what was reconciled", len(nodes)))
    return [problem for of_node in executor.results(found) for problem in of_node]


def problems_of(checked: Checked) -> tuple[Problem, ...]:
    """The part of a check that goes back to the coordinator."""
    return checked.problems


def check_node(
    kept: Snapshot, cells: Snapshot, tree: str, place: int, node: TreeNode, vectors: Vectors | None, messages: Sequence[Message],
    above: Checked | None,
) -> Checked:  # fmt: skip
    """Make what is kept of a node anew, and compare: the elimination, and of a tile its vectors and state."""
    done, _ = eliminate_node(node, messages) if vectors is None else eliminate_tile(cells, node, vectors)
    state = complete(done, None if above is None else above.state)
    tile = kept.cover.tile_name(node.tile) if vectors is not None else ""
    try:
        stored = read_elimination(kept.root, tree, place)
        differences = [f"elimination at node {place}: {said}" for said in _different(done, stored)]
        if vectors is not None:
            differences += [f"state: {said}" for said in _different_state(kept, node.tile, vectors, state)]
    except DAMAGE as error:
        return Checked(state, (Problem(tile, "unreadable", f"reconciled state, node {place}: {first_line(error)}"),))
    return Checked(state, tuple(Problem(tile, "stale-state", said) for said in differences))


def _different(made: Elimination, stored: Elimination) -> list[str]:
    if not (np.array_equal(made.interior, stored.interior) and np.array_equal(made.boundary, stored.boundary)):
        return ["other vectors than those of the cells"]
    return [*_far("root", made.root, stored.root), *_far("shift", made.shift, stored.shift)]


def _different_state(kept: Snapshot, tile: int, vectors: Vectors, made: State) -> list[str]:
    store = ReconciledStore.of(kept)
    stored = store.tile(tile)
    if stored is None:
        return ["there is none"]
    if not (np.array_equal(stored.vectors.names, vectors.names) and np.array_equal(stored.vectors.images, vectors.images)):
        return ["other vectors or images than those of the cells"]
    mean, covariance = unpacked_state(made)
    return [
        *_far("a priori factor", vectors.prior.toarray(), stored.vectors.prior.toarray()),
        *_far("mean", mean, stored.mean),
        *_far("covariance", covariance, store.covariance(tile, np.arange(len(mean)))),
    ]


def _far(what: str, made: Array, stored: Array) -> list[str]:
    """What is said of an array that is not what was made anew."""
    if made.shape != stored.shape:
        return [f"{what} has the shape {stored.shape}; expected {made.shape}"]
    difference = float(np.abs(made - stored).max(initial=0.0) / max(np.abs(made).max(initial=0.0), 1e-300)) if made.size else 0.0
    return [] if difference <= TOLERANCE else [f"{what} differs by {difference:.1e}; expected at most {TOLERANCE:g}"]
