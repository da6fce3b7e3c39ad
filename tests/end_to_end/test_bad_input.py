"""Every row of docs/bad-input.md, given to the real command line: exit code, message, and nothing half done."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import icechunk
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import pytest
import shapely
import zarr
from command_calls import Call
from gnss_files import MEASUREMENTS, dna_lines, simulated
from isis_files import binary, isd, points
from isis_files import write as write_isis
from networks import accepted_rays, area_of
from sinex_files import sinex_lines, station_parameters

import submin
from orchestration.adjust import adjust, write
from orchestration.control import add_control
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.run import run
from submin.formats.tables import covariance_rows
from submin.query.warm_up import compile_kernels
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import CatalogueMetadata
from submin.storage.gnss_import import import_gnss
from submin.storage.network_store import Snapshot, tag_version, versions
from submin.storage.point_table import read_point_table
from submin.storage.rpc_import import import_rpc
from submin.storage.simulated import write_region
from submin.storage.sinex_import import import_solution

ROOT = Path(__file__).parents[2]
TINY = RegionDesign(width_km=60, height_km=60, point_spacing_km=9.5)
"""4 triplets, 36 points, 300 rays about 100 degrees east, 35 degrees north."""
BLOCKS = 4
BOX = ["--bbox", 99, 34, 101, 36]
NOBODY = 65534


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


# --- the command line -------------------------------------------------------------------------------------------------------------------

simply("unknown command", lambda w: ["fuse", w.catalogue, w.network])
simply("unknown option", lambda w: [*w.run(), "--wrokers", 2])
simply("missing argument", lambda w: ["run", w.catalogue])
simply("option of another type", lambda w: [*w.run(), "--workers", "two"])
simply("box of three numbers", lambda w: ["query", w.fused, "--bbox", 99, 34, 101])
simply("negative number of workers", lambda w: [*w.run(), "--workers", -1])
simply("batches of no block", lambda w: [*w.run(), "--batch-blocks", 0])
simply("limit of the innovation test out of range", lambda w: [*w.run(), "--innovation", 0.5])
simply("no point at most", lambda w: ["query", w.fused, *BOX, "--max-points", 0])
simply("unknown blocking of an import", lambda w: [*w.importing(), "--blocks", "strip"])
simply("sigma of an import out of range", lambda w: [*w.isis(), "--sigma", 0])
simply("scale of a simulation out of range", lambda w: ["simulate", "region", "--out", w.new, "--scale", 0])
simply("scale of a simulated China out of range", lambda w: ["simulate", "china", "--out", w.new, "--scale", 0])
simply("unknown kind of error of a simulated China", lambda w: ["simulate", "china", "--out", w.new, "--error", "none"])
simply("unknown region of simulated footprints", lambda w: ["simulate", "footprints", "--out", w.new, "--region", "mars"])
simply("negative seed of a simulation", lambda w: ["simulate", "five-blocks", "--out", w.new, "--seed", -1])


@case("shared data of a simulation not there")
def _(w: World) -> list[Any]:
    w.around = lambda: mock.patch.dict("os.environ", {"SUBMIN_DATA": str(w.folder)})
    return ["simulate", "china", "--out", w.new]


# --- the network ------------------------------------------------------------------------------------------------------------------------

simply("no network there", lambda w: ["run", w.catalogue, w.folder / "nowhere"])
simply("folder that is not a network", lambda w: ["query", w.catalogue, *BOX])
simply("file in place of a network", lambda w: ["query", w.write("file", "mine"), *BOX])
simply("network made where something is", lambda w: ["create", w.network, *BOX])
simply("network made where a file is", lambda w: ["create", w.write("file", "mine"), *BOX])
simply("network made below a file", lambda w: ["create", w.write("file", "mine") / "network", *BOX])
simply("unknown version", lambda w: ["query", w.fused, *BOX, "--at", "v7"])
simply("unknown form", lambda w: ["create", w.new, *BOX, "--form", "sparse"])
simply("sizes of tiles for a dense network", lambda w: ["create", w.new, *BOX, "--form", "dense", "--tile-km", "50"])
simply("map of a dense network", lambda w: ["map", w.dense(), "--out", w.folder / "map.png"])
simply("policy of several tiles for a dense network", lambda w: ["query", w.dense(), *BOX, "--policy", "rigorous"])
simply("image withdrawn from a dense network", lambda w: ["withdraw", w.dense(), "--image", "IMAGE"])


@case("network of another format version")
def _(w: World) -> list[Any]:
    repository = icechunk.Repository.open(icechunk.local_filesystem_storage(str(w.network)))
    session = repository.writable_session("main")
    root = zarr.open_group(session.store, mode="r+")
    root.attrs["submin"] = {**dict(root.attrs["submin"]), "format_version": 99}
    session.commit("of another release", metadata={"version": 1})
    return w.run()


@case("repository that is not a network")
def _(w: World) -> list[Any]:
    icechunk.Repository.create(icechunk.local_filesystem_storage(str(w.new)))
    return ["info", w.new]


@contextmanager
def limited(size: int) -> Iterator[None]:
    """No file grows beyond a size: a disk that fills up, for any user."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def mounted(*words: object) -> Iterator[bool]:
    """Mount something on the folder named last; False where this is not allowed."""
    folder = str(words[-1])
    done = subprocess.run(["mount", *map(str, words)], capture_output=True, check=False).returncode == 0 if shutil.which("mount") else False
    try:
        yield done
    finally:
        if done:
            subprocess.run(["umount", "--lazy", folder], check=True)


