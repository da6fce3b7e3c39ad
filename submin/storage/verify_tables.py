"""What belongs to the network as a whole, checked: metadata, names, image table, ledger, flags, directory, and what is in which cell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from submin.errors import SubminError
from submin.network.network_image import image_set
from submin.storage.arrays import group_of, read_table
from submin.storage.ledger import Entry
from submin.storage.problems import DAMAGE, Problem, first_line, some
from submin.storage.ray_totals import summed_cells
from submin.storage.repository import versions
from submin.storage.schema import FLAG_COLUMNS, IMAGE_COLUMNS, LEDGER_COLUMNS
from submin.storage.snapshot import Snapshot
from submin.storage.verify_tile import CellContents
from submin.tiling.cover import Cover

WITHOUT = "without image"
"""How the reason of a block begins of which images were withdrawn (`orchestration.withdraw`)."""


def stored_tiles(snapshot: Snapshot) -> tuple[list[int], list[Problem]]:
    """Tiles to check: those with a sub-MIN, and those that hold a cell; and names that the cover does not have."""
    tiles: set[int] = set()
    problems = []
    for kind, number_of in (("tiles", snapshot.cover.tile_number), ("cells", snapshot.cover.cell_number)):
        for name in sorted(group_of(snapshot.root, kind).group_keys()):
            try:
                number = number_of(name)
            except SubminError as error:
                problems.append(Problem("", "unknown-name", f"{kind[:-1]} {name} is stored: {error}"))
                continue
            tiles.update([number] if kind == "tiles" else snapshot.cover.holders(number))
    return sorted(tiles), problems


def verify_network(snapshot: Snapshot, cells: Sequence[CellContents], complete: bool) -> list[Problem]:
    """Check what no tile can check by itself.

    ``cells`` is what the tiles found in their own cells. Where these are not ``complete``, some being unreadable, no ray is called missing.
    """
    problems: list[Problem] = []
    checks: tuple[tuple[str, Callable[[], list[Problem]]], ...] = (
        ("the history", lambda: verify_history(snapshot)),
        ("the totals of rays", lambda: _ray_totals(snapshot)),
        ("the image table", lambda: _image_table(snapshot)),
        ("the ledger", lambda: _ledger(snapshot, cells, complete)),
        ("the flags of bad cameras", lambda: _flags(snapshot)),
        ("the directory of points", lambda: _directory(snapshot, cells)),
    )
    for what, check in checks:
        try:
            problems += check()
        except DAMAGE as error:
            problems.append(Problem("", "unreadable", f"{what}: {first_line(error)}"))
    return problems


def verify_history(snapshot: Snapshot) -> list[Problem]:
    """The number of a version is written in its root and in its commit."""
    count = [version.number for version in versions(snapshot.place)].count(snapshot.number)
    return [] if count == 1 else [Problem("", "metadata", f"the root says version {snapshot.number}; the history has {count} of them")]


def _ray_totals(snapshot: Snapshot) -> list[Problem]:
    """Totals follow every change of a cell; squares are added up in another order."""
    stated, found = snapshot.ray_totals(), summed_cells(snapshot.root)
    near = abs(stated.square_px - found.square_px) <= 1e-6 * max(found.square_px, 1.0)
    if near and replace(stated, square_px=found.square_px) == found:
        return []
    return [Problem("", "metadata", f"the root has {stated} for all cells together; the cells sum to {found}")]


def _image_table(snapshot: Snapshot) -> list[Problem]:
    table = snapshot.image_columns(list(IMAGE_COLUMNS))
    lengths = {name: len(column) for name, column in table.items()}
    if len(set(lengths.values())) > 1:
        return [Problem("", "image-table", f"columns have different lengths: {lengths}")]
    here = table["withdrawn"] == 0
    problems = [
        Problem("", "image-table", f"column {name} holds {table[name].max()}; expected 0 and 1")
        for name in ("released", "withdrawn")
        if (table[name] > 1).any()
    ]
    ids, count = np.unique(table["image_id"][here], return_counts=True)
    twice = ids[count > 1].tolist()
    if twice:
        problems.append(Problem("", "block-twice", f"{len(twice)} images are in the network twice: {some(twice)}"))
    for image in snapshot.images():
        try:
            usable = image_set([image], snapshot.metadata.ellipsoid, snapshot.metadata.parameters)
            finite = bool(np.isfinite(usable.cameras).all() and np.isfinite(usable.prior_variance).all())
        except DAMAGE as error:
            problems.append(Problem("", "image-table", f"image {image.image_id}: {first_line(error)}"))
            continue
        if not finite:
            problems.append(Problem("", "image-table", f"image {image.image_id}: its camera or a priori model is not finite"))
    return problems


def _ledger(snapshot: Snapshot, cells: Sequence[CellContents], complete: bool) -> list[Problem]:
    """Every block once: lines against the image table, rays in the cells against lines."""
    columns = snapshot.ledger(list(LEDGER_COLUMNS))
    names = [f.name for f in fields(Entry)]
    lines = [Entry(*row) for row in zip(*(columns[name].tolist() for name in names), strict=True)]
    table = snapshot.image_columns(["image_id", "block_id", "withdrawn"])
    problems: list[Problem] = []
    last: dict[str, Entry] = {}
    for line in lines:
        before = last.get(line.block_id)
        if line.status == "fused" and before is not None and before.status == "fused" and not line.reason.startswith(WITHOUT):
            problems.append(Problem("", "block-twice", f"block {line.block_id} is fused in v{before.version} and again in v{line.version}"))
        if not 0 <= line.version <= snapshot.number:
            problems.append(Problem("", "ledger", f"block {line.block_id} came with version {line.version}; this is v{snapshot.number}"))
        if line.status != "rejected":
            last[line.block_id] = line

    total, gone = len(table["image_id"]), table["withdrawn"] != 0
    rays = np.zeros(total, dtype=np.int64)
    for cell in cells:
        if len(cell.images) and int(cell.images[-1]) < total:
            np.add.at(rays, cell.images, cell.rays)
    problems += _leftovers(snapshot, cells, table["image_id"], gone, rays)
    blocks, of_block = np.unique(table["block_id"], return_inverse=True)
    images = np.bincount(of_block, weights=~gone, minlength=len(blocks)).astype(np.int64)
    in_cells = np.bincount(of_block, weights=rays * ~gone, minlength=len(blocks)).astype(np.int64)
    found = {str(block): (int(m), int(r)) for block, m, r in zip(blocks, images, in_cells, strict=True)}
    for block, line in last.items():
        m, r = found.pop(block, (0, 0))
        if line.status != "fused":
            if m:
                problems.append(Problem("", "ledger", f"block {block} is {line.status}, and {m} of its images are in the image table"))
            continue
        if m != line.images:
            problems.append(Problem("", "ledger", f"block {block} has {line.images} images; the image table has {m}"))
        if r > line.rays or (r < line.rays and complete):
            kind = "rays-missing" if r < line.rays else "block-twice"
            problems.append(Problem("", kind, f"block {block} came with {line.rays} rays; {r} are in the cells"))
    for block, (m, _) in found.items():
        if m:
            problems.append(Problem("", "ledger", f"{m} images are of block {block}, which is not in the ledger"))
    return problems


def _leftovers(
    snapshot: Snapshot, cells: Sequence[CellContents], image_ids: NDArray[np.str_], gone: NDArray[np.bool_], rays: NDArray[np.int64]
) -> list[Problem]:
    """Rays of images that are not in the network any more, by tile."""
    if not (rays[gone] > 0).any():
        return []
    problems = []
    for cell in cells:
        left = cell.images[gone[cell.images]]
        if len(left):
            problems.append(Problem(
                snapshot.cover.tile_name(Cover.owner(cell.number)), "withdrawn-rays",
                f"cell {snapshot.cover.cell_name(cell.number)} has rays of withdrawn images: {some(image_ids[left].tolist())}",
            ))  # fmt: skip
    return problems


def _flags(snapshot: Snapshot) -> list[Problem]:
    """Which cameras are bad is written twice: by tile, and in the image table."""
    flags = read_table(group_of(snapshot.root, "flags"), list(FLAG_COLUMNS))
    table = snapshot.image_columns(["image_id", "released", "withdrawn"])
    stored, _ = stored_tiles(snapshot)
    by_tile: dict[int, set[int]] = {}
    problems = []
    for tile, row in zip(flags["tile"].tolist(), flags["image"].tolist(), strict=True):
        if tile not in stored or not 0 <= row < len(table["image_id"]):
            problems.append(Problem("", "released-flag", f"tile {tile} flags image row {row}; there is no such tile or image"))
        else:
            by_tile.setdefault(row, set()).add(tile)
    for row in sorted({*by_tile} ^ {*np.flatnonzero(table["released"] != 0).tolist()}):
        image = table["image_id"][row]
        problems += [
            Problem(
                snapshot.cover.tile_name(tile), "released-flag", f"the tile finds the camera of image {image} bad, and its prior is in use"
            )
            for tile in sorted(by_tile.get(row, ()))
        ] or [Problem("", "released-flag", f"the prior of image {image} is released, and no tile finds its camera bad")]
    return problems


def _directory(snapshot: Snapshot, cells: Sequence[CellContents]) -> list[Problem]:
    """Every point is in one cell, and the directory says in which. Entries of points that have left the network may stay."""
    every = np.concatenate([np.empty(0, dtype=np.uint64), *(cell.hashes for cell in cells)])
    number = np.repeat(np.array([cell.number for cell in cells], dtype=np.int64), [len(cell.hashes) for cell in cells])
    problems = []
    _, inverse, count = np.unique(every, return_inverse=True, return_counts=True)
    again = count[inverse] > 1
    for cell in np.unique(number[again]).tolist():
        points = int((number[again] == cell).sum())
        problems.append(_of_cell(snapshot, cell, "point-in-two-cells", f"{points} points of cell %s are in another cell too"))
    listed = read_table(group_of(snapshot.root, "directory"))
    # entries are in order of arrival, and the last one of a point counts
    known, first = np.unique(listed["hash"][::-1], return_index=True)
    says = listed["cell"][::-1][first]
    at = np.minimum(np.searchsorted(known, every), max(len(known) - 1, 0))
    right = (known[at] == every) & (says[at] == number) if len(known) else np.zeros(len(every), dtype=np.bool_)
    lost = ~right & ~again  # what is in two cells is told above
    for cell in np.unique(number[lost]).tolist():
        points = int((number[lost] == cell).sum())
        problems.append(_of_cell(snapshot, cell, "directory", f"the directory does not find {points} points of cell %s"))
    return problems


def _of_cell(snapshot: Snapshot, cell: int, kind: str, detail: str) -> Problem:
    return Problem(snapshot.cover.tile_name(Cover.owner(cell)), kind, detail % snapshot.cover.cell_name(cell))
