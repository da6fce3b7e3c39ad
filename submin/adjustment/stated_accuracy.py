"""A priori model of RPC images from the accuracy that their files state, in metres on the ground.

RPC00B has two numbers (STDI-0002, appendix E): ``ERR_BIAS``, RMS in metres along each horizontal axis of the error that does not vary with
time, and ``ERR_RAND`` of the one that does. The first is a shift of the whole image, of which images of one pass share a part; the second
varies within the image: it counts in the shift too, and is the drift that an image may have at its edge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from submin.adjustment.priors import APriori
from submin.sensors.base import Array


def stated_a_priori(cameras: Sequence[Mapping[str, Any]], pixels: Array, default: APriori) -> APriori | None:
    """What the files of a block's RPC images state: the largest sigmas of any of them; None unless all state a positive ``ERR_BIAS``.

    Parameters
    ----------
    cameras : camera descriptions of the m images
    pixels : (m,) size of a pixel of each on the ground, metres
    default : what is believed of all else, and of the drift where an image does not state its ``ERR_RAND``
    """
    bias, random = (np.array([float(camera.get(name, 0.0)) for camera in cameras]) for name in ("ERR_BIAS", "ERR_RAND"))
    if not (np.isfinite(bias) & (bias > 0.0)).all():
        return None
    stated = np.isfinite(random) & (random > 0.0)  # unknown is written as 0 or as -1
    random = np.where(stated, random, 0.0)
    drift = np.where(stated, random / pixels, default.drift_px)
    return replace(default, bias_px=float((np.hypot(bias, random) / pixels).max()), drift_px=float(drift.max()))
