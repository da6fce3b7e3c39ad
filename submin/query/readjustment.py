"""MIN++: cameras of images that a network has fused, from its final points (Dolloff et al. 2010, appendix A; docs/stage-1.md).

Images are taken together that the a priori model couples: those of a block, and blocks of one pass. Their rays are read from the
cells of their points, and the points' joint covariance from the tiles that hold these cells, so that no more is in memory than a query of
the same points needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from submin.adjustment.control import ControlledPrior, covariance_factor, estimate
from submin.adjustment.elimination import LinearRays
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import ImagePrior
from submin.adjustment.resection import resect
from submin.network.cell import factors
from submin.network.sub_min import GroundPart, SubMin, loadings, locate
from submin.query.planner import POLICIES, Selection, check_policy, choose
from submin.query.source import Index, NetworkSource

Array = NDArray[np.float64]
Ids = NDArray[np.str_]


@dataclass(frozen=True)
class Readjusted:
    """Cameras of some images of a network.

    Attributes
    ----------
    rows : (m,) of the network's images, ascending; images : the same
    theta : (m, p) corrections; covariance : (m p, m p)
    points : (n,) ids of the network's points that the images see, in the order of ``gain``
    gain : (m p, 3n) G: the covariance of corrections and points is ``G P[points, :]``; None when it was de-weighted
    rays : (m,) accepted rays
    policy, tiles : that the points come from
    """

    rows: Index
    images: ImageSet
    theta: Array
    covariance: Array
    points: Ids
    gain: Array | None
    rays: NDArray[np.int64]
    policy: str
    tiles: tuple[int, ...]


def coupled_images(priors: Sequence[ImagePrior], usable: NDArray[np.bool_]) -> list[Index]:
    """Groups of rows of images whose a priori models are coupled, by a block or by a part common to a pass, in the order of their first.

    ``usable`` (m,) is False for images that are to be in no group.
    """
    m = len(priors)
    names: dict[tuple[str, str], int] = {}
    links: list[tuple[int, int]] = []
    for i in np.flatnonzero(usable).tolist():
        keys = [("block", priors[i].block_id)]
        keys += [("pass", priors[i].pass_id)] if priors[i].shares_errors else []
        links += [(i, m + names.setdefault(key, len(names))) for key in keys]
    graph = sp.coo_array((np.ones(len(links)), tuple(np.array(links, dtype=np.int64).reshape(-1, 2).T)), shape=(m + len(names),) * 2)
    _, label = connected_components(graph, directed=False)
    groups: dict[int, list[int]] = {}
    for i in np.flatnonzero(usable).tolist():
        groups.setdefault(int(label[i]), []).append(i)
    return [np.array(members, dtype=np.int32) for members in groups.values()]


def readjust(
    source: NetworkSource, groups: Sequence[Index], cells_of: Mapping[int, Sequence[int]], policy: str, deweight: float | None = None
) -> Iterator[Readjusted]:
    """Readjust groups of images (rows of the network, ascending); groups whose points lie in the same tiles one after another.

    Parameters
    ----------
    cells_of : cells in which each image has rays
    policy : that gives the points, see `submin.query.planner`
    deweight : instead of the rigorous form: the images' a priori covariance times its square, and the network's points as control
        of their covariance, as if the images' rays had not made them (for comparison; not consistent)

    Raises
    ------
    QueryError
        When the policy is unknown, or ``tile`` is asked of points that no one tile holds.
    """
    check_policy(policy)
    prepared = [(rows, sorted({cell for row in rows.tolist() for cell in cells_of.get(row, ())})) for rows in groups]
    for rows, cells in sorted(prepared, key=lambda group: group[1]):
        yield _readjusted(source, rows, cells, policy, deweight)


def _readjusted(source: NetworkSource, rows: Index, cells: Sequence[int], policy: str, deweight: float | None) -> Readjusted:
    images = source.image_set(rows)
    gathered = [part for part in (_part(source, number, rows) for number in cells) if part is not None]
    if not gathered:  # no ray was accepted: the images are where their a priori model has them
        shape, prior = (len(rows), images.parameters), images.prior
        none = np.zeros(len(rows), dtype=np.int64)
        return Readjusted(rows, images, np.zeros(shape), (prior @ prior.T).toarray(), np.empty(0, dtype="U1"), None, none, policy, ())
    chosen, tiles = choose(source, [g.selection for g in gathered], policy, None)
    parts = [g.part for g in gathered]
    seen = np.unique(np.concatenate([rows, *(part.linear.image for part in parts)])).astype(np.int32)
    state = POLICIES[chosen](source, tiles, seen, parts)
    seen = state.images
    linear, held, correction = _rays_of(gathered, rows, state)
    weight, p = np.ones(len(linear.y)), images.parameters
    own = np.where(held[:, None, None], np.concatenate([part.factors.own for part in parts]), 0.0)
    loading = loadings(parts, seen, p)
    ids = np.concatenate([g.selection.cell.point_ids[g.selection.rows] for g in gathered])
    rays = np.bincount(linear.image, minlength=len(rows))
    if deweight is None:
        found = resect(linear, weight, held, correction, images.prior, p)
        covariance = found.total_covariance(loading, own, state.covariance)
        return Readjusted(rows, images, found.theta, covariance, ids, found.gain.toarray(), rays, chosen, tuple(tiles))
    theta, covariance = _deweighted(linear, weight, held, correction, own[held], loading, state, deweight * images.prior, p)
    return Readjusted(rows, images, theta, covariance, ids, None, rays, chosen, tuple(tiles))


@dataclass(frozen=True)
class _Gathered:
    """The points of one cell that some images see: with all their rays, and which of these are the images' own and accepted."""

    selection: Selection
    part: GroundPart
    own_rays: NDArray[np.bool_]


