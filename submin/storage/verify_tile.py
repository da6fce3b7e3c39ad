"""One tile of a network, checked against its own rays: cells, sums, sub-MIN, and how much round-off is in it. Nothing is changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from submin.adjustment.elimination import LinearRays, point_factors
from submin.adjustment.estimation import reduced_information
from submin.adjustment.images import ImageSet
from submin.errors import NumericalError
from submin.geodesy import geocentric_to_geodetic
from submin.network.cell import Cell, linear_rays, summed, union_of_images
from submin.network.health import asymmetry, condition, positive_semi_definite, sub_min_difference, sums_difference
from submin.network.network_image import NetworkImage, image_set
from submin.network.replay import joined, replay_error
from submin.network.sub_min import SubMin, add_sums, factor, wider
from submin.network.variance_factor import Fits, Kind, fits
from submin.query.planner import DETERMINED_METRES
from submin.storage.arrays import attributes_of, group_of, hash_ids, read_matrix, read_record
from submin.storage.problems import DAMAGE, Problem, first_line, some
from submin.storage.schema import determined, read_cell
from submin.storage.snapshot import Snapshot
from submin.tiling.cover import Cover

Array = NDArray[np.float64]

SUMS_TOLERANCE = 1e-9
"""Relative difference of sums: where rays are summed in another order, on another machine, it is below 1e-13 (docs/quality.md)."""
FACTOR_TOLERANCE = 1e-9
"""Of a sub-MIN, relative to two standard deviations; more where the condition of the information makes more of round-off."""
ROUND_OFF = 100.0 * float(np.finfo(np.float64).eps)
"""Part by which two ways to the same sub-MIN may differ, for each unit of the condition."""
REPLAY_TOLERANCE = 1e-6
SEMI_DEFINITE = 1e-9
COMBINATIONS, POINTS_OF_EACH = 3, 3
METRE_DEGREES = 1e-8
"""A registered position this near to a border of cells (a millimetre) may lie on either side of it."""


@dataclass(frozen=True)
class CellContents:
    """What a cell holds, for checks across cells.

    Attributes
    ----------
    number : of the cell; hashes : (n,) of its points' ids, as the directory has them
    images : (m,) rows of the network's images; rays : (m,) rays of each, rejected ones too
    """

    number: int
    hashes: NDArray[np.uint64]
    images: NDArray[np.int32]
    rays: NDArray[np.int64]


@dataclass(frozen=True)
class TileHealth:
    """What was found in a tile.

    Attributes
    ----------
    tile : its name
    problems : in its own cells and its sub-MIN
    cells : what its own cells hold
    unread : number of its own cells that cannot be read
    images, parameters : that it sees; 0 without a sub-MIN
    condition : of its information, scaled to a unit diagonal
    sums_error, factor_error, symmetric_error, replay_error : see docs/quality.md; NaN where there was nothing to compare
    fits : of the measurements of the points in its own core, by sensor and platform
    """

    tile: str
    problems: tuple[Problem, ...]
    cells: tuple[CellContents, ...] = ()
    unread: int = 0
    images: int = 0
    parameters: int = 0
    condition: float = float("nan")
    sums_error: float = float("nan")
    factor_error: float = float("nan")
    symmetric_error: float = float("nan")
    replay_error: float = float("nan")
    fits: Fits | None = None


@dataclass
class _Findings:
    """Problems of one tile, as they are found."""

    tile: str
    problems: list[Problem] = field(default_factory=list)

    def add(self, kind: str, detail: str) -> None:
        self.problems.append(Problem(self.tile, kind, detail))

    def unreadable(self, what: str, error: Exception) -> None:
        self.add("unreadable", f"{what}: {first_line(error)}")


@dataclass(frozen=True)
class _Linear:
    """A cell of the tile whose rays can be trusted enough to be computed with."""

    cell: Cell
    rays: LinearRays
    weight: Array


def verify_tile(snapshot: Snapshot, tile: int) -> TileHealth:
    """Check a tile: its own cells against their rays, its sub-MIN against the cells that it holds, and its round-off against a replay.

    Problems are found, never raised: damage in one array does not hide that in another.
    """
    name = snapshot.cover.tile_name(tile)
    found = _Findings(name)
    held: dict[int, Cell | None] = {}
    linear: dict[int, _Linear] = {}
    contents: list[CellContents] = []
    sums_error = float("nan")
    cells_stored = group_of(snapshot.root, "cells")
    for number in snapshot.cover.cells_held(tile):
        cell_name = snapshot.cover.cell_name(number)
        if cell_name not in cells_stored:
            continue
        own = Cover.owner(number) == tile
        cell = _read_cell(snapshot, number, cell_name, found if own else _Findings(name))
        held[number] = cell
        if cell is not None and own:
            contents.append(_contents(cell))
    there = [cell for cell in held.values() if cell is not None]
    images_of = _Images(snapshot, union_of_images(there))
    for cell in there:
        own, cell_name = Cover.owner(cell.number) == tile, snapshot.cover.cell_name(cell.number)
        try:
            images = images_of.take(cell.images)
        except DAMAGE as error:
            found.add("image-table", f"images of cell {cell_name}: {first_line(error)}")
            continue
        try:
            linear[cell.number] = _Linear(cell, linear_rays(cell, images), cell.rays.accepted.astype(np.float64))
            if own:
                sums_error = np.fmax(sums_error, _check_sums(cell, images, linear[cell.number], cell_name, found))
        except DAMAGE as error:
            found.unreadable(f"rays of cell {cell_name}", error)
    numbers = _check_sub_min(snapshot, tile, held, linear, images_of, found)
    unread = sum(cell is None for number, cell in held.items() if Cover.owner(number) == tile)
    return TileHealth(name, tuple(found.problems), tuple(contents), unread, sums_error=float(sums_error), **numbers)


class _Images:
    """Images of a tile, read once and when they are first asked for."""

    def __init__(self, snapshot: Snapshot, rows: NDArray[np.int32]) -> None:
        self._snapshot, self._rows = snapshot, rows
        self._read: list[NetworkImage] | None = None

    def take(self, rows: NDArray[np.int32]) -> ImageSet:
        """Those of some rows, ascending."""
        if self._read is None:
            self._read = self._snapshot.images(self._rows)
        read, metadata = self._read, self._snapshot.metadata
        return image_set([read[k] for k in np.searchsorted(self._rows, rows).tolist()], metadata.ellipsoid, metadata.parameters)

    def kinds(self, rows: NDArray[np.int32]) -> list[Kind]:
        """Sensor and platform of the images of some rows."""
        table = self._snapshot.image_columns(["sensor", "platform"])
        return list(zip(table["sensor"][rows].tolist(), table["platform"][rows].tolist(), strict=True))


def _contents(cell: Cell) -> CellContents:
    rays = np.bincount(cell.rays.image, minlength=len(cell.images))
    return CellContents(cell.number, hash_ids(cell.point_ids), cell.images, rays)


def _read_cell(snapshot: Snapshot, number: int, name: str, found: _Findings) -> Cell | None:
    """A cell whose rows fit together, or None; what does not fit is found."""
    try:
        group = group_of(snapshot.root, "cells/" + name)
        attributes = attributes_of(group)
        cell = read_cell(group, int(snapshot.metadata.parameters))
    except DAMAGE as error:
        found.unreadable(f"cell {name}", error)
        return None
    wrong = _damage(cell, number, snapshot.image_count())
    for kind, detail in wrong:
        found.add(kind, f"cell {name}: {detail}")
    if wrong:
        return None
    for detail in _miscounted(cell, attributes):
        found.add("damaged-cell", f"cell {name}: {detail}")
    first = np.flatnonzero((np.diff(cell.rays.point) == 0) & (np.diff(cell.rays.image) == 0))
    if len(first):
        twice = [f"{cell.point_ids[cell.rays.point[k]]} in image row {cell.images[cell.rays.image[k]]}" for k in first.tolist()]
        found.add("duplicate-ray", f"cell {name}: {len(first)} rays are there twice: {some(twice)}; expected one of a point in an image")
    elsewhere = _misplaced(cell, snapshot.cover)
    if elsewhere:
        found.add("misplaced-point", f"cell {name}: registered positions of {len(elsewhere)} points lie in other cells: {some(elsewhere)}")
    return cell


def _damage(cell: Cell, number: int, image_count: int) -> list[Kind]:
    """What keeps a cell from being computed with: kind and detail."""
    n, m, rays, sums = len(cell.point_ids), len(cell.images), cell.rays, cell.sums
    r, size = len(rays.point), m * cell.theta.shape[1] if cell.theta.ndim == 2 else -1
    shapes: dict[str, tuple[NDArray[Any], tuple[int, ...]]] = {
        "origin": (cell.origin, (n, 3)), "linearised_at": (cell.linearised_at, (n, 3)), "theta": (cell.theta, (m, size // max(m, 1))),
        "ray_image": (rays.image, (r,)), "accepted": (rays.accepted, (r,)), "observed": (rays.observed, (r, 2)),
        "sigma": (rays.sigma, (r, 2)), "vector": (sums.vector, (size,)), "information": (sums.information, (size, size)),
    }  # fmt: skip
    wrong = [("damaged-cell", f"{part} has shape {a.shape}; expected {shape}") for part, (a, shape) in shapes.items() if a.shape != shape]
    if wrong:
        return wrong
    finite = ("origin", "linearised_at", "theta", "observed", "sigma", "vector", "information")
    for part in finite:
        bad = int((~np.isfinite(shapes[part][0])).sum())
        if bad:
            wrong.append(("not-finite", f"{bad} of {shapes[part][0].size} numbers of {part} are not finite"))
    rules = {
        f"number {number}": cell.number == number,
        "point ids ascending and each once": bool((cell.point_ids[1:] > cell.point_ids[:-1]).all()) and not (cell.point_ids == "").any(),
        "image rows ascending, of the image table": bool((np.diff(cell.images) > 0).all())
        and (m == 0 or (cell.images[0] >= 0 and int(cell.images[-1]) < image_count)),
        "rays sorted by point, then image, of the cell's points and images": bool(
            ((rays.point >= 0) & (rays.point < n) & (rays.image >= 0) & (rays.image < m)).all()
            and (np.diff(rays.point.astype(np.int64) * max(m, 1) + rays.image) >= 0).all()
        ),
        "positive sigmas": bool((rays.sigma > 0.0).all()) or not np.isfinite(rays.sigma).all(),
    }
    wrong += [("damaged-cell", f"expected {rule}") for rule, kept in rules.items() if not kept]
    if wrong:
        return wrong
    if (np.bincount(rays.point, minlength=n) == 0).any() or (np.bincount(rays.image, minlength=m) == 0).any():
        return [("damaged-cell", "a point or an image has no ray; expected some of each")]
    return []


def _miscounted(cell: Cell, attributes: dict[str, Any]) -> list[str]:
    """Counts among a cell's attributes that are not those of its rows."""
    counts = {
        "points": len(cell), "determined": int(determined(cell).sum()), "rays": len(cell.rays), "accepted": int(cell.rays.accepted.sum()),
    }  # fmt: skip
    return [f"its count of {key} is {attributes.get(key)}; it has {n}" for key, n in counts.items() if attributes.get(key) != n]


