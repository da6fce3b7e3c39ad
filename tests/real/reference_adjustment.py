"""One simultaneous adjustment of all images and all ground points, by plain numpy and scipy: what a network must equal.

The unknowns are the total corrections ``theta`` (m, 6) of all images, pixels, and the coordinates of all ground points about fixed origins,
``x - x0`` (n, 3), metres. The observations are the accepted rays and, for the images, ``0 = theta + e`` with a dense a priori covariance Q. Nothing is
eliminated, nothing is whitened, no normal matrix is formed: with all observations ``y = J p + e``, ``Cov e = R``, one sparse factorisation of

    [ R   J ] [ lambda ]   [ y ]
    [ J'  0 ] [   p    ] = [ 0 ]

gives the estimate, and with ``-1`` at unknown k and zeros elsewhere on the right column k of the covariance of ``p`` (Bjoerck, Numerical Methods for Least
Squares Problems, section 2.5.3, "augmented system"). Its error grows with the condition of J, not with that of J'J.

From the product come the camera model (tested against GDAL), the unpacking of a catalogue's camera, and what is stored: rays, decisions, linearisation.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from submin.sensors import Ground, sensor_named
from submin.storage.network_store import Snapshot

Array = NDArray[np.float64]
Index = NDArray[np.int64]

P = 6
"""Adjustable parameters of an RPC: three for the sample, three for the line, each a shift and two drifts."""
SHIFTS = (0, 3)
RELEASE = 100.0
"""Factor on the sigmas of an image's own part once its camera was found bad (decision 004)."""
CHUNK = 64


@dataclass(frozen=True)
class Observations:
    """Accepted rays of the points that they determine, with the state at which each is linearised.

    Attributes
    ----------
    point_ids : (n,) ascending; origin : (n, 3) of their coordinates, geocentric metres
    image_ids : (m,) as the network lists them; cameras : (m, 94); prior : (m 6, m 6) Q, pixels squared
    point, image : (r,) rows of these; observed, sigma : (r, 2) pixels
    theta : (r, 6) corrections of the ray's image and ground : (r, 3) position of its point where the ray is linearised
    """

    point_ids: NDArray[np.str_]
    origin: Array
    image_ids: tuple[str, ...]
    cameras: Array
    prior: Array
    point: Index
    image: Index
    observed: Array
    sigma: Array
    theta: Array
    ground: Array


def prior_covariance(images: Sequence[tuple[str, bool, str]]) -> Array:
    """A priori covariance Q (6 m, 6 m), pixels squared, of the total corrections of m images.

    Each image is given by pass, released or not, and the JSON text of its a priori model, in which images of a block are uncorrelated. An image's own part has
    the drifts and what is left of the shifts' variance; its pass has the rest, the same for all its images, released ones too.
    """
    covariance = np.zeros((P * len(images), P * len(images)))
    for i, (pass_i, released, text) in enumerate(images):
        model = json.loads(text)
        assert model["correlation"] == "none", "the reference knows no correlation within a block"
        common = model["common_to_pass"]
        own = np.full(P, model["drift_px"] ** 2)
        own[list(SHIFTS)] = (1.0 - common) * model["bias_px"] ** 2
        covariance[P * i : P * i + P, P * i : P * i + P] += np.diag(own * (RELEASE**2 if released else 1.0))
        for k, (pass_k, _, _) in enumerate(images):
            if pass_k == pass_i:
                for c in SHIFTS:
                    covariance[P * i + c, P * k + c] += common * model["bias_px"] ** 2
    return covariance


def stored_observations(snapshot: Snapshot) -> Observations:
    """Everything that a network of RPC images has accepted, at the linearisation that each of its cells keeps.

    A point with one accepted ray has fewer observations than coordinates: it says nothing about images and has no place; it is left out.
    """
    listed = snapshot.images()
    sensor = sensor_named("rpc")
    assert {image.sensor for image in listed} == {"rpc"}
    columns: list[list[NDArray[np.generic]]] = [[] for _ in range(8)]
    for number in snapshot.cell_numbers():
        cell = snapshot.cell(number, with_sums=False)
        rays = cell.rays
        seen = rays.accepted & (np.bincount(rays.point[rays.accepted], minlength=len(cell))[rays.point] >= 2)
        at = rays.point[seen]
        values = (
            cell.point_ids[at], cell.images[rays.image[seen]], rays.observed[seen], rays.sigma[seen], cell.theta[rays.image[seen]],
            cell.linearised_at[at], cell.origin[at], np.full(len(at), number),
        )  # fmt: skip
        for column, value in zip(columns, values, strict=True):
            column.append(value)
    ids, image, observed, sigma, theta, ground, origin, cells = (np.concatenate(column) for column in columns)
    point_ids, first, point = np.unique(ids, return_index=True, return_inverse=True)
    assert np.array_equal(cells, cells[first][point]), "a point has rays in two cells"
    return Observations(
        point_ids.astype(np.str_), origin[first].astype(np.float64), tuple(i.image_id for i in listed),
        np.stack([sensor.pack(json.loads(i.camera), i.width, i.height) for i in listed]),
        prior_covariance([(i.pass_id, i.released, i.a_priori) for i in listed]),
        point, image.astype(np.int64), observed.astype(np.float64), sigma.astype(np.float64), theta.astype(np.float64), ground.astype(np.float64),
    )  # fmt: skip


