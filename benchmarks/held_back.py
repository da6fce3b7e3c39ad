"""A catalogue in two: all blocks but one, and that one."""

from __future__ import annotations

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq


def held_back(catalogue: Path, block: int, rest: Path, one: Path) -> str:
    """Write the catalogues ``rest`` and ``one`` of a catalogue in Parquet; the id of the block (its place among all) that is held back.

    Measurements go through in pieces: memory does not grow with the catalogue.
    """
    images = pq.read_table(catalogue / "images.parquet")
    block_id = images["block_id"].unique()[block].as_py()
    for folder, belongs in ((rest, pc.not_equal), (one, pc.equal)):
        folder.mkdir()
        for name in ("catalogue.json", "priors.json"):
            shutil.copy(catalogue / name, folder)
        pq.write_table(images.filter(belongs(images["block_id"], block_id)), folder / "images.parquet")
        with (
            pq.ParquetFile(catalogue / "measurements.parquet") as source,
            pq.ParquetWriter(folder / "measurements.parquet", source.schema_arrow) as target,
        ):
            for piece in source.iter_batches():
                rows = pa.Table.from_batches([piece]).filter(belongs(piece["block_id"], block_id))
                if rows.num_rows:
                    target.write_table(rows)
    return str(block_id)
