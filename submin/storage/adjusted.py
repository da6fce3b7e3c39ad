"""What an adjustment leaves on disk: a folder with cameras, their joint covariance, points, and a report (docs/stage-1.md has the layout).

A folder appears when all of it is written. Every file says that its content is derived: it may be used, also to control images, but
never be entered into a network, which has or will have the rays behind it (Rule 0 of docs/mathematics.md).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from uuid import uuid4

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.errors import InputError
from submin.formats import tables
from submin.query.control_set import ControlSet
from submin.sensors import sensor_named
from submin.storage.point_table import RULE_0

Array = NDArray[np.float64]

NO_COVARIANCE = (
    "adjusted with virtual control, which is a regularisation: coordinates and cameras may be used, and no accuracy is stated, because "
    "a covariance of these equations would be too small"
)

_CAMERA_COLUMNS = (
    ("image_id", pa.string()), ("block_id", pa.string()), ("sensor", pa.string()), ("parameter", pa.string()), ("unit", pa.string()),
    ("correction", pa.float64()), ("released", pa.bool_()), ("rays", pa.int64()),
)  # fmt: skip
_COVARIANCE_COLUMNS = (("sigma", pa.float64()), ("covariance_file", pa.string()), ("covariance_row", pa.int64()))
_POINT_COLUMNS = ("point_id", "x", "y", "z", "longitude", "latitude", "height", "rays")


@dataclass(frozen=True)
class AdjustedCameras:
    """Images that were adjusted together.

    Attributes
    ----------
    images : the m images; theta : (m, p) their corrections
    covariance : (m p, m p), joint, or None where no accuracy is stated
    released : (m,) images whose a priori model was given up; rays : (m,) accepted rays
    """

    images: ImageSet
    theta: Array
    covariance: Array | None
    released: NDArray[np.bool_]
    rays: NDArray[np.int64]


class AdjustedWriter:
    """Context manager that writes a folder of adjusted cameras and points; nothing is left when its body raises.

    Parameters
    ----------
    path : the folder, new or empty
    accuracy : False leaves everything out that states accuracy
    metadata : texts that go into every Parquet file beside `RULE_0`

    Raises
    ------
    InputError
        When something is in the folder already, or it cannot be written.
    """

    def __init__(self, path: str | Path, accuracy: bool, metadata: Mapping[str, str]) -> None:
        self.path, self.accuracy = Path(path), accuracy
        self.metadata = {"use": RULE_0, **metadata} | ({} if accuracy else {"accuracy": NO_COVARIANCE})
        refuse_occupied(self.path)
        self._place = self.path.resolve()
        self._folder = self._place.with_name(f".{self._place.name}.{uuid4().hex}")
        self._made: list[Path] = []
        self._groups = 0
        self._cameras: pq.ParquetWriter | None = None

    def __enter__(self) -> Self:
        try:
            self._make_parents()
            self._folder.mkdir()
            schema = pa.schema([*_CAMERA_COLUMNS, *(_COVARIANCE_COLUMNS if self.accuracy else ())]).with_metadata(self.metadata)
            self._cameras = pq.ParquetWriter(self._folder / "cameras.parquet", schema, compression="zstd")
            if self.accuracy:
                (self._folder / "covariance").mkdir()
        except OSError as cause:
            self._remove()
            raise self._unwritable(cause) from cause
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if self._cameras is not None:
                self._cameras.close()
            if kind is None:
                refuse_occupied(self.path)
                if self._place.exists():
                    self._place.rmdir()
                self._folder.rename(self._place)
            elif isinstance(error, OSError):
                raise self._unwritable(error) from error
        except OSError as cause:
            raise self._unwritable(cause) from cause
        finally:
            self._remove()

    def _make_parents(self) -> None:
        """Make the folders above the result's, and remember which of them there were not."""
        for folder in reversed([folder for folder in self._place.parents if not folder.exists()]):
            folder.mkdir(exist_ok=True)
            self._made.append(folder)

    def _remove(self) -> None:
        """Remove what is not the result: after a failure also the folders above it that were made; those with something in them stay."""
        shutil.rmtree(self._folder, ignore_errors=True)
        for folder in reversed(self._made):
            try:
                folder.rmdir()
            except OSError:
                return

    def write_cameras(self, cameras: AdjustedCameras) -> None:
        """Append images that were adjusted together: a row for each adjustable parameter, and one file with their joint covariance."""
        assert self._cameras is not None
        images, p = cameras.images, cameras.images.parameters
        adjustable = np.flatnonzero(images.prior_variance.ravel() > 0.0)
        image = adjustable // p
        parameters = [sensor_named(images.sensors[i]).parameters[k % p] for i, k in zip(image, adjustable, strict=True)]
        ids = np.array(images.ids, dtype=np.str_)[image]
        names, units = [parameter.name for parameter in parameters], [parameter.unit for parameter in parameters]
        columns: dict[str, Any] = {
            "image_id": ids, "block_id": [images.priors[i].block_id for i in image], "sensor": [images.sensors[i] for i in image],
            "parameter": names, "unit": units, "correction": cameras.theta.ravel()[adjustable],
            "released": cameras.released[image], "rays": cameras.rays[image],
        }  # fmt: skip
        if self.accuracy:
            assert cameras.covariance is not None
            self._groups += 1
            name = f"covariance/{self._groups:06d}.npz"
            covariance = cameras.covariance[np.ix_(adjustable, adjustable)]
            with (self._folder / name).open("wb") as file:
                np.savez(
                    file, image_id=ids, parameter=np.array(names, dtype=np.str_), unit=np.array(units, dtype=np.str_),
                    covariance=covariance, use=np.array(self.metadata["use"]),
                )  # fmt: skip
            columns |= {
                "sigma": np.sqrt(np.diagonal(covariance)), "covariance_file": [name] * len(ids), "covariance_row": np.arange(len(ids)),
            }  # fmt: skip
        self._cameras.write_table(pa.table(columns, schema=self._cameras.schema))

    def write_points(self, points: ControlSet) -> None:
        """Write ``points.parquet``: in the layout of a query's answer, without its covariances where no accuracy is stated."""
        target = self._folder / "points.parquet"
        if self.accuracy:
            table = points.table()
            tables.write_parquet(target, tables.ControlTable(table.columns, table.covariance, {**table.metadata, **self.metadata}))
            return
        values = [points.ids, *points.geocentric.T, *points.geodetic.T, points.rays]
        columns = dict(zip(_POINT_COLUMNS, values, strict=True))
        pq.write_table(pa.table(columns).replace_schema_metadata(self.metadata), target, compression="zstd")

    def write_report(self, values: Mapping[str, Any]) -> None:
        """Write ``report.json``."""
        text = json.dumps({**self.metadata, **values}, indent=1, ensure_ascii=False)
        (self._folder / "report.json").write_text(text + "\n", encoding="utf-8")

    def _unwritable(self, cause: OSError) -> InputError:
        return InputError(
            f"{self.path}: cannot be written ({cause.strerror or cause}); make room there, mend the permissions, or choose another place"
        )


def refuse_occupied(path: Path) -> None:
    """Refuse a folder that holds something, or a file in its place.

    Raises
    ------
    InputError
        See above.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; expected a folder for the result")
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: is not empty; expected a new folder: give another one, or remove it first")
