"""A peer: GTSAM, given the linear system as a factor graph: one variable a point, one a group of images, one for what passes share.

It has no RPC cameras, and no need of them: rays are linear factors of a point and a group of images. Everything is left to it as it comes:
multifrontal Cholesky in the order that its COLAMD finds. Of what it offers for one more block the faster counts: `GaussianISAM.update`, or
the whole again. The graph is built through its Python interface, factor by factor; that time stands by itself, and for one more block is
left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers_outcome import Outcome, Times
from benchmarks.peers_problem import ImageGroups, Problem, image_groups
from orchestration.memory import own_peak_memory_mb

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]

SECONDS_OF_SINGLE = 60.0
"""Covariances of single points are computed for so long, of points drawn from all; what all would take is then extrapolated."""


def adjust(problem: Problem) -> Outcome:
    """Everything that is asked of a contender."""
    groups, every = image_groups(problem), np.ones(len(problem.image), dtype=np.bool_)
    clock = time.perf_counter()
    graph = graph_of(problem, groups, every, every=True)
    built, clock = time.perf_counter() - clock, time.perf_counter()
    tree = graph.eliminateMultifrontal()
    found = tree.optimize()
    coordinates = problem.origin + np.array([found.at(j) for j in range(len(problem))])
    solve = time.perf_counter() - clock

    rows, covariance, all_3x3 = singles(problem, tree)
    remark = "" if len(rows) == len(problem) else f"extrapolated from {len(rows):,}"
    (near, of_near), (far, of_far) = (timed(lambda rows=rows: joint(tree, rows)) for rows in (problem.near, problem.far))  # type: ignore[misc]
    one_block = min(solve, added(problem, groups))
    times = Times(built, solve, all_3x3, remark, of_near, of_far, one_block)
    return Outcome(times, own_peak_memory_mb(), coordinates, rows, covariance, near, far)


def graph_of(problem: Problem, groups: ImageGroups, rays: Mask, *, every: bool, images: Mask | None = None) -> gtsam.GaussianFactorGraph:
    """Factors of some rays (r,), and a priori factors: of all images, or of those of ``images`` (m,); ``every``: common ones too."""
    n, graph, unit = len(problem), gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create(2)
    own = [own_factor(problem, of_group) for of_group in groups.own]
    group_of, rows_of = groups.of_images(problem)
    for r in np.flatnonzero(rays).tolist():
        image, point = int(problem.image[r]), int(problem.point[r])
        g = int(group_of[image])
        if g < 0:
            graph.add(point, problem.by_ground[r], problem.y[r], unit)
            continue
        parameter, place = rows_of[image]
        graph.add(point, problem.by_ground[r], n + g, problem.by_parameters[r][:, parameter] @ own[g][place], problem.y[r], unit)
    for g in np.unique(group_of[(group_of >= 0) if images is None else (group_of >= 0) & images]).tolist():
        add_prior(graph, problem, groups, g, own[g])
    if every:
        for c, columns in enumerate(groups.shared):
            size = len(columns)
            graph.add(n + len(groups.own) + c, np.eye(size), np.zeros(size), gtsam.noiseModel.Unit.Create(size))
    return graph


def own_factor(problem: Problem, of_group: Rows) -> Array:
    """K (k, k) of a group's own errors: its variable is ``w`` with ``theta = K_own w``, since K_own may be as good as singular."""
    return np.asarray(problem.prior[problem.adjusted[of_group]][:, of_group].toarray())


def add_prior(graph: gtsam.GaussianFactorGraph, problem: Problem, groups: ImageGroups, g: int, own: Array) -> None:
    """``w - K_own^-1 K_common c ~ N(0, I)``, since ``theta = K_own u + K_common c``.

    Raises
    ------
    ValueError
        When what a pass has in common moves parameters that the group's own errors cannot.
    """
    n, size, c = len(problem), len(own), int(groups.common[g])
    unit, zero = gtsam.noiseModel.Unit.Create(size), np.zeros(size)
    if c < 0:
        graph.add(n + g, np.eye(size), zero, unit)
        return
    common = problem.prior[problem.adjusted[groups.own[g]]][:, groups.shared[c]].toarray()
    shared = np.linalg.lstsq(own, common)[0]
    if not np.allclose(own @ shared, common, rtol=1e-12, atol=1e-12 * np.abs(common).max()):
        raise ValueError("errors common to a pass are not among those that its images can have of their own")
    graph.add(n + g, np.eye(size), n + len(groups.own) + c, -shared, zero, unit)


def singles(problem: Problem, tree: gtsam.GaussianBayesTree) -> tuple[Rows, Array, float]:
    """Points, their covariances (k, 3, 3), and the seconds that those of all points take."""
    rows = np.random.default_rng(1).permutation(len(problem))
    found: list[Array] = []
    started = time.perf_counter()
    while len(found) < len(rows) and time.perf_counter() - started < SECONDS_OF_SINGLE:
        found.append(tree.marginalCovariance(int(rows[len(found)])))
    seconds = (time.perf_counter() - started) * len(rows) / len(found)
    order = np.argsort(rows[: len(found)])
    return rows[: len(found)][order], np.array(found)[order], seconds


def joint(tree: gtsam.GaussianBayesTree, rows: Rows) -> Array:
    """Joint covariance of some points; nothing that an earlier question left behind helps."""
    tree.deleteCachedShortcuts()
    return np.asarray(tree.jointMarginalCovariance(rows.tolist()).fullMatrix())


def added(problem: Problem, groups: ImageGroups) -> float:
    """Seconds of adding the last block to the tree of the others, coordinates included."""
    before = problem.before_last_block()
    with_rays = np.zeros(len(problem.added), dtype=np.bool_)
    with_rays[problem.image[before]] = True
    # a group enters with its first ray; what passes share is there from the start
    entered = _whole_groups(problem, groups, with_rays)
    tree = graph_of(problem, groups, before, every=True, images=entered).eliminateMultifrontal()
    network = gtsam.GaussianISAM(tree)
    new = graph_of(problem, groups, ~before, every=False, images=~entered)
    clock = time.perf_counter()
    network.update(new)
    found = network.optimize()
    np.array([found.at(j) for j in range(len(problem))])
    return time.perf_counter() - clock


def _whole_groups(problem: Problem, groups: ImageGroups, images: Mask) -> Mask:
    """All images of the groups of some images."""
    image = problem.adjusted // problem.by_parameters.shape[2]
    seen = np.unique(groups.of_row[images[image]])
    found = np.zeros(len(images), dtype=np.bool_)
    found[image[np.isin(groups.of_row, seen)]] = True
    return found


def timed(work: Callable[[], Array]) -> tuple[Array, float]:
    """A result, and the seconds that it took."""
    clock = time.perf_counter()
    return work(), time.perf_counter() - clock
