"""Five blocks: Tables 2 and 3 of the 2008 MIN paper beside ours, sequential against simultaneous, and whether the stated accuracy is true.

What the paper leaves out and what was chosen: docs/experiments.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import submin
from benchmarks.bundle import solve
from benchmarks.comparison import below, between, data, network_of, rejections_allowed, statement, verdict, widened
from orchestration.control import add_control
from orchestration.executors import SerialExecutor
from submin.accuracy import accuracy_against_truth, ce90, le90, nees_per_dof
from submin.adjustment.elimination import linearise, point_factors
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geodetic_to_geocentric, local_axes, rotate_covariance
from submin.network.sub_min import GroundPart, joint_covariance, loadings
from submin.query.control_set import ControlSet
from submin.simulation.five_blocks import EXTERNAL_CONTROL, five_blocks
from submin.simulation.scene import Layout, SimulatedScene, realise
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import scene_blocks, survey_table, write_scene

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

RUNS = 200
SEED = 0
CONTROLLED = "control"
"""Name of the step that adds external control."""


class Radii(NamedTuple):
    """CE90 and LE90, metres."""

    ce: float
    le: float


TABLE_2: tuple[tuple[str, dict[int, Radii]], ...] = (
    ("none", {**{block: Radii(25, 15) for block in (1, 2, 3, 4)}, 5: Radii(50, 28)}),
    ("block 1", {1: Radii(22, 14)}),
    ("block 2", {1: Radii(14, 8), 2: Radii(13, 8)}),
    ("block 3", {1: Radii(12, 8), 2: Radii(11, 7), 3: Radii(13, 8)}),
    ("block 4", {1: Radii(12, 8), 2: Radii(11, 7), 3: Radii(13, 8), 4: Radii(23, 14)}),
    ("block 5", {1: Radii(11, 7), 2: Radii(10, 6), 3: Radii(12, 8), 4: Radii(12, 8), 5: Radii(12, 8)}),
)
"""After which step, and by block, as printed."""
TABLE_3 = {1: Radii(3, 3), 2: Radii(5, 5), 3: Radii(9, 6), 4: Radii(3, 4), 5: Radii(3, 4)}
"""Its last row; the others are those of Table 2."""


class Accuracy(NamedTuple):
    """What a step leaves: CE90 and LE90 of a typical point by block, and of the vector from block 1 to block 3."""

    step: str
    by_block: dict[int, Radii]
    relative: Radii | None


class Networks(NamedTuple):
    """Answers of networks that were made in different ways.

    Attributes
    ----------
    steps : after each block; control : with external control
    sequential, reversed, simultaneous : block by block, in the opposite order, and in one commit
    """

    steps: list[Accuracy]
    control: Accuracy
    sequential: ControlSet
    reversed: ControlSet
    simultaneous: ControlSet


def measure(scale: float, workers: int, out: Path | None = None) -> list[dict[str, Any]]:
    """Rows of both tables and of every claim; ``scale`` is the part of the 200 runs that are made."""
    layout = five_blocks()
    scene = realise(layout, SEED)
    with tempfile.TemporaryDirectory() as folder:
        networks = fuse(scene, Path(folder))
    steps = [extraction(layout), *networks.steps]
    if out is not None:
        plot(steps, networks.control, out)
    rows = [*table_2(steps), *table_3(networks.control), *claims(steps, networks)]
    whole = solve(scene_blocks(scene))
    far = np.abs(whole.geocentric - networks.sequential.geocentric).max()
    return [
        *rows,
        below("sequential - one bundle in memory, all linearised anew: coordinates, m", 0.01, float(far)),
        *consistency(layout, scale),
    ]


def fuse(scene: SimulatedScene, folder: Path) -> Networks:
    """Networks of a scene through catalogue, runs and queries."""
    layout = scene.layout
    write_scene(scene, folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    blocks = list(catalogue.blocks())
    place = network_of(catalogue, folder / "sequential", [[block] for block in blocks])
    network = submin.open(place)
    after = [network.at(f"v{k + 1}").query(points=_ids(layout, k + 1)) for k in range(len(blocks))]
    steps = [_accuracy(f"block {k + 1}", layout, answer) for k, answer in enumerate(after)]
    answers = [
        submin.open(network_of(catalogue, folder / name, batches)).query(points=layout.point_ids)
        for name, batches in (("reversed", [[block] for block in blocks[::-1]]), ("simultaneous", [blocks]))
    ]
    add_control(survey_table(scene, layout.control), "external control", place, SerialExecutor())
    controlled = submin.open(place).query(points=layout.point_ids)
    return Networks(steps, _accuracy(CONTROLLED, layout, controlled, EXTERNAL_CONTROL), after[-1], *answers)


def extraction(layout: Layout) -> Accuracy:
    """Extraction from the two images of a pair as they are, with the a priori covariance of their parameters, correlation included.

    The mean over all points of a block and all pairs that measure them.
    """
    images, rays = layout.image_set, len(layout.image)
    truth = geodetic_to_geocentric(layout.truth)
    unadjusted = np.zeros((len(images), images.parameters))
    exact = images.project(unadjusted, images.ground(truth), layout.image, layout.point).image
    sigma = np.full((rays, 2), layout.sigma_px)
    # a pair sees its own copy of each of its points
    pair = layout.image // 2
    copies, copy = np.unique(np.stack([pair, layout.point], axis=1), axis=0, return_inverse=True)
    ordered = sorted_rays(copy.ravel().astype(np.int32), layout.image, exact, sigma, np.ones(rays, dtype=np.bool_))
    ground = truth[copies[:, 1]]
    linear = linearise(images, ordered, unadjusted, ground, ground)
    part = GroundPart(ground, linear, point_factors(linear, np.ones(rays)))
    loading = loadings([part], np.arange(len(images), dtype=np.int32), images.parameters)
    joint = joint_covariance(loading, part.factors.own, (images.prior @ images.prior.T).toarray())
    block = np.array([int(image.block_id.split()[1]) for image in layout.images])[2 * copies[:, 0]]
    geodetic, n = layout.truth[copies[:, 1]], len(copies)
    local = rotate_covariance(joint.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :], local_axes(geodetic))
    by_block = {k: _mean_radii(local[block == k]) for k in range(1, 6)}
    relative = _relative(joint, np.flatnonzero(block == 1), np.flatnonzero(block == 3), geodetic)
    return Accuracy("none", by_block, relative)


def table_2(steps: Sequence[Accuracy]) -> Iterator[dict[str, Any]]:
    """Rows of Table 2: every number within 20 % or 1 m, whichever is more."""
    for (step, printed), ours in zip(TABLE_2, steps, strict=True):
        for block, paper in printed.items():
            allowed = [max(0.2 * value, 1.0) for value in paper]
            yield _row("2", step, block, paper, ours.by_block[block], allowed)


def table_3(ours: Accuracy) -> Iterator[dict[str, Any]]:
    """The last row of Table 3: CE within 3 m (block 3: 4 m), LE within 2 m."""
    for block, paper in TABLE_3.items():
        yield _row("3", CONTROLLED, block, paper, ours.by_block[block], (4.0 if block == 3 else 3.0, 2.0))


def claims(steps: Sequence[Accuracy], networks: Networks) -> Iterator[dict[str, Any]]:
    """Rows of what else the experiment must show."""
    deviations = [
        abs(mine - theirs) / theirs
        for (_, printed), ours in zip(TABLE_2, steps, strict=True) for block, paper in printed.items()
        for mine, theirs in zip(ours.by_block[block], paper, strict=True)
    ]  # fmt: skip
    yield below("Table 2: mean deviation from the paper, per cent", 10.0, 100.0 * float(np.mean(deviations)))
    ce = {block: radii.ce for block, radii in networks.control.by_block.items()}
    yield statement("Table 3: CE of block 1 < 2 < 3; CE of block 2, m", f"{ce[1]:.1f} to {ce[3]:.1f}", ce[2], ce[1] < ce[2] < ce[3])
    yield below("Table 3: CE of block 1 is halved by control, m", 0.5 * steps[-1].by_block[1].ce, ce[1])
    before, after = steps[0].relative, steps[-1].relative
    assert before is not None and after is not None
    yield between("relative CE block 1 to 3, no adjustment (paper 35), m", 31.5, 38.5, before.ce)
    yield data("relative LE block 1 to 3, no adjustment, m", "paper 25, contradicts its LE 15", before.le)
    yield data("relative CE block 1 to 3, after block 5, m", "paper 11, not reached with its Table 2", after.ce)
    yield between("relative LE block 1 to 3, after block 5 (paper 6), m", 4.8, 7.2, after.le)
    for name, other in (("opposite order", networks.reversed), ("simultaneous", networks.simultaneous)):
        difference = np.abs(networks.sequential.geocentric - other.geocentric).max()
        yield below(f"sequential - {name}: coordinates, m", 1e-6, float(difference))
        sigma = np.sqrt(np.diag(other.covariance))
        relative = np.abs(networks.sequential.covariance - other.covariance) / sigma / sigma[:, None]
        yield below(f"sequential - {name}: covariance, part of the variances", 1e-9, float(relative.max()))


def consistency(layout: Layout, scale: float) -> Iterator[dict[str, Any]]:
    """Many realisations, each adjusted with its own errors: NEES, and how many errors lie within their CE90 and LE90.

    The bands are those of 200 runs; of fewer they are wider.
    """
    runs = max(round(RUNS * scale), 2)
    truth = geodetic_to_geocentric(layout.truth)
    axes = local_axes(layout.truth)
    nees, errors, covariances, lost = [], [], [], 0
    for seed in range(runs):
        solution = solve(scene_blocks(realise(layout, seed)))
        error = solution.geocentric - truth
        nees.append(nees_per_dof(error.ravel(), solution.joint_covariance(np.arange(len(truth)))))
        errors.append(np.einsum("nij,nj->ni", axes, error))
        covariances.append(solution.local_covariance)
        lost += solution.rejected + solution.released
    pooled = accuracy_against_truth(np.concatenate(errors), np.concatenate(covariances))
    of, rays = f"{runs} runs", runs * len(layout.image)
    off, per_cent = widened(0.03, runs, RUNS), widened(3.0, runs, RUNS)
    yield between(f"NEES per degree of freedom, {of}", 1.0 - off, 1.0 + off, float(np.mean(nees)))
    for name, within in (("CE90", pooled.per_cent_within_ce90), ("LE90", pooled.per_cent_within_le90)):
        yield between(f"per cent within {name}, {of}", 90.0 - per_cent, min(90.0 + per_cent, 100.0), within)
    allowed = 100.0 * rejections_allowed(0.001, rays, runs, RUNS)
    yield below(f"good rays rejected and good cameras flagged, per cent of the rays, {of}", allowed, 100.0 * lost / rays)


def plot(steps: Sequence[Accuracy], control: Accuracy, out: Path) -> None:
    """CE90 and LE90 by block against the step, beside the paper's: ``five-blocks.png`` in a folder."""
    import matplotlib.pyplot as plt

    out.mkdir(parents=True, exist_ok=True)
    shown = [*steps, control]
    printed = [*TABLE_2, (CONTROLLED, TABLE_3)]
    labels = ["none", *(f"+ {step}" for step, _ in TABLE_2[1:]), "+ control"]
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharex=True, constrained_layout=True)
    for place, (name, axis) in enumerate(zip(("CE90", "LE90"), axes, strict=True)):
        for block in range(1, 6):
            # before its own update a point can only be extracted from its pair
            ours = [(k, step.by_block.get(block, shown[0].by_block[block])[place]) for k, step in enumerate(shown)]
            theirs = [(k + 0.06 * (block - 3), row[block][place]) for k, (_, row) in enumerate(printed) if block in row]
            axis.plot(*zip(*ours, strict=True), color=f"C{block - 1}", label=f"block {block}")
            axis.plot(*zip(*theirs, strict=True), "o", color=f"C{block - 1}", mfc="none")
        axis.plot([], [], "o", color="0.4", mfc="none", label="paper")
        axis.set(ylabel=f"{name} of a typical point, m", yscale="log", xlabel="after the update with")
        axis.set_xticks(range(len(labels)), labels, rotation=30)
        axis.set_yticks(ticks := [2, 3, 5, 10, 20, 50], [str(tick) for tick in ticks])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[1].legend(ncols=2)
    figure.suptitle("Five blocks (simulated): lines ours, circles the 2008 paper")
    figure.savefig(out / "five-blocks.png", dpi=110)
    plt.close(figure)


