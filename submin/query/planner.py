"""From a question to an answer: which points, which tiles, which policy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.adjustment.elimination import PointFactors
from submin.adjustment.images import ImageSet
from submin.errors import QueryError
from submin.geodesy import geocentric_to_geodetic
from submin.network.cell import Cell, factors
from submin.network.sub_min import CombinedState, GroundPart, SubMin, joint_covariance, loadings, locate, with_own_parts
from submin.query import bounded_inflation, covariance_intersection, rigorous, split_intersection, tile
from submin.query.source import Index, NetworkSource
from submin.query.spread import check_most, spread_rows

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

Policy = Callable[[NetworkSource, Sequence[int], Index, Sequence[GroundPart]], SubMin]
POLICIES: dict[str, Policy] = {
    "tile": tile.estimate,
    "ci": covariance_intersection.estimate,
    "bci": bounded_inflation.estimate,
    "split": split_intersection.estimate,
    "rigorous": rigorous.estimate,
}
"""Merge policies. A new one is one file, one line here and one row in the table of `tests/property/test_policies.py`."""

DETERMINED_METRES = 1000.0
"""A point whose own part is worse (rays of one viewpoint) keeps what its rays say about images, but is not reported as a control point."""

SEARCH_MARGIN_METRES = 2000.0
"""Points are looked for in cells this far around the queried area: a point's estimate may lie outside the cell of its registration."""


@dataclass(frozen=True)
class Selection:
    """Points of one cell: rows of the cell, ascending."""

    cell: Cell
    rows: Rows


@dataclass(frozen=True)
class Answer:
    """The answer of a query, in arrays.

    Attributes
    ----------
    ids : (n,) points, ascending; geocentric : (n, 3) metres; covariance : (3n, 3n) joint, geocentric square metres
    owner : (n,) tile whose core holds each point; rays : (n,) accepted rays of each
    policy : the one used; tiles : those concerned; images : rows of the images behind the answer
    network_wide : True when it equals the answer of the monolithic network
    """

    ids: NDArray[np.str_]
    geocentric: Array
    covariance: Array
    owner: Rows
    rays: Rows
    policy: str
    tiles: tuple[int, ...]
    images: Index
    network_wide: bool


def points_in_area(source: NetworkSource, area: BaseGeometry, every: bool = False) -> list[Selection]:
    """Determined points whose latest position lies in an area (longitude and latitude, degrees).

    With ``every`` also points of fewer than two rays, and those whose registered position alone lies in the area.
    """
    selections = []
    for cell in source.some_cells(cells_near(source, area)):
        at = source.kept(("geodetic", cell.number), partial(geocentric_to_geodetic, cell.linearised_at, source.cover.ellipsoid))
        inside = np.asarray(shapely.intersects_xy(area, at[:, 0], at[:, 1]), dtype=bool)
        if every:
            at = geocentric_to_geodetic(cell.origin, source.cover.ellipsoid)
            inside |= shapely.intersects_xy(area, at[:, 0], at[:, 1])
        selections.append(Selection(cell, np.flatnonzero(inside & _wanted(cell, every))))
    return [s for s in selections if len(s.rows)]


def all_points(source: NetworkSource) -> list[Selection]:
    """All determined points of a network."""
    cells = source.some_cells(source.cell_numbers())
    return [s for s in (Selection(cell, np.flatnonzero(_wanted(cell, every=False))) for cell in cells) if len(s.rows)]


def points_of_tile(source: NetworkSource, number: int, every: bool = False, core: bool = False) -> list[Selection]:
    """All determined points that a tile, or with ``core`` its core, holds; with ``every`` also those of fewer than two rays."""
    cells = source.some_cells(source.existing(source.cover.cells_owned(number) if core else source.cover.cells_held(number)))
    return [s for s in (Selection(cell, np.flatnonzero(_wanted(cell, every))) for cell in cells) if len(s.rows)]


def points_named(
    source: NetworkSource, ids: NDArray[np.str_], cells: Rows, every: bool = False
) -> tuple[list[Selection], NDArray[np.str_]]:
    """Points by id, with the cell (n,) where the directory says that each is; and the ids of those that cannot be answered for.

    A point that is not in the network, or (without ``every``) that its rays do not determine yet, cannot.
    """
    found = np.zeros(len(ids), dtype=bool)
    selections = []
    for cell in source.some_cells(np.unique(cells[cells >= 0]).tolist()):
        wanted = np.flatnonzero(cells == cell.number)
        row = np.minimum(np.searchsorted(cell.point_ids, ids[wanted]), max(len(cell) - 1, 0))
        held = (cell.point_ids[row] == ids[wanted]) & _wanted(cell, every)[row] if len(cell) else np.zeros(len(wanted), dtype=bool)
        found[wanted[held]] = True
        selections.append(Selection(cell, np.unique(row[held])))
    return [s for s in selections if len(s.rows)], ids[~found]


