"""One simultaneous adjustment of all images and all ground points, by plain numpy and scipy: what a network must equal.

The unknowns are the coordinates of all ground points about fixed origins, ``x - x0`` (n, 3), metres, and the *total* corrections
``theta`` (m, 6) of all images, pixels. The observations are the accepted rays and ``0 = theta + e`` with a dense a priori covariance Q.
All of them, divided by their standard deviations, are the rows of one sparse design matrix J; its normal matrix J'J is factored whole by
a general sparse solver, and every solution is refined with residuals formed from J itself. Nothing is eliminated by hand; there are no
vectors of passes, no cells, no tiles.

From the product come the camera model (tested against GDAL by itself), and what is stored: rays, decisions, linearisation, descriptions of
images.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu

from submin.sensors import Ground, sensor_named
from submin.storage.snapshot import Snapshot

Array = NDArray[np.float64]
Index = NDArray[np.int64]

P = 6
"""Adjustable parameters of an RPC: three for the sample, three for the line, each a shift and two drifts."""
SHIFTS = (0, 3)
RELEASE = 100.0
"""Factor on the sigmas of an image once its camera was found bad (decision 004)."""

CONVERGED_METRES = 1e-8
CONVERGED_PIXELS = 1e-8
REFINEMENTS = 2
COLUMNS_AT_ONCE = 128


@dataclass(frozen=True)
class Observations:
    """Accepted rays of the points that they determine, each with the state at which it is linearised, and what is believed of the images.

    Attributes
    ----------
    point_ids : (n,) ascending; origin : (n, 3) of their coordinates, geocentric metres
    image_ids : (m,) as the network lists them; cameras : (m, 94); prior : (6 m, 6 m) Q, pixels squared
    point, image : (r,) rows of these; observed, sigma : (r, 2) pixels
    theta : (r, 6) corrections of the ray's image and ground : (r, 3) position of its point, where the ray is linearised
    fitted : (r, 2) image coordinates at which drift is evaluated: the measured ones less their residual where the ray is linearised
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
    fitted: Array


@dataclass(frozen=True)
class Solution:
    """A simultaneous adjustment.

    Attributes
    ----------
    point_ids : (n,) ascending; origin : (n, 3)
    correction : (n, 3) ``x - x0``, geocentric metres; theta : (m, 6) corrections of the images, pixels
    ray_rms_px : of the residuals of the rays, per coordinate
    design : J (rows, 3 n + 6 m), points first; factor : of J'J
    """

    point_ids: NDArray[np.str_]
    origin: Array
    correction: Array
    theta: Array
    ray_rms_px: float
    design: sp.csr_array
    factor: SuperLU

    @property
    def geocentric(self) -> Array:
        """Positions (n, 3), metres."""
        return self.origin + self.correction

    def rows(self, point_ids: NDArray[np.str_]) -> Index:
        """Rows (k,) of some points."""
        row = np.minimum(np.searchsorted(self.point_ids, point_ids), len(self.point_ids) - 1)
        assert np.array_equal(self.point_ids[row], point_ids), "a point is not in the adjustment"
        return np.asarray(row)

    def covariance(self, point_ids: NDArray[np.str_]) -> Array:
        """Joint covariance (3k, 3k) of some points, geocentric square metres, point-major in the order given: columns of ``(J'J)^-1``."""
        at = (3 * self.rows(point_ids)[:, None] + np.arange(3)).ravel()
        joint = np.empty((len(at), len(at)))
        for start in range(0, len(at), COLUMNS_AT_ONCE):
            chosen = at[start : start + COLUMNS_AT_ONCE]
            unit = np.zeros((self.design.shape[1], len(chosen)))
            unit[chosen, np.arange(len(chosen))] = 1.0
            column = self.factor.solve(unit)
            for _ in range(REFINEMENTS):
                column += self.factor.solve(unit - self.design.T @ (self.design @ column))
            joint[:, start : start + COLUMNS_AT_ONCE] = column[at]
        return joint


def largest_difference(found: Array, expected: Array) -> float:
    """Largest ``|P_ij - Q_ij| / sqrt(Q_ii Q_jj)`` of a covariance P and the expected Q."""
    sigma = np.sqrt(np.diag(expected))
    return float(np.abs((found - expected) / np.outer(sigma, sigma)).max())


