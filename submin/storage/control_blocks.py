"""Surveyed points as blocks, so that they are entered, counted once and withdrawn as images are.

A point whose errors are its own is a block. Points with a joint covariance are one: what is known of any of them depends on all.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.joint_errors import joint_errors
from submin.errors import InputError
from submin.geodesy import Ellipsoid, geocentric_to_geodetic, geodetic_to_geocentric, local_axes, rotate_covariance
from submin.network.observations import Cluster
from submin.storage.catalogue_schema import CONTROL_PREFIX, Block, ImageRecord, PointTable

Array = NDArray[np.float64]

SET_PREFIX = CONTROL_PREFIX + "set:"
"""Begins the block id of a set of correlated points."""
SAME_COVARIANCE = 1e-6
"""Part of its largest element by which the covariance of a point may differ from its block of the joint one: written with fewer digits."""


def control_block_id(point_id: str) -> str:
    """Block of a control point that came by itself."""
    return CONTROL_PREFIX + point_id


def control_set_id(point_ids: NDArray[np.str_]) -> str:
    """Block of control points with a joint covariance, whatever their order."""
    ids = np.sort(point_ids).tolist()
    digest = hashlib.blake2b("\n".join(ids).encode(), digest_size=3).hexdigest()
    return f"{SET_PREFIX}{ids[0]}+{len(ids) - 1}:{digest}"


def view_id(point_id: str, number: int) -> str:
    """Image id of a view of a surveyed point, whatever it came with."""
    return f"{CONTROL_PREFIX}{point_id}:{number}"


def point_of_view(image_id: str) -> str | None:
    """The surveyed point of a view, or None for an image."""
    return image_id.removeprefix(CONTROL_PREFIX).rpartition(":")[0] if image_id.startswith(CONTROL_PREFIX) else None


def points_of(block: Block) -> tuple[str, ...]:
    """Surveyed points of a block, none for one of images."""
    return () if block.kind == "images" else tuple(np.unique(block.point_ids).tolist())


def control_blocks(points: PointTable, ellipsoid: Ellipsoid, source: str) -> Iterator[Block]:
    """Blocks of control points: one for every point, or, where they have a joint covariance, one for all.

    Covariances must be positive definite; ``source`` says in messages where the points come from.

    Raises
    ------
    InputError
        At once, when a joint covariance is none, or contradicts the covariance that a point has beside it.
    """
    if points.joint_covariance is None or len(points) < 2:
        return _blocks(points, ellipsoid)
    order = np.argsort(points.point_ids)
    axes = local_axes(points.geodetic)
    own = points.joint_covariance.reshape(len(points), 3, len(points), 3)[np.arange(len(points)), :, np.arange(len(points)), :]
    largest = np.abs(points.covariance_enu).max(axis=(1, 2))
    differs = np.abs(rotate_covariance(own, axes) - points.covariance_enu).max(axis=(1, 2)) > SAME_COVARIANCE * largest
    if differs.any():
        row = int(np.argmax(differs))
        raise InputError(
            f"{source}: row {row + 1}: the covariance of point {points.point_ids[row]} is not that in the joint one (covariance_row); "
            "expected the same, along geocentric axes in covariance_row and along local ones beside it"
        )
    at = (3 * order[:, None] + np.arange(3)).ravel()
    ids = points.point_ids[order]
    joint = points.joint_covariance[np.ix_(at, at)]
    place = points.geodetic[order]
    said = f"{source}: the joint covariance (covariance_row)"
    return iter([_set(control_set_id(ids), "control", ids, geodetic_to_geocentric(place, ellipsoid), place, joint, said)])


def observed_positions(cluster: Cluster, ellipsoid: Ellipsoid, source: str) -> Block:
    """A cluster of positions as a block of correlated control.

    Raises
    ------
    InputError
        When the cluster holds baselines, a position twice, or a covariance that is none.
    """
    if not cluster.positions.all():
        k = int(np.argmin(cluster.positions))
        raise InputError(
            f"{source}: cluster {cluster.cluster_id}: baseline from {cluster.from_ids[k]} to {cluster.to_ids[k]}; expected positions: "
            "baselines enter a network of the dense form (submin create NETWORK --form dense)"
        )
    ids, first, count = np.unique(cluster.from_ids, return_index=True, return_counts=True)
    if (count > 1).any():
        raise InputError(f"{source}: cluster {cluster.cluster_id}: position of {ids[np.argmax(count)]} comes twice; expected it once")
    at = (3 * first[:, None] + np.arange(3)).ravel()
    place, covariance = cluster.values[first], cluster.covariance[np.ix_(at, at)]
    said = f"{source}: the covariance of cluster {cluster.cluster_id}"
    return _set(cluster.cluster_id, "observations", ids, place, geocentric_to_geodetic(place, ellipsoid), covariance, said)


def _blocks(points: PointTable, ellipsoid: Ellipsoid) -> Iterator[Block]:
    geocentric = geodetic_to_geocentric(points.geodetic, ellipsoid)
    axes = local_axes(points.geodetic)
    for k, point_id in enumerate(points.point_ids.tolist()):
        variances, vectors = np.linalg.eigh(axes[k].T @ points.covariance_enu[k] @ axes[k])
        along, sigma = vectors.T[::-1], np.sqrt(variances[::-1])  # the two weakest axes, then the best one by itself
        block_id = control_block_id(point_id)
        yield Block(
            block_id, _views(point_id, block_id, "survey", geocentric[k], points.geodetic[k], along), None,
            np.array([point_id, point_id]), np.arange(2, dtype=np.int32), np.zeros(2), np.zeros(2),
            np.array([sigma[0], sigma[2]]), np.array([sigma[1], 1.0]),
            # as surveyed: eigenvectors differ in their last digits, or altogether, from one machine to another
            content=json.dumps([point_id, points.geodetic[k].tolist(), points.covariance_enu[k].tolist()]), kind="control",
        )  # fmt: skip


def _set(
    block_id: str, kind: str, ids: NDArray[np.str_], geocentric: Array, geodetic: Array, covariance: Array, said: str
) -> Block:  # fmt: skip
    """A block of points, ids ascending, with their joint covariance (3n, 3n), geocentric; ``said`` begins what is wrong with that."""
    n, axes = len(ids), local_axes(geodetic)
    rows = np.einsum("kij,kjm->kim", axes, covariance.reshape(n, 3, 3 * n))
    local = np.einsum("kij,mkj->mki", axes, rows.reshape(3 * n, n, 3)).reshape(3 * n, 3 * n)
    try:
        joint = joint_errors(0.5 * (local + local.T))
    except InputError as error:
        raise InputError(f"{said} of {n} points {error}") from None
    images = tuple(
        view for k, name in enumerate(ids.tolist()) for view in _views(name, block_id, "survey set", geocentric[k], geodetic[k], axes[k])
    )
    sigma = np.sqrt(joint.variance).reshape(n, 3)
    digest = hashlib.blake2b(np.ascontiguousarray(covariance + 0.0, dtype="<f8").tobytes(), digest_size=32).hexdigest()
    return Block(
        block_id, images, None, np.repeat(ids, 2), np.arange(2 * n, dtype=np.int32), np.zeros(2 * n), np.zeros(2 * n),
        sigma[:, [0, 2]].ravel(), np.column_stack([sigma[:, 1], np.ones(n)]).ravel(),
        content=json.dumps([ids.tolist(), geodetic.tolist(), digest]), kind=kind, joint=joint,
    )  # fmt: skip


def _views(point_id: str, block_id: str, sensor: str, origin: Array, place: Array, axes: Array) -> tuple[ImageRecord, ImageRecord]:
    """A point along two axes, and along the third by itself; ``axes`` (3, 3) in rows, geocentric."""
    first, second = (
        ImageRecord(view_id(point_id, n), block_id, block_id, "survey", sensor, json.dumps({
            "origin": origin.tolist(), "axes": view.tolist(), "place": place.tolist(),
        }), 1, 1)
        for n, view in enumerate((axes[:2], np.stack([axes[2], np.zeros(3)])))
    )  # fmt: skip
    return first, second
