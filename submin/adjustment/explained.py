"""How far off on the ground a ray may be before any adjustment: what is believed of its camera, and of its measurement.

Bounds in metres that catch mistakes (two places under one id, a point that runs away along its rays) hold for cameras known to metres.
Where cameras are known to kilometres only, those explain more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EXPLAINED_SIGMAS = 4.0
"""What is so many a priori sigmas off has another reason."""


def explained_metres(by_ground: Array, by_parameters: Array, prior_variance: Array) -> Array:
    """Metres (r,) on the ground, across each ray, that are `EXPLAINED_SIGMAS` of its camera and measurement; 0 for a ray without ground.

    Parameters
    ----------
    by_ground, by_parameters : (r, 2, 3), (r, 2, p), partials of the rays at unadjusted cameras, in sigmas of the measurements
    prior_variance : (r, p), a priori, of the parameters of each ray's image
    """
    in_sigmas = np.einsum("rcp,rcp,rp->r", by_parameters, by_parameters, prior_variance) + 2.0
    by_metre = 0.5 * np.einsum("rck,rck->r", by_ground, by_ground)
    square = np.divide(in_sigmas, by_metre, out=np.zeros_like(in_sigmas), where=by_metre > 0.0)
    return np.asarray(EXPLAINED_SIGMAS * np.sqrt(square))
