"""A peer: simultaneous adjustment of all images by normal equations, points eliminated, with sparse matrices of SciPy and CHOLMOD.

    Z_j = L_j^-1 B_j'A_j,  L_j L_j' = B_j'B_j        S = A'A - Z'Z        Lambda = I + K' S K

What bundle adjustment programs do. It shares with the product the linearised rays, the a priori factor, and the last step of single
points' covariances (`point_covariances`), so that what differs is how M is found.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from benchmarks.peers_outcome import Outcome, Times
from benchmarks.peers_problem import Problem
from benchmarks.sparse_adjustment import SparseAdjustment, SparseSystem
from orchestration.memory import own_peak_memory_mb
from submin.adjustment.elimination import PointFactors, point_covariances

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Points eliminated from their rays.

    Attributes
    ----------
    information, vector : S (m p, m p) and h (m p,) of the images
    own : (n, 3, 3) D; offset : (n, 3) xbar - x0; loading : (r, 3, p) U by ray
    """

    information: sp.csr_array
    vector: Array
    own: Array
    offset: Array
    loading: Array


def adjust(problem: Problem) -> Outcome:
    """Everything that is asked of a contender."""
    point_covariances(np.zeros(1, np.int64), np.empty(0, np.int32), _factors(np.empty((0, 3, 3)), np.empty((0, 3, 6))), np.empty((0, 0)))
    every = np.ones(len(problem.image), dtype=np.bool_)
    before = problem.before_last_block()
    known = eliminated(problem, before)
    clock = time.perf_counter()
    sums = added(problem, known, before)
    coordinates_of(problem, sums, solved(problem, sums))
    one_block = time.perf_counter() - clock

    clock = time.perf_counter()
    sums = eliminated(problem, every)
    built, clock = time.perf_counter() - clock, time.perf_counter()
    solution = solved(problem, sums)
    coordinates = coordinates_of(problem, sums, solution)
    solve, clock = time.perf_counter() - clock, time.perf_counter()
    covariance = all_covariances(problem, sums, solution)
    all_3x3, clock = time.perf_counter() - clock, time.perf_counter()
    near = joint(problem, sums, solution, problem.near)
    of_near, clock = time.perf_counter() - clock, time.perf_counter()
    far = joint(problem, sums, solution, problem.far)
    of_far = time.perf_counter() - clock
    rows = np.arange(len(problem))
    times = Times(built, solve, all_3x3, "", of_near, of_far, one_block)
    return Outcome(times, own_peak_memory_mb(), coordinates, rows, covariance, near, far)


def eliminated(problem: Problem, rays: Mask) -> Eliminated:
    """Eliminate the points that some rays (r,) see; of the others there is nothing."""
    n, p = len(problem), problem.by_parameters.shape[2]
    size = problem.prior.shape[0]
    point, image = problem.point[rays], problem.image[rays]
    a, b, y = problem.by_parameters[rays], problem.by_ground[rays], problem.y[rays]
    seen, place = np.unique(point, return_inverse=True)
    normal, right = np.zeros((len(seen), 3, 3)), np.zeros((len(seen), 3))
    np.add.at(normal, place, b.transpose(0, 2, 1) @ b)
    np.add.at(right, place, np.einsum("rci,rc->ri", b, y))
    lower = np.linalg.cholesky(normal)
    half = np.linalg.solve(lower, np.broadcast_to(np.eye(3), lower.shape))  # L^-1
    z = half[place] @ (b.transpose(0, 2, 1) @ a)
    columns = image[:, None] * p + np.arange(p)
    rows_of = 3 * place[:, None] + np.arange(3)
    whole = (3 * len(seen), size)
    of_points = sp.csr_array(
        (z.ravel(), (np.repeat(rows_of, p, axis=1).ravel(), np.repeat(columns[:, None], 3, axis=1).ravel())), shape=whole
    )  # fmt: skip
    of_rays = sp.csr_array(
        (a.ravel(), np.repeat(columns[:, None], 2, axis=1).ravel(), p * np.arange(2 * len(a) + 1)), shape=(2 * len(a), size)
    )  # fmt: skip
    t = np.einsum("nij,nj->ni", half, right)
    information = of_rays.T @ of_rays - of_points.T @ of_points
    own, offset, loading = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((len(problem.image), 3, p))
    own[seen] = half.transpose(0, 2, 1) @ half
    offset[seen] = np.einsum("nji,nj->ni", half, t)
    loading[rays] = -half.transpose(0, 2, 1)[place] @ z
    vector = of_rays.T @ y.ravel() - of_points.T @ t.ravel()
    return Eliminated(sp.csr_array(information), vector, own, offset, loading)


def solved(problem: Problem, sums: Eliminated) -> SparseAdjustment:
    """The images, from the sums of all points."""
    system = SparseSystem(sp.csc_array(sums.information), sums.vector, problem.prior, problem.by_parameters.shape[2])
    return SparseAdjustment.of_system(system, "cholmod")


def added(problem: Problem, known: Eliminated, before: Mask) -> Eliminated:
    """Sums with the last block: points that its rays touch are eliminated anew, those of all others stand."""
    touched = np.zeros(len(problem), dtype=np.bool_)
    touched[problem.point[~before]] = True
    of_touched = touched[problem.point]
    old, new = eliminated(problem, before & of_touched), eliminated(problem, of_touched)
    return Eliminated(
        known.information - old.information + new.information, known.vector - old.vector + new.vector,
        np.where(touched[:, None, None], new.own, known.own), np.where(touched[:, None], new.offset, known.offset),
        np.where(of_touched[:, None, None], new.loading, known.loading),
    )  # fmt: skip


def coordinates_of(problem: Problem, sums: Eliminated, solution: SparseAdjustment) -> Array:
    """Geocentric coordinates (n, 3) of all points."""
    by_ray = np.einsum("rcp,rp->rc", sums.loading, solution.theta[problem.image])
    return np.asarray(problem.origin + sums.offset + np.add.reduceat(by_ray, problem.first[:-1], axis=0))


def all_covariances(problem: Problem, sums: Eliminated, solution: SparseAdjustment) -> Array:
    """Covariances (n, 3, 3) of all points, by M of all images."""
    prior = solution.prior
    of_images = np.ascontiguousarray(prior @ solution.factor.solve(prior.T.toarray()))
    return point_covariances(problem.first, problem.image.astype(np.int32), _factors(sums.own, sums.loading), of_images)


def joint(problem: Problem, sums: Eliminated, solution: SparseAdjustment, points: Rows) -> Array:
    """Joint covariance (3k, 3k) of some points."""
    p, k = problem.by_parameters.shape[2], len(points)
    rays = np.flatnonzero(np.isin(problem.point, points))
    rows = 3 * np.searchsorted(points, problem.point[rays])[:, None, None] + np.arange(3)[:, None] + np.zeros(p, dtype=np.int64)
    columns = (problem.image[rays] * p)[:, None, None] + np.zeros((3, 1), dtype=np.int64) + np.arange(p)
    of_points = sp.csr_array((sums.loading[rays].ravel(), (rows.ravel(), columns.ravel())), shape=(3 * k, problem.prior.shape[0]))
    found = solution.factor.quadratic((of_points @ solution.prior).T.tocsc())
    found.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k), :] += sums.own[points]
    return found


def _factors(own: Array, loading: Array) -> PointFactors:
    return PointFactors(np.full(len(own), 3), np.zeros((len(own), 3)), own, loading)