def _misplaced(cell: Cell, cover: Cover) -> list[str]:
    """Points whose registered position lies in another cell."""
    at = geocentric_to_geodetic(cell.origin, cover.ellipsoid)
    off = np.flatnonzero(cover.cells_of(at[:, 0], at[:, 1]) != cell.number)
    for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        if len(off):
            near = cover.cells_of(at[off, 0] + dx * METRE_DEGREES, at[off, 1] + dy * METRE_DEGREES) == cell.number
            off = off[~near]
    return [f"{cell.point_ids[k]} in {cover.cell_name(int(cover.cells_of(at[k : k + 1, 0], at[k : k + 1, 1])[0]))}" for k in off.tolist()]


def _check_sums(cell: Cell, images: ImageSet, linear: _Linear, name: str, found: _Findings) -> float:
    """Compare a cell's sums with those of its rays."""
    made = summed(cell, images)
    difference = sums_difference(cell.sums, made.sums, linear.rays, linear.weight, len(images))
    if not difference <= SUMS_TOLERANCE:
        found.add("cell-sums", f"cell {name}: its sums differ from its rays' by {difference:.1e}; expected at most {SUMS_TOLERANCE:g}")
    if cell.sums.redundancy != made.sums.redundancy:
        found.add("cell-sums", f"cell {name}: its redundancy is {cell.sums.redundancy}; its rays have {made.sums.redundancy}")
    return difference