def cells_near(source: NetworkSource, area: BaseGeometry) -> list[int]:
    """Cells with points in or near an area, ascending."""
    cover = source.cover
    outline = shapely.get_coordinates(shapely.segmentize(area, 0.25) if not area.is_empty else area)
    if not len(outline):
        return []
    x, y = cover.plane(outline[:, 0], outline[:, 1])
    opposite = cover.centre[0] + np.array([-180.0, 180.0])
    if shapely.intersects_xy(area, opposite, -cover.centre[1]).any() or not np.isfinite([x, y]).all():
        return list(source.cell_numbers())  # in the plane such an area lies outside of its outline
    west, south = x.min() - SEARCH_MARGIN_METRES, y.min() - SEARCH_MARGIN_METRES
    east, north = x.max() + SEARCH_MARGIN_METRES, y.max() + SEARCH_MARGIN_METRES
    near = []
    for number in (cell for t in cover.tiles_meeting(west, south, east, north) for cell in cover.cells_owned(t)):
        w, s, e, n = cover.cell_bounds(number)
        if w <= east and e >= west and s <= north and n >= south:
            near.append(number)
    return list(source.existing(sorted(near)))


def well_spread(source: NetworkSource, selections: Sequence[Selection], most: int) -> list[Selection]:
    """All of the points when they are no more than ``most``, else so many of those that their rays determine; see `spread_rows`.

    They are spread by registered positions, and compared by the trace of their own part D: what other rays of the same images could not
    give them.

    Raises
    ------
    QueryError
        When ``most`` is below 1.
    """
    check_most(most)
    if sum(len(s.rows) for s in selections) <= most:
        return list(selections)
    kept, parts = determined_parts(source, selections)
    if sum(len(s.rows) for s in kept) <= most:
        return kept
    at = geocentric_to_geodetic(np.concatenate([part.origin for part in parts]), source.cover.ellipsoid)
    variance = np.concatenate([np.trace(part.factors.own, axis1=1, axis2=2) for part in parts])
    ids = np.concatenate([s.cell.point_ids[s.rows] for s in kept])
    chosen = spread_rows(np.stack(source.cover.plane(at[:, 0], at[:, 1]), axis=1), variance, ids, most)
    ends = np.cumsum([len(s.rows) for s in kept])
    found = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
    spread = [Selection(s.cell, s.rows[rows - end + len(s.rows)]) for s, rows, end in zip(kept, found, ends, strict=True)]
    return [s for s in spread if len(s.rows)]


def check_policy(policy: str) -> None:
    """Raise `QueryError` for a policy that is unknown."""
    if policy != "auto" and policy not in POLICIES:
        raise QueryError(f"policy is {policy!r}; expected one of auto, {', '.join(POLICIES)}")


def answer(source: NetworkSource, selections: Sequence[Selection], policy: str, tile_number: int | None = None) -> Answer:
    """Answer for the selected points by a policy.

    ``tile_number`` fixes the tile of policy ``tile``. Points whose rays determine no position are left out.

    Raises
    ------
    QueryError
        When the policy is unknown, or ``tile`` is asked of points that no one tile holds.
    """
    check_policy(policy)
    kept, parts = determined_parts(source, selections)
    if not parts:
        none = np.empty(0, dtype=np.int64)
        return Answer(
            np.empty(0, dtype="U1"), np.empty((0, 3)), np.empty((0, 0)), none, none, "tile" if policy == "auto" else policy, (),
            np.empty(0, dtype=np.int32), True,
        )  # fmt: skip
    policy, tiles = choose(source, kept, policy, tile_number)
    images = np.unique(np.concatenate([part.linear.image for part in parts])).astype(np.int32)
    ids = np.concatenate([s.cell.point_ids[s.rows] for s in kept])
    order = np.argsort(ids, kind="stable")
    axes = (3 * order[:, None] + np.arange(3)).ravel()  # sorted before the joint matrix is formed, which is never copied
    own = np.concatenate([part.factors.own for part in parts])[order]
    state: SubMin | CombinedState | None = None
    if policy == "rigorous" and 3 * len(ids) < len(images) * parts[0].factors.loading.shape[2]:
        loading = loadings(parts, images, parts[0].factors.loading.shape[2])[axes]
        state = source.combined_with_outside(tiles, images, loading)
    if state is None:
        state = POLICIES[policy](source, tiles, images, parts)
        covariance = joint_covariance(loadings(parts, state.images, state.theta.shape[1])[axes], own, state.covariance)
        behind = state.images if state.behind is None else state.behind
    else:
        covariance, behind = with_own_parts(state.covariance, own), state.images
    return Answer(
        ids[order],
        np.concatenate([locate(part, state) for part in parts])[order],
        covariance,
        np.concatenate([np.full(len(s.rows), source.cover.owner(s.cell.number)) for s in kept])[order],
        np.concatenate([ray_counts(s.cell)[s.rows] for s in kept])[order],
        policy, tuple(tiles), behind,
        state.whole or (policy in ("tile", "rigorous") and hold_all(source, tiles)),
    )  # fmt: skip


