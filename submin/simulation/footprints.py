"""Simulated images of real footprints: where satellites have looked, with measurements and errors that are known.

An image's format is the smallest rectangle along and across its track that holds the real outline; it shows what lies in the outline (the
rest is margin, as in a product), and its footprint is that outline. Cameras are linear arrays over the middle of their scene that look
forward or backward, never aside: of a real line of sight the part along the track is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.formats.outlines import LandsatOutline, SatelliteScene
from submin.geodesy import geodetic_to_geocentric, local_axes
from submin.simulation.campaign import FIRST_PASS, MEAN_RADIUS_KM, Campaign, CampaignDesign, Scene
from submin.simulation.linear_array import View
from submin.simulation.point_grid import KM_OF_DEGREE, PointGrid

Array = NDArray[np.float64]
Ids = NDArray[np.str_]

REGIONS = ("australia", "morocco")
EVENT = "Morocco-Earthquake-Sept-2023"
LANDSAT_VIEWS = (View("FWD", 8.0, 15.0), View("BWD", -8.0, 15.0))
"""The real instrument looks down, and nearly every point would have one ray; so the simulated one looks 8 degrees to and fro."""
LANDSAT_CYCLE, LANDSAT_STEP, SECONDS_OF_ROW = 16, 7, 24.0
"""A path comes every 16 days, the path west of it 7 days later; from row to row it takes some 24 s."""
LEAST_FIELDS = 8.0
"""Of the point grid, that a scene shows. 385 scenes of Landsat touch Australia, some by a corner; a few of Morocco show 20 km2."""
PASS_SECONDS = 180.0
CHECK_PART, LEAST_CHECK_POINTS = 0.01, 100
"""Check points, as a part of the fields of the point grid in the outlines."""


@dataclass(frozen=True)
class _Look:
    """Numbers of a region: position sigma of an image (m), spacing of points (km), relief (m), orbit (km)."""

    sigma: float
    spacing_km: float
    relief_m: float
    orbit_km: float
    platform: str


_AUSTRALIA = _Look(12.0, 12.0, 800.0, 705.0, "LANDSAT-SIMULATED")
_MOROCCO = _Look(3.0, 1.5, 3000.0, 617.0, "WORLDVIEW-SIMULATED")


def australia(scenes: Sequence[LandsatOutline], land: BaseGeometry, scale: float = 1.0, seed: int = 0, error: float = 0.5) -> Campaign:
    """Stereo pairs with the outlines of Landsat scenes that show Australia; a pass is a path, a block a scene.

    Parameters
    ----------
    land : where tie points are, longitude and latitude in degrees
    scale : part of the scenes, those nearest to the middle
    error : part of the variance of an image's shift that its pass has in common
    """
    shapely.prepare(land)
    chosen = [scene for scene in scenes if _fields(land, scene.outline, _AUSTRALIA.spacing_km) > LEAST_FIELDS]
    made = [
        _scene(
            f"P{s.path:03d}R{s.row:03d}", f"path-{s.path:03d}", s.outline, lambda _heading: LANDSAT_VIEWS,
            float(LANDSAT_STEP * -s.path % LANDSAT_CYCLE) + SECONDS_OF_ROW * s.row / 86400.0,
        )
        for s in sorted(chosen, key=lambda s: (s.path, s.row))
    ]  # fmt: skip
    return _campaign("Australia", _AUSTRALIA, made, land, scale, seed, error)


def morocco(scenes: Sequence[SatelliteScene], scale: float = 1.0, seed: int = 0, error: float = 0.5) -> Campaign:
    """One image of each scene after the 2023 earthquake in Morocco, each a block; those of one satellite within minutes are a pass.

    Parameters are those of `australia`; tie points are wherever a scene is.
    """
    shown = [s for s in scenes if s.event == EVENT and _fields(s.outline, s.outline, _MOROCCO.spacing_km) > LEAST_FIELDS]
    chosen = sorted(shown, key=lambda s: (s.platform, s.time, s.scene_id))
    made, pass_id = [], ""
    for k, s in enumerate(chosen):
        before = chosen[k - 1] if k else None
        if before is None or before.platform != s.platform or (s.time - before.time).total_seconds() > PASS_SECONDS:
            pass_id = f"{s.platform}-{s.time:%Y%m%dT%H%M%S}"
        made.append(_scene(s.scene_id, pass_id, s.outline, _line_of_sight(s), (s.time - FIRST_PASS).total_seconds() / 86400.0))
    ground = shapely.union_all([s.outline.buffer(0.0) for s in chosen]).simplify(1e-3)
    return _campaign("Morocco", _MOROCCO, made, ground, scale, seed, error)


def _line_of_sight(scene: SatelliteScene) -> Callable[[float], tuple[View, ...]]:
    def views(heading: float) -> tuple[View, ...]:
        along = np.cos(np.radians(scene.azimuth - heading))
        pitch = np.degrees(np.arctan(np.tan(np.radians(scene.off_nadir)) * along))
        return (View("PAN", float(pitch), scene.pixel),)

    return views


def _campaign(
    name: str, look: _Look, scenes: Sequence[Scene], land: BaseGeometry, scale: float, seed: int, error: float
) -> Campaign:  # fmt: skip
    if not scenes:
        raise InputError(f"no scene of {name} in the list of outlines; expected the whole list")
    if not 0.0 < scale <= 1.0:
        raise InputError(f"--scale is {scale:g}; expected a part of the {len(scenes)} scenes, above 0 to 1")
    start = np.stack([scene.orbit_axes[0] for scene in scenes])
    middle = start.mean(axis=0)
    nearest = np.argsort(-(start @ middle), kind="stable")[: max(1, round(scale * len(scenes)))]
    kept = [scenes[k] for k in sorted(nearest.tolist())]
    shown = shapely.union_all(shapely.buffer(shapely.from_wkb([s.outline for s in kept]), 0.0))
    design = CampaignDesign(
        outline=land, grid=PointGrid(look.spacing_km, look.relief_m, seed), seed=seed, orbit_km=look.orbit_km, platform=look.platform,
        priors=APriori(bias_m=look.sigma, common_to_pass=error),
    )  # fmt: skip
    checks = max(LEAST_CHECK_POINTS, round(CHECK_PART * _fields(land, shown, look.spacing_km)))
    label = f"simulated images of footprints, {name}, scale {scale:g}, seed {seed}"
    return Campaign(label, design, tuple(kept), checks, lambda geodetic: np.full(len(geodetic), name))


def _fields(land: BaseGeometry, outline: BaseGeometry, spacing_km: float) -> float:
    """About how many fields of a point grid lie in an outline and on land."""
    part = shapely.intersection(land, outline) if shapely.intersects(land, outline) else shapely.Polygon()
    if part.is_empty:
        return 0.0
    return float(part.area * (KM_OF_DEGREE / spacing_km) ** 2 * np.cos(np.radians(part.centroid.y)))


def _scene(name: str, pass_id: str, outline: BaseGeometry, views: Callable[[float], tuple[View, ...]], day: float) -> Scene:
    """The scene of an outline, flown southwards along the side of its rectangle that is nearer to the meridian."""
    ring = shapely.get_coordinates(outline)
    direction = geodetic_to_geocentric(np.column_stack([ring, np.zeros(len(ring))]))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    centre = outline.centroid
    east, north, _ = local_axes(np.array([[centre.x, centre.y, 0.0]]))[0]
    up = direction.mean(axis=0)
    plane = shapely.minimum_rotated_rectangle(shapely.multipoints(np.stack([direction @ east, direction @ north], axis=1)))
    sides = np.diff(shapely.get_coordinates(plane)[:3], axis=0)
    side = sides[int(np.argmax(np.abs(sides[:, 1]) / np.linalg.norm(sides, axis=1)))]
    side = side if side[1] < 0.0 else -side
    along = side[0] * east + side[1] * north
    axes = _orthonormal(up, along)
    # the track runs through the middle of what is seen, across and along it
    for _ in range(3):
        x, y, z = axes @ direction.T
        a, c = np.arctan2(y, x), np.arcsin(z)
        mid_a, mid_c = 0.5 * (a.min() + a.max()), 0.5 * (c.min() + c.max())
        over = np.cos(mid_c) * (np.cos(mid_a) * axes[0] + np.sin(mid_a) * axes[1]) + np.sin(mid_c) * axes[2]
        axes = _orthonormal(over, np.cos(mid_a) * axes[1] - np.sin(mid_a) * axes[0])
    x, y, z = axes @ direction.T
    length, width = (MEAN_RADIUS_KM * float(np.ptp(v)) for v in (np.arctan2(y, x), np.arcsin(z)))
    heading = float(np.degrees(np.arctan2(side[0], side[1])))
    return Scene(name, pass_id, axes, 0.0, 0.0, width, length, views(heading), day, shapely.to_wkb(outline))


def _orthonormal(up: Array, along: Array) -> Array:
    """Axes (3, 3) of an orbit that passes over ``up`` in the direction of ``along``."""
    up = up / np.linalg.norm(up)
    along = along - up * (up @ along)
    along /= np.linalg.norm(along)
    return np.stack([up, along, np.cross(up, along)])
