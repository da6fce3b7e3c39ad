"""Five blocks of stereo pairs over some 280 km x 280 km: the experiment of the 2008 MIN paper (section 5, Tables 1 to 3).

18 images in 9 pairs, 62 ground points. Blocks 1, 2 and 3 make a row from west to east, each of two or three pairs that overlap by half;
block 4 lies by itself to the north, and block 5, one long pair from south to north, ties it to block 1:

    north    4 4 4 4             GP4, 8, 11, 14, 17, 20 are common to blocks 1 and 2, six points to blocks 1 and 5, four to blocks 4 and 5,
             5                   twelve to blocks 2 and 3; GP59 to GP62 are in block 5 alone.
             1 1 1 2 2 3 3 3
             5                   Places are given in kilometres east and north of the southwestern corner of block 1.
    south

The camera is a frame of 3 m focal length that stands for a scanner: its pixels are 2.5 m on the ground both ways. Which of it the paper
states and which was chosen is in docs/experiments.md.
"""

from __future__ import annotations

import datetime
import json
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.priors import APriori
from submin.geodesy import geodetic_to_geocentric, local_axes
from submin.sensors import sensor_named
from submin.sensors.footprint import footprints
from submin.simulation.region import RegionFrame, terrain_height
from submin.simulation.scene import Layout, SimulatedImage, Survey, utc, visible

Array = NDArray[np.float64]

SENSOR = sensor_named("frame")
LONGITUDE, LATITUDE = 45.0, 36.0
"""Centre of the area."""
CENTRE_KM = (139.0, 73.0)
"""The same, east and north of the southwestern corner of block 1."""
HEADING = 180.0
"""Of the satellite: it flies south."""
ORBIT_M = 400e3
INCIDENCE = 30.0
"""Degrees between a line of sight and the vertical at the ground, before and behind: they meet at 60 degrees."""
FOCAL_LENGTH_MM = 3000.0
PIXEL_M = 2.5
SIGMA_PX = 0.5
RELIEF_M = 500.0
SECONDS_IN_PAIR = 80.0
SECONDS_BETWEEN_PAIRS = 5.0
FIRST_BLOCK = datetime.datetime(2008, 1, 1, 8, tzinfo=datetime.UTC)
DAYS_BETWEEN_BLOCKS = 10

SIGMAS = (6.0, 10.0, 4.0, 15e-6, 15e-6, 100e-6, 0.3)
SIGMAS_OF_BLOCK_5 = (12.0, 20.0, 8.0, 30e-6, 30e-6, 200e-6, 0.6)
"""Of the sensor's parameters: metres in track, cross track, radial; radians alpha, beta, kappa; millimetres of focal length."""
TIME_CONSTANTS = (2000.0, 3000.0, 1000.0, 200.0, 100.0, 300.0, 5000.0)


class Format(NamedTuple):
    """Size of an image, and whether its lines follow each other to the east (else to the south)."""

    lines: int
    samples: int
    eastward: bool


class Pair(NamedTuple):
    """A stereo pair: its block, and the common centre of its two images, kilometres east and north."""

    block: int
    east: float
    north: float


EAST_WEST, NORTH_SOUTH = Format(50_000, 20_000, True), Format(80_000, 25_000, False)
PAIRS = (
    Pair(1, 62.5, 50.0), Pair(1, 62.5, 25.0),
    Pair(2, 152.5, 62.5), Pair(2, 152.5, 37.5), Pair(2, 152.5, 12.5),
    Pair(3, 215.5, 50.0), Pair(3, 215.5, 25.0),
    Pair(4, 62.5, 120.0), Pair(5, 19.0, 73.0),
)  # fmt: skip
ROWS = (69.0, 56.0, 44.0, 31.0, 19.0, 6.0)
"""Kilometres north of the points of blocks 1 to 3: in block 1 two rows are in the northern pair, two in both, two in the southern one."""
EXTERNAL_CONTROL = ("GP59", "GP60", "GP61", "GP62")
CONTROL_CE90_LE90_M = 1.0


def five_blocks(seconds_between_pairs: float = SECONDS_BETWEEN_PAIRS) -> Layout:
    """The layout; what is measured in a block is seen in all its images that hold it."""
    frame = RegionFrame.at(LONGITUDE, LATITUDE, HEADING)
    images = tuple(image for k, pair in enumerate(PAIRS) for image in _pair(frame, pair, k, seconds_between_pairs))
    places, blocks = _points()
    truth = _geodetic(frame, places)
    point_ids = np.array([f"GP{k + 1:02d}" for k in range(len(places))])
    one, five = _a_priori(SIGMAS), _a_priori(SIGMAS_OF_BLOCK_5)
    none = np.empty(0, dtype=np.int32)
    layout = Layout(
        name="five blocks",
        images=images,
        priors={image.block_id: five if image.block_id == _block_id(5) else one for image in images},
        point_ids=point_ids,
        truth=truth,
        area=np.array([_block_id(min(of_point)) for of_point in blocks]),
        image=none,
        point=none,
        sigma_px=SIGMA_PX,
        check=Survey(np.arange(len(places), dtype=np.int32), np.zeros((3, 3))),
        control=Survey.accurate_to(np.flatnonzero(np.isin(point_ids, EXTERNAL_CONTROL)), CONTROL_CE90_LE90_M),
    )
    size = np.array([[image.width, image.height] for image in images], dtype=np.float64)
    seen = visible(layout.image_set, size, truth)
    block = np.array([int(image.block_id.split()[1]) for image in images])
    return layout.with_rays(seen & np.array([[b in of_point for of_point in blocks] for b in block]))


