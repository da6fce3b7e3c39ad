"""The test of a block by a network before it is accepted: one sub-MIN's answer for its common points, and the block's own rays.

Rays, cameras and blunders are those of stage 1. The network's part is read, not computed: the tile that holds most of the common points
answers for them from its stored covariance. Images of the block that share a pass with images of the tile are correlated with its answer;
what the tile knows of their common error follows from its estimate of the pass-mates alone, because rays speak of images, not of what
images have in common:  ``E(u | theta_g) = K_g^+ theta_g``, with K_g the a priori factor of the pass-mates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.stats import chi2

from submin.adjustment.adjustment import BundleEstimate
from submin.adjustment.control import ControlledPrior, covariance_factor, innovation_of
from submin.adjustment.controlled_adjustment import adjust_controlled
from submin.adjustment.elimination import linearise
from submin.adjustment.images import ImageSet
from submin.adjustment.priors import ImagePrior, prior_factor
from submin.adjustment.rays import Rays
from submin.errors import NumericalError
from submin.network.innovation import BlockTest, allowed_cameras, allowed_points
from submin.network.sub_min import GroundPart, SubMin, loadings, locate, marginal
from submin.query.planner import Selection, determined_parts, points_named, well_spread
from submin.query.source import Index, NetworkSource

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

MOST_POINTS = 60
"""Common points that are compared, well spread: systematic errors of a block show in few, and the work grows with their square or cube."""
KNOWN = 1e-10
"""A direction of the pass-mates' a priori factor below this part of the largest is taken for unknown."""


@dataclass(frozen=True)
class CommonPoints:
    """Points that a block has in common with one tile.

    Attributes
    ----------
    ids : (k,) ascending; order : of the parts' points by these
    mates : rows of the network's images, of the tile, that share a pass with an image of the block; mate_priors : theirs
    state : the tile's estimate of the images that see the points, and of the mates
    """

    ids: Ids
    order: NDArray[np.int64]
    parts: tuple[GroundPart, ...]
    mates: Index
    mate_priors: tuple[ImagePrior, ...]
    state: SubMin

    def prior(self, block: ImageSet, points: Ids) -> ControlledPrior:
        """Control points and images of a block before its rays; ``points`` (n,), ascending, are the block's."""
        p, k, g = block.parameters, len(self.ids), len(self.mates) * block.parameters
        on_points = loadings(self.parts, self.state.images, p)
        at = (np.searchsorted(self.state.images, self.mates)[:, None] * p + np.arange(p)).ravel()
        on_mates = sp.csr_array((np.ones(g), (np.arange(g), at)), shape=(g, self.state.theta.size))
        both = sp.vstack([on_points, on_mates], format="csr")
        half = np.ascontiguousarray((both @ self.state.covariance).T)
        root = covariance_factor(np.asarray(both @ half))
        q = root.shape[1]
        whole = prior_factor((*self.mate_priors, *block.priors), p).toarray()
        mates, images = whole[:g], whole[g:]
        sigma = np.sqrt((mates**2).sum(axis=1))
        scale = np.where(sigma > 0.0, sigma, 1.0)
        knows = np.linalg.pinv(mates / scale[:, None], rcond=KNOWN) / scale if g else np.zeros((whole.shape[1], 0))
        gain = images @ knows
        left = images - (images @ knows) @ mates
        loading = np.zeros((k, 3, q + left.shape[1]))
        loading[:, :, :q] = root[: 3 * k].reshape(k, 3, q)[self.order]
        of_mates = self.state.theta.ravel()[at]
        return ControlledPrior(
            np.searchsorted(points, self.ids),
            np.concatenate([locate(part, self.state) for part in self.parts])[self.order],
            np.concatenate([part.factors.own for part in self.parts])[self.order],
            loading,
            (gain @ of_mates).reshape(-1, p),
            np.hstack([gain @ root[3 * k :], left]),
        )


