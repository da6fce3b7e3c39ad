"""Virtual control points: a regularisation for blocks without control whose images have no a priori model (the ZY-3 papers' way).

On a grid in every image, each place is cut with a height datum by the *unadjusted* camera, and the ground point so made is then observed
where it came from, with the sigma of the image's positioning accuracy. That holds each image to where it was, the more points the more, so
the estimate exists where tie points alone leave it undetermined.

**It is no accuracy statement.** The virtual points of an image share the one error of its camera; the equations take them for
independent. Coordinates and cameras may be used, a covariance of the system so weighted is too small by about the number of
virtual points, times the weight factor, and is not made (docs/stage-1.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.adjustment import CONVERGED_METRES, CONVERGED_SIGMAS, reach_metres
from submin.adjustment.elimination import eliminate, ground_corrections, linearise, moved_rays, point_factors
from submin.adjustment.estimation import estimate_images
from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays
from submin.errors import InputError, NumericalError
from submin.geodesy import geodetic_to_geocentric
from submin.sensors import sensor_named

Array = NDArray[np.float64]
Index = NDArray[np.int32]

WEIGHTS = ("plain", "balanced")
MAX_ITERATIONS = 40
DETERMINED = 1e-10
"""A combination of parameters that moves virtual points less than this part of the best seen one is not held by them."""


@dataclass(frozen=True)
class VirtualControl:
    """Virtual control points of some images.

    Attributes
    ----------
    image : (v,) row of the image of each; observed : (v, 2) place on its grid, pixels
    ground : (v, 3) geocentric, metres
    weight : (v,) of each image coordinate, one over square pixels
    """

    image: Index
    observed: Array
    ground: Array
    weight: Array


@dataclass(frozen=True)
class VirtuallyControlled:
    """A block adjusted with virtual control: coordinates, and no covariance.

    Attributes
    ----------
    theta : (m, p) corrections; ground : (n, 3) geocentric metres, NaN for points that are not determined
    iterations : linearisations
    """

    theta: Array
    ground: Array
    iterations: int


def virtual_control(
    images: ImageSet, first: Array, size: Array, tie_points: NDArray[np.int64],
    grid: int, sigma: float, weight: str, height: float | None = None,
) -> VirtualControl:  # fmt: skip
    """Virtual control at the centres of a grid of ``grid`` x ``grid`` fields in each of m images.

    Parameters
    ----------
    first : (m, 2) sample and line of each image's first pixel; size : (m, 2) its width and height, pixels
    tie_points : (m,) tie points measured in each image
    sigma : positioning accuracy of an unadjusted image, pixels
    weight : ``plain``, one over sigma squared, or ``balanced``, times tie points over virtual points of the image
    height : of the datum, metres above the ellipsoid; by default each camera's mean height

    Raises
    ------
    InputError
        When the grid, sigma, weight or height is none, or a camera does not reach the datum.
    """
    if grid < 1 or not (np.isfinite(sigma) and sigma > 0.0) or weight not in WEIGHTS:
        raise InputError(
            f"virtual control of {grid} x {grid} points, sigma {sigma:g}, weight {weight!r}; expected 1 or more, a positive number, and "
            f"one of {', '.join(WEIGHTS)}"
        )
    if height is not None and not np.isfinite(height):
        raise InputError(f"height of the virtual control is {height:g}; expected a finite number, metres above the ellipsoid")
    centre = (np.arange(grid) + 0.5) / grid
    across, down = (part.ravel() for part in np.meshgrid(centre, centre))
    place = np.stack([across, down], axis=1)
    image = np.repeat(np.arange(len(images), dtype=np.int32), grid**2)
    observed = (first[:, None, :] - 0.5 + size[:, None, :] * place).reshape(-1, 2)
    geodetic = np.empty((len(image), 3))
    for name in set(images.sensors):
        sensor, rows = sensor_named(name), np.array(images.sensors)[image] == name
        heights = sensor.mean_height(images.cameras)[image[rows]] if height is None else np.full(int(rows.sum()), height)
        samples, lines = np.ascontiguousarray(observed[rows, 0]), np.ascontiguousarray(observed[rows, 1])
        geodetic[rows] = sensor.localise(images.cameras, image[rows], samples, lines, heights, images.ellipsoid)
    missing = ~np.isfinite(geodetic).all(axis=1)
    if missing.any():
        worst = int(image[np.argmax(missing)])
        raise InputError(f"image {images.ids[worst]}: its camera does not reach the height of the virtual control; give another height")
    scale = np.where(tie_points > 0, tie_points, 1) / grid**2 if weight == "balanced" else np.ones(len(images))
    return VirtualControl(image, observed, geodetic_to_geocentric(geodetic, images.ellipsoid), np.repeat(scale / sigma**2, grid**2))


def virtual_factor(images: ImageSet, control: VirtualControl) -> sp.csr_array:
    """What virtual control holds of the images, in the form of an a priori factor K (m p, q) of their adjustable parameters.

    The ground being fixed, its equations are of the images alone: ``N = sum A' w A`` of each, ``K K' = N^-1``. Parameters that the a priori
    model holds as they are stay so.

    Raises
    ------
    InputError
        When the points of an image do not hold all of its parameters.
    """
    m, p = len(images), images.parameters
    points = np.arange(len(control.image), dtype=np.int32)
    projection = images.project(np.zeros((m, p)), images.ground(control.ground), control.image, points, control.observed)
    a = projection.by_parameters * np.sqrt(control.weight)[:, None, None]
    normal = np.zeros((m, p, p))
    np.add.at(normal, control.image, np.swapaxes(a, 1, 2) @ a)
    adjustable = images.prior_variance > 0.0
    blocks: list[Array] = []
    for i in range(m):
        free = np.flatnonzero(adjustable[i])
        sigma = np.sqrt(np.diag(normal[i])[free])
        scale = np.where(sigma > 0.0, sigma, 1.0)
        values, vectors = np.linalg.eigh(normal[i][np.ix_(free, free)] / scale[:, None] / scale)
        if len(free) and not values[0] > DETERMINED * values[-1]:
            raise InputError(
                f"image {images.ids[i]}: {(control.image == i).sum()} virtual control points do not hold its {len(free)} adjustable "
                "parameters; give more points an image, or fewer adjustable parameters in priors.json"
            )
        block = np.zeros((p, len(free)))
        block[free] = vectors / np.sqrt(values) / scale[:, None]
        blocks.append(block)
    return sp.csr_array(sp.block_diag(blocks, format="csr"))


def adjust_virtually(images: ImageSet, rays: Rays, start: Array, control: VirtualControl) -> VirtuallyControlled:
    """Adjust images and points by their accepted rays and virtual control, without any a priori model of the images.

    ``start`` (n, 3) are the points' registered positions.

    Raises
    ------
    InputError
        When the points of an image do not hold all of its parameters.
    NumericalError
        When it does not converge.
    """
    factor, weight, m, p = virtual_factor(images, control), rays.accepted.astype(np.float64), len(images), images.parameters
    theta, ground, reach = np.zeros((m, p)), start, np.empty(0)
    for iteration in range(1, MAX_ITERATIONS + 1):
        linear = linearise(images, rays, theta, ground, start)
        reach = reach_metres(images, rays, linear) if iteration == 1 else reach
        sums = eliminate(linear, weight, m)
        found = estimate_images(sums, factor, p)
        factors = point_factors(linear, weight)
        offset = ground_corrections(factors, linear, found.theta)
        distance = np.linalg.norm(offset, axis=1)
        offset *= (reach / np.maximum(distance, reach))[:, None]
        moved = np.abs(moved_rays(linear, found.theta - theta)).max(initial=0.0)
        shift = np.abs(start + offset - ground).max(initial=0.0)
        theta, ground = found.theta, start + offset
        if moved < CONVERGED_SIGMAS and shift < CONVERGED_METRES:
            known = np.where((factors.rank == 3)[:, None], ground, np.nan)
            return VirtuallyControlled(theta, known, iteration)
    raise NumericalError(f"the adjustment with virtual control did not converge in {MAX_ITERATIONS} iterations; check the block's cameras")
