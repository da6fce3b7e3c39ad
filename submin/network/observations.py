"""Observations of ground points that come without images: positions and baselines as GNSS gives them, and height differences."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.errors import InputError

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

_HASHED_ROWS = 96
"""Rows of a covariance whose digest is computed at once."""


class PointObservations(Protocol):
    """Linear observations of ground points: ``y = H x + v``, x geocentric, v of covariance R and uncorrelated with every other set."""

    @property
    def block_id(self) -> str:
        """Name, for messages."""

    @property
    def block_ids(self) -> tuple[str, ...]:
        """Names under which it counts once: its own, or those of its parts."""

    @property
    def point_ids(self) -> Ids:
        """The t points concerned, each once, ascending."""

    @property
    def covariance(self) -> Array:
        """R (m, m), positive definite."""

    def design(self) -> sp.csr_array:
        """H (m, 3t), the points in the order of their ids."""

    def misclosure(self, origins: Array) -> Array:
        """``y - H x0`` (m,) for positions x0 (t, 3), formed from differences of coordinates so that their digits are kept."""

    def approximate(self, known: Array) -> Array:
        """Positions (t, 3) of the points, some of them known (rows of NaN are not); those that cannot be said stay NaN."""


@dataclass(frozen=True, eq=False)
class Cluster:
    """Positions and baselines whose errors are correlated with one another and with nothing else: one block of information.

    Attributes
    ----------
    cluster_id : name of the cluster, its block in the ledger
    from_ids : (k,) start of each baseline, or the point whose position is given
    to_ids : (k,) end of each baseline; empty text for a position
    values : (k, 3) geocentric metres: the position, or the vector from start to end
    covariance : (3k, 3k) square metres, positive definite, observation-major

    Raises
    ------
    InputError
        When shapes do not match, a number is not finite, or a baseline ends where it starts.
    """

    cluster_id: str
    from_ids: Ids
    to_ids: Ids
    values: Array
    covariance: Array

    def __post_init__(self) -> None:
        k = len(self.from_ids)
        shapes = {"from_ids": (k,), "to_ids": (k,), "values": (k, 3), "covariance": (3 * k, 3 * k)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"cluster {self.cluster_id}: {name} has shape {getattr(self, name).shape}; expected {shape}")
        if not k:
            raise InputError(f"cluster {self.cluster_id}: holds no observation; expected positions or baselines")
        for name in ("values", "covariance"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"cluster {self.cluster_id}: {name} holds something that is not finite; expected metres")
        if (self.from_ids == self.to_ids).any():
            point = self.from_ids[self.from_ids == self.to_ids][0]
            raise InputError(f"cluster {self.cluster_id}: a baseline goes from {point} to itself; expected two points")

    def __len__(self) -> int:
        return len(self.from_ids)

    @property
    def positions(self) -> NDArray[np.bool_]:
        """True (k,) for positions, False for baselines."""
        return np.asarray(self.to_ids == "")

    @property
    def point_ids(self) -> Ids:
        """The points concerned, each once, ascending."""
        every = np.unique(np.concatenate([self.from_ids, self.to_ids]))
        return np.asarray(every[every != ""], dtype=np.str_)

    def content_hash(self) -> str:
        """Hexadecimal BLAKE2b of the observations: points, values, and the lower triangle of the covariance.

        The order of the observations leaves no trace, neither does the name of the cluster: a network knows by it what it holds already.
        """
        values = np.asarray(self.values, dtype="<f8") + 0.0  # + 0.0: one sign of zero
        order = np.lexsort((*values.T[::-1], self.to_ids, self.from_ids))
        head = [[str(a), str(b)] for a, b in zip(self.from_ids[order], self.to_ids[order], strict=True)]
        digest = hashlib.blake2b(json.dumps(head).encode(), digest_size=32)
        digest.update(np.ascontiguousarray(values[order]).tobytes())
        rows = (3 * order[:, None] + np.arange(3)).ravel()
        for first in range(0, len(rows), _HASHED_ROWS):  # of a large covariance never a second copy
            chosen = rows[first : first + _HASHED_ROWS]
            # The symmetric value is taken from the triangle that is stored.
            i, j = np.maximum(chosen[:, None], rows), np.minimum(chosen[:, None], rows)
            part = np.tril(self.covariance[i, j], first) + 0.0
            digest.update(np.ascontiguousarray(part, dtype="<f8").tobytes())
        return digest.hexdigest()

    @property
    def block_id(self) -> str:
        """The cluster's id: a cluster is a block."""
        return self.cluster_id

    @property
    def block_ids(self) -> tuple[str, ...]:
        """Its name."""
        return (self.cluster_id,)

    def design(self) -> sp.csr_array:
        """H (3k, 3t): the end of each vector, less its start."""
        ids, k = self.point_ids, len(self)
        ends = np.where(self.positions, self.from_ids, self.to_ids)
        baseline = np.flatnonzero(~self.positions)
        row = np.concatenate([np.arange(k), baseline])
        column = np.searchsorted(ids, np.concatenate([ends, self.from_ids[baseline]]))
        sign = np.concatenate([np.ones(k), -np.ones(len(baseline))])
        axes = np.arange(3)
        return sp.coo_array(
            (np.repeat(sign, 3), ((3 * row[:, None] + axes).ravel(), (3 * column[:, None] + axes).ravel())), shape=(3 * k, 3 * len(ids))
        ).tocsr()

    def misclosure(self, origins: Array) -> Array:
        """Values less those of the origins (3k,), metres."""
        start, end = self._ends(origins)
        # the difference of two near coordinates is exact: a small vector is never the difference of sums of large numbers
        expected = np.where(self.positions[:, None], start, end - start)
        return np.asarray((self.values - expected).ravel())

    def approximate(self, known: Array) -> Array:
        """Positions (t, 3): those known, those observed, and those at the other end of a baseline, as far as baselines lead."""
        at = known.copy()
        of = np.searchsorted(self.point_ids, self.from_ids)
        to = np.searchsorted(self.point_ids, np.where(self.positions, self.from_ids, self.to_ids))
        given = self.positions & np.isnan(at[of, 0])
        at[of[given]] = self.values[given]
        while True:
            missing = np.isnan(at[:, 0])
            onward, back = ~self.positions & ~missing[of] & missing[to], ~self.positions & missing[of] & ~missing[to]
            if not (onward | back).any():
                return at
            at[to[onward]] = at[of[onward]] + self.values[onward]
            at[of[back]] = at[to[back]] - self.values[back]

    def _ends(self, origins: Array) -> tuple[Array, Array]:
        ids = self.point_ids
        end_ids = np.where(self.positions, self.from_ids, self.to_ids)
        return origins[np.searchsorted(ids, self.from_ids)], origins[np.searchsorted(ids, end_ids)]


