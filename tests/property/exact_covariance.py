"""Exact error covariance of a small network's answers, by dense linear algebra that shares no code with the library's.

All accepted rays of a network, whitened and linearised where the network keeps them, and the a priori model are one linear problem,

    y = A K u + B (x - x0) + v        0 = u + w        Cov v = I,  Cov w = I,  v and w independent,

and every policy's estimate is a linear map of the data ``(y, 0)``. The error of the estimate is the same map of ``(v, w)``, so with F the
rows of the map
that belong to the points asked for, ``P_true = F F'``. Maps have 2 r + q columns: sample and line of each of r rays, then the q whitened
image parameters' a priori values.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray

from submin.adjustment.rays import Rays
from submin.network.network_image import NetworkImage
from submin.sensors import Ground, Projection, sensor_named
from submin.storage.network import Network
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
RELEASED = 100.0


@dataclass(frozen=True, eq=False)
class Equations:
    """A network's linear problem, without the rays of points that fewer than two rays see: those say nothing about anything else.

    Attributes
    ----------
    by_images : (2 r, q) A K; by_ground : (2 r, 3 n) B; y : (2 r,)
    row_cell : (2 r,) cell of the point of each row
    point_ids : (n,) ascending; point_cell : (n,) their cells; origin : (n, 3) x0, geocentric metres
    cover : tiles and cells
    """

    by_images: Array
    by_ground: Array
    y: Array
    row_cell: NDArray[np.int64]
    point_ids: NDArray[np.str_]
    point_cell: NDArray[np.int64]
    origin: Array
    cover: Cover

    @property
    def whitened(self) -> int:
        """Number q of whitened image parameters."""
        return int(self.by_images.shape[1])

    @property
    def data(self) -> Array:
        """What maps act on: (y, 0)."""
        return np.concatenate([self.y, np.zeros(self.whitened)])

    def held(self, tiles: Iterable[int]) -> NDArray[np.int64]:
        """Cells that any of some tiles holds."""
        return np.unique(np.concatenate([np.array(self.cover.cells_held(tile), dtype=np.int64) for tile in tiles]))


@dataclass(frozen=True, eq=False)
class Information:
    """What some rays and the a priori model say of the whitened image parameters: ``root u = map (y, 0)``, information ``root' root``."""

    root: Array
    map: Array


def equations(network: Network) -> Equations:
    """The linear problem of a network, from the rays, linearisation and images that it keeps."""
    withdrawn = network.snapshot.image_columns(["withdrawn"])["withdrawn"]
    images = [replace(i, a_priori="") if w else i for i, w in zip(network.snapshot.images(), withdrawn, strict=True)]
    ellipsoid = network.snapshot.metadata.ellipsoid
    factor = a_priori_factor(images)
    p = factor.shape[0] // len(images)
    by_images, by_ground, y, cell_of_point, origin, point_of_row, row_cell = [], [], [], [], [], [], []
    ids: list[NDArray[np.str_]] = []
    points = 0
    for number in network.cell_numbers():
        cell = network.cell(number)
        count = np.bincount(cell.rays.point[cell.rays.accepted], minlength=len(cell))
        rays = cell.rays.take(cell.rays.accepted & (count >= 2)[cell.rays.point])
        of_cell = [images[row] for row in cell.images]
        projection = projected(of_cell, cell.theta, Ground.at(cell.linearised_at, ellipsoid), rays)
        moved = (cell.linearised_at - cell.origin)[rays.point]
        reduced = (
            rays.observed - projection.image
            + (projection.by_parameters @ cell.theta[rays.image][:, :, None])[:, :, 0]
            + (projection.by_ground @ moved[:, :, None])[:, :, 0]
        )  # fmt: skip
        rows_of_image = p * cell.images[rays.image][:, None] + np.arange(p)
        by_images.append((projection.by_parameters @ factor[rows_of_image] / rays.sigma[:, :, None]).reshape(-1, factor.shape[1]))
        by_ground.append((projection.by_ground / rays.sigma[:, :, None]).reshape(-1, 3))
        y.append((reduced / rays.sigma).ravel())
        seen = np.flatnonzero(count >= 2)
        point_of_row.append(np.repeat(np.searchsorted(seen, rays.point) + points, 2))
        points += len(seen)
        row_cell.append(np.full(2 * len(rays), number))
        ids.append(cell.point_ids[seen])
        cell_of_point.append(np.full(len(seen), number))
        origin.append(cell.origin[seen])
    names = np.concatenate(ids)
    order = np.argsort(names)
    place = np.argsort(order)[np.concatenate(point_of_row)]
    narrow = np.concatenate(by_ground)
    wide = np.zeros((len(narrow), 3 * len(names)))
    np.put_along_axis(wide, 3 * place[:, None] + np.arange(3), narrow, axis=1)
    return Equations(
        np.concatenate(by_images), wide, np.concatenate(y), np.concatenate(row_cell), names[order],
        np.concatenate(cell_of_point)[order], np.concatenate(origin)[order], network.cover,
    )  # fmt: skip