def _check_sub_min(
    snapshot: Snapshot, tile: int, held: dict[int, Cell | None], linear: dict[int, _Linear], images_of: _Images, found: _Findings
) -> dict[str, Any]:
    """Compare a tile's sub-MIN with what its cells say; numbers of `TileHealth`."""
    cover, name = snapshot.cover, snapshot.cover.tile_name(tile)
    if name not in group_of(snapshot.root, "tiles"):
        if held:
            found.add("lost-tile", f"the tile has no sub-MIN, and holds {len(held)} cells: {some([cover.cell_name(c) for c in held])}")
        return {}
    group = group_of(snapshot.root, "tiles/" + name)
    try:
        stored, raw, counted = _read_sub_min(group)
        stored = wider(stored, snapshot.metadata.parameters)
    except DAMAGE as error:
        found.unreadable("sub-MIN", error)
        return {}
    if not _usable(stored, raw, snapshot.image_count(), found):
        return {"images": len(stored.images)}
    numbers: dict[str, Any] = {"images": len(stored.images), "parameters": stored.theta.size, "symmetric_error": asymmetry(raw)}
    if not numbers["symmetric_error"] <= FACTOR_TOLERANCE:
        found.add("not-symmetric", f"the triangles of the covariance differ by {numbers['symmetric_error']:.1e}; expected round-off")
    if not positive_semi_definite(stored.covariance, SEMI_DEFINITE):
        found.add("not-positive-definite", "the covariance of the images' corrections has a negative eigenvalue")
    lost, more = sorted({*counted} - {*held}), sorted({*held} - {*counted})
    if lost:
        found.add("lost-cell", f"the sub-MIN counts {len(lost)} cells that are not there: {some([_cell_name(cover, c) for c in lost])}")
    if more:
        found.add("stale-factor", f"{len(more)} cells that the tile holds are not counted: {some([cover.cell_name(c) for c in more])}")
    if lost or more or len(linear) < len(held):
        return numbers
    try:
        return numbers | _compare(images_of, stored, list(linear.values()), found, tile)
    except NumericalError as error:
        found.add("not-positive-definite", f"the information of the cells held cannot be factored: {error}")
    except DAMAGE as error:
        found.unreadable("sub-MIN", error)
    return numbers


