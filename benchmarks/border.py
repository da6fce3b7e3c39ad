"""Points about the border of two tiles: what each policy answers, what is true of the answer, and what the monolithic network says."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.linear_estimates import MERGED, LinearEstimate, alone, cross_covariance
from submin.accuracy import ce90, le90
from submin.geodesy import geocentric_to_geodetic, local_axes, rotate_covariance
from submin.network.sub_min import GroundPart, SubMin, covariances_of, joint_covariance, loadings, locate
from submin.query import rigorous
from submin.query.control_set import ControlSet
from submin.query.padded_tiles import PaddedTiles, padded_tiles
from submin.query.planner import Selection, all_points, determined_parts
from submin.query.source import existing_cells
from submin.query.tile import tile_state
from submin.storage.network import Network
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Ids = NDArray[np.str_]
Rows = NDArray[np.int64]

TILE, RIGOROUS, RECONCILED = "tile", "rigorous", "rigorous, reconciled"
SAME_CLAIM = 1e-6
"""A policy's covariance and the one whose truth is computed differ by no more than this part of the sigmas."""


class Border(NamedTuple):
    """Where the cores of two tiles meet: a line at ``at``, from ``low`` to ``high`` along it, metres in the plane.

    Attributes
    ----------
    one, other : tiles west and east of a line of constant easting (``axis`` 0), or south and north of one of constant northing (1)
    """

    one: int
    other: int
    axis: int
    at: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Question:
    """Points about a border that nobody but its two tiles holds, ordered by id.

    Attributes
    ----------
    parts : their ground parts; axes : (3n,) rows of the points' coordinates, as the parts have them
    own : (n, 3, 3) D; owner : (n,) tile; shared : (n,) True where both tiles hold the point
    offset : (n,) metres from the border, positive on the side of the other tile
    pairs : (k, 2) points nearer to each other than asked for
    """

    border: Border
    ids: Ids
    parts: tuple[GroundPart, ...]
    axes: Rows
    own: Array
    owner: Rows
    shared: Flags
    offset: Array
    pairs: Rows

    @property
    def straddling(self) -> Flags:
        """True (k,) for the pairs on both sides of the border."""
        return np.asarray(self.owner[self.pairs[:, 0]] != self.owner[self.pairs[:, 1]])

    def positions(self, state: SubMin) -> Array:
        """Geocentric positions (n, 3) by an estimate of the images."""
        return np.concatenate([locate(part, state) for part in self.parts])[self.axes[::3] // 3]

    def joint(self, state: SubMin) -> Array:
        """Joint covariance (3n, 3n) by an estimate of the images."""
        return joint_covariance(loadings(self.parts, state.images, state.theta.shape[1])[self.axes], self.own, state.covariance)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a policy answers, and the true covariance of its error.

    Attributes
    ----------
    geocentric : (n, 3); reported, true : (3n, 3n)
    seconds : that it took, NaN where nobody was asked
    stated : (g, n) points for which the covariance is stated jointly; between groups ``reported`` is zero, and nothing is said
    """

    geocentric: Array
    reported: Array
    true: Array
    seconds: float
    stated: Flags


def borders(cover: Cover) -> list[Border]:
    """All borders of the tiles of the area."""
    bounds = {tile: (*cover.core_outline(tile).min(axis=0), *cover.core_outline(tile).max(axis=0)) for tile in cover.tiles()}
    found = []
    for one, (west, south, east, north) in bounds.items():
        for other, (w, s, e, n) in bounds.items():
            if np.isclose(east, w) and min(north, n) > max(south, s):
                found.append(Border(one, other, 0, float(w), float(max(south, s)), float(min(north, n))))
            if np.isclose(north, s) and min(east, e) > max(west, w):
                found.append(Border(one, other, 1, float(s), float(max(west, w)), float(min(east, e))))
    return found


def monolithic(network: Network) -> SubMin:
    """A posteriori state of all images from every cell, each once."""
    return rigorous.estimate(network, list(network.cover.tiles()), np.empty(0, dtype=np.int32), ())


def question(network: Network, border: Border, reach: float, ends: float, near: float) -> Question | None:
    """Points no farther than ``reach`` from a border, without its ends of so many metres, and pairs nearer than ``near``; or None."""
    cover, tiles, selections = network.cover, {border.one, border.other}, []
    for selection in all_points(network):
        number = selection.cell.number
        if not tiles.issuperset(cover.holders(number)):
            continue
        plane = _plane(cover, selection.cell.origin[selection.rows])
        along = plane[:, 1 - border.axis]
        chosen = (np.abs(plane[:, border.axis] - border.at) <= reach) & (along >= border.low + ends) & (along <= border.high - ends)
        if chosen.any():
            selections.append(Selection(selection.cell, selection.rows[chosen]))
    kept, parts = determined_parts(network, selections)
    if not kept:
        return None
    ids = np.concatenate([s.cell.point_ids[s.rows] for s in kept])
    order = np.argsort(ids)
    origin = np.concatenate([part.origin for part in parts])[order]
    pairs = cKDTree(origin).query_pairs(near, output_type="ndarray").astype(np.int64)
    owner = np.concatenate([np.full(len(s.rows), cover.owner(s.cell.number)) for s in kept])[order]
    asked = Question(
        border, ids[order], tuple(parts), (3 * order[:, None] + np.arange(3)).ravel(),
        np.concatenate([part.factors.own for part in parts])[order], owner,
        np.concatenate([np.full(len(s.rows), len(cover.holders(s.cell.number)) == 2) for s in kept])[order],
        _plane(cover, origin)[:, border.axis] - border.at, pairs,
    )  # fmt: skip
    return asked if asked.straddling.any() and not asked.straddling.all() else None


def answers(network: Network, reconciled: Network, asked: Question, whole: SubMin) -> Iterator[tuple[str, Answer]]:
    """The answer of every policy, by its name; the monolithic network first, those of the reconciled network last.

    Raises
    ------
    RuntimeError
        When a policy claims another covariance than the estimate whose truth is computed.
    """
    border = asked.border
    joint, every = asked.joint(whole), np.ones((1, len(asked.ids)), dtype=np.bool_)
    yield "monolithic", Answer(asked.positions(whole), joint, joint, float("nan"), every)
    padded = padded_tiles(network, (border.one, border.other))
    seen = (loadings(asked.parts, padded.rows, padded.images.parameters) @ padded.prior).toarray()[asked.axes]
    yield TILE, _tile_by_tile(network, asked, padded, seen)
    functionals = seen.T @ seen
    for policy, merge in MERGED.items():
        estimate = merge(padded, functionals)
        claimed, true = (_of_points(asked, seen, u) for u in (estimate.claimed, cross_covariance(padded, estimate, estimate)))
        if policy == "naive":
            yield policy, Answer(asked.positions(_state(padded, estimate)), claimed, true, float("nan"), every)
            continue
        control, seconds = timed(lambda policy=policy: network.query(points=asked.ids, policy=policy))  # type: ignore[misc]
        sigma = np.sqrt(np.diagonal(claimed))
        if (np.abs(control.covariance - claimed) > SAME_CLAIM * sigma * sigma[:, None]).any():
            raise RuntimeError(f"policy {policy}: its covariance is not that of the estimate whose truth is computed")
        yield policy, Answer(control.geocentric, control.covariance, true, seconds, every)
    control, seconds = timed(lambda: reconciled.query(points=asked.ids, policy=RIGOROUS))
    yield RECONCILED, Answer(control.geocentric, control.covariance, joint, seconds, every)


def steps(network: Network, asked: Question, policy: str) -> tuple[Array, Array]:
    """Differences (k, 3) of the two neighbours' answers for the points that both hold, and the covariance (k, 3, 3) that the first states.

    By ``tile`` each answers alone; by other policies each is asked for all points that it holds here.
    """
    shared = asked.ids[asked.shared]
    sides = [asked.shared | (asked.owner == tile) for tile in (asked.border.one, asked.border.other)]
    if policy == TILE:
        one, other = (network.query(points=shared, tile=network.cover.tile_name(t)) for t in (asked.border.one, asked.border.other))
    else:
        one, other = (network.query(points=asked.ids[side], policy=policy) for side in sides)
        one, other = (control.subset(np.isin(control.ids, shared)) for control in (one, other))
    return one.geocentric - other.geocentric, one.point_covariance


def timed(work: Callable[[], ControlSet]) -> tuple[ControlSet, float]:
    """What some work gives, and the seconds that it takes."""
    started = time.perf_counter()
    done = work()
    return done, time.perf_counter() - started


def _tile_by_tile(network: Network, asked: Question, padded: PaddedTiles, seen: Array) -> Answer:
    """Each point by its owner alone; the two tiles' answers together as a user has them: nothing is stated between them."""
    size = len(seen)
    true, reported, geocentric, seconds = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size // 3, 3)), 0.0
    rows, estimates = [], []
    for place, tile in enumerate((asked.border.one, asked.border.other)):
        mine = asked.owner == tile
        rows.append(np.flatnonzero(mine.repeat(3)))
        estimates.append(alone(padded, place))
        control, took = timed(lambda m=mine, t=tile: network.query(points=asked.ids[m], tile=network.cover.tile_name(t)))  # type: ignore[misc]
        reported[np.ix_(rows[place], rows[place])] = control.covariance
        geocentric[mine], seconds = control.geocentric, seconds + took
    for s in range(2):
        for t in range(2):
            u = cross_covariance(padded, estimates[s], estimates[t])
            true[np.ix_(rows[s], rows[t])] = seen[rows[s]] @ u @ seen[rows[t]].T
    _add_own(true, asked.own)
    return Answer(geocentric, reported, true, seconds, np.stack([asked.owner == border for border in asked.border[:2]]))


def _state(padded: PaddedTiles, estimate: LinearEstimate) -> SubMin:
    """The images by an estimate of u; what it claims of them is not needed."""
    theta = np.asarray(padded.prior @ estimate.solution(padded)).reshape(len(padded.rows), -1)
    return SubMin(padded.rows, theta, np.empty((0, 0)), float("nan"), 0)


def _of_points(asked: Question, seen: Array, u: Array) -> Array:
    """``D + F u F'`` (3n, 3n)."""
    covariance = seen @ u @ seen.T
    _add_own(covariance, asked.own)
    return np.asarray(0.5 * (covariance + covariance.T))


def _add_own(covariance: Array, own: Array) -> None:
    n = np.arange(len(own))
    covariance.reshape(len(own), 3, len(own), 3)[n, :, n, :] += own


def _plane(cover: Cover, geocentric: Array) -> Array:
    """Easting and northing (n, 2), metres."""
    at = geocentric_to_geodetic(geocentric, cover.ellipsoid)
    return np.stack(cover.plane(at[:, 0], at[:, 1]), axis=1)


def relative(covariance: Array, pairs: Rows) -> Array:
    """Covariance (k, 3, 3) of the vectors between the points of some pairs, from a joint covariance (3n, 3n)."""
    n = len(covariance) // 3
    blocks = covariance.reshape(n, 3, n, 3)
    i, j = pairs.T
    return np.asarray(blocks[i, :, i, :] + blocks[j, :, j, :] - blocks[i, :, j, :] - blocks[j, :, i, :])


def own_blocks(covariance: Array) -> Array:
    """Covariances (n, 3, 3) of the points of a joint covariance."""
    n = np.arange(len(covariance) // 3)
    return np.asarray(covariance.reshape(len(n), 3, len(n), 3)[n, :, n, :])


def radii(covariance: Array, geocentric: Array) -> tuple[Array, Array]:
    """CE90 and LE90 (n,) of covariances (n, 3, 3) in geocentric axes, at places (n, 3)."""
    local = rotate_covariance(covariance, local_axes(geocentric_to_geodetic(geocentric)))
    return ce90(local[:, :2, :2]), le90(local[:, 2, 2])


def largest_eigenvalue(true: Array, reported: Array) -> float:
    """Largest true over reported variance of any function of the points: at most 1 where the report is consistent."""
    last = len(true) - 1
    return float(la.eigh(true, reported, eigvals_only=True, subset_by_index=[last, last])[0])


@dataclass(frozen=True, eq=False)
class Sheets:
    """Answers for all points, tile by tile: each tile alone, or merged rigorously with the tiles that hold some of its points.

    Attributes
    ----------
    ids : (n,) points that the tile holds; owned : (n,) True where its core does
    geocentric : (n, 3); covariance : (n, 3, 3); whole, of_whole : the same of the monolithic network
    """

    tile: int
    ids: Ids
    owned: Flags
    geocentric: Array
    covariance: Array
    whole: Array
    of_whole: Array


def sheets(network: Network, whole: SubMin, policy: str) -> Iterator[Sheets]:
    """All tiles with points, by policy ``tile`` or ``rigorous``; of a reconciled network a tile alone comes with what lies outside."""
    cover, everything = network.cover, all_points(network)
    for tile in cover.tiles():
        held = set(existing_cells(network, [tile]))
        kept, parts = determined_parts(network, [s for s in everything if s.cell.number in held])
        if not parts:
            continue
        if policy == TILE:
            state = tile_state(network, tile, np.unique(np.concatenate([part.linear.image for part in parts])).astype(np.int32))
        else:
            concerned: Sequence[int] = sorted({t for s in kept for t in cover.holders(s.cell.number)})
            state = rigorous.estimate(network, concerned, np.empty(0, dtype=np.int32), parts)
        by_state = [
            (np.concatenate([locate(part, s) for part in parts]), np.concatenate([covariances_of(part, s) for part in parts]))
            for s in (state, whole)
        ]
        yield Sheets(
            tile, np.concatenate([s.cell.point_ids[s.rows] for s in kept]),
            np.concatenate([np.full(len(s.rows), cover.owner(s.cell.number) == tile) for s in kept]), *by_state[0], *by_state[1],
        )  # fmt: skip