@contextmanager
def somebody_else(folder: Path) -> Iterator[None]:
    """Root, whom no permission binds, is somebody else meanwhile, who can find the folder."""
    if os.geteuid() != 0:
        yield
        return
    above = [path for path in folder.parents if not path.stat().st_mode & 0o001]
    for path in above:
        path.chmod(path.stat().st_mode | 0o011)
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)
        for path in above:
            path.chmod(path.stat().st_mode & ~0o011)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Nothing can be written in a folder: by a mount where one is allowed, else by permissions."""
    inside = [folder, *folder.rglob("*")]
    with mounted("-o", "bind,ro", folder, folder) as done:
        if done:
            yield
            return
        for path in inside:
            path.chmod(0o555 if path.is_dir() else 0o444)
        try:
            with somebody_else(folder):
                yield
        finally:
            for path in inside:
                path.chmod(0o755 if path.is_dir() else 0o644)


@case("network that is read only")
def _(w: World) -> list[Any]:
    w.around = lambda: read_only(w.network)
    return w.run()


@case("network made in a folder that is read only")
def _(w: World) -> list[Any]:
    (w.folder / "closed").mkdir()
    w.around = lambda: read_only(w.folder / "closed")
    return ["create", w.folder / "closed" / "network", *BOX]


@case("disk full in the middle of a commit")
def _(w: World) -> list[Any]:
    w.around, w.leaves_chunks = lambda: limited(20_000), True
    return w.run()


@case("network made on a full disk")
def _(w: World) -> list[Any]:
    w.around = lambda: limited(100)
    return ["create", w.new, *BOX]


# --- the area ---------------------------------------------------------------------------------------------------------------------------

RING = [[99, 34], [101, 34], [101, 36], [99, 36], [99, 34]]

simply("no area given", lambda w: ["create", w.new])
simply("area given twice", lambda w: ["create", w.new, *BOX, "--fit", w.catalogue])
simply("box without width", lambda w: ["create", w.new, "--bbox", 99, 34, 99, 36])
simply("box with swapped axes", lambda w: ["create", w.new, "--bbox", 34, 99, 36, 101])
simply("queried box with swapped axes", lambda w: ["query", w.fused, "--bbox", 34, 99, 36, 101])
simply("box that is not finite", lambda w: ["create", w.new, "--bbox", "nan", 34, 101, 36])


@case("queried box whose swapped axes are on the globe")
def _(w: World) -> list[Any]:
    create(str(w.new), shapely.box(34.0, 29.0, 36.0, 31.0), Catalogue.open(w.catalogue).metadata, 60.0, 20.0)
    return ["query", w.new, "--bbox", 29.5, 34.5, 30.5, 35.5]


simply("no such area file", lambda w: ["create", w.new, "--aoi", w.folder / "nowhere.geojson"])
simply("area file that is not JSON", lambda w: ["create", w.new, "--aoi", w.write("area.geojson", "POLYGON ((0 0))")])
simply(
    "area file that is not UTF-8",
    lambda w: ["create", w.new, "--aoi", w.write("area.geojson", b'{"type": "Polygon", "name": "Z\xfcrich"}')],
)
simply("area without a polygon", lambda w: w.area(99, 34, kind="Point"))
simply("empty area", lambda w: w.area())
simply("queried area with swapped axes", lambda w: ["query", w.fused, "--aoi", w.area([[y, x] for x, y in RING])[-1]])
simply("area without extent", lambda w: w.area([[99, 34], [101, 36], [99, 34], [99, 34]]))
simply("self-crossing area", lambda w: w.area([[99, 34], [101, 36], [101, 34], [99, 36], [99, 34]]))
simply("area with swapped axes", lambda w: w.area([[y, x] for x, y in RING]))
simply("area off the globe", lambda w: w.area([[x, y + 100] for x, y in RING]))
simply("area with a coordinate that is not finite", lambda w: w.area([[99, float("nan")], *RING[1:]]))
simply("overlap as wide as the core", lambda w: ["create", w.new, *BOX, "--tile-km", 50, "--overlap-km", 50])
simply("overlap wider than the core", lambda w: ["create", w.new, *BOX, "--tile-km", 50, "--overlap-km", 75])
simply("negative overlap", lambda w: ["create", w.new, *BOX, "--overlap-km", -1])
simply("tiles without size", lambda w: ["create", w.new, *BOX, "--tile-km", 0])
simply("a billion tiles", lambda w: ["create", w.new, "--bbox", -170, -60, 170, 60, "--tile-km", 0.3, "--overlap-km", 0.1])
simply("ten million tiles", lambda w: [*w.area([[100, 0], [110, 0], [110, 10], [100, 10], [100, 0]]), "--tile-km", 0.347])
simply("area around the globe", lambda w: ["create", w.new, "--bbox", -180, -60, 180, 60])
simply("tiles too small to count", lambda w: ["create", w.new, *BOX, "--tile-km", 1e-307, "--overlap-km", 0])


@case("footprints with swapped axes")
def _(w: World) -> list[Any]:
    columns = w.columns("images")
    flipped = shapely.transform(shapely.from_wkb(columns["geometry"]), lambda at: at[:, ::-1])
    w.put("images", columns | {"geometry": shapely.to_wkb(flipped).tolist()})
    return ["create", w.new, "--fit", w.catalogue]


@case("footprint that is not WKB")
def _(w: World) -> list[Any]:
    w.set("images", "geometry", b"polygon", row=1)
    return ["create", w.new, "--fit", w.catalogue]


@case("no footprints to fit")
def _(w: World) -> list[Any]:
    columns = w.columns("images")
    del columns["geometry"]
    blind = [json.dumps(json.loads(camera) | {"LINE_NUM_COEFF": [0.0] * 20}) for camera in columns["camera"]]
    w.put("images", columns | {"camera": blind})
    return ["create", w.new, "--fit", w.catalogue]


# --- the catalogue ----------------------------------------------------------------------------------------------------------------------


def changed(name: str, change: Callable[[World], Any]) -> None:
    """Enter a case in which a changed catalogue is run."""

    def words(w: World) -> list[Any]:
        change(w)
        return [*w.run(), "--batch-blocks", 1]  # were the first block committed before the last row is read, it would show

    case(name)(words)


simply("no such catalogue", lambda w: ["run", w.folder / "nowhere", w.network])
simply("file in place of a catalogue", lambda w: ["run", w.write("file", "mine"), w.network])
simply("folder that is not a catalogue", lambda w: ["run", w.network, w.network])
changed("metadata that are not JSON", lambda w: w.write("catalogue/catalogue.json", "name: region") if w.catalogue else None)
changed("metadata that are not UTF-8", lambda w: w.write("catalogue/catalogue.json", b'{"name": "Z\xfcrich"}') if w.catalogue else None)
changed("unknown key in the metadata", lambda w: w.metadata(datum="WGS84"))
changed("missing key in the metadata", lambda w: (w.catalogue / "catalogue.json").write_text('{"name": "region"}'))
changed("catalogue of another format version", lambda w: w.metadata(format_version=2))
changed("orthometric heights", lambda w: w.metadata(height_kind="orthometric"))
changed("ellipsoid that is none", lambda w: w.metadata(semimajor_axis=-1.0))
changed("another frame", lambda w: w.metadata(frame="ITRF2014"))
changed("another epoch", lambda w: w.metadata(epoch="2010.0"))
changed("another body", lambda w: w.metadata(body="moon", semimajor_axis=1737400.0, flattening=0.0))

changed("table missing", lambda w: (w.catalogue / "measurements.parquet").unlink())
changed("table there twice", lambda w: (w.catalogue / "measurements.csv").write_text("mine"))
changed(
    "missing column of measurements", lambda w: w.put("measurements", {k: v for k, v in w.columns("measurements").items() if k != "line"})
)
changed("missing column of images", lambda w: w.put("images", {k: v for k, v in w.columns("images").items() if k != "camera"}))
changed("column of another type", lambda w: w.put("measurements", w.columns("measurements") | {"sample": ["here"] * 300}))
changed("empty id", lambda w: w.set("measurements", "point_id", "", row=4))
changed("unknown image in a measurement", lambda w: w.set("measurements", "image_id", "T9", row=4))
changed("image of another block in a measurement", lambda w: w.set("measurements", "image_id", w.columns("images")["image_id"][-1], row=4))
changed("unknown block in a measurement", lambda w: w.set("measurements", "block_id", "T9", row=299))
changed(
    "measurements not sorted by block", lambda w: w.put("measurements", {k: [*v[1:], v[0]] for k, v in w.columns("measurements").items()})
)
changed("no measurements in the file", lambda w: w.rows("measurements", lambda row: False))
changed(
    "truncated Parquet",
    lambda w: (w.catalogue / "measurements.parquet").write_bytes((w.catalogue / "measurements.parquet").read_bytes()[:2000]),
)
changed("Parquet of no bytes", lambda w: (w.catalogue / "measurements.parquet").write_bytes(b""))


@case("CSV of no bytes")
def _(w: World) -> list[Any]:
    w.csv("measurements").write_bytes(b"")
    return w.run()


@case("CSV with a ragged row")
def _(w: World) -> list[Any]:
    path = w.csv("measurements")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:7], lines[7] + ",9", *lines[8:]]))
    return w.run()


@case("CSV with text where a number belongs")
def _(w: World) -> list[Any]:
    path = w.csv("measurements")
    lines = path.read_text().splitlines()
    words = lines[7].split(",")
    path.write_text("\n".join([*lines[:7], ",".join([*words[:3], "left", *words[4:]]), *lines[8:]]))
    return w.run()


@case("CSV that is not UTF-8")
def _(w: World) -> list[Any]:
    path = w.csv("measurements")
    path.write_bytes(path.read_bytes().replace(b"P", b"\xfc", 1))
    return w.run()


changed("image there twice", lambda w: w.set("images", "image_id", w.columns("images")["image_id"][0], row=2))
changed("image without size", lambda w: w.set("images", "width", 0))
changed("time that is none", lambda w: w.set("images", "acquired", "noon"))
changed("geometry that is not WKB", lambda w: w.set("images", "geometry", b"polygon", row=1))
changed("unknown sensor", lambda w: w.set("images", "sensor", "sonar"))
changed("camera that is not JSON", lambda w: w.set("images", "camera", "<rpc/>"))
changed("RPC without a list of coefficients", lambda w: w.camera(lambda c: c.pop("SAMP_DEN_COEFF")))
changed("RPC with 19 coefficients", lambda w: w.camera(lambda c: c["LINE_NUM_COEFF"].pop()))
changed("RPC with a scale of zero", lambda w: w.camera(lambda c: c.update(LAT_SCALE=0.0)))
changed("RPC with a value that is not finite", lambda w: w.camera(lambda c: c.update(LINE_OFF=float("nan"))))
changed("RPC with a value that is not a number", lambda w: w.camera(lambda c: c.update(LINE_OFF="left")))


def framed(name: str, **changes: Any) -> None:
    """Enter a case in which an image is said to be of a frame camera, which lacks something."""

    def change(w: World) -> None:
        w.camera(lambda c: (c.clear(), c.update({**FRAME, **changes})))
        w.set("images", "sensor", "frame")

    changed(name, change)


FRAME = {
    "position": [7e6, 0.0, 0.0], "rotation": [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]], "focal_length": 3000.0,
    "mm_to_pixel": [[5000.0, 100.0, 0.0], [5000.0, 0.0, 100.0]], "height": 0.0,
}  # fmt: skip

framed("frame camera without a place", position=None)
framed("frame camera with a rotation that is none", rotation=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
framed("frame camera with a distortion that says not which way", distortion={"radial": [1e-9, 0.0, 0.0]})
framed("frame camera with a distortion that folds the image", distortion={"radial": [-1e-3, 0.0, 0.0], "direction": "measured to ideal"})
changed("RPC with swapped axes", lambda w: w.camera(lambda c: c.update(LAT_OFF=c["LONG_OFF"], LONG_OFF=c["LAT_OFF"])))

changed("priors that are not JSON", lambda w: (w.catalogue / "priors.json").write_text("bias 10"))
changed("priors that are not an object", lambda w: w.priors([]))
changed("unknown key in the priors", lambda w: w.priors({"defaults": {}}))
changed("unknown key in a block's prior", lambda w: w.priors({"default": {"bias_mm": 10}}))
changed("prior of an unknown block", lambda w: w.priors({"blocks": {"T9": {}}}))
changed("prior without a number", lambda w: w.priors({"default": {"bias_px": "large"}}))
changed("prior sigma that is not positive", lambda w: w.priors({"default": {"bias_px": 0}}))
changed(
    "prior covariance that is not positive definite", lambda w: w.priors({"default": {"correlation": "fixed", "correlation_parameter": 1}})
)
changed("prior part out of range", lambda w: w.priors({"default": {"common_to_pass": 1.5}}))
changed("unknown correlation of the priors", lambda w: w.priors({"default": {"correlation": "linear"}}))

POINT = {"point_id": ["P00000"], "longitude": [100.0], "latitude": [35.0], "height": [900.0]}
SIGMAS = {"sigma_e": [1.0], "sigma_n": [1.0], "sigma_u": [1.0]}
MATRIX = {"cov_ee": [1.0], "cov_en": [2.0], "cov_eu": [0.0], "cov_nn": [1.0], "cov_nu": [0.0], "cov_uu": [1.0]}

changed("control without covariance", lambda w: w.put("control", POINT))
changed("control covariance that is not positive definite", lambda w: w.put("control", POINT | MATRIX | {"cov_en": [1.0]}))
changed("check covariance that is not positive definite", lambda w: w.put("check", POINT | MATRIX))
changed("negative sigma of a point", lambda w: w.put("control", POINT | SIGMAS | {"sigma_n": [-1.0]}))
changed("point there twice", lambda w: w.put("check", {k: v * 2 for k, v in (POINT | SIGMAS).items()}))
changed("point with swapped axes", lambda w: w.put("check", POINT | SIGMAS | {"longitude": [35.0], "latitude": [100.0]}))

# --- blocks: each rejects itself and no other -------------------------------------------------------------------------------------------


def in_block(name: str, change: Callable[[World], Any], k: int = 0) -> None:
    """Enter a case in which one block of the catalogue is rejected."""

    def words(w: World) -> list[Any]:
        change(w)
        return w.run(rejected=w.block(k))

    case(name)(words)


in_block("measurement that is not a number", lambda w: w.set("measurements", "sample", float("nan"), row=4))
in_block("measurement that is missing", lambda w: w.set("measurements", "sample", None, row=4))
in_block("measurement that is infinite", lambda w: w.set("measurements", "line", float("inf"), row=4))
in_block("sigma of zero", lambda w: w.set("measurements", "sigma_sample", 0.0, row=4))
in_block("negative sigma", lambda w: w.set("measurements", "sigma_line", -0.5, row=4))
in_block("ray given twice", lambda w: w.put("measurements", {k: [v[0], *v] for k, v in w.columns("measurements").items()}))
in_block("image without measurements", lambda w: w.rows("measurements", lambda row: row["image_id"] != w.columns("images")["image_id"][1]))
in_block("block without measurements", lambda w: w.rows("measurements", lambda row: row["block_id"] != w.block(0)))


@case("block of two rays")
def _(w: World) -> list[Any]:
    images = pq.read_table(w.catalogue / "images.parquet")
    first, block = images["image_id"][0].as_py(), w.block(0)
    w.rows("images", lambda row: row["block_id"] != block or row["image_id"] == first)
    points = iter(range(1000))
    w.rows("measurements", lambda row: row["block_id"] != block or (row["image_id"] == first and next(points) < 2))
    return w.run(rejected=block)


@case("prior correlation in time, and an image without one")
def _(w: World) -> list[Any]:
    w.priors({"blocks": {w.block(0): {"correlation": "gaussian", "correlation_parameter": 60}}})
    w.set("images", "acquired", "")
    return w.run(rejected=w.block(0))


def all_cameras(w: World, block: str, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the cameras of a block."""
    for row, of in enumerate(w.columns("images")["block_id"]):
        if of == block:
            w.camera(change, row)


