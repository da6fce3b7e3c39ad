"""Does a block agree with a network? The test of their common points before anything is fused (docs/mathematics.md, "Innovation").

`innovation` is the test of two independent estimates of the same points; the test of a block with its rays, which needs no covariance of
the block, is `submin.adjustment.control.innovation_test`, and gives the same number. `BlockTest` is what came of it for one block, and
the rule by which it is accepted, doubtful or rejected (decision 012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from submin.errors import NumericalError

Array = NDArray[np.float64]

REJECTED = 1e-6
"""A good block in a million is turned away."""
DOUBTFUL = 1e-3
"""A good block in a thousand is called doubtful."""
CRITICAL_COORDINATE = float(norm.isf(0.5e-3))
"""3.29: one good coordinate in a thousand fails."""
POWER = 0.8


@dataclass(frozen=True)
class Innovation:
    """Test of two independent estimates of n points.

    Attributes
    ----------
    d2, dof, probability : ``nu' S^-1 nu``, chi-square with 3n degrees of freedom, and the chance of a value as large
    point : (n,) ``T_j = u_j' (S^-1)_jj^-1 u_j``, chi-square with three degrees of freedom
    coordinate : (n, 3) w-tests ``u_i / sqrt((S^-1)_ii)``, standard normal
    detectable : (n, 3) metres; an error of the block in this coordinate is found by its w-test (at 3.29) in 80 of 100 cases
    by_block, by_network : (n, 3) parts of the redundancy, ``diag(R S^-1)`` and ``diag(P S^-1)``; they add up to 1 in every coordinate
    """

    d2: float
    dof: int
    probability: float
    point: Array
    coordinate: Array
    detectable: Array
    by_block: Array
    by_network: Array


def innovation(block: Array, block_covariance: Array, network: Array, network_covariance: Array) -> Innovation:
    """Test a block's positions (n, 3) of common points against those of a network.

    Covariances (3n, 3n) are joint, point-major, of independent errors; metres and square metres in one frame.

    Raises
    ------
    NumericalError
        When the sum of the covariances is not positive definite.
    """
    n = len(block)
    total = block_covariance + network_covariance
    lower, info = la.lapack.dpotrf(total.T, lower=1, clean=1)
    if info != 0:
        raise NumericalError(f"the covariance of the innovation of {n} points is not positive definite at row {info - 1}")
    # all of S^-1 is wanted: its diagonal blocks, and its products with R and P
    inverse, _ = la.lapack.dpotri(lower, lower=1)
    inverse = np.tril(inverse) + np.tril(inverse, -1).T
    nu = (block - network).ravel()
    u = inverse @ nu
    d2 = float(nu @ u)
    k = np.arange(n)
    of_point = inverse.reshape(n, 3, n, 3)[k, :, k, :]
    by_point = np.einsum("nc,nc->n", u.reshape(n, 3), np.linalg.solve(of_point, u.reshape(n, 3, 1))[:, :, 0])
    root = np.sqrt(np.diagonal(inverse))
    shift = CRITICAL_COORDINATE + float(norm.ppf(POWER))
    parts = (np.einsum("ij,ij->i", covariance, inverse).reshape(n, 3) for covariance in (block_covariance, network_covariance))
    return Innovation(
        d2, 3 * n, float(chi2.sf(d2, 3 * n)), by_point, (u / root).reshape(n, 3), (shift / root).reshape(n, 3), *parts
    )  # fmt: skip


@dataclass(frozen=True)
class BlockTest:
    """Test of one block against a version of the network.

    Attributes
    ----------
    d2, dof, probability : of the common points that were not left out; ``probability`` is that of ``d2 / scale``
    points, left_out : common points tested, and how many of these contradict the rest and were left out
    images, released : of the block, and cameras whose a priori model had to be given up
    scale : the network's own variance factor where that is above one, else one
    explained : False where leaving out points and releasing cameras, up to half of them, does not make the block agree
    """

    d2: float
    dof: int
    probability: float
    points: int
    left_out: int = 0
    images: int = 0
    released: int = 0
    scale: float = 1.0
    explained: bool = True

    @property
    def doubtful(self) -> bool:
        """True for a block as improbable as one in a thousand good ones."""
        return self.probability < DOUBTFUL

    def rejected(self, limit: float) -> bool:
        """True for a block that contradicts the network as a whole, and is less probable than ``limit`` (0: none is)."""
        return not self.explained and self.probability < limit

    def reason(self, limit: float, version: str) -> str:
        """Why it is rejected."""
        most = self.scale * float(chi2.isf(limit, self.dof))
        scaled = f", for a variance factor of {self.scale:.2f}" if self.scale > 1.0 else ""
        return (
            f"the block contradicts the network {version} as a whole: d2 is {self.d2:.1f} with {self.dof} degrees of freedom, and would be "
            f"above {most:.1f} in one of {1.0 / limit:,.0f} good blocks{scaled}; neither leaving out half of its {self.points} common "
            f"points nor releasing half of its {self.images} cameras explains it; check its cameras, the sigmas of its measurements and "
            "priors, and its point ids; where the network is wrong, withdraw what is wrong there and give the same command again"
        )


def allowed_cameras(images: int) -> int:
    """Cameras of a block that may be bad before the block is: half of them, and always one."""
    return max(images // 2, 1)


def allowed_points(points: int) -> int:
    """Common points of a block that may be blunders before the block is: half of them, and always one."""
    return max(points // 2, 1)
