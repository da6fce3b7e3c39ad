"""What `verify` can find wrong with a network: a closed list of kinds, each with its meaning (docs/quality.md says what to do)."""

from __future__ import annotations

from dataclasses import dataclass

import icechunk

from submin.errors import SubminError

DAMAGE = (
    SubminError, icechunk.IcechunkError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, OSError, RuntimeError,
    MemoryError,
)  # fmt: skip
"""What reading and computing with damaged values may raise: findings, not failures of the check."""

KINDS = {
    "metadata": "the version, the cover or another value of the network's root is not what it must be",
    "unreadable": "an array cannot be read, or is not there",
    "unknown-name": "a cell or a tile is stored that the cover does not have",
    "not-finite": "a number is not finite",
    "damaged-cell": "rows of a cell do not fit together: ids out of order, rays or images out of range, wrong counts",
    "duplicate-ray": "a point is measured twice in one image",
    "misplaced-point": "a point is in a cell in which its registered position does not lie",
    "point-in-two-cells": "a point is in more than one cell, so that its rays count twice",
    "cell-sums": "the sums of a cell are not those of its rays",
    "stale-factor": "a sub-MIN is not the factorisation of the sums of the cells that its tile holds",
    "not-positive-definite": "an information matrix or a covariance is not positive definite",
    "not-symmetric": "the two triangles of a covariance differ",
    "round-off": "a sub-MIN differs from its replay by more than round-off may",
    "stale-state": "what was reconciled is not what follows from the cells of its version",
    "lost-cell": "a sub-MIN counts a cell that is not there",
    "lost-tile": "cells are there that a tile holds, and the tile has no sub-MIN",
    "directory": "the directory of points says another cell than the one in which a point is",
    "image-table": "a row of the image table cannot be used",
    "ledger": "the ledger and the image table contradict each other",
    "block-twice": "a block, an image or rays of it count twice",
    "rays-missing": "fewer rays are in the cells than the ledger has for the block",
    "withdrawn-rays": "rays are in the cells of an image that was withdrawn, or of a block that is not in the network",
    "released-flag": "the flags of bad cameras are not those of the image table",
}
"""Kind of problem and what it means."""


@dataclass(frozen=True)
class Problem:
    """Something that is wrong.

    Attributes
    ----------
    tile : name of the tile concerned; empty for the network as a whole
    kind : one of `KINDS`
    detail : what was found, and what was expected
    """

    tile: str
    kind: str
    detail: str

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind is {self.kind!r}; expected one of {', '.join(KINDS)}")


def some(names: list[str], most: int = 3) -> str:
    """A few names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def first_line(error: BaseException) -> str:
    """What an error says, in a line."""
    said = " ".join(str(error).split()) or "no more is said"
    return f"{said[:200]} ({type(error).__name__})"
