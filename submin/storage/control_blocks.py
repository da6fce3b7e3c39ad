"""Surveyed control points as blocks, so that they are entered, counted once and withdrawn as images are."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np

from submin.errors import InputError
from submin.geodesy import Ellipsoid, geodetic_to_geocentric, local_axes
from submin.storage.catalogue_schema import CONTROL_PREFIX, Block, ImageRecord, PointTable


def control_block_id(point_id: str) -> str:
    """Block of a control point."""
    return CONTROL_PREFIX + point_id


def control_point_of(block_id: str) -> str | None:
    """Control point of a block, or None for a block of images."""
    return block_id.removeprefix(CONTROL_PREFIX) if block_id.startswith(CONTROL_PREFIX) else None


def control_blocks(points: PointTable, ellipsoid: Ellipsoid, source: str) -> Iterator[Block]:
    """A block for every control point: two views of it along the principal axes of its covariance (see `submin.sensors.survey`).

    Covariances must be positive definite; ``source`` says in messages where the points come from.

    Raises
    ------
    InputError
        At once, when the points are correlated: this release takes points with a covariance each.
    """
    if points.joint_covariance is not None:
        raise InputError(
            f"{source}: the points have a joint covariance (covariance_row); expected points with a covariance each "
            "(cov_ee to cov_uu, or sigmas): correlated control is not taken yet"
        )
    return _blocks(points, ellipsoid)


def _blocks(points: PointTable, ellipsoid: Ellipsoid) -> Iterator[Block]:
    geocentric = geodetic_to_geocentric(points.geodetic, ellipsoid)
    axes = local_axes(points.geodetic)
    for k, point_id in enumerate(points.point_ids.tolist()):
        variances, vectors = np.linalg.eigh(axes[k].T @ points.covariance_enu[k] @ axes[k])
        along, sigma = vectors.T[::-1], np.sqrt(variances[::-1])  # the two weakest axes, then the best one by itself
        views = ((along[:2], sigma[:2]), (np.stack([along[2], np.zeros(3)]), np.array([sigma[2], 1.0])))
        block_id = control_block_id(point_id)
        images = tuple(
            ImageRecord(f"{block_id}:{n}", block_id, block_id, "survey", "survey", json.dumps({
                "origin": geocentric[k].tolist(), "axes": view.tolist(), "place": points.geodetic[k].tolist(),
            }), 1, 1)
            for n, (view, _) in enumerate(views)
        )  # fmt: skip
        sigmas = np.stack([s for _, s in views])
        yield Block(
            block_id, images, None, np.array([point_id, point_id]), np.arange(2, dtype=np.int32),
            np.zeros(2), np.zeros(2), sigmas[:, 0], sigmas[:, 1],
            # as surveyed: eigenvectors differ in their last digits, or altogether, from one machine to another
            content=json.dumps([point_id, points.geodetic[k].tolist(), points.covariance_enu[k].tolist()]),
        )  # fmt: skip
