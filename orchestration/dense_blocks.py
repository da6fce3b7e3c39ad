"""What comes to a dense network as sets of observations: clusters of a catalogue, control points, blocks of images by their points."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from orchestration.stage_one import BlockRays, adjust_block
from submin.adjustment.adjustment import adjust
from submin.adjustment.elimination import eliminate, linearise, point_factors
from submin.adjustment.estimation import estimate_images
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import Rays, canonical_order
from submin.errors import InputError, NumericalError
from submin.geodesy import Ellipsoid, geodetic_to_geocentric, local_axes
from submin.network.network_image import image_set
from submin.network.observations import Cluster
from submin.network.sub_min import GroundPart, SubMin, joint_covariance, loadings, locate
from submin.query.planner import determined_by
from submin.sensors import sensor_named, width_of
from submin.storage.catalogue_schema import Block, PointTable
from submin.storage.control_blocks import control_block_id, control_set_id
from submin.storage.dense_store import Member

Array = NDArray[np.float64]


def control_members(points: PointTable, ellipsoid: Ellipsoid) -> Iterator[Member]:
    """Control points as positions: one set each, or one of all where they have a joint covariance."""
    geocentric, axes = geodetic_to_geocentric(points.geodetic, ellipsoid), local_axes(points.geodetic)
    if points.joint_covariance is not None and len(points) > 1:
        ids = points.point_ids
        stated = json.dumps([ids.tolist(), points.geodetic.tolist(), points.joint_covariance.tolist()])
        yield Member(positions(control_set_id(ids), ids, geocentric, points.joint_covariance), "control", stated=stated)
        return
    for k, point in enumerate(points.point_ids.tolist()):
        covariance = axes[k].T @ points.covariance_enu[k] @ axes[k]
        # as surveyed: rotated numbers differ in their last digits from one machine to another
        stated = json.dumps([point, points.geodetic[k].tolist(), points.covariance_enu[k].tolist()])
        cluster = positions(control_block_id(point), points.point_ids[k : k + 1], geocentric[k : k + 1], 0.5 * (covariance + covariance.T))
        yield Member(cluster, "control", stated=stated)


def positions(name: str, ids: NDArray[np.str_], geocentric: Array, covariance: Array) -> Cluster:
    """A cluster of positions alone."""
    return Cluster(name, ids, np.full(len(ids), "", dtype="U1"), geocentric, covariance)


def free_points(block: Block, ellipsoid: Ellipsoid) -> Member:
    """The points of a block of images, adjusted by itself, with their joint covariance.

    Images are marginalised: what the dense network keeps of the block are its determined points.

    Raises
    ------
    InputError
        With the reason for which the block cannot come in.
    """
    raw = BlockRays.of(block)
    outcome = adjust_block(raw, ellipsoid)
    reason = outcome.reason
    if reason is not None:
        raise InputError(reason)
    images = image_set(raw.images, ellipsoid, width_of(image.sensor for image in raw.images))
    used = outcome.accepted
    seen, point = np.unique(raw.point[used], return_inverse=True)
    ids = raw.ids[seen]
    order = canonical_order(point, raw.image[used], raw.observed[used])
    rays = Rays(
        point[order].astype(np.int32), raw.image[used][order], raw.observed[used][order], raw.sigma[used][order],
        np.ones(len(order), dtype=np.bool_),
    )  # fmt: skip
    solved = adjust(images, rays, intersect(images, rays, len(ids)))
    if not solved.converged:
        raise InputError(solved.status.message(images.ids, ids))
    images = images.release(solved.released)
    linear = linearise(images, rays, solved.theta, solved.ground, solved.ground)
    weight = solved.accepted.astype(np.float64)
    sums, part = eliminate(linear, weight, len(images)), GroundPart(solved.ground, linear, point_factors(linear, weight))
    estimate = estimate_images(sums, images.prior, images.parameters)
    rows = np.arange(len(images), dtype=np.int32)
    state = SubMin(rows, estimate.theta, estimate.covariance, estimate.chi_square, sums.redundancy)
    determined = determined_by(part.factors) & (np.bincount(rays.point[solved.accepted], minlength=len(ids)) >= 2)
    if not determined.any():
        raise InputError("none of its points is determined; expected points measured in two images or more")
    kept = np.flatnonzero(determined)
    loading = loadings([part], rows, images.parameters)[(3 * kept[:, None] + np.arange(3)).ravel()]
    try:
        covariance = joint_covariance(loading, part.factors.own[kept], estimate.covariance)
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise NumericalError("the covariance of its points is not positive definite; check its rays and its a priori model") from None
    model = block.a_priori
    passes = {i.pass_id for i in block.images if model is not None and model.shares_errors(sensor_named(i.sensor).parameters)}
    cluster = positions(block.block_id, ids[kept], locate(part, state)[kept], covariance)
    return Member(cluster, "images", tuple(sorted(passes)), estimate.chi_square, sums.redundancy)
