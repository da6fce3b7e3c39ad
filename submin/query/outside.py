"""What tiles say with all that lies outside of them: the marginal of the whole network as it was reconciled, and what has come since.

A reconciled tile keeps the posterior state (u, P) of the whitened vectors that it holds, of some version v. With the same vectors before
and behind it (`submin.network.whitened_vectors`), what changed in the cells that it holds is added:

    P' = L (I + L' J L)^-1 L',   u' = u + P' (r - J u),   P = L L',   J = K' (S_now - S_v) K,   r = K' (h_now - h_v)

A state is not used once something that it counts is gone: a tile outside has lost a ray since v, or a prior has changed (decision 014;
docs/mathematics.md, "Outside messages").
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.estimation import cholesky
from submin.adjustment.symmetric import between, fill_symmetric
from submin.network.cell import kept_rows
from submin.network.outside_messages import Elimination, carried, carried_together
from submin.network.sub_min import CombinedState, SubMin, add_sums
from submin.network.whitened_vectors import Vectors, first_rows
from submin.query.source import NetworkSource

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Names = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TileState:
    """The state of a tile, but for its covariance: its place in its tree, its vectors and their mean (q,)."""

    tree: str
    node: int
    vectors: Vectors
    mean: Array


@dataclass(frozen=True, eq=False)
class TreeState:
    """A reconciled part of the network.

    Attributes
    ----------
    version : of the states; images : number of images that the network had then
    members : rows of the images that the part sees, ascending; released : those of them whose prior was released
    tiles : of the part; parents : place of each node's parent, -1 for the root
    shared : names of vectors of passes and sets, ascending; holder : a tile that holds each
    chi_square, redundancy : of the whole part
    """

    version: int
    images: int
    members: NDArray[np.int64]
    released: frozenset[int]
    tiles: frozenset[int]
    parents: tuple[int, ...]
    shared: Names
    holder: NDArray[np.int64]
    chi_square: float
    redundancy: int


class Reconciled(Protocol):
    """What a version of a network keeps of its last reconciliations."""

    @property
    def released(self) -> frozenset[int]:
        """Rows of the images whose prior is released now."""
        ...

    @property
    def changed(self) -> Mapping[int, int]:
        """Version in which the own cells of each tile changed last."""
        ...

    def gone(self, tiles: Collection[int]) -> int:
        """The last version in which something went that the states of some tiles counted."""
        ...

    def tile(self, tile: int) -> TileState | None:
        """The state of a tile, None where it has none."""
        ...

    def tree(self, name: str) -> TreeState:
        """A part of the network."""
        ...

    def covariance(self, tile: int, columns: NDArray[np.int64]) -> Array:
        """Covariance (k, k) of some of the tile's vectors (columns, ascending), both triangles."""
        ...

    def elimination(self, tree: str, node: int) -> Elimination:
        """What was eliminated at a node."""
        ...

    def earlier(self, version: int) -> NetworkSource:
        """The network as it was at a version, as many parameters an image as now."""
        ...

    def vectors(self, images: Index) -> Vectors:
        """The whitened vectors of images of the present version."""
        ...


@dataclass(frozen=True, eq=False)
class WhitenedState:
    """Joint state of vectors: names (q,) ascending, mean (q,), covariance (q, q), both triangles."""

    names: Names
    mean: Array
    covariance: Array
    chi_square: float
    redundancy: int


@dataclass(frozen=True, eq=False)
class Functionals:
    """Combinations of a tile's vectors: weights (n, k) of its columns (k,), ascending."""

    tile: int
    columns: NDArray[np.int64]
    weights: sp.csr_array


@dataclass(frozen=True, eq=False)
class UnionState:
    """State of all images that some tiles see, beside what it depends on."""

    images: Index
    prior: sp.csr_array
    state: WhitenedState


