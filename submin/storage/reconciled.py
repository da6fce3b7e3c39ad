"""What a network keeps of its reconciliations: states of tiles, eliminations of trees, and when tiles changed since (decision 014).

``reconciled/tiles/NAME`` holds a tile's vectors, their mean and covariance; ``reconciled/trees/NAME`` a connected part of the network with
what was eliminated at each of its nodes. A version that changes cells leaves them as they are and notes what changed.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import zarr
from numpy.typing import NDArray

from submin.network.outside_messages import Elimination, State, unpacked_state
from submin.network.whitened_vectors import PASS, Vectors, WholeImages, vectors_of
from submin.query.kept import Kept
from submin.query.outside import other_priors
from submin.query.reconciled_state import TileState, TreeState
from submin.query.source import NetworkSource
from submin.storage.arrays import (
    PLAIN,
    WRITTEN_WHOLE,
    attributes_of,
    group_of,
    member_names,
    read_matrix,
    read_record,
    read_table,
    replace_table,
    write_record,
)
from submin.storage.schema import read_symmetric, write_symmetric
from submin.storage.snapshot import Snapshot
from submin.tiling.tile_tree import TileTree

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Names = NDArray[np.int64]

TILE_STATES, TREES = "reconciled/tiles", "reconciled/trees"
EVERYWHERE = -1
"""Stands for a tile where something was lost of which no tile can tell."""
KINDS = ("changed", "lost", "stale")
ROOT_CHUNK = 512
KEPT_BYTES = 512 * 1024**2
CACHED_TILES = 256


class ImageDirectory:
    """Of every image of a version: its pass, its block, and what its a priori errors are correlated with."""

    def __init__(self, snapshot: Snapshot) -> None:
        table = snapshot.image_columns(["block_id", "pass_id", "withdrawn"])
        self._priors = snapshot.image_priors()
        self.present = table["withdrawn"] == 0
        self._block, self.block_row = _first_of(table["block_id"])
        _, self.pass_row = _first_of(table["pass_id"])

    def whole(self, held: Index) -> WholeImages:
        """Some images (rows, ascending) with those of their blocks, or sets, that their errors are correlated with."""
        blocks = np.unique([self._block[row] for row in held.tolist() if self._priors[row].correlated])
        mates = np.flatnonzero(np.isin(self._block, blocks) & self.present) if len(blocks) else held[:0]
        rows = np.union1d(held, mates).astype(np.int32)
        return WholeImages(rows, tuple(self._priors[row] for row in rows.tolist()), self.pass_row[rows], self.block_row[rows])


def _first_of(names: NDArray[np.str_]) -> tuple[Names, Names]:
    """A number for each name, and the first row of each row's name."""
    _, first, number = np.unique(names, return_index=True, return_inverse=True)
    return number.astype(np.int64), first[number].astype(np.int64)


def shared_names(snapshot: Snapshot) -> tuple[str, ...]:
    """Names of the parameters that passes share, those that earlier versions knew first."""
    known: list[str] = list(attributes_of(group_of(snapshot.root, "reconciled"))["shared_names"])
    kinds = {(prior.a_priori, prior.parameters) for prior in snapshot.image_priors() if prior.a_priori is not None}
    names = {p.name for model, parameters in kinds for p in parameters if (u := model.of(p)).sigma > 0.0 and u.common_to_pass > 0.0}
    return (*known, *sorted(names - set(known)))


def note_shared_names(root: zarr.Group, names: Sequence[str]) -> None:
    """Note the names of shared parameters, by whose order vectors are named."""
    group_of(root, "reconciled").attrs["shared_names"] = list(names)


def write_tree(
    root: zarr.Group, name: str, tree: TileTree, members: Names, holder: Mapping[int, int], attributes: Mapping[str, Any]
) -> None:  # fmt: skip
    """Write a connected part of the network, which sees the images ``members``; ``holder``: a tile for each vector of a pass or set."""
    shared = np.array(sorted(holder), dtype=np.int64)
    write_record(
        group_of(root, TREES), name,
        {"parents": np.array(tree.parents(), dtype=np.int64), "tiles": np.array(tree.tiles, dtype=np.int64),
         "members": members, "shared": shared,
         "holder": np.array([holder[key] for key in shared.tolist()], dtype=np.int64)},
        attributes,
    )  # fmt: skip


def write_elimination(root: zarr.Group, tree: str, node: int, done: Elimination) -> None:
    """Write what was eliminated at a node of a tree."""
    group = write_record(
        group_of(root, TREES), f"{tree}n{node:05d}", {"interior": done.interior, "boundary": done.boundary, "shift": done.shift}
    )
    rows, columns = done.root.shape
    if columns:
        chunks = (min(rows, ROOT_CHUNK), min(columns, ROOT_CHUNK))
        group.create_array("root", data=np.ascontiguousarray(done.root), chunks=chunks, compressors=PLAIN, config=WRITTEN_WHOLE)


