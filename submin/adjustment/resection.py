"""Resection: images from ground points held without error, and then the error of the points propagated.

Given the ground points that its images see, a block owes nothing to other blocks. So the images of a block of a network, as one
adjustment of everything has them, follow from their a priori model and their own rays on the network's points (docs/stage-1.md),

    Q_c = (Q^-1 + sum A'A)^-1     theta = Q_c sum A'(y - B x)     G = -Q_c sum A'B     M = Q_c + G P G'

with x and P those points and their joint covariance, to which the same rays have contributed. Nothing is counted twice: Q_c is the error
of the images when the points are known, and P that of the points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, Sums, eliminate
from submin.adjustment.estimation import estimate_images

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Resection:
    """Images by ground points held without error.

    Attributes
    ----------
    theta : (m, p) corrections
    covariance : (m p, m p) Q_c, of the images if the points were without error
    gain : (m p, 3n) G, by which errors of the points go into the corrections; zero for points that were not held
    """

    theta: Array
    covariance: Array
    gain: sp.csr_array

    def total_covariance(self, loading: sp.csr_array, own: Array, covariance: Array) -> Array:
        """M (m p, m p), when the points' joint covariance is ``D + U C U'``: U (3n, c), D (n, 3, 3), C (c, c)."""
        seen = self.gain @ loading
        apart = self.gain @ sp.block_diag(list(own), format="csr") if len(own) else self.gain
        return np.asarray(self.covariance + seen @ covariance @ seen.T + (apart @ self.gain.T).toarray())


def resect(linear: LinearRays, weight: Array, held: Flags, correction: Array, prior: sp.csr_array, parameters: int) -> Resection:
    """Estimate the images from their linearised rays.

    Parameters
    ----------
    linear : rays of the images alone, on n points; weight : (r,), 0 for rejected ones
    held : (n,) points held without error; the others are unknown, and eliminated
    correction : (n, 3) ``x - x0`` of the points held, metres
    prior : a priori factor K of the images, so many ``parameters`` each

    Raises
    ------
    NumericalError
        When the information is not positive definite.
    """
    p, m, n = parameters, prior.shape[0] // parameters, len(correction)
    point = np.repeat(np.arange(n), np.diff(linear.first))
    of_held = held[point] & (weight > 0.0)
    free = eliminate(linear, np.where(of_held, 0.0, weight), m)
    root = np.sqrt(weight[of_held])
    a = root[:, None, None] * linear.by_parameters[of_held]
    b = root[:, None, None] * linear.by_ground[of_held]
    image, at = linear.image[of_held], point[of_held]
    y = root[:, None] * linear.y[of_held] - np.einsum("rck,rk->rc", b, correction[at])
    information, vector = free.information.copy(), free.vector.copy()
    normal = np.zeros((m, p, p))
    np.add.at(normal, image, np.swapaxes(a, 1, 2) @ a)
    for i in range(m):
        information[i * p : (i + 1) * p, i * p : (i + 1) * p] += np.tril(normal[i])
    np.add.at(vector.reshape(m, p), image, np.einsum("rcp,rc->rp", a, y))
    misclosure = free.misclosure + float((y**2).sum())
    found = estimate_images(Sums(information, vector, misclosure, free.redundancy + 2 * len(y)), prior, p)
    shape = (len(y), p, 3)
    rows = np.broadcast_to((p * image[:, None] + np.arange(p))[:, :, None], shape).ravel()
    columns = np.broadcast_to((3 * at[:, None] + np.arange(3))[:, None, :], shape).ravel()
    crossed = sp.coo_array(((np.swapaxes(a, 1, 2) @ b).ravel(), (rows, columns)), shape=(m * p, 3 * n)).tocsr()
    return Resection(found.theta, found.covariance, sp.csr_array(-(sp.csr_array(found.covariance) @ crossed)))
