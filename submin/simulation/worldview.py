"""Fifty WorldView-1 stereo pairs in the southwestern United States: the experiment of the 2010 paper (Tables 1 to 6).

Ten cells of two to seven pairs (`CELLS`, the paper's Table 1): seven of one by one degree, of which Fallon and Edwards Middle are covered
twice (from north to south, and from east to west), and three that bridge between them. A pair is taken on one pass, all pairs on
different ones but for two that share theirs, so 50 pairs are 49 blocks. Tie points are chosen, once for all seeds, so that Table 2 holds:
472, 697, 152 and 26 points in one, two, three and four pairs, of which 41, 38, 18 and 4 are check points.

The camera is a linear array that is turned while it scans, so that strips run where they are wanted. Which of it the paper states and which
was chosen is in docs/experiments.md.
"""

from __future__ import annotations

import datetime
import json
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from submin.adjustment.priors import APriori
from submin.geodesy import WGS84, geodetic_to_geocentric, local_axes
from submin.sensors import sensor_named
from submin.sensors.footprint import footprints
from submin.simulation.scene import Layout, SimulatedImage, Survey, utc

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.int64]

SENSOR = sensor_named("pushbroom")
ORBIT_M = 496e3
GRAVITY_PARAMETER = 3.986004418e14
"""GM of the Earth, m3/s2 (NIMA TR8350.2)."""
TRACK_AZIMUTH = 190.0
"""Degrees: a descending sun-synchronous pass."""
FOCAL_LENGTH_MM = 8800.0
SAMPLES = 36_000
PIXEL_M = 0.6
SIGMA_PX = 1.0
ATTITUDE_RAD, RATE_RAD_S, COMMON_TO_PASS = 5e-6, 0.5e-6, 0.75
MEAN_HEIGHT_M, RELIEF_M = 1200.0, 800.0
MARGIN_KM = 1.2
"""No point is measured closer to an image's edge: relief and true corrections move it, and it must stay inside."""
CHECK_M = 0.5
"""CE90 and LE90 of surveyed coordinates."""

POINTS_BY_PAIRS = {1: 472, 2: 697, 3: 152, 4: 26}
CHECK_POINTS_BY_PAIRS = {1: 41, 2: 38, 3: 18, 4: 4}
MIDDLE = "EdwardsM"
"""Edwards Middle: what lies under the strips of EdwardsM and of EdwardsM-EW."""
TWICE_COVERED = ("Fallon", MIDDLE)
CHECK_POINTS_IN_MIDDLE = {2: 14, 3: 9, 4: 2}
CONTROL_BY_AREA = {"Fallon": 2, "EdwardsN": 1, MIDDLE: 3, "EdwardsS": 1, "FallonEdwardsB1": 1, "Nellis": 1}
"""Nine of the check points, in six cells, three in Edwards Middle."""
CANDIDATE_KM = 2.5
POINT_KM = 2.0
"""A point this much farther from the others is worth one point less in its pairs, when the next one is chosen."""
LAYOUT_SEED = 2010
DAYS_BETWEEN_PASSES = 2


class Cell(NamedTuple):
    """One line of the paper's Table 1, and where the cell lies.

    Attributes
    ----------
    name, pairs : as the paper has them
    first, last : dates between which it was collected
    lines : of an image, thousands; seconds : that a scan takes
    off_nadir, convergence : degrees, means over the cell's images and pairs
    longitude, latitude : of its centre, degrees
    spacing_km : from strip to strip; None to fill one degree
    """

    name: str
    pairs: int
    first: datetime.date
    last: datetime.date
    lines: int
    seconds: float
    off_nadir: float
    convergence: float
    longitude: float
    latitude: float
    spacing_km: float | None = None

    @property
    def eastward(self) -> bool:
        """True when strips run from west to east, one south of the other."""
        return self.name.endswith("-EW")


def _month(text: str) -> datetime.date:
    return datetime.date(2000 + int(text[2:]), int(text[:2]), 15)


