"""What is known of every point of a network beside its coordinates: what it rests on, how well its rays meet, what it may be used for.

Everything is counted from the rays in the cells by group reductions, so that it cannot disagree with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.weak_geometry import convergence_angles
from submin.errors import QueryError
from submin.geodesy import geocentric_to_geodetic
from submin.network.cell import factors
from submin.network.thinning import reported_points
from submin.query.planner import Selection, determined_by
from submin.query.source import NetworkSource

Array = NDArray[np.float64]
Codes = NDArray[np.int64]
Texts = NDArray[np.str_]
Flags = NDArray[np.bool_]

STATUSES = ("internal", "external", "check", "pending", "undetermined")
BETWEEN = "; "
"""Stands between the licences of one point."""
DETAILS = ("status", "first_block", "last_block", "blocks", "convergence", "licences")
"""Columns that an answer takes over with its points (``submin query --details``)."""


@dataclass(frozen=True)
class ImageFacts:
    """What points take over from the images (m,) of a network, by row.

    Attributes
    ----------
    survey : True for a view of a surveyed point, which is no image
    block : place of the image's block in ``block_ids``, which are in the order in which they came
    acquired : place of the time in ``times``, which ascend; -1 where it is not known
    licence : place in ``licences``, which ascend; -1 where none is given
    """

    survey: Flags
    block: Codes
    block_ids: Texts
    acquired: Codes
    times: Texts
    licence: Codes
    licences: Texts


@dataclass(frozen=True, eq=False)
class PointMetadata:
    """Points of one version of a network, ascending by id. Units and meanings: docs/points.md.

    Attributes
    ----------
    ids : (n,)
    geodetic : (n, 3) longitude, latitude (degrees), height (metres above the ellipsoid): where the adjustment of the tile whose core holds
        the point has it; the registered position of a point that its rays do not determine
    registered : (n, 3) registered position, likewise
    status : (n,) one of `STATUSES`
    rays, rays_rejected : (n,) accepted and rejected rays, of images
    blocks : (n,) blocks of images with an accepted ray
    first_block, last_block : (n,) of them, by the version that they came with, then by name
    convergence : (n,) degrees, largest angle between two accepted rays; NaN with fewer
    first_acquired, last_acquired : (n,) times of the images with an accepted ray, ISO 8601 UTC; empty when not known
    licences : (n,) of these images, different ones, ascending, joined by "; "
    tile, cell : (n,) names of the tile whose core holds the point, and of its cell
    reported : (n,) False for points that thinning leaves out of answers for areas and tiles
    valid_from, valid_to, reason : (n,) first and last day, ISO 8601, and why; empty where open
    epoch, version : of the network
    """

    ids: Texts
    geodetic: Array
    registered: Array
    status: Texts
    rays: Codes
    rays_rejected: Codes
    blocks: Codes
    first_block: Texts
    last_block: Texts
    convergence: Array
    first_acquired: Texts
    last_acquired: Texts
    licences: Texts
    tile: Texts
    cell: Texts
    reported: Flags
    valid_from: Texts
    valid_to: Texts
    reason: Texts
    epoch: str = ""
    version: str = ""

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: Codes | Flags) -> PointMetadata:
        """The points of these rows, or of a mask."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _KINDS})

    def with_status(self, status: str) -> PointMetadata:
        """The points of one status.

        Raises
        ------
        QueryError
            When there is no such status.
        """
        if status not in STATUSES:
            raise QueryError(f"status is {status!r}; expected one of {', '.join(STATUSES)}")
        return self.take(self.status == status)

    def details(self) -> dict[str, NDArray[Any]]:
        """The columns `DETAILS`."""
        return {name: getattr(self, name) for name in DETAILS}

    def columns(self) -> dict[str, NDArray[Any]]:
        """All columns as they are written to files."""
        axes = ("longitude", "latitude", "height")
        first: dict[str, NDArray[Any]] = {"point_id": self.ids}
        first |= {name: self.geodetic[:, k] for k, name in enumerate(axes)}
        first |= {f"registered_{name}": self.registered[:, k] for k, name in enumerate(axes)}
        rest = {name: getattr(self, name) for name in _KINDS if name not in ("ids", *PLACES)}
        return first | rest | {"epoch": np.full(len(self), self.epoch)}


_KINDS: dict[str, str] = {
    "ids": "U1", "geodetic": "f8", "registered": "f8", "status": "U1", "rays": "i8", "rays_rejected": "i8", "blocks": "i8",
    "first_block": "U1", "last_block": "U1", "convergence": "f8", "first_acquired": "U1", "last_acquired": "U1", "licences": "U1",
    "tile": "U1", "cell": "U1", "reported": "?", "valid_from": "U1", "valid_to": "U1", "reason": "U1",
}  # fmt: skip
"""The arrays and their types, for a table without rows."""
PLACES = ("geodetic", "registered")


