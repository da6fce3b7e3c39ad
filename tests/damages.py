"""Damage to a network as no command does it, and what verify must say of each."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from submin.network.cell import summed
from submin.network.network_image import image_set
from submin.storage.arrays import append_table, array_of, attributes_of, group_of, read_record, read_table, set_rows, write_record
from submin.storage.commit import begin_change, commit
from submin.storage.schema import write_cell
from submin.storage.snapshot import Snapshot

Found = tuple[str, str]
"""Kind of a problem, and the tile that must be named."""


class Store:
    """A network's store, to be damaged as no command would: one version more, of whatever is written into ``root``."""

    def __init__(self, place: Path) -> None:
        self.place = str(place)
        before = Snapshot.open(self.place)
        self.session, self.base = begin_change(self.place, before.number)
        self.root = zarr.open_group(self.session.store, mode="r+")
        self.busiest = max(self.base.cell_numbers(), key=lambda number: self.base.cell_counts([number])[0]["rays"])
        self.cell_name = self.base.cover.cell_name(self.busiest)
        self.owner = self.base.cover.tile_name(self.base.cover.owner(self.busiest))

    def commit(self) -> None:
        self.root.attrs["version"] = self.base.number + 1
        commit(self.session, self.base.number + 1, "damaged")

    def edit(self, name: str, **parts: Callable[[np.ndarray], Any]) -> None:
        """Change parts of a record in place."""
        group = group_of(self.root, name)
        attributes = {key: value for key, value in attributes_of(group).items() if key != "layout"}
        record = read_record(group)
        for part, change in parts.items():
            change(record[part])
        others = {key: array_of(group, key)[...] for key in group.array_keys() if key not in ("data",)}
        path, _, last = name.rpartition("/")
        written = write_record(group_of(self.root, path), last, record, attributes)
        for key, values in others.items():
            written.create_array(key, data=np.asarray(values))

    def edit_cell(self, **parts: Callable[[np.ndarray], Any]) -> None:
        self.edit("cells/" + self.cell_name, **parts)

    def edit_covariance(self, change: Callable[[np.ndarray], Any]) -> None:
        array = array_of(group_of(self.root, "tiles/" + self.owner), "covariance")
        values = np.asarray(array[:, :])
        change(values)
        array[:, :] = values

    def edit_text(self, table: str, column: str, row: int, change: Callable[[str], str]) -> None:
        """Change one text of a table."""
        group = group_of(self.root, table)
        columns = read_table(group)
        texts = columns[column].astype(object)
        texts[row] = change(texts[row])
        columns[column] = texts.astype(np.str_)
        for name in group.array_keys():
            array_of(group, name).resize((0,))
        append_table(group, columns)


def scaled(at: Any, factor: float) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[at] *= factor

    return change


def put(at: Any, value: Any) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[at] = value

    return change


def shifted(at: Any, by: float) -> Callable[[np.ndarray], None]:
    def change(values: np.ndarray) -> None:
        values[at] += by

    return change


def tampered_information(store: Store) -> list[Found]:
    store.edit_cell(information=scaled(2, 1.0 + 1e-6))  # the second element of the diagonal
    return [("cell-sums", store.owner), ("stale-factor", store.owner)]


def tampered_vector(store: Store) -> list[Found]:
    store.edit_cell(vector=scaled(1, 1.0 + 1e-4))
    return [("cell-sums", store.owner)]


def tampered_observation(store: Store) -> list[Found]:
    store.edit_cell(observed=shifted((3, 0), 0.01))
    return [("cell-sums", store.owner)]


def tampered_corrections(store: Store) -> list[Found]:
    store.edit("tiles/" + store.owner, theta=shifted((0, 0), 1e-4))
    return [("stale-factor", store.owner)]


def tampered_covariance(store: Store) -> list[Found]:
    store.edit_covariance(scaled((7, 2), 1.0 + 1e-4))
    return [("stale-factor", store.owner)]


def asymmetric_covariance(store: Store) -> list[Found]:
    store.edit_covariance(scaled((2, 7), 1.0 + 1e-4))
    return [("not-symmetric", store.owner)]


def indefinite_covariance(store: Store) -> list[Found]:
    store.edit_covariance(scaled((4, 4), 0.5))
    return [("not-positive-definite", store.owner)]


def indefinite_information(store: Store) -> list[Found]:
    store.edit_cell(information=put(2, -1e9))
    return [("cell-sums", store.owner), ("not-positive-definite", store.owner)]


def flipped_flag(store: Store) -> list[Found]:
    accepted = np.flatnonzero(store.base.cell(store.busiest).rays.accepted)[5]
    store.edit_cell(accepted=put(accepted, 0))
    return [("cell-sums", store.owner), ("damaged-cell", store.owner)]


def stale_factor(store: Store) -> list[Found]:
    """A ray is changed and its cell summed again, as it should be; the tiles that hold it are not factored."""
    cell = store.base.cell(store.busiest)
    cell.rays.observed[3, 1] += 0.5
    images = image_set(store.base.images(cell.images), store.base.metadata.ellipsoid, store.base.metadata.parameters)
    counts = store.base.cell_counts([store.busiest])[0]
    write_cell(store.root, store.cell_name, summed(cell, images), counts["square_px"], counts["pixel_rays"])
    return [("stale-factor", store.base.cover.tile_name(tile)) for tile in store.base.cover.holders(store.busiest)]


def nan_in_a_cell(store: Store) -> list[Found]:
    store.edit_cell(observed=put((3, 0), np.nan))
    return [("not-finite", store.owner)]


