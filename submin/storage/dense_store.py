"""A dense network on disk: the sets of observations behind it, its points, and blocks of one triangle of their covariance."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import zarr
from numpy.typing import NDArray

from submin.adjustment.symmetric import fill_symmetric
from submin.network.dense_sub_min import DenseSubMin
from submin.network.observations import Cluster
from submin.network.triangle import PANEL, Triangle
from submin.storage.arrays import (
    PLAIN,
    WRITTEN_WHOLE,
    append_table,
    attributes_of,
    create_table,
    group_of,
    read_matrix,
    read_record,
    read_table,
    table_length,
    write_record,
)
from submin.storage.schema import COVARIANCE_CHUNK
from submin.storage.snapshot import Snapshot

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
Rows = NDArray[np.int64]

GROUP = "dense"
CLUSTER_COLUMNS = {
    "block_id": "text", "kind": "text", "passes": "text", "version": "int64", "observations": "int64", "first": "int64", "entries": "int64",
    "inner_square": "float64", "inner_redundancy": "int64",
}  # fmt: skip
OBSERVATION_COLUMNS = {"from": "text", "to": "text", "x": "float64", "y": "float64", "z": "float64"}
COVARIANCE_COLUMNS = {"value": "float64"}
SEPARATOR = "\n"


@dataclass(frozen=True, eq=False)
class Member:
    """A set of observations in a dense network, and where it comes from.

    Attributes
    ----------
    cluster : the observations; its id is that of the block in the ledger
    kind : ``observations``, ``control`` or ``images``
    passes : of images, those whose errors in common the block has taken in
    inner_square, inner_redundancy : chi-square and redundancy that stayed behind in the adjustment which gave the positions (images)
    stated : what came, where the observations were computed from it: it identifies them instead; not kept
    """

    cluster: Cluster
    kind: str = "observations"
    passes: tuple[str, ...] = ()
    inner_square: float = 0.0
    inner_redundancy: int = 0
    stated: str = ""

    @property
    def block_id(self) -> str:
        """Name in the ledger."""
        return self.cluster.cluster_id

    @property
    def point_ids(self) -> tuple[str, ...]:
        """The points concerned, ascending."""
        return tuple(self.cluster.point_ids.tolist())

    def content_hash(self) -> str:
        """Hexadecimal BLAKE2b of the observations and their covariance."""
        return hashlib.blake2b(self.stated.encode(), digest_size=32).hexdigest() if self.stated else self.cluster.content_hash()


def create_dense(root: zarr.Group) -> None:
    """What an empty dense network holds besides ledger and tables of images."""
    group = root.create_group(GROUP)
    for name, columns in (("clusters", CLUSTER_COLUMNS), ("observations", OBSERVATION_COLUMNS), ("covariances", COVARIANCE_COLUMNS)):
        create_table(group, name, columns)
    write_state(root, DenseSubMin(), {})


def append_members(root: zarr.Group, members: Sequence[Member], version: int) -> None:
    """Keep sets of observations as they came: what is fused anew, after a withdrawal, are these."""
    if not members:
        return
    group = group_of(root, GROUP)
    first, entries = table_length(group_of(group, "observations")), table_length(group_of(group, "covariances"))
    sizes = np.array([len(m.cluster) for m in members])
    packed = [m.cluster.covariance[np.tril_indices(3 * len(m.cluster))] for m in members]
    append_table(group_of(group, "clusters"), {
        "block_id": np.array([m.block_id for m in members]), "kind": np.array([m.kind for m in members]),
        "passes": np.array([SEPARATOR.join(m.passes) for m in members]), "version": np.full(len(members), version),
        "observations": sizes, "first": first + np.cumsum(sizes) - sizes,
        "entries": entries + np.cumsum([len(p) for p in packed]) - [len(p) for p in packed],
        "inner_square": np.array([m.inner_square for m in members]), "inner_redundancy": np.array([m.inner_redundancy for m in members]),
    })  # fmt: skip
    values = np.concatenate([m.cluster.values for m in members])
    append_table(group_of(group, "observations"), {
        "from": np.concatenate([m.cluster.from_ids for m in members]), "to": np.concatenate([m.cluster.to_ids for m in members]),
        **{name: values[:, k] for k, name in enumerate("xyz")},
    })  # fmt: skip
    append_table(group_of(group, "covariances"), {"value": np.concatenate(packed)})


def read_members(snapshot: Snapshot, wanted: Collection[str]) -> list[Member]:
    """The sets of observations of some blocks, as they came last, in the order in which they came."""
    group = group_of(snapshot.root, GROUP)
    table = read_table(group_of(group, "clusters"))
    last = {name: k for k, name in enumerate(table["block_id"].tolist())}  # of those that came again the last one counts
    rows = sorted(k for name, k in last.items() if name in set(wanted))
    observations = read_table(group_of(group, "observations"))
    packed = read_table(group_of(group, "covariances"))["value"]
    values = np.stack([observations[name] for name in "xyz"], axis=1)
    members = []
    for k in rows:
        first, count, entries = int(table["first"][k]), int(table["observations"][k]), int(table["entries"][k])
        size, span = 3 * count, slice(first, first + count)
        lower = np.zeros((size, size))
        lower[np.tril_indices(size)] = packed[entries : entries + size * (size + 1) // 2]
        cluster = Cluster(
            str(table["block_id"][k]), observations["from"][span], observations["to"][span], values[span], fill_symmetric(lower)
        )  # fmt: skip
        passes = tuple(part for part in str(table["passes"][k]).split(SEPARATOR) if part)
        members.append(Member(cluster, str(table["kind"][k]), passes, float(table["inner_square"][k]), int(table["inner_redundancy"][k])))
    return members


def write_state(root: zarr.Group, state: DenseSubMin, inner: Mapping[str, tuple[float, int]]) -> None:
    """Write points and covariance, replacing what is there: of the covariance only blocks on and below the diagonal, as they are.

    ``inner`` has chi-square and redundancy that stayed behind in the blocks fused, by block.
    """
    group, names = group_of(root, GROUP), state.blocks
    square = state.chi_square + sum(inner[name][0] for name in names if name in inner)
    redundancy = state.redundancy + sum(inner[name][1] for name in names if name in inner)
    record = write_record(
        group, "points",
        {"ids": state.ids if len(state) else np.empty(0, dtype="U1"), "origins": state.origins, "adjustments": state.adjustments,
         "own": state.triangle.diagonal_blocks(), "blocks": np.array(names, dtype=np.str_) if names else np.empty(0, dtype="U1")},
        {"chi_square": state.chi_square, "redundancy": state.redundancy, "whole_square": square, "whole_redundancy": redundancy},
    )  # fmt: skip
    size = state.triangle.size
    chunk = min(COVARIANCE_CHUNK, max(size, 1))
    array = record.create_array(
        "covariance", shape=(size, size), chunks=(chunk, chunk), dtype="float64", compressors=PLAIN, config=WRITTEN_WHOLE
    )
    for k, panel in enumerate(state.triangle.panels):
        start, stop = k * PANEL, min((k + 1) * PANEL, size)
        array[start:stop, :stop] = panel[:stop, : stop - start].T  # a block column of the one triangle is a block row of the other


@dataclass(frozen=True, eq=False)
class DensePoints:
    """Points of a dense network, without the covariance between them.

    Attributes
    ----------
    ids : (n,) in the order of the state; geocentric : (n, 3) metres; covariance : (n, 3, 3) of each, square metres
    blocks : fused, in their order
    chi_square, redundancy : of the whole, with what stayed behind in adjustments of images
    """

    ids: Ids
    geocentric: Array
    covariance: Array
    blocks: tuple[str, ...]
    chi_square: float
    redundancy: int


def read_points(snapshot: Snapshot) -> DensePoints:
    """Points of a version."""
    group = group_of(group_of(snapshot.root, GROUP), "points")
    parts, attributes = read_record(group), attributes_of(group)
    at = parts["origins"] + parts["adjustments"].reshape(-1, 3)
    square, redundancy = float(attributes["whole_square"]), int(attributes["whole_redundancy"])
    return DensePoints(parts["ids"], at, parts["own"], tuple(parts["blocks"].tolist()), square, redundancy)


def read_covariance(snapshot: Snapshot, rows: Rows) -> Array:
    """Joint covariance (3k, 3k) of the points at these places (ascending), square metres; only the blocks concerned are read."""
    group = group_of(group_of(snapshot.root, GROUP), "points")
    at = (3 * rows[:, None] + np.arange(3)).ravel()
    return fill_symmetric(np.ascontiguousarray(read_matrix(group, "covariance", at, at)) if len(at) else np.empty((0, 0)))


def read_state(snapshot: Snapshot) -> DenseSubMin:
    """The whole state, to be fused into."""
    group = group_of(group_of(snapshot.root, GROUP), "points")
    parts, attributes = read_record(group), attributes_of(group)
    size, triangle = 3 * len(parts["ids"]), Triangle()
    for start in range(0, size, PANEL):
        rows = read_matrix(group, "covariance", slice(start, start + PANEL), slice(0, start + PANEL))
        triangle.append(rows[:, :start], rows[:, start:].T)
    return DenseSubMin.restored(
        parts["ids"], parts["origins"], parts["adjustments"], triangle, float(attributes["chi_square"]), int(attributes["redundancy"]),
        tuple(parts["blocks"].tolist()),
    )  # fmt: skip