def elsewhere(w: World, longitude: float, latitude: float) -> list[Any]:
    """The first block lies at another place, and shares no point with the others."""
    block = w.block(0)
    all_cameras(w, block, lambda c: c.update(LONG_OFF=longitude + c["LONG_OFF"] - 100.0, LAT_OFF=latitude + c["LAT_OFF"] - 35.0))
    rays = w.columns("measurements")
    rays["point_id"] = [f"away-{p}" if b == block else p for p, b in zip(rays["point_id"], rays["block_id"], strict=True)]
    w.put("measurements", rays)
    return w.run(rejected=block)


simply("block wholly outside the area", lambda w: elsewhere(w, 20.0, 50.0))


@case("block outside an area with swapped axes")
def _(w: World) -> list[Any]:
    catalogue = w.catalogue
    for row in range(len(w.columns("images")["image_id"])):
        w.camera(lambda c: c.update(LONG_OFF=c["LONG_OFF"] - 70.0), row)
    w.rows("images", lambda row: row["block_id"] in (w.block(0), w.block(1)))
    kept = set(Catalogue.open(catalogue).block_ids)
    w.rows("measurements", lambda row: row["block_id"] in kept)
    create(str(w.new), shapely.box(34.0, 29.0, 36.0, 31.0), Catalogue.open(catalogue).metadata, 60.0, 20.0)
    w.rejected = tuple(sorted(kept))
    return ["run", catalogue, w.new]


@case("one id at two places")
def _(w: World) -> list[Any]:
    block = w.block(3)
    rays = w.columns("measurements")
    theirs = {p for p, b in zip(rays["point_id"], rays["block_id"], strict=True) if b != block}
    mine = next(p for p, b in zip(rays["point_id"], rays["block_id"], strict=True) if b == block)
    far = next(p for p in sorted(theirs, reverse=True) if (block, p) not in set(zip(rays["block_id"], rays["point_id"], strict=True)))
    rays["point_id"] = [far if b == block and p == mine else p for p, b in zip(rays["point_id"], rays["block_id"], strict=True)]
    w.put("measurements", rays)
    return w.run(rejected=block)


