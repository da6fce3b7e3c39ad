"""Two sets of points whose joint errors nobody knows, as one: Covariance Intersection on the union of their points.

Points that come from elsewhere (another network, a file) have no ledger: what the two sets share is unknown, and only a rule that holds for
every cross-covariance may join them. For any weight 0 < w < 1 the matrix ``diag(P_A / w, P_B / (1 - w))`` is not below the joint covariance
of both, whatever it is (Julier and Uhlmann, 1997), so the estimate that takes the two for independent with these covariances,

    P^-1 = w H_A' P_A^-1 H_A + (1 - w) H_B' P_B^-1 H_B

states no more accuracy than there is, jointly for all points of the union. What one set does not know has no information there; P exists,
because every point is known to one of them. Points that only one knows move with the common ones through its own joint covariance.

No inverse is formed: with c the common points, ``S = P_A,cc / w + P_B,cc / (1 - w)`` is the covariance of their differences, and the union
is an update of both sets by these. The weight minimises the trace over all points of the union, a convex function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from submin.errors import NumericalError, QueryError
from submin.network.registration import SAME_POINT_METRES

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
Rows = NDArray[np.int64]

LEAST_WEIGHT = 1e-6
ROUND_OFF = 1e-7
"""Part of a trace that tells nothing: near the least weight six digits cancel, and of two equal sets every weight is as good."""


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points with the joint covariance of their errors.

    Attributes
    ----------
    ids : (n,) different ids; geocentric : (n, 3) metres; covariance : (3n, 3n) m2, point-major, symmetric
    """

    ids: Ids
    geocentric: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class JoinedPoints:
    """The union of two sets.

    Attributes
    ----------
    points : ids ascending
    weight : w of the first set; the second has ``1 - w``
    place_one, place_other : (n,) place of each point in the sets, -1 where a set does not know it
    """

    points: PointSet
    weight: float
    place_one: Rows
    place_other: Rows


def join(one: PointSet, other: PointSet) -> JoinedPoints:
    """Join two sets of points by Covariance Intersection. Points of the same id are the same points.

    Raises
    ------
    QueryError
        When they have no point in common: nothing would be gained, and both would be inflated. When a common id is at two places more than
        a kilometre apart.
    NumericalError
        When the covariances of the common points are not positive definite together.
    """
    common, at_one, at_other = np.intersect1d(one.ids, other.ids, return_indices=True)
    if not len(common):
        raise QueryError(
            f"the sets of {len(one.ids)} and {len(other.ids)} points have no id in common, so joining them would inflate both and improve "
            "nothing; expected common points, or keep them apart"
        )
    difference = other.geocentric[at_other] - one.geocentric[at_one]
    far = np.linalg.norm(difference, axis=1)
    if far.max() > SAME_POINT_METRES:
        k = int(far.argmax())
        raise QueryError(
            f"point {common[k]} is at two places {far[k] / 1000.0:.1f} km apart; expected the same point where the id is the same: "
            "rename the points of one set"
        )
    split = _Split(one.covariance, _axes(at_one), other.covariance, _axes(at_other))
    weight = split.best_weight()
    added = np.setdiff1d(np.arange(len(other.ids)), at_other)
    ids = np.concatenate([one.ids, other.ids[added]])
    moved, covariance = split.union(weight, _axes(added), difference.ravel())
    geocentric = np.concatenate([one.geocentric, other.geocentric[added]]) + moved.reshape(-1, 3)
    order = np.argsort(ids)
    axes = _axes(order)
    return JoinedPoints(
        PointSet(ids[order], geocentric[order], covariance[np.ix_(axes, axes)]), weight,
        _places(ids[order], one.ids), _places(ids[order], other.ids),
    )  # fmt: skip


def _axes(points: Rows | NDArray[np.intp]) -> Rows:
    """Rows of the coordinates of some points."""
    return np.asarray((3 * np.asarray(points, dtype=np.int64)[:, None] + np.arange(3)).ravel())


