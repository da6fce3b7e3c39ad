"""Queries of a dense network: one tile, one vector of points, one covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin import accuracy
from submin.errors import InputError, QueryError
from submin.geodesy import geocentric_to_geodetic, local_axes, rotate_covariance
from submin.query.asked import few
from submin.query.control_set import ControlSet
from submin.query.spread import spread_rows
from submin.storage.dense_store import DensePoints, Member, Rows, read_covariance, read_members, read_points
from submin.storage.snapshot import Snapshot

Array = NDArray[np.float64]
FORM = "dense"
DENSE_POLICIES = ("auto", "tile")
"""There is nothing to merge: its one tile answers for the whole network."""


def is_dense(snapshot: Snapshot) -> bool:
    """True for a version of a dense network."""
    return snapshot.metadata.form == FORM


def refuse_dense(snapshot: Snapshot, what: str) -> None:
    """Refuse what needs images; raises `InputError` for a dense network."""
    if is_dense(snapshot):
        raise InputError(f"{snapshot.place}: is a dense network, which keeps points and no images; {what} expects a factored one")


@dataclass(frozen=True, eq=False)
class DenseReader:
    """One version of a dense network, read only; points are read once, of the covariance what is asked for."""

    snapshot: Snapshot

    @cached_property
    def points(self) -> DensePoints:
        """All points."""
        return read_points(self.snapshot)

    @cached_property
    def geodetic(self) -> Array:
        """Longitude and latitude in degrees, height in metres (n, 3) of all points."""
        return geocentric_to_geodetic(self.points.geocentric, self.snapshot.metadata.ellipsoid)

    @cached_property
    def local_covariance(self) -> Array:
        """Covariance (n, 3, 3) of each point in its local axes, square metres."""
        return rotate_covariance(self.points.covariance, local_axes(self.geodetic)) if len(self.geodetic) else np.empty((0, 3, 3))

    @cached_property
    def members(self) -> list[Member]:
        """The sets of observations that were fused."""
        return read_members(self.snapshot, self.points.blocks)

    @cached_property
    def observation_counts(self) -> Rows:
        """Observations (n,), positions and baselines, in which each point takes part."""
        sides = [ids for member in self.members for ids in (member.cluster.from_ids, member.cluster.to_ids)]
        named, counts = np.unique(np.concatenate(sides) if sides else np.empty(0, dtype="U1"), return_counts=True)
        if not len(self.points.ids):
            return np.empty(0, dtype=np.int64)
        return np.asarray(counts[np.searchsorted(named, self.points.ids)], dtype=np.int64)

    @cached_property
    def control_points(self) -> NDArray[np.str_]:
        """Points that are its control."""
        ids = [member.cluster.from_ids for member in self.members if member.kind == "control"]
        return np.unique(np.concatenate(ids)) if ids else np.empty(0, dtype="U1")

    def ce90(self) -> Array:
        """CE90 (n,) of all points, metres."""
        return accuracy.ce90(self.local_covariance[:, :2, :2])

    def le90(self) -> Array:
        """LE90 (n,) of all points, metres."""
        return accuracy.le90(self.local_covariance[:, 2, 2])

    def held(self, ids: NDArray[np.str_]) -> NDArray[np.str_]:
        """Those of some points that the network has, ascending."""
        return np.intersect1d(ids, self.points.ids)

    def in_area(self, area: BaseGeometry) -> Rows:
        """Places of the points in an area (longitude and latitude, degrees)."""
        return np.flatnonzero(shapely.intersects_xy(area, self.geodetic[:, 0], self.geodetic[:, 1]))

    def named(self, points: Sequence[str] | NDArray[np.str_]) -> Rows:
        """Places of points by their ids; raises `QueryError` when the network does not have one."""
        ids = np.unique(np.asarray(points, dtype=np.str_))
        missing = np.setdiff1d(ids, self.points.ids)
        if len(missing):
            raise QueryError(f"{len(missing)} of {len(ids)} points are not in the network or not yet determined: {few(missing)}")
        return np.flatnonzero(np.isin(self.points.ids, ids))

    def answer(self, rows: Rows, policy: str, max_points: int | None) -> ControlSet:
        """Control set of the points at these places, in the order of their ids.

        Raises
        ------
        QueryError
            When another policy is asked for than that of one tile, or ``max_points`` is below 1.
        """
        if policy not in DENSE_POLICIES:
            raise QueryError(
                f"policy is {policy!r}; a dense network has one tile and nothing to merge: expected one of {', '.join(DENSE_POLICIES)}"
            )
        if max_points is not None and len(rows) > max_points:
            east, north = self.snapshot.cover.plane(self.geodetic[rows, 0], self.geodetic[rows, 1])
            variance = np.trace(self.points.covariance[rows], axis1=1, axis2=2)
            rows = rows[spread_rows(np.column_stack([east, north]), variance, self.points.ids[rows], max_points)]
        covariance = read_covariance(self.snapshot, rows)
        by_id = np.argsort(self.points.ids[rows])
        at = (3 * by_id[:, None] + np.arange(3)).ravel()
        rows, metadata = rows[by_id], self.snapshot.metadata
        tile = self.snapshot.cover.tile_name(0)
        return ControlSet(
            ids=self.points.ids[rows] if len(rows) else np.empty(0, dtype="U1"),
            geocentric=self.points.geocentric[rows],
            covariance=covariance[np.ix_(at, at)],
            ellipsoid=metadata.ellipsoid,
            frame=metadata.frame,
            epoch=metadata.epoch,
            policy="tile",
            tiles=(tile,) if len(rows) else (),
            tile_of_point=np.full(len(rows), tile),
            rays=self.observation_counts[rows],
            version=self.snapshot.version,
            blocks=tuple(sorted(self.points.blocks)) if len(rows) else (),
            scope="network",
        )