def _cell(
    name: str, pairs: int, dates: str, lines: int, seconds: float, off_nadir: float, convergence: float, longitude: float, latitude: float,
    spacing_km: float | None = None,
) -> Cell:  # fmt: skip
    first, last = map(_month, dates.split("-"))
    return Cell(name, pairs, first, last, lines, seconds, off_nadir, convergence, longitude, latitude, spacing_km)


CELLS = (
    _cell("Fallon", 5, "0308-0608", 197, 16, 27, 39, -118.5, 39.5),
    _cell("Fallon-EW", 7, "0708-0908", 161, 13, 27, 44, -118.5, 39.5),
    _cell("FallonEdwardsB1", 3, "0209-0209", 275, 23, 23, 37, -118.2, 38.45, 16.0),
    _cell("FallonEdwardsB2", 2, "0409-0509", 233, 19, 25, 40, -117.9, 37.4, 16.0),
    _cell("EdwardsN", 6, "0108-0708", 191, 16, 29, 40, -117.5, 36.5),
    _cell("EdwardsM", 6, "1207-0608", 199, 17, 26, 36, -117.5, 35.5),
    _cell("EdwardsM-EW", 7, "0708-0808", 167, 14, 27, 43, -117.5, 35.5),
    _cell("EdwardsS", 6, "1207-1208", 202, 17, 24, 35, -117.5, 34.5),
    _cell("EdwardsNellisB-EW", 3, "0309-0309", 197, 16, 25, 42, -116.5, 36.4, 16.0),
    _cell("Nellis", 5, "0608-0608", 199, 17, 28, 34, -115.5, 36.5),
)
SHARED_PASS = {("Fallon-EW", 1): datetime.date(2008, 7, 30), ("EdwardsM-EW", 3): datetime.date(2008, 7, 30)}
"""Cell and number of the pairs that were taken on one pass."""


class Strip(NamedTuple):
    """One pair: its cell, its number in it, the centre of its images, and on which side of them (1 east, -1 west) the satellite passes."""

    cell: Cell
    number: int
    longitude: float
    latitude: float
    side: int

    @property
    def name(self) -> str:
        """As ids have it."""
        return f"{self.cell.name}-{self.number + 1}"


def worldview() -> Layout:
    """The layout: 49 blocks of one pair, but for one of two."""
    strips = [strip for cell in CELLS for strip in _strips(cell)]
    shared = [k for k, strip in enumerate(strips) if (strip.cell.name, strip.number) in SHARED_PASS]
    together = "+".join(strips[k].name for k in shared)
    # the pairs of the shared pass follow each other: images are ordered by block
    order = [k for k in range(shared[1]) if k not in shared] + shared + list(range(shared[1] + 1, len(strips)))
    strips = [strips[k] for k in order]
    blocks = [together if (strip.cell.name, strip.number) in SHARED_PASS else strip.name for strip in strips]
    images = tuple(image for strip, block in zip(strips, blocks, strict=True) for image in _pair(strip, block))

    point_ids, truth, measured = _tie_points(strips, images)
    area = _areas(strips, measured)
    check = _check_points(truth, measured, area)
    a_priori = APriori(
        common_to_pass=0.0,
        parameters={
            "attitude": {"sigma": ATTITUDE_RAD, "common_to_pass": COMMON_TO_PASS},
            "rate": {"sigma": RATE_RAD_S, "common_to_pass": COMMON_TO_PASS},
        },
    )
    none = np.empty(0, dtype=np.int32)
    return Layout(
        name="WorldView-1",
        images=images,
        priors=dict.fromkeys(blocks, a_priori),
        point_ids=point_ids,
        truth=truth,
        area=area,
        image=none,
        point=none,
        sigma_px=SIGMA_PX,
        check=Survey.accurate_to(check, CHECK_M),
        control=Survey.accurate_to(_control_points(truth, area, check), CHECK_M),
    ).with_rays(np.repeat(measured.T, 2, axis=0))


