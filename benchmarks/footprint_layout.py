"""Images simulated over real footprints: who overlaps whom, and who shares a pass, are as flown; cameras and measurements are simulated.

A footprint may be taken several times from different directions, as a three-line camera does. Each image is a perspective view from where
the satellite stood, scaled to the wanted pixel; an RPC is fitted to it, and **the RPC is the truth**, as in `submin.simulation.region`.
Points are measured where they lie within the real outline.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.geodesy import WGS84, geodetic_to_geocentric, local_axes
from submin.sensors import sensor_named
from submin.simulation.rpc_fit import fit_rpc
from submin.simulation.scene import Layout, SimulatedImage, Survey, utc

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

SENSOR = sensor_named("rpc")
TRACK_AZIMUTH = 190.0
"""Degrees: lines follow a descending sun-synchronous pass."""
RELIEF_M = 2000.0
WAVES_KM = (170.0, 110.0, 60.0)
MARGIN_PX = 100.0
"""Width of the format around the footprint: true corrections move points, and they must stay inside."""
LEAST_RAYS = 12
"""A block with fewer is left out."""
LEAST_CONVERGENCE = 10.0
"""Degrees: points whose rays all meet at less are left out, because they would be weak whatever is done about tiles."""


class Look(NamedTuple):
    """From where an image is taken.

    Attributes
    ----------
    name : distinguishes the images of a footprint
    off_nadir : angle at the satellite between nadir and line of sight, degrees
    azimuth : in which the satellite stands, seen from the ground, degrees from north to east
    """

    name: str
    off_nadir: float
    azimuth: float


@dataclass(frozen=True, eq=False)
class Footprint:
    """A real scene, and how it is taken.

    Attributes
    ----------
    scene_id, block_id, pass_id : for ids of images
    acquired : time
    outline : (k, 2) longitude and latitude, degrees
    looks : one an image
    pixel_m : size of a pixel on the ground across the line of sight, metres
    orbit_m : height of the orbit
    """

    scene_id: str
    block_id: str
    pass_id: str
    acquired: datetime.datetime
    outline: Array
    looks: tuple[Look, ...]
    pixel_m: float
    orbit_m: float


def footprint_layout(
    name: str, footprints: Sequence[Footprint], a_priori: APriori, places: Array, sigma_px: float = 0.5
) -> Layout:  # fmt: skip
    """Lay out images over footprints, with a ray for every point in every image whose footprint holds it.

    Parameters
    ----------
    name : for people
    footprints : at least one
    a_priori : model of all images
    places : (n, 2) longitude and latitude of candidate points, degrees; those that two well separated looks see are taken
    sigma_px : of a measurement, sample and line each

    Raises
    ------
    InputError
        When no point is seen from two directions.
    """
    ordered = sorted(footprints, key=lambda f: (f.block_id, f.scene_id))
    shapes = [shapely.Polygon(f.outline) for f in ordered]
    inside = np.stack([shapely.contains_xy(shape, places[:, 0], places[:, 1]) for shape in shapes])
    measured = inside.repeat([len(f.looks) for f in ordered], axis=0)
    sight = np.concatenate([[_direction(_incidence(f, look), look.azimuth) for look in f.looks] for f in ordered])
    _, block = np.unique([f.block_id for f in ordered for _ in f.looks], return_inverse=True)
    good, kept = _chosen(measured, sight, block)
    if not kept.any():
        raise InputError(f"{name}: no points are seen from directions {LEAST_CONVERGENCE:g} degrees apart; expected overlapping footprints")
    images = tuple(image for image, keep in zip((_image(f, look) for f in ordered for look in f.looks), kept, strict=True) if keep)
    point_ids, none = np.char.mod("P%06d", np.flatnonzero(good)), np.empty(0, dtype=np.int32)
    return Layout(
        name=name,
        images=images,
        priors={image.block_id: a_priori for image in images},
        point_ids=point_ids,
        truth=np.column_stack([places, _terrain(places)])[good],
        area=np.full(len(point_ids), ""),
        image=none,
        point=none,
        sigma_px=sigma_px,
        check=Survey(np.arange(len(point_ids), dtype=np.int32), np.zeros((3, 3))),
        control=Survey(none, np.zeros((3, 3))),
    ).with_rays(measured[np.ix_(kept, good)])


def _chosen(measured: Flags, sight: Array, block: NDArray[np.int64]) -> tuple[Flags, Flags]:
    """Points (n,) that images of well separated directions see, and images (m,) of blocks with enough rays on such points."""
    apart = (sight @ sight.T < np.cos(np.radians(LEAST_CONVERGENCE))).astype(np.float64)
    kept = np.ones(len(measured), dtype=np.bool_)
    while True:
        seen = (measured & kept[:, None]).astype(np.float64)
        good = np.asarray(np.einsum("in,in->n", seen, apart @ seen) > 0.0)
        rays = np.bincount(block, weights=(seen @ good), minlength=int(block.max()) + 1)
        enough = kept & (rays >= LEAST_RAYS)[block]
        if (enough == kept).all():
            return good, kept
        kept = enough


def _terrain(places: Array) -> Array:
    """Heights (n,) from 0 to `RELIEF_M`: three smooth waves, the same everywhere on the globe."""
    unit = geodetic_to_geocentric(np.column_stack([places, np.zeros(len(places))])) / 1e3
    waves = sum(np.sin(2.0 * np.pi * unit[:, k] / length) for k, length in enumerate(WAVES_KM))
    return np.asarray(RELIEF_M * (0.5 + waves / 6.0))


def _image(footprint: Footprint, look: Look) -> SimulatedImage:
    """One image: an RPC that is fitted to a perspective view, its format around the footprint."""
    low, high = footprint.outline.min(axis=0), footprint.outline.max(axis=0)
    edge = 0.05 * (high - low)
    view = _view(footprint, look)
    outline = np.column_stack([footprint.outline, np.full(len(footprint.outline), 0.5 * RELIEF_M)])
    seen = view(outline)
    first = seen.min(axis=0) - MARGIN_PX
    width, height = (int(v) for v in np.ceil(np.ptp(seen, axis=0) + 2.0 * MARGIN_PX))
    rpc, _ = fit_rpc(
        lambda geodetic: view(geodetic) - first,
        (float(low[0] - edge[0]), float(high[0] + edge[0])),
        (float(low[1] - edge[1]), float(high[1] + edge[1])),
        (-0.1 * RELIEF_M, 1.1 * RELIEF_M),
    )
    return SimulatedImage(
        image_id=f"{footprint.scene_id}-{look.name}" if look.name else footprint.scene_id,
        block_id=footprint.block_id,
        pass_id=footprint.pass_id,
        platform="SIM",
        sensor=SENSOR.name,
        camera=json.dumps(rpc),
        width=width,
        height=height,
        acquired=utc(footprint.acquired),
        footprint=shapely.to_wkb(shapely.Polygon(footprint.outline)),
    )


def _view(footprint: Footprint, look: Look) -> Callable[[Array], Array]:
    """Perspective view: samples and lines (n, 2) of geodetic coordinates (n, 3), about the middle of the footprint."""
    middle = shapely.Polygon(footprint.outline).centroid
    centre = np.array([[middle.x, middle.y, 0.5 * RELIEF_M]])
    at = geodetic_to_geocentric(centre)[0]
    axes = local_axes(centre)[0]
    radius, incidence = float(np.linalg.norm(at)), _incidence(footprint, look)
    distance = np.sqrt((radius + footprint.orbit_m) ** 2 - (radius * np.sin(incidence)) ** 2) - radius * np.cos(incidence)
    towards = _direction(incidence, look.azimuth) @ axes
    station = at + distance * towards
    along = _direction(0.5 * np.pi, TRACK_AZIMUTH) @ axes
    line = along - towards * (towards @ along)
    line /= np.linalg.norm(line)
    across = np.cross(line, towards)
    scale = distance / footprint.pixel_m

    def view(geodetic: Array) -> Array:
        sight = geodetic_to_geocentric(geodetic) - station
        return np.asarray(scale * np.stack([sight @ across, sight @ line], axis=1) / (sight @ -towards)[:, None])

    return view


def _incidence(footprint: Footprint, look: Look) -> float:
    """Angle at the ground between the vertical and the line of sight, radians."""
    return float(np.arcsin((1.0 + footprint.orbit_m / WGS84.semimajor_axis) * np.sin(np.radians(look.off_nadir))))


def _direction(from_vertical: float, azimuth: float) -> Array:
    """Unit vector in local axes east, north, up; angle from the vertical in radians, azimuth in degrees."""
    turned = np.radians(azimuth)
    return np.array([np.sin(from_vertical) * np.sin(turned), np.sin(from_vertical) * np.cos(turned), np.cos(from_vertical)])
