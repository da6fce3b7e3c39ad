"""How far off on the ground a ray may be before any adjustment: what is believed of its camera, and of its measurement.

Bounds in metres that catch mistakes (two places under one id, a point that runs away along its rays) hold for cameras known to metres.
Where cameras are known to kilometres only, those explain more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from submin.sensors import Projection

Array = NDArray[np.float64]

EXPLAINED_SIGMAS = 4.0
"""What is so many a priori sigmas off has another reason."""


def explained_metres(projection: Projection, prior_variance: Array, sigma: Array) -> Array:
    """Metres (r,) on the ground, across each ray, that are `EXPLAINED_SIGMAS` of its camera and measurement; 0 for a ray without ground.

    Parameters
    ----------
    projection : of the rays, unadjusted cameras
    prior_variance : (r, p), a priori, of the parameters of each ray's image
    sigma : (r, 2), of the measurements
    """
    in_image = np.einsum("rcp,rp->r", projection.by_parameters**2, prior_variance) + (sigma**2).sum(axis=1)
    by_metre = 0.5 * (projection.by_ground**2).sum(axis=(1, 2))
    square = np.divide(in_image, by_metre, out=np.zeros_like(in_image), where=by_metre > 0.0)
    return np.asarray(EXPLAINED_SIGMAS * np.sqrt(square))