def common_points(
    source: NetworkSource, ids: Ids, cells: NDArray[np.int64], block: ImageSet, mates_in: Callable[[int], Index],
    sub_min: Callable[[int], SubMin],
) -> CommonPoints | None:  # fmt: skip
    """What one tile says of a block's points ``ids`` (in ``cells``, see `points_named`); None without any determined one.

    ``mates_in`` gives the rows of a tile's images that share a pass with an image of the block, ``sub_min`` a tile's sub-MIN.
    """
    selections, _ = points_named(source, ids, cells)
    tile = _tile_of_most(source, selections)
    if tile is None:
        return None
    held = set(source.cover.cells_held(tile))
    kept, parts = determined_parts(source, well_spread(source, [s for s in selections if s.cell.number in held], MOST_POINTS))
    if not parts:
        return None
    mates = mates_in(tile) if any(prior.shares_errors for prior in block.priors) else np.empty(0, dtype=np.int32)
    seen = np.unique(np.concatenate([mates, *(part.linear.image for part in parts)])).astype(np.int32)
    found = np.concatenate([s.cell.point_ids[s.rows] for s in kept])
    order = np.argsort(found, kind="stable")
    return CommonPoints(found[order], order, tuple(parts), mates, source.image_set(mates).priors, marginal(sub_min(tile), seen))


def _tile_of_most(source: NetworkSource, selections: Sequence[Selection]) -> int | None:
    """The tile that holds most of some points, of those that hold as many the one that owns most."""
    held, owned = Counter[int](), Counter[int]()
    for s in selections:
        owned[source.cover.owner(s.cell.number)] += len(s.rows)
        for tile in source.cover.holders(s.cell.number):
            held[tile] += len(s.rows)
    return max(sorted(held), key=lambda tile: (held[tile], owned[tile]), default=None)


def block_test(
    common: CommonPoints, images: ImageSet, ids: Ids, rays: Rays, adjusted: BundleEstimate, start: Callable[[], Array]
) -> BlockTest | None:  # fmt: skip
    """Test a block, adjusted by itself, against what a network says of their common points; None when nothing can be compared.

    Parameters
    ----------
    images : of the block; ids : (n,) its points, ascending; start : gives (n, 3) where they are registered, if that is needed
    rays : of the block, with what its own adjustment has accepted, which has put its cameras and points where ``adjusted`` says
    """
    released = images.release(adjusted.released)
    scale = max(common.state.chi_square / common.state.redundancy, 1.0) if common.state.redundancy > 0 else 1.0
    k, m = len(common.ids), len(images)
    prior, weight = common.prior(released, ids), rays.accepted.astype(np.float64)
    origin = adjusted.ground.copy()
    origin[prior.point] = prior.position
    every = np.ones(k, dtype=np.bool_)
    linear = linearise(released, rays, adjusted.theta, adjusted.ground, origin)
    first = innovation_of(linear, weight, prior, every)
    if not first.dof:
        return None
    bad = int(adjusted.released.sum())
    plain = BlockTest(first.d2, first.dof, float(chi2.sf(first.d2 / scale, first.dof)), k, 0, m, bad, scale)
    if not plain.doubtful:
        return plain
    unexplained = replace(plain, explained=False)
    try:
        # cameras are judged afresh: by itself the block may have blamed the wrong one
        again = adjust_controlled(images, rays, start(), lambda state: common.prior(state, ids))
    except NumericalError:
        return unexplained
    left_out, bad = int((~again.active).sum()), int(again.released.sum())
    if left_out > allowed_points(k) or bad > allowed_cameras(m):
        return unexplained
    if not again.test.dof:  # the only point is a blunder, and nothing is left to be compared
        return replace(plain, left_out=left_out, released=bad)
    test = BlockTest(again.test.d2, again.test.dof, float(chi2.sf(again.test.d2 / scale, again.test.dof)), k, left_out, m, bad, scale)
    return replace(test, explained=not test.doubtful)
