"""Writing a catalogue: into a folder beside the one that is meant, which takes its name when all is written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Literal, Self
from uuid import uuid4

import pyarrow as pa
import pyarrow.parquet as pq

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError
from submin.formats.columns import Column
from submin.network.observations import Cluster
from submin.storage.catalogue import IMAGE_COLUMNS, MEASUREMENT_COLUMNS
from submin.storage.catalogue_schema import POINT_KINDS, Block, CatalogueMetadata, ImageRecord, PointTable
from submin.storage.observation_table import OBSERVATION_COLUMNS, cluster_tables
from submin.storage.observation_table import STEM as OBSERVATIONS
from submin.storage.point_table import point_columns

GROUP_ROWS = 1 << 17
"""Measurements in a row group of the Parquet file: a few MB, so that a reader needs little memory and few groups hold one block."""
_IMAGES_AT_ONCE = 1 << 12
_GROUP_VALUES = 1 << 20
"""Values of covariances after which a row group of observations is written: 8 MiB."""


def _schema(columns: Iterable[Column]) -> pa.Schema:
    return pa.schema([(c.name, c.type) for c in columns])


def _geoparquet(body: str) -> dict[str, str]:
    """Metadata by which GeoParquet 1.1 readers find the footprints; without ``crs`` they are longitude and latitude on WGS84."""
    column = {"encoding": "WKB", "geometry_types": []} | ({} if body == "earth" else {"crs": None})
    return {"geo": json.dumps({"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}})}


class CatalogueWriter:
    """Context manager that writes a catalogue; nothing is left when its body raises.

    Parameters
    ----------
    path : folder of the catalogue; may exist if it is empty
    metadata : what holds for all of it
    overwrite : take the place of a catalogue that is there (and of nothing else)

    Raises
    ------
    CatalogueError
        When the folder holds something already, or cannot be written (a full disk, no permission).
    """

    def __init__(self, path: str | Path, metadata: CatalogueMetadata, overwrite: bool = False) -> None:
        self.path = Path(path)
        self.metadata = metadata
        self.overwrite = overwrite
        self._refuse_occupied()
        self._place = self.path.resolve()
        self._folder = self._place.with_name(f".{self._place.name}.{uuid4().hex}")
        self._written: set[str] = set()
        self._pending: list[pa.Table] = []
        self._pending_rows = 0
        self._clusters: set[str] = set()
        self._observations: pq.ParquetWriter | None = None
        self._waiting: list[pa.Table] = []
        self._without_images = True
        self._others = False
        self._images: pq.ParquetWriter | None = None
        self._points: dict[str, pq.ParquetWriter] = {}
        self._measurements: pq.ParquetWriter | None = None

    def __enter__(self) -> Self:
        try:
            self._place.parent.mkdir(parents=True, exist_ok=True)
            self._folder.mkdir()
            images = _schema(IMAGE_COLUMNS).with_metadata(_geoparquet(self.metadata.body))
            self._images = pq.ParquetWriter(self._folder / "images.parquet", images, compression="zstd")
            self._measurements = pq.ParquetWriter(self._folder / "measurements.parquet", _schema(MEASUREMENT_COLUMNS), compression="zstd")
            self._json("catalogue.json", self.metadata.to_mapping())
        except OSError as cause:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise self._unwritable(cause) from cause
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            images, measurements = self._open()
            if kind is None:
                self._flush()
                self._flush_observations()
            for writer in (images, measurements, self._observations, *self._points.values()):
                if writer is not None:
                    writer.close()
            if kind is None:
                if self._without_images and self._others:
                    for name in ("images", "measurements"):
                        (self._folder / f"{name}.parquet").unlink()
                self._take_place()
            elif isinstance(error, OSError):
                raise self._unwritable(error) from error
        except OSError as cause:
            raise self._unwritable(cause) from cause
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def write_images(self, images: Iterable[ImageRecord]) -> None:
        """Append images; their order is the catalogue's."""
        writer, remaining = self._open()[0], iter(images)
        while chunk := list(islice(remaining, _IMAGES_AT_ONCE)):
            self._without_images = False
            names = [c.name for c in IMAGE_COLUMNS]
            columns: dict[str, Sequence[object]] = {
                name: [image.footprint or None for image in chunk] if name == "geometry" else [getattr(image, name) for image in chunk]
                for name in names
            }
            writer.write_table(pa.table(columns, schema=writer.schema))

    def write_block(self, block: Block) -> None:
        """Append the measurements of a block. Its images are not written: `write_images` does that.

        Raises
        ------
        CatalogueError
            When the block was written before: a block stands in one place.
        """
        self._open()
        if block.block_id in self._written:
            raise CatalogueError(f"{self.path}: block {block.block_id!r} is written twice; expected all its rays at once")
        self._written.add(block.block_id)
        self._without_images = False
        image_ids = pa.array([image.image_id for image in block.images], pa.string())
        columns = [
            pa.repeat(pa.scalar(block.block_id, pa.string()), len(block)), image_ids.take(pa.array(block.image)),
            pa.array(block.point_ids, pa.string()), block.sample, block.line, block.sigma_sample, block.sigma_line,
        ]  # fmt: skip
        self._pending.append(pa.table(columns, schema=_schema(MEASUREMENT_COLUMNS)))
        self._pending_rows += len(block)
        if self._pending_rows >= GROUP_ROWS:
            self._flush()

    def write_observations(self, cluster: Cluster) -> None:
        """Append a cluster of positions and baselines; a catalogue that gets no images then has no tables of images and measurements.

        Raises
        ------
        CatalogueError
            When the cluster was written before: a cluster stands in one place.
        """
        self._open()
        if cluster.cluster_id in self._clusters:
            raise CatalogueError(f"{self.path}: cluster {cluster.cluster_id!r} is written twice; expected all its observations at once")
        self._clusters.add(cluster.cluster_id)
        self._others = True
        for part in cluster_tables(cluster):
            self._waiting.append(part)
            if sum(len(table["covariance_row"].combine_chunks().flatten()) for table in self._waiting) >= _GROUP_VALUES:
                self._flush_observations()

    def write_priors(self, default: APriori, by_block: Mapping[str, APriori] | None = None) -> None:
        """Write ``priors.json``: the a priori model of all blocks, and of those that have their own."""
        self._open()
        blocks = {block_id: a_priori.to_mapping() for block_id, a_priori in (by_block or {}).items()}
        self._json("priors.json", {"default": default.to_mapping(), "blocks": blocks})

    def write_points(self, kind: Literal["control", "check", "truth"], points: PointTable, suffix: str = "") -> None:
        """Append control points, check points or simulated truth (of which only the coordinates).

        A table with a ``suffix`` (``control-SUFFIX``) lies beside the catalogue's own one: no run takes it by itself.
        """
        self._open()
        if kind not in POINT_KINDS:
            raise CatalogueError(f"kind of points is {kind!r}; expected one of {', '.join(POINT_KINDS)}")
        self._others |= kind == "control" and not suffix
        table, stem = point_columns(points, kind != "truth"), f"{kind}{suffix and '-' + suffix}"
        if stem not in self._points:
            self._points[stem] = pq.ParquetWriter(self._folder / f"{stem}.parquet", table.schema, compression="zstd")
        self._points[stem].write_table(table)

    def _unwritable(self, cause: OSError) -> CatalogueError:
        return CatalogueError(
            f"{self.path}: cannot be written ({cause.strerror or cause}); make room there, mend the permissions, or choose another place"
        )

    def _open(self) -> tuple[pq.ParquetWriter, pq.ParquetWriter]:
        if self._images is None or self._measurements is None:
            raise CatalogueError(f"{self.path}: the writer is not open; use it in a 'with' statement")
        return self._images, self._measurements

    def _json(self, name: str, values: Mapping[str, object]) -> None:
        (self._folder / name).write_text(json.dumps(values, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

    def _flush(self) -> None:
        if self._pending:
            self._open()[1].write_table(pa.concat_tables(self._pending), row_group_size=2 * GROUP_ROWS)
        self._pending, self._pending_rows = [], 0

    def _flush_observations(self) -> None:
        if not self._waiting:
            return
        if self._observations is None:
            schema = _schema(OBSERVATION_COLUMNS)
            self._observations = pq.ParquetWriter(
                self._folder / f"{OBSERVATIONS}.parquet", schema, compression="zstd", use_dictionary=["cluster", "kind"]
            )
        self._observations.write_table(pa.concat_tables(self._waiting))
        self._waiting = []

    def _refuse_occupied(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise CatalogueError(f"{self.path}: is a file; expected a folder for the catalogue")
        if not self.path.is_dir() or not any(self.path.iterdir()):
            return
        if not self.overwrite:
            raise CatalogueError(f"{self.path}: is not empty; expected a new folder: give another one, or remove it first")
        if not (self.path / "catalogue.json").is_file():
            raise CatalogueError(f"{self.path}: holds other things than a catalogue; only a catalogue is written over")

    def _take_place(self) -> None:
        self._refuse_occupied()
        if not self._place.exists():
            self._folder.rename(self._place)
            return
        former = self._folder.with_name(self._folder.name + ".former")
        self._place.rename(former)
        self._folder.rename(self._place)
        shutil.rmtree(former, ignore_errors=True)