def tiles_with_outside(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], images: Index, memory: dict[tuple[int, ...], UnionState]
) -> SubMin | None:
    """A posteriori state of ``images`` from some tiles and all that lies outside of them; None where that is not known any more.

    ``memory`` keeps what tiles say together with what has come since they were reconciled.
    """
    known = _known(kept, tiles)
    if known is None:
        return None
    states, trees = known
    p = source.image_set(images[:1]).parameters
    if _unchanged(source, kept, tiles, states, trees):
        return _as_reconciled(kept, tiles, states, trees, images, p)
    key = tuple(sorted(tiles))
    if key not in memory:
        union = _with_increments(source, kept, tiles, states, trees, p)
        if union is None:
            return None
        memory.clear()
        memory[key] = union
    union = memory[key]
    at = np.searchsorted(union.images, images)
    if (at >= len(union.images)).any() or (union.images[at] != images).any():
        return None
    k = union.prior[_rows_of(at, p)]
    state = union.state
    return SubMin(
        images, np.asarray(k @ state.mean).reshape(-1, p), between(k, state.covariance), state.chi_square, state.redundancy, whole=False
    )


def _known(kept: Reconciled, tiles: Sequence[int]) -> tuple[list[TileState], dict[str, TreeState]] | None:
    """The states of some tiles, and the parts of the network that they are of.

    None where a tile has none, or where one counts something that is no more.
    """
    states = [state for state in (kept.tile(tile) for tile in tiles) if state is not None]
    if not tiles or len(states) < len(tiles):
        return None
    trees = {name: kept.tree(name) for name in {state.tree for state in states}}
    return None if any(_stale(tree, kept, tiles) for tree in trees.values()) else (states, trees)


def _unchanged(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState]
) -> bool:
    """True when nothing has come to the cells of some tiles since they were reconciled."""
    return not any(_changed_owners(source, kept, tile, trees[state.tree].version) for tile, state in zip(tiles, states, strict=True))


def _nothing_since(kept: Reconciled, trees: Mapping[str, TreeState]) -> bool:
    """True when nothing has come to any tile of these parts of the network since they were reconciled."""
    return all(kept.changed.get(tile, 0) <= tree.version for tree in trees.values() for tile in tree.tiles)


def _rows_of(images: NDArray[np.integer], parameters: int) -> NDArray[np.int64]:
    """Rows (m p,) of the parameters of images at these places."""
    return np.asarray((images.astype(np.int64)[:, None] * parameters + np.arange(parameters)).ravel())


def _stale(tree: TreeState, kept: Reconciled, tiles: Sequence[int]) -> bool:
    """True when the states of a part count something that is no more, outside of some tiles."""
    return other_priors(tree, kept.released) or kept.gone(tiles) > tree.version


def other_priors(tree: TreeState, released: frozenset[int]) -> bool:
    """True when the prior of an image of a part has been released since, or is in use again."""
    now = np.array(sorted(released), dtype=np.int64)
    return set(now[np.isin(now, tree.members)].tolist()) != tree.released


def _changed_owners(source: NetworkSource, kept: Reconciled, tile: int, version: int) -> bool:
    owners = {source.cover.owner(cell) for cell in source.cover.cells_held(tile)}
    return any(kept.changed.get(owner, 0) > version for owner in owners)


def _as_reconciled(
    kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState], images: Index, parameters: int,
) -> SubMin | None:  # fmt: skip
    """Images as the states of some tiles have them; one tile alone where it sees them all."""
    chosen = _first_to_see(states, images)
    if chosen is None:
        return None
    parts, order = [], []
    for k, rows in chosen:
        columns, prior = states[k].vectors.seen(images[rows])
        parts.append(Functionals(tiles[k], columns, _widened(prior, len(rows), parameters)))
        order.append(_rows_of(rows, parameters))
    mean, covariance = joint(kept, parts)
    if len(parts) > 1:  # of one tile they are in order
        place = np.argsort(np.concatenate(order))
        mean, covariance = mean[place], covariance[np.ix_(place, place)]
    chi_square = sum(tree.chi_square for tree in trees.values())
    redundancy = sum(tree.redundancy for tree in trees.values())
    return SubMin(
        images, mean.reshape(-1, parameters), covariance, chi_square, redundancy, whole=_nothing_since(kept, trees)
    )  # fmt: skip


def _first_to_see(states: Sequence[TileState], images: Index) -> list[tuple[int, NDArray[np.int64]]] | None:
    """For some of the states the places of the images that are taken from each, of one alone where it sees them all.

    None where an image is seen by none.
    """
    sees = [np.isin(images, state.vectors.images) for state in states]
    if len(images) and not np.any(sees, axis=0).all():
        return None
    alone = [k for k, seen in enumerate(sees) if seen.all()]
    of_image = np.full(len(images), alone[0]) if alone else np.argmax(sees, axis=0)
    return [(int(k), np.flatnonzero(of_image == k)) for k in np.unique(of_image)]


