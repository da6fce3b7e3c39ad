"""Errors of measurements add up to no drift: images are not made larger, nor a network smaller, by what is only noise (decision 018).

Images of small format, where an error of a measurement is a large part of it, show in one block what takes a continent of large ones. A
drift that all images have in common is the weak direction: the ground takes it up, and only the a priori model holds it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from submin.adjustment.adjustment import adjust
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geodetic_to_geocentric
from submin.sensors import sensor_named

Array = NDArray[np.float64]

RPC = sensor_named("rpc")
HALF = 50.0
SIGMA_PX = 0.5
POINTS = 1200
BLOCKS = 4
VIEWS = (-0.5, 0.0, 0.5)
"""Tangents of the views along the track."""
DRIFT = 0.5
"""A priori sigma, pixels at the edge."""


def camera(tangent: float) -> dict[str, Any]:
    """RPC of a parallel view, 5 m pixels near the equator, which leans by this tangent along the lines."""
    numerator = np.zeros((2, 20))
    numerator[0, 1], numerator[1, 2], numerator[1, 3] = 1.0, -1.0, -tangent
    one = [1.0, *([0.0] * 19)]
    return {
        "LINE_OFF": HALF - 0.5, "SAMP_OFF": HALF - 0.5, "LAT_OFF": 0.0, "LONG_OFF": 20.0, "HEIGHT_OFF": 0.0,
        "LINE_SCALE": HALF, "SAMP_SCALE": HALF, "LAT_SCALE": HALF * 5.0 / 110574.0, "LONG_SCALE": HALF * 5.0 / 111320.0,
        "HEIGHT_SCALE": HALF * 5.0,
        "SAMP_NUM_COEFF": numerator[0].tolist(), "LINE_NUM_COEFF": numerator[1].tolist(), "SAMP_DEN_COEFF": one, "LINE_DEN_COEFF": one,
    }  # fmt: skip


def images() -> ImageSet:
    cameras = np.stack([RPC.pack(camera(view), 2.0 * HALF, 2.0 * HALF) for view in VIEWS])
    prior = ImagePrior("block", "pass", 0.0, APriori(bias_px=3.0, drift_px=DRIFT), RPC.parameters)
    return ImageSet(tuple("abc"), ("rpc",) * 3, cameras, (prior,) * 3, len(RPC.parameters))


@pytest.mark.parametrize("seed", range(BLOCKS))
def test_a_common_drift_is_no_more_than_its_own_noise(seed: int) -> None:
    rng, members = np.random.default_rng(seed), images()
    place = rng.uniform(-0.9, 0.9, (POINTS, 3)) * [HALF * 5.0 / 111320.0, HALF * 5.0 / 110574.0, 20.0]
    ground = geodetic_to_geocentric(place + np.array([20.0, 0.0, 0.0]))
    point, image = (index.ravel().astype(np.int32) for index in np.indices((POINTS, len(VIEWS))))
    exact = members.project(np.zeros((3, 6)), members.ground(ground), image, point).image
    observed = exact + rng.normal(0.0, SIGMA_PX, exact.shape)
    rays = sorted_rays(point, image, observed, np.full(exact.shape, SIGMA_PX), np.ones(len(point), dtype=np.bool_))
    found = adjust(members, rays, intersect(members, rays, POINTS))
    assert found.converged
    common = found.theta[:, [1, 5]].mean(axis=0)
    # no error of a camera was made: what is left comes through the measurements, whose own part is a few hundredths of a pixel. With drift
    # at the measured coordinates it was 5.4 px in the samples and 3.9 px in the lines, whatever the seed
    assert np.abs(common).max() < 0.1, common