def projected(images: Sequence[NetworkImage], theta: Array, ground: Ground, rays: Rays) -> Projection:
    """Image coordinates and partials of all rays, image by image."""
    r, p = len(rays), theta.shape[1]
    whole = Projection(np.empty((r, 2)), np.empty((r, 2, 3)), np.zeros((r, 2, p)))
    for k, image in enumerate(images):
        of_image, sensor = np.flatnonzero(rays.image == k), sensor_named(image.sensor)
        camera = sensor.pack(json.loads(image.camera), image.width, image.height)[None]
        first = np.zeros(len(of_image), dtype=np.int32)
        measured, sigma = rays.observed[of_image], rays.sigma[of_image]
        missed = measured - sensor.project(camera, theta[k : k + 1], ground, first, rays.point[of_image], measured).image
        missed[(np.abs(missed) > 5.0 * sigma).any(axis=1)] = 0.0
        part = sensor.project(camera, theta[k : k + 1], ground, first, rays.point[of_image], measured - missed)
        whole.image[of_image], whole.by_ground[of_image] = part.image, part.by_ground
        whole.by_parameters[of_image, :, : len(sensor.parameters)] = part.by_parameters
    return whole


def a_priori_factor(images: Sequence[NetworkImage]) -> Array:
    """K (m p, q), dense: own parts of the images of a block by a Cholesky factor of their correlation, then two columns a pass.

    A released image has a hundred times the sigmas, and no correlation with its block (docs/decisions/004-blunders-and-bad-cameras.md).
    A survey has nothing to adjust, and a withdrawn image is not there: their rows are zero.
    """
    m, p = len(images), len(sensor_named("rpc").parameters)
    bias = np.isin(np.arange(p), (0, 3))
    models = [json.loads(image.a_priori) if image.a_priori else None for image in images]
    passes = list(dict.fromkeys(image.pass_id for image in images))
    factor = np.zeros((m, p, m * p + 2 * len(passes)))
    for i, image in enumerate(images):
        if models[i] is None:
            continue
        column = m * p + 2 * passes.index(image.pass_id)
        factor[i, np.flatnonzero(bias), [column, column + 1]] = models[i]["bias_px"] * np.sqrt(models[i]["common_to_pass"])
        if image.released:
            sigma = np.where(bias, models[i]["bias_px"], models[i]["drift_px"])
            factor[i, np.arange(p), p * i + np.arange(p)] = RELEASED * sigma
    for block in dict.fromkeys(image.block_id for image in images):
        members = [i for i, image in enumerate(images) if image.block_id == block and not image.released and models[i] is not None]
        seconds = np.array([images[i].seconds for i in members])
        for a, row in enumerate(np.linalg.cholesky(correlation(models[members[0]], seconds)) if members else ()):
            model = models[members[a]]
            own = np.where(bias, model["bias_px"] * np.sqrt(1.0 - model["common_to_pass"]), model["drift_px"])
            for b, value in enumerate(row):
                factor[members[a], np.arange(p), p * members[b] + np.arange(p)] = value * own
    return factor.reshape(m * p, -1)


def correlation(model: Mapping[str, Any], seconds: Array) -> Array:
    """Correlation (n, n) of the own parts of n images of a block, taken at these times."""
    if model["correlation"] == "exponential":
        return np.asarray(np.exp(-np.abs(seconds[:, None] - seconds) / model["correlation_parameter"]))
    assert model["correlation"] == "none"
    return np.eye(len(seconds))


def information(problem: Equations, cells: NDArray[np.int64]) -> Information:
    """All rays of the points of some cells with the whole a priori model, ground points eliminated: one QR factorisation, ground first."""
    rows = np.isin(problem.row_cell, cells)
    ground = np.repeat(np.isin(problem.point_cell, cells), 3)
    q, n = problem.whitened, int(ground.sum())
    design = np.block([
        [problem.by_ground[np.ix_(rows, ground)], problem.by_images[rows]],
        [np.zeros((q, n)), np.eye(q)],
    ])  # fmt: skip
    orthogonal, triangle = la.qr(design, mode="economic")
    columns = np.concatenate([np.flatnonzero(rows), len(rows) + np.arange(q)])
    linear_map = np.zeros((q, len(rows) + q))
    linear_map[:, columns] = orthogonal[:, n:].T
    return Information(triangle[n:, n:], linear_map)


def adjusted_together(problem: Equations, tiles: Sequence[int], weights: Array) -> Array:
    """Map (q, 2 r + q) to the images from the a priori model and every cell that any of the tiles holds, each counted once."""
    of_tiles = information(problem, problem.held(tiles))
    return np.asarray(la.solve_triangular(of_tiles.root, of_tiles.map))