def combined_with_outside(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], images: Index, loading: sp.csr_array
) -> CombinedState | None:
    """What ``loading`` (n, m p) makes of the m ``images``, from some tiles and all that lies outside of them.

    Few combinations of many images, as coordinates of points are, cost less to carry up the tree than all parameters of the images.
    None where one tile sees all images or something has come since they were reconciled (see `tiles_with_outside`), or nobody can tell.
    """
    known = _known(kept, tiles)
    if known is None or not _unchanged(source, kept, tiles, *known):
        return None
    states, trees = known
    chosen, p = _first_to_see(states, images), source.image_set(images[:1]).parameters
    if chosen is None or len(chosen) < 2:
        return None
    parts, theta = [], np.zeros((len(images), p))
    for k, rows in chosen:
        columns, prior = states[k].vectors.seen(images[rows])
        wide = _widened(prior, len(rows), p)
        theta[rows] = np.asarray(wide @ states[k].mean[columns]).reshape(-1, p)
        of_images = loading[:, _rows_of(rows, p)]
        concerned = np.flatnonzero(np.diff(of_images.indptr))
        parts.append((Functionals(tiles[k], columns, sp.csr_array(of_images[concerned] @ wide)), concerned))
    return CombinedState(images, theta, _summed_noise(kept, parts, loading.shape[0]), _nothing_since(kept, trees))


def _widened(prior: sp.csr_array, images: int, parameters: int) -> sp.csr_array:
    """K of some images with so many parameters each; what is added is zero."""
    old = prior.shape[0] // max(images, 1)
    if not images or old == parameters:
        return prior
    place = sp.csr_array(
        (np.ones(images * old), (kept_rows(images, old, parameters), np.arange(images * old))), shape=(images * parameters, images * old)
    )
    return sp.csr_array(place @ prior)


def joint(kept: Reconciled, parts: Sequence[Functionals]) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n), both triangles, of combinations of the vectors of several tiles.

    Of one tile they come from its own state. Those of two are carried up the tree: what they have in common is the noise of the nodes on
    both ways to the root. Different parts of the network are independent.
    """
    if len(parts) == 1:  # a large matrix is made once
        (part,), state = parts, kept.tile(parts[0].tile)
        assert state is not None
        return part.weights @ state.mean[part.columns], between(part.weights, kept.covariance(part.tile, part.columns))
    ends = np.cumsum([0, *(part.weights.shape[0] for part in parts)])
    mean, covariance = np.empty(ends[-1]), np.zeros((ends[-1], ends[-1]))
    passing: dict[tuple[str, int], list[tuple[int, Array]]] = {}
    for k, part in enumerate(parts):
        for node, noise in _way_up(kept, part).items():
            passing.setdefault(node, []).append((k, noise))
    for ways in passing.values():
        if len(ways) > 1:  # what only one passes is in its own block
            rows = np.concatenate([np.arange(ends[k], ends[k + 1]) for k, _ in ways])
            noise = np.concatenate([noise for _, noise in ways])
            covariance[np.ix_(rows, rows)] += noise @ noise.T
    for k, part in enumerate(parts):
        own, state = slice(ends[k], ends[k + 1]), kept.tile(part.tile)
        assert state is not None
        mean[own] = part.weights @ state.mean[part.columns]
        covariance[own, own] = between(part.weights, kept.covariance(part.tile, part.columns))
    return mean, covariance


def _way_up(kept: Reconciled, part: Functionals) -> dict[tuple[str, int], Array]:
    """Noise (n, k) of combinations of a tile's vectors at every node of its tree from the tile to the root."""
    state = kept.tile(part.tile)
    assert state is not None
    names, weights = state.vectors.names, np.zeros((part.weights.shape[0], len(state.vectors.names)))
    weights[:, part.columns] = part.weights.toarray()
    parents, node, noise = kept.tree(state.tree).parents, state.node, {}
    while node >= 0:
        done = kept.elimination(state.tree, node)
        noise[state.tree, node], weights = carried(done, names, weights)
        names, node = done.boundary, parents[node]
    return noise