def write_tile_state(root: zarr.Group, name: str, tree: str, node: int, vectors: Vectors, state: State) -> None:
    """Write the state of a tile, replacing its earlier one; ``state`` is of the tile's vectors."""
    mean, covariance = unpacked_state(state)
    group = write_record(
        group_of(root, TILE_STATES), name,
        {"images": vectors.images, "names": vectors.names, "mean": mean, "prior_first": vectors.prior.indptr,
         "prior_column": vectors.prior.indices, "prior_value": vectors.prior.data},
        {"tree": tree, "node": node},
    )  # fmt: skip
    write_symmetric(group, "covariance", covariance)


def drop_trees(root: zarr.Group, kept: Iterable[str], tiles: Iterable[str]) -> None:
    """Delete the trees that no tile refers to any more, and the states of all tiles but some (names)."""
    keep = set(kept)
    for name in member_names(group_of(root, TREES)):
        if name.split("n")[0] not in keep:
            del group_of(root, TREES)[name]
    stay = set(tiles)
    for name in member_names(group_of(root, TILE_STATES)):
        if name not in stay:
            del group_of(root, TILE_STATES)[name]


def read_elimination(root: zarr.Group, tree: str, node: int) -> Elimination:
    """What was eliminated at a node of a tree."""
    group = group_of(root, f"{TREES}/{tree}n{node:05d}")
    parts = read_record(group)
    k, b = len(parts["interior"]), len(parts["boundary"])
    values = read_matrix(group, "root") if k else np.empty((b, 0))
    return Elimination(parts["interior"], parts["boundary"], np.asfortranarray(values), parts["shift"])


def read_tile_state(root: zarr.Group, name: str) -> TileState:
    """The state of a tile, but for its covariance."""
    group = group_of(root, f"{TILE_STATES}/{name}")
    parts, attributes = read_record(group), attributes_of(group)
    rows = len(parts["prior_first"]) - 1
    prior = sp.csr_array(
        (parts["prior_value"], parts["prior_column"].astype(np.int32), parts["prior_first"].astype(np.int32)),
        shape=(rows, len(parts["names"])),
    )
    vectors = Vectors(parts["images"].astype(np.int32), parts["names"], prior)
    return TileState(str(attributes["tree"]), int(attributes["node"]), vectors, parts["mean"])


def read_tree(root: zarr.Group, name: str) -> TreeState:
    """A connected part of the network."""
    group = group_of(root, f"{TREES}/{name}")
    parts, a = read_record(group), attributes_of(group)
    return TreeState(
        int(a["version"]), int(a["images"]), parts["members"], frozenset(a["released"]), frozenset(parts["tiles"].tolist()),
        tuple(parts["parents"].tolist()), parts["shared"], parts["holder"], float(a["chi_square"]), int(a["redundancy"]),
    )  # fmt: skip


@dataclass(frozen=True)
class Changes:
    """What a new version does to what was reconciled.

    Attributes
    ----------
    changed : tiles whose own cells change; lost : that lose something that they had counted, or `EVERYWHERE`
    stale : whose own state counts something already that has moved into a cell that they hold
    """

    changed: frozenset[int]
    lost: frozenset[int]
    stale: frozenset[int]


def read_changes(snapshot: Snapshot) -> dict[str, dict[int, int]]:
    """For each kind of `Changes` the version in which it last happened, by tile."""
    table = read_table(group_of(snapshot.root, "changes"))
    return {kind: dict(zip(table["tile"].tolist(), table[kind].tolist(), strict=True)) for kind in KINDS}


def note_changes(root: zarr.Group, base: Snapshot, version: int, changes: Changes) -> None:
    """Note what happens with a version."""
    before = read_changes(base)
    when = {kind: before[kind] | dict.fromkeys(getattr(changes, kind), version) for kind in KINDS}
    tiles = np.array(sorted(set().union(*when.values())), dtype=np.int64)
    columns = {kind: np.array([of_kind.get(tile, 0) for tile in tiles.tolist()], dtype=np.int64) for kind, of_kind in when.items()}
    replace_table(group_of(root, "changes"), {"tile": tiles, **columns})


