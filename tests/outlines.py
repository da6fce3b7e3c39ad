"""Natural Earth outlines and Landsat footprints of the shared data, as tests need them."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from real_data import FOLDER
from shapely.geometry.base import BaseGeometry

from submin.formats.outlines import landsat_outlines, named_polygons

WORLD = FOLDER / "footprints_world"


def continents() -> dict[str, BaseGeometry]:
    """Land of each continent, longitude and latitude in degrees, in parts that end at the antimeridian."""
    return named_polygons(WORLD / "naturalearth_lowres" / "naturalearth_lowres.shp", "continent")


def landsat_rings() -> list[NDArray[np.float64]]:
    """Outlines (n, 2) of the Landsat WRS-2 scenes, those in one part; longitude and latitude in degrees."""
    return [np.asarray(shapely.get_coordinates(scene.outline)) for scene in landsat_outlines(WORLD / "wrs2_descending.csv.gz")]
