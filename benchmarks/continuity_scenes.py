"""What `benchmarks.continuity` runs on: two sets of real footprints with simulated images, and a real block of WorldView-3."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from benchmarks.border import borders
from benchmarks.footprint_layout import Footprint, footprint_layout
from benchmarks.real_footprints import DATA, morocco_scenes, three_line_scenes
from submin.adjustment.priors import APriori
from submin.geodesy import geodetic_to_geocentric
from submin.simulation.scene import realise
from submin.storage.catalogue import Catalogue
from submin.storage.rpc_import import import_rpc
from submin.storage.simulated import write_scene
from submin.tiling.area import cover_area
from submin.tiling.cover import Cover

Array = NDArray[np.float64]

SEED = 0
CLUSTER_KM = 4.0
"""Half the side of a square in which the points of a cluster lie: most pairs in it are nearer than 10 km."""

ZY3_LIKE = APriori(bias_px=6.0, drift_px=1.0, common_to_pass=0.5)
"""15 m an axis at 2.5 m a pixel, half of its variance common to a pass."""
WORLDVIEW_LIKE = APriori(bias_px=1.0, drift_px=0.2, common_to_pass=0.5)
"""2.5 m an axis at 2.5 m a pixel: 5 urad from 500 km; half common to a pass."""
WORLDVIEW = APriori(bias_px=5.0, drift_px=1.0, common_to_pass=0.5)
"""2.5 m an axis at 0.5 m a pixel."""


@dataclass(frozen=True)
class Scene:
    """A block to be cut into tiles.

    Attributes
    ----------
    name : as rows have it
    width_km : of a footprint, by which overlaps are counted; core_km : side of a core
    overlaps : in widths
    reach_km, ends_km : points are asked for so far from a border, and not so near to its ends, where a third tile may hold them
    near_km : pairs of points are near below it
    catalogue : makes the catalogue in a folder, at a part of the full area
    area : that the tiles cover, at the same part
    """

    name: str
    width_km: float
    core_km: float
    overlaps: tuple[float, ...]
    reach_km: float
    ends_km: float
    near_km: float
    catalogue: Callable[[Path, float], Catalogue]
    area: Callable[[float], BaseGeometry]


def around(box: tuple[float, float, float, float], scale: float) -> BaseGeometry:
    """A box in degrees, shrunk about its middle to a part of its area."""
    west, south, east, north = box
    half = 0.5 * np.sqrt(scale) * np.array([east - west, north - south])
    return shapely.box(*(np.array([west + east, south + north]) / 2.0 - half), *(np.array([west + east, south + north]) / 2.0 + half))


def clusters(cover: Cover, spacing: float, points: int, on_borders: float, rng: np.random.Generator) -> Array:
    """Longitudes and latitudes (n, 2) of clusters of points: one in each square of this side, one every so many metres of each border."""
    corner = np.concatenate([cover.core_outline(tile) for tile in cover.tiles()])
    low, high = corner.min(axis=0), corner.max(axis=0)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, spacing) for a, b in zip(low, high, strict=True))), axis=-1).reshape(-1, 2)
    centre = [grid + rng.uniform(0.0, spacing, grid.shape)]
    for border in borders(cover) if on_borders else ():
        along = np.arange(border.low, border.high, on_borders)
        place = np.stack([np.full(len(along), border.at), along], axis=1)[:, :: 1 - 2 * border.axis]
        centre.append(place + rng.uniform(-5e2, 5e2, place.shape) * CLUSTER_KM)
    spread = rng.uniform(-1e3, 1e3, (sum(map(len, centre)), points, 2)) * CLUSTER_KM * (points > 1)
    at = (np.concatenate(centre)[:, None] + spread).reshape(-1, 2)
    return np.stack(cover.geographic(at[:, 0], at[:, 1]), axis=1)


def _australia(name: str, a_priori: APriori) -> Scene:
    def area(scale: float) -> BaseGeometry:
        return around((125.0, -28.5, 140.0, -21.0), scale)

    def catalogue(folder: Path, scale: float) -> Catalogue:
        return _simulated(name, three_line_scenes(area(scale)), a_priori, folder, cover_area(area(scale), 555e3, 0.0), 50e3, 4, 20e3)

    return Scene(name, 185.0, 555.0, (0.0, 0.5, 1.0, 2.0), 220.0, 185.0, 10.0, catalogue, area)


def _morocco(name: str, a_priori: APriori) -> Scene:
    def area(scale: float) -> BaseGeometry:
        return around((-8.95, 30.75, -7.6, 31.8), scale)

    def catalogue(folder: Path, scale: float) -> Catalogue:
        scenes = [s for s in morocco_scenes() if area(scale).intersects(shapely.Polygon(s.outline).centroid)]
        return _simulated(name, scenes, a_priori, folder, cover_area(area(scale), 48e3, 0.0), 2.5e3, 1, 0.0)

    return Scene(name, 16.0, 48.0, (0.0, 0.5, 1.0, 2.0), 20.0, 16.0, 10.0, catalogue, area)


def _simulated(
    name: str, footprints: list[Footprint], a_priori: APriori, folder: Path, cover: Cover, spacing: float, points: int, on_borders: float
) -> Catalogue:
    places = clusters(cover, spacing, points, on_borders, np.random.default_rng(SEED))
    write_scene(realise(footprint_layout(name, footprints, a_priori, places), SEED), folder)
    return Catalogue.open(folder)


def _jacksonville(folder: Path, scale: float) -> Catalogue:
    source = DATA / "wv3_jax068"
    import_rpc(source / "images.csv", source / "rpc_raw", source / "tracks.csv.gz", folder, blocks="pass")
    return Catalogue.open(folder)


JACKSONVILLE = "Jacksonville, real"
ZY3_AUSTRALIA = "Australia, ZY-3-like prior"
SCENES = (
    _australia(ZY3_AUSTRALIA, ZY3_LIKE),
    _australia("Australia, WorldView-like prior", WORLDVIEW_LIKE),
    _morocco("Morocco, WorldView-like prior", WORLDVIEW),
    Scene(
        JACKSONVILLE, 0.1, 0.1, (0.0, 0.25, 0.5), 0.035, 0.025, 0.005, _jacksonville,
        lambda scale: shapely.box(-81.6655, 30.3475, -81.6620, 30.3502),
    ),
)  # fmt: skip
"""Jacksonville is one footprint wide in all: its overlaps are parts of a core of 100 m, and near is 5 m."""


def truth(catalogue: Catalogue) -> tuple[NDArray[np.str_], Array] | None:
    """Ids, ascending, and true geocentric positions of all points of a simulated catalogue; None for a real one."""
    table = catalogue.points("truth")
    if table is None:
        return None
    order = np.argsort(table.point_ids)
    return table.point_ids[order], geodetic_to_geocentric(table.geodetic[order], catalogue.metadata.ellipsoid)