@case("one id at another place than in the network")
def _(w: World) -> list[Any]:
    block = w.block(0)
    all_cameras(w, block, lambda c: c.update(LONG_OFF=c["LONG_OFF"] + 0.2))
    for stem in ("images", "measurements"):
        columns = w.columns(stem)
        moved = [b == block for b in columns["block_id"]]
        for name in ("block_id", "image_id"):
            columns[name] = [f"again-{value}" if m else value for value, m in zip(columns[name], moved, strict=True)]
        w.put(stem, columns)
    w.rejected = (f"again-{block}",)
    return ["run", w.catalogue, w.fused]


@case("camera that looks away from the ground")
def _(w: World) -> list[Any]:
    w.camera(lambda c: c.update(SAMP_NUM_COEFF=[0.0] * 20))
    return w.run(rejected=w.block(0))


@case("points of a block measured all at one place")
def _(w: World) -> list[Any]:
    block = w.block(0)
    rays = w.columns("measurements")
    for name in ("sample", "line"):  # every point in the middle of every image
        rays[name] = [5000.0 if b == block else v for v, b in zip(rays[name], rays["block_id"], strict=True)]
    w.put("measurements", rays)
    return w.run(rejected=block)


def measured_elsewhere(w: World, block: str, lines: float, rows: slice = slice(None)) -> list[Any]:
    """The rays of a block, or some of them, are measured so many lines off."""
    rays = w.columns("measurements")
    for k in np.flatnonzero([b == block for b in rays["block_id"]])[rows]:
        rays["line"][k] += lines
    w.put("measurements", rays)
    return w.run(rejected=block)


simply("block measured far outside its images", lambda w: measured_elsewhere(w, w.block(0), 3e5))
simply("line far out of range", lambda w: measured_elsewhere(w, w.block(0), 1e9, slice(5, 6)))


@case("camera on the other side of the Earth")
def _(w: World) -> list[Any]:
    w.camera(lambda c: c.update(LONG_OFF=c["LONG_OFF"] - 180.0))
    return w.run(rejected=w.block(0))


@case("line upside down in a camera")
def _(w: World) -> list[Any]:
    w.camera(lambda c: c.update(LINE_NUM_COEFF=[-value for value in c["LINE_NUM_COEFF"]]))
    return w.run(rejected=w.block(0))


@case("sample and line exchanged in a block")
def _(w: World) -> list[Any]:
    block = w.block(0)
    rays = w.columns("measurements")
    pairs = list(zip(rays["sample"], rays["line"], rays["block_id"], strict=True))
    rays["sample"] = [line if b == block else sample for sample, line, b in pairs]
    rays["line"] = [sample if b == block else line for sample, line, b in pairs]
    w.put("measurements", rays)
    return w.run(rejected=block)


@case("block known with other content")
def _(w: World) -> list[Any]:
    w.set("measurements", "sample", w.columns("measurements")["sample"][0] + 1.0)
    w.rejected = (w.block(0),)
    return ["run", w.catalogue, w.fused]


@case("image that came in another block")
def _(w: World) -> list[Any]:
    block = w.block(0)
    for stem in ("images", "measurements"):
        columns = w.columns(stem)
        w.put(stem, columns | {"block_id": ["again" if b == block else b for b in columns["block_id"]]})
    w.rejected = ("again",)
    return ["run", w.catalogue, w.fused]


# --- queries, checks, maps --------------------------------------------------------------------------------------------------------------

simply("nothing queried", lambda w: ["query", w.fused])
simply("two things queried", lambda w: ["query", w.fused, *BOX, "--points", w.write("ids.txt", "P1")])
simply("scheduler that does not answer", lambda w: [*w.run(), "--scheduler", "carrier-pigeon://here"])
simply("unknown policy", lambda w: ["query", w.fused, *BOX, "--policy", "best"])
simply("unknown tile", lambda w: ["query", w.fused, "--tile", "r9"])
simply("unknown points", lambda w: ["query", w.fused, "--points", w.write("ids.txt", "P1\nP2\n")])
simply("no such list of points", lambda w: ["query", w.fused, "--points", w.folder / "nowhere.csv"])
simply("empty list of points", lambda w: ["query", w.fused, "--points", w.write("ids.txt", "\n")])
simply("list of points without a column of ids", lambda w: ["query", w.fused, "--points", w.write("ids.csv", "id\nP1\n")])
simply("list of points that is not UTF-8", lambda w: ["query", w.fused, "--points", w.write("ids.txt", b"Z\xfcrich\n")])
simply("output of unknown format", lambda w: ["query", w.fused, *BOX, "--out", w.folder / "control.xls"])
simply("output to a folder that does not exist", lambda w: ["query", w.fused, *BOX, "--out", w.folder / "nowhere" / "control.csv"])
simply("output where a folder is", lambda w: ["query", w.fused, *BOX, "--out", Path(f"{w.catalogue}").rename(w.folder / "c.csv")])
simply("check of no such table", lambda w: ["check", w.fused, w.folder / "nowhere.csv"])
simply(
    "check of points that are not in the network",
    lambda w: ["check", w.fused, w.write("c.csv", f"{','.join(POINT | SIGMAS)}\nZ,100,35,900,1,1,1\n")],
)
simply(
    "report of a check to a folder that does not exist",
    lambda w: ["check", w.fused, w.catalogue / "check.parquet", "--out", w.new / "c.txt"],
)
simply("map of another format", lambda w: ["map", w.fused, "--out", w.folder / "map.pdf"])
simply("map to a folder that does not exist", lambda w: ["map", w.fused, "--out", w.folder / "nowhere" / "map.png"])


@case("output to a folder that is read only")
def _(w: World) -> list[Any]:
    (w.folder / "closed").mkdir()
    w.around = lambda: read_only(w.folder / "closed")
    return ["query", w.fused, *BOX, "--out", w.folder / "closed" / "control.npz"]


@case("output on a full disk")
def _(w: World) -> list[Any]:
    w.around = lambda: limited(1000)
    return ["query", w.fused, *BOX, "--out", w.folder / "control.parquet"]


@case("map on a full disk")
def _(w: World) -> list[Any]:
    w.around = lambda: limited(1000)
    return ["map", w.fused, "--out", w.folder / "map.png"]


# --- export -----------------------------------------------------------------------------------------------------------------------------


def export(w: World, *words: Any, out: str = "compact.parquet", family: str = "exponential") -> list[Any]:
    return ["export", w.fused, "--out", w.folder / out, "--family", family, *words]


simply("unknown family of correlation functions", lambda w: export(w, family="sinc"))
simply("correlation function that is indefinite in the plane", lambda w: export(w, family="tent"))
simply("floor of a family that has none", lambda w: export(w, "--floor-km", 50))
simply("floor that is not positive", lambda w: export(w, "--floor-km", 0))
simply("more vectors than coordinates", lambda w: export(w, "--rank", 1000))
simply("negative number of vectors", lambda w: export(w, "--rank", -1))
simply("no points to condense", lambda w: export(w, "--bbox", 99, 34, 99.001, 34.001))
simply("export of unknown format", lambda w: export(w, out="compact.csv"))
simply("export to a folder that does not exist", lambda w: export(w, out="nowhere/compact.parquet"))


@case("too many points to condense")
def _(w: World) -> list[Any]:
    w.around = lambda: mock.patch("submin.correlation.compact.MOST_POINTS", 10)
    return export(w)


@case("export as control")
def _(w: World) -> list[Any]:
    submin.open(w.fused).export(w.folder / "compact.parquet", family="exponential", max_points=9)
    return ["control", "add", w.fused, w.folder / "compact.parquet"]


