"""Correlation functions in place of a joint covariance: the factor of consistency and the storage, by family (2008 MIN paper, section 6).

First the five blocks of the paper (all of its first experiment), with every family: fitted to the correlations, fitted for the factor, and
with vectors beside the functions. Then a simulated region as large as a tile, with the families that are zero from some distance on, as
sparse matrices. What is drawn: the correlations against distance, as in Figure 11 of the paper.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as la
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from benchmarks.bundle import Solution, solve
from benchmarks.comparison import verdict
from submin.correlation import FAMILIES, CompactCovariance, SparseFactor, assemble, assemble_sparse, bounded, condense, expand, family_named
from submin.correlation.assembly import own_blocks, symmetric_roots, whitened
from submin.correlation.families import Correlation
from submin.correlation.fitting import Binned, binned, least_squares
from submin.geodesy import common_axes
from submin.simulation.five_blocks import five_blocks
from submin.simulation.region import RegionDesign, simulate_region
from submin.simulation.scene import realise
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import scene_blocks, write_region

Array = NDArray[np.float64]

SEED = 0
RANKS = (8, 24)
REGION_KM = 250.0
"""Side of the simulated region at full scale: 676 points."""
FLOORS_KM = (50.0, 25.0)
ROUND_OFF = 1e-9
"""Eigenvalues of a bound less the covariance, relative to the bound, are not below minus this."""
COMPONENTS = ("east", "north", "up")


class Joint(NamedTuple):
    """Points with their joint covariance."""

    geocentric: Array
    covariance: Array
    axes: Array

    @classmethod
    def of(cls, solution: Solution) -> Joint:
        """Of all points of a bundle."""
        every = np.arange(len(solution.ids))
        return cls(solution.geocentric, solution.joint_covariance(every), common_axes(solution.geocentric))

    @property
    def triangle(self) -> int:
        """Numbers of the covariance as it is."""
        size = len(self.covariance)
        return size * (size + 1) // 2

    def bound(self, functions: tuple[Correlation, ...], rank: int = 0) -> CompactCovariance:
        """With functions that are known."""
        return bounded(self.covariance, self.geocentric, self.axes, functions, rank)

    def fitted(self, family: str, rank: int = 0, floor: float | None = None) -> CompactCovariance:
        """With functions fitted for the mean variance of the bound."""
        return condense(self.covariance, self.geocentric, self.axes, family, rank, floor)

    def correlations(self) -> Binned:
        """Whitened, against distance."""
        _, inverse = symmetric_roots(own_blocks(self.covariance))
        return binned(whitened(self.covariance, inverse, self.axes), self.geocentric)

    def least(self, compact: CompactCovariance) -> float:
        """Least eigenvalue of the bound less the covariance, relative to the bound: 0 is a bound that could not be smaller."""
        size = len(self.covariance)
        ratio = la.eigh(self.covariance, expand(compact), eigvals_only=True, subset_by_index=[size - 1, size - 1])
        return 1.0 - float(ratio[-1])


def measure(scale: float, workers: int, out: Path | None = None) -> list[dict[str, Any]]:
    """Rows of all tables; ``scale`` is the part of the region's area."""
    five = Joint.of(solve(scene_blocks(realise(five_blocks(), SEED))))
    fits = {name: five.fitted(name) for name in FAMILIES}
    if out is not None:
        plot(five, fits["exponential"], out)
    return [
        *by_family(five, fits),
        *with_vectors(five),
        *correlations_of_components(five),
        *sparse(Joint.of(solve(region_blocks(REGION_KM * scale**0.5)))),
    ]


def by_family(five: Joint, fits: dict[str, CompactCovariance]) -> Iterator[dict[str, Any]]:
    """Factors of each family: least squares without and with own parts, and fitted for the factor; and of 3 x 3 blocks alone."""
    seen = five.correlations()
    nothing = (Correlation(family_named("spherical"), (1.0, 0.5 * float(pdist(five.geocentric).min()))),) * 3
    yield _family_row("3 x 3 blocks alone", None, None, five.bound(nothing), five)
    for name, compact in fits.items():
        whole, own = (five.bound(least_squares(family_named(name), seen, own_part=part)).kappa for part in (False, True))
        yield _family_row(name, whole, own, compact, five)


def with_vectors(five: Joint) -> Iterator[dict[str, Any]]:
    """Functions fitted for so many vectors beside them."""
    for rank in RANKS:
        for name in FAMILIES:
            compact = five.fitted(name, rank)
            least = five.least(compact)
            yield {
                "family": name, "vectors": rank, "factor": compact.factor, "kappa without": compact.kappa,
                "sigma x": float(np.sqrt(compact.inflation.mean())), "sigma x, worst point": float(np.sqrt(compact.inflation.max())),
                "numbers": compact.numbers, "per cent of triangle": 100.0 * compact.numbers / five.triangle,
                "least eigenvalue": least, "verdict": verdict(least >= -ROUND_OFF),
            }  # fmt: skip


def correlations_of_components(five: Joint) -> Iterator[dict[str, Any]]:
    """What Figure 11 shows, in numbers: correlations of like components near and far, and the largest of unlike ones."""
    chord, matrix = pairs(five)
    edges = np.array([0.0, 25e3, 75e3, 150e3, np.inf])
    for a in range(3):
        for b in range(a, 3):
            rho = matrix[a, b] if a == b else np.concatenate([matrix[a, b], matrix[b, a]])
            d = chord if a == b else np.tile(chord, 2)
            mean = [float(rho[(d >= low) & (d < high)].mean()) for low, high in pairwise(edges)]
            yield {
                "correlation": f"{COMPONENTS[a]}-{COMPONENTS[b]}", "below 25 km": mean[0], "to 75 km": mean[1], "to 150 km": mean[2],
                "beyond": mean[3], "largest, absolute": float(np.abs(rho).max()),
            }  # fmt: skip


