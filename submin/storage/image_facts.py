"""What points take over from the images of a network: blocks in the order in which they came, times, licences."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from submin.query.point_metadata import ImageFacts
from submin.sensors import SURVEYS
from submin.storage.snapshot import Snapshot


def image_facts(snapshot: Snapshot) -> ImageFacts:
    """Facts of all images of a version, withdrawn ones too, which no ray names.

    A block counts as of the version in which it was last fused as a whole: withdrawing one of its images later does not make it younger.
    """
    table = snapshot.image_columns(["block_id", "sensor", "acquired", "seconds", "licence"])
    blocks, of_image = np.unique(table["block_id"], return_inverse=True)
    order = np.lexsort((blocks, _versions(snapshot, blocks)))
    times, acquired = _codes(table["seconds"], table["acquired"], np.isfinite(table["seconds"]))
    licences, licence = _codes(table["licence"], table["licence"], table["licence"] != "")
    return ImageFacts(np.isin(table["sensor"], SURVEYS), np.argsort(order)[of_image], blocks[order], acquired, times, licence, licences)


def _versions(snapshot: Snapshot, blocks: NDArray[np.str_]) -> NDArray[np.int64]:
    """Version (k,) in which each of some blocks came; 0 where the ledger does not say."""
    ledger = snapshot.ledger(["block_id", "status", "reason", "version", "kind"])
    # a line of a fused block with a reason tells of an image that has left it
    came = (ledger["status"] == "fused") & (ledger["reason"] == "") & (ledger["kind"] == "images")
    versions = np.zeros(len(blocks), dtype=np.int64)
    known = np.isin(ledger["block_id"], blocks) & came
    np.maximum.at(versions, np.searchsorted(blocks, ledger["block_id"][known]), ledger["version"][known])
    return versions


def _codes(
    values: NDArray[np.float64] | NDArray[np.str_], texts: NDArray[np.str_], known: NDArray[np.bool_]
) -> tuple[NDArray[np.str_], NDArray[np.int64]]:
    """Text of every different value, values ascending, and the place (m,) of each image's value there; -1 where it is not known."""
    _, first, place = np.unique(values[known], return_index=True, return_inverse=True)
    codes = np.full(len(values), -1, dtype=np.int64)
    codes[known] = place
    return texts[known][first], codes
