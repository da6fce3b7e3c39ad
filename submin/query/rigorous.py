"""Policy ``rigorous``: each cell of the tiles concerned once, and the a priori model of their images once.

For all tiles this is the monolithic network (docs/mathematics.md, "Cells": rigorous merge). Where the network is reconciled, what lies
outside of the tiles comes in too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from submin.network.sub_min import GroundPart, SubMin, add_sums, factor
from submin.query.source import Index, NetworkSource, existing_cells


def estimate(source: NetworkSource, tiles: Sequence[int], images: Index, parts: Sequence[GroundPart]) -> SubMin:
    """A posteriori state of all images that the tiles see, from their distinct cells, each once; of ``images`` from the whole network."""
    reconciled = source.with_outside(tiles, images)
    return source.kept(("rigorous", tuple(tiles)), lambda: _merged(source, tiles)) if reconciled is None else reconciled


def _merged(source: NetworkSource, tiles: Sequence[int]) -> SubMin:
    sums = source.some_sums(existing_cells(source, tiles))
    rows = np.unique(np.concatenate([of_cell for of_cell, _ in sums])).astype(np.int32)
    image_set = source.image_set(rows)
    return factor(add_sums(sums, rows, image_set.parameters), rows, image_set)
