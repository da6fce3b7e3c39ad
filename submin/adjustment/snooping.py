"""Which rays of a point are blunders: the explanations with fewest blunders, and what they leave in doubt.

A point's residuals v have covariance V (`submin.adjustment.blunders`). Leaving a set D of its rays out, of the point *and* of the
adjustment, drops the weighted squares by ``v_D' V_DD^-1 v_D`` and changes what is left by elimination:

    v_R <- v_R - V_RD V_DD^-1 v_D         V_RR <- V_RR - V_RD V_DD^-1 V_DR

so that every explanation "the rays D are blunders" is tried without adjusting anything again. When a coordinate fails its test, sets of
one ray are tried, then of two, until some leave nothing that fails. Of these the one that drops the squares most is the likeliest, and
every other of the same size whose drop is nearly as large is as good an explanation: the data do not tell between them, and what any
of them calls a blunder goes (decision 004).
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from submin.adjustment.point_basis import gather, most_rays, orthonormal, remove_ground

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Offsets = NDArray[np.int64]

MOST_EXPLANATIONS = 250
"""Where there are more sets of rays to try, the ray whose loss drops the squares most goes, and the rest are tested again."""
TIE = 1e-9
"""Drops that differ by this part are the same but for round-off."""


@numba.njit(cache=True, error_model="numpy")
def _leave_out(variance: Array, residual: Array, rays: Offsets, size: int, n: int, testable: float) -> tuple[float, float]:
    """Leave rays ``rays[:size]`` out of the n that have these residuals (2 n) of this covariance (2 n, 2 n); both are changed.

    Returns the drop of the weighted squares and the largest w of what is left. A direction that nothing checks (variance below
    ``testable``) does not count.
    """
    drop, left = 0.0, np.ones(2 * n, np.bool_)
    for k in range(size):
        left[2 * rays[k]] = left[2 * rays[k] + 1] = False
    for _ in range(2 * size):
        pivot = 2 * rays[0]
        for k in range(size):
            for c in range(2 * rays[k], 2 * rays[k] + 2):
                if variance[c, c] > variance[pivot, pivot]:
                    pivot = c
        free = variance[pivot, pivot]
        if not free >= testable:
            break
        drop += residual[pivot] ** 2 / free
        for i in range(2 * n):
            if i != pivot:
                share = variance[i, pivot] / free
                residual[i] -= share * residual[pivot]
                for j in range(2 * n):
                    variance[i, j] -= share * variance[pivot, j]
        for i in range(2 * n):
            variance[i, pivot] = variance[pivot, i] = 0.0
    worst = 0.0
    for i in range(2 * n):
        if left[i] and variance[i, i] >= testable:
            worst = max(worst, abs(residual[i]) / np.sqrt(variance[i, i]))
    return drop, worst


@numba.njit(cache=True, error_model="numpy")
def _choices(n: int, k: int) -> int:
    number = 1
    for i in range(k):
        number = number * (n - i) // (i + 1)
    return number


@numba.njit(cache=True, error_model="numpy")
def explain(variance: Array, residual: Array, n: int, critical: float, doubt: float, testable: float, blunder: NDArray[np.bool_]) -> None:
    """Mark in ``blunder`` (n) the rays of a point that fails its test that go.

    ``residual`` (2 n) and ``variance`` (2 n, 2 n) are those of its n rays; an explanation whose squares are larger than the best one's by
    no more than ``doubt`` is as good.
    """
    blunder[:n] = False
    work, left = np.empty((2 * n, 2 * n)), np.empty(2 * n)
    rays, drops = np.empty(n, np.int64), np.empty(MOST_EXPLANATIONS)
    for size in range(1, n):
        tries = _choices(n, size)
        greedy = tries > MOST_EXPLANATIONS
        if greedy:
            size, tries = 1, n
        best, fits = -1.0, False
        for again in range(2):
            for k in range(size):
                rays[k] = k
            for which in range(tries):
                if again == 0:
                    work[...], left[...] = variance[: 2 * n, : 2 * n], residual[: 2 * n]
                    drops[which], worst = _leave_out(work, left, rays, size, n, testable)
                    if (greedy or worst <= critical) and drops[which] > best:
                        best, fits = drops[which], True
                elif drops[which] >= (1.0 - TIE) * best - (0.0 if greedy else doubt):
                    for k in range(size):
                        blunder[rays[k]] = True
                k = size - 1  # the next set, in the order of the dictionary
                while k > 0 and rays[k] == n - size + k:
                    k -= 1
                rays[k] += 1
                for i in range(k + 1, size):
                    rays[i] = rays[i - 1] + 1
            if not fits:
                break
        if fits:
            return
    blunder[:n] = True


@numba.njit(cache=True, error_model="numpy")
def residual_rows(
    n: int, rays: Offsets, root: Array, image: Index, by_parameters: Array, q: Array, rank: int, covariance: Array,
    z: Array, row: Array, product: Array, free: Array,
) -> None:  # fmt: skip
    """What the n rays of a point say of the images once the point is gone, ``row = P A`` (2 n, n p), and the variances of its residuals.

    ``product = row M`` with M the images' covariance, ``free = diag(P - row M row')`` (2 n): the redundancy numbers of the coordinates.
    """
    p = by_parameters.shape[2]
    for a in range(n):
        for u in range(p):
            for e in range(rank):
                z[a, e, u] = root[a] * (q[2 * a, e] * by_parameters[rays[a], 0, u] + q[2 * a + 1, e] * by_parameters[rays[a], 1, u])
    for k in range(2 * n):
        a, c = k // 2, k % 2
        free[k] = 1.0
        for e in range(rank):
            free[k] -= q[k, e] ** 2
        for s in range(n):
            for u in range(p):
                value = root[a] * by_parameters[rays[s], c, u] if s == a else 0.0
                for e in range(rank):
                    value -= q[k, e] * z[s, e, u]
                row[k, s * p + u] = value
        for s in range(n):
            at = image[rays[s]] * p
            for u in range(p):
                total = 0.0
                for s2 in range(n):
                    to = image[rays[s2]] * p
                    for x in range(p):
                        total += covariance[at + u, to + x] * row[k, s2 * p + x]
                product[k, s * p + u] = total
                free[k] -= total * row[k, s * p + u]


@numba.njit(cache=True, error_model="numpy")
def snoop(
    first: Offsets, image: Index, weight: Array, by_ground: Array, by_parameters: Array, y: Array,
    theta: Array, covariance: Array, critical: float, doubt: float, testable: float, statistic: Array,
) -> None:  # fmt: skip
    """Test the rays of each point by itself, reject its blunders, and test again until nothing fails.

    Changes ``weight``; ``statistic`` (r,) becomes each ray's last w.
    """
    p = by_parameters.shape[2]
    most = most_rays(first)
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot, z = np.empty((3, 3)), np.empty(3, np.int32), np.empty((most, 3, p))
    row, product, variance = np.empty((2 * most, most * p)), np.empty((2 * most, most * p)), np.empty((2 * most, 2 * most))
    free, blunder = np.empty(2 * most), np.empty(most, np.bool_)
    for j in range(len(first) - 1):
        while True:
            n = gather(j, first, weight, by_ground, y, rays, root, b, t)
            if n < 2:
                break
            rank = orthonormal(b, 2 * n, q, r, pivot)
            if 2 * n <= rank:
                break
            for a in range(n):
                i = rays[a]
                for c in range(2):
                    for u in range(p):
                        t[2 * a + c] -= by_parameters[i, c, u] * theta[image[i], u]
            remove_ground(q, rank, 2 * n, t)
            worst = 0.0
            residual_rows(n, rays, root, image, by_parameters, q, rank, covariance, z, row, product, free)
            for k in range(2 * n):
                w = abs(t[k]) / np.sqrt(free[k]) if free[k] >= testable else 0.0
                statistic[rays[k // 2]] = w if k % 2 == 0 else max(statistic[rays[k // 2]], w)
                worst = max(worst, w)
            if not worst > critical:
                break
            for k in range(2 * n):
                for i in range(2 * n):
                    variance[k, i] = 1.0 if k == i else 0.0
                    for e in range(rank):
                        variance[k, i] -= q[k, e] * q[i, e]
                    for s in range(n * p):
                        variance[k, i] -= row[k, s] * product[i, s]
            explain(variance, t, n, critical, doubt, testable, blunder)
            for a in range(n):
                if blunder[a]:
                    weight[rays[a]] = 0.0
