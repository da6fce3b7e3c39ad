"""Figure of `benchmarks.china`: where the seconds of a run and of a reconciliation go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

COORDINATOR = "coordinator alone, and waiting"
STAGES = {"run": "run, catalogue to committed network", "reconcile": "reconcile"}
LEAST_SHOWN = 0.5
LEAST_LABELLED = 24.0
"""Seconds of a part that has room for its name; the others are in the legend."""


def parts_of(rows: Sequence[Mapping[str, Any]], stage: str, workers: int) -> list[tuple[str, float]]:
    """Seconds by the clock of each task of a stage, as if always every worker had one, and what is left, largest first."""
    (whole,) = (float(row["seconds"]) for row in rows if row.get("stage") == STAGES[stage])
    tasks = [(str(row["task"]), float(row["seconds of all"]) / workers) for row in rows if row.get("of") == stage]
    tasks = [task for task in tasks if task[1] >= LEAST_SHOWN]
    busy = sum(seconds for _, seconds in tasks)
    return [*sorted(tasks, key=lambda task: -task[1]), (COORDINATOR, max(whole - busy, 0.0))]


def plot(rows: Sequence[Mapping[str, Any]], workers: int, out: Path) -> None:
    """``china.png`` in a folder."""
    import matplotlib.pyplot as plt

    out.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(figsize=(11, 4.0), constrained_layout=True)
    for at, stage in enumerate(STAGES):
        left = 0.0
        for k, (name, seconds) in enumerate(parts_of(rows, stage, workers)):
            roomy = seconds >= LEAST_LABELLED
            colour = "0.75" if name == COORDINATOR else f"C{(k + 5 * at) % 10}"
            axes.barh(at, seconds, left=left, color=colour, edgecolor="w", label=None if roomy else f"{stage}: {name}, {seconds:.1f} s")
            if roomy:  # above the line of what was wanted, which may cross it
                label = "\n".join([*name.split(", "), f"{seconds:.0f} s"])
                text = axes.text(left + 0.5 * seconds, at, label, ha="center", va="center", fontsize=8, zorder=3)
                text.set_bbox({"facecolor": colour, "edgecolor": "none", "pad": 1.0})
            left += seconds
        wanted = next((row["wanted, s"] for row in rows if row.get("stage") == STAGES[stage]), "")
        if wanted != "":
            limit = float(wanted)
            axes.plot([limit, limit], [at - 0.45, at + 0.45], "k--", linewidth=1.5)
            axes.text(limit, at + 0.47, f"wanted: {limit:.0f} s", ha="center", va="bottom", fontsize=8)
    axes.set_yticks(range(len(STAGES)), list(STAGES))
    axes.set_ylim(-0.6, len(STAGES) - 0.2)
    axes.set_xlabel(f"seconds; tasks of {workers} workers as if none ever waited")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(out / "china.png", dpi=110)
    plt.close(figure)