def cell_of(image_id: str) -> str:
    """Cell of an image."""
    return image_id.rsplit("-", 2)[0]


def _strips(cell: Cell) -> list[Strip]:
    """The pairs of a cell, from west to east or from north to south."""
    north_km, east_km = _km_of_degree(cell.latitude)
    width = 1e-3 * SAMPLES * PIXEL_M
    extent = north_km if cell.eastward else east_km
    spacing = (extent - width) / (cell.pairs - 1) if cell.spacing_km is None else cell.spacing_km
    offsets = spacing * (np.arange(cell.pairs) - 0.5 * (cell.pairs - 1))
    return [
        Strip(
            cell, k,
            cell.longitude if cell.eastward else cell.longitude + float(offset) / east_km,
            cell.latitude - float(offset) / north_km if cell.eastward else cell.latitude,
            1 if k % 2 else -1,
        )
        for k, offset in enumerate(offsets)
    ]  # fmt: skip


def _km_of_degree(latitude: float) -> tuple[float, float]:
    """Kilometres of a degree of latitude and of longitude."""
    return 111.0, 111.3 * float(np.cos(np.radians(latitude)))


def _pair(strip: Strip, block: str) -> list[SimulatedImage]:
    """The two images of a pair: from behind the scene, along the track, then from ahead of it."""
    cell = strip.cell
    days = max((cell.last - cell.first).days // cell.pairs, DAYS_BETWEEN_PASSES)
    day = SHARED_PASS.get((cell.name, strip.number), cell.first + datetime.timedelta(days=days * strip.number))
    noon = datetime.datetime.combine(day, datetime.time(18, 27), datetime.UTC)
    pass_id = f"pass {day}" if (cell.name, strip.number) in SHARED_PASS else f"pass {strip.name}"
    centre = np.array([[strip.longitude, strip.latitude, MEAN_HEIGHT_M]])
    lines = 1000 * cell.lines
    images = []
    for view, ahead in (("F", -1.0), ("B", 1.0)):
        camera, since = _camera(strip, centre, ahead)
        packed, size = SENSOR.pack(camera, SAMPLES, lines)[None], np.array([[SAMPLES, lines]], dtype=np.float64)
        (footprint,) = footprints(SENSOR, packed, np.zeros((1, 2)), size, centre[:, 2], WGS84)
        images.append(
            SimulatedImage(
                image_id=f"{strip.name}-{view}",
                block_id=block,
                pass_id=pass_id,
                platform="SIM-WV01",
                sensor=SENSOR.name,
                camera=json.dumps(camera),
                width=SAMPLES,
                height=lines,
                acquired=utc(noon + datetime.timedelta(seconds=since)),
                footprint=footprint,
            )
        )
    return images


def _camera(strip: Strip, centre: Array, ahead: float) -> tuple[dict[str, object], float]:
    """Description of the camera of one image, and its time: seconds after the satellite has passed the latitude of 40 degrees.

    ``ahead`` is -1 for the image that is taken before the satellite passes the scene. The orbit is a circle in body-fixed axes.
    """
    cell = strip.cell
    at = geodetic_to_geocentric(centre)[0]
    east, north, _ = local_axes(centre)[0]
    radius = float(np.linalg.norm(at))
    up, orbit = at / radius, radius + ORBIT_M
    azimuth = np.radians(TRACK_AZIMUTH)
    along = _across(np.sin(azimuth) * east + np.cos(azimuth) * north, up)
    incidence = np.arcsin(orbit / radius * np.sin(np.radians(cell.off_nadir)))
    turned = np.arcsin(np.sin(0.5 * np.radians(cell.convergence)) / np.sin(incidence))
    level = np.cos(turned) * strip.side * np.cross(up, along) + np.sin(turned) * ahead * along
    distance = np.sqrt(orbit**2 - (radius * np.sin(incidence)) ** 2) - radius * np.cos(incidence)
    satellite = (at + distance * (np.cos(incidence) * up + np.sin(incidence) * level)) / orbit
    forward = _across(along, satellite)

    times = np.linspace(-0.8 * cell.seconds, 0.8 * cell.seconds, 33)[:, None]  # the sensor looks a quarter of the image beyond its edges
    angular = np.sqrt(GRAVITY_PARAMETER / orbit**3)
    turn = angular * times
    position = orbit * (np.cos(turn) * satellite + np.sin(turn) * forward)
    velocity = orbit * angular * (np.cos(turn) * forward - np.sin(turn) * satellite)
    scan = _across(east if cell.eastward else -north, up)
    swept = 1e3 * cell.lines * PIXEL_M / cell.seconds * times / radius
    aim = radius * (np.cos(swept) * up + np.sin(swept) * scan)
    sight = _unit(aim - position)
    x = _across(np.cos(swept) * scan - np.sin(swept) * up, sight)
    y = np.cross(sight, x)
    middle = len(times) // 2
    on_ground = y[middle] - sight[middle] * (y[middle] @ up) / (sight[middle] @ up)
    step = FOCAL_LENGTH_MM * PIXEL_M / (distance * float(np.linalg.norm(on_ground)))
    camera = {
        "position": {"times": times[:, 0].tolist(), "values": position.tolist(), "velocities": velocity.tolist()},
        "attitude": {"times": times[:, 0].tolist(), "values": Rotation.from_matrix(np.stack([x, y, sight], axis=2)).as_quat().tolist()},
        "lines": {"times": [-0.5 * cell.seconds, 0.5 * cell.seconds], "values": [0.0, 1e3 * cell.lines - 1.0]},
        "focal_length": FOCAL_LENGTH_MM,
        "detector": {"origin": [0.0, -0.5 * (SAMPLES - 1) * step], "step": [0.0, step]},
        "mean_height": MEAN_HEIGHT_M,
    }
    from_forty = 1e3 * _km_of_degree(strip.latitude)[0] * (40.0 - strip.latitude)
    return camera, float((from_forty / radius + ahead * np.arcsin(distance * np.sin(incidence) * np.sin(turned) / orbit)) / angular)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _across(vectors: Array, axis: Array) -> Array:
    """Unit vectors: the part of vectors that is at right angles to unit vectors."""
    return _unit(vectors - axis * np.sum(vectors * axis, axis=-1, keepdims=True))


def _tie_points(strips: list[Strip], images: tuple[SimulatedImage, ...]) -> tuple[NDArray[np.str_], Array, Flags]:
    """Ids, ground (n, 3), and by which pairs each point is measured (n, pairs)."""
    rng = np.random.default_rng(LAYOUT_SEED)
    outlines = [shapely.from_wkb(image.footprint) for image in images]
    both = [shapely.intersection(a, b).buffer(-MARGIN_KM / 100.0) for a, b in zip(outlines[::2], outlines[1::2], strict=True)]
    west, south, east, north = shapely.union_all(both).bounds
    spacing = CANDIDATE_KM / np.array([_km_of_degree(0.5 * (south + north))[1], _km_of_degree(0.0)[0]])
    longitude, latitude = np.meshgrid(np.arange(west, east, spacing[0]), np.arange(south, north, spacing[1]))
    places = np.column_stack([longitude.ravel(), latitude.ravel()]) + spacing * rng.uniform(-0.4, 0.4, (longitude.size, 2))
    seen = np.column_stack([shapely.contains_xy(outline, places[:, 0], places[:, 1]) for outline in both])
    kept = seen.any(axis=1)
    places, seen = places[kept], seen[kept]
    chosen = _balanced(places, seen)
    # ids from north to south
    chosen = chosen[np.argsort(-places[chosen, 1], kind="stable")]
    places, seen = places[chosen], seen[chosen]
    ids = np.array([f"WV{k + 1:04d}" for k in range(len(places))])
    return ids, np.column_stack([places, _heights(places)]), seen


def _heights(places: Array) -> Array:
    """Heights (n,) of basins and ranges, metres."""
    waves = np.sin(2.0 * np.pi * (places[:, 0] + 0.3 * places[:, 1]) / 0.45) + 0.6 * np.sin(2.0 * np.pi * places[:, 1] / 1.3)
    return np.asarray(MEAN_HEIGHT_M + RELIEF_M / 1.6 * waves)


def _balanced(places: Array, seen: Flags) -> Rows:
    """Rows of the candidates (c) that are measured: as many points by number of pairs as wanted, spread over pairs and ground.

    One after another, those in most pairs first: the next one is where its pairs have fewest points and other points are far.
    """
    plane = _plane(places)
    pairs = seen.sum(axis=1)
    in_pair = np.zeros(seen.shape[1])
    apart = np.full(len(places), 1e3)
    chosen: list[int] = []
    for number, wanted in sorted(POINTS_BY_PAIRS.items(), reverse=True):
        candidates = np.flatnonzero(pairs == number)
        for _ in range(wanted):
            crowded = seen[candidates] @ in_pair / number - np.minimum(apart[candidates], 20.0) / POINT_KM
            k = int(candidates[np.argmin(crowded)])
            chosen.append(k)
            in_pair += seen[k]
            apart = np.minimum(apart, np.hypot(*(plane - plane[k]).T))
    return np.array(chosen)


def _plane(places: Array) -> Array:
    """Kilometres east and north (n, 2), good enough to tell near from far."""
    north_km, east_km = _km_of_degree(37.0)
    return np.asarray(places[:, :2] * (east_km, north_km))


def _areas(strips: list[Strip], measured: Flags) -> NDArray[np.str_]:
    """Sub-area (n,) of each point: a cell that is covered twice where both covers measure it, else the first cell that does."""
    names = [cell.name for cell in CELLS]
    in_cell = measured @ np.array([[strip.cell.name == name for name in names] for strip in strips])
    area = np.array(names)[np.argmax(in_cell, axis=1)].astype("U32")
    for name in TWICE_COVERED:
        both = in_cell[:, names.index(name)] & in_cell[:, names.index(f"{name}-EW")]
        area[(area == name) & ~both] = f"{name}-NS"
        area[both] = name
    return np.asarray(area)


def _check_points(truth: Array, measured: Flags, area: NDArray[np.str_]) -> Rows:
    """Rows of the check points, ascending: as many by number of pairs as wanted, 25 of them in Edwards Middle."""
    pairs, middle = measured.sum(axis=1), area == MIDDLE
    chosen = []
    for number, wanted in CHECK_POINTS_BY_PAIRS.items():
        inside = CHECK_POINTS_IN_MIDDLE.get(number, 0)
        chosen += [_spread(truth, np.flatnonzero((pairs == number) & middle), inside)]
        chosen += [_spread(truth, np.flatnonzero((pairs == number) & ~middle), wanted - inside)]
    return np.sort(np.concatenate(chosen))


def _control_points(truth: Array, area: NDArray[np.str_], check: Rows) -> Rows:
    """Rows of the check points that serve as sparse control, ascending."""
    return np.sort(np.concatenate([_spread(truth, check[area[check] == name], wanted) for name, wanted in CONTROL_BY_AREA.items()]))


def _spread(truth: Array, rows: Rows, wanted: int) -> Rows:
    """So many of some points, far from each other: each is the one farthest from those before; the first is nearest to their middle."""
    if not wanted:
        return rows[:0]
    distances = cdist(_plane(truth[rows]), _plane(truth[rows]))
    chosen = [int(np.argmin(distances.sum(axis=1)))]
    while len(chosen) < wanted:
        chosen.append(int(np.argmax(distances[:, chosen].min(axis=1))))
    return rows[chosen]


__all__ = ["CELLS", "MIDDLE", "cell_of", "worldview"]
