"""SINEX files for tests: written from arrays, in the columns of the format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def as_kind(covariance: Array, kind: str) -> Array:
    """A covariance as the matrix of a file."""
    if kind == "INFO":
        return np.asarray(np.linalg.inv(covariance))
    if kind == "CORR":
        sigma = np.sqrt(np.diagonal(covariance))
        matrix = covariance / np.outer(sigma, sigma)
        np.fill_diagonal(matrix, sigma)
        return np.asarray(matrix)
    return covariance


def matrix_lines(title: str, matrix: Array, triangle: str, skip_zeros: bool = False) -> list[str]:
    lines = [f"+{title} {triangle}"]
    n = len(matrix)
    order = triangle.split()[0]
    for row in range(n):
        columns = range(row + 1) if order == "L" else range(row, n)
        for first in columns[::3]:
            chosen = [c for c in range(first, first + 3) if c in columns]
            if skip_zeros and not matrix[row, chosen].any():
                continue
            lines.append(f" {row + 1:5d} {first + 1:5d}" + "".join(f" {matrix[row, c]:21.14E}" for c in chosen))
    return [*lines, f"-{title} {triangle}"]


def parameter_lines(title: str, names: list[tuple[str, str]], values: Array, sigmas: Array) -> list[str]:
    lines = [f"+{title}"]
    for i, ((kind, site), value, sigma) in enumerate(zip(names, values, sigmas, strict=True), start=1):
        unit = "m" if kind.startswith("STA") else "m/y"
        lines.append(f" {i:5d} {kind:6s} {site:4s}  A    1 17:298:43200 {unit:4s} 2 {value:21.14E} {sigma:11.5E}")
    return [*lines, f"-{title}"]


def station_parameters(stations: int, velocities: bool = False) -> list[tuple[str, str]]:
    kinds = ("STAX", "STAY", "STAZ", *(("VELX", "VELY", "VELZ") if velocities else ()))
    return [(kind, f"S{s:03d}") for s in range(stations) for kind in kinds]


def sinex_lines(
    names: list[tuple[str, str]],
    values: Array,
    covariance: Array,
    triangle: str = "L",
    kind: str = "COVA",
    a_priori: tuple[Array, Array] | None = None,
    a_priori_kind: str = "COVA",
    code: str = "2",
) -> list[str]:
    """The lines of a file; ``a_priori`` are values and covariance of the constraint of all parameters."""
    sites = sorted({site for _, site in names})
    lines = [f"%=SNX 2.01 TST 17:331:00000 TST 17:295:00000 17:301:00000 C {len(names):05d} {code} S"]
    lines += ["+SITE/ID", "*CODE PT __DOMES__ T _STATION DESCRIPTION__ APPROX_LON_ APPROX_LAT_ _APP_H_"]
    lines += [f" {site:4s}  A 50137M001 P {'simulated':22s} 133 53 07.8 -23 40 12.4   603.3" for site in sites]
    lines += ["-SITE/ID", "*" + 60 * "-"]
    lines += parameter_lines("SOLUTION/ESTIMATE", names, values, np.sqrt(np.diagonal(covariance)))
    if a_priori is not None:
        lines += parameter_lines("SOLUTION/APRIORI", names, a_priori[0], np.sqrt(np.diagonal(a_priori[1])))
    lines += matrix_lines("SOLUTION/MATRIX_ESTIMATE", as_kind(covariance, kind), f"{triangle} {kind}")
    if a_priori is not None:
        lines += matrix_lines(
            "SOLUTION/MATRIX_APRIORI", as_kind(a_priori[1], a_priori_kind), f"{triangle} {a_priori_kind}", skip_zeros=True
        )
    return [*lines, "%ENDSNX"]


def write_sinex(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path