def prior_covariance(images: Sequence[tuple[str, bool, str]]) -> Array:
    """A priori covariance Q (6 m, 6 m), pixels squared, of the total corrections of m images.

    Each image is given by its pass, whether it is released, and the JSON text of its a priori model, by which images of a block are not
    correlated. An image's own part has the drifts and what is left of the shifts' variance; its pass has the rest, the same for all its
    images. A released image has a hundred times the sigmas of the whole as its own part, and its pass's part as before.
    """
    covariance = np.zeros((P * len(images), P * len(images)))
    for i, (pass_i, released, text) in enumerate(images):
        model = json.loads(text)
        assert model["correlation"] == "none", "the reference knows no correlation within a block"
        own = np.full(P, model["drift_px"] ** 2)
        own[list(SHIFTS)] = model["bias_px"] ** 2 * (1.0 if released else 1.0 - model["common_to_pass"])
        covariance[P * i : P * i + P, P * i : P * i + P] += np.diag(own * (RELEASE**2 if released else 1.0))
        for k, (pass_k, _, _) in enumerate(images):
            for c in SHIFTS if pass_k == pass_i else ():
                covariance[P * i + c, P * k + c] += model["common_to_pass"] * model["bias_px"] ** 2
    return covariance


def stored_observations(snapshot: Snapshot, *, every_ray: bool = False, unreleased: frozenset[str] = frozenset()) -> Observations:
    """What a network of RPC images has accepted, each ray at the linearisation that its cell keeps.

    A point with one accepted ray has fewer observations than coordinates: it has no place and says nothing about images; it is left out.
    With ``every_ray`` the rejected rays are there too, as they are before any judgement.
    Images in ``unreleased`` are taken at their first a priori model whatever the network says: a wrong reference, to see that a comparison
    can fail.
    """
    images, sensor = snapshot.images(), sensor_named("rpc")
    assert {image.sensor for image in images} == {"rpc"}
    ids, image, observed, sigma, theta, ground, origin, cells = [], [], [], [], [], [], [], []
    for number in snapshot.cell_numbers():
        cell = snapshot.cell(number, with_sums=False)
        rays = cell.rays
        candidates = rays.accepted | every_ray
        used = candidates & (np.bincount(rays.point[candidates], minlength=len(cell))[rays.point] >= 2)
        at, of_cell = rays.point[used], rays.image[used]
        ids.append(cell.point_ids[at])
        image.append(cell.images[of_cell].astype(np.int64))
        observed.append(rays.observed[used])
        sigma.append(rays.sigma[used])
        theta.append(cell.theta[of_cell])
        ground.append(cell.linearised_at[at])
        origin.append(cell.origin[at])
        cells.append(np.full(len(at), number))
    point_ids, first, point = np.unique(np.concatenate(ids), return_index=True, return_inverse=True)
    cell_of_ray = np.concatenate(cells)
    assert np.array_equal(cell_of_ray, cell_of_ray[first][point]), "a point has rays in two cells"
    prior = prior_covariance([(i.pass_id, i.released and i.image_id not in unreleased, i.a_priori) for i in images])
    observations = Observations(
        point_ids, np.concatenate(origin)[first], tuple(i.image_id for i in images),
        np.stack([sensor.pack(json.loads(i.camera), i.width, i.height) for i in images]), prior,
        point, np.concatenate(image), np.concatenate(observed), np.concatenate(sigma), np.concatenate(theta), np.concatenate(ground),
        np.concatenate(observed),
    )  # fmt: skip
    return fitted_again(observations)


def fitted_again(observations: Observations) -> Observations:
    """The same with drift at the coordinates that are fitted where the rays are linearised now (docs/decisions/018)."""
    o, every = observations, np.arange(len(observations.point), dtype=np.int32)
    seen = sensor_named("rpc").project(o.cameras[o.image], o.theta, Ground.at(o.ground), every, every, o.observed).image
    residual = o.observed - seen
    residual[(np.abs(residual) > 5.0 * o.sigma).any(axis=1)] = 0.0
    return replace(o, fitted=o.observed - residual)


