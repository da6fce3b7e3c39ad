"""Figures of `benchmarks.continuity`: profiles across borders, and maps of the difference from the monolithic network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.border import RIGOROUS, TILE
from benchmarks.continuity_measures import Measured, Profile
from submin.geodesy import geocentric_to_geodetic

Array = NDArray[np.float64]

BINS = 16
SHOWN = {"monolithic": "k", TILE: "C3", "ci": "C1", "split": "C0", RIGOROUS: "C2", "naive": "0.6"}


def plot(
    measured: Sequence[Measured], profiles: Sequence[tuple[str, float]], charts: Sequence[tuple[str, float, str]], out: Path
) -> None:  # fmt: skip
    """``continuity-profile.png`` and ``continuity-map.png`` in a folder.

    ``profiles``: scenes and overlaps; ``charts``: scenes, overlaps and policies of the maps.
    """
    out.mkdir(parents=True, exist_ok=True)
    found = {(m.scene.name, m.overlap): m for m in measured}
    profile([found[which] for which in profiles], out)
    maps([(found[name, overlap], policy) for name, overlap, policy in charts], out)


def profile(shown: Sequence[Measured], out: Path) -> None:
    """CE90 as stated, and the difference from the monolithic network against the distance from the border."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(shown), figsize=(11, 7), sharex=True, sharey="row", constrained_layout=True)
    for column, m in enumerate(shown):
        stated, apart = axes[:, column]
        for policy, colour in SHOWN.items():
            style: dict[str, Any] = {"color": colour, "ls": "--" if policy == "naive" else "-", "label": policy}
            stated.plot(*binned(m.profiles, lambda p, name=policy: (p.offset, p.ce[name]), np.median), **style)  # type: ignore[misc]
            if policy != "monolithic":
                apart.plot(*binned(m.profiles, lambda p, name=policy: (p.offset, p.difference[name]), _rms), **style)  # type: ignore[misc]
        if any(len(p.step) for p in m.profiles):
            apart.plot(*binned(m.profiles, lambda p: (p.step_offset, p.step), _rms), color="C3", ls=":", label="tile against tile")
        stated.set_title(f"overlap {m.overlap:g} footprint widths")
        apart.set_xlabel("distance from the border, km")
        for axis in (stated, apart):
            axis.axvline(0.0, color="0.8", zorder=0)
            axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("CE90 as stated, median, m")
    axes[1, 0].set_ylabel("difference from monolithic, RMS, m")
    axes[0, -1].legend(ncols=3, fontsize="small")
    axes[1, -1].legend(ncols=2, fontsize="small")
    figure.suptitle(f"{shown[0].scene.name}: across {len(shown[0].profiles)} borders (simulated)")
    figure.savefig(out / "continuity-profile.png", dpi=110)
    plt.close(figure)


def binned(
    profiles: Sequence[Profile], of: Callable[[Profile], tuple[Array, Array]], summary: Callable[[Array], Any]
) -> tuple[Array, Array]:  # fmt: skip
    """Middles of the bins, kilometres, and a summary of the values in each that holds some."""
    offset, value = (np.concatenate([of(p)[k] for p in profiles]) for k in range(2))
    edges = np.linspace(min(p.offset.min() for p in profiles), max(p.offset.max() for p in profiles), BINS + 1)
    place = np.clip(np.digitize(offset, edges) - 1, 0, BINS - 1)
    there = np.unique(place)
    middle = 0.5e-3 * (edges[there] + edges[there + 1])
    return middle, np.array([summary(value[place == k]) for k in there])


def maps(shown: Sequence[tuple[Measured, str]], out: Path) -> None:
    """Where points move against the monolithic network, and the borders of the cores."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(12, 8), constrained_layout=True)
    for axis, (m, policy) in zip(axes.ravel(), shown, strict=False):
        at = np.concatenate([geocentric_to_geodetic(s.whole[s.owned]) for s in m.sheets[policy]])
        apart = np.concatenate([np.linalg.norm((s.geocentric - s.whole)[s.owned], axis=1) for s in m.sheets[policy]])
        order = np.argsort(apart)
        dots = axis.scatter(at[order, 0], at[order, 1], c=apart[order], s=4, cmap="viridis_r", vmin=0.0, vmax=np.percentile(apart, 98))
        for tile in m.cover.tiles():
            ring = m.cover.core_outline(tile)
            axis.plot(*m.cover.geographic(ring[:, 0], ring[:, 1]), color="0.5", lw=0.7)
        margin = 0.03 * np.ptp(at[:, :2], axis=0)
        axis.set(
            xlim=(at[:, 0].min() - margin[0], at[:, 0].max() + margin[0]), ylim=(at[:, 1].min() - margin[1], at[:, 1].max() + margin[1])
        )
        axis.set_aspect(1.0 / np.cos(np.radians(at[:, 1].mean())))
        axis.set_title(f"{m.scene.name}: {policy}, overlap {m.overlap:g}", fontsize="medium")
        axis.ticklabel_format(useOffset=False)
        axis.locator_params(nbins=5)
        figure.colorbar(dots, ax=axis, label="m", shrink=0.7)
    figure.suptitle("Distance of each point from its place in the monolithic network; lines: cores")
    figure.savefig(out / "continuity-map.png", dpi=110)
    plt.close(figure)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))
