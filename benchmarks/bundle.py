"""Blocks adjusted together in memory, as a network's one tile would: for many realisations, where a store would only take time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.adjustment import adjust
from submin.adjustment.elimination import eliminate, linearise, point_factors
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import sorted_rays
from submin.geodesy import WGS84, geocentric_to_geodetic, local_axes, rotate_covariance
from submin.network.network_image import image_set
from submin.network.sub_min import GroundPart, SubMin, covariances_of, factor, joint_covariance, loadings, locate
from submin.sensors import width_of
from submin.storage.block_images import network_images
from submin.storage.catalogue_schema import Block

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
Rows = NDArray[np.integer]


@dataclass(frozen=True, eq=False)
class Solution:
    """Ground points of a bundle.

    Attributes
    ----------
    ids : (n,) ascending; geocentric : (n, 3) metres
    part, loading (3n, m p), images : what their covariance is made of, see `submin.network.sub_min`
    rejected : rays rejected as blunders; released : images found to be bad
    """

    ids: Ids
    geocentric: Array
    part: GroundPart
    loading: sp.csr_array
    images: SubMin
    rejected: int
    released: int

    @cached_property
    def local_covariance(self) -> Array:
        """Covariance (n, 3, 3) of each point alone, m2, in its local axes."""
        return rotate_covariance(covariances_of(self.part, self.images), local_axes(geocentric_to_geodetic(self.geocentric)))

    def joint_covariance(self, rows: Rows) -> Array:
        """Covariance (3k, 3k) of some points, m2, geocentric axes."""
        axes = (3 * np.asarray(rows)[:, None] + np.arange(3)).ravel()
        return joint_covariance(self.loading[axes], self.part.factors.own[rows], self.images.covariance)


def solve(blocks: Iterable[Block], judged: bool = True) -> Solution:
    """Adjust some blocks, control among them, as one bundle: registered, judged, linearised at the solution, factored.

    Without judgement every ray and camera is taken as good, and the bundle is linearised once, at its registration.
    """
    blocks = list(blocks)
    members = [image for block in blocks for image in network_images(block)]
    images = image_set(members, WGS84, width_of(image.sensor for image in members))
    first = np.cumsum([0, *(len(block.images) for block in blocks)])
    ids, point = np.unique(np.concatenate([block.point_ids for block in blocks]), return_inverse=True)
    image = np.concatenate([block.image + at for block, at in zip(blocks, first, strict=False)]).astype(np.int32)
    observed = np.concatenate([block.observed for block in blocks])
    sigma = np.concatenate([block.sigma for block in blocks])
    rays = sorted_rays(point.astype(np.int32), image, observed, sigma, np.ones(len(image), dtype=np.bool_))
    origin = intersect(images, rays, len(ids))
    accepted, released = rays.accepted, np.zeros(len(images), dtype=np.bool_)
    if judged:
        adjusted = adjust(images, rays, origin)
        accepted, released = adjusted.accepted, adjusted.released
        linear = linearise(images, rays, adjusted.theta, adjusted.ground, origin)
    else:
        linear = linearise(images, rays, np.zeros((len(images), images.parameters)), origin, origin)
    images, weight = images.release(released), accepted.astype(np.float64)
    state = factor(eliminate(linear, weight, len(images)), np.arange(len(images), dtype=np.int32), images)
    part = GroundPart(origin, linear, point_factors(linear, weight))
    return Solution(
        ids, locate(part, state), part, loadings([part], state.images, images.parameters), state,
        int((~accepted).sum()), int(released.sum()),
    )  # fmt: skip
