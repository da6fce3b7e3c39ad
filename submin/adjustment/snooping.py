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

from submin.adjustment.point_basis import by_images, complement, gather, most_rays, orthonormal, remove_ground

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Offsets = NDArray[np.int64]

UNCHECKED = 1e-10
"""Part of a direction's variance below which nothing but the point's own rays says where its images are."""
MOST_EXPLANATIONS = 250
"""Where there are more sets of rays to try, the ray whose loss drops the squares most goes, and the rest are tested again."""
TIE = 1e-9
"""Drops that differ by this part are the same but for round-off."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _leave_out(variance: Array, residual: Array, rays: Offsets, size: int, n: int, testable: Array) -> tuple[float, float]:
    """Leave rays ``rays[:size]`` out of the n that have these residuals (2 n) of this covariance (2 n, 2 n); both are changed.

    Returns the drop of the weighted squares and the largest w of what is left. A direction that nothing checks (variance below the
    ``testable`` (n) of its ray) does not count.
    """
    drop, left = 0.0, np.ones(2 * n, np.bool_)
    for k in range(size):
        left[2 * rays[k]] = left[2 * rays[k] + 1] = False
    for _ in range(2 * size):
        pivot = 2 * rays[0]
        for k in range(size):
            for c in range(2 * rays[k], 2 * rays[k] + 2):
                if variance[c, c] * testable[pivot // 2] > variance[pivot, pivot] * testable[c // 2]:
                    pivot = c
        free = variance[pivot, pivot]
        if not free >= testable[pivot // 2]:
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
        if left[i] and variance[i, i] >= testable[i // 2]:
            worst = max(worst, abs(residual[i]) / np.sqrt(variance[i, i]))
    return drop, worst


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _choices(n: int, k: int) -> int:
    number = 1
    for i in range(k):
        number = number * (n - i) // (i + 1)
    return number


@numba.njit(cache=True, nogil=True, error_model="numpy")
def explain(variance: Array, residual: Array, n: int, critical: float, doubt: float, testable: Array, blunder: NDArray[np.bool_]) -> None:
    """Mark in ``blunder`` (n) the rays of a point that fails its test that go.

    ``residual`` (2 n) and ``variance`` (2 n, 2 n) are those of its n rays; an explanation whose squares are larger than the best one's by
    no more than ``doubt`` is as good.
    """
    blunder[:n] = False
    work, left = np.empty((2 * n, 2 * n)), np.empty(2 * n)
    rays, drops = np.empty(n, np.int64), np.empty(max(n, MOST_EXPLANATIONS))
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


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def image_part(
    n: int, rays: Offsets, root: Array, n2: int, rays2: Offsets, root2: Array, image: Index, by_parameters: Array, covariance: Array,
    mirrored: bool, out: Array,
) -> None:  # fmt: skip
    """``A M A2'`` (2 n, 2 n2) of two sets of rays; ``mirrored`` when they are one, of which half has to be summed."""
    p = by_parameters.shape[2]
    for a in range(n):
        by, at = by_parameters[rays[a]], image[rays[a]] * p
        for s in range(a + 1 if mirrored else n2):
            by2, to, part = by_parameters[rays2[s]], image[rays2[s]] * p, root[a] * root2[s]
            c00 = c01 = c10 = c11 = 0.0
            for x in range(p):
                half0 = half1 = 0.0
                for u in range(p):
                    m = covariance[to + x, at + u]
                    half0 += by[0, u] * m
                    half1 += by[1, u] * m
                c00 += half0 * by2[0, x]
                c01 += half0 * by2[1, x]
                c10 += half1 * by2[0, x]
                c11 += half1 * by2[1, x]
            out[2 * a, 2 * s], out[2 * a, 2 * s + 1] = part * c00, part * c01
            out[2 * a + 1, 2 * s], out[2 * a + 1, 2 * s + 1] = part * c10, part * c11
    if mirrored:
        for i in range(2 * n):
            for k in range(i):
                out[k, i] = out[i, k]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _turned(basis: Array, free: int, n: int, full: Array, basis2: Array, free2: int, n2: int, product: Array, out: Array) -> None:
    """``N' X N2`` (free, free2) of a matrix X (2 n, 2 n2)."""
    for e in range(free):
        for k in range(2 * n2):
            product[k] = 0.0
        for i in range(2 * n):
            part = basis[i, e]
            for k in range(2 * n2):
                product[k] += part * full[i, k]
        for d in range(free2):
            out[e, d] = 0.0
        for k in range(2 * n2):
            part = product[k]
            for d in range(free2):
                out[e, d] += part * basis2[k, d]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def residual_space(
    n: int, rays: Offsets, root: Array, image: Index, by_parameters: Array, q: Array, rank: int, covariance: Array,
    basis: Array, known: Array, product: Array, inner: Array,
) -> int:  # fmt: skip
    """Covariance of the residuals of a point's n rays, ``V = N inner N'`` with N the directions (2 n, m) that the point leaves free.

    ``basis`` becomes N, ``known = A M A'`` (2 n, 2 n) with M the images' covariance, ``inner = I - N' known N`` (m, m); ``product`` (2 n)
    is work space. Returns m.
    """
    free = complement(q, rank, 2 * n, basis)
    image_part(n, rays, root, n, rays, root, image, by_parameters, covariance, True, known)
    _turned(basis, free, n, known, basis, free, n, product, inner)
    for e in range(free):
        for d in range(e + 1):
            inner[e, d] = inner[d, e] = (1.0 if d == e else 0.0) - inner[e, d]
    return free


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def residual_variances(q: Array, rank: int, k: int, known: Array, product: Array, variance: Array) -> None:
    """Diagonal (k) of ``V = P - P X P``, ``P = I - QQ'``, of X = ``known`` (k, k), without a basis of what P leaves."""
    for i in range(k):
        variance[i] = 1.0 - known[i, i]
    for e in range(rank):
        for i in range(k):
            product[e, i] = 0.0
        for m in range(k):
            part = q[m, e]
            for i in range(k):
                product[e, i] += part * known[m, i]
        for i in range(k):
            variance[i] += q[i, e] * (2.0 * product[e, i] - q[i, e])
    for e in range(rank):
        for d in range(rank):
            total = 0.0
            for m in range(k):
                total += product[e, m] * q[m, d]
            for i in range(k):
                variance[i] -= q[i, e] * total * q[i, d]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def residual_covariance(basis: Array, inner: Array, free: int, i: int, k: int) -> float:
    """Element (i, k) of ``N inner N'``."""
    total = 0.0
    for e in range(free):
        half = 0.0
        for d in range(free):
            half += inner[e, d] * basis[k, d]
        total += basis[i, e] * half
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _misclosures(n: int, rays: Offsets, root: Array, image: Index, by_parameters: Array, theta: Array, t: Array) -> None:
    """Take what the images' corrections explain out of the stacked observations ``t`` (2 n) of a point, in place."""
    for a in range(n):
        i = rays[a]
        for c in range(2):
            for u in range(by_parameters.shape[2]):
                t[2 * a + c] -= root[a] * by_parameters[i, c, u] * theta[image[i], u]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _predicted(inner: Array, e: Array, cross: Array, inner2: Array, e2: Array, free: int, free2: int) -> None:
    """Turn what a set of rays says into what it would, were the images adjusted with these rays of the point and no others of it.

    ``inner`` (free, free) and ``e`` (free) are ``I - N'A M A'N`` and the misclosures of the set, ``inner2``, ``e2`` those of the rays of
    the point with which the images *were* adjusted. Without the point the misclosures are ``e + X inner2^-1 e2`` of covariance
    ``C = I + N'A M A'N + X inner2^-1 X'``, X = ``cross``; ``inner`` becomes ``C^-1`` and ``e`` becomes ``C^-1`` times them.
    """
    spread, mean = np.empty((free, free)), np.empty((free, 1))
    for i in range(free):
        mean[i, 0] = e[i]
        for k in range(free):
            spread[i, k] = (2.0 if i == k else 0.0) - inner[i, k]
    if free2 > 0:
        values, vectors = np.linalg.eigh(np.ascontiguousarray(inner2[:free2, :free2]))
        turned = cross @ vectors
        for d in range(free2):
            value, part = max(values[d], UNCHECKED), 0.0
            for k in range(free2):
                part += vectors[k, d] * e2[k]
            for i in range(free):
                mean[i, 0] += turned[i, d] * part / value
                for k in range(free):
                    spread[i, k] += turned[i, d] * turned[k, d] / value
    values, vectors = np.linalg.eigh(spread)
    for d in range(free):
        values[d] = max(values[d], 1.0)  # C >= I: what is less is round-off
    inverse = (vectors / values) @ vectors.T
    solved = inverse @ mean
    for i in range(free):
        e[i] = solved[i, 0]
        for k in range(free):
            inner[i, k] = inverse[i, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _along(basis: Array, free: int, k: int, t: Array, e: Array) -> None:
    """``e = N't`` (free) of stacked numbers (k)."""
    for m in range(free):
        e[m] = 0.0
        for i in range(k):
            e[m] += basis[i, m] * t[i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _tested(n: int, rays: Offsets, residual: Array, variance: Array, testable: Array, statistic: Array) -> float:
    """Largest w of a point's n rays, of their residuals (2 n) and variances (2 n); those of the rays become their ``statistic``."""
    worst = 0.0
    for a in range(n):
        i, w = rays[a], 0.0
        for k in (2 * a, 2 * a + 1):
            if variance[k] >= testable[i]:
                w = max(w, abs(residual[k]) / np.sqrt(variance[k]))
        statistic[i], worst = w, max(worst, w)
    return worst


@numba.njit(cache=True, nogil=True, error_model="numpy")
def snoop(
    first: Offsets, image: Index, weight: Array, used: Array, by_ground: Array, by_parameters: Array, y: Array,
    theta: Array, covariance: Array, critical: float, doubt: float, testable: Array, statistic: Array,
) -> None:  # fmt: skip
    """Test the rays of each point by itself, reject its blunders, and test again until nothing fails.

    A coordinate is tested when the variance of its residual is at least ``testable`` (r,), in that of its ray.
    Changes ``weight``; ``statistic`` (r,) becomes each ray's last w. ``used`` (r,) is above 0 for the rays with which the images were
    adjusted: a test must not depend on them, or a ray that moves its image far would be taken back and rejected in turn.
    """
    most = most_rays(first)
    rays, root, rays2, root2 = np.empty(most, np.int64), np.empty(most), np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot, blunder, limit = np.empty((3, 3)), np.empty(3, np.int32), np.empty(most, np.bool_), np.empty(most)
    basis, inner, variance = np.empty((2 * most, 2 * most)), np.empty((2 * most, 2 * most)), np.empty((2 * most, 2 * most))
    basis2, inner2, e, e2 = np.empty((2 * most, 2 * most)), np.empty((2 * most, 2 * most)), np.empty(2 * most), np.empty(2 * most)
    known, cross, product, along = (
        np.empty((2 * most, 2 * most)),
        np.empty((2 * most, 2 * most)),
        np.empty(2 * most),
        np.empty((3, 2 * most)),
    )
    own = np.empty(2 * most)
    for j in by_images(first, image, weight):  # the numbers of M that they need stay in the cache
        while True:
            n = gather(j, first, weight, by_ground, y, rays, root, b, t)
            if n < 2:
                break
            rank = orthonormal(b, 2 * n, q, r, pivot)
            if 2 * n <= rank:
                break
            _misclosures(n, rays, root, image, by_parameters, theta, t)
            same = True
            for i in range(first[j], first[j + 1]):
                same = same and (weight[i] > 0.0) == (used[i] > 0.0)
            if same:  # most points, and most of these pass
                image_part(n, rays, root, n, rays, root, image, by_parameters, covariance, True, known)
                residual_variances(q, rank, 2 * n, known, along, own)
                remove_ground(q, rank, 2 * n, t)
                if not _tested(n, rays, t, own, testable, statistic) > critical:
                    break
            free = residual_space(n, rays, root, image, by_parameters, q, rank, covariance, basis, known, product, inner)
            _along(basis, free, 2 * n, t, e)
            if not same:
                n2 = gather(j, first, used, by_ground, y, rays2, root2, b, t)
                free2 = 0
                if n2 > 0:
                    rank2 = orthonormal(b, 2 * n2, q, r, pivot)
                    free2 = residual_space(
                        n2, rays2, root2, image, by_parameters, q, rank2, covariance, basis2, known, product, inner2
                    )  # fmt: skip
                    _misclosures(n2, rays2, root2, image, by_parameters, theta, t)
                    _along(basis2, free2, 2 * n2, t, e2)
                image_part(n, rays, root, n2, rays2, root2, image, by_parameters, covariance, False, known)
                _turned(basis, free, n, known, basis2, free2, n2, product, cross)
                _predicted(inner, e, np.ascontiguousarray(cross[:free, :free2]), inner2, e2, free, free2)
            for k in range(2 * n):
                t[k] = 0.0
                for m in range(free):
                    t[k] += basis[k, m] * e[m]
                own[k] = residual_covariance(basis, inner, free, k, k)
            if not _tested(n, rays, t, own, testable, statistic) > critical:
                break
            for k in range(2 * n):
                for i in range(2 * n):
                    variance[k, i] = residual_covariance(basis, inner, free, k, i)
            for a in range(n):
                limit[a] = testable[rays[a]]
            explain(variance, t, n, critical, doubt, limit, blunder)
            for a in range(n):
                if blunder[a]:
                    weight[rays[a]] = 0.0