def sparse(joint: Joint) -> Iterator[dict[str, Any]]:
    """Zero floors on a region: what is stored, and how long it takes beside the same matrix as a dense one."""
    right = np.random.default_rng(0).normal(size=len(joint.covariance))
    for name in (name for name, family in FAMILIES.items() if family.zero_floor):
        for floor in FLOORS_KM:
            started = time.perf_counter()
            compact = joint.fitted(name, RANKS[-1], 1000.0 * floor)
            fit = time.perf_counter() - started
            arguments = (compact.blocks, joint.geocentric, compact.functions, joint.axes)
            matrix, made = timed(partial(assemble_sparse, *arguments))
            factor, factored = timed(partial(SparseFactor.of, matrix))
            full, made_dense = timed(partial(assemble, *arguments))
            triangle, factored_dense = timed(partial(la.cholesky, full, lower=True))
            apart = np.abs(factor.solve(right) - la.cho_solve((triangle, True), right)).max() / np.abs(right).max()
            least = joint.least(compact)
            yield {
                "family": name, "floor, km": floor, "points": len(joint.geocentric), "vectors": compact.rank, "factor": compact.factor,
                "sigma x": float(np.sqrt(compact.inflation.mean())), "triangle": joint.triangle, "non-zeros": factor.triangle,
                "fill": factor.fill, "numbers": compact.numbers, "fit, s": fit, "sparse, s": made, "dense, s": made_dense,
                "LU, s": factored, "Cholesky, s": factored_dense, "solutions apart": float(apart),
                "least eigenvalue": least, "verdict": verdict(least >= -ROUND_OFF and bool(apart < ROUND_OFF)),
            }  # fmt: skip


def region_blocks(side_km: float) -> list[Any]:
    """Blocks of a simulated region."""
    with tempfile.TemporaryDirectory() as folder:
        write_region(simulate_region(RegionDesign(width_km=side_km, height_km=side_km, point_spacing_km=9.5)), Path(folder) / "catalogue")
        return list(Catalogue.open(Path(folder) / "catalogue").blocks())


def timed(work: Callable[[], Any], repeats: int = 3) -> tuple[Any, float]:
    """What work returns, and the least time that it took."""
    best = np.inf
    for _ in range(repeats):
        started = time.perf_counter()
        result = work()
        best = min(best, time.perf_counter() - started)
    return result, float(best)


def pairs(joint: Joint) -> tuple[Array, Array]:
    """Distances (k,) of all pairs of points, and their plain correlations (3, 3, k) along the common axes."""
    n = len(joint.geocentric)
    turned = np.einsum("ab,ibjd,cd->iajc", joint.axes, joint.covariance.reshape(n, 3, n, 3), joint.axes, optimize=True)
    sigma = np.sqrt(np.einsum("iaia->ia", turned))
    i, j = np.triu_indices(n, 1)
    return pdist(joint.geocentric), (turned / sigma[:, :, None, None] / sigma)[i, :, j, :].transpose(1, 2, 0)


def plot(five: Joint, fitted: CompactCovariance, out: Path) -> None:
    """Correlations of like components against distance with exponential fits, as Figure 11: ``correlation-functions.png`` in a folder."""
    import matplotlib.pyplot as plt

    out.mkdir(parents=True, exist_ok=True)
    chord, matrix = pairs(five)
    rough = least_squares(family_named("exponential"), five.correlations())
    kappa = five.bound(rough).kappa
    d = np.linspace(0.0, 1.02 * chord.max(), 400)
    figure, axes = plt.subplots(1, 3, figsize=(11, 4.2), sharey=True, constrained_layout=True)
    for c, axis in enumerate(axes):
        axis.plot(chord / 1000.0, matrix[c, c], ".", ms=2, color="0.6", label="pairs of points")
        for function, colour, name in (
            (rough[c], "C0", f"least squares (kappa {kappa:.1f})"), (fitted.functions[c], "C3", f"least kappa ({fitted.kappa:.1f})")
        ):  # fmt: skip
            axis.plot(d / 1000.0, function(d), color=colour, label=name)
        axis.set(title=f"{'xyz'[c]}-{'xyz'[c]} ({COMPONENTS[c]})", xlabel="distance, km", ylim=(0.0, 1.03), xlim=(0.0, d[-1] / 1000.0))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("correlation")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, markerscale=4)
    figure.suptitle(
        "Correlation of ground points' errors against distance: five blocks (simulated), all pairs of 62 points, exponential fits"
    )
    figure.savefig(out / "correlation-functions.png", dpi=90)
    plt.close(figure)


def _family_row(name: str, whole: float | None, own: float | None, compact: CompactCovariance, five: Joint) -> dict[str, Any]:
    least = five.least(compact)
    return {
        "family": name, "zero floor": "yes" if whole is None or family_named(name).zero_floor else "",
        "kappa, least squares, A = 1": "" if whole is None else whole, "kappa, least squares": "" if own is None else own,
        "kappa, fitted for it": compact.kappa, "sigma x": float(np.sqrt(compact.kappa)),
        "D east, north, up, km": "" if whole is None else ", ".join(f"{f.parameters['D'] / 1000.0:.0f}" for f in compact.functions),
        "numbers": compact.numbers, "triangle": five.triangle, "non-zeros": non_zeros(compact),
        "least eigenvalue": least, "verdict": verdict(least >= -ROUND_OFF),
    }  # fmt: skip


def non_zeros(compact: CompactCovariance) -> int:
    """Of one triangle of P_hat."""
    floor = max(function.floor for function in compact.functions)
    return 6 * len(compact) + 9 * int((pdist(compact.geocentric) < floor).sum())