def adjust_linearised(observations: Observations) -> Solution:
    """The least-squares solution with every ray linearised where ``observations`` say, all images and points at once."""
    o, rays = observations, len(observations.point)
    m, n = len(o.image_ids), len(o.point_ids)
    every = np.arange(rays, dtype=np.int32)
    # a camera and a state for every ray, because cells are linearised apart
    projection = sensor_named("rpc").project(o.cameras[o.image], o.theta, Ground.at(o.ground), every, every, o.fitted)
    y = o.observed - projection.image
    y += np.einsum("rcp,rp->rc", projection.by_parameters, o.theta)
    y += np.einsum("rck,rk->rc", projection.by_ground, o.ground - o.origin[o.point])

    row = (2 * every[:, None] + np.arange(2))[:, :, None]
    by_point, by_image = 3 * o.point[:, None, None] + np.arange(3), 3 * n + P * o.image[:, None, None] + np.arange(P)
    partials = np.concatenate([projection.by_ground, projection.by_parameters], axis=2) / o.sigma[:, :, None]
    columns = np.broadcast_to(np.concatenate([by_point, by_image], axis=2), partials.shape)
    measured = sp.coo_array(
        (partials.ravel(), (np.broadcast_to(row, partials.shape).ravel(), columns.ravel())), shape=(2 * rays, 3 * n + P * m)
    )  # fmt: skip
    root = la.solve_triangular(la.cholesky(o.prior, lower=True), np.eye(P * m), lower=True)
    believed = sp.hstack([sp.csr_array((P * m, 3 * n)), sp.csr_array(root)])
    design = sp.vstack([measured, believed], format="csr")
    right = np.concatenate([(y / o.sigma).ravel(), np.zeros(P * m)])

    # points come first and touch no other point, so the order given is the one with least fill; J'J is positive definite: no pivoting
    factor = splu((design.T @ design).tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    unknowns = factor.solve(design.T @ right)
    for _ in range(REFINEMENTS):
        unknowns += factor.solve(design.T @ (right - design @ unknowns))
    residual = (right - design @ unknowns)[: 2 * rays] * o.sigma.ravel()
    return Solution(
        o.point_ids, o.origin, unknowns[: 3 * n].reshape(n, 3), unknowns[3 * n :].reshape(m, P), float(np.sqrt(np.mean(residual**2))),
        design, factor,
    )  # fmt: skip


def adjust(observations: Observations, iterations: int = 20, *, refitted: bool = False) -> Solution:
    """The nonlinear least-squares solution of the same rays: from unadjusted cameras and the origins, linearised anew until none moves.

    Drift stays at the coordinates that the network has fitted, or is ``refitted`` to this solution.
    """
    m = len(observations.image_ids)
    theta, ground = np.zeros((m, P)), observations.origin
    for _ in range(iterations):
        at = replace(observations, theta=theta[observations.image], ground=ground[observations.point])
        solution = adjust_linearised(fitted_again(at) if refitted else at)
        step_px, step_m = np.abs(solution.theta - theta).max(), np.abs(solution.geocentric - ground).max()
        theta, ground = solution.theta, solution.geocentric
        if step_px < CONVERGED_PIXELS and step_m < CONVERGED_METRES:
            return solution
    raise AssertionError(f"the reference has not converged: last step {step_px:.1e} px, {step_m:.1e} m")


def ray_statistics(observations: Observations, theta: Array) -> Array:
    """Baarda's test statistic (r,) of each ray, all rays of its point taken together, images held at ``theta`` (m, 6).

    The larger one of the two coordinates; 0 for a coordinate that no other observation of the point checks (less than a hundredth of its
    variance). Points are brought to the place that suits all their rays first. Images without error make it a little too small.
    """
    o, sensor, every = observations, sensor_named("rpc"), np.arange(len(observations.point), dtype=np.int32)
    ground = o.origin
    for _ in range(10):
        projection = sensor.project(o.cameras[o.image], theta[o.image], Ground.at(ground[o.point]), every, every, o.fitted)
        v = (o.observed - projection.image) / o.sigma
        b = projection.by_ground / o.sigma[:, :, None]
        normal, right = np.zeros((len(ground), 3, 3)), np.zeros((len(ground), 3))
        np.add.at(normal, o.point, np.einsum("rci,rcj->rij", b, b))
        np.add.at(right, o.point, np.einsum("rci,rc->ri", b, v))
        inverse = np.linalg.inv(normal)
        step = np.einsum("nij,nj->ni", inverse, right)
        ground = ground + step
    left = v - np.einsum("rci,ri->rc", b, step[o.point])
    free = 1.0 - np.einsum("rci,rij,rcj->rc", b, inverse[o.point], b)
    return np.asarray(np.where(free > 0.01, np.abs(left) / np.sqrt(np.maximum(free, 0.01)), 0.0).max(axis=1))
