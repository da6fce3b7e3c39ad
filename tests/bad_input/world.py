"""Where a case of bad input makes what is wrong, what the page says of it, and the list of all cases."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import shapely
from gnss_files import dna_lines
from isis_files import isd
from isis_files import write as write_isis
from sinex_files import sinex_lines, station_parameters

import submin
from orchestration.control import add_control
from orchestration.create import create
from orchestration.executors import SerialExecutor
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import CatalogueMetadata
from submin.storage.point_table import read_point_table
from submin.storage.repository import tag_version

ROOT = Path(__file__).parents[2]
BOX = ["--bbox", 99, 34, 101, 36]
POINT = {"point_id": ["P00000"], "longitude": [100.0], "latitude": [35.0], "height": [900.0]}
SIGMAS = {"sigma_e": [1.0], "sigma_n": [1.0], "sigma_u": [1.0]}


@dataclass(frozen=True)
class Row:
    """A row of the documentation: what is wrong, and what the program says."""

    case: str
    code: int
    message: str

    def says(self, message: str) -> bool:
        return re.fullmatch(".+".join(re.escape(part) for part in self.message.split("…")), message) is not None


def documented() -> dict[str, Row]:
    """Rows of all tables of the page, by case."""
    rows: dict[str, Row] = {}
    for line in (ROOT / "docs" / "bad-input.md").read_text(encoding="utf-8").splitlines():
        found = re.fullmatch(r"\| (.+) \| ([12]) \| `(.+)` \|", line)
        if found:
            assert found[1] not in rows, f"{found[1]} is there twice"
            rows[found[1]] = Row(found[1], int(found[2]), found[3])
    return rows


ROWS = documented()


@dataclass
class World:
    """A folder with a catalogue, a network and whatever a case makes; kept apart from those of other cases."""

    folder: Path
    origin: Path
    around: Callable[[], AbstractContextManager[None]] = nullcontext
    """In what the command runs: a full disk, a folder that is read only."""
    rejected: tuple[str, ...] = ()
    """Blocks that must be named; all others must come in."""
    leaves_chunks: bool = False
    """A failed commit may leave data that no version names."""

    def _copy(self, name: str) -> Path:
        if not (self.folder / name).exists():
            shutil.copytree(self.origin / name, self.folder / name)
        return self.folder / name

    @property
    def catalogue(self) -> Path:
        return self._copy("catalogue")

    @property
    def network(self) -> Path:
        """Empty, over the whole catalogue."""
        return self._copy("network")

    @property
    def fused(self) -> Path:
        """The catalogue is in."""
        return self._copy("fused")

    def tagged(self) -> Path:
        """The catalogue is in, and its version has the tag ``mine``."""
        tag_version(str(self.fused), "mine")
        return self.fused

    def controlling(self) -> Path:
        """A table of control that is in the network, with its covariance as sigmas."""
        path = self.write("survey.csv", f"{','.join(POINT | SIGMAS)}\nP00000,100,35,900,9000,9000,9000\n")
        add_control(read_point_table(path), "survey", str(self.fused), SerialExecutor())
        return path

    def joining(self, change: Callable[[dict[str, Any]], Any]) -> list[Any]:
        """A query that joins an earlier answer, arrays of which are changed."""
        west, south, east, north = BOX[1:]
        path = self.folder / "other.npz"
        submin.open(self.fused).query(bbox=(west, south, east, north)).to_npz(path)
        with np.load(path) as file:
            arrays = dict(file)
        change(arrays)
        np.savez(path, **arrays)
        return ["query", self.fused, *BOX, "--join", path]

    def dense(self) -> Path:
        """An empty network of the dense form."""
        place = self.folder / "dense"
        create(str(place), shapely.box(*BOX[1:]), CatalogueMetadata("dense"), None, None, "dense")
        return place

    @property
    def new(self) -> Path:
        return self.folder / "new"

    def write(self, name: str, content: str | bytes) -> Path:
        path = self.folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def columns(self, stem: str) -> dict[str, list[Any]]:
        columns: dict[str, list[Any]] = pq.read_table(self.catalogue / f"{stem}.parquet").to_pydict()
        return columns

    def put(self, stem: str, columns: dict[str, Any]) -> None:
        pq.write_table(pa.table(columns), self.catalogue / f"{stem}.parquet")

    def set(self, stem: str, name: str, value: Any, row: int = 0) -> None:
        """Change one value of a table of the catalogue."""
        columns = self.columns(stem)
        columns[name][row] = value
        self.put(stem, columns)

    def rows(self, stem: str, keep: Callable[[dict[str, Any]], bool]) -> None:
        table = pq.read_table(self.catalogue / f"{stem}.parquet")
        pq.write_table(table.filter(pa.array([keep(row) for row in table.to_pylist()])), self.catalogue / f"{stem}.parquet")

    def csv(self, stem: str) -> Path:
        """Make a table of the catalogue CSV."""
        path = self.catalogue / f"{stem}.parquet"
        table = pq.read_table(path)
        pcsv.write_csv(table.drop_columns([n for n in ("geometry",) if n in table.schema.names]), path.with_suffix(".csv"))
        path.unlink()
        return path.with_suffix(".csv")

    def camera(self, change: Callable[[dict[str, Any]], Any], row: int = 0) -> None:
        """Change the camera of an image."""
        camera = json.loads(self.columns("images")["camera"][row])
        change(camera)
        self.set("images", "camera", json.dumps(camera), row)

    def metadata(self, **changes: Any) -> None:
        path = self.catalogue / "catalogue.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    def priors(self, values: Any) -> None:
        (self.catalogue / "priors.json").write_text(json.dumps(values))

    def run(self, *, rejected: str = "") -> list[Any]:
        self.rejected = (rejected,) if rejected else ()
        return ["run", self.catalogue, self.network]

    def block(self, k: int = 0) -> str:
        return Catalogue.open(self.catalogue).block_ids[k]

    def area(self, *rings: Any, kind: str = "Polygon") -> list[Any]:
        self.write("area.geojson", json.dumps({"type": kind, "coordinates": rings}))
        return ["create", self.new, "--aoi", self.folder / "area.geojson"]

    def importing(self) -> list[Any]:
        """The inputs of an import, taken from the catalogue, and its command."""
        images, rays = self.columns("images"), self.columns("measurements")
        (self.folder / "rpc").mkdir()
        for image_id, camera in zip(images["image_id"], images["camera"], strict=True):
            self.write(f"rpc/{image_id}.json", camera)
        pcsv.write_csv(pa.table({"image_id": images["image_id"]}), self.folder / "images.csv")
        tracks = {"track_id": rays["point_id"], "image_id": rays["image_id"], "col": rays["sample"], "row": rays["line"]}
        pcsv.write_csv(pa.table(tracks), self.folder / "tracks.csv")
        files = ["--images", self.folder / "images.csv", "--rpc", self.folder / "rpc", "--tracks", self.folder / "tracks.csv"]
        return ["import", "rpc", *files, "--out", self.new]

    def rpc(self, change: Callable[[dict[str, Any]], Any]) -> list[Any]:
        """An import in which one RPC is changed."""
        words = self.importing()
        path = self.folder / "rpc" / f"{self.columns('images')['image_id'][0]}.json"
        camera = json.loads(path.read_text())
        change(camera)
        path.write_text(json.dumps(camera))
        return words

    def isis(self, old: str = "", new: str = "") -> list[Any]:
        """An import of an ISIS network, a text of which is replaced."""
        network = write_isis(self.folder / "isis")
        if old:
            self.replace("isis/network.pvl", old, new)
        return ["import", "isis", network, "--cameras", self.folder / "isis", "--out", self.new]

    def isd(self, **changes: Any) -> list[Any]:
        """An import of an ISIS network, one camera of which is changed."""
        words = self.isis()
        self.write("isis/image0.isd", json.dumps(isd(0, **changes)))
        return words

    def gnss(self, old: str = "", new: str = "", lines: list[str] | None = None) -> list[Any]:
        """An import of GNSS measurements, a text of which is replaced."""
        file = self.write("survey.msr", "\n".join(dna_lines() if lines is None else lines) + "\n")
        if old:
            self.replace("survey.msr", old, new)
        return ["import", "gnss", file, "--out", self.new]

    def sinex(self, old: str = "", new: str = "", **file: Any) -> list[Any]:
        """An import of a solution of two stations, a text of which is replaced."""
        places = np.array([-4052052.7, 4212835.9, -2545104.5, -2713833.4, 5303935.0, -2269515.1])
        covariance = 1e-6 * (np.eye(6) + 0.5)
        path = self.write("solution.snx", "\n".join(sinex_lines(station_parameters(2), places, covariance, **file)) + "\n")
        if old:
            self.replace("solution.snx", old, new)
        return ["import", "sinex", path, "--out", self.folder / "control.parquet"]

    def observed(self, **columns: Any) -> list[Any]:
        """A run of a catalogue that also has observations, some columns of which are changed."""
        rows = {"cluster": ["gnss"], "kind": ["position"], "from": ["A"], "to": [""], "x": [-1.1e6], "y": [5.1e6], "z": [3.6e6]}
        pq.write_table(pa.table(rows | {"covariance_row": [np.eye(3).ravel().tolist()]} | columns), self.catalogue / "observations.parquet")
        return self.run()

    def replace(self, name: str, old: str, new: str) -> None:
        path = self.folder / name
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new, 1))


CASES: dict[str, Callable[[World], list[Any]]] = {}


def case(name: str) -> Callable[[Callable[[World], list[Any]]], Callable[[World], list[Any]]]:
    """Enter a function that makes what is wrong and returns the command that meets it."""

    def enter(function: Callable[[World], list[Any]]) -> Callable[[World], list[Any]]:
        assert name not in CASES
        CASES[name] = function
        return function

    return enter


def put(values: np.ndarray, at: int, value: Any) -> None:
    """An assignment, in a lambda."""
    values[at] = value


def simply(name: str, words: Callable[[World], list[Any]]) -> None:
    """Enter a case that is only a command."""
    case(name)(words)