def _cell_name(cover: Cover, number: int) -> str:
    try:
        return cover.cell_name(number)
    except DAMAGE:
        return f"number {number}"


def _read_sub_min(group: zarr.Group) -> tuple[SubMin, Array, list[int]]:
    """A sub-MIN, its covariance as it is stored (blocks above the diagonal zero), and the cells that it counts."""
    parts, attributes = read_record(group, ["images", "theta", "cells"]), attributes_of(group)
    raw = read_matrix(group, "covariance")
    full = np.tril(raw)
    full += np.tril(raw, -1).T
    sub_min = SubMin(parts["images"].astype(np.int32), parts["theta"], full, float(attributes["chi_square"]), int(attributes["redundancy"]))
    return sub_min, raw, parts["cells"].tolist()


def _usable(stored: SubMin, raw: Array, image_count: int, found: _Findings) -> bool:
    """True when a sub-MIN can be computed with."""
    m = len(stored.images)
    ascending = bool((np.diff(stored.images) > 0).all()) and m > 0 and stored.images[0] >= 0 and int(stored.images[-1]) < image_count
    if not ascending or stored.theta.shape[0] != m or stored.covariance.shape != (stored.theta.size, stored.theta.size):
        found.add("unreadable", "sub-MIN: images, corrections and covariance do not fit together")
        return False
    for part, values in (("corrections", stored.theta), ("covariance", raw), ("chi-square", np.array([stored.chi_square]))):
        bad = int((~np.isfinite(values)).sum())
        if bad:
            found.add("not-finite", f"sub-MIN: {bad} of {values.size} numbers of its {part} are not finite")
            return False
    return True


