"""How an adjustment ended, and what to do when it did not converge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, moved_by_ground, moved_rays
from submin.adjustment.weak_geometry import UNDETERMINED_DEGREES, convergence_angles

Array = NDArray[np.float64]

FORMLESS = 0.5
"""Part of the rays that must agree with each other for the others to be called blunders."""


class Cause(Enum):
    """Why an adjustment ended."""

    CONVERGED = "converged"
    UNSEEN = "a camera does not see its ground"
    FEW_AGREE = "most rays contradict each other"
    DECISIONS = "rays are rejected and taken back in turn"
    SINGULAR = "points are seen from one direction only"
    ADRIFT = "most points run away along their rays"
    CAMERA = "a camera moves on and on"
    POINT = "a point moves on and on"


@dataclass(frozen=True)
class Status:
    """How an adjustment ended.

    Attributes
    ----------
    cause : why it ended, and what is wrong with it
    converged : all decisions stood and nothing was left to be moved; so may an adjustment end whose cause is ``UNSEEN``, without these rays
    iterations : how many steps there were
    image, point : row of the worst image and point, -1 where the cause names none
    amount : rays that agree (``FEW_AGREE``), convergence angle in degrees (``SINGULAR``), or the last step (``CAMERA``: the farthest that
        a ray was moved, in sigmas; ``POINT``: metres)
    """

    cause: Cause
    converged: bool
    iterations: int
    image: int = -1
    point: int = -1
    amount: float = 0.0

    def message(self, image_ids: Sequence[str], point_ids: Sequence[str] | NDArray[np.str_]) -> str:
        """The cause as a sentence that names image and point, and what to do."""
        image = image_ids[self.image] if self.image >= 0 else ""
        point = str(point_ids[self.point]) if self.point >= 0 else ""
        steps = f"the adjustment did not converge in {self.iterations} iterations"
        match self.cause:
            case Cause.CONVERGED:
                return f"converged in {self.iterations} iterations"
            case Cause.UNSEEN:
                return f"image {image}: its camera does not see the ground at point {point}; check the camera model and the axis order"
            case Cause.FEW_AGREE:
                return (
                    f"{steps}: only {self.amount:.0%} of the rays agree with each other; "
                    "check the order of sample and line, the point ids and the cameras"
                )
            case Cause.DECISIONS:
                return (
                    f"{steps}: a ray of point {point} in image {image} is rejected and taken back in turn; "
                    "remove it, or give the measurements their true sigmas"
                )
            case Cause.SINGULAR:
                return (
                    f"{steps}: point {point} is seen from one direction only (its rays meet at {self.amount:.2g} degrees); "
                    "add an image from another direction, or heights of the points"
                )
            case Cause.ADRIFT:
                return (
                    f"most points, {point} among them, run away along their rays, farther than the cameras can be linearised; "
                    "add images from other directions, control, or smaller a priori sigmas"
                )
            case Cause.CAMERA:
                return (
                    f"{steps}: the correction of image {image} still moves its rays by {self.amount:.2g} sigmas; "
                    "check its camera and measurements, or give it a smaller a priori sigma"
                )
            case Cause.POINT:
                return f"{steps}: point {point} still moves by {self.amount:.2g} m; check its measurements, or remove it"


def unseen_image(linear: LinearRays, candidates: NDArray[np.bool_], seen: NDArray[np.bool_]) -> tuple[int, int] | None:
    """An image that sees nothing of what its candidate rays (r,) were measured of, and the point of the first; None if there is none."""
    if seen.all():
        return None
    measured = np.bincount(linear.image[candidates])
    blind = np.flatnonzero((measured > 0) & (np.bincount(linear.image[candidates & seen], minlength=len(measured)) == 0))
    if not len(blind):
        return None
    ray = int(np.flatnonzero(candidates & (linear.image == blind[0]))[0])
    return int(blind[0]), int(np.searchsorted(linear.first, ray, side="right")) - 1


def diagnose(
    linear: LinearRays, weight: Array, step: tuple[Array, Array], decided: NDArray[np.bool_], iterations: int, still: float
) -> Status:
    """Why an adjustment ran out of iterations.

    Parameters
    ----------
    linear, weight : the rays at the last state, and which of them take part
    step : last changes of the images' corrections (m, p) and of the points (n, 3), metres
    decided : (r,) True for rays about which the last judgement changed its mind
    still : a ray that moves by less, in sigmas, does not move
    """
    used = weight > 0.0
    agreeing = float(used.mean()) if len(used) else 0.0
    if agreeing < FORMLESS:
        return Status(Cause.FEW_AGREE, False, iterations, amount=agreeing)
    point = np.repeat(np.arange(len(linear.first) - 1), np.diff(linear.first))
    by_image = np.where(used, np.abs(moved_rays(linear, step[0])).max(axis=1), 0.0)
    by_ground = np.where(used, np.abs(moved_by_ground(linear, step[1])).max(axis=1), 0.0)
    worst = int(np.argmax(np.maximum(by_image, by_ground)))
    if max(by_image[worst], by_ground[worst]) < still and decided.any():
        worst = int(np.argmax(decided))
        return Status(Cause.DECISIONS, False, iterations, int(linear.image[worst]), int(point[worst]))
    angles = convergence_angles(linear, weight)
    met = np.isfinite(angles)
    if met.any() and np.median(angles[met]) < UNDETERMINED_DEGREES:
        narrow = int(np.nanargmin(angles))
        return Status(Cause.SINGULAR, False, iterations, point=narrow, amount=float(angles[narrow]))
    if by_image[worst] >= by_ground[worst]:
        return Status(Cause.CAMERA, False, iterations, int(linear.image[worst]), amount=float(by_image[worst]))
    return Status(Cause.POINT, False, iterations, point=int(point[worst]), amount=float(np.linalg.norm(step[1][point[worst]])))
