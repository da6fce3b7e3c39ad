"""Numbers of texts: what `numpy.unique` with its inverse gives, without sorting all of them."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray


def numbered(texts: NDArray[np.str_]) -> tuple[NDArray[np.str_], NDArray[np.int64]]:
    """The different ones (n,) of some texts (r,), ascending, and the place (r,) of each text among them.

    Only the different ones are sorted: rays name each point several times.
    """
    if not len(texts):
        return np.unique(texts), np.empty(0, dtype=np.int64)
    encoded = pa.array(texts, type=pa.large_string()).dictionary_encode()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.combine_chunks()
    order = pc.sort_indices(encoded.dictionary).to_numpy()  # UTF-8 sorts as code points do
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    different = encoded.dictionary.take(pa.array(order)).to_numpy(zero_copy_only=False)
    return np.asarray(different, dtype=np.str_), place[encoded.indices.to_numpy()]
