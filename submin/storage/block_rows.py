"""The rows of one block in a table of measurements, as they were read: little work for whoever reads, and little to send."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from submin.adjustment.priors import APriori
from submin.formats.columns import number_values, text_values
from submin.storage.catalogue_schema import DEFAULT_SIGMA_PX, Block, ImageRecord


@dataclass(frozen=True, eq=False)
class BlockRows:
    """The rows of one block, of which every one is known to be of an image of the block; their values are not looked at yet.

    Attributes
    ----------
    block_id, images, a_priori, source, first_row : as in `Block`
    image : (r,) index of each row's image among ``images``
    table : the r rows, with point, sample, line and sigmas
    """

    block_id: str
    images: tuple[ImageRecord, ...]
    a_priori: APriori
    image: NDArray[np.int32]
    table: pa.Table
    source: str
    first_row: int

    def block(self) -> Block:
        """The block, its measurements as arrays."""
        return Block(
            self.block_id,
            self.images,
            self.a_priori,
            text_values(self.table, "point_id"),
            self.image,
            number_values(self.table, "sample"),
            number_values(self.table, "line"),
            number_values(self.table, "sigma_sample", DEFAULT_SIGMA_PX),
            number_values(self.table, "sigma_line", DEFAULT_SIGMA_PX),
            source=self.source,
            first_row=self.first_row,
        )

    def __getstate__(self) -> dict[str, Any]:
        """Arrow would send with some rows the whole batch that they are a slice of."""
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, self.table.schema) as stream:
            stream.write_table(self.table)
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"table": sink.getvalue()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        with pa.ipc.open_stream(state["table"]) as stream:
            self.__dict__.update(state, table=stream.read_all())
