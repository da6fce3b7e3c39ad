"""A catalogue in several: some of its blocks each by itself, and all the others."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq


def held_back(catalogue: Path, blocks: Sequence[int], rest: Path, each: Path) -> list[Path]:
    """Write of a catalogue in Parquet the catalogue ``rest``, and one for each block that is held back.

    Measurements go through in pieces: memory does not grow with the catalogue.

    Parameters
    ----------
    catalogue : the catalogue, whose blocks are told by their ``block_id``
    blocks : places of the blocks to hold back, in the order of the catalogue
    rest : new folder for the catalogue of all other blocks
    each : new folder, in which every block gets a catalogue named by its id

    Returns
    -------
    list
        The folders of the single blocks, in the order of ``blocks``.
    """
    images = pq.read_table(catalogue / "images.parquet")
    every = images["block_id"].unique().to_pylist()
    ids = [every[block] for block in blocks]
    each.mkdir()
    _write(catalogue, images, rest, lambda column: pc.invert(pc.is_in(column, pa.array(ids))))
    folders = [each / str(block_id) for block_id in ids]
    for block_id, folder in zip(ids, folders, strict=True):
        _write(catalogue, images, folder, partial(pc.equal, block_id))
    return folders


def _write(catalogue: Path, images: pa.Table, folder: Path, belongs: Callable[[Any], Any]) -> None:
    folder.mkdir()
    for name in ("catalogue.json", "priors.json"):
        shutil.copy(catalogue / name, folder)
    pq.write_table(images.filter(belongs(images["block_id"])), folder / "images.parquet")
    with (
        pq.ParquetFile(catalogue / "measurements.parquet") as source,
        pq.ParquetWriter(folder / "measurements.parquet", source.schema_arrow) as target,
    ):
        for piece in source.iter_batches():
            rows = pa.Table.from_batches([piece]).filter(belongs(piece["block_id"]))
            if rows.num_rows:
                target.write_table(rows)