def metadata_of_points(
    source: NetworkSource, selections: Sequence[Selection], images: ImageFacts, check_points: Texts, thinning: float
) -> PointMetadata:
    """Metadata of selected points, without dates, epoch and version.

    ``check_points`` are the ids of all of them, ``thinning`` the side of the squares of which one point each is reported (0: none).
    """
    parts = [_of_cell(source, selection, images, check_points, thinning) for selection in selections]
    columns: dict[str, Any] = {
        name: np.concatenate([np.empty((0, 3) if name in PLACES else 0, dtype=kind), *(part[name] for part in parts)])
        for name, kind in _KINDS.items()
    }
    found = PointMetadata(**columns)
    return found.take(np.argsort(found.ids, kind="stable"))


def _of_cell(
    source: NetworkSource, selection: Selection, images: ImageFacts, check_points: Texts, thinning: float
) -> dict[str, NDArray[Any]]:
    """Columns of some points of one cell."""
    cell, rows, cover = selection.cell, selection.rows, source.cover
    n, ids = len(rows), cell.point_ids[rows]
    linear, point_factors = factors(cell, source.image_set(cell.images), rows)
    of_point = np.repeat(np.arange(n), np.diff(linear.first))
    image = cell.images[linear.image]
    accepted = cell.rays.accepted[np.isin(cell.rays.point, rows)]
    of_image = ~images.survey[image]
    used, surveyed = accepted & of_image, accepted & ~of_image
    determined = determined_by(point_factors)
    external = np.bincount(of_point[surveyed], minlength=n) > 0
    point, seen = of_point[used], image[used]
    rays = np.bincount(point, minlength=n)
    status = np.select(
        [~determined & (rays == 1), ~determined, external, np.isin(ids, check_points)],
        ["pending", "undetermined", "external", "check"], "internal",
    )  # fmt: skip
    registered = geocentric_to_geodetic(cell.origin[rows], cover.ellipsoid)
    at = geocentric_to_geodetic(cell.linearised_at[rows], cover.ellipsoid)
    first_block, last_block = group_extremes(point, images.block[seen], n)
    timed = images.acquired[seen] >= 0
    first_time, last_time = group_extremes(point[timed], images.acquired[seen][timed], n)
    licensed = images.licence[seen] >= 0
    none = np.zeros(n, dtype="U1")
    return {
        "ids": ids, "geodetic": np.where(determined[:, None], at, registered), "registered": registered, "status": status,
        "rays": rays, "rays_rejected": np.bincount(of_point[of_image & ~accepted], minlength=n),
        "blocks": np.bincount(group_distinct(point, images.block[seen])[0], minlength=n),
        "first_block": _named(first_block, images.block_ids), "last_block": _named(last_block, images.block_ids),
        "convergence": convergence_angles(linear, used.astype(np.float64)),
        "first_acquired": _named(first_time, images.times), "last_acquired": _named(last_time, images.times),
        "licences": joined_texts(point[licensed], images.licence[seen][licensed], images.licences, n),
        "tile": np.full(n, cover.tile_name(cover.owner(cell.number))), "cell": np.full(n, cover.cell_name(cell.number)),
        "reported": reported_points(cell, cover, thinning)[rows], "valid_from": none, "valid_to": none, "reason": none,
    }  # fmt: skip


def group_extremes(point: Codes, value: Codes, points: int) -> tuple[Codes, Codes]:
    """Least and greatest value (points,) of each point's; -1 where it has none. Values are 0 or more."""
    least, greatest = np.full(points, np.iinfo(np.int64).max), np.full(points, -1, dtype=np.int64)
    np.minimum.at(least, point, value)
    np.maximum.at(greatest, point, value)
    return np.where(greatest < 0, -1, least), greatest


def group_distinct(point: Codes, value: Codes) -> tuple[Codes, Codes]:
    """The different pairs of a point and one of its values (0 or more), ascending by point, then value."""
    base = int(value.max(initial=0)) + 1
    pairs = np.unique(point * base + value)
    return pairs // base, pairs % base


def joined_texts(point: Codes, value: Codes, texts: Texts, points: int) -> Texts:
    """The different texts (points,) that the values of each point name, ascending, joined by `BETWEEN`.

    Points with the same texts so far are taken together: the loop runs over the largest number of texts of one point.
    """
    point, value = group_distinct(point, value)
    place = np.arange(len(point)) - np.searchsorted(point, point)
    joined, at = np.zeros(1, dtype="U1"), np.zeros(points, dtype=np.int64)
    for k in range(int(place.max(initial=-1)) + 1):
        here = place == k
        before, added = np.divmod(np.unique(pairs := at[point[here]] * len(texts) + value[here]), len(texts))
        longer = np.char.add(np.char.add(joined[before], BETWEEN if k else ""), texts[added])
        at[point[here]] = len(joined) + np.searchsorted(before * len(texts) + added, pairs)
        joined = np.concatenate([joined, longer])
    return joined[at]


def _named(codes: Codes, names: Texts) -> Texts:
    """Names of codes; empty for -1."""
    return np.append(names, "")[codes]