class ReconciledStore:
    """What a version keeps of its reconciliations, as queries ask for it (`submin.query.reconciled_state.Reconciled`)."""

    def __init__(self, snapshot: Snapshot, earlier: Callable[[int], NetworkSource]) -> None:
        """``earlier`` opens the network as it was at a version."""
        self._snapshot, self._open = snapshot, earlier
        self._tiles: OrderedDict[int, TileState | None] = OrderedDict()
        self._trees: dict[str, TreeState] = {}
        self._eliminations: Kept[Elimination] = Kept(KEPT_BYTES)
        self._covariances: Kept[Array] = Kept(KEPT_BYTES)
        self._asked: set[int] = set()
        self._earlier: tuple[int, NetworkSource] | None = None

    @classmethod
    def of(cls, snapshot: Snapshot) -> ReconciledStore:
        """Of a version, without a look at earlier ones."""

        def never(version: int) -> NetworkSource:
            raise AssertionError(f"v{version} is not looked at")

        return cls(snapshot, never)

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(member_names(group_of(self._snapshot.root, TILE_STATES)))

    def __bool__(self) -> bool:
        return bool(self._names)

    @cached_property
    def released(self) -> frozenset[int]:
        """Rows of the images whose prior is released now."""
        return frozenset(row for _, row in self._snapshot.flags())

    @cached_property
    def _changes(self) -> dict[str, dict[int, int]]:
        return read_changes(self._snapshot)

    @property
    def changed(self) -> Mapping[int, int]:
        """Version in which the own cells of each tile changed last."""
        return self._changes["changed"]

    def gone(self, tiles: Collection[int]) -> int:
        """The last version in which something went that the states of some tiles counted."""
        lost = [version for tile, version in self._changes["lost"].items() if tile not in tiles]
        return max([*lost, *(self._changes["stale"].get(tile, 0) for tile in tiles)], default=0)

    def tile(self, tile: int) -> TileState | None:
        """The state of a tile, None where it has none."""
        if tile not in self._tiles:
            name = self._snapshot.cover.tile_name(tile)
            self._tiles[tile] = read_tile_state(self._snapshot.root, name) if name in self._names else None
            if len(self._tiles) > CACHED_TILES:
                self._tiles.popitem(last=False)
        return self._tiles[tile]

    def tree(self, name: str) -> TreeState:
        """A part of the network."""
        if name not in self._trees:
            self._trees[name] = read_tree(self._snapshot.root, name)
        return self._trees[name]

    def covariance(self, tile: int, columns: NDArray[np.int64]) -> Array:
        """Covariance (k, k) of some of the tile's vectors (columns, ascending), both triangles.

        Of a tile that is asked for again the whole is kept in memory; it must not be changed.
        """
        whole = self._covariances.get(tile)
        if whole is None:
            group = group_of(self._snapshot.root, f"{TILE_STATES}/{self._snapshot.cover.tile_name(tile)}")
            if tile not in self._asked:
                self._asked.add(tile)
                return read_symmetric(group, "covariance", columns)
            whole = self._covariances.put(tile, read_symmetric(group, "covariance"))
        return whole if len(columns) == len(whole) else whole[np.ix_(columns, columns)]

    def elimination(self, tree: str, node: int) -> Elimination:
        """What was eliminated at a node; the latest used ones are kept in memory."""
        known = self._eliminations.get((tree, node))
        return self._eliminations.put((tree, node), read_elimination(self._snapshot.root, tree, node)) if known is None else known

    def earlier(self, version: int) -> NetworkSource:
        """The network as it was at a version."""
        if self._earlier is None or self._earlier[0] != version:
            self._earlier = version, self._open(version)
        return self._earlier[1]

    def vectors(self, images: Index) -> Vectors:
        """The whitened vectors of images of the present version."""
        whole = ImageDirectory(self._snapshot).whole(images)
        return vectors_of(whole, images, self._snapshot.metadata.parameters, shared_names(self._snapshot))

    def current(self, tiles: Iterable[int]) -> bool:
        """True when the states of all tiles of the network, ``tiles``, stand as they are."""
        trees = self.trees().values()
        reconciled: frozenset[int] = frozenset().union(*(tree.tiles for tree in trees))
        return reconciled >= set(tiles) and all(self.stands(tree) for tree in trees)

    def stands(self, tree: TreeState) -> bool:
        """True when nothing has changed in a part of the network since it was reconciled."""
        return not any(self.changed.get(tile, 0) > tree.version for tile in tree.tiles) and not other_priors(tree, self.released)

    def trees(self) -> dict[str, TreeState]:
        """All parts of the network that have been reconciled and that tiles refer to."""
        found = {}
        for name in sorted(self._names):
            tree = str(attributes_of(group_of(self._snapshot.root, f"{TILE_STATES}/{name}"))["tree"])
            if tree not in found:
                found[tree] = self.tree(tree)
        return found


def holders_of_shared(tiles: Sequence[int], vectors: Sequence[Vectors]) -> dict[int, int]:
    """A tile for each vector of a pass or set."""
    holder: dict[int, int] = {}
    for tile, of_tile in zip(tiles, vectors, strict=True):
        shared = of_tile.names[of_tile.names >= PASS]
        holder.update(dict.fromkeys(shared.tolist(), tile))
    return holder