# --- withdrawal, control and tags -------------------------------------------------------------------------------------------------------

HEADER = "point_id,longitude,latitude,height"


def surveyed(w: World, header: str, *rows: str) -> list[Any]:
    """Control points in a file, and the command that adds them."""
    return ["control", "add", w.fused, w.write("survey.csv", "\n".join([header, *rows]))]


simply("nothing named to be withdrawn", lambda w: ["withdraw", w.fused])
simply("two things named to be withdrawn", lambda w: ["withdraw", w.fused, "--block", w.block(), "--control", "P"])
simply("withdrawal of a block that is not there", lambda w: ["withdraw", w.network, "--block", w.block()])
simply("withdrawal of a control point that is not there", lambda w: ["withdraw", w.fused, "--control", "P"])
simply("added control without covariance", lambda w: surveyed(w, HEADER, "P,100,35,0"))
simply(
    "added control with a negative variance",
    lambda w: surveyed(w, f"{HEADER},cov_ee,cov_en,cov_eu,cov_nn,cov_nu,cov_uu", "P,100,35,0,-1,0,0,1,0,1"),
)
simply("added control with a negative sigma", lambda w: surveyed(w, f"{HEADER},sigma_e,sigma_n,sigma_u", "P,100,35,0,-1,1,1"))
simply("added control with a sigma of zero", lambda w: surveyed(w, f"{HEADER},sigma_e,sigma_n,sigma_u", "P,100,35,0,1,0,1"))
simply("tag that is taken", lambda w: ["tag", w.tagged(), "mine"])
simply("details of points that join from elsewhere", lambda w: [*w.joining(lambda a: None), "--details", "--out", w.folder / "points.csv"])
simply("control to join in another format", lambda w: ["query", w.fused, *BOX, "--join", w.write("other.csv", "point_id\n")])
simply("control to join that does not say where it is", lambda w: w.joining(lambda a: a.pop("frame")))
simply("control to join with a point twice", lambda w: w.joining(lambda a: put(a["ids"], 1, a["ids"][0])))
simply("control to join in another frame, epoch or ellipsoid", lambda w: w.joining(lambda a: a.update(frame=np.array("PZ-90"))))
simply("control to join without a common point", lambda w: w.joining(lambda a: a.update(ids=np.char.add("X", a["ids"]))))
simply("control to join with an id elsewhere", lambda w: w.joining(lambda a: a.update(geocentric=a["geocentric"] + 1e5)))
simply("tag like a version", lambda w: ["tag", w.fused, "v1"])
simply("difference to an unknown version", lambda w: ["diff", w.fused, "v0", "v8"])

# --- points: metadata, thinning, dates --------------------------------------------------------------------------------------------------


def listing(w: World, *words: Any, out: str = "points.csv") -> list[Any]:
    return ["points", w.fused, *words, "--out", w.folder / out]


def retiring(w: World, *words: Any, ids: str = "P000000\n") -> list[Any]:
    return ["retire", w.fused, "--points", w.write("ids.txt", ids), *words]


simply("thinning to squares without a side", lambda w: ["create", w.new, *BOX, "--thin-metres", 0])
simply("details of an answer that is not written", lambda w: ["query", w.fused, *BOX, "--details"])
simply("query on a day that is none", lambda w: ["query", w.fused, *BOX, "--on", "31.5.2026"])
simply("metadata of no points", lambda w: listing(w))
simply("metadata asked for in two ways", lambda w: listing(w, *BOX, "--tile", "r000c000"))
simply("metadata of unknown points", lambda w: listing(w, "--points", w.write("ids.txt", "P000000\nP1\n")))
simply("metadata of an unknown status", lambda w: listing(w, *BOX, "--status", "good"))
simply("metadata of unknown format", lambda w: listing(w, *BOX, out="points.npz"))
simply("metadata to a folder that does not exist", lambda w: listing(w, *BOX, out="nowhere/points.csv"))
simply("retirement of unknown points", lambda w: retiring(w, "--valid-to", "2026-05-31", ids="P000000\nP1\n"))
simply("retirement on a day that is none", lambda w: retiring(w, "--valid-to", "2026-02-30"))
simply("retirement without a day", lambda w: retiring(w, "--reason", "quarry"))
simply("retirement before the first day", lambda w: retiring(w, "--valid-from", "2026-06-01", "--valid-to", "2026-05-31"))


def _correlated(w: World, covariance: Any, variance: float = 1.0) -> list[Any]:
    """Two points with this joint covariance, and a variance beside it for the coordinates of each."""
    points = Catalogue.open(w.catalogue).points("check")
    columns = {"point_id": points.point_ids[:2]}  # type: ignore[union-attr]
    columns |= {name: points.geodetic[:2, k] for k, name in enumerate(("longitude", "latitude", "height"))}  # type: ignore[union-attr]
    columns |= {f"sigma_{axis}": np.full(2, np.sqrt(variance)) for axis in "enu"}
    pq.write_table(pa.table(columns | {"covariance_row": covariance_rows(covariance, 0, 2)}), w.folder / "joint.parquet")
    return ["control", "add", w.fused, w.folder / "joint.parquet"]


@case("correlated control with a negative variance")
def _(w: World) -> list[Any]:
    return _correlated(w, np.kron([[1.0, 2.0], [2.0, 1.0]], np.eye(3)))


@case("correlated control without a datum")
def _(w: World) -> list[Any]:
    return _correlated(w, np.kron(np.full((2, 2), 1e12) + np.eye(2), np.eye(3)), 1e12)


@case("correlated control whose covariances contradict each other")
def _(w: World) -> list[Any]:
    return _correlated(w, np.eye(6), 2.0)


@case("image id of a control point")
def _(w: World) -> list[Any]:
    w.set("images", "image_id", "control:P:0")
    return w.run()


@case("tile that was split")
def _(w: World) -> list[Any]:
    catalogue = Catalogue.open(w.catalogue)
    area = shapely.box(99.5, 34.5, 100.5, 35.5)
    create(str(w.new), area, catalogue.metadata, 200.0, 20.0, max_parameters=60)
    run(catalogue, str(w.new), SerialExecutor())
    return ["query", w.new, "--tile", "r000c000"]


# --- adjusting and readjusting ----------------------------------------------------------------------------------------------------------


def adjusting(w: World, *options: Any, network: bool = False) -> list[Any]:
    """The command that adjusts the first block, by the network that has none of them or by itself."""
    control = ["--network", w.network] if network else []
    return ["adjust", w.catalogue, "--block", w.block(), *control, "--out", w.new, *options]


simply("adjustment of a block that is in the network", lambda w: [*adjusting(w), "--network", w.fused])
simply("adjustment of an unknown block", lambda w: ["adjust", w.catalogue, "--block", "B", "--out", w.new])
simply("adjustment by an unknown policy", lambda w: [*adjusting(w), "--network", halfway(w), "--policy", "best"])
simply("adjustment with no point at most", lambda w: adjusting(w, "--max-points", 0))
simply("virtual control beside a network", lambda w: adjusting(w, "--virtual-control", 3, network=True))
simply("virtual control of unknown weight", lambda w: adjusting(w, "--virtual-control", 3, "--virtual-weight", "heavy"))
simply("virtual control of too few points", lambda w: adjusting(w, "--virtual-control", 1))
simply("virtual control out of reach", lambda w: adjusting(w, "--virtual-control", 3, "--virtual-height", 1e12))
simply("virtual control at no height", lambda w: adjusting(w, "--virtual-control", 3, "--virtual-height", "nan"))
for option, value in (("sigma", 5), ("weight", "plain"), ("height", 0)):
    simply(
        f"adjustment with --virtual-{option} and no --virtual-control",
        lambda w, words=(f"--virtual-{option}", value): adjusting(w, *words, network=True),
    )
