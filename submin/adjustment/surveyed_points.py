"""Surveyed points that an adjustment finds to contradict the rays: what is said of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.adjustment import Adjustment
from submin.adjustment.images import ImageSet
from submin.adjustment.rays import Rays
from submin.geodesy import local_axes
from submin.sensors import SURVEYS
from submin.sensors.survey import surveyed_axes, surveyed_place

Array = NDArray[np.float64]
LEAST_RAYS = 2
"""With fewer accepted rays nothing is left that places a point against its survey."""


@dataclass(frozen=True)
class ContradictedPoint:
    """A surveyed point that contradicts the network and the points surveyed with it, so that it is not used, in part or as a whole."""

    point_id: str
    reason: str


def contradicted_points(
    images: ImageSet, rays: Rays, result: Adjustment, ids: NDArray[np.str_], among: NDArray[np.bool_]
) -> tuple[ContradictedPoint, ...]:  # fmt: skip
    """Points, of those where ``among`` (n,) is True, of which a survey's ray is rejected; ``ids`` (n,) are their names."""
    surveyed = np.isin(images.sensors, SURVEYS)[rays.image]
    lost = surveyed & ~result.accepted & among[rays.point]
    left = np.bincount(rays.point[result.accepted], minlength=len(ids))
    found = []
    for j in np.unique(rays.point[lost]).tolist():
        of_point = rays.point == j
        whole = not (surveyed & result.accepted & of_point).any()
        found.append(
            ContradictedPoint(str(ids[j]), _reason(images, rays, result, str(ids[j]), np.flatnonzero(lost & of_point), left[j], whole))
        )
    return tuple(found)


def _reason(images: ImageSet, rays: Rays, result: Adjustment, name: str, lost: NDArray[np.int64], left: int, whole: bool) -> str:
    """``lost`` are the rejected rays of the survey, ``whole`` when there are no others; ``left`` rays of the point are accepted."""
    worst = float(result.statistic[lost].max())
    if left < LEAST_RAYS:
        return f"control point {name} and the rays of its point contradict each other (test statistic {worst:.1f}); none of them is used"
    views, ground = rays.image[lost], result.ground[rays.point[lost[0]]]
    axes = surveyed_axes(images.cameras[views])
    origin, place = surveyed_place(images.cameras[views])
    # what the errors of the other points make likely of this one's is no contradiction
    along = np.einsum("rck,rk->rc", axes, origin - ground) - result.theta[views, :2] * axes.any(axis=2)
    east, north, up = local_axes(place[:1])[0] @ np.einsum("rc,rck->k", along, axes)
    return (
        f"control point {name} lies {east:.3g} m east, {north:.3g} m north, {up:.3g} m up of where the network has it "
        f"(test statistic {worst:.1f}); it is not used{'' if whole else ' in these directions'}"
    )
