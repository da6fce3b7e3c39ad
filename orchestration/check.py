"""A network against check points: whether its coordinates are right, and its stated accuracy true."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from submin import ControlSet, Network
from submin.accuracy import AccuracyTable, accuracy_against_truth, nees_band, nees_per_dof
from submin.errors import InputError
from submin.geodesy import geodetic_to_geocentric, local_axes
from submin.storage.ledger import Ledger
from submin.storage.point_table import PointTable

Array = NDArray[np.float64]

JOINT_POINTS = 2000
"""Points whose joint covariance is formed at once (288 MB); more are checked core by core."""


@dataclass(frozen=True)
class CheckResult:
    """Result of a check.

    Attributes
    ----------
    accuracy : of all points; by_area : of each named sub-area
    nees_per_dof : mean over the groups, weighted by their degrees of freedom; nees_band : its 99 % band if the model is right
    missing : check points that the network cannot answer for
    control_left_out : check points that are the network's control: a surveyed point cannot check what was fitted to it
    policy, version : of the answers
    """

    accuracy: AccuracyTable
    by_area: dict[str, AccuracyTable]
    nees_per_dof: float
    nees_band: tuple[float, float]
    missing: int
    control_left_out: int
    policy: str
    version: str

    def to_json(self) -> dict[str, Any]:
        """Plain values, as programs rely on them."""
        return self.accuracy.to_mapping() | {
            "nees_per_dof": self.nees_per_dof,
            "nees_band": list(self.nees_band),
            "areas": {name: table.to_mapping() for name, table in self.by_area.items()},
            "missing": self.missing,
            "control_left_out": self.control_left_out,
            "policy": self.policy,
            "version": self.version,
        }


def check(network: Network, points: PointTable, policy: str, advance: Callable[[int], None] = lambda done: None) -> CheckResult:
    """Compare the network with check points of the same ids; those that are its control are left out, and counted.

    Raises
    ------
    InputError
        When the network holds none of the check points, or all are its control.
    """
    order = np.argsort(points.point_ids)
    if network.dense is not None:
        policy = "tile"  # the one that there is
    surveyed = Ledger.of(network.snapshot).control_points() if network.dense is None else network.dense.control_points
    controlled = np.isin(points.point_ids[order], surveyed)
    order = order[~controlled]
    ids = points.point_ids[order]
    if controlled.any() and not len(ids):
        raise InputError(
            f"all {len(controlled)} check points are control of the network ({points.point_ids[0]}, ...), which cannot check itself; "
            "expected points that did not control it: withdraw some of the control, or take another table"
        )
    errors, covariances, rows = [], [], []
    nees, dof = 0.0, 0
    for control in _groups(network, ids, policy):
        row = order[np.searchsorted(ids, control.ids)]
        truth = geodetic_to_geocentric(points.geodetic[row], control.ellipsoid)
        error = control.geocentric - truth
        axes = local_axes(points.geodetic[row])
        errors.append(np.einsum("nij,nj->ni", axes, error))
        covariances.append(control.local_covariance + points.covariance_enu[row])
        rows.append(row)
        joint = control.covariance
        own = np.swapaxes(axes, 1, 2) @ points.covariance_enu[row] @ axes
        at = np.arange(len(row))
        joint.reshape(len(row), 3, len(row), 3)[at, :, at, :] += own
        nees += nees_per_dof(error.ravel(), joint) * error.size
        dof += error.size
        advance(len(row))
    if not rows:
        raise InputError(f"none of the {len(ids)} check points is in the network; expected the ids of tie points (column point_id)")
    enu, covariance, row = np.concatenate(errors), np.concatenate(covariances), np.concatenate(rows)
    areas = points.area[row]
    named = sorted(set(areas.tolist()) - {""})
    return CheckResult(
        accuracy_against_truth(enu, covariance),
        {name: accuracy_against_truth(enu[areas == name], covariance[areas == name]) for name in named},
        nees / dof, nees_band(dof), len(ids) - len(row), int(controlled.sum()), policy, network.version,
    )  # fmt: skip


def _groups(network: Network, ids: NDArray[np.str_], policy: str) -> Iterator[ControlSet]:
    """Answers for all points that can be answered for: together, or where they are many those of one core, which few tiles answer for."""
    group: list[NDArray[np.str_]] = []
    many, core = len(ids) > JOINT_POINTS, -1
    for cell, members in sorted(network.cells_of_points(ids).items(), key=lambda item: network.cover.owner(item[0])):
        for start in range(0, len(members), JOINT_POINTS):
            part = members[start : start + JOINT_POINTS]
            left = many and network.cover.owner(cell) != core
            if group and (left or sum(map(len, group)) + len(part) > JOINT_POINTS):
                yield network.query(points=np.concatenate(group), policy=policy)
                group = []
            group.append(part)
            core = network.cover.owner(cell)
    if group:
        yield network.query(points=np.concatenate(group), policy=policy)
