"""What a run would do, without doing it: which tiles a catalogue's images go to, which of them would be split, what it would take.

Images go to every tile that their footprint meets: more than a run puts there, which goes by measured points. How many rays a tile holds
comes from the places of the points, each intersected from the rays of its block. Nothing is written.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from orchestration.batch import Rejected, wholly_outside
from orchestration.expectation import BASIS, Expectation, TileLoad, expected
from orchestration.progress import Reporter, Silent
from orchestration.run import DEFAULT_BATCH_BLOCKS, check_frames
from submin.adjustment.intersection import intersect
from submin.adjustment.rays import sorted_rays
from submin.errors import InputError
from submin.formats.columns import required_path
from submin.geodesy import Ellipsoid, geocentric_to_geodetic
from submin.network.network_image import image_set
from submin.sensors import width_of
from submin.storage.block_images import network_images
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, defects
from submin.storage.control_blocks import control_blocks
from submin.storage.dense_reader import refuse_dense
from submin.storage.image_footprints import image_footprints
from submin.storage.ledger import Ledger
from submin.storage.snapshot import Snapshot
from submin.tiling.cover import Cover
from submin.tiling.footprints import FootprintIndex, Shapes

Rows = NDArray[np.int64]
Array = NDArray[np.float64]

NONE = np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class TilePlan:
    """What a tile would have after the run.

    Attributes
    ----------
    tile : name; blocks : blocks of images new to it
    images : that it would see, those that it sees already among them; parameters : of these
    rays : new ones that it would hold
    """

    tile: str
    blocks: int
    images: int
    parameters: int
    rays: int


@dataclass(frozen=True)
class Plan:
    """What a run would do; the keys of ``submin plan --json``.

    Attributes
    ----------
    blocks : of the catalogue; of these new, already_there, refused (with reasons) and unmeasured (new, but without rays yet)
    rays : of the new blocks; rays_outside : on points outside the area, which the nearest core takes
    control_points : new ones
    tiles : that would get something; split : names of those that would be split; over_limit : those that cannot be split any more
    limit : image parameters beyond which a tile is split
    """

    blocks: int
    new: int
    already_there: int
    refused: tuple[Rejected, ...]
    unmeasured: int
    control_points: int
    images: int
    rays: int
    rays_outside: int
    blocks_outside_in_part: int
    tiles: tuple[TilePlan, ...]
    tiles_of_the_area: int
    split: tuple[str, ...]
    over_limit: tuple[str, ...]
    limit: int
    expected: tuple[Expectation, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        counts = {name: getattr(self, name) for name in ("images", "rays", "rays_outside", "control_points", "tiles_of_the_area")}
        return {
            "blocks": self.blocks, "blocks_new": self.new, "blocks_already_there": self.already_there,
            "blocks_refused": [asdict(r) for r in self.refused], "blocks_unmeasured": self.unmeasured,
            "blocks_partly_outside": self.blocks_outside_in_part, **counts, "tiles": len(self.tiles),
            "blocks_per_tile": self._spread("blocks"), "images_per_tile": self._spread("images"),
            "parameters_per_tile": self._spread("parameters"), "tiles_split": list(self.split), "tiles_over_limit": list(self.over_limit),
            "max_parameters": self.limit, "by_tile": [asdict(t) for t in self.tiles],
            "expected": [asdict(e) for e in self.expected], "basis": BASIS,
        }  # fmt: skip

    def _spread(self, name: str) -> dict[str, Any]:
        values = [getattr(tile, name) for tile in self.tiles]
        if not values:
            return {"median": 0, "most": 0, "tile": ""}
        most = int(np.argmax(values))
        return {"median": float(np.median(values)), "most": values[most], "tile": self.tiles[most].tile}


@dataclass(frozen=True, eq=False)
class Arrivals:
    """What of a catalogue would come in.

    Attributes
    ----------
    block : (m,) running number of the block of each new image; footprints : (m,) longitude and latitude in degrees
    place : (p, 2) longitude and latitude of the points of every block; rays : (p,) of the block on each; of : (p,) number of the block
    """

    block: Rows
    footprints: Shapes
    place: Array
    rays: Rows
    of: Rows


@dataclass
class Tally:
    """Blocks by what would become of them."""

    blocks: int = 0
    new: int = 0
    already_there: int = 0
    unmeasured: int = 0
    control: int = 0
    partly_outside: int = 0


def plan(catalogue: Catalogue, place: str, *, batch_blocks: int = DEFAULT_BATCH_BLOCKS, reporter: Reporter | None = None) -> Plan:
    """Plan the run of a catalogue into a network; its blocks may have no measurements yet.

    Raises
    ------
    InputError
        When the catalogue breaks its contract or has no images, its frame is not the network's, or the network is a dense one.
    """
    reporter, snapshot = reporter or Silent(), Snapshot.open(place)
    refuse_dense(snapshot, "plan")
    if not catalogue.images:
        raise InputError(
            f"{catalogue.path}: has no images, of which a plan tells; 'submin run' takes its observations and control as they are"
        )
    check_frames(catalogue, snapshot)
    catalogue.validate(measured=False, truth=False)
    refused, tally = list[Rejected](), Tally()
    arrivals = _arrivals(catalogue, snapshot, refused, tally, reporter)
    outside = arrivals.rays[snapshot.cover.outside_area(*arrivals.place.T)].sum() if len(arrivals.rays) else 0
    parameters = max(snapshot.metadata.parameters, width_of({image.sensor for image in catalogue.images}))
    cover, new, known = _assign(arrivals, snapshot, parameters)
    held = _rays_held(arrivals, cover)
    batch = arrivals.block // max(batch_blocks, 1)
    of_images = np.array([shape.geom_type != "Point" for shape in arrivals.footprints], dtype=np.bool_)
    tiles, loads = [], []
    for tile, images in sorted(new.items()):
        count = len(images) + len(known.get(tile, NONE))
        blocks = len(np.unique(arrivals.block[images[of_images[images]]]))
        tiles.append(TilePlan(cover.tile_name(tile), blocks, count, count * parameters, held.get(tile, 0)))
        loads.append(TileLoad(count * parameters, held.get(tile, 0), len(np.unique(batch[images]))))
    limit = snapshot.metadata.max_parameters
    fresh = [tile for tile in cover.splits if tile not in snapshot.cover.splits]
    fused, rays = tally.new + tally.control, int(arrivals.rays.sum())
    return Plan(
        tally.blocks, tally.new, tally.already_there, tuple(refused), tally.unmeasured, tally.control, int(of_images.sum()), rays,
        int(outside), tally.partly_outside, tuple(tiles), cover.tile_count, tuple(cover.tile_name(t) for t in fresh),
        tuple(t.tile for t in tiles if t.parameters > limit), limit, expected(fused, rays, -(-fused // max(batch_blocks, 1)), loads),
    )  # fmt: skip


def _arrivals(catalogue: Catalogue, snapshot: Snapshot, refused: list[Rejected], tally: Tally, reporter: Reporter) -> Arrivals:
    """Blocks that a run would let in: where their images look, and where their points are."""
    ellipsoid, ledger, cover = catalogue.metadata.ellipsoid, Ledger.of(snapshot), snapshot.cover
    shapes = image_footprints(catalogue, required_path(catalogue.path, "images"))
    footprint = dict(zip((image.image_id for image in catalogue.images), shapes, strict=True))
    control = catalogue.points("control")
    tally.blocks = catalogue.block_count
    reporter.begin(tally.blocks + (0 if control is None else len(control)))
    block, seen, places, rays, of = list[int](), list[Any](), [np.empty((0, 2))], [NONE], [NONE]
    survey = () if control is None else control_blocks(control, ellipsoid, f"{catalogue.path}/control")
    for each in chain(catalogue.blocks(), survey):
        reporter.fused(1)
        is_control = each.kind == "control"
        if ledger.holds(each):
            tally.already_there += not is_control
            continue
        at, count, reason = np.empty((0, 2)), NONE, None
        if len(each):  # a block without rays is not yet measured
            reason = ledger.refusal(each) or defects(each)
            if reason is None:
                at, count = _points(each, ellipsoid)
                reason = wholly_outside(at, cover) if cover.outside(*at.T).all() else None
        if reason is not None:
            refused.append(Rejected(each.block_id, reason))
            continue
        ledger.enter(each)
        number = tally.new + tally.control
        tally.control += is_control
        tally.new += not is_control
        tally.unmeasured += not len(each)
        tally.partly_outside += bool(len(at)) and bool(cover.outside_area(*at.T).any())
        block.extend([number] * len(each.images))
        seen.extend(shapely.Point(at[0]) if is_control else footprint[image.image_id] for image in each.images)
        places.append(at)
        rays.append(count)
        of.append(np.full(len(at), number))
    footprints = np.array(seen, dtype=np.object_)
    return Arrivals(np.array(block, dtype=np.int64), footprints, np.concatenate(places), np.concatenate(rays), np.concatenate(of))


def _points(block: Block, ellipsoid: Ellipsoid) -> tuple[Array, Rows]:
    """Longitude and latitude (p, 2) of the points of a block that its cameras reach, and the number (p,) of their rays."""
    images = image_set(network_images(block), ellipsoid, width_of(image.sensor for image in block.images))
    ids, point = np.unique(block.point_ids, return_inverse=True)
    rays = sorted_rays(point.astype(np.int32), block.image, block.observed, block.sigma, np.ones(len(point), dtype=np.bool_))
    ground = intersect(images, rays, len(ids))
    reached = np.isfinite(ground).all(axis=1)
    return geocentric_to_geodetic(ground[reached], ellipsoid)[:, :2], np.bincount(point, minlength=len(ids))[reached]


def _assign(arrivals: Arrivals, snapshot: Snapshot, parameters: int) -> tuple[Cover, dict[int, Rows], dict[int, Rows]]:
    """The cover after the run, and by tile the new images that it would see, and the rows of those that it sees already.

    Tiles that would see too many images are split, as `orchestration.change.place` does.
    """
    cover, limit = snapshot.cover, snapshot.metadata.max_parameters // parameters
    index = FootprintIndex.of(arrivals.footprints, cover)
    new = _by_tile(*index.all_met(cover))
    known = {tile: snapshot.tile_images(tile).astype(np.int64) for tile in snapshot.tile_numbers()}
    old = _known_footprints(snapshot, np.unique(np.concatenate([NONE, *known.values()])))
    while full := [t for t in new if len(new[t]) + len(known.get(t, NONE)) > limit and cover.can_split(t)]:
        for tile in full:
            if tile not in cover.splits:  # not yet, as the larger neighbour of another one
                cover = cover.split(tile)
        for tile in sorted(({*new} | {*known}) & {*cover.splits}):
            parts = np.array(list(cover.leaves_of(tile)), dtype=np.int64)
            new.pop(tile, None)
            new |= _by_tile(*index.met_by(parts, cover))
            rows = known.pop(tile, NONE)
            seen = np.array([old.get(row) for row in rows.tolist()], dtype=np.object_)
            known |= {t: rows[k] for t, k in _by_tile(*FootprintIndex.of(seen, cover).met_by(parts, cover)).items()}
    return cover, new, known


def _by_tile(tiles: Rows, rows: Rows) -> dict[int, Rows]:
    names, start = np.unique(tiles, return_index=True)
    return dict(zip(names.tolist(), np.split(rows, start[1:]), strict=True)) if len(names) else {}


def _known_footprints(snapshot: Snapshot, rows: Rows) -> dict[int, Any]:
    """Footprints of images that the network has, by row, of those that came with one."""
    stored = snapshot.image_columns(["footprint"])["footprint"][rows].tolist()
    return {row: shapely.from_wkb(bytes.fromhex(text)) for row, text in zip(rows.tolist(), stored, strict=True) if text}


def _rays_held(arrivals: Arrivals, cover: Cover) -> dict[int, int]:
    """New rays that each tile would hold."""
    held: dict[int, int] = {}
    if len(arrivals.rays):
        cells, of = np.unique(cover.cells_of(*arrivals.place.T), return_inverse=True)
        for cell, count in zip(cells.tolist(), np.bincount(of, weights=arrivals.rays).astype(np.int64).tolist(), strict=True):
            for tile in cover.holders(cell):
                held[tile] = held.get(tile, 0) + count
    return held