def _summed_noise(kept: Reconciled, parts: Sequence[tuple[Functionals, NDArray[np.int64]]], count: int) -> Array:
    """Covariance (n, n) of ``count`` sums of combinations of the vectors of several tiles; of each part also the sums that it belongs to.

    All of it is noise of the nodes above the tiles. What tiles add to the same sum is one combination from the node on where their ways
    meet, so the large nodes near the root are passed once.
    """
    arriving: dict[tuple[str, int], list[tuple[NDArray[np.int64], Names, Array]]] = {}
    depth: dict[tuple[str, int], int] = {}
    for part, sums in parts:
        state = kept.tile(part.tile)
        assert state is not None
        weights = np.zeros((len(sums), len(state.vectors.names)))
        weights[:, part.columns] = part.weights.toarray()
        arriving.setdefault((state.tree, state.node), []).append((sums, state.vectors.names, weights))
        way, node, parents = [], state.node, kept.tree(state.tree).parents
        while node >= 0:
            way.append((state.tree, node))
            node = parents[node]
        depth.update((key, len(way) - k) for k, key in enumerate(way))
    covariance = np.zeros((count, count))
    for tree, node in sorted(depth, key=lambda key: -depth[key]):  # children before their parents
        come = arriving.pop((tree, node))
        sums = np.unique(np.concatenate([of_part for of_part, _, _ in come]))
        done = kept.elimination(tree, node)
        here = [(np.searchsorted(sums, of_part), names, given) for of_part, names, given in come]
        noise, weights = carried_together(done, here, len(sums))
        covariance[np.ix_(sums, sums)] += noise @ noise.T
        parent = kept.tree(tree).parents[node]
        if parent >= 0:
            arriving.setdefault((tree, parent), []).append((sums, done.boundary, weights))
    return covariance


def _with_increments(
    source: NetworkSource,
    kept: Reconciled,
    tiles: Sequence[int],
    states: Sequence[TileState],
    trees: Mapping[str, TreeState],
    parameters: int,
) -> UnionState | None:
    """All images that some tiles see, from their states and what their cells sum to now beyond what they did then."""
    now, then = _increments(source, kept, tiles, states, trees)
    held = np.unique(np.concatenate([state.vectors.images for state in states]))
    rows = np.unique(np.concatenate([held, *(images for images, _ in (*now, *then))])).astype(np.int32)
    new = np.setdiff1d(rows, held).astype(np.int32)
    arrived = kept.vectors(new)
    names = np.unique(np.concatenate([arrived.names, *(state.vectors.names for state in states)]))
    parts = _parts(kept, tiles, states, trees, names)
    if parts is None:
        return None
    before = _before(kept, parts, names, trees)
    prior = _prior(rows, names, (*states, arrived), parameters)
    added, gone = add_sums(now, rows, parameters), add_sums(then, rows, parameters)
    difference = Sums(
        added.information - gone.information, added.vector - gone.vector, added.misclosure - gone.misclosure,
        added.redundancy - gone.redundancy,
    )  # fmt: skip
    return UnionState(rows, prior, with_sums(before, prior, difference))


def _increments(
    source: NetworkSource, kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState]
) -> tuple[list[tuple[Index, Sums]], list[tuple[Index, Sums]]]:
    """Sums of the cells that some tiles hold and that changed since: as they are now, and as they were."""
    now: dict[str, tuple[Index, Sums]] = {}
    then: dict[str, tuple[Index, Sums]] = {}
    existing = set(source.cell_numbers())
    for tile, state in zip(tiles, states, strict=True):
        version = trees[state.tree].version
        earlier = kept.earlier(version)
        for cell in set(source.cover.cells_held(tile)) & existing:
            if kept.changed.get(source.cover.owner(cell), 0) > version:
                now.setdefault(source.cover.cell_name(cell), source.cell_sums(cell))
        for cell in set(earlier.cover.cells_held(tile)) & set(earlier.cell_numbers()):
            owner = earlier.cover.owner(cell)
            if owner in source.cover.splits or kept.changed.get(owner, 0) > version:
                then.setdefault(earlier.cover.cell_name(cell), earlier.cell_sums(cell))
    return list(now.values()), list(then.values())