def choose(source: NetworkSource, selections: Sequence[Selection], policy: str, tile_number: int | None) -> tuple[str, list[int]]:
    """The policy to use and the tiles concerned."""
    cover = source.cover
    cells = [s.cell.number for s in selections]
    if tile_number is not None:
        if policy not in ("tile", "auto"):
            raise QueryError(f"a tile is named, but policy {policy!r} merges several; use policy 'tile' or leave the tile out")
        return "tile", [tile_number]
    all_hold = set.intersection(*(set(cover.holders(cell)) for cell in cells))
    if policy in ("tile", "auto") and all_hold:
        at = np.concatenate([s.cell.linearised_at[s.rows] for s in selections])
        geodetic = geocentric_to_geodetic(at, cover.ellipsoid)
        depth = {t: float(cover.depth(t, geodetic[:, 0], geodetic[:, 1]).min()) for t in all_hold}
        owned = Counter[int]()
        for s in selections:
            owned[cover.owner(s.cell.number)] += len(s.rows)
        # the tile whose core holds most of the query; ties to the largest interior depth
        best = max(sorted(all_hold), key=lambda t: (owned[t], depth[t]))
        return "tile", [best]
    if policy == "tile":
        raise QueryError("no one tile holds all queried points; use policy 'rigorous' or 'auto', a smaller area, or name a tile")
    return ("rigorous" if policy == "auto" else policy), sorted({t for cell in cells for t in cover.holders(cell)})


def hold_all(source: NetworkSource, tiles: Sequence[int]) -> bool:
    """Whether some tiles together hold every cell of the network."""
    cover = source.cover
    held = {cell for tile in tiles for cell in cover.cells_held(tile)}
    around = sorted({other for tile in tiles for other in cover.neighbours(tile)} - set(tiles))
    # a cell of one neighbour is proof enough, mostly; only without one must all cells be listed
    if any(source.existing([cell for cell in cover.cells_owned(other) if cell not in held]) for other in around):
        return False
    return held.issuperset(source.cell_numbers())


def determined_parts(source: NetworkSource, selections: Sequence[Selection]) -> tuple[list[Selection], list[GroundPart]]:
    """Those of some points that are determined, and their ground parts; cells without any are left out."""
    rows = np.unique(np.concatenate([np.empty(0, dtype=np.int32), *(s.cell.images for s in selections)]))
    return ground_parts(selections, rows, source.image_set(rows))


def ground_parts(selections: Sequence[Selection], rows: Index, images: ImageSet) -> tuple[list[Selection], list[GroundPart]]:
    """As `determined_parts`; ``images`` are those of the selections' cells, ``rows`` (ascending) theirs in the network."""
    both = [ground_part(s, images.take(np.searchsorted(rows, s.cell.images))) for s in selections]
    return [kept for kept, _ in both if len(kept.rows)], [part for kept, part in both if len(kept.rows)]


def ground_part(selection: Selection, images: ImageSet) -> tuple[Selection, GroundPart]:
    """Own parts and loadings of the selected points; those of deficient rank are left out. ``images`` are those of the cell."""
    cell = selection.cell
    linear, point_factors = factors(cell, images, selection.rows)
    good = determined_by(point_factors)
    if not good.all():
        return ground_part(Selection(cell, selection.rows[good]), images)
    return selection, GroundPart(cell.origin[selection.rows], replace(linear, image=cell.images[linear.image]), point_factors)


def determined_by(point_factors: PointFactors) -> NDArray[np.bool_]:
    """True (n,) for points that their rays determine well enough to be reported as control points."""
    own = np.trace(point_factors.own, axis1=1, axis2=2)
    return np.asarray((point_factors.rank == 3) & (np.where(point_factors.rank == 3, own, np.inf) < DETERMINED_METRES**2))


def ray_counts(cell: Cell) -> Rows:
    """Accepted rays (n,) of each of the cell's points."""
    return np.bincount(cell.rays.point[cell.rays.accepted], minlength=len(cell))


def _wanted(cell: Cell, every: bool) -> NDArray[np.bool_]:
    return ray_counts(cell) >= (0 if every else 2)
