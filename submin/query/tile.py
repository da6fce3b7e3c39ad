"""Policy ``tile``: the answer of one sub-MIN alone, as the 2008 paper has it (Dolloff et al., section 6).

Where the network is reconciled, that is with all that lies outside of the tile.
"""

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
    return tile_state(source, tiles[0], images)


def tile_state(source: NetworkSource, tile: int, images: Index) -> SubMin:
    """A posteriori state of some images (ascending) that a tile sees, with what lies outside of the tile where that is known."""
    reconciled = source.with_outside([tile], images)
    return source.sub_min(tile, images) if reconciled is None else reconciled
