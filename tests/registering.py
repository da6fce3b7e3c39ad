"""A small network of cells into which rays of five simulated images are registered, for tests of registration."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hypothesis import Phase, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from orchestration.change import Relocations, TakenOut, take_points, take_points_seen
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geocentric_to_geodetic, geodetic_to_geocentric
from submin.network.cell import Cell, empty_cell, summed, with_points, without_points
from submin.network.registration import (
    LooseRays,
    Registration,
    register,
    together,
)
from submin.sensors import sensor_named
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Index = NDArray[np.int32]

P = 6
# a smaller seed is not a simpler network: nothing to shrink
EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate))
SEEDS = st.integers(0, 2**32 - 1)
CENTRE = np.array([5.4, 43.3])
VIEWS = ((-0.5, 0.1), (0.5, 0.0), (0.0, 0.5), (0.1, -0.5), (0.3, 0.3))
"""Tangents of the views to the east and north. At 400 m above the mean height a single ray lands some 200 m off."""
NAMES = ("d", "b", "e", "a", "c")
"""Names of the images by row: not in the order of their rows."""
COVER = Cover((5.4, 43.3), (-600.0, -600.0), 8, 8, 150.0, 40.0).split(27).split(30)
ROW = 10
"""The images are rows 10, 11, ... of their network."""
ROWS = np.arange(ROW, ROW + len(VIEWS), dtype=np.int32)


def camera(tangent_east: float, tangent_north: float) -> dict[str, Any]:
    """RPC of half-metre pixels about the centre, mean height 0, its view leaning by these tangents."""
    metres = np.array([0.02 * 81000.0, 0.02 * 111100.0, 500.0]) / 2500.0
    sample = [0.0, metres[0], 0.0, tangent_east * metres[2], *([0.0] * 16)]
    line = [0.0, 0.0, -metres[1], -tangent_north * metres[2], *([0.0] * 16)]
    return {
        "LINE_OFF": 4999.5, "SAMP_OFF": 4999.5, "LAT_OFF": CENTRE[1], "LONG_OFF": CENTRE[0], "HEIGHT_OFF": 0.0,
        "LINE_SCALE": 5000.0, "SAMP_SCALE": 5000.0, "LAT_SCALE": 0.02, "LONG_SCALE": 0.02, "HEIGHT_SCALE": 500.0,
        "SAMP_NUM_COEFF": sample, "LINE_NUM_COEFF": line, "SAMP_DEN_COEFF": [1.0] + [0.0] * 19, "LINE_DEN_COEFF": [1.0] + [0.0] * 19,
    }  # fmt: skip


def image_set(views: Sequence[tuple[float, float]] = VIEWS, names: Sequence[str] = NAMES) -> ImageSet:
    sensor = sensor_named("rpc")
    cameras = np.stack([sensor.pack(camera(*view), 10000.0, 10000.0) for view in views])
    priors = tuple(ImagePrior(f"b{i}", f"p{i}", 0.0, APriori(), sensor.parameters) for i in range(len(views)))
    return ImageSet(tuple(names[: len(views)]), ("rpc",) * len(views), cameras, priors, len(sensor.parameters), COVER.ellipsoid)


IMAGES = image_set()


def places(east: Sequence[float], north: Sequence[float], height: float = 400.0) -> Array:
    """Geocentric coordinates (n, 3) of places of the cover's plane, at this height."""
    lon, lat = COVER.geographic(np.array(east), np.array(north))
    return geodetic_to_geocentric(np.column_stack([lon, lat, np.full(len(lon), height)]))


def exactly(ground: Array, image: int, images: ImageSet = IMAGES) -> Array:
    """Where an image sees these points (n, 2)."""
    rows = np.arange(len(ground), dtype=np.int32)
    theta = np.zeros((len(images), P))
    return np.asarray(images.project(theta, images.ground(ground), np.full(len(ground), image, np.int32), rows).image)


def observed(ground: Array, image: int, seed: int = 1) -> Array:
    """Where an image sees these points (n, 2), with 0.3 pixels of noise."""
    exact = exactly(ground, image)
    return exact + np.random.default_rng(seed + 10 * image).normal(0.0, 0.3, exact.shape)


def arriving(ids: Sequence[str], ground: Array, images: Sequence[int], block: int = 0) -> LooseRays:
    """Rays of every point in each of some images."""
    n = len(ids)
    return LooseRays.of(
        np.tile(np.array(ids, dtype=np.str_), len(images)), (ROW + np.repeat(np.array(images, dtype=np.int32), n)).astype(np.int32),
        np.concatenate([observed(ground, i) for i in images]), np.full((n * len(images), 2), 0.3),
        np.ones(n * len(images), dtype=np.bool_), np.full(n * len(images), block, dtype=np.int32),
    )  # fmt: skip


NOTHING = together([])


