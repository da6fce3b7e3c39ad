"""Compile the kernels in one process before workers start, so that they find them in the cache instead of each compiling their own."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from submin.adjustment.adjustment import adjust
from submin.adjustment.elimination import linearise, moved_by_ground, point_factors
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import sorted_rays
from submin.adjustment.symmetric import DENSE_SIZE, add_into, between, fill_symmetric, packed, permuted, unpacked
from submin.network.id_hash import hash_ids, look_up
from submin.network.sub_min import GroundPart, loadings
from submin.query.spread import spread_rows
from submin.sensors import sensor_named


def compile_kernels() -> None:
    """Adjust two points in two images, and test them by a network: every kernel that a run needs; a second when they are in the cache.

    A kernel that is not called here is compiled by each worker for itself (`tests/orchestration/test_warm_up.py`).
    """
    first_order, one = np.zeros(20), np.zeros(20)
    one[0] = 1.0
    cameras = []
    for tilt in (-0.5, 0.5):
        camera = dict.fromkeys(("LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF"), 0.0)
        camera |= dict.fromkeys(("LINE_SCALE", "SAMP_SCALE", "HEIGHT_SCALE"), 1000.0) | dict.fromkeys(("LAT_SCALE", "LONG_SCALE"), 0.01)
        samples, lines = first_order.copy(), first_order.copy()
        samples[1], lines[2], lines[3] = 1.0, 1.0, tilt
        polynomials = {"SAMP_NUM_COEFF": samples, "SAMP_DEN_COEFF": one, "LINE_NUM_COEFF": lines, "LINE_DEN_COEFF": one}
        cameras.append(sensor_named("rpc").pack(camera | polynomials, 2000, 2000))
    priors = tuple(ImagePrior("warm", "up", float("nan"), APriori(), sensor_named("rpc").parameters) for _ in cameras)
    images = ImageSet(("a", "b"), ("rpc", "rpc"), np.array(cameras), priors, len(sensor_named("rpc").parameters))
    index = np.array([0, 0, 1, 1], dtype=np.int32)
    observed = np.array([[10.0, 20.0], [10.5, 20.0], [90.0, 70.0], [90.0, 71.0]])
    image = np.array([0, 1, 0, 1], dtype=np.int32)
    rays = sorted_rays(index, image, observed, np.full((4, 2), 0.5), np.ones(4, dtype=np.bool_))
    ground = intersect(images, rays, 2)
    adjust(images, rays, ground)
    images.localise(image, observed)
    linear = linearise(images, rays, np.zeros((2, images.parameters)), ground, ground)
    moved_by_ground(linear, np.zeros((2, 3)))
    # what a cell keeps of its points, what a record keeps of a covariance, and which points a block is tested by
    loadings([GroundPart(ground, linear, point_factors(linear, np.ones(4)))], np.arange(2, dtype=np.int32), images.parameters)
    unpacked(packed(np.eye(2)))
    spread_rows(np.arange(6.0).reshape(3, 2), np.ones(3), np.array(["a", "b", "c"]), 2)
    look_up([(hash_ids(np.array(["a"])), np.zeros(1, dtype=np.int64))], hash_ids(np.array(["a"])))
    # the sums of a tile are large and sparse, which those of two images are not
    many = DENSE_SIZE + 1
    add_into(np.zeros((many, many)), permuted(np.eye(many), np.arange(many), 1), np.arange(many), 1)
    between(sp.eye_array(many, format="csr"), fill_symmetric(np.eye(many, order="F")).T)
