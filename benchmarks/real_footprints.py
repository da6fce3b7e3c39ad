"""Real footprints of the shared data: Landsat scenes (WRS-2) over Australia, and scenes of Maxar's satellites over Morocco."""

from __future__ import annotations

import csv
import datetime
import gzip
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from benchmarks.footprint_layout import TRACK_AZIMUTH, Footprint, Look

Array = NDArray[np.float64]

DATA = Path(os.environ.get("SUBMIN_DATA", Path(__file__).parents[2] / "shared" / "data"))
LANDSAT_ORBIT_M, WORLDVIEW_ORBIT_M = 705e3, 770e3
LANDSAT_ROW_SECONDS, LANDSAT_FIRST = 23.9, datetime.datetime(2012, 2, 1, 0, 30, tzinfo=datetime.UTC)
THREE_LINES = (Look("FWD", 22.0, TRACK_AZIMUTH + 180.0), Look("NAD", 0.0, 0.0), Look("BWD", 22.0, TRACK_AZIMUTH))
THREE_LINE_PIXEL_M = 2.5
SAME_PASS_SECONDS = 180.0


class LandsatScene(NamedTuple):
    """A scene of the Worldwide Reference System, descending: path, row, outline (k, 2) in longitude and latitude, degrees."""

    path: int
    row: int
    outline: Array


def landsat_scenes(data: Path = DATA) -> Iterator[LandsatScene]:
    """All WRS-2 scenes in one part."""
    with gzip.open(data / "footprints_world" / "wrs2_descending.csv.gz", "rt", encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            if "|" not in row["ring_lonlat"]:
                outline = np.array([point.split() for point in row["ring_lonlat"].split(";")], dtype=np.float64)
                yield LandsatScene(int(row["path"]), int(row["row"]), outline)


def three_line_scenes(area: BaseGeometry, data: Path = DATA) -> list[Footprint]:
    """A three-line camera over the Landsat scenes whose middle lies in an area: a scene is a block, a path a pass."""
    scenes = [s for s in landsat_scenes(data) if area.contains(shapely.Polygon(s.outline).centroid)]
    return [
        Footprint(
            scene_id=f"L{s.path:03d}-{s.row:03d}",
            block_id=f"L{s.path:03d}-{s.row:03d}",
            pass_id=f"path-{s.path:03d}",
            acquired=LANDSAT_FIRST + datetime.timedelta(days=s.path * 7 % 16, seconds=LANDSAT_ROW_SECONDS * s.row),
            outline=s.outline,
            looks=THREE_LINES,
            pixel_m=THREE_LINE_PIXEL_M,
            orbit_m=LANDSAT_ORBIT_M,
        )
        for s in scenes
    ]  # fmt: skip


def morocco_scenes(data: Path = DATA) -> list[Footprint]:
    """The WorldView and GeoEye scenes of Morocco as they were taken, one image each; those minutes apart are one pass and one block.

    The azimuth of the view is taken as that in which the satellite stands.
    """
    with gzip.open(data / "footprints_world" / "maxar_open_data_scenes.jsonl.gz", "rt", encoding="utf-8") as stream:
        rows = [row for row in map(json.loads, stream) if row["event"].startswith("Morocco")]
    rows.sort(key=lambda row: (row["platform"], row["datetime"], row["catalog_id"]))
    scenes, last, pass_id = list[Footprint](), None, ""
    for row in rows:
        time = datetime.datetime.fromisoformat(row["datetime"])
        if last is None or row["platform"] != last[0] or (time - last[1]).total_seconds() > SAME_PASS_SECONDS:
            pass_id = f"{row['platform']} {row['datetime']}"
        last = (row["platform"], time)
        scenes.append(
            Footprint(
                scene_id=row["catalog_id"],
                block_id=pass_id,
                pass_id=pass_id,
                acquired=time,
                outline=largest_part(row["geometry"]),
                looks=(Look("", row["off_nadir_deg"], row["view_azimuth_deg"]),),
                pixel_m=row["gsd_m"],
                orbit_m=WORLDVIEW_ORBIT_M,
            )
        )
    return scenes


def largest_part(geometry: Mapping[str, Any]) -> Array:
    """Outline (k, 2) of a GeoJSON polygon, or of the largest part of one in parts."""
    parts = shapely.get_parts(shapely.from_geojson(json.dumps(geometry)))
    return np.asarray(shapely.get_coordinates(shapely.get_exterior_ring(parts[np.argmax(shapely.area(parts))])))
