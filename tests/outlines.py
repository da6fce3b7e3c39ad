"""Natural Earth outlines and Landsat footprints of the shared data, as tests need them."""

from __future__ import annotations

import csv
import gzip

import numpy as np
from numpy.typing import NDArray
from real_data import FOLDER
from shapely.geometry.base import BaseGeometry

from submin.formats.outlines import named_polygons

WORLD = FOLDER / "footprints_world"


def continents() -> dict[str, BaseGeometry]:
    """Land of each continent, longitude and latitude in degrees, in parts that end at the antimeridian."""
    return named_polygons(WORLD / "naturalearth_lowres" / "naturalearth_lowres.shp", "continent")


def landsat_rings() -> list[NDArray[np.float64]]:
    """Outlines (n, 2) of the Landsat WRS-2 scenes, those in one part; longitude and latitude in degrees."""
    with gzip.open(WORLD / "wrs2_descending.csv.gz", "rt", encoding="utf-8") as stream:
        rings = [row["ring_lonlat"] for row in csv.DictReader(stream)]
    return [np.array([point.split() for point in ring.split(";")], dtype=np.float64) for ring in rings if "|" not in ring]