def _block_id(block: int) -> str:
    return f"block {block}"


def _points() -> tuple[Array, list[frozenset[int]]]:
    """Places (n, 2) of the ground points in the order of their ids, kilometres east and north, and the blocks that measure each."""
    places: list[tuple[float, float]] = []
    blocks: list[frozenset[int]] = []

    def add(east: float, north: float, *measured_in: int) -> None:
        places.append((east, north))
        blocks.append(frozenset(measured_in))

    for k, north in enumerate(ROWS):  # block 1: rows of four, then of three; the western column is in 5, the eastern one in 2
        add(15.0, north, 1, 5)
        for east in (62.0, 84.0) if k < 2 else (62.0,):
            add(east, north, 1)
        add(108.0, north, 1, 2)
    for north in ROWS:
        add(138.0, north, 2)
        add(165.0, north, 2, 3)
        add(200.0, north, 2, 3)
    for north in ROWS:
        add(235.0, north, 3)
        add(265.0, north, 3)
    for east, measured_in in ((15.0, (4, 5)), (42.0, (4, 5)), (75.0, (4,)), (110.0, (4,))):
        for north in (105.0, 135.0):
            add(east, north, *measured_in)
    for east, north in ((8.0, 152.0), (40.0, 149.0), (18.0, 85.0), (18.0, -9.0)):
        add(east, north, 5)
    return np.array(places), blocks


def _geodetic(frame: RegionFrame, places: Array) -> Array:
    """Ground (n, 3) at places (n, 2) east and north in kilometres: the track's frame is along to the south, across to the east."""
    along, across = CENTRE_KM[1] - places[:, 1], places[:, 0] - CENTRE_KM[0]
    return frame.geodetic(along, across, terrain_height(along, across, RELIEF_M))


def _a_priori(sigmas: tuple[float, ...]) -> APriori:
    """Every parameter by itself, correlated in time within the block; blocks share nothing."""
    return APriori(
        common_to_pass=0.0,
        parameters={
            parameter.name: {"sigma": sigma, "correlation": "gaussian", "correlation_parameter": seconds}
            for parameter, sigma, seconds in zip(SENSOR.parameters, sigmas, TIME_CONSTANTS, strict=True)
        },
    )


def _pair(frame: RegionFrame, pair: Pair, number: int, seconds_between_pairs: float) -> list[SimulatedImage]:
    """The image taken before and the one taken behind its centre."""
    within = sum(other.block == pair.block for other in PAIRS[:number])
    start = FIRST_BLOCK + datetime.timedelta(days=DAYS_BETWEEN_BLOCKS * pair.block, seconds=seconds_between_pairs * within)
    centre = _geodetic(frame, np.array([[pair.east, pair.north]]))
    shape = NORTH_SOUTH if pair.block == 5 else EAST_WEST
    images = []
    for view, ahead, seconds in (("F", -1.0, 0.0), ("B", 1.0, SECONDS_IN_PAIR)):
        camera = _camera(centre, shape, ahead)
        packed, size = SENSOR.pack(camera, shape.samples, shape.lines)[None], np.array([[shape.samples, shape.lines]], dtype=np.float64)
        (footprint,) = footprints(SENSOR, packed, np.zeros((1, 2)), size, centre[:, 2], frame.ellipsoid)
        images.append(
            SimulatedImage(
                image_id=f"B{pair.block}-P{within + 1}-{view}",
                block_id=_block_id(pair.block),
                pass_id=f"pass {pair.block}",
                platform="SIM-FRAME",
                sensor=SENSOR.name,
                camera=json.dumps(camera),
                width=shape.samples,
                height=shape.lines,
                acquired=utc(start + datetime.timedelta(seconds=seconds)),
                footprint=footprint,
            )
        )
    return images


def _camera(centre: Array, shape: Format, ahead: float) -> dict[str, object]:
    """Description of a camera that looks at a place (1, 3) from behind it (``ahead`` -1) or from ahead (1), seen along the track."""
    at = geodetic_to_geocentric(centre)[0]
    east, north, _ = local_axes(centre)[0]
    radius = float(np.linalg.norm(at))
    up = at / radius
    along = -(north - up * (up @ north)) / np.linalg.norm(north - up * (up @ north))
    incidence = np.radians(INCIDENCE)
    arc = incidence - np.arcsin(radius / (radius + ORBIT_M) * np.sin(incidence))
    position = (radius + ORBIT_M) * (np.cos(arc) * up + ahead * np.sin(arc) * along)
    distance = float(np.linalg.norm(at - position))
    sight = (at - position) / distance
    level = (east - sight * (sight @ east)) / np.linalg.norm(east - sight * (sight @ east))
    across = np.cross(level, sight)  # away from the equator, and foreshortened where it meets the ground
    x, y = (across, level) if shape.eastward else (level, np.cross(sight, level))
    fine = FOCAL_LENGTH_MM * PIXEL_M / distance
    step_x, step_y = (fine * np.cos(incidence), fine) if shape.eastward else (fine, fine * np.cos(incidence))
    return {
        "position": position.tolist(),
        "rotation": np.stack([x, y, sight]).tolist(),
        "focal_length": FOCAL_LENGTH_MM,
        "mm_to_pixel": [[0.5 * (shape.samples - 1), 1.0 / step_x, 0.0], [0.5 * (shape.lines - 1), 0.0, 1.0 / step_y]],
        "velocity": along.tolist(),
        "height": float(centre[0, 2]),
    }


__all__ = ["EXTERNAL_CONTROL", "five_blocks"]