simply("adjustment with --policy and no --network", lambda w: adjusting(w, "--policy", "auto"))
simply("adjustment with --at and no --network", lambda w: adjusting(w, "--at", "v1"))
simply("readjustment by an unknown policy", lambda w: ["readjust", w.catalogue, w.fused, "--out", w.new / "a" / "b", "--policy", "best"])
simply("readjustment of a block that is not in the network", lambda w: [*readjusting(w, w.network), "--block", w.block()])
simply("readjustment of a catalogue that is not in the network", lambda w: readjusting(w, w.network))
simply("de-weighting that gives weight", lambda w: [*readjusting(w, w.fused), "--deweight", 0.5])


def readjusting(w: World, network: Path) -> list[Any]:
    return ["readjust", w.catalogue, network, "--out", w.new]


def halfway(w: World) -> Path:
    """A network of all blocks but the first."""
    part = shutil.copytree(w.catalogue, w.folder / "part")
    for stem in ("images", "measurements"):
        table = pq.read_table(part / f"{stem}.parquet")
        pq.write_table(table.filter(pc.not_equal(table["block_id"], w.block())), part / f"{stem}.parquet")
    run(Catalogue.open(part), str(w.network), SerialExecutor())
    return w.network


@case("adjustment of a block with a ray twice")
def _(w: World) -> list[Any]:
    columns = w.columns("measurements")
    w.put("measurements", {name: [values[0], *values] for name, values in columns.items()})
    return adjusting(w)


@case("adjustment by a network of another frame")
def _(w: World) -> list[Any]:
    w.metadata(frame="ITRF2014")
    return adjusting(w, network=True)


@case("control of an adjustment with an impossible joint covariance")
def _(w: World) -> list[Any]:
    ids = w.columns("measurements")["point_id"][:2]
    at = {name: [value, value] for name, value in (("longitude", 100.0), ("latitude", 35.0), ("height", 0.0))}
    rows = [np.eye(3).ravel().tolist(), np.hstack([5.0 * np.eye(3), np.eye(3)]).ravel().tolist()]
    w.put("control", {"point_id": sorted(set(ids)) if len(set(ids)) == 2 else [ids[0], "other"], **at, "covariance_row": rows})
    return adjusting(w)


@case("result of an adjustment where something is")
def _(w: World) -> list[Any]:
    w.new.mkdir()
    (w.new / "mine").write_text("mine")
    return adjusting(w)


@case("result of a readjustment where a file is")
def _(w: World) -> list[Any]:
    return ["readjust", w.catalogue, w.fused, "--out", w.write("file", "mine")]


@case("result of an adjustment in a folder that is read only")
def _(w: World) -> list[Any]:
    folder = w.folder / "closed"
    folder.mkdir()
    w.around = lambda: read_only(folder)
    return ["adjust", w.catalogue, "--block", w.block(), "--out", folder / "result"]


@case("adjusted points added as control")
def _(w: World) -> list[Any]:
    catalogue = Catalogue.open(w.catalogue)
    write(adjust(catalogue, w.block()), w.new)
    return ["control", "add", w.fused, w.new / "points.parquet"]


def answered(w: World, path: Path) -> Path:
    """What the network answers of all its points, as a file."""
    submin.open(str(w.fused)).query(bbox=(-180.0, -90.0, 180.0, 90.0)).write(path)
    return path


for suffix in ("csv", "parquet"):

    @case(f"answer of a network added as control, {suffix}")
    def _(w: World, suffix: str = suffix) -> list[Any]:
        return ["control", "add", w.fused, answered(w, w.folder / f"answer.{suffix}")]

    @case(f"answer of a network as control of a run, {suffix}")
    def _(w: World, suffix: str = suffix) -> list[Any]:
        answered(w, w.catalogue / f"control.{suffix}")
        return ["run", w.catalogue, w.network]

    @case(f"answer of a network as control of an adjustment, {suffix}")
    def _(w: World, suffix: str = suffix) -> list[Any]:
        answered(w, w.catalogue / f"control.{suffix}")
        return adjusting(w)


@case("one column of an answer left in control")
def _(w: World) -> list[Any]:
    table = pcsv.read_csv(answered(w, w.folder / "answer.csv")).drop_columns(["tile", "ce90", "le90"])
    pcsv.write_csv(table, w.folder / "few.csv")
    return ["control", "add", w.fused, w.folder / "few.csv"]


# --- imports ----------------------------------------------------------------------------------------------------------------------------


def imported(name: str, change: Callable[[World], Any]) -> None:
    """Enter a case in which the inputs of an import are changed."""

    def words(w: World) -> list[Any]:
        given = w.importing()
        change(w)
        return given

    case(name)(words)


simply("imported RPC without a list of coefficients", lambda w: w.rpc(lambda c: c.pop("SAMP_DEN_COEFF")))
simply("imported RPC with 19 coefficients", lambda w: w.rpc(lambda c: c["LINE_NUM_COEFF"].pop()))
simply("imported RPC with swapped axes", lambda w: w.rpc(lambda c: c.update(LAT_OFF=c["LONG_OFF"], LONG_OFF=c["LAT_OFF"])))
simply("imported RPC with a scale of zero", lambda w: w.rpc(lambda c: c.update(LONG_SCALE=0.0)))
imported("missing RPC", lambda w: (w.folder / "rpc" / f"{w.columns('images')['image_id'][0]}.json").unlink())
imported("RPC file that is none", lambda w: w.write(f"rpc/{w.columns('images')['image_id'][0]}.json", "mine"))
imported("missing column of an import", lambda w: w.replace("tracks.csv", "col", "column"))
imported("unknown image in a track", lambda w: w.replace("tracks.csv", "T000", "T999"))
imported(
    "ray twice in the tracks", lambda w: w.write("tracks.csv", (t := (w.folder / "tracks.csv").read_text()) + t.splitlines()[1] + "\n")
)
imported("no such file of tracks", lambda w: (w.folder / "tracks.csv").unlink())
imported("folder that holds something already", lambda w: shutil.copytree(w.catalogue, w.new))
imported("file in place of a new catalogue", lambda w: w.write("new", "mine"))


simply("ISIS network that is none", lambda w: w.isis("Object = ControlNetwork", "Object = Network"))
simply("no such ISIS network", lambda w: [*w.isis()[:2], w.folder / "nowhere.net", *w.isis()[3:]])
simply("ISIS network cut short", lambda w: w.isis("  End_Object\n\nEnd_Object\nEnd", ""))
simply("ISIS network that is not PVL in a line", lambda w: w.isis("PointType = Free", "PointType ="))
simply("ISIS network of an old version", lambda w: w.isis("Version = 5", "Version = 1"))
simply("control point of an ISIS network without covariance", lambda w: w.isis("AprioriCovarianceMatrix", "AprioriMatrix"))
simply("control point of an ISIS network without error", lambda w: w.isis("PointType = Constrained", "PointType = Fixed"))
simply("unknown image in an ISIS network", lambda w: w.isis("APOLLO15/METRIC/1971-07-31T14:01", "APOLLO16/METRIC/1972-04-21T14:01"))
simply(
    "scale of ISIS images that is not whole", lambda w: w.isd(focal2pixel_samples=[0.0, -140.0, 0.0], focal2pixel_lines=[0.0, 0.0, 140.0])
)
simply("ISD of a camera that is no frame camera", lambda w: w.isd(name_model="USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"))
simply("ISD of an unknown lens", lambda w: w.isd(name_sensor="WAC", optical_distortion={"radial": {"coefficients": [0.0, 1e-5, 0.0]}}))
simply("ISD without a position", lambda w: w.isd(instrument_position={}))


@case("binary ISIS network of an old version")
def _(w: World) -> list[Any]:
    words = w.isis()
    w.write("isis/network.pvl", binary(points(), version="2"))
    return words