def _part(source: NetworkSource, number: int, rows: Index) -> _Gathered | None:
    cell = source.cell(number)
    mine = np.isin(cell.images, rows)[cell.rays.image] & cell.rays.accepted
    points = np.unique(cell.rays.point[mine]).astype(np.int64)
    if not len(points):
        return None
    linear, found = factors(cell, source.image_set(cell.images), points)
    linear = replace(linear, image=cell.images[linear.image])
    return _Gathered(Selection(cell, points), GroundPart(cell.origin[points], linear, found), mine[np.isin(cell.rays.point, points)])


def _rays_of(gathered: Sequence[_Gathered], rows: Index, state: SubMin) -> tuple[LinearRays, NDArray[np.bool_], Array]:
    """The images' own rays on all points gathered, which points are held (n,), and where the network has them: ``x - x0`` (n, 3)."""
    every, own_rays = [g.part.linear for g in gathered], np.concatenate([g.own_rays for g in gathered])
    count = np.concatenate([np.diff(linear.first) for linear in every])
    own_count = np.bincount(np.repeat(np.arange(len(count)), count)[own_rays], minlength=len(count))
    image, by_ground, by_parameters, y = (
        np.concatenate([getattr(linear, name) for linear in every])[own_rays] for name in ("image", "by_ground", "by_parameters", "y")
    )
    linear = LinearRays(np.cumsum([0, *own_count]), np.searchsorted(rows, image).astype(np.int32), by_ground, by_parameters, y)
    held = np.concatenate([g.part.factors.rank == 3 for g in gathered])
    return linear, held, np.concatenate([locate(g.part, state) - g.part.origin for g in gathered])


def _deweighted(
    linear: LinearRays, weight: Array, held: NDArray[np.bool_], correction: Array, own: Array, loading: sp.csr_array,
    state: SubMin, prior: sp.csr_array, parameters: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Corrections and covariance with the points held as control of their covariance, and an a priori factor of the images."""
    on_points = np.asarray(loading @ covariance_factor(state.covariance)).reshape(len(held), 3, -1)[held]
    k, q = len(on_points), prior.shape[1]
    known = ControlledPrior(
        np.flatnonzero(held), correction[held], own,
        np.concatenate([np.zeros((k, 3, q)), on_points], axis=2),
        np.zeros((prior.shape[0] // parameters, parameters)),
        np.concatenate([prior.toarray(), np.zeros((prior.shape[0], on_points.shape[2]))], axis=1),
    )  # fmt: skip
    origin = np.where(held[:, None], correction, 0.0)  # about the points' x0
    point = np.repeat(np.arange(len(held)), np.diff(linear.first))
    about = replace(linear, y=linear.y - np.einsum("rck,rk->rc", linear.by_ground, origin[point]))
    found = estimate(about, weight, known, np.ones(k, dtype=np.bool_), origin)
    return found.theta, found.covariance
