"""Footprints of images of a catalogue: as its table gives them, else where their cameras look."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from submin.errors import CatalogueError, InputError
from submin.geodesy import Ellipsoid
from submin.sensors import SENSORS, sensor_named
from submin.sensors.footprint import footprints as seen_by
from submin.storage.catalogue import Catalogue, read_footprint
from submin.storage.catalogue_schema import ImageRecord
from submin.storage.image_rows import BATCH_IMAGES
from submin.tiling.footprints import EMPTY, Shapes, middles

Array = NDArray[np.float64]


def image_footprints(catalogue: Catalogue, path: Path) -> Shapes:
    """Footprint (m,) of each image of a catalogue, longitude and latitude in degrees; empty where a camera sees no ground.

    ``path`` is the table of images, for messages.

    Raises
    ------
    CatalogueError
        When a footprint is no polygon, or not where its camera looks.
    """
    ellipsoid = catalogue.metadata.ellipsoid
    parts = [
        _footprints(catalogue.images[start : start + BATCH_IMAGES], start + 1, ellipsoid, path)
        for start in range(0, len(catalogue.images), BATCH_IMAGES)
    ]
    return np.concatenate([np.empty(0, dtype=np.object_), *parts])


def _footprints(images: tuple[ImageRecord, ...], first_row: int, ellipsoid: Ellipsoid, path: Path) -> Shapes:
    known = np.array([bool(image.footprint) for image in images])
    shapes = np.full(len(images), EMPTY, dtype=np.object_)
    for k in np.flatnonzero(known):
        name = f"{path}: row {first_row + k}: geometry of image {images[k].image_id}"
        shapes[k] = read_footprint(images[k].footprint, name)
        if shapes[k].is_empty:
            raise CatalogueError(f"{name} is empty; expected a polygon in longitude and latitude")
    of_cameras = shapely.from_wkb(camera_footprints([images[k] for k in np.flatnonzero(~known)], ellipsoid))
    shapes[~known] = np.where(shapely.is_missing(of_cameras), EMPTY, of_cameras)
    if known.any():
        _check(images, shapes, np.flatnonzero(known), ellipsoid, path, first_row)
    return shapes


def camera_footprints(images: Sequence[ImageRecord], ellipsoid: Ellipsoid) -> NDArray[np.object_]:
    """Footprint (m,), WKB, of each image at its camera's mean height; None where it sees no ground."""
    found = np.full(len(images), None, dtype=np.object_)
    for name in SENSORS:
        rows = np.array([k for k, image in enumerate(images) if image.sensor == name], dtype=np.int64)
        if len(rows):
            cameras, size = _cameras([images[k] for k in rows])
            heights = SENSORS[name].mean_height(cameras)
            outlines = seen_by(SENSORS[name], cameras, np.zeros_like(size), size, heights, ellipsoid)
            found[rows] = [outline or None for outline in outlines]
    return found


def _cameras(images: Sequence[ImageRecord]) -> tuple[Array, Array]:
    """Packed cameras (m, c) of one sensor, and the size (m, 2) of their images in pixels."""
    return np.stack([image.pack() for image in images]), np.array([(i.width, i.height) for i in images], dtype=np.float64)


def _check(
    images: tuple[ImageRecord, ...], shapes: Shapes, rows: NDArray[np.int64], ellipsoid: Ellipsoid, path: Path, first_row: int
) -> None:
    """Refuse footprints that are off the globe, or nowhere near the place at which the camera looks with their axes swapped."""
    bounds = shapely.bounds(shapes[rows])
    off = ~((bounds[:, 1] >= -90.0) & (bounds[:, 3] <= 90.0) & (bounds[:, 0] >= -360.0) & (bounds[:, 2] <= 360.0))
    looks = _looks_at([images[k] for k in rows], ellipsoid)
    here = _unit(middles(shapes[rows]))
    there = _unit(middles(shapely.transform(shapes[rows], lambda at: at[:, ::-1])))
    camera = _unit(looks)
    swapped = np.arccos(np.clip((there * camera).sum(axis=1), -1, 1)) < 0.1 * np.arccos(np.clip((here * camera).sum(axis=1), -1, 1))
    for at in np.flatnonzero(off | swapped)[:1]:
        (west, south, east, north), (longitude, latitude) = bounds[at], looks[at]
        raise InputError(
            f"{path}: row {first_row + rows[at]}: geometry of image {images[rows[at]].image_id} spans longitudes {west:g} to {east:g} and "
            f"latitudes {south:g} to {north:g}, but its camera looks at longitude {longitude:g}, latitude {latitude:g}; "
            + ("its axes look swapped: expected longitude first, then latitude" if swapped[at] else "expected degrees on a globe")
        )


def _looks_at(images: Sequence[ImageRecord], ellipsoid: Ellipsoid) -> Array:
    """Longitude and latitude (m, 2) of the middle of each image, at its camera's mean height; NaN where it sees no ground."""
    found = np.full((len(images), 2), np.nan)
    for name in {image.sensor for image in images}:
        rows = np.array([k for k, image in enumerate(images) if image.sensor == name], dtype=np.int64)
        sensor = sensor_named(name)
        cameras, size = _cameras([images[k] for k in rows])
        every = np.arange(len(rows), dtype=np.int32)
        samples, lines = (np.ascontiguousarray(0.5 * column) for column in size.T)
        found[rows] = sensor.localise(cameras, every, samples, lines, sensor.mean_height(cameras), ellipsoid)[:, :2]
    return found


def _unit(lonlat: Array) -> Array:
    lon, lat = np.radians(lonlat).T
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
