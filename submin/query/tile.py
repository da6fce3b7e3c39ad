"""Policy ``tile``: the answer of one sub-MIN alone, as the 2008 paper has it (Dolloff et al., section 6)."""

from __future__ import annotations

from collections.abc import Sequence

from submin.errors import QueryError
from submin.network.sub_min import GroundPart, SubMin
from submin.query.source import Index, NetworkSource


def estimate(source: NetworkSource, tiles: Sequence[int], images: Index, parts: Sequence[GroundPart]) -> SubMin:
    """A posteriori state of ``images`` from the one tile given.

    Raises
    ------
    QueryError
        When there is more than one tile.
    """
    if len(tiles) != 1:
        raise QueryError(f"policy 'tile' answers from one tile; {len(tiles)} are asked for: use 'rigorous', 'ci' or 'auto'")
    return source.sub_min(tiles[0], images)