def _places(ids: Ids, known: Ids) -> Rows:
    """Place (n,) of each id among the known ones, -1 for others."""
    order = np.argsort(known)
    at = np.minimum(np.searchsorted(known[order], ids), len(known) - 1)
    return np.where(known[order][at] == ids, order[at], -1)


class _Split:
    """Covariances of two sets, with those of their common coordinates brought to diagonal form together.

    With ``A_cc + B_cc = L L'`` and ``L^-1 B_cc L^-T = X diag(d) X'``, V = L X: ``A_cc = V diag(1 - d) V'``, ``B_cc = V diag(d) V'``, and
    ``S = V diag((1 - d) / w + d / (1 - w)) V'`` for every w.
    """

    def __init__(self, one: Array, common_one: Rows, other: Array, common_other: Rows) -> None:
        self.one, self.other = one, other
        together = one[np.ix_(common_one, common_one)] + other[np.ix_(common_other, common_other)]
        try:
            lower = la.cholesky(together, lower=True)
        except la.LinAlgError:
            raise NumericalError(
                f"the covariances of the {len(common_one) // 3} common points are not positive definite together; expected points whose "
                "errors are not known exactly, each once"
            ) from None
        half = la.solve_triangular(lower, other[np.ix_(common_other, common_other)], lower=True)
        part, vectors = la.eigh(la.solve_triangular(lower, half.T, lower=True))
        self.part = np.clip(part, 0.0, 1.0)
        self.inverse = vectors.T @ la.solve_triangular(lower, np.eye(len(lower)), lower=True)  # V^-1
        self.seen_one = one[:, common_one] @ self.inverse.T  # A_.c V^-T
        self.seen_other = other[:, common_other] @ self.inverse.T
        self.new = np.setdiff1d(np.arange(len(other)), common_other)

    def gain(self, weight: float) -> Array:
        """Diagonal (c,) of S^-1 in the form of V."""
        return np.asarray(weight * (1.0 - weight) / ((1.0 - weight) * (1.0 - self.part) + weight * self.part))

    def trace(self, weight: float) -> float:
        """Of the covariance of the union."""
        gain, rest = self.gain(weight), 1.0 - weight
        mine = np.trace(self.one) / weight - np.square(self.seen_one).sum(axis=0) @ gain / weight**2
        theirs = np.diagonal(self.other)[self.new].sum() / rest - np.square(self.seen_other[self.new]).sum(axis=0) @ gain / rest**2
        return float(mine + theirs)

    def best_weight(self) -> float:
        """The weight of the least trace; of those that are as good but for round-off the one nearest to the middle."""
        found = minimize_scalar(self.trace, bounds=(LEAST_WEIGHT, 1.0 - LEAST_WEIGHT), method="bounded", options={"xatol": 1e-9})
        traces = {weight: self.trace(weight) for weight in (float(found.x), LEAST_WEIGHT, 0.5, 1.0 - LEAST_WEIGHT)}
        good = (1.0 + ROUND_OFF) * min(traces.values())
        return min((weight for weight, trace in traces.items() if trace <= good), key=lambda weight: abs(weight - 0.5))

    def union(self, weight: float, new: Rows, difference: Array) -> tuple[Array, Array]:
        """Corrections (m,) and covariance (m, m) of all coordinates of the first set and the new ones of the other."""
        gain = self.gain(weight)
        mine, theirs = self.seen_one / weight, self.seen_other[new] / (1.0 - weight)
        innovation = gain * (self.inverse @ difference)
        # by L^-1 both sets are updated with one product: what is subtracted within a set is added between them
        half_mine, half_theirs = mine * np.sqrt(gain), theirs * np.sqrt(gain)
        between = half_mine @ half_theirs.T
        covariance = np.block([
            [self.one / weight - half_mine @ half_mine.T, between],
            [between.T, self.other[np.ix_(new, new)] / (1.0 - weight) - half_theirs @ half_theirs.T],
        ])  # fmt: skip
        moved = np.concatenate([mine @ innovation, -theirs @ innovation])
        return moved, np.asarray(0.5 * (covariance + covariance.T))
