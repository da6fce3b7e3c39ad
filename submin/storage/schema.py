"""What a network's store holds, and cells and sub-MINs as records of it (docs/decisions/002-store-layout.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.priors import JointRows
from submin.adjustment.rays import Rays
from submin.adjustment.symmetric import fill_symmetric, packed, unpacked
from submin.errors import StoreError
from submin.geodesy import Ellipsoid
from submin.network.cell import Cell, widened
from submin.network.network_image import JointPlace, NetworkImage
from submin.network.sub_min import SubMin, wider
from submin.storage.arrays import PLAIN, WRITTEN_WHOLE, Record, attributes_of, group_of, read_matrix, read_record, write_record
from submin.storage.catalogue_schema import ImageRecord

FORMAT_VERSION = 7
COVARIANCE_CHUNK = 256

IMAGE_COLUMNS = {
    "image_id": "text", "block_id": "text", "pass_id": "text", "platform": "text", "sensor": "text", "camera": "text",
    "width": "int64", "height": "int64", "acquired": "text", "seconds": "float64", "footprint": "text", "licence": "text",
    "a_priori": "text", "released": "uint8", "withdrawn": "uint8",
}  # fmt: skip
IMAGE_CHUNK = 1 << 12
"""Rows of a chunk of the image table: every task reads the few that its tile sees."""
IMAGE_LETTERS = 1 << 18
"""Bytes of a chunk of its texts: some hundred cameras."""
LEDGER_COLUMNS = {
    "block_id": "text", "content": "text", "status": "text", "reason": "text", "version": "int64",
    "images": "int64", "rays": "int64", "rays_rejected": "int64",
    "d2": "float64", "dof": "int64", "probability": "float64", "left_out": "int64", "against": "int64", "kind": "text",
}  # fmt: skip
JOINT = "joint"
"""Group of the factors of correlated control, a record by content (`JointPlace.record`); views that were withdrawn keep theirs."""
JOINT_CHUNK = 256
CELL_PARTS = ("point_ids", "ray_point", "ray_image", "accepted", "images", "origin", "linearised_at", "theta", "observed", "sigma")
"""What a cell's record holds, but for its sums."""
SUMS_PARTS = ("images", "vector", "information")
FLAG_COLUMNS = {"tile": "int64", "image": "int64"}
"""Which tile finds the camera of which image bad; the prior of an image is released while any tile says so."""
DIRECTORY_COLUMNS = {"hash": "uint64", "cell": "int64"}
CHANGE_COLUMNS = {"tile": "int64", "changed": "int64", "lost": "int64", "stale": "int64"}
"""Versions in which a tile's own cells last changed, last lost something that they had counted, and in which its own reconciled state
last came to count something twice (decision 014)."""


@dataclass(frozen=True)
class NetworkMetadata:
    """What is fixed when a network is created, and its cover, which later versions may refine.

    Attributes
    ----------
    name, body, frame, epoch : texts; heights are ellipsoidal
    semimajor_axis, flattening : ellipsoid (metres)
    cover : description of the cover, see `Cover.to_mapping`
    form : ``factored`` or ``dense`` (decision 011)
    parameters : adjustable parameters kept for each image; later versions may keep more, when a sensor comes that has them
    max_parameters : a tile that would hold more image parameters is split, where its overlap lets it
    format_version : of the store
    thinning : side in metres of the squares of which one point each is reported; 0 reports every point (decision 013)
    """

    name: str
    body: str
    frame: str
    epoch: str
    semimajor_axis: float
    flattening: float
    cover: dict[str, Any]
    form: str = "factored"
    parameters: int = 6
    max_parameters: int = 2500
    format_version: int = FORMAT_VERSION
    thinning: float = 0.0

    @property
    def ellipsoid(self) -> Ellipsoid:
        """Ellipsoid of the body."""
        return Ellipsoid(self.semimajor_axis, self.flattening)

    def to_attributes(self) -> dict[str, Any]:
        """Attributes of the store's root."""
        return {"submin": asdict(self)}

    @classmethod
    def from_attributes(cls, attributes: Any, place: str) -> NetworkMetadata:
        """Metadata of a store's root; raises `StoreError` for something else or another format version."""
        values = attributes.get("submin")
        if not isinstance(values, dict):
            raise StoreError(f"{place}: not a network (its root has no 'submin' attributes); make one with 'submin create'")
        if values.get("format_version") != FORMAT_VERSION:
            raise StoreError(
                f"{place}: format version {values.get('format_version')}; this program reads {FORMAT_VERSION}: "
                "open it with the release that wrote it"
            )
        return cls(**values)


