"""What changed between two versions of a network: points that came, went and moved, against what was said of their accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from submin import Network
from submin.geodesy import geodetic_to_geocentric, local_axes

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of two versions, as policy ``tile`` has each point from the tile whose core holds it.

    Attributes
    ----------
    before, after : names of the versions
    gone, new : ids of points that only one of them has
    ids : (n,) points of both
    moved : (n, 3) east, north, up in metres
    ce90, le90 : (n,) in the one version and the other, metres
    """

    before: str
    after: str
    gone: NDArray[np.str_]
    new: NDArray[np.str_]
    ids: NDArray[np.str_]
    moved: Array
    ce90: tuple[Array, Array]
    le90: tuple[Array, Array]

    @property
    def horizontal(self) -> Array:
        """Horizontal move (n,), metres."""
        return np.asarray(np.hypot(self.moved[:, 0], self.moved[:, 1]))

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """True (n,) for points that moved by more than the CE90 or LE90 that the first version stated."""
        return np.asarray((self.horizontal > self.ce90[0]) | (np.abs(self.moved[:, 2]) > self.le90[0]))

    def to_json(self) -> dict[str, Any]:
        """Plain values."""

        def spread(values: Array) -> dict[str, float | None]:
            return {name: float(np.quantile(values, q)) if len(values) else None for name, q in (("p50", 0.5), ("p90", 0.9), ("max", 1.0))}

        worst = np.argsort(-np.maximum(self.horizontal / self.ce90[0], np.abs(self.moved[:, 2]) / self.le90[0]))[:10]
        return {
            "before": self.before, "after": self.after, "points": len(self.ids), "points_new": len(self.new), "points_gone": len(self.gone),
            "horizontal": spread(self.horizontal), "vertical": spread(np.abs(self.moved[:, 2])),
            "beyond_stated": int(self.beyond.sum()),
            "ce90_median": [float(np.median(v)) if len(v) else None for v in self.ce90],
            "le90_median": [float(np.median(v)) if len(v) else None for v in self.le90],
            "worst": [
                {"point_id": str(self.ids[k]), "horizontal": float(self.horizontal[k]), "vertical": float(self.moved[k, 2]),
                 "ce90": float(self.ce90[0][k]), "le90": float(self.le90[0][k])}
                for k in worst
            ],
        }  # fmt: skip


def difference(before: Network, after: Network) -> Difference:
    """Compare two versions of a network."""
    a, b = before.accuracy(), after.accuracy()
    ids, at_a, at_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    ellipsoid = after.cover.ellipsoid
    shift = geodetic_to_geocentric(b.geodetic[at_b], ellipsoid) - geodetic_to_geocentric(a.geodetic[at_a], ellipsoid)
    moved = np.einsum("nij,nj->ni", local_axes(a.geodetic[at_a]), shift)
    return Difference(
        before.version, after.version, np.setdiff1d(a.ids, ids), np.setdiff1d(b.ids, ids), ids, moved,
        (a.ce90[at_a], b.ce90[at_b]), (a.le90[at_a], b.le90[at_b]),
    )  # fmt: skip
