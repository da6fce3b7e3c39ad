"""What the rays of a network sum to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields

import numpy as np
import zarr

from submin.storage.arrays import group_of, member_names, read_attributes


@dataclass(frozen=True)
class RayTotals:
    """Rays of cells, the accepted ones, those of these that are measured in pixels, and the sum of their squared residuals, px2."""

    rays: int
    accepted: int
    pixel_rays: int
    square_px: float

    def changed(self, before: RayTotals, after: RayTotals) -> RayTotals:
        """Totals in which what some cells summed to is exchanged for what they sum to now."""
        return RayTotals(*(t - b + a for t, b, a in zip(astuple(self), astuple(before), astuple(after), strict=True)))

    @property
    def rms_px(self) -> float:
        """Residual of the accepted rays that are measured in pixels, RMS of one coordinate; 0 without any."""
        return float(np.sqrt(max(self.square_px, 0.0) / (2.0 * self.pixel_rays))) if self.pixel_rays else 0.0


def summed_cells(root: zarr.Group, names: Iterable[str] | None = None) -> RayTotals:
    """What the rays of some cells (names) that are there sum to, or of all; ``root`` may be of a version that is being written."""
    group = group_of(root, "cells")
    cells = [cell for cell in read_attributes(group, member_names(group) if names is None else names) if cell is not None]
    return RayTotals(*(sum(cell[field.name] for cell in cells) for field in fields(RayTotals)))