def write_cell(root: zarr.Group, name: str, cell: Cell, square_px: float, pixel_rays: int) -> None:
    """Write a cell, replacing its earlier state.

    ``square_px`` is the sum of the squared residuals, pixels squared, of its ``pixel_rays`` accepted rays that are measured in pixels.
    """
    rays, sums = cell.rays, cell.sums
    write_record(
        group_of(root, "cells"), name,
        {
            "point_ids": cell.point_ids, "ray_point": rays.point, "ray_image": rays.image, "accepted": rays.accepted,
            "origin": cell.origin, "linearised_at": cell.linearised_at, "theta": cell.theta, "observed": rays.observed, "sigma": rays.sigma,
            "images": cell.images, "vector": sums.vector, "information": packed(sums.information),
        },
        {"number": cell.number, "misclosure": sums.misclosure, "redundancy": sums.redundancy,
         "points": len(cell.point_ids), "determined": int(determined(cell).sum()), "rays": len(rays), "accepted": int(rays.accepted.sum()),
         "square_px": square_px, "pixel_rays": pixel_rays},
    )  # fmt: skip


def determined(cell: Cell) -> NDArray[np.bool_]:
    """Points (n,) with at least two accepted rays."""
    return np.bincount(cell.rays.point[cell.rays.accepted], minlength=len(cell.point_ids)) >= 2


def read_cell(group: zarr.Group, parameters: int, *, with_sums: bool = True) -> Cell:
    """The cell of a record, with so many parameters an image; without sums (left empty) the large part is not read."""
    return cell_of(Record(attributes_of(group), read_record(group, None if with_sums else CELL_PARTS)), parameters, with_sums=with_sums)


def cell_of(record: Record, parameters: int, *, with_sums: bool) -> Cell:
    """The cell of a record as it was read, with so many parameters an image; without sums these are left empty."""
    parts = record.parts
    rays = Rays(
        parts["ray_point"].astype(np.int32), parts["ray_image"].astype(np.int32), parts["observed"], parts["sigma"],
        parts["accepted"].astype(np.bool_),
    )  # fmt: skip
    sums = sums_of(record) if with_sums else Sums(np.empty((0, 0)), np.empty(0), 0.0, 0)
    cell = Cell(
        int(record.attributes["number"]), parts["point_ids"], parts["origin"], parts["linearised_at"],
        parts["images"].astype(np.int32), parts["theta"], rays, sums,
    )  # fmt: skip
    return widened(cell, parameters)


def sums_of(record: Record) -> Sums:
    """Sums among the parts of a cell's record."""
    parts, attributes = record.parts, record.attributes
    return Sums(unpacked(parts["information"]), parts["vector"], float(attributes["misclosure"]), int(attributes["redundancy"]))


def write_sub_min(root: zarr.Group, name: str, sub_min: SubMin, cells: Sequence[int]) -> None:
    """Write a tile's sub-MIN, replacing its earlier state; of the covariance only blocks on and below the diagonal."""
    group = write_record(
        group_of(root, "tiles"), name,
        {"images": sub_min.images, "cells": np.array(cells, dtype=np.int64), "theta": sub_min.theta},
        {"chi_square": sub_min.chi_square, "redundancy": sub_min.redundancy},
    )  # fmt: skip
    write_symmetric(group, "covariance", sub_min.covariance)


def write_symmetric(group: zarr.Group, name: str, matrix: NDArray[np.float64]) -> None:
    """Write a symmetric matrix as an array of square chunks, of which only those on and below the diagonal are written."""
    size = len(matrix)
    chunk = min(COVARIANCE_CHUNK, max(size, 1))
    array = group.create_array(name, shape=(size, size), chunks=(chunk, chunk), dtype="float64", compressors=PLAIN, config=WRITTEN_WHOLE)
    for start in range(0, size, chunk):
        array[start : start + chunk, : start + chunk] = matrix[start : start + chunk, : start + chunk]


