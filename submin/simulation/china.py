"""All of China from ZY-3 without ground control: 8,802 three-line triplets in some 730 passes (block adjustment of ZY-3 images over China).

The paper gives the satellite, the number of triplets, images, tie points and check points. Where its scenes lie is lost, so they are laid
out here: ground tracks in equal steps of longitude, scenes every 45 km along them, those kept that lie most in China. A satellite does
not image a whole track at a time: each is cut into passes of at most 17 scenes, at places that differ from track to track.

Parts of China are the scenes nearest to its middle. More than one China is rigid copies of the layout, turned about the Earth's axis in
steps of 62 degrees, and every second one upside down south of the equator (turned by half a circle about an axis in the equator): both
turns leave the ellipsoid as it is, so the geometry is the same. Terrain, places of points and errors differ. Copies do not touch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.geodesy import geocentric_to_geodetic, local_axes
from submin.simulation.campaign import MEAN_RADIUS_KM, Campaign, CampaignDesign, Scene
from submin.simulation.hilbert import along_hilbert
from submin.simulation.linear_array import ZY3_VIEWS
from submin.simulation.point_grid import PointGrid

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Ids = NDArray[np.str_]

TRIPLETS = 8802
CHECK_POINTS = 8000
LEAST_CHECK_POINTS = 100
"""So many are needed to judge by percentages, in whatever part of China."""
ERRORS = {"independent": 0.0, "mixed": 0.5, "common": 1.0}
"""Part of the variance of an image's shift that its pass has in common, by name."""
POSITION_SIGMA = 15.0
"""Of one image without control, metres along each axis (section 3.1)."""
DRIFT_PX = 1.0
"""Sigma of the shift at the edge of an image: the paper says that the inner accuracy is better than a pixel."""
RELIEF_M = 5000.0

MOST_COPIES = 10
TURN = 62.0
"""Degrees from one copy to the next; China is 61.4 degrees wide."""
MIDDLE_LONGITUDE = 104.35
CENTRE = (103.8, 36.1)
"""Where small parts lie: near the geographic centre, some 600 km from the nearest border."""

TRACKS = 1272
"""Around the equator: 31.5 km apart there, 25 km at 36 degrees. So the 8,802 scenes that lie most in China have an eighth there or more."""
INCLINATION = 98.2
"""Degrees, of a circle in the body-fixed frame that crosses 35 degrees north at an azimuth of 190, as a sun-synchronous track does."""
SCENE_KM, STEP_KM = 50.0, 45.0
SCENES_OF_PASS = 17
"""At most; the border makes many shorter. It gives 731 passes where some 726 were wanted."""
SPACING_KM = 1.746
"""Of the point grid. With it, and with the part that is matched, all of China has 3.0 million points and 17.6 million rays."""
MATCHED = 0.85
"""Part of the points in a triplet that matching finds; the rest stands for clouds and change. With 1 there were 6.7 rays a point."""
EQUATOR = round(0.5 * np.pi * MEAN_RADIUS_KM / STEP_KM)
"""Number along its track of the scene at the equator; a track is half a circle."""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
_SAMPLES = 7


@dataclass(frozen=True, eq=False)
class Layout:
    """Scenes of one China, in the order of the catalogue.

    Attributes
    ----------
    track, number : (n,) of the ground track, and along it; run : (n,) part of the track that is one pass
    inside : (n,) part of the scene that lies in China
    """

    track: Index
    number: Index
    run: Index
    inside: Array

    @property
    def passes(self) -> Index:
        """A number (n,) of the pass of each scene, from 0, in the order of tracks and runs."""
        return np.unique(np.stack([self.track, self.run], axis=1), axis=0, return_inverse=True)[1].reshape(-1)

    def rows(self, kept: Index) -> Layout:
        """The layout of some of the scenes."""
        return Layout(self.track[kept], self.number[kept], self.run[kept], self.inside[kept])


