"""Reading a catalogue: names of images in memory, measurements streamed block by block, and a full scan for structural errors.

Tables are read by `submin.formats.columns`. Whatever is wrong with the structure of a catalogue (columns, types, unknown images,
order) raises `CatalogueError`; what is wrong inside one block is left to `defects`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError, InputError
from submin.formats.columns import (
    empty_table,
    number,
    required_path,
    table_path,
    table_runs,
    text,
)
from submin.network.observations import Cluster
from submin.storage.block_rows import BlockRows
from submin.storage.catalogue_schema import (
    POINT_KINDS,
    Block,
    CatalogueMetadata,
    CatalogueSummary,
    ImageRecord,
    PointTable,
    defects,
)
from submin.storage.image_rows import IMAGE_COLUMNS, ImageRows
from submin.storage.observation_table import STEM as OBSERVATIONS
from submin.storage.observation_table import read_clusters
from submin.storage.point_table import Covariances, read_point_table

T = TypeVar("T")

MEASUREMENT_COLUMNS = (
    text("block_id"), text("image_id"), text("point_id"), number("sample"), number("line"),
    number("sigma_sample", False), number("sigma_line", False),
)  # fmt: skip

_COVARIANCE_OF: dict[Literal["control", "check", "truth"], Covariances] = {"control": "definite", "check": "any", "truth": "none"}


@dataclass(frozen=True, eq=False)
class Catalogue:
    """A catalogue on disk: names of images and priors in memory, measurements and other observations read as they are needed.

    Attributes
    ----------
    path : its folder
    metadata : body, ellipsoid, frame
    images : all images, in catalogue order, made as they are asked for; none in a catalogue of other observations or of control alone
    default_prior : a priori model of blocks without an entry of their own
    priors : a priori model by block
    """

    path: Path
    metadata: CatalogueMetadata
    images: ImageRows
    default_prior: APriori
    priors: Mapping[str, APriori]

    @classmethod
    def open(cls, path: str | Path) -> Catalogue:
        """Open a catalogue and read all but its measurements and points.

        Raises
        ------
        CatalogueError
            When metadata, images or priors cannot be used: file, row, value, what was expected.
        """
        folder = Path(path)
        if folder.is_file():
            raise CatalogueError(f"{folder}: is a file; expected a catalogue (a folder with catalogue.json)")
        if not folder.is_dir():
            raise CatalogueError(f"{folder}: no such folder; expected a catalogue (a folder with catalogue.json)")
        metadata = _from_json(folder / "catalogue.json", CatalogueMetadata.from_mapping)
        images = ImageRows.none()
        if _needs_images(folder):
            images = ImageRows.read(required_path(folder, "images"))
            required_path(folder, "measurements")
        default, priors = APriori(), dict[str, APriori]()
        if (folder / "priors.json").exists():
            default, priors = _from_json(folder / "priors.json", _priors)
            unknown = sorted(set(priors) - set(images.blocks))
            if unknown:
                raise CatalogueError(f"{folder / 'priors.json'}: block {unknown[0]!r} has no image; expected blocks of the images table")
        return cls(folder, metadata, images, default, priors)

    @cached_property
    def _rows_of(self) -> dict[str, NDArray[np.int64]]:
        """Rows of the images of each block."""
        order = np.argsort(self.images.block_of, kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(self.images.block_of))[:-1]) if len(order) else []
        return dict(zip(self.images.blocks, parts, strict=True))

    @property
    def block_ids(self) -> tuple[str, ...]:
        """Blocks in the order in which the images table names them."""
        return self.images.blocks

    @property
    def block_count(self) -> int:
        """Number of blocks."""
        return len(self.images.blocks)

    def a_priori(self, block_id: str) -> APriori:
        """What is believed of the cameras of a block."""
        return self.priors.get(block_id, self.default_prior)

    def blocks(self, skip: Collection[str] = frozenset()) -> Iterator[Block]:
        """Every block but those in ``skip``, as `block_rows` has them."""
        return (rows.block() for rows in self.block_rows(skip))

    def block_rows(self, skip: Collection[str] = frozenset()) -> Iterator[BlockRows]:
        """The rows of every block but those in ``skip``, once: in the order of the measurements, and last the blocks without any.

        Memory is bounded by one block and one batch of rows.

        Raises
        ------
        CatalogueError
            When a block comes back after another one, or a measurement names an image that is not of its block.
        """
        if not self.images:
            return
        path = required_path(self.path, "measurements")
        measured = set()
        for block_id, row, table in _runs(path):
            measured.add(block_id)
            if block_id not in skip:
                yield self._rows(block_id, row, table, path)
        for block_id in self.block_ids:
            if block_id not in measured and block_id not in skip:
                yield self._rows(block_id, 1, empty_table(MEASUREMENT_COLUMNS), path)

    def block(self, block_id: str) -> Block:
        """One block; raises `CatalogueError` for an unknown one."""
        if not self.images:
            raise CatalogueError(f"{self.path}: no block {block_id!r}; the catalogue has no images")
        if block_id not in self._rows_of:
            few, more = self.block_ids[:5], self.block_count - 5
            names = "one of " * (self.block_count > 1) + ", ".join(few) + (f" and {more:,} more" if more > 0 else "")
            raise CatalogueError(f"{self.path}: no block {block_id!r}; expected {names}")
        path = required_path(self.path, "measurements")
        for found, row, table in _runs(path):
            if found == block_id:
                return self._rows(block_id, row, table, path).block()
        return self._rows(block_id, 1, empty_table(MEASUREMENT_COLUMNS), path).block()

    def points(self, kind: Literal["control", "check", "truth"]) -> PointTable | None:
        """Control points, check points or simulated truth; None when the catalogue has no such table."""
        if kind not in POINT_KINDS:
            raise CatalogueError(f"kind of points is {kind!r}; expected one of {', '.join(POINT_KINDS)}")
        path = table_path(self.path, kind)
        return None if path is None else read_point_table(path, _COVARIANCE_OF[kind])

    def observations(self) -> Iterator[Cluster]:
        """The clusters of positions and baselines, in the order of their table; none when the catalogue has no such table.

        Memory is bounded by one cluster and a few rows of another.

        Raises
        ------
        CatalogueError
            When a cluster cannot be used, or has the id of a block of images: file, row, value, what was expected.
        """
        path = table_path(self.path, OBSERVATIONS)
        return iter(()) if path is None else read_clusters(path, self.metadata.ellipsoid, frozenset(self.block_ids))

    def validate(self, *, measured: bool = True, truth: bool = True) -> CatalogueSummary:
        """Scan the whole catalogue for structural errors; with ``measured`` that it holds no measurement is one.

        Without ``truth`` the simulated truth, by far the largest of the tables of points, is left out: nothing but a comparison reads it.

        Raises
        ------
        CatalogueError
            The first one: file, row, value, what was expected.
        """
        rays = self._validate_images(measured) if self.images else 0
        for kind in _COVARIANCE_OF:
            if truth or kind != "truth":
                self.points(kind)
        sizes = [len(cluster) for cluster in self.observations()]
        return CatalogueSummary(self.block_count, len(self.images), rays, len(sizes), sum(sizes))

    def _validate_images(self, measured: bool) -> int:
        """Scan images and measurements; the number of rays."""
        path = required_path(self.path, "images")
        for row, image in enumerate(self.images, start=1):
            try:
                image.pack()
            except InputError as error:
                raise CatalogueError(f"{path}: row {row}: {error}") from None
            if image.footprint:
                read_footprint(image.footprint, f"{path}: row {row}: geometry of image {image.image_id}")
        path = required_path(self.path, "measurements")
        rays = sum(len(self._image_index(block_id, row, table, path)) for block_id, row, table in _runs(path))
        if measured and not rays:
            raise CatalogueError(f"{path}: holds no measurements; expected at least one row")
        return rays

    def _image_index(self, block_id: str, row: int, table: pa.Table, path: Path) -> NDArray[np.int32]:
        """Index of each ray's image among the images of its block; ``row`` is the number of the table's first row in its file."""
        if block_id not in self._rows_of:
            raise CatalogueError(f"{path}: row {row}: block_id is {block_id!r}; expected a block of the images table")
        index = pc.index_in(table["image_id"], value_set=self.images.ids.take(self._rows_of[block_id]))
        if index.null_count:
            k = int(np.argmax(pc.is_null(index).to_numpy()))
            image_id = table["image_id"][k].as_py()
            other = pc.index(self.images.ids, image_id).as_py()
            found = "which the images table does not have" if other < 0 else f"an image of block {self.images[other].block_id!r}"
            raise CatalogueError(f"{path}: row {row + k}: image_id is {image_id!r}, {found}; expected an image of block {block_id!r}")
        return np.asarray(index.to_numpy(), dtype=np.int32)

    def _rows(self, block_id: str, row: int, table: pa.Table, path: Path) -> BlockRows:
        image = self._image_index(block_id, row, table, path)
        images = self.images.take(self._rows_of[block_id])
        return BlockRows(block_id, images, self.a_priori(block_id), image, table.drop_columns(["block_id", "image_id"]), path.name, row)


def _needs_images(folder: Path) -> bool:
    """Whether a catalogue must have images: unless it has other observations or control, and no table that goes with images."""
    others = any(table_path(folder, stem) for stem in (OBSERVATIONS, "control"))
    return not others or any(table_path(folder, stem) for stem in ("images", "measurements"))


def read_footprint(footprint: bytes, name: str) -> BaseGeometry:
    """The polygon of a footprint that ``name`` names in errors; raises `CatalogueError` when it is not WKB."""
    try:
        return shapely.from_wkb(footprint)
    except shapely.GEOSException as error:
        raise CatalogueError(f"{name} is not WKB ({error}); expected a polygon in longitude and latitude") from None


def _runs(path: Path) -> Iterator[tuple[str, int, pa.Table]]:
    """The rows of each block of a measurements table, with the number of their first row; a block that comes back is refused."""
    return table_runs(path, MEASUREMENT_COLUMNS, "block_id", "block")


def _from_json(path: Path, parse: Callable[[Mapping[str, Any]], T]) -> T:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise InputError(f"holds {type(values).__name__}; expected a JSON object")
        return parse(values)
    except FileNotFoundError:
        raise CatalogueError(f"{path}: no such file; expected the metadata of a catalogue") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CatalogueError(f"{path}: is not JSON ({error}); expected a JSON object in UTF-8") from None
    except InputError as error:
        raise CatalogueError(f"{path}: {error}") from None


def _priors(values: Mapping[str, Any]) -> tuple[APriori, dict[str, APriori]]:
    """Default and by block of a ``priors.json``; what the entry of a block leaves out is as in the default."""
    unknown = sorted(set(values) - {"default", "blocks"})
    if unknown:
        raise CatalogueError(f"unknown key {unknown[0]!r}; expected 'default', 'blocks'")
    entries, by_block = values.get("default", {}), values.get("blocks", {})
    if not (isinstance(entries, dict) and isinstance(by_block, dict) and all(isinstance(e, dict) for e in by_block.values())):
        raise CatalogueError("'default' and every entry of 'blocks' must be JSON objects")
    default = APriori.from_mapping(entries)
    return default, {block_id: APriori.from_mapping(_over(default.to_mapping(), entry)) for block_id, entry in by_block.items()}


def _over(default: Mapping[str, Any], entry: Mapping[str, Any]) -> dict[str, Any]:
    """An entry over the default; so are its entries by parameter."""
    inner = [values.get("parameters", {}) for values in (default, entry)]
    merged = {**default, **entry}
    return merged | {"parameters": {**inner[0], **inner[1]}} if all(isinstance(values, dict) for values in inner) else merged


__all__ = [
    "IMAGE_COLUMNS", "MEASUREMENT_COLUMNS",
    "Block", "Catalogue", "CatalogueMetadata", "CatalogueSummary", "ImageRecord", "PointTable", "defects", "read_footprint",
]  # fmt: skip
