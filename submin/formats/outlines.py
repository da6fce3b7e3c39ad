"""Outlines of countries and of satellite scenes, as public collections give them: a shapefile of polygons, tables of rings."""

from __future__ import annotations

import csv
import gzip
import json
import struct
import zlib
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
import shapely.geometry
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from submin.errors import InputError


def named_polygons(shapefile: Path, column: str) -> dict[str, BaseGeometry]:
    """Polygons of a shapefile by the texts of a column, those of one text together; longitude and latitude in degrees.

    Parameters
    ----------
    shapefile : the ``.shp`` file; its ``.dbf`` lies beside it

    Raises
    ------
    InputError
        When a file cannot be read, or has no such column.
    """
    try:
        names, shapes = _dbf(shapefile.with_suffix(".dbf"), column), _shp(shapefile.with_suffix(".shp"))
    except (OSError, struct.error, UnicodeError, LookupError) as error:
        raise InputError(f"{shapefile}: cannot be read as a shapefile ({error}); expected polygons, and a .dbf file beside it") from None
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
    content, page = path.read_bytes(), path.with_suffix(".cpg")
    encoding = page.read_text(encoding="ascii").strip() if page.exists() else "utf-8"
    count, header, length = struct.unpack_from("<ihh", content, 4)
    offset, names = 1, list[str]()
    for at in range(32, header - 32, 32):
        size = content[at + 16]
        names.append(content[at : at + 11].split(b"\0")[0].decode())
        if names[-1] == name:
            rows = [header + k * length + offset for k in range(count)]
            return [content[row : row + size].decode(encoding).strip() for row in rows]
        offset += size
    raise InputError(f"{path}: has no column {name!r}; expected one of {', '.join(names)}")


@dataclass(frozen=True)
class LandsatOutline:
    """Outline of a Landsat scene (Worldwide Reference System 2), longitude and latitude in degrees."""

    path: int
    row: int
    outline: Polygon


@dataclass(frozen=True)
class SatelliteScene:
    """A real scene, as a public list describes it.

    Attributes
    ----------
    scene_id, event, platform : names; time : of acquisition, UTC
    pixel : on the ground, metres
    off_nadir, azimuth : of the line of sight, degrees
    outline : longitude and latitude in degrees, of its largest part
    """

    scene_id: str
    event: str
    platform: str
    time: datetime
    pixel: float
    off_nadir: float
    azimuth: float
    outline: Polygon


def landsat_outlines(table: Path) -> list[LandsatOutline]:
    """Outlines of a table (``.csv.gz``) with ``path``, ``row``, ``ring_lonlat``; scenes on the antimeridian, in two parts, are left out.

    Raises
    ------
    InputError
        When the table cannot be read.
    """
    try:
        with gzip.open(table, "rt", encoding="utf-8") as stream:
            return [
                LandsatOutline(
                    int(r["path"]), int(r["row"]), Polygon([[float(v) for v in at.split()] for at in r["ring_lonlat"].split(";")])
                )
                for r in csv.DictReader(stream)
                if "|" not in r["ring_lonlat"]
            ]
    except (OSError, EOFError, zlib.error, ValueError, KeyError) as error:
        raise InputError(f"{table}: cannot be read ({error!r}); expected columns path, row, ring_lonlat in .csv.gz") from None


def satellite_scenes(table: Path) -> list[SatelliteScene]:
    """Scenes of a list of JSON objects, one a line (``.jsonl.gz``).

    Raises
    ------
    InputError
        When the list cannot be read.
    """
    scenes = []
    try:
        with gzip.open(table, "rt", encoding="utf-8") as stream:
            for line in stream:
                r = json.loads(line)
                outline = max(getattr(shape := shapely.geometry.shape(r["geometry"]), "geoms", [shape]), key=lambda part: float(part.area))
                scenes.append(
                    SatelliteScene(
                        r["catalog_id"], r["event"], r["platform"], datetime.fromisoformat(r["datetime"]), float(r["gsd_m"]),
                        float(r["off_nadir_deg"]), float(r["view_azimuth_deg"]), outline,
                    )
                )  # fmt: skip
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{table}: cannot be read ({error!r}); expected a JSON object a line in .jsonl.gz") from None
    return scenes