@dataclass(frozen=True, eq=False)
class HeightDifferences:
    """Differences of height along given directions: ``y = u_to (x_to - r_to) - u_from (x_from - r_from) + v``.

    Attributes
    ----------
    block_id : name
    from_ids, to_ids : (k,) points; from which, to which
    values : (k,) metres, what was observed less what it is for points at the reference positions
    up : (k, 2, 3) unit vectors: up at the start and at the end, geocentric axes
    reference : (k, 2, 3) geocentric metres: the positions r of start and end about which heights were linearised
    covariance : (k, k) square metres, positive definite
    """

    block_id: str
    from_ids: Ids
    to_ids: Ids
    values: Array
    up: Array
    reference: Array
    covariance: Array

    def __post_init__(self) -> None:
        k = len(self.from_ids)
        shapes = {"from_ids": (k,), "to_ids": (k,), "values": (k,), "up": (k, 2, 3), "reference": (k, 2, 3), "covariance": (k, k)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"height differences {self.block_id}: {name} has shape {getattr(self, name).shape}; expected {shape}")
        if (self.from_ids == self.to_ids).any():
            point = self.from_ids[self.from_ids == self.to_ids][0]
            raise InputError(f"height differences {self.block_id}: one goes from {point} to itself; expected two points")

    def __len__(self) -> int:
        return len(self.from_ids)

    @property
    def block_ids(self) -> tuple[str, ...]:
        """Its name."""
        return (self.block_id,)

    @property
    def point_ids(self) -> Ids:
        """The points concerned, each once, ascending."""
        return np.asarray(np.unique(np.concatenate([self.from_ids, self.to_ids])))

    def design(self) -> sp.csr_array:
        """H (k, 3t): up at the end, less up at the start."""
        k, axes = len(self), np.arange(3)
        column = np.searchsorted(self.point_ids, np.stack([self.from_ids, self.to_ids], axis=1))
        columns = 3 * column[:, :, None] + axes
        rows = np.broadcast_to(np.arange(k)[:, None, None], columns.shape)
        signed = self.up * np.array([-1.0, 1.0])[None, :, None]
        return sp.coo_array((signed.ravel(), (rows.ravel(), columns.ravel())), shape=(k, 3 * len(self.point_ids))).tocsr()

    def misclosure(self, origins: Array) -> Array:
        """Values less those of the origins (k,), metres."""
        column = np.searchsorted(self.point_ids, np.stack([self.from_ids, self.to_ids], axis=1))
        along = np.einsum("kes,kes->ke", self.up, origins[column] - self.reference)
        return np.asarray(self.values - (along[:, 1] - along[:, 0]))

    def approximate(self, known: Array) -> Array:
        """The reference positions, where nothing better is known."""
        at = known.copy()
        for end, ids in enumerate((self.from_ids, self.to_ids)):
            place = np.searchsorted(self.point_ids, ids)
            missing = np.isnan(at[place, 0])
            at[place[missing]] = self.reference[missing, end]
        return at


