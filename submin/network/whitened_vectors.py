"""Names of whitened vectors that outlive versions, and the a priori factor of some images written by them.

A vector is named by what never changes: the row of its image and the place of its parameter; the first row of its pass and the name of the
parameter; the first row of its set of correlated control and the column (decision 014). Names are integers: sets of them are arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.priors import ImagePrior, prior_and_columns
from submin.errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.int32]
Names = NDArray[np.int64]

STRIDE, SET_STRIDE = 1 << 10, 1 << 20
PASS, SET = 1 << 50, 1 << 60


@dataclass(frozen=True, eq=False)
class WholeImages:
    """Images with all that their a priori errors are correlated with.

    Attributes
    ----------
    rows : (m,) rows of the network's images, ascending; priors : what is believed of each
    pass_row, block_row : (m,) first row of each image's pass and block in the network
    """

    rows: Index
    priors: tuple[ImagePrior, ...]
    pass_row: Names
    block_row: Names


@dataclass(frozen=True, eq=False)
class Vectors:
    """The whitened vectors of some images.

    Attributes
    ----------
    images : (m,) rows of the network's images, ascending
    names : (q,) of the vectors, ascending
    prior : K (m p, q), of the images by these vectors
    """

    images: Index
    names: Names
    prior: sp.csr_array

    def seen(self, rows: NDArray[np.integer]) -> tuple[NDArray[np.int64], sp.csr_array]:
        """Columns (k,) that some images (rows of the network, each held) load on, ascending, and K (len p, k) of these images by them."""
        p = self.prior.shape[0] // max(len(self.images), 1)
        at = np.searchsorted(self.images, rows)
        of_rows = self.prior[(at[:, None] * p + np.arange(p)).ravel()]
        columns = np.unique(of_rows.indices).astype(np.int64)
        return columns, of_rows[:, columns]


def vectors_of(whole: WholeImages, held: Index, parameters: int, shared_names: Sequence[str]) -> Vectors:
    """The vectors of the images ``held`` (rows, ascending, among those of ``whole``).

    ``shared_names`` are the names of all parameters that passes share, in an order that later versions only add to.

    Raises
    ------
    InputError
        When a sensor has more parameters, or a set more points, than names are made for.
    """
    prior, columns = prior_and_columns(whole.priors, parameters)
    if parameters >= STRIDE or len(shared_names) >= STRIDE or any(width >= SET_STRIDE for _, width in columns.sets):
        raise InputError(f"more than {STRIDE} parameters an image, or {SET_STRIDE} coordinates a set; reconcile is not made for that")
    rows = whole.rows.astype(np.int64)
    pass_row = {prior.pass_id: int(row) for prior, row in zip(whole.priors, whole.pass_row, strict=True)}
    block_row = {prior.block_id: int(row) for prior, row in zip(whole.priors, whole.block_row, strict=True)}
    of_name = {name: k for k, name in enumerate(shared_names)}
    names = np.concatenate([
        rows[columns.image] * STRIDE + columns.parameter,
        np.array([PASS + pass_row[pass_id] * STRIDE + of_name[name] for pass_id, name in columns.passes], dtype=np.int64),
        *(SET + block_row[block] * SET_STRIDE + np.arange(width) for block, width in columns.sets),
    ])  # fmt: skip
    at = np.searchsorted(whole.rows, held)
    of_held = prior[(at[:, None] * parameters + np.arange(parameters)).ravel()]
    used = np.unique(of_held.indices)  # a block-mate's own vectors count only where they move an image that is held
    order = used[np.argsort(names[used])]
    return Vectors(held, names[order], sp.csr_array(of_held[:, order]))


def first_rows(names: Names) -> Names:
    """For each vector (q,) the row of the image, or the first row of the pass or set, that it is named by."""
    own = np.where(names < PASS, names, np.where(names < SET, names - PASS, 0)) // STRIDE
    return np.where(names < SET, own, (names - SET) // SET_STRIDE)