def _row(table: str, step: str, block: int, paper: Radii, ours: Radii, allowed: Sequence[float]) -> dict[str, Any]:
    met = all(abs(mine - theirs) <= limit for mine, theirs, limit in zip(ours, paper, allowed, strict=True))
    return {
        "table": table, "after": step, "block": block, "paper CE": float(paper.ce), "ours CE": ours.ce,
        "paper LE": float(paper.le), "ours LE": ours.le, "verdict": verdict(met),
    }  # fmt: skip


def _blocks_of_points(layout: Layout) -> list[set[int]]:
    """Blocks that measure each point."""
    of_image = [int(image.block_id.split()[1]) for image in layout.images]
    return [{of_image[i] for i in layout.image[layout.point == point]} for point in range(len(layout.point_ids))]


def _ids(layout: Layout, blocks: int) -> NDArray[np.str_]:
    """Points that the first blocks measure."""
    return layout.point_ids[[min(of_point) <= blocks for of_point in _blocks_of_points(layout)]]


def _accuracy(step: str, layout: Layout, answer: ControlSet, without: Sequence[str] = ()) -> Accuracy:
    """Means over the points of each block; a point of several blocks counts in each. Points ``without`` are left out."""
    members = _blocks_of_points(layout)
    of_answer = [members[k] for k in np.searchsorted(layout.point_ids, answer.ids)]
    counted = ~np.isin(answer.ids, without)
    done = range(1, 6) if step == CONTROLLED else range(1, int(step.split()[1]) + 1)
    rows = {block: np.flatnonzero([block in of_point for of_point in of_answer] & counted) for block in done}
    by_block = {block: _mean_radii(answer.local_covariance[at]) for block, at in rows.items()}
    if 3 not in done:
        return Accuracy(step, by_block, None)
    first, third = rows[1], rows[3]
    return Accuracy(step, by_block, _relative(answer.covariance, first, third, answer.geodetic))


def _mean_radii(local: Array) -> Radii:
    return Radii(float(ce90(local[:, :2, :2]).mean()), float(le90(local[:, 2, 2]).mean()))


def _relative(joint: Array, first: Rows, other: Rows, geodetic: Array) -> Radii:
    """Mean relative CE90 and LE90 over all pairs of points of two groups, in the axes of the first point."""
    n = len(geodetic)
    p = joint.reshape(n, 3, n, 3)
    i, j = (index.ravel() for index in np.meshgrid(first, other, indexing="ij"))
    vector = p[i, :, i, :] + p[j, :, j, :] - p[i, :, j, :] - p[j, :, i, :]
    return _mean_radii(rotate_covariance(vector, local_axes(geodetic[i])))
