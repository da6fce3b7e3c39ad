"""Observations of ground points that come without images: positions and baselines with one covariance, as GNSS gives them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

_HASHED_ROWS = 96
"""Rows of a covariance whose digest is computed at once."""


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