def _parts(
    kept: Reconciled, tiles: Sequence[int], states: Sequence[TileState], trees: Mapping[str, TreeState], names: Names
) -> list[Functionals] | None:
    """Each vector that the network knew when it was reconciled, from one tile that holds it; None when one is held nowhere.

    A vector of a pass or set that none of the tiles holds comes from another tile: its error is correlated with what they know.
    """
    parts, left = [], names
    for tile, state in zip(tiles, states, strict=True):
        parts.append(_of_names(tile, state, left))
        left = np.setdiff1d(left, state.vectors.names)
    for tree in trees.values():
        at = np.minimum(np.searchsorted(tree.shared, left), max(len(tree.shared) - 1, 0))
        found = tree.shared[at] == left if len(tree.shared) else np.zeros(len(left), dtype=np.bool_)
        for holder in np.unique(tree.holder[at[found]]).tolist():
            elsewhere = kept.tile(holder)
            if elsewhere is None:
                return None
            parts.append(_of_names(holder, elsewhere, left))
            left = np.setdiff1d(left, elsewhere.vectors.names)
    known = first_rows(left) < max(tree.images for tree in trees.values())
    return None if known.any() else [part for part in parts if len(part.columns)]


def _of_names(tile: int, state: TileState, names: Names) -> Functionals:
    columns = np.flatnonzero(np.isin(state.vectors.names, names)).astype(np.int64)
    return Functionals(tile, columns, sp.csr_array(sp.eye_array(len(columns))))


def _before(kept: Reconciled, parts: Sequence[Functionals], names: Names, trees: Mapping[str, TreeState]) -> WhitenedState:
    """State of all vectors as they were reconciled; those that are new have their prior."""
    of_parts = []
    for part in parts:
        state = kept.tile(part.tile)
        assert state is not None
        of_parts.append(state.vectors.names[part.columns])
    at = np.searchsorted(names, np.concatenate(of_parts))
    mean, covariance = np.zeros(len(names)), np.eye(len(names))
    mean[at], covariance[np.ix_(at, at)] = joint(kept, parts)
    return WhitenedState(
        names, mean, covariance, sum(tree.chi_square for tree in trees.values()), sum(tree.redundancy for tree in trees.values())
    )


def _prior(rows: Index, names: Names, known: Sequence[TileState | Vectors], parameters: int) -> sp.csr_array:
    """K of images (rows) by vectors (names), each image from the first that knows it."""
    blocks, place, left = [], [], np.ones(len(rows), dtype=np.bool_)
    for source in known:
        vectors = source.vectors if isinstance(source, TileState) else source
        chosen = np.flatnonzero(left & np.isin(rows, vectors.images))
        left[chosen] = False
        if not len(chosen):
            continue
        columns, prior = vectors.seen(rows[chosen])
        wide = _widened(prior, len(chosen), parameters).tocoo()
        at = np.searchsorted(names, vectors.names[columns])
        blocks.append(sp.coo_array((wide.data, (wide.row, at[wide.col])), shape=(wide.shape[0], len(names))))
        place.append(_rows_of(chosen, parameters))
    whole = sp.vstack(blocks).tocsr()
    return sp.csr_array(whole[np.argsort(np.concatenate(place))])


def with_sums(state: WhitenedState, prior: sp.csr_array, sums: Sums) -> WhitenedState:
    """The state with more information about images, some of which may be taken away: what is left must be a sum of sources.

    Parameters
    ----------
    prior : K (m p, q) of the images by the state's vectors; sums : about the images
    """
    information = between(prior, fill_symmetric(sums.information.copy()), transposed=True)
    vector = prior.T @ sums.vector
    root = np.tril(cholesky(state.covariance.copy()))  # P = L L'
    half = la.blas.dtrmm(1.0, root, la.blas.dtrmm(1.0, root, np.asfortranarray(information), side=1, lower=1), lower=1, trans_a=1)
    half[np.diag_indices(len(half))] += 1.0
    inner = cholesky(np.ascontiguousarray(0.5 * (half + half.T)))  # of I + L' J L
    spread = la.blas.dtrsm(1.0, inner, np.asfortranarray(root.T), lower=1)
    covariance = fill_symmetric(np.ascontiguousarray(spread.T @ spread))
    misfit = vector - information @ state.mean
    moved = covariance @ misfit
    chi_square = (
        sums.misclosure - 2.0 * vector @ state.mean + state.mean @ information @ state.mean - misfit @ moved
    )  # what the new sources add at the new minimum
    return WhitenedState(
        state.names, state.mean + moved, covariance, state.chi_square + float(chi_square), state.redundancy + sums.redundancy
    )
