"""Real footprints of the shared data: Landsat scenes (WRS-2), and scenes of Maxar's satellites over Morocco."""

from __future__ import annotations

import datetime
import os
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from benchmarks.footprint_layout import TRACK_AZIMUTH, Footprint, Look
from submin.formats.outlines import landsat_outlines, satellite_scenes
from submin.simulation.footprints import EVENT, LANDSAT_CYCLE, LANDSAT_STEP, PASS_SECONDS

Array = NDArray[np.float64]

DATA = Path(os.environ.get("SUBMIN_DATA", Path(__file__).parents[2] / "shared" / "data"))
LANDSAT_ORBIT_M, WORLDVIEW_ORBIT_M = 705e3, 770e3
LANDSAT_ROW_SECONDS, LANDSAT_FIRST = 23.9, datetime.datetime(2012, 2, 1, 0, 30, tzinfo=datetime.UTC)
THREE_LINES = (Look("FWD", 22.0, TRACK_AZIMUTH + 180.0), Look("NAD", 0.0, 0.0), Look("BWD", 22.0, TRACK_AZIMUTH))
THREE_LINE_PIXEL_M = 2.5


def three_line_scenes(area: BaseGeometry, data: Path = DATA) -> list[Footprint]:
    """A three-line camera over the Landsat scenes whose middle lies in an area: a scene is a block, a path a pass."""
    scenes = landsat_outlines(data / "footprints_world" / "wrs2_descending.csv.gz")
    return [
        Footprint(
            scene_id=f"L{s.path:03d}-{s.row:03d}",
            block_id=f"L{s.path:03d}-{s.row:03d}",
            pass_id=f"path-{s.path:03d}",
            acquired=LANDSAT_FIRST + datetime.timedelta(days=s.path * LANDSAT_STEP % LANDSAT_CYCLE, seconds=LANDSAT_ROW_SECONDS * s.row),
            outline=ring(s.outline),
            looks=THREE_LINES,
            pixel_m=THREE_LINE_PIXEL_M,
            orbit_m=LANDSAT_ORBIT_M,
        )
        for s in scenes
        if area.contains(s.outline.centroid)
    ]


def morocco_scenes(data: Path = DATA) -> list[Footprint]:
    """The WorldView and GeoEye scenes of Morocco as they were taken, one image each; those minutes apart are one pass and one block.

    The azimuth of the view is taken as that in which the satellite stands.
    """
    every = satellite_scenes(data / "footprints_world" / "maxar_open_data_scenes.jsonl.gz")
    found = list[Footprint]()
    before, pass_id = None, ""
    for s in sorted((s for s in every if s.event == EVENT), key=lambda s: (s.platform, s.time, s.scene_id)):
        if before is None or before.platform != s.platform or (s.time - before.time).total_seconds() > PASS_SECONDS:
            pass_id = f"{s.platform} {s.time:%Y-%m-%dT%H:%M:%SZ}"
        before = s
        found.append(
            Footprint(
                scene_id=s.scene_id,
                block_id=pass_id,
                pass_id=pass_id,
                acquired=s.time,
                outline=ring(s.outline),
                looks=(Look("", s.off_nadir, s.azimuth),),
                pixel_m=s.pixel,
                orbit_m=WORLDVIEW_ORBIT_M,
            )
        )
    return found


def ring(outline: Polygon) -> Array:
    """Corners (k, 2) of the outer ring of an outline."""
    return np.asarray(shapely.get_coordinates(shapely.get_exterior_ring(outline)))
