"""Simulated GNSS measurements, and the DNA and DynaML files that hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PLACE = np.array([-4297030.4411, 2827160.2328, -3759485.1852])


@dataclass(frozen=True)
class Simulated:
    """A measurement to write in any format: its entries, the covariance before its scale, the scale."""

    type: str
    pairs: tuple[tuple[str, str], ...]
    values: Array
    covariance: Array
    scale: float = 1.0
    ignored: bool = False
    frame: str = "GDA2020"
    day: str = "01.01.2020"


def simulated(kind: str, pairs: tuple[tuple[str, str], ...], seed: int, **more: Any) -> Simulated:
    rng = np.random.default_rng(seed)
    n = 3 * len(pairs)
    values = np.round((PLACE if kind == "Y" else 0.0) + 1e4 * rng.normal(size=(len(pairs), 3)), 4)
    factor = rng.normal(size=(n, n + 2))
    covariance = np.array([[float(f"{v:.13e}") for v in row] for row in 1e-6 * factor @ factor.T])
    return Simulated(kind, pairs, values, np.tril(covariance) + np.tril(covariance, -1).T, **more)


MEASUREMENTS = (
    simulated("G", (("A", "B"),), 1, scale=10.0, frame="ITRF2008", day="18.02.2015"),
    simulated("G", (("B", "C"),), 2, ignored=True),
    simulated("X", (("A", "C"), ("A", "D"), ("D", "B")), 3, scale=8.95, frame="ITRF2014", day="17.01.2018"),
    simulated("Y", (("A", ""), ("E", "")), 4),
)


def dna_lines(measurements: tuple[Simulated, ...] = MEASUREMENTS) -> list[str]:
    lines = [f"!#=DNA 3.01 MSR    13.12.2018{'GDA2020':>14s}{'01.01.2020':>14s}{len(measurements):>10d}", "* simulated"]
    for m in measurements:
        k = len(m.pairs)
        for i, (start, end) in enumerate(m.pairs):
            line = f"{m.type}{'*' if m.ignored else ' '}{start:20s}{('XYZ' if not i else '') if m.type == 'Y' else end:20s}"
            if not i:
                line += f"{'' if m.type == 'G' else k:<20}{m.scale:10.2f}{1:10.2f}{1:10.2f}{1:10.2f}{m.frame:>20s}{m.day:>20s}"
            lines.append(line)
            own = slice(3 * i, 3 * i + 3)
            for a in range(3):
                row = m.covariance[own, own][a, : a + 1]
                lines.append(" " * 62 + f"{m.values[i, a]:20.4f}" + "".join(f"{v:20.13e}" for v in row))
            for j in range(i + 1, k):
                lines += [" " * 82 + "".join(f"{v:20.13e}" for v in row) for row in m.covariance[own, 3 * j : 3 * j + 3]]
    return lines


def xml_lines(measurements: tuple[Simulated, ...] = MEASUREMENTS) -> list[str]:
    lines = [
        '<?xml version="1.0"?>',
        '<DnaXmlFormat type="Measurement File" referenceframe="GDA2020" epoch="01.01.2020">',
        "<!-- simulated -->",
    ]
    for m in measurements:
        lines += ["<DnaMeasurement>", f"<Type>{m.type}</Type>", f"<Ignore>{'*' if m.ignored else ''}</Ignore>"]
        lines += [f"<ReferenceFrame>{m.frame}</ReferenceFrame>", f"<Epoch>{m.day}</Epoch>", f"<Vscale>{m.scale}</Vscale>"]
        lines += [f"<{name}>1.000</{name}>" for name in ("Pscale", "Lscale", "Hscale")]
        lines += ["<Coords>XYZ</Coords>"] if m.type == "Y" else []
        lines += [f"<Total>{len(m.pairs)}</Total>"] if m.type != "G" else []
        value, covariance = ("Clusterpoint", "PointCovariance") if m.type == "Y" else ("GPSBaseline", "GPSCovariance")
        for i, (start, end) in enumerate(m.pairs):
            own = slice(3 * i, 3 * i + 3)
            lines += [f"<First>{start}</First>", *([f"<Second>{end}</Second>"] if end else []), f"<{value}>"]
            lines += [f"<{axis}>{v:.4f}</{axis}>" for axis, v in zip("XYZ", m.values[i], strict=True)]
            names = [(a, b) for a in range(3) for b in range(a, 3)]
            lines += [f"<Sigma{'XYZ'[a]}{'XYZ'[b]}>{m.covariance[own, own][a, b]:.13e}</Sigma{'XYZ'[a]}{'XYZ'[b]}>" for a, b in names]
            for j in range(i + 1, len(m.pairs)):
                block = m.covariance[own, 3 * j : 3 * j + 3]
                cells = [f"<m{a + 1}{b + 1}>{block[a, b]:.13e}</m{a + 1}{b + 1}>" for a in range(3) for b in range(3)]
                lines += [f"<{covariance}>", *cells, f"</{covariance}>"]
            lines.append(f"</{value}>")
        lines.append("</DnaMeasurement>")
    return [*lines, "</DnaXmlFormat>"]