def _compare(images_of: _Images, stored: SubMin, linear: Sequence[_Linear], found: _Findings, tile: int) -> dict[str, Any]:
    """Compare a sub-MIN with the cells that its tile holds, and with their rays."""
    cells = [of_cell.cell for of_cell in linear]
    rows = np.unique(np.concatenate([cell.images for cell in cells])).astype(np.int32)
    if not np.array_equal(rows, stored.images):
        found.add("stale-factor", f"the sub-MIN is about {len(stored.images)} images; its cells see {len(rows)}, not the same")
        return {}
    images = images_of.take(rows)
    sums = add_sums([(cell.images, cell.sums) for cell in cells], rows, images.parameters)
    number, root = condition(reduced_information(sums.information, images.prior))
    numbers: dict[str, Any] = {"condition": number}
    if not root.size and images.prior.shape[1]:
        found.add("not-positive-definite", f"the information of the cells held ({images.prior.shape[1]} parameters) has no Cholesky factor")
        return numbers
    made = factor(sums, rows, images)
    numbers["factor_error"] = sub_min_difference(stored, made)
    allowed = max(FACTOR_TOLERANCE, ROUND_OFF * number)
    stale = not numbers["factor_error"] <= allowed or stored.redundancy != made.redundancy
    if stale:
        found.add(
            "stale-factor",
            f"the sub-MIN differs from the factorisation of its cells by {numbers['factor_error']:.1e} standard deviations; "
            f"expected at most {allowed:.0e}: a cell, or the a priori model of an image, is not what it was factored from",
        )
    every, weight = _together(stored, linear), np.concatenate([of_cell.weight for of_cell in linear])
    numbers["replay_error"], allowed = _replayed(stored, every, weight, images, root, tile), max(REPLAY_TOLERANCE, ROUND_OFF * number)
    if not stale and not numbers["replay_error"] <= allowed:
        found.add("round-off", f"the sub-MIN differs from its replay by {numbers['replay_error']:.1e}; expected at most {allowed:.0e}")
    own = np.concatenate([np.full(len(of_cell.weight), Cover.owner(of_cell.cell.number) == tile) for of_cell in linear])
    numbers["fits"] = fits(every, weight * own, stored.theta, stored.covariance, images_of.kinds(rows))
    return numbers


def _together(stored: SubMin, linear: Sequence[_Linear]) -> LinearRays:
    """The rays of all cells that a tile holds; ``image`` are rows of its sub-MIN."""
    parts = []
    for of_cell in linear:
        rays = of_cell.rays
        at = np.searchsorted(stored.images, of_cell.cell.images)[rays.image].astype(np.int32)
        parts.append(LinearRays(rays.first, at, rays.by_ground, rays.by_parameters, rays.y))
    return joined(parts)


def _replayed(stored: SubMin, every: LinearRays, weight: Array, images: ImageSet, root: Array, tile: int) -> float:
    """See `submin.network.replay.replay_error`; the combinations of points are the same in every call."""
    factors = point_factors(every, weight)
    spread = np.trace(factors.own, axis1=1, axis2=2)
    good = np.flatnonzero((factors.rank == 3) & (np.where(factors.rank == 3, spread, np.inf) < DETERMINED_METRES**2))
    chance = np.random.default_rng(tile)
    combinations = [
        (chosen, chance.standard_normal((len(chosen), 3)))
        for chosen in (chance.choice(good, min(POINTS_OF_EACH, len(good)), replace=False) for _ in range(COMBINATIONS))
        if len(chosen)
    ]
    return replay_error(every, weight, factors, stored.theta, stored.covariance, images.prior, root, combinations)
