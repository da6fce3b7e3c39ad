"""What is kept of reconciliations: states of tiles, and the parts of the network that they are of."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from submin.network.outside_messages import Elimination
from submin.network.whitened_vectors import Vectors
from submin.query.source import NetworkSource

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Names = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TileState:
    """The state of a tile, but for its covariance: its place in its tree, its vectors and their mean (q,)."""

    tree: str
    node: int
    vectors: Vectors
    mean: Array


@dataclass(frozen=True, eq=False)
class TreeState:
    """A reconciled part of the network.

    Attributes
    ----------
    version : of the states; images : number of images that the network had then
    members : rows of the images that the part sees, ascending; released : those of them whose prior was released
    tiles : of the part; parents : place of each node's parent, -1 for the root
    shared : names of vectors of passes and sets, ascending; holder : a tile that holds each
    chi_square, redundancy : of the whole part
    """

    version: int
    images: int
    members: NDArray[np.int64]
    released: frozenset[int]
    tiles: frozenset[int]
    parents: tuple[int, ...]
    shared: Names
    holder: NDArray[np.int64]
    chi_square: float
    redundancy: int


class Reconciled(Protocol):
    """What a version of a network keeps of its last reconciliations."""

    @property
    def released(self) -> frozenset[int]:
        """Rows of the images whose prior is released now."""
        ...

    @property
    def changed(self) -> Mapping[int, int]:
        """Version in which the own cells of each tile changed last."""
        ...

    def gone(self, tiles: Collection[int]) -> int:
        """The last version in which something went that the states of some tiles counted."""
        ...

    def tile(self, tile: int) -> TileState | None:
        """The state of a tile, None where it has none."""
        ...

    def tree(self, name: str) -> TreeState:
        """A part of the network."""
        ...

    def covariance(self, tile: int, columns: NDArray[np.int64]) -> Array:
        """Covariance (k, k) of some of the tile's vectors (columns, ascending), both triangles."""
        ...

    def elimination(self, tree: str, node: int) -> Elimination:
        """What was eliminated at a node."""
        ...

    def earlier(self, version: int) -> NetworkSource:
        """The network as it was at a version, as many parameters an image as now."""
        ...

    def vectors(self, images: Index) -> Vectors:
        """The whitened vectors of images of the present version."""
        ...