def nan_in_a_covariance(store: Store) -> list[Found]:
    store.edit_covariance(put((9, 3), np.nan))
    return [("not-finite", store.owner)]


def ids_out_of_order(store: Store) -> list[Found]:
    cell = store.base.cell(store.busiest)
    store.edit_cell(point_ids=put([0, 1], cell.point_ids[[1, 0]]))
    return [("damaged-cell", store.owner)]


def image_out_of_range(store: Store) -> list[Found]:
    store.edit_cell(ray_image=put(0, 10**6))
    return [("damaged-cell", store.owner)]


def ray_twice(store: Store) -> list[Found]:
    cell = store.base.cell(store.busiest)
    k = int(np.flatnonzero(np.diff(cell.rays.point) == 0)[0])
    store.edit_cell(ray_image=put(k + 1, cell.rays.image[k]))
    return [("duplicate-ray", store.owner), ("cell-sums", store.owner)]


def misplaced_point(store: Store) -> list[Found]:
    """A registered position moves by two tiles; sums do not depend on it."""
    store.edit_cell(origin=shifted((0, slice(None)), 90e3))
    return [("misplaced-point", store.owner)]


def block_in_two_cells(store: Store) -> list[Found]:
    """All rays of a cell once more in another one, both as they should be."""
    cell = store.base.cell(store.busiest)
    cover, numbers = store.base.cover, store.base.cell_numbers()
    other = next(c for tile in cover.tiles() for c in cover.cells_owned(tile) if c != cell.number)
    assert other in numbers  # it is replaced
    write_cell(store.root, cover.cell_name(other), dataclasses.replace(cell, number=other), 0.0, len(cell.rays))
    owner = cover.tile_name(cover.owner(other))
    return [("point-in-two-cells", store.owner), ("point-in-two-cells", owner), ("block-twice", ""), ("misplaced-point", owner),
            ("stale-factor", owner)]  # fmt: skip


def ledger_line_twice(store: Store) -> list[Found]:
    ledger = group_of(store.root, "ledger")
    append_table(ledger, read_table(ledger, start=4, stop=5))
    return [("block-twice", "")]


def image_row_twice(store: Store) -> list[Found]:
    images = group_of(store.root, "images")
    append_table(images, read_table(images, start=4, stop=5))
    return [("block-twice", ""), ("ledger", "")]


def lost_cell(store: Store) -> list[Found]:
    del store.root["cells/" + store.cell_name]
    return [("lost-cell", store.owner), ("rays-missing", "")]


def lost_tile(store: Store) -> list[Found]:
    del store.root["tiles/" + store.owner]
    return [("lost-tile", store.owner)]


def unknown_tile(store: Store) -> list[Found]:
    group_of(store.root, "tiles").create_group("r099c000")
    return [("unknown-name", "")]


def wrong_directory(store: Store) -> list[Found]:
    directory = group_of(store.root, "directory")
    rows = np.flatnonzero(read_table(directory)["cell"] == store.busiest)[:1]
    set_rows(directory, "cell", rows, np.array([store.busiest + 1]))
    return [("directory", store.owner)]


def withdrawn_image(store: Store) -> list[Found]:
    row = int(store.base.cell(store.busiest).images[0])
    set_rows(group_of(store.root, "images"), "withdrawn", np.array([row]), np.array([1]))
    return [("withdrawn-rays", store.owner), ("ledger", "")]


def withdrawn_block(store: Store) -> list[Found]:
    store.edit_text("ledger", "status", 2, lambda _: "withdrawn")
    return [("ledger", "")]


def dropped_release(store: Store) -> list[Found]:
    tile, row = sorted(store.base.flags())[0]
    set_rows(group_of(store.root, "images"), "released", np.array([row]), np.array([0]))
    name = store.base.cover.tile_name(tile)
    return [("released-flag", name), ("stale-factor", name)]


def changed_prior(store: Store) -> list[Found]:
    row = int(store.base.cell(store.busiest).images[0])

    def tighter(text: str) -> str:
        model = json.loads(text)
        return json.dumps(model | {"bias_px": 0.5 * model["bias_px"]}, sort_keys=True)

    store.edit_text("images", "a_priori", row, tighter)
    return [("stale-factor", store.owner)]


def broken_camera(store: Store) -> list[Found]:
    row = int(store.base.cell(store.busiest).images[0])
    store.edit_text("images", "camera", row, lambda text: text[:-20])
    return [("image-table", ""), ("image-table", store.owner)]


def missing_array(store: Store) -> list[Found]:
    del store.root[f"cells/{store.cell_name}/data"]
    return [("unreadable", store.owner)]


def ragged_table(store: Store) -> list[Found]:
    array_of(group_of(store.root, "images"), "seconds").resize((3,))
    return [("image-table", "")]


DAMAGES = [
    tampered_information, tampered_vector, tampered_observation, tampered_corrections, tampered_covariance, asymmetric_covariance,
    indefinite_covariance, indefinite_information, flipped_flag, stale_factor, nan_in_a_cell, nan_in_a_covariance, ids_out_of_order,
    image_out_of_range, ray_twice, misplaced_point, block_in_two_cells, ledger_line_twice, image_row_twice, lost_cell, lost_tile,
    unknown_tile, wrong_directory, withdrawn_image, withdrawn_block, dropped_release, changed_prior, broken_camera, missing_array,
    ragged_table,
]  # fmt: skip