def intersected(problem: Equations, tiles: Sequence[int], weights: Array) -> Array:
    """Map to the images by Covariance Intersection of the tiles' own adjustments, each with the a priori model of all images."""
    return weighted_sum([information(problem, problem.held([tile])) for tile in tiles], weights)


def inflated(problem: Equations, tiles: Sequence[int], scale: Array) -> Array:
    """Map to the images by the tiles' own adjustments, each with its covariance times a scale, fused as if they were independent."""
    return weighted_sum([information(problem, problem.held([tile])) for tile in tiles], 1.0 / np.asarray(scale))


def split(problem: Equations, tiles: Sequence[int], weights: Array) -> Array:
    """Map to the images by split intersection: of each tile only what comes from cells and priors of several tiles is inflated."""
    held = [problem.held([tile]) for tile in tiles]
    holders: dict[tuple[bool, ...], list[int]] = {}
    for cell in np.unique(np.concatenate(held)).tolist():
        holders.setdefault(tuple(cell in of_tile for of_tile in held), []).append(cell)
    q = problem.whitened
    whole, right = np.zeros((q, q)), np.zeros((q, len(problem.data)))
    for t, of_tile in enumerate(held):
        own = information(problem, of_tile)
        mine = own.root.T @ own.root
        spread = np.eye(q) * np.sum(weights) / weights[t]
        for who, cells in holders.items():
            if who[t]:
                part = information(problem, np.array(cells))
                spread += (part.root.T @ part.root - np.eye(q)) * np.sum(np.asarray(weights)[list(who)]) / weights[t]
        whole += mine @ np.linalg.solve(spread, mine)
        right += mine @ np.linalg.solve(spread, own.root.T @ own.map)
    return np.asarray(la.solve(whole, right, assume_a="pos"))


def inflated_point(problem: Equations, tiles: Sequence[int], scale: Array, ids: NDArray[np.str_]) -> Array:
    """Map (3, 2 r + q) to one point: what the tiles' images say of it, each with its covariance times a scale, fused as 3-vectors."""
    own, loading = fitted(problem, ids)
    maps = [loading @ adjusted_together(problem, [tile], np.ones(1)) for tile in tiles]
    believed = []
    for tile in tiles:
        root = information(problem, problem.held([tile])).root
        half = la.solve_triangular(root, loading.T, trans="T")
        believed.append(half.T @ half)
    total = sum(np.linalg.inv(p) / c for p, c in zip(believed, scale, strict=True))
    return own + np.linalg.solve(total, sum(np.linalg.inv(p) @ m / c for p, m, c in zip(believed, maps, scale, strict=True)))


def weighted_sum(parts: Sequence[Information], weights: Sequence[float] | Array) -> Array:
    """Map to the images from weighted information of several estimates; with every weight 1 the naive independent merge."""
    whole = sum(weight * part.root.T @ part.root for part, weight in zip(parts, weights, strict=True))
    right = sum(weight * part.root.T @ part.map for part, weight in zip(parts, weights, strict=True))
    return np.asarray(la.solve(whole, right, assume_a="pos"))


def fitted(problem: Equations, ids: NDArray[np.str_]) -> tuple[Array, Array]:
    """Ground points as the best fit of their own rays, given the images: maps (3 n, 2 r + q) of the data and (3 n, q) of the images."""
    points = np.isin(problem.point_ids, ids)
    assert points.sum() == len(ids)
    by_ground = problem.by_ground[:, np.repeat(points, 3)]
    rows = np.flatnonzero(by_ground.any(axis=1))
    orthogonal, triangle = la.qr(by_ground[rows], mode="economic")
    inverse = la.solve_triangular(triangle, orthogonal.T)
    own = np.zeros((len(inverse), len(problem.data)))
    own[:, rows] = inverse
    return own, -inverse @ problem.by_images[rows]


def located(problem: Equations, images: Array, ids: NDArray[np.str_]) -> Array:
    """Map (3 n, 2 r + q) to ground points, given the map (q, 2 r + q) to the images' estimate."""
    own, loading = fitted(problem, ids)
    return own + loading @ images


def monolithic(problem: Equations) -> tuple[Array, Array]:
    """Positions (n, 3) and joint covariance (3 n, 3 n) of all points by one least-squares adjustment of all unknowns."""
    q, n = problem.whitened, len(problem.point_ids)
    design = np.block([[problem.by_images, problem.by_ground], [np.eye(q), np.zeros((q, 3 * n))]])
    orthogonal, triangle = la.qr(design, mode="economic")
    inverse = la.solve_triangular(triangle, orthogonal.T)[q:]
    return problem.origin + (inverse @ problem.data).reshape(n, 3), inverse @ inverse.T


def largest_ratio(true: Array, reported: Array) -> float:
    """Largest true variance over reported variance of any linear function of the points: at most 1 for a consistent answer."""
    size = len(reported)
    return float(la.eigh(true, reported, eigvals_only=True, subset_by_index=[size - 1, size - 1])[0])