@dataclass
class Fused:
    """Cells and directory of a network, changed as a run and a withdrawal do it, but without a store.

    It answers what `take_points` and `take_points_seen` ask of a version of the network.
    """

    cells: dict[int, Cell] = field(default_factory=dict)
    directory: dict[str, int] = field(default_factory=dict)
    cover: Cover = COVER

    def cell(self, number: int, *, with_sums: bool = True) -> Cell:
        return self.cells.get(number, empty_cell(number, P))

    def cell_numbers(self) -> tuple[int, ...]:
        return tuple(sorted(self.cells))

    def tile_numbers(self) -> tuple[int, ...]:
        return tuple(sorted({tile for number in self.cells for tile in self.cover.holders(number)}))

    def tile_images(self, tile: int) -> Index:
        return np.unique(np.concatenate([self.cell(number).images for number in self.cover.cells_held(tile)]))

    def add(self, rays: LooseRays) -> Registration:
        """New rays come."""
        ids = np.unique(rays.point_ids)
        known = np.array([self.directory.get(str(i), -1) for i in ids], dtype=np.int64)
        return self._change(rays, take_points(self, ids, known))  # type: ignore[arg-type]

    def withdraw(self, images: Collection[int]) -> Registration:
        """Images leave."""
        rows = (ROW + np.array(sorted(images))).astype(np.int32)
        return self._change(NOTHING, take_points_seen(self, rows))  # type: ignore[arg-type]

    def _change(self, new: LooseRays, out: TakenOut) -> Registration:
        registration = register(together([new, out.rays]), IMAGES, ROWS, self.cover)
        for number in {*registration.arrivals, *out.departures}:
            cell = without_points(self.cell(number), out.departures.get(number, np.empty(0, dtype="U1")))
            if number in registration.arrivals:
                cell = with_points(cell, registration.arrivals[number])
            self.cells[number] = summed(cell, IMAGES.take(cell.images - ROW))
            if not len(cell):
                assert not len(cell.images) and not len(cell.rays)
                del self.cells[number]
        ids, cells = registration.directory
        listed = (cells >= 0) & (cells != Relocations.of(out, registration).before)
        self.directory |= {str(i): int(c) for i, c in zip(ids[listed], cells[listed], strict=True)}
        return registration

    def cell_of(self, point: str) -> tuple[Cell, int]:
        """The cell that holds a point, and its row; fails unless there is exactly one, and it is the one of the directory."""
        found = [(cell, int(row)) for cell in self.cells.values() for row in np.flatnonzero(cell.point_ids == point)]
        assert len(found) == 1
        assert self.directory[point] == found[0][0].number
        return found[0]

    def rays(self) -> list[tuple[str, int, float, float]]:
        """All rays of all cells: point, row of the network's image, sample, line."""
        return sorted(
            (str(cell.point_ids[p]), int(cell.images[i]), float(sample), float(line))
            for cell in self.cells.values()
            for p, i, (sample, line) in zip(cell.rays.point, cell.rays.image, cell.rays.observed, strict=True)
        )

    def rays_of(self, point: str) -> list[tuple[int, float, float]]:
        """Rays of a point: row of the network's image, sample, line."""
        return [ray[1:] for ray in self.rays() if ray[0] == point]

    def origin(self, point: str) -> Array:
        cell, row = self.cell_of(point)
        return np.asarray(cell.origin[row])


def assert_same(found: Cell, expected: Cell) -> None:
    """Bit by bit, but for the width of texts."""
    assert found.number == expected.number
    for name in ("point_ids", "origin", "linearised_at", "images", "theta"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for name in ("point", "image", "observed", "sigma", "accepted"):
        np.testing.assert_array_equal(getattr(found.rays, name), getattr(expected.rays, name))
        assert getattr(found.rays, name).dtype == getattr(expected.rays, name).dtype
    assert found.images.dtype == expected.images.dtype == np.int32


def assert_same_network(found: Fused, expected: Fused) -> None:
    """The same cells bit by bit, with their sums."""
    assert found.cell_numbers() == expected.cell_numbers()
    for number, cell in found.cells.items():
        assert_same(cell, expected.cells[number])
        np.testing.assert_array_equal(cell.sums.information, expected.cells[number].sums.information)
        np.testing.assert_array_equal(cell.sums.vector, expected.cells[number].sums.vector)
        assert cell.sums.redundancy == expected.cells[number].sums.redundancy
        assert cell.sums.misclosure == expected.cells[number].sums.misclosure
    for cell in expected.cells.values():
        for point in cell.point_ids:
            assert found.directory[str(point)] == cell.number


def position(ground: Array, images: Sequence[int]) -> Array:
    """Intersection (3,) of the rays of one point in some images."""
    return positions(["x"], ground, images)[0]


def positions(ids: Sequence[str], ground: Array, images: Sequence[int]) -> Array:
    """Intersections (n, 3) of the rays of points in some images, the images in the order of their names."""
    rays = arriving(ids, ground, images)
    by_name = sorted(range(len(NAMES)), key=lambda k: NAMES[k])
    image = np.array([by_name.index(int(row) - ROW) for row in rays.image], dtype=np.int32)
    point = np.tile(np.arange(len(ids), dtype=np.int32), len(images))
    bundle = sorted_rays(point, image, rays.observed, rays.sigma, np.ones(len(rays), dtype=np.bool_))
    return intersect(IMAGES.take(by_name), bundle, len(ids))


def cell_at(geocentric: Array) -> int:
    geodetic = geocentric_to_geodetic(geocentric[None], COVER.ellipsoid)
    return int(COVER.cells_of(geodetic[:, 0], geodetic[:, 1])[0])


THERE = places([35.0], [45.0])
"""In the middle of a cell, not at its border, as noise must not decide."""
