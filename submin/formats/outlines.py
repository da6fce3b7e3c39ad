"""Outlines of countries and of satellite scenes, as public collections give them: a shapefile of polygons, tables of rings."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
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