@case("missing ISD")
def _(w: World) -> list[Any]:
    words = w.isis()
    (w.folder / "isis" / "image1.isd").unlink()
    return words


@case("point of an ISIS network twice in an image")
def _(w: World) -> list[Any]:
    return w.isis("APOLLO15/METRIC/1971-07-31T14:01", "APOLLO15/METRIC/1971-07-31T14:00")


@case("imported coordinate that is not a number")
def _(w: World) -> list[Any]:
    words = w.importing()
    lines = (w.folder / "tracks.csv").read_text().splitlines()
    track, image, _, row = lines[5].split(",")
    w.write("tracks.csv", "\n".join([*lines[:5], f"{track},{image},nan,{row}", *lines[6:]]))
    return words


@case("catalogue made on a full disk")
def _(w: World) -> list[Any]:
    words = w.importing()
    import_rpc(words[3], words[5], words[7], w.folder / "roomy")  # what is compiled is kept on disk: that it has room for
    shutil.rmtree(w.folder / "roomy")
    w.around = lambda: limited(1000)
    return words


@case("catalogue made in a folder that is read only")
def _(w: World) -> list[Any]:
    (w.folder / "closed").mkdir()
    w.around = lambda: read_only(w.folder / "closed")
    return ["simulate", "region", "--scale", 0.02, "--out", w.folder / "closed" / "catalogue"]