def track_axes(track: Index) -> Array:
    """Axes (n, 3, 3) of ground tracks: where they cross the equator southwards, their direction there, the pole of the orbit."""
    node = np.stack([360.0 / TRACKS * track, np.zeros(len(track)), np.zeros(len(track))], axis=1)
    east, north, start = local_axes(node).transpose(1, 0, 2)
    sine = np.cos(np.radians(INCLINATION))  # of the azimuth at the equator
    along = sine * east - np.sqrt(1.0 - sine**2) * north
    return np.stack([start, along, np.cross(start, along)], axis=1)


def china_layout(outline: BaseGeometry, triplets: int = TRIPLETS) -> Layout:
    """The scenes of one China, or of its middle: nothing is random, and no ray is needed.

    Parameters
    ----------
    outline : of China, longitude and latitude in degrees
    triplets : how many of the 8,802, those nearest to `CENTRE`
    """
    track, number = (index.ravel() for index in np.indices((TRACKS, 2 * EQUATOR)))
    centre = _lonlat(track, number, np.zeros(1), np.zeros(1))[:, 0]
    west, south, east, north = outline.buffer(1.0).bounds
    near = (centre[:, 0] > west) & (centre[:, 0] < east) & (centre[:, 1] > south) & (centre[:, 1] < north)
    track, number, centre = track[near], number[near], centre[near]
    offset = SCENE_KM * ((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5)
    forward, left = (part.ravel() for part in np.meshgrid(offset, offset))
    places = _lonlat(track, number, forward, left)
    shapely.prepare(outline)
    inside = shapely.contains_xy(outline, places[..., 0], places[..., 1]).mean(axis=1)
    # where passes of a track end differs from track to track, or all would end at one latitude
    run = (number + 7 * track % SCENES_OF_PASS) // SCENES_OF_PASS
    most = np.argsort(-inside, kind="stable")[:TRIPLETS]
    layout, centre = Layout(track, number, run, inside).rows(most), centre[most]
    middle = np.argsort(_distance(centre, CENTRE), kind="stable")[:triplets]
    layout, centre = layout.rows(middle), centre[middle]
    return layout.rows(_neighbours_together(centre, layout))


def china(outline: BaseGeometry, scale: float = 1.0, seed: int = 0, error: str = "mixed") -> Campaign:
    """The campaign over a part of China, all of it, or several.

    Parameters
    ----------
    outline : of China, longitude and latitude in degrees
    scale : number of Chinas, by triplets: 1 is all of it, at most `MOST_COPIES`
    error : of images, one of `ERRORS`

    Raises
    ------
    InputError
        When the scale leaves no triplet or is too large, or the kind of error is unknown.
    """
    check_asked(scale, error)
    left = round(TRIPLETS * scale)
    scenes: list[Scene] = []
    while left > 0:
        copy = len(scenes) // TRIPLETS
        scenes += _scenes(china_layout(outline, min(left, TRIPLETS)), copy)
        left -= TRIPLETS
    copies = -(-len(scenes) // TRIPLETS)
    land = shapely.union_all([shapely.transform(outline, partial(placed, copy=copy)) for copy in range(copies)])
    design = CampaignDesign(
        outline=land, grid=PointGrid(SPACING_KM, RELIEF_M, seed), seed=seed, matched=MATCHED,
        priors=APriori(bias_m=POSITION_SIGMA, drift_px=DRIFT_PX, common_to_pass=ERRORS[error]), platform="ZY3-SIMULATED",
    )  # fmt: skip
    name = f"simulated China, scale {scale:g}, error {error}, seed {seed}"
    return Campaign(name, design, tuple(scenes), max(LEAST_CHECK_POINTS, round(CHECK_POINTS * scale)), sub_areas)


def check_asked(scale: float, error: str) -> None:
    """Refuse a scale or a kind of error that `china` does not know."""
    if not 1.0 / TRIPLETS <= scale <= MOST_COPIES:
        raise InputError(f"--scale is {scale:g}; expected {1 / TRIPLETS:.6f} (one triplet) to {MOST_COPIES} (Chinas side by side)")
    check_error(error)


def check_error(error: str) -> None:
    """Refuse an unknown kind of error."""
    if error not in ERRORS:
        raise InputError(f"--error is {error!r}; expected one of {', '.join(ERRORS)}")


def turn(copy: int) -> Array:
    """Rotation (3, 3) of geocentric coordinates from the one China to a copy of it; 0 is itself."""
    angle = -np.radians(TURN * (copy // 2))
    about_axis = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    if copy % 2 == 0:
        return about_axis
    middle = np.radians(MIDDLE_LONGITUDE)
    axis = np.array([np.cos(middle), np.sin(middle), 0.0])
    return np.asarray(about_axis @ (2.0 * np.outer(axis, axis) - np.eye(3)))


def placed(lonlat: Array, copy: int) -> Array:
    """Where a copy has places of China (n, 2), degrees."""
    longitude, latitude = lonlat.T
    if copy % 2:
        longitude, latitude = 2.0 * MIDDLE_LONGITUDE - longitude, -latitude
    return np.stack([longitude - TURN * (copy // 2), latitude], axis=1)


def sub_areas(geodetic: Array) -> Ids:
    """The paper's five sub-areas (n,) of places (n, 3) in China or a copy of it; their borders are lost, these are ours."""
    west = MIDDLE_LONGITUDE - 0.5 * TURN
    longitude, latitude = west + (geodetic[:, 0] - west) % TURN, np.abs(geodetic[:, 1])
    longitude = np.where(geodetic[:, 1] < 0.0, 2.0 * MIDDLE_LONGITUDE - longitude, longitude)
    areas = [longitude < 96.0, (longitude >= 118.0) & (latitude >= 39.0), latitude >= 37.0, longitude >= 111.0]
    return np.select(areas, ["West", "Northeast", "North", "East"], "Middle")


def _scenes(layout: Layout, copy: int) -> list[Scene]:
    axes = track_axes(layout.track) @ turn(copy).T
    prefix, days = f"C{copy}-" if copy else "", layout.passes
    angle = _angle(layout.track, layout.number).tolist()
    return [
        Scene(
            f"{prefix}T{track:04d}-{number:03d}", f"{prefix}T{track:04d}-pass{run}", axes[k], angle[k], 0.0, SCENE_KM, SCENE_KM,
            ZY3_VIEWS, float(days[k]),
        )
        for k, (track, number, run) in enumerate(
            zip(layout.track.tolist(), layout.number.tolist(), layout.run.tolist(), strict=True)
        )
    ]  # fmt: skip


def _angle(track: Index, number: Index) -> Array:
    """Angles (n,) of the orbit, radians, 0 at the equator, at scenes of these numbers along their tracks.

    By the golden section scenes of neighbouring tracks do not lie side by side.
    """
    return np.asarray(STEP_KM / MEAN_RADIUS_KM * (number - EQUATOR + GOLDEN * track % 1.0))


def _lonlat(track: Index, number: Index, forward_km: Array, left_km: Array) -> Array:
    """Longitude and latitude (n, p, 2) of places (p,) so far along and across the track from the centres of scenes (n,)."""
    start, along, pole = track_axes(track).transpose(1, 0, 2)[:, :, None]
    a = (_angle(track, number)[:, None] + forward_km / MEAN_RADIUS_KM)[..., None]
    c = (left_km / MEAN_RADIUS_KM)[:, None]
    direction = np.cos(c) * (np.cos(a) * start + np.sin(a) * along) + np.sin(c) * pole
    geodetic = geocentric_to_geodetic(1e3 * MEAN_RADIUS_KM * direction.reshape(-1, 3))
    return geodetic[:, :2].reshape(*direction.shape[:2], 2)


def _distance(lonlat: Array, centre: tuple[float, float]) -> Array:
    """Angles (n,) from places (n, 2) to a centre, as their cosine with the sign turned."""
    up = local_axes(np.vstack([lonlat, centre]))[:, 2]
    return np.asarray(-(up[:-1] @ up[-1]))


def _neighbours_together(centre: Array, layout: Layout) -> Index:
    """Order along Hilbert's curve: a batch is a compact piece of land, so that few tiles are of two batches."""
    east = centre[:, 0] * np.cos(np.radians(CENTRE[1]))
    return np.lexsort((layout.number, layout.track, along_hilbert(np.stack([east, centre[:, 1]], axis=1))))
