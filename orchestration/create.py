"""A new, empty network over an area."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from submin.errors import InputError
from submin.formats.columns import required_path
from submin.geodesy import Ellipsoid, geocentric_to_geodetic
from submin.network.observations import Stack
from submin.sensors import width_of
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import CatalogueMetadata
from submin.storage.dense_store import create_dense
from submin.storage.image_footprints import image_footprints
from submin.storage.repository import create_network
from submin.storage.schema import NetworkMetadata
from submin.tiling.area import check_on_globe, cover_area
from submin.tiling.cover import Cover
from submin.tiling.footprints import footprint_widths, on_globe

FORMS = ("factored", "dense")
DEFAULT_CORE_KM = 100.0
CORE_IN_FOOTPRINTS = 4.0
"""With ``--fit`` a core is so many median footprint widths wide, and neighbours share one."""

ALL_METRES = 4e7
"""Side of a core that holds every area that has a plane."""
ONE_TILE_MARGIN, LEAST_TILE_METRES = 1.1, 1000.0
POINTS_MARGIN_DEGREES = 0.01


@dataclass(frozen=True)
class Created:
    """A network just made."""

    place: str
    cover: Cover
    metadata: NetworkMetadata

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "network": self.place, "tiles": self.cover.tile_count, "rows": self.cover.rows, "columns": self.cover.columns,
            "tile_km": self.cover.core / 1000.0, "overlap_km": self.cover.overlap / 1000.0, "frame": self.metadata.frame, "version": "v0",
            "thin_metres": self.metadata.thinning,
        }  # fmt: skip


def create(
    place: str,
    area: BaseGeometry,
    metadata: CatalogueMetadata,
    tile_km: float | None,
    overlap_km: float | None,
    form: str = "factored",
    max_parameters: int = 2500,
    thin_metres: float | None = None,
) -> Created:
    """Create an empty network over an area (longitude and latitude, degrees).

    ``thin_metres``: it reports one point in each square of this side; all points without one (decision 013).

    Raises
    ------
    InputError
        When the area or the sizes cannot be used; nothing is written then.
    StoreError
        When something is already at the place.
    """
    if form not in FORMS:
        raise InputError(f"form is {form!r}; expected one of {', '.join(FORMS)}")
    if thin_metres is not None and not (np.isfinite(thin_metres) and thin_metres > 0.0):
        raise InputError(f"--thin-metres is {thin_metres:g}; expected a positive length, or none of this option to report every point")
    if form == "dense":
        if tile_km is not None or overlap_km is not None:
            raise InputError("--tile-km and --overlap-km say nothing of a dense network, which has one tile; leave them out")
        if thin_metres is not None:
            raise InputError("--thin-metres is given for a dense network, which reports every point; leave it out")
        cover = one_tile(area, metadata.ellipsoid)
    else:
        core = 1000.0 * (DEFAULT_CORE_KM if tile_km is None else tile_km)
        overlap = 0.25 * core if overlap_km is None else 1000.0 * overlap_km
        cover = cover_area(area, core, overlap, metadata.ellipsoid)
    network = NetworkMetadata(
        name=Path(place).name, body=metadata.body, frame=metadata.frame, epoch=metadata.epoch,
        semimajor_axis=metadata.semimajor_axis, flattening=metadata.flattening, cover=cover.to_mapping(), form=form,
        parameters=width_of(["rpc"]), max_parameters=max_parameters, thinning=thin_metres or 0.0,
    )  # fmt: skip
    create_network(place, network, create_dense if form == "dense" else None)
    return Created(place, cover, network)


def one_tile(area: BaseGeometry, ellipsoid: Ellipsoid) -> Cover:
    """The cover of a dense network: one core around all of an area."""
    plane = cover_area(area, ALL_METRES, 0.25 * ALL_METRES, ellipsoid)
    outline = shapely.get_coordinates(shapely.segmentize(area, max(0.01 * float(np.ptp(area.bounds)), 1e-9)))
    side = ONE_TILE_MARGIN * max(float(np.ptp(v)) for v in plane.plane(outline[:, 0], outline[:, 1])) + LEAST_TILE_METRES
    return cover_area(area, side, 0.25 * side, ellipsoid)


def fit_points(catalogue: Catalogue) -> BaseGeometry:
    """Area of the points of a catalogue without images: its observations and control.

    Raises
    ------
    InputError
        When they place no point: baselines alone.
    """
    clusters, control = tuple(catalogue.observations()), catalogue.points("control")
    places = [] if control is None else [control.geodetic]
    if clusters:
        every = Stack(clusters)
        at = every.approximate(np.full((len(every.point_ids), 3), np.nan))
        places.append(geocentric_to_geodetic(at[np.isfinite(at[:, 0])], catalogue.metadata.ellipsoid))
    geodetic = np.concatenate(places) if places else np.empty((0, 3))
    if not len(geodetic):
        raise InputError(f"{catalogue.path}: places no point (baselines alone have no position); give the area by --bbox or --aoi")
    west, south = geodetic[:, :2].min(axis=0) - POINTS_MARGIN_DEGREES
    east, north = geodetic[:, :2].max(axis=0) + POINTS_MARGIN_DEGREES
    return shapely.box(west, max(south, -90.0), east, min(north, 90.0))


def read_area(path: Path) -> BaseGeometry:
    """Polygons of a GeoJSON file, as one area.

    Raises
    ------
    InputError
        When the file is not GeoJSON, holds no polygon, or one that is not on a globe or crosses itself.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        kind = values["type"]
        features = values["features"] if kind == "FeatureCollection" else [values]
        shapes = [shapely.from_geojson(json.dumps(f["geometry"] if f["type"] == "Feature" else f)) for f in features]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a GeoJSON file") from None
    except (ValueError, KeyError, TypeError, shapely.GEOSException) as error:
        raise InputError(f"{path}: not GeoJSON ({error}); expected a polygon, a feature or a collection of features") from None
    polygons = [shape for shape in shapes if shape is not None and shape.geom_type in ("Polygon", "MultiPolygon")]
    if not polygons:
        raise InputError(f"{path}: holds no polygon; expected the area as Polygon or MultiPolygon in longitude and latitude")
    broken = [polygon for polygon in polygons if not polygon.is_valid]
    if broken:
        raise InputError(f"{path}: the area is not a valid polygon: {shapely.is_valid_reason(broken[0])}; mend it and try again")
    whole = shapely.union_all(polygons)
    try:
        check_on_globe(whole)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return whole


def fit_catalogue(catalogue: Catalogue) -> tuple[BaseGeometry, float, float]:
    """Area of a catalogue's footprints, and the core and overlap that suit them, kilometres.

    Images without a footprint in the catalogue have that of their camera.

    Raises
    ------
    InputError
        When no image has a footprint and no camera sees ground, or a footprint is not where its camera looks.
    """
    shapes = image_footprints(catalogue, required_path(catalogue.path, "images"))
    shapes = shapes[~shapely.is_empty(shapes)]
    if not len(shapes):
        raise InputError(
            f"{catalogue.path}: no image has a footprint (column geometry), and no camera sees ground; give the area by --bbox or --aoi"
        )
    width = float(np.median(footprint_widths(shapes, catalogue.metadata.ellipsoid))) / 1000.0
    return shapely.union_all([on_globe(shape) for shape in shapes]), CORE_IN_FOOTPRINTS * width, width
