"""Random networks of positions, baselines and heights, and their simultaneous least squares by plain numpy."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from submin.network.dense_sub_min import DenseSubMin
from submin.network.observations import Cluster, HeightDifferences, PointObservations

Array = NDArray[np.float64]
Ids = NDArray[np.str_]
CENTRE = np.array([4.0e6, 1.0e6, 4.8e6])


@dataclass(frozen=True)
class Solution:
    """Least squares of some blocks at once: points ascending, positions about origins near them, covariance, chi-square."""

    ids: Ids
    origin: Array
    adjustment: Array
    covariance: Array
    chi_square: float
    redundancy: int


def regular(rng: np.random.Generator, size: int, sigma: float = 0.01) -> Array:
    root = rng.normal(size=(size, size))
    return np.asarray(sigma**2 * (root @ root.T / size + 0.05 * np.eye(size)))


def noise(rng: np.random.Generator, covariance: Array) -> Array:
    return np.asarray(np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance)))


def truth(rng: np.random.Generator, points: int) -> dict[str, Array]:
    return {f"p{k:03d}": CENTRE + rng.uniform(-2e4, 2e4, 3) for k in range(points)}


def position_cluster(rng: np.random.Generator, at: dict[str, Array], name: str, ids: Sequence[str]) -> Cluster:
    covariance = regular(rng, 3 * len(ids))
    values = np.stack([at[i] for i in ids]) + noise(rng, covariance).reshape(-1, 3)
    return Cluster(name, np.array(ids), np.full(len(ids), "", dtype="U1"), values, covariance)


def mixed_cluster(rng: np.random.Generator, at: dict[str, Array], name: str, positions: float = 0.25) -> Cluster:
    """One to four positions and baselines."""
    ids, k = list(at), int(rng.integers(1, 5))
    pairs = [tuple(rng.choice(ids, 2, replace=False).tolist()) for _ in range(k)]
    alone = rng.random(k) < positions
    covariance = regular(rng, 3 * k)
    exact = np.stack([at[a] if one else at[b] - at[a] for (a, b), one in zip(pairs, alone, strict=True)])
    return Cluster(
        name, np.array([a for a, _ in pairs]), np.array(["" if one else b for (_, b), one in zip(pairs, alone, strict=True)]),
        exact + noise(rng, covariance).reshape(-1, 3), covariance,
    )  # fmt: skip


def heights(rng: np.random.Generator, at: dict[str, Array], name: str, pairs: Sequence[tuple[str, str]]) -> HeightDifferences:
    """Differences along the local verticals, linearised about positions metres away from the truth."""
    reference = np.array([[at[a], at[b]] for a, b in pairs]) + rng.normal(0.0, 5.0, (len(pairs), 2, 3))
    exact = np.array([[at[a], at[b]] for a, b in pairs])
    up = exact / np.linalg.norm(exact, axis=2, keepdims=True)
    along = np.einsum("kes,kes->ke", up, exact - reference)
    covariance = regular(rng, len(pairs))
    values = along[:, 1] - along[:, 0] + noise(rng, covariance)
    return HeightDifferences(name, np.array([a for a, _ in pairs]), np.array([b for _, b in pairs]), values, up, reference, covariance)


def _equations(block: PointObservations, place: dict[str, int], origin: Array) -> tuple[Array, Array]:
    """Design and misclosure of a block, written out observation by observation: nothing is taken from the code that is tested."""
    rows, y = [], []
    if isinstance(block, Cluster):
        for start, end, value in zip(block.from_ids.tolist(), block.to_ids.tolist(), block.values, strict=True):
            for axis in range(3):
                row = np.zeros(3 * len(place))
                row[3 * place[end or start] + axis] += 1.0
                expected = origin[place[start], axis]
                if end:
                    row[3 * place[start] + axis] -= 1.0
                    expected = origin[place[end], axis] - expected
                rows.append(row)
                y.append(value[axis] - expected)
    elif isinstance(block, HeightDifferences):
        for k, (start, end) in enumerate(zip(block.from_ids.tolist(), block.to_ids.tolist(), strict=True)):
            row, expected = np.zeros(3 * len(place)), 0.0
            for side, (point, sign) in enumerate(((start, -1.0), (end, 1.0))):
                row[3 * place[point] : 3 * place[point] + 3] += sign * block.up[k, side]
                expected += sign * float(block.up[k, side] @ (origin[place[point]] - block.reference[k, side]))
            rows.append(row)
            y.append(block.values[k] - expected)
    return np.array(rows), np.array(y)


def simultaneous(blocks: Sequence[PointObservations], near: dict[str, Array]) -> Solution:
    """One least squares of all blocks, orthogonal, coordinates about ``near``."""
    ids = np.unique(np.concatenate([block.point_ids for block in blocks]))
    place = {point: k for k, point in enumerate(ids.tolist())}
    origin = np.stack([near[point] for point in ids.tolist()])
    design, observed = [], []
    for block in blocks:
        h, y = _equations(block, place, origin)
        white = np.linalg.solve(np.linalg.cholesky(block.covariance), np.column_stack([h, y]))
        design.append(white[:, :-1])
        observed.append(white[:, -1])
    a, y = np.concatenate(design), np.concatenate(observed)
    q, r = np.linalg.qr(a)
    x, inverse = np.linalg.solve(r, q.T @ y), np.linalg.inv(r)
    residual = y - a @ x
    return Solution(ids, origin, x, inverse @ inverse.T, float(residual @ residual), len(y) - len(x))


def assert_equal(state: DenseSubMin, expected: Solution, relative: float = 1e-9) -> None:
    """The state holds these points and no others, and equals their solution: in sigmas, element by element, and in chi-square."""
    np.testing.assert_array_equal(np.sort(state.ids), expected.ids)
    rows = state.rows_of(expected.ids)
    sigma = np.sqrt(np.diag(expected.covariance))
    # differences of origins first, which are exact: the radius of the earth leaves no digit for a billionth of a sigma
    shift = (state.origins[rows] - expected.origin).ravel() + state.adjustments.reshape(-1, 3)[rows].ravel() - expected.adjustment
    scale = max(1.0, float(np.abs(expected.adjustment / sigma).max()))
    np.testing.assert_allclose(shift / sigma, 0.0, atol=relative * scale)
    correlation = (state.covariance(rows) - expected.covariance) / np.outer(sigma, sigma)
    np.testing.assert_allclose(correlation, 0.0, atol=relative)
    np.testing.assert_allclose(state.chi_square, expected.chi_square, rtol=relative, atol=1e-9)
    assert state.redundancy == expected.redundancy


def victoria(data: Path) -> list[Cluster]:
    """The 131 independent solutions of a real GNSS network (values in GDA2020), full covariances; a minimal reading of its files."""
    folder = data / "dynadjust_gnss_network"
    values: dict[int, dict[tuple[str, str], list[float]]] = {}
    for line in (folder / "measured_gda2020.csv").read_text(encoding="utf-8").splitlines()[1:]:
        cluster, _, start, end, _, _, value = line.split(",")
        values.setdefault(int(cluster), {}).setdefault((start, end), []).append(float(value))
    lines = [line for line in (folder / "gnss-network.msr").read_text(encoding="utf-8").splitlines() if line[0] not in "!*"]
    clusters, at = [], 0
    for number, observed in values.items():
        k = len(observed)
        scale = float(re.findall(r"\d+\.\d+", lines[at])[0])
        covariance = np.zeros((3 * k, 3 * k))
        for i in range(k):
            at += 1
            for axis in range(3):
                covariance[3 * i + axis, 3 * i : 3 * i + axis + 1] = _reals(lines[at])
                at += 1
            for j in range(i + 1, k):
                for axis in range(3):
                    covariance[3 * j : 3 * j + 3, 3 * i + axis] = _reals(lines[at])
                    at += 1
        covariance = scale * (np.tril(covariance) + np.tril(covariance, -1).T)
        start, end = (np.array(names) for names in zip(*observed, strict=True))
        clusters.append(Cluster(f"solution {number}", start, end, np.array(list(observed.values())), covariance))
    return clusters


def _reals(line: str) -> list[float]:
    """Covariances of a line: the numbers with an exponent."""
    return [float(number) for number in re.findall(r"-?\d+\.\d+e[+-]\d+", line)]