@dataclass(frozen=True)
class Solution:
    """A simultaneous adjustment at one linearisation.

    Attributes
    ----------
    point_ids : (n,) ascending; origin : (n, 3)
    theta : (m, 6) corrections of the images, pixels; correction : (n, 3) ``x - x0``, geocentric metres
    chi_square : weighted squares of the residuals of all observations, a priori ones included
    """

    point_ids: NDArray[np.str_]
    origin: Array
    theta: Array
    correction: Array
    chi_square: float
    factor: SuperLU
    system: sp.csc_array

    @property
    def geocentric(self) -> Array:
        """Positions (n, 3), metres."""
        return self.origin + self.correction

    @cached_property
    def _unknowns_at(self) -> int:
        return int(self.system.shape[0]) - self.theta.size - self.correction.size

    def covariance(self, point_ids: NDArray[np.str_]) -> Array:
        """Joint covariance (3k, 3k) of some points, geocentric square metres, point-major in the order given."""
        row = np.searchsorted(self.point_ids, point_ids)
        assert np.array_equal(self.point_ids[row], point_ids)
        at = self._unknowns_at + self.theta.size + (3 * row[:, None] + np.arange(3)).ravel()
        columns = []
        for start in range(0, len(at), CHUNK):
            chosen = at[start : start + CHUNK]
            right = np.zeros((self.system.shape[0], len(chosen)))
            right[chosen, np.arange(len(chosen))] = -1.0
            columns.append(_solve(self.factor, self.system, right)[at])
        return np.concatenate(columns, axis=1)


def adjust_simultaneously(observations: Observations) -> Solution:
    """The linear least-squares solution at the given linearisation, all images and points at once."""
    o, rays = observations, len(observations.point)
    m, n = len(o.image_ids), len(o.point_ids)
    sensor, each = sensor_named("rpc"), np.arange(rays, dtype=np.int32)
    # every ray has a state of its own: cells are linearised apart
    projection = sensor.project(o.cameras[o.image], o.theta, Ground.at(o.ground), each, each)
    y = o.observed - projection.image
    y += (projection.by_parameters @ o.theta[:, :, None])[:, :, 0]
    y += (projection.by_ground @ (o.ground - o.origin[o.point])[:, :, None])[:, :, 0]

    observed = (2 * each[:, None] + np.arange(2))[:, :, None]
    by_image = P * o.image[:, None, None] + np.arange(P)
    by_point = P * m + 3 * o.point[:, None, None] + np.arange(3)
    rows = np.concatenate([np.broadcast_to(observed, (rays, 2, P)).ravel(), np.broadcast_to(observed, (rays, 2, 3)).ravel()])
    at = np.concatenate([np.broadcast_to(by_image, (rays, 2, P)).ravel(), np.broadcast_to(by_point, (rays, 2, 3)).ravel()])
    values = np.concatenate([projection.by_parameters.ravel(), projection.by_ground.ravel()])
    measured = sp.coo_array((values, (rows, at)), shape=(2 * rays, P * m + 3 * n))
    believed = sp.eye_array(P * m, P * m + 3 * n)
    design = sp.vstack([measured, believed]).tocsr()
    noise = sp.block_diag([sp.diags_array(o.sigma.ravel() ** 2), sp.csr_array(o.prior)])
    system = sp.block_array([[noise, design], [design.T, None]], format="csc")
    right = np.concatenate([y.ravel(), np.zeros(system.shape[0] - 2 * rays)])
    factor = splu(system)
    solved = _solve(factor, system, right[:, None])[:, 0]
    unknown = solved[design.shape[0] :]
    multiplier = solved[: design.shape[0]]
    return Solution(
        o.point_ids, o.origin, unknown[: P * m].reshape(m, P), unknown[P * m :].reshape(n, 3), float(multiplier @ (noise @ multiplier)),
        factor, system,
    )  # fmt: skip


def _solve(factor: SuperLU, system: sp.csc_array, right: Array) -> Array:
    """Solution with one step of iterative refinement, which also hides nothing: a poor factor would show in the comparison."""
    solved = factor.solve(right)
    return np.asarray(solved + factor.solve(right - system @ solved))
