"""What a contender hands back: how long each step took, how much memory, and its results to compare."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Times:
    """Seconds of a contender.

    Attributes
    ----------
    build : of ours ``run``, from the catalogue; of peers their equations from linearised rays, which they are given
    solve : of ours ``reconcile``; of peers factor, solution and coordinates
    all_3x3 : covariances of all points, each by itself
    remark : of ``all_3x3``: how it was found where not all were computed
    joint_near, joint_far : joint covariance of 100 points
    one_block : the network with one more block
    """

    build: float
    solve: float
    all_3x3: float
    remark: str
    joint_near: float
    joint_far: float
    one_block: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """Times, and results in geocentric metres.

    Attributes
    ----------
    peak_mb : largest resident memory, of all its processes
    coordinates : (n, 3) of all points by ascending id
    rows, covariance : (k,) points, and the covariance (k, 3, 3) of each by itself
    near, far : joint covariances
    """

    times: Times
    peak_mb: float
    coordinates: Array
    rows: Rows
    covariance: Array
    near: Array
    far: Array

    def save(self, path: Path) -> None:
        """Write it to a file."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "times"}
        np.savez(path, **arrays, **asdict(self.times))

    @classmethod
    def load(cls, path: Path) -> Outcome:
        """Read it from a file."""
        with np.load(path) as held:
            times: dict[str, Any] = {field.name: held[field.name].item() for field in fields(Times)}
            arrays = {f.name: held[f.name] for f in fields(cls) if f.name not in ("times", "peak_mb")}
            return cls(Times(**times), float(held["peak_mb"]), **arrays)


@dataclass(frozen=True)
class Difference:
    """How far results are apart: metres, and covariances over the product of the sigmas concerned."""

    metres: float
    single: float
    joint: float

    @classmethod
    def of(cls, found: Outcome, wanted: Outcome) -> Difference:
        """Of one contender's results from another's, of the points of which the first has a covariance."""
        near, far = (relative_difference(getattr(found, name), getattr(wanted, name)) for name in ("near", "far"))
        single = relative_difference(found.covariance, wanted.covariance[np.searchsorted(wanted.rows, found.rows)])
        return cls(float(np.abs(found.coordinates - wanted.coordinates).max()), single, max(near, far))


def relative_difference(found: Array, wanted: Array) -> float:
    """Largest difference of covariances (..., k, k) over the sigmas of row and column."""
    sigma = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    return float((np.abs(found - wanted) / (sigma[..., :, None] * sigma[..., None, :])).max())