@dataclass(frozen=True, eq=False)
class Stack:
    """Several sets of observations as one: what must be fused together, because only together do they determine a point."""

    parts: tuple[PointObservations, ...]

    @property
    def block_id(self) -> str:
        """Names of all parts."""
        return " + ".join(part.block_id for part in self.parts)

    @property
    def block_ids(self) -> tuple[str, ...]:
        """The name of each part."""
        return tuple(name for part in self.parts for name in part.block_ids)

    @property
    def point_ids(self) -> Ids:
        """The points of all parts, each once, ascending."""
        return np.asarray(np.unique(np.concatenate([part.point_ids for part in self.parts])))

    @property
    def covariance(self) -> Array:
        """Block-diagonal: parts are uncorrelated."""
        return np.asarray(la.block_diag(*(part.covariance for part in self.parts)))

    def design(self) -> sp.csr_array:
        """Rows of all parts, one part after another."""
        ids, rows = self.point_ids, []
        for part, at in zip(self.parts, self._places(), strict=True):
            h = part.design().tocoo()
            rows.append(sp.coo_array((h.data, (h.row, 3 * at[h.col // 3] + h.col % 3)), shape=(h.shape[0], 3 * len(ids))))
        return sp.csr_array(sp.vstack(rows))

    def misclosure(self, origins: Array) -> Array:
        """Of all parts, one after another."""
        return np.concatenate([part.misclosure(origins[at]) for part, at in zip(self.parts, self._places(), strict=True)])

    def approximate(self, known: Array) -> Array:
        """As the parts say, until none says more."""
        at = known
        while True:
            before = np.isnan(at[:, 0]).sum()
            for part, place in zip(self.parts, self._places(), strict=True):
                at = at.copy()
                at[place] = part.approximate(at[place])
            if np.isnan(at[:, 0]).sum() in (0, before):
                return at

    def _places(self) -> Sequence[NDArray[np.int64]]:
        ids = self.point_ids
        return [np.searchsorted(ids, part.point_ids) for part in self.parts]
