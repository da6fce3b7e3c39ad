"""What an adjustment is worth: how well measurements fit what was said of them, what they check of each other, and how good the result is.

Everything is made when it is asked for. The weighted squares at the minimum over the redundancy are the *variance factor*: 1 when the
sigmas that were stated are the true ones. Of a coordinate, the *redundancy number* is the part of an error in it that shows in its own
residual, ``r = diag(P - P A M A' P)`` (`submin.adjustment.blunders`); with those of the a priori model they add up to the redundancy.
A blunder of ``(critical + 0.84) sigma / sqrt(r)`` is found in 80 of 100 cases: the *minimal detectable blunder* (Baarda 1968).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.special import gammaincinv, ndtri

from submin.adjustment.adjustment import Adjustment
from submin.adjustment.blunders import CRITICAL_RAY, TESTABLE
from submin.adjustment.elimination import LinearRays, PointFactors, Sums, eliminate, linearise, point_covariances, point_factors
from submin.adjustment.estimation import ImageEstimate, estimate_images
from submin.adjustment.images import ImageSet
from submin.adjustment.point_basis import Array, Index, Offsets, gather, most_rays, orthonormal
from submin.adjustment.rays import Rays
from submin.adjustment.snooping import image_part, residual_variances
from submin.adjustment.weak_geometry import convergence_angles, weak_points

POWER = 0.8
"""Chance with which a minimal detectable blunder is found."""
BAND = 0.95
"""Chance with which the variance factor of a right model falls into its band."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _redundancy_numbers(first: Offsets, image: Index, weight: Array, by_ground: Array, by_parameters: Array, covariance: Array) -> Array:
    """Redundancy numbers (r, 2) of accepted rays; NaN for the others."""
    most = most_rays(first)
    numbers, zeros = np.full((len(image), 2), np.nan), np.zeros((len(image), 2))
    rays, root = np.empty(most, np.int64), np.empty(most)
    b, q, t = np.empty((2 * most, 3)), np.empty((2 * most, 3)), np.empty(2 * most)
    r, pivot, known = np.empty((3, 3)), np.empty(3, np.int32), np.empty((2 * most, 2 * most))
    product, own = np.empty((3, 2 * most)), np.empty(2 * most)
    for j in range(len(first) - 1):
        n = gather(j, first, weight, by_ground, zeros, rays, root, b, t)
        if n == 0:
            continue
        rank = orthonormal(b, 2 * n, q, r, pivot)
        image_part(n, rays, root, n, rays, root, image, by_parameters, covariance, True, known)
        residual_variances(q, rank, 2 * n, known, product, own)
        for k in range(2 * n):
            nothing = b[k, 0] == 0.0 and b[k, 1] == 0.0 and b[k, 2] == 0.0  # the empty row of a view along one axis
            numbers[rays[k // 2], k % 2] = 0.0 if nothing or 2 * n <= rank else own[k]
    return numbers


@dataclass(frozen=True)
class Quality:
    """Statistics of an adjustment of r rays of n points in m images of p parameters.

    Attributes
    ----------
    sigma : (r, 2) stated standard deviations of the measurements, in units of their images
    linear, weight : the rays at the solution, and which of them (r,) were accepted
    sums, estimate : the information that they hold about the images, and the images' estimate
    """

    sigma: Array
    linear: LinearRays
    weight: Array
    sums: Sums
    estimate: ImageEstimate

    @property
    def redundancy(self) -> int:
        """Observations, those of the a priori model included, less unknowns."""
        return self.sums.redundancy

    @property
    def variance_factor(self) -> float:
        """A posteriori variance of a measurement in units of the stated one; NaN without redundancy."""
        return self.estimate.chi_square / self.redundancy if self.redundancy > 0 else float("nan")

    @property
    def band(self) -> tuple[float, float]:
        """Between which the variance factor lies in 95 of 100 cases when the stated sigmas are true."""
        if self.redundancy <= 0:
            return 0.0, float("inf")
        low, high = (2.0 * float(gammaincinv(0.5 * self.redundancy, at)) for at in (0.5 - 0.5 * BAND, 0.5 + 0.5 * BAND))
        return low / self.redundancy, high / self.redundancy

    @cached_property
    def redundancy_numbers(self) -> Array:
        """Of each coordinate of each ray, (r, 2), 0 to 1; NaN for rejected rays."""
        x = self.linear
        return np.asarray(
            _redundancy_numbers(x.first, x.image, self.weight, x.by_ground, x.by_parameters, self.estimate.covariance)
        )  # fmt: skip

    @cached_property
    def prior_redundancy(self) -> Array:
        """Of each whitened vector of the a priori model, (q,), 0 to 1."""
        factor = self.estimate.factor
        if not len(factor):
            return np.empty(0)
        inverse, _ = la.lapack.dtrtri(np.tril(factor), lower=1)
        return np.asarray(1.0 - np.einsum("ij,ij->j", inverse, inverse))

    def detectable(self, critical: float = CRITICAL_RAY) -> Array:
        """Minimal detectable blunder (r, 2) of each coordinate, in units of its image: found in 80 of 100 cases by a test at ``critical``.

        By default that of the rejection of rays; at 3.29, one good coordinate in 1,000, it is ``4.13 sigma / sqrt(r)``. Infinite where
        other observations check less than a hundredth of a coordinate, NaN for rejected rays.
        """
        numbers = self.redundancy_numbers
        shift = critical + float(ndtri(POWER))
        checked = np.where(numbers >= TESTABLE, shift * self.sigma / np.sqrt(np.maximum(numbers, TESTABLE)), np.inf)
        return np.where(np.isnan(numbers), np.nan, checked)

    @property
    def image_covariance(self) -> Array:
        """Covariance (m p, m p) of the images' corrections, image-major."""
        return self.estimate.covariance

    @cached_property
    def _factors(self) -> PointFactors:
        return point_factors(self.linear, self.weight)

    @cached_property
    def point_covariances(self) -> Array:
        """Covariance (n, 3, 3) of each point, geocentric square metres; NaN for points that are not determined."""
        x, own = self.linear, self._factors
        return point_covariances(x.first, x.image, own, self.estimate.covariance)

    def joint_covariance(self, points: NDArray[np.integer]) -> Array:
        """Joint covariance (3k, 3k) of some points (rows (k,)), geocentric square metres, point-major; NaN for those not determined."""
        x, p = self.linear, self.linear.by_parameters.shape[2]
        by_image = np.zeros((len(points), 3, self.estimate.theta.size))
        for k, j in enumerate(points):
            for i in range(x.first[j], x.first[j + 1]):
                at = x.image[i] * p
                by_image[k, :, at : at + p] += self._factors.loading[i]
        flat = by_image.reshape(3 * len(points), -1)
        joint = flat @ self.estimate.covariance @ flat.T
        for k, j in enumerate(points):
            joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += self._factors.own[j]
        return joint

    @cached_property
    def convergence_angles(self) -> Array:
        """Largest angle (n,), degrees, between two accepted rays of each point; NaN where fewer than two are left."""
        return convergence_angles(self.linear, self.weight)

    @property
    def weak(self) -> NDArray[np.bool_]:
        """Points (n,) whose rays meet at too small an angle, see `submin.adjustment.weak_geometry`."""
        return weak_points(self.convergence_angles)


def quality(images: ImageSet, rays: Rays, result: Adjustment) -> Quality:
    """Statistics of an adjustment of these images and rays, linearised at its result.

    Raises
    ------
    NumericalError
        When the adjustment has not arrived where its information is positive definite.
    """
    released = images.release(result.released) if result.released.any() else images
    linear, weight = linearise(images, rays, result.theta, result.ground, result.ground), result.accepted.astype(np.float64)
    sums = eliminate(linear, weight, len(images))
    return Quality(rays.sigma, linear, weight, sums, estimate_images(sums, released.prior, images.parameters))