def read_symmetric(group: zarr.Group, name: str, rows: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
    """A matrix of `write_symmetric`, both triangles: all of it, or some rows (ascending) and the same columns."""
    lower = read_matrix(group, name) if rows is None else read_matrix(group, name, rows, rows)
    return fill_symmetric(np.ascontiguousarray(lower))


def read_sub_min(group: zarr.Group, parameters: int, images: NDArray[np.int32] | None = None) -> SubMin:
    """A tile's sub-MIN, with so many parameters an image.

    With ``images`` (rows of the network, ascending) its marginal on those of them that it holds.
    """
    parts = read_record(group, ["images", "theta"])
    held, theta = parts["images"].astype(np.int32), parts["theta"]
    chosen = np.arange(len(held)) if images is None else np.flatnonzero(np.isin(held, images))
    p = theta.shape[1]
    rows = (chosen[:, None] * p + np.arange(p)).ravel()
    attributes = attributes_of(group)
    sub_min = SubMin(
        held[chosen], theta[chosen], read_symmetric(group, "covariance", rows),
        float(attributes["chi_square"]), int(attributes["redundancy"]),
    )  # fmt: skip
    return wider(sub_min, parameters)


def image_columns(images: Sequence[NetworkImage], records: Sequence[ImageRecord]) -> dict[str, NDArray[Any]]:
    """Columns of the image table for new images and their catalogue records."""
    texts = {
        **{name: [getattr(i, name) for i in images] for name in ("image_id", "block_id", "pass_id", "sensor", "camera", "a_priori")},
        **{name: [getattr(r, name) for r in records] for name in ("platform", "acquired", "licence")},
        "footprint": [r.footprint.hex() for r in records],
    }
    none = np.zeros(len(images), dtype=np.uint8)
    return {
        **{name: np.array(values, dtype=np.str_) for name, values in texts.items()},
        "width": np.array([i.width for i in images], dtype=np.int64), "height": np.array([i.height for i in images], dtype=np.int64),
        "seconds": np.array([i.seconds for i in images], dtype=np.float64), "released": none, "withdrawn": none,
    }  # fmt: skip


def network_images(columns: dict[str, NDArray[Any]]) -> list[NetworkImage]:
    """Images from columns of the image table."""
    names = ("image_id", "block_id", "pass_id", "sensor", "camera", "width", "height", "seconds", "a_priori", "released")
    return [
        NetworkImage(str(i), str(b), str(p), str(s), str(c), int(w), int(h), float(t), str(a), bool(r))
        for i, b, p, s, c, w, h, t, a, r in zip(*(columns[name] for name in names), strict=True)
    ]


def write_joint(root: zarr.Group, images: Sequence[NetworkImage]) -> None:
    """Write the factors of the sets of correlated control among some new images, all views of a set together."""
    parts: dict[str, list[NDArray[np.float64]]] = {}
    for image in images:
        place = JointPlace.from_text(image.a_priori)
        if place is not None and image.joint is not None:
            parts.setdefault(place.record, []).append(image.joint.rows)
    for record, rows in parts.items():
        factor = np.concatenate(rows)
        chunks = tuple(min(JOINT_CHUNK, length) for length in factor.shape)
        root.require_group(JOINT).create_group(record, overwrite=True).create_array(
            "factor", data=factor, chunks=chunks, compressors=PLAIN, config=WRITTEN_WHOLE
        )


def with_joint(root: zarr.Group, images: Sequence[NetworkImage]) -> list[NetworkImage]:
    """Images with the rows of the factors that those of correlated control have in the store."""
    places = [JointPlace.from_text(image.a_priori) for image in images]
    factors = {}
    for record in {place.record for place in places if place is not None}:
        wanted = [place for place in places if place is not None and place.record == record]
        first, stop = min(place.first for place in wanted), max(place.first + place.rows for place in wanted)
        factors[record] = first, read_matrix(group_of(root, f"{JOINT}/{record}"), "factor", slice(first, stop))
    return [
        image if place is None else replace(image, joint=_rows_of(place, *factors[place.record]))
        for image, place in zip(images, places, strict=True)
    ]


def _rows_of(place: JointPlace, first: int, factor: NDArray[np.float64]) -> JointRows:
    return JointRows(factor[place.first - first : place.first - first + place.rows], place.part)
