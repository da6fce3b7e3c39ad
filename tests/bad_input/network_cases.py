"""Cases of the command line, of the place of a network, and of the area it covers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import icechunk
import shapely
import zarr

from bad_input.disks import limited, read_only
from bad_input.world import BOX, World, case, simply
from orchestration.create import create
from submin.storage import spilled
from submin.storage.catalogue import Catalogue

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


@case("more cameras than stay in memory, and no room for the others")
def _(w: World) -> list[Any]:
    @contextmanager
    def around() -> Iterator[None]:
        with mock.patch.object(spilled, "MOST_IN_MEMORY", 0), limited(1000):
            yield

    w.around = around
    return w.run()


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