# --- the tests --------------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def origin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalogue, an empty network over it, and one that holds it; nobody writes here."""
    folder = tmp_path_factory.mktemp("origin")
    region = simulate_region(TINY)
    write_region(region, folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    for name in ("network", "fused"):
        create(str(folder / name), area_of(region), catalogue.metadata, 60.0, 20.0)
    run(catalogue, str(folder / "fused"), SerialExecutor())
    compile_kernels()  # what is compiled is also written, and could not be on a full disk
    return folder


@pytest.fixture
def world(tmp_path: Path, origin: Path) -> World:
    return World(tmp_path, origin)


def state(folder: Path) -> dict[str, tuple[bool, int, int]]:
    """Every file and folder below a folder, with size and time: what any writing would change."""
    return {
        str(path.relative_to(folder)): (path.is_dir(), 0 if path.is_dir() else path.stat().st_size, path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
    }


def test_the_page_and_the_cases_are_the_same() -> None:
    assert sorted(ROWS) == sorted(CASES)


@pytest.mark.parametrize("name", CASES)
def test_each_case(name: str, world: World, call: Call) -> None:
    words, row = CASES[name](world), ROWS[name]
    (refused if row.code == 2 else rejected_alone)(world, words, row, call)


# --- GNSS files, solutions, observations ------------------------------------------------------------------------------------------------

simply("GNSS file of another format", lambda w: ["import", "gnss", w.write("survey.txt", "G A B"), "--out", w.new])
simply("no such GNSS file", lambda w: ["import", "gnss", w.folder / "survey.msr", "--out", w.new])
simply("GNSS file cut short", lambda w: w.gnss(lines=dna_lines()[:5]))
simply("GNSS measurement of another type", lambda w: w.gnss("G A ", "S A "))
simply("GNSS positions that are not XYZ", lambda w: w.gnss("XYZ", "LLH"))
simply("GNSS scale by direction", lambda w: w.gnss("10.00      1.00", "10.00      1.50"))
simply("GNSS covariance with too few numbers", lambda w: w.gnss(lines=[line[:102] for line in dna_lines()]))
simply("GNSS positions of another epoch", lambda w: [*w.gnss(), "--epoch", "2021-01-01"])
simply("GNSS file whose measurements are all left out", lambda w: w.gnss(lines=dna_lines((MEASUREMENTS[1],))))


@case("GNSS covariance that is none")
def _(w: World) -> list[Any]:
    flat = simulated("G", (("A", "B"),), 1)
    flat.covariance[1] = flat.covariance[:, 1] = flat.covariance[0]
    return w.gnss(lines=dna_lines((flat,)))


def replacing_values(w: World, value: float, rows: int = 3) -> list[Any]:
    lines = [f"0,G,A,B,{axis},{value if value else v:.4f},{v:.4f}" for axis, v in zip("XYZ", MEASUREMENTS[0].values[0], strict=True)]
    table = w.write("values.csv", "\n".join(["cluster,type,from,to,component,file,new", *lines[:rows], ""]))
    return [*w.gnss(lines=dna_lines(MEASUREMENTS[:1])), "--values", table]


simply("values that are of another measurement", lambda w: replacing_values(w, 1.0))
simply("values that leave one out", lambda w: replacing_values(w, 0.0, rows=2))
simply("SINEX file cut short", lambda w: w.sinex("-SOLUTION/MATRIX_ESTIMATE L COVA\n%ENDSNX\n", ""))
simply("file that is not SINEX", lambda w: w.sinex("%=SNX", "%=BIA"))


@case("SINEX file without a matrix")
def _(w: World) -> list[Any]:
    words = w.sinex()
    for _ in ("begin", "end"):
        w.replace("solution.snx", "SOLUTION/MATRIX_ESTIMATE", "SOLUTION/MATRIX_OF_OURS")
    return words


simply("SINEX matrix that is no covariance", lambda w: w.sinex(" 5.00000000000000E-07", " 5.00000000000000E-01"))
simply("SINEX line with a word too many", lambda w: w.sinex(" 5.00000000000000E-07", " 5.0E-07 5.0E-07 5.0E-07 5.0E-07"))
simply("SINEX coordinates of an unknown station", lambda w: w.sinex(" S001  A 5", " S009  A 5"))
simply("SINEX coordinates at two epochs", lambda w: w.sinex("STAX   S001  A    1 17:298", "STAX   S001  A    1 16:298"))
simply("SINEX solution with a constraint that is not in the file", lambda w: w.sinex(code="0"))
simply("SINEX solution that its constraint alone holds", lambda w: w.sinex(a_priori=(np.zeros(6), 1e-6 * (np.eye(6) + 0.5))))
simply("SINEX solution of another epoch", lambda w: [*w.sinex(), "--epoch", "2020"])
simply("GNSS file as control with baselines in it", lambda w: ["import", "sinex", w.gnss()[2], "--out", w.folder / "control.parquet"])


@case("control made where something is")
def _(w: World) -> list[Any]:
    w.write("control.parquet", "mine")
    return w.sinex()


simply("control made as CSV", lambda w: [*w.sinex()[:4], w.folder / "control.csv"])
simply("observation of another kind", lambda w: w.observed(kind=["angle"]))
simply("position with an end", lambda w: w.observed(to=["B"]))
simply("baseline without an end", lambda w: w.observed(kind=["baseline"]))
simply("position in degrees", lambda w: w.observed(x=[100.0], y=[35.0], z=[900.0]))
simply("observation that is not a number", lambda w: w.observed(x=[float("nan")]))
simply("observation whose covariance is short", lambda w: w.observed(covariance_row=[[1.0] * 3]))
simply("observation without an error of its own", lambda w: w.observed(covariance_row=[[1.0] * 9]))
simply("cluster with the id of a block of images", lambda w: w.observed(cluster=[w.block()]))
simply("baseline into a factored network", lambda w: w.observed(kind=["baseline"], to=["B"]))


def measured_alone(w: World) -> Path:
    """A catalogue of GNSS measurements alone."""
    import_gnss(w.gnss()[2], w.new)
    return w.new


simply("tiles fitted to a catalogue without images", lambda w: ["create", w.folder / "tiled", "--fit", measured_alone(w)])
simply(
    "another frame than that of the fitted catalogue", lambda w: ["create", w.folder / "tiled", "--fit", w.catalogue, "--frame", "ITRF2014"]
)
simply("plan of a catalogue without images", lambda w: ["plan", measured_alone(w), w.network])
simply("plan of a run into a dense network", lambda w: ["plan", w.catalogue, w.dense()])


@case("control of another frame than the network's")
def _(w: World) -> list[Any]:
    import_solution(w.sinex()[2], w.folder / "control.parquet", frame="ITRF2014")
    return ["control", "add", w.network, w.folder / "control.parquet"]


def refused(world: World, words: list[Any], row: Row, call: Call) -> None:
    """Exit code 2, one line on standard error, and nothing written."""
    network = world.folder / "network"
    before, known = state(world.folder), len(versions(str(network))) if network.exists() else 0
    with world.around():
        code, out, err = call(*words)
        at = 2 if words[0] in ("import", "simulate", "control") else 1
        as_json = call(*words[:at], "--json", *words[at:])
    assert (code, out) == (2, "")
    assert err.startswith("submin: ") and err.endswith("\n") and err.count("\n") == 1
    message = err.removeprefix("submin: ").removesuffix("\n")
    assert row.says(message), message
    assert as_json[0] == 2
    assert row.says(json.loads(as_json[1])["error"])
    if world.leaves_chunks:
        assert len(versions(str(network))) == known
    else:
        assert state(world.folder) == before


def rejected_alone(world: World, words: list[Any], row: Row, call: Call) -> None:
    """Exit code 1, the block named with its reason in JSON and in text, and all other blocks in the network."""
    network = str(words[2])
    blocks = set(Catalogue.open(world.catalogue).block_ids)
    code, out, err = call(*words, "--json")
    assert (code, err) == (1, "")
    values = json.loads(out)
    assert [r["block_id"] for r in values["blocks_rejected"]] == list(world.rejected)
    for rejected in values["blocks_rejected"]:
        assert row.says(rejected["reason"]), rejected["reason"]
    ledger = Snapshot.open(network).ledger(["block_id", "status"])
    fused = {str(b) for b, s in zip(ledger["block_id"], ledger["status"], strict=True) if s == "fused"}
    assert blocks - set(world.rejected) <= fused
    assert values["blocks_fused"] + values["blocks_skipped"] == len(blocks) - len(world.rejected)

    code, out, err = call(*words)
    assert (code, err) == (1, "")
    lines = [line for line in out.splitlines() if line.startswith("rejected block ")]
    assert len(lines) == len(world.rejected)
    for line, block in zip(lines, world.rejected, strict=True):
        assert row.says(line.removeprefix(f"rejected block {block}: ")), line
    known = len(versions(network))
    assert call(*words)[1].splitlines()[-len(lines) :] == lines
    assert len(versions(network)) == known  # the same again writes nothing


def not_finite(group: zarr.Group, path: str = "") -> list[str]:
    """Arrays of a store that hold something that is no number."""
    found = []
    for name, member in group.members():
        if isinstance(member, zarr.Group):
            found += not_finite(member, f"{path}/{name}")
        elif isinstance(member, zarr.Array) and member.dtype.kind == "f" and not np.isfinite(np.asarray(member[...])).all():
            found.append(f"{path}/{name}")
    return found


@pytest.mark.parametrize("apart", [0.0, 1e-7, 1e-3])
@pytest.mark.parametrize("alone", [True, False])
def test_two_images_of_one_viewpoint_leave_no_nonsense(apart: float, alone: bool, world: World) -> None:
    """They are no error: their points wait for an image from another direction, or are as uncertain as they are."""
    block = world.block(0)
    columns = world.columns("images")
    first, second, *others = [i for i, b in zip(columns["image_id"], columns["block_id"], strict=True) if b == block]
    camera = json.loads(columns["camera"][columns["image_id"].index(first)])
    camera["LINE_NUM_COEFF"][3] += apart
    columns["camera"][columns["image_id"].index(second)] = json.dumps(camera)
    world.put("images", columns)
    rays = world.columns("measurements")
    seen = {p: (s, t) for p, i, s, t in zip(rays["point_id"], rays["image_id"], rays["sample"], rays["line"], strict=True) if i == first}
    for k, (point, image) in enumerate(zip(rays["point_id"], rays["image_id"], strict=True)):
        if image == second and point in seen:
            rays["sample"][k], rays["line"][k] = seen[point]
    world.put("measurements", rays)
    world.rows("measurements", lambda row: row["image_id"] not in others and (row["image_id"] != second or row["point_id"] in seen))
    world.rows("images", lambda row: row["image_id"] not in others)
    if alone:
        for stem in ("images", "measurements"):
            world.rows(stem, lambda row: row["block_id"] == block)
    result = run(Catalogue.open(world.catalogue), str(world.network), SerialExecutor())
    assert result.rejected == () and result.unsettled_tiles == ()
    repository = icechunk.Repository.open(icechunk.local_filesystem_storage(str(world.network)))
    assert not_finite(zarr.open_group(repository.readonly_session("main").store, mode="r")) == []
    control = submin.open(world.network).query(bbox=(99.0, 34.0, 101.0, 36.0), policy="rigorous")
    assert np.isfinite(control.geocentric).all() and np.isfinite(control.covariance).all()
    if alone:
        assert len(control) == 0 or apart > 0.0
        assert control.le90.min(initial=np.inf) > 10.0


def test_a_billion_tiles_are_refused_at_once(world: World, call: Call) -> None:
    words = CASES["a billion tiles"](world)
    call(*words)
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert call(*words)[0] == 2
    assert time.monotonic() - started < 1.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10_000  # kB


@contextmanager
def disk(folder: Path) -> Iterator[Callable[[int], AbstractContextManager[None]]]:
    """A folder on a small file system of its own, and what fills it up to some bytes.

    Where none can be mounted the size of files is limited instead: writes fail in the middle of a commit all the same.
    """
    folder.mkdir()

    @contextmanager
    def full(room: int) -> Iterator[None]:
        ballast = folder / "ballast"
        ballast.write_bytes(bytes(shutil.disk_usage(folder).free - room))
        try:
            yield
        finally:
            ballast.unlink()

    with mounted("-t", "tmpfs", "-o", "size=4m", "tmpfs", folder) as done:
        yield full if done else limited


@pytest.mark.parametrize("how", ["full file system", "limit of file size"])
def test_a_full_disk_leaves_the_last_version_and_the_same_command_continues(how: str, world: World, origin: Path, call: Call) -> None:
    catalogue, first = world.catalogue, Catalogue.open(world.catalogue).block_ids[:2]
    part = shutil.copytree(catalogue, world.folder / "part")
    for stem in ("images", "measurements"):
        table = pq.read_table(part / f"{stem}.parquet")
        pq.write_table(table.filter(pc.is_in(table["block_id"], pa.array(first))), part / f"{stem}.parquet")
    with disk(world.folder / "disk") if how == "full file system" else nullcontext(limited) as full:
        network = (world.folder / "disk" if how == "full file system" else world.folder) / "network"
        shutil.copytree(origin / "network", network)
        assert call("run", part, network, "--no-reconcile")[0] == 0
        query = ("query", network, *BOX, "--policy", "rigorous", "--out", world.folder / "control.npz")
        assert call(*query)[0] == 0
        before = np.load(world.folder / "control.npz")["covariance"]
        for room in (0, 2_000, 20_000):  # the first write fails, or a later one
            with full(room):
                code, _, err = call("run", catalogue, network, "--no-reconcile")
            assert (code, err.count("\n")) == (2, 1)
            assert ROWS["disk full in the middle of a commit"].says(err.strip().removeprefix("submin: "))
            assert [v.name for v in versions(str(network))] == ["v1", "v0"]
            assert call(*query)[0] == 0
            np.testing.assert_array_equal(np.load(world.folder / "control.npz")["covariance"], before)
        code, out, _ = call("run", catalogue, network, "--no-reconcile", "--json")
        assert code == 0
        assert (json.loads(out)["version"], json.loads(out)["blocks_fused"]) == ("v2", BLOCKS - 2)
        assert accepted_rays(network) == accepted_rays(origin / "fused")
