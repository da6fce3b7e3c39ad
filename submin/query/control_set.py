"""The answer of a query: ground points with the joint covariance of their errors, and where the answer comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from submin import accuracy
from submin.correlation.compact import AUTO, CompactCovariance, condense
from submin.errors import InputError, QueryError
from submin.formats import tables
from submin.geodesy import Ellipsoid, common_axes, geocentric_to_geodetic, local_axes, rotate_covariance
from submin.query.joined import PointSet, join

Array = NDArray[np.float64]

SCOPES = ("network", "tiles")


@dataclass(frozen=True)
class RelativeAccuracy:
    """Accuracy of the vector between two points.

    Attributes
    ----------
    ce90, le90 : relative CE90 and LE90, metres
    covariance : (3, 3), m2, covariance of the vector in local axes (east, north, up) at the middle of the pair
    """

    ce90: float
    le90: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class ControlSet:
    """Control points with their full covariance. Arrays are not copied: do not change them.

    Parameters
    ----------
    ids : (n,), unicode
        Global ids of the points.
    geocentric : (n, 3), m
        Positions in the frame of the network.
    covariance : (3n, 3n), m2
        Joint covariance of the positions, geocentric axes, point-major, symmetric.
    ellipsoid : Ellipsoid
        Of the body; geodetic coordinates and local axes refer to it.
    frame, epoch : str
        Of the network.
    policy : str
        Merge policy that gave the answer.
    tiles, blocks : tuple of str
        Tiles concerned, and blocks that have contributed.
    tile_of_point : (n,), unicode
        Owner tile of each point.
    rays : (n,), integer
        Rays used for each point.
    version : str
        Version of the network, such as ``v12``.
    scope : str
        ``network`` when the answer equals that of the monolithic network, else ``tiles``.
    validity : tuple of str
        ``ID FROM/TO`` for every point of which a first or last day is known: an ISO 8601 interval, ``..`` where it is open.

    Raises
    ------
    InputError
        When shapes do not match, a type is another, a position is not finite, or the scope is unknown.
    """

    ids: NDArray[np.str_]
    geocentric: Array
    covariance: Array
    ellipsoid: Ellipsoid
    frame: str
    epoch: str
    policy: str
    tiles: tuple[str, ...]
    tile_of_point: NDArray[np.str_]
    rays: NDArray[np.integer[Any]]
    version: str
    blocks: tuple[str, ...]
    scope: str
    validity: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.ids)
        shapes = {"ids": (n,), "geocentric": (n, 3), "covariance": (3 * n, 3 * n), "tile_of_point": (n,), "rays": (n,)}
        types = {"ids": np.str_, "geocentric": np.float64, "covariance": np.float64, "tile_of_point": np.str_, "rays": np.integer}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value.shape != shape:
                raise InputError(f"control set: {name} has shape {value.shape}; expected {shape} for {n} points")
            if not np.issubdtype(value.dtype, types[name]):
                raise InputError(f"control set: {name} is of type {value.dtype}; expected numpy.{types[name].__name__}")
        finite = np.isfinite(self.geocentric).all(axis=1)
        if not finite.all():
            i = int(np.argmin(finite))
            raise InputError(f"control set: point {self.ids[i]} is at {self.geocentric[i].tolist()}; expected finite metres")
        if self.scope not in SCOPES:
            raise InputError(f"control set: scope is {self.scope!r}; expected one of {', '.join(SCOPES)}")

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def geodetic(self) -> Array:
        """Longitude and latitude in degrees, height in metres above the ellipsoid (n, 3)."""
        return geocentric_to_geodetic(self.geocentric, self.ellipsoid)

    @cached_property
    def point_covariance(self) -> Array:
        """Covariance (n, 3, 3) of each point alone, m2, geocentric axes."""
        n = len(self)
        return np.asarray(self.covariance.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :])

    @cached_property
    def local_covariance(self) -> Array:
        """Covariance (n, 3, 3) of each point alone, m2, in its local axes east, north, up."""
        return rotate_covariance(self.point_covariance, local_axes(self.geodetic))

    @cached_property
    def ce90(self) -> Array:
        """CE90 (n,) in metres; see `submin.accuracy.ce90`."""
        return accuracy.ce90(self.local_covariance[:, :2, :2])

    @cached_property
    def le90(self) -> Array:
        """LE90 (n,) in metres; see `submin.accuracy.le90`."""
        return accuracy.le90(self.local_covariance[:, 2, 2])

    def relative(self, i: int, j: int) -> RelativeAccuracy:
        """Relative accuracy of the pair of points at places i and j, 0 to n - 1; it does not depend on their order.

        Horizontal and vertical refer to the local axes at the middle of the pair: for points far apart on the globe the words lose
        their meaning, the covariance does not.

        Raises
        ------
        QueryError
            When a place is not one of the set.
        NumericalError
            When the covariance of the pair is not finite or not positive semi-definite.
        """
        for place in (i, j):
            if not 0 <= place < len(self):
                raise QueryError(f"relative accuracy: there is no point {place}; expected 0 to {len(self) - 1} ({len(self)} points)")
        middle = 0.5 * (self.geocentric[i] + self.geocentric[j])
        axes = local_axes(geocentric_to_geodetic(middle[None], self.ellipsoid))[0]
        # A rotated factor keeps every block semi-definite, however small beside the others; a rotated matrix does not.
        values, vectors = np.linalg.eigh(accuracy.relative_covariance(self.covariance, i, j))
        factor = axes @ (vectors * np.sqrt(np.clip(values, 0.0, None)))
        local = np.asarray(factor @ factor.T)
        return RelativeAccuracy(float(accuracy.ce90(local[:2, :2])[0]), float(accuracy.le90(local[2, 2])[0]), local)

    def subset(self, indices: Sequence[int] | NDArray[Any]) -> ControlSet:
        """The points at these places, in this order, with the part of the joint covariance that concerns them; or those of a mask (n,).

        Policy, tiles, blocks and scope stay those of the query that was answered.

        Raises
        ------
        QueryError
            When an index is not a place of the set, or a mask has another length.
        """
        chosen = np.asarray(indices)
        if chosen.dtype == bool:
            if chosen.shape != (len(self),):
                raise QueryError(f"subset: mask has shape {chosen.shape}; expected {(len(self),)}")
            chosen = np.flatnonzero(chosen)
        if not chosen.size:
            chosen = np.empty(0, dtype=np.intp)
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu":
            raise QueryError(f"subset: indices have shape {chosen.shape} and type {chosen.dtype}; expected one row of integers or a mask")
        outside = (chosen < 0) | (chosen >= len(self))
        if outside.any():
            raise QueryError(f"subset: there is no point {chosen[outside][0]}; expected 0 to {len(self) - 1} ({len(self)} points)")
        rows = (3 * chosen.astype(np.intp)[:, None] + np.arange(3)).ravel()
        here = set(self.ids[chosen].tolist())
        return replace(
            self,
            ids=self.ids[chosen],
            geocentric=self.geocentric[chosen],
            covariance=self.covariance[np.ix_(rows, rows)],
            tile_of_point=self.tile_of_point[chosen],
            rays=self.rays[chosen],
            validity=tuple(dated for dated in self.validity if dated.rsplit(" ", 1)[0] in here),
        )

    def joined(self, other: ControlSet, policy: str = "ci") -> ControlSet:
        """These points and those of a set that comes from elsewhere, as one: another network's answer, or a file (`submin.read_control`).

        Nothing is known of what the two share, so the answer holds whatever it is: Covariance Intersection with the weight that is best for
        all points of both. Points of the same id are the same points and bridge the sets; points that only one of them knows are
        corrected through its joint covariance (docs/mathematics.md, "Sets from elsewhere").

        Tiles, and the tile of a point, are those of this set; a point that it does not know has none. The rays of a common point are those
        of the set that counts more: some may be the same.

        Raises
        ------
        QueryError
            When the policy is not ``ci``, frame, epoch or ellipsoid differ, or there is no common point.
        NumericalError
            When the covariances of the common points are not positive definite together.
        """
        if policy != "ci":
            raise QueryError(
                f"policy is {policy!r}; a set from elsewhere can join only by 'ci': it has no ledger of blocks, so what it shares with "
                "this one is unknown, and every other policy needs to know"
            )
        for name, mine, theirs in (
            ("frame", self.frame, other.frame), ("epoch", self.epoch, other.epoch), ("ellipsoid", self.ellipsoid, other.ellipsoid)
        ):  # fmt: skip
            if mine != theirs:
                raise QueryError(f"{name} of the other set is {theirs}; expected {mine}, that of this one: transform its points first")
        found = join(*(PointSet(c.ids, c.geocentric, c.covariance) for c in (self, other)))
        here, there = found.place_one >= 0, found.place_other >= 0
        counts = (np.where(here, self.rays[found.place_one], 0), np.where(there, other.rays[found.place_other], 0))
        return replace(
            self,
            ids=found.points.ids,
            geocentric=found.points.geocentric,
            covariance=found.points.covariance,
            policy="ci",
            tile_of_point=np.where(here, self.tile_of_point[found.place_one], ""),
            rays=np.maximum(*counts),
            blocks=tuple(sorted({*self.blocks, *other.blocks})),
            scope="tiles",
            validity=tuple(sorted({*self.validity, *other.validity})),
        )

    def compact(self, family: str = AUTO, rank: int = 0, floor: float | None = None) -> CompactCovariance:
        """The joint covariance condensed to each point's own covariance and correlation functions, with the factor that makes it a bound.

        `submin.correlation.expand` makes a joint covariance of it again, which is nowhere smaller than that of the set.

        Parameters
        ----------
        family : name of a family of correlation functions (docs/correlation.md), or ``auto``: the one that enlarges least
        rank : number of vectors kept beside the functions: 3n numbers each, and the covariance is enlarged less
        floor : metres from which on points are uncorrelated at the latest, but for the vectors; for families with zero floor

        Raises
        ------
        InputError
            When the family is unknown or not positive definite in space, there are too few or too many points, or rank or floor are out
            of range.
        NumericalError
            When a point's own covariance is not positive definite.
        """
        return condense(self.covariance, self.geocentric, common_axes(self.geocentric, self.ellipsoid), family, rank, floor)

    def table(self) -> tables.ControlTable:
        """Columns, joint covariance and metadata as they are written to files."""
        local, geodetic = self.local_covariance, self.geodetic
        columns = {
            "point_id": self.ids,
            "x": self.geocentric[:, 0],
            "y": self.geocentric[:, 1],
            "z": self.geocentric[:, 2],
            "longitude": geodetic[:, 0],
            "latitude": geodetic[:, 1],
            "height": geodetic[:, 2],
            "cov_ee": local[:, 0, 0],
            "cov_en": local[:, 0, 1],
            "cov_eu": local[:, 0, 2],
            "cov_nn": local[:, 1, 1],
            "cov_nu": local[:, 1, 2],
            "cov_uu": local[:, 2, 2],
            "ce90": self.ce90,
            "le90": self.le90,
            "tile": self.tile_of_point,
            "rays": self.rays,
        }
        metadata: tables.Metadata = {
            "policy": self.policy,
            "version": self.version,
            "frame": self.frame,
            "epoch": self.epoch,
            "scope": self.scope,
            "semimajor_axis": self.ellipsoid.semimajor_axis,
            "flattening": self.ellipsoid.flattening,
            "tiles": self.tiles,
            "blocks": self.blocks,
        }
        if self.validity:
            metadata = {**metadata, "validity": self.validity}
        return tables.ControlTable(columns, self.covariance, metadata)

    def write(self, path: str | Path, details: Mapping[str, NDArray[Any]] | None = None) -> None:
        """Write to a file of the format that its suffix names: ``.parquet``, ``.npz``, ``.geojson``, ``.csv`` or ``.gcp``.

        ``details``: further columns (n,), such as those of `PointMetadata.details` for the same points.

        Raises
        ------
        QueryError
            When the suffix is another.
        InputError
            When the folder does not exist.
        """
        table = self.table()
        tables.write_table(path, replace(table, columns={**table.columns, **(details or {})}))

    def to_parquet(self, path: str | Path) -> None:
        """Write points, joint covariance and metadata; see `submin.formats.tables.write_parquet`."""
        tables.write_parquet(path, self.table())

    def to_npz(self, path: str | Path) -> None:
        """Write arrays, joint covariance and metadata; see `submin.formats.tables.write_npz`."""
        tables.write_npz(path, self.table())

    def to_geojson(self, path: str | Path) -> None:
        """Write 3-D points without the joint covariance; see `submin.formats.tables.write_geojson`."""
        tables.write_geojson(path, self.table())

    def to_csv(self, path: str | Path) -> None:
        """Write the point columns without the joint covariance; see `submin.formats.tables.write_csv`."""
        tables.write_csv(path, self.table())
