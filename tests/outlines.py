"""Natural Earth outlines and Landsat footprints of the shared data, as tests need them."""

from __future__ import annotations

import csv
import gzip
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from real_data import FOLDER
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

WORLD = FOLDER / "footprints_world"


def continents() -> dict[str, BaseGeometry]:
    """Land of each continent, longitude and latitude in degrees, in parts that end at the antimeridian."""
    place = WORLD / "naturalearth_lowres" / "naturalearth_lowres"
    names, shapes = _dbf(place.with_suffix(".dbf"), "continent"), _shp(place.with_suffix(".shp"))
    return {name: shapely.union_all([s for s, n in zip(shapes, names, strict=True) if n == name]) for name in sorted(set(names))}


def _shp(path: Path) -> list[BaseGeometry]:
    """Polygons of a shapefile (ESRI Shapefile Technical Description, 1998): big-endian record headers, little-endian content."""
    content, at, shapes = path.read_bytes(), 100, list[BaseGeometry]()
    while at < len(content):
        (words,) = struct.unpack_from(">i", content, at + 4)
        parts, points = struct.unpack_from("<2i", content, at + 44)
        first = [*struct.unpack_from(f"<{parts}i", content, at + 52), points]
        lonlat = np.frombuffer(content, "<f8", 2 * points, at + 52 + 4 * parts).reshape(-1, 2)
        # rings of a record do not overlap but where one is a hole
        rings = [Polygon(lonlat[a:b]) for a, b in pairwise(first)]
        shape: BaseGeometry = MultiPolygon()
        for ring in rings:
            shape = shapely.symmetric_difference(shape, ring)
        shapes.append(shape)
        at += 8 + 2 * words
    return shapes


def _dbf(path: Path, name: str) -> list[str]:
    """A column of texts of a dBASE table."""
    content = path.read_bytes()
    count, header, length = struct.unpack_from("<ihh", content, 4)
    offset = 1
    for at in range(32, header - 32, 32):
        size = content[at + 16]
        if content[at : at + 11].split(b"\0")[0].decode() == name:
            rows = [header + k * length + offset for k in range(count)]
            return [content[row : row + size].decode("utf-8").strip() for row in rows]
        offset += size
    raise KeyError(name)


def landsat_rings() -> list[NDArray[np.float64]]:
    """Outlines (n, 2) of the Landsat WRS-2 scenes, those in one part; longitude and latitude in degrees."""
    with gzip.open(WORLD / "wrs2_descending.csv.gz", "rt", encoding="utf-8") as stream:
        rings = [row["ring_lonlat"] for row in csv.DictReader(stream)]
    return [np.array([point.split() for point in ring.split(";")], dtype=np.float64) for ring in rings if "|" not in ring]
