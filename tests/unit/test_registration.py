"""Registration: a position from all the rays that a point has, whenever they came; every ray in one cell, exactly once."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from orchestration.change import TakenOut, take_points, take_points_seen
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geocentric_to_geodetic, geodetic_to_geocentric
from submin.network.cell import Cell, RegisteredPoints, empty_cell, summed, with_points, without_points
from submin.network.id_numbers import numbered
from submin.network.registration import (
    IN_THE_NETWORK,
    SAME_POINT_METRES,
    LooseRays,
    Registration,
    arranged,
    by_points,
    contradictions,
    joined,
    locate,
    register,
    taken_out,
    together,
)
from submin.sensors import sensor_named
from submin.sensors.base import Ground, Projection
from submin.sensors.rpc import RpcSensor
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

    def candidate_cells(self, ids: NDArray[np.str_]) -> NDArray[np.int64]:
        return np.array([self.directory.get(str(i), -1) for i in ids], dtype=np.int64)

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
        return self._change(rays, take_points(self, np.unique(rays.point_ids)))  # type: ignore[arg-type]

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
        self.directory |= {str(i): int(c) for i, c in zip(ids, cells, strict=True) if c >= 0}
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


# Where points go


def test_position_comes_from_all_rays() -> None:
    fused = Fused()
    ids = [f"p{i}" for i in range(6)]
    ground = places([-400.0, -250.0, -80.0, 90.0, 260.0, 400.0], [330.0, -330.0, 100.0, -100.0, 40.0, 200.0])
    registration = fused.add(arriving(ids, ground, [0, 2, 4]))
    expected = positions(ids, ground, [0, 2, 4])
    for k, point in enumerate(ids):
        np.testing.assert_array_equal(fused.origin(point), expected[k])
        assert np.linalg.norm(fused.origin(point) - ground[k]) < 2.0
        cell, row = fused.cell_of(point)
        assert cell.number == cell_at(ground[k])
        np.testing.assert_array_equal(cell.linearised_at[row], cell.origin[row])
    assert len(fused.cells) > 1
    assert registration.apart.max() < 4.0
    assert not registration.outside.any()
    assert registration.directory[0].tolist() == ids


def test_rays_that_were_rejected_take_part_in_the_position_and_are_judged_afresh() -> None:
    fused = Fused()
    fused.add(arriving(["p", "q"], np.concatenate([THERE, THERE + 0.5]), [0, 1]))
    cell, row = fused.cell_of("p")
    no_more = cell.rays.with_accepted((cell.rays.point != row) & (cell.rays.image == 0))
    fused.cells[cell.number] = replace(cell, rays=no_more)
    fused.add(arriving(["p"], THERE, [2]))
    np.testing.assert_array_equal(fused.origin("p"), position(THERE, [0, 1, 2]))
    cell, row = fused.cell_of("p")
    assert cell.rays.accepted[cell.rays.point == row].tolist() == [True] * 3
    # the judgement of points that stayed is not touched here
    assert cell.rays.accepted[cell.rays.point != row].tolist() == [True, False]


def test_single_ray_is_registered_at_the_mean_height_and_pending() -> None:
    fused = Fused()
    registration = fused.add(arriving(["p"], THERE, [0]))
    cell, _ = fused.cell_of("p")
    geodetic = geocentric_to_geodetic(fused.origin("p")[None])
    assert abs(geodetic[0, 2]) < 1e-3
    assert np.linalg.norm(fused.origin("p") - THERE[0]) > 300.0
    assert cell.number == cell_at(fused.origin("p")) != cell_at(THERE[0])
    # a pending point is in its cell, and says nothing
    assert cell.sums.redundancy == 0 and not cell.sums.information.any() and not cell.sums.vector.any()
    assert registration.apart[0] < 1e-6


def test_pending_point_moves_with_its_second_ray_and_takes_the_first_along_once() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0]))
    first = fused.cell_of("p")[0].number
    registration = fused.add(arriving(["p"], THERE, [1]))
    cell, _ = fused.cell_of("p")
    assert cell.number == cell_at(THERE[0]) != first
    assert list(registration.arrivals) == [cell.number]
    assert registration.arrivals[cell.number].image.tolist() == [ROW + 1, ROW]  # both, whichever is new
    assert (registration.directory[0].tolist(), registration.directory[1].tolist()) == (["p"], [cell.number])
    assert [image for image, *_ in fused.rays_of("p")] == [ROW, ROW + 1]
    np.testing.assert_array_equal(np.array([r[1:] for r in fused.rays_of("p")]), np.stack([observed(THERE, i)[0] for i in (0, 1)]))
    # nothing is left of the cell that it came from
    assert fused.cell_numbers() == (cell.number,)
    np.testing.assert_array_equal(cell.images, [ROW, ROW + 1])
    assert cell.sums.redundancy == 1


def test_point_that_comes_back_to_its_cell_is_there_once() -> None:
    # at the mean height the single ray lands on the spot
    there = places([35.0], [45.0], height=0.0)
    fused = Fused()
    fused.add(arriving(["p"], there, [0]))
    number = fused.cell_of("p")[0].number
    registration = fused.add(arriving(["p"], there, [1]))
    assert list(registration.arrivals) == [number]
    cell, row = fused.cell_of("p")
    assert cell.number == number and len(cell) == 1
    assert [image for image, *_ in fused.rays_of("p")] == [ROW, ROW + 1]
    np.testing.assert_array_equal(fused.origin("p"), position(there, [0, 1]))
    np.testing.assert_array_equal(cell.linearised_at[row], cell.origin[row])


def test_neighbours_in_a_cell_stay_when_a_point_leaves() -> None:
    ids = ["a", "b", "c"]
    ground = places([35.0, 40.0, 45.0], [45.0, 43.0, 41.0])
    fused = Fused()
    fused.add(arriving(ids, ground, [0]))
    first = fused.cell_of("a")[0].number
    assert {fused.cell_of(point)[0].number for point in ids} == {first}
    before = {point: (fused.rays_of(point), fused.origin(point)) for point in ids}
    registration = fused.add(arriving(["b"], ground[1:2], [1]))
    assert registration.directory[0].tolist() == ["b"]
    assert fused.cells[first].point_ids.tolist() == ["a", "c"]
    assert fused.cell_of("b")[0].number != first
    for point in ("a", "c"):
        assert fused.rays_of(point) == before[point][0]
        np.testing.assert_array_equal(fused.origin(point), before[point][1])
    assert fused.rays_of("b")[0] == before["b"][0][0]


def test_registration_is_never_final() -> None:
    # two rays place it; a third that disagrees by hundreds of metres takes it to another cell, and its leaving brings it back
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1]))
    number, origin = fused.cell_of("p")[0].number, fused.origin("p").copy()
    elsewhere = places([320.0], [-280.0])
    registration = fused.add(arriving(["p"], elsewhere, [2]))
    cell, _ = fused.cell_of("p")
    assert list(registration.arrivals) == [cell.number] != [number]
    assert cell.number == cell_at(fused.origin("p"))
    assert np.linalg.norm(fused.origin("p") - origin) > 50.0
    assert len(fused.rays_of("p")) == 3
    assert 200.0 < registration.apart[0] < SAME_POINT_METRES
    fused.withdraw([2])
    assert fused.cell_of("p")[0].number == number
    np.testing.assert_array_equal(fused.origin("p"), origin)


def test_linearisation_of_points_that_stay_is_left_alone() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1]))
    number = fused.cell_of("p")[0].number
    cell = fused.cells[number]
    fused.cells[number] = replace(cell, linearised_at=cell.linearised_at + 7.0, theta=cell.theta + 3.0)
    fused.add(arriving(["q"], THERE, [0, 3]))
    cell, row = fused.cell_of("p")
    np.testing.assert_array_equal(cell.linearised_at[row], cell.origin[row] + 7.0)
    cell, row = fused.cell_of("q")
    assert cell.number == number
    np.testing.assert_array_equal(cell.linearised_at[row], cell.origin[row])
    # images known to the cell keep their corrections, new ones start from none
    np.testing.assert_array_equal(cell.images, [ROW, ROW + 1, ROW + 3])
    np.testing.assert_array_equal(cell.theta, np.repeat([[3.0], [3.0], [0.0]], P, axis=1))


# Whenever they came


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_three_rays_in_any_order_or_together_register_alike(order: tuple[int, ...]) -> None:
    fused, at_once = Fused(), Fused()
    at_once.add(arriving(["p"], THERE, [0, 1, 2]))
    for image in order:
        fused.add(arriving(["p"], THERE, [image]))
    assert_same_network(fused, at_once)


def test_row_of_an_image_in_the_network_leaves_no_trace() -> None:
    rng = np.random.default_rng(8)
    ids = [f"p{i:02d}" for i in range(30)]
    rays = arriving(ids, places(rng.uniform(-550.0, 550.0, 30).tolist(), rng.uniform(-550.0, 550.0, 30).tolist()), range(5))
    rays = rays.take(rng.uniform(size=len(rays)) < 0.6)
    expected = register(rays, IMAGES, ROWS, COVER)
    for order in ([4, 3, 2, 1, 0], [2, 0, 4, 1, 3]):
        # image k of the set is now in row 100 + 7 times its place in the order
        place = np.argsort(order)
        rows = (100 + 7 * np.arange(5)).astype(np.int32)
        moved = replace(rays, image=rows[place[rays.image - ROW]])
        found = register(moved, IMAGES.take(order), rows, COVER)
        np.testing.assert_array_equal(found.directory[0], expected.directory[0])
        np.testing.assert_array_equal(found.directory[1], expected.directory[1])
        np.testing.assert_array_equal(found.apart, expected.apart)
        assert found.arrivals.keys() == expected.arrivals.keys()
        for number, points in found.arrivals.items():
            np.testing.assert_array_equal(points.origin, expected.arrivals[number].origin)


@dataclass(frozen=True)
class Blocks:
    """Random blocks: each brings the rays of one image, of points that the others see too."""

    ids: list[str]
    rays: tuple[LooseRays, ...]

    @classmethod
    def random(cls, seed: int, wild: float = 0.0) -> Blocks:
        """``wild``: share of the rays that point hundreds of metres elsewhere."""
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 30))
        ids = [f"p{'x' * int(rng.integers(0, 5))}{i:02d}" for i in range(n)]
        ground = places(rng.uniform(-800.0, 800.0, n).tolist(), rng.uniform(-800.0, 800.0, n).tolist())
        every = []
        for image in range(len(VIEWS)):
            rays = arriving(ids, ground, [image], block=image)
            off = (rng.uniform(size=n) < wild)[:, None] * rng.uniform(-900.0, 900.0, (n, 2))
            rays = replace(rays, observed=rays.observed + off, sigma=rng.uniform(0.1, 1.0, (n, 2)))
            some = rays.take(rng.permutation(n)[: rng.integers(0, n + 1)])  # type: ignore[arg-type]
            # now and then a point is measured twice in an image
            every.append(together([some, replace(some, observed=some.observed + 0.2).take(rng.uniform(size=len(some)) < 0.1)]))
        return cls(ids, tuple(every))

    def some(self, images: Sequence[int]) -> LooseRays:
        """The rays of some images, one block after another."""
        return together([self.rays[image] for image in images])


def in_groups(rng: np.random.Generator, images: Sequence[int]) -> list[list[int]]:
    """Images in random order, cut into random groups."""
    shuffled = rng.permutation(np.array(images, dtype=np.int64))
    cuts = np.flatnonzero(rng.uniform(size=max(len(shuffled) - 1, 0)) < 0.6) + 1
    return [group.tolist() for group in np.split(shuffled, cuts)]


@EXAMPLES
@given(SEEDS, st.sampled_from([0.0, 0.2]))
def test_cells_do_not_depend_on_the_order_and_grouping_of_arrival(seed: int, wild: float) -> None:
    blocks, rng = Blocks.random(seed, wild), np.random.default_rng(seed + 1)
    at_once, fused = Fused(), Fused()
    at_once.add(blocks.some(range(5)))
    for group in in_groups(rng, range(5)):
        rays = blocks.some(group)
        fused.add(rays.take(rng.permutation(len(rays))))  # type: ignore[arg-type]
    assert_same_network(fused, at_once)


@EXAMPLES
@given(SEEDS, st.sampled_from([0.0, 0.2]))
def test_every_ray_is_in_one_cell_exactly_once(seed: int, wild: float) -> None:
    blocks, rng, fused = Blocks.random(seed, wild), np.random.default_rng(seed + 1), Fused()
    came: list[int] = []
    for group in in_groups(rng, range(5)):
        fused.add(blocks.some(group))
        came += group
        rays = blocks.some(came)
        expected = zip(rays.point_ids.tolist(), rays.image.tolist(), *rays.observed.T.tolist(), strict=True)
        assert fused.rays() == sorted(expected)
        for point in np.unique(rays.point_ids):
            cell, row = fused.cell_of(str(point))
            assert cell.number == cell_at(cell.origin[row])
        for cell in fused.cells.values():
            assert cell.point_ids.tolist() == sorted(set(cell.point_ids.tolist()))
            np.testing.assert_array_equal(cell.images, np.unique(cell.images[cell.rays.image]))
            np.testing.assert_array_equal(np.unique(cell.rays.point), np.arange(len(cell)))


@EXAMPLES
@given(SEEDS, st.sampled_from([0.0, 0.2]))
def test_withdrawn_images_leave_a_network_that_never_had_them(seed: int, wild: float) -> None:
    # images come and go and come again, one or several at a time, in any order
    blocks, rng, fused = Blocks.random(seed, wild), np.random.default_rng(seed + 1), Fused()
    here: set[int] = set()
    for _ in range(6):
        group = rng.permutation(5)[: rng.integers(1, 4)].tolist()
        new, old = [i for i in group if i not in here], [i for i in group if i in here]
        if new:
            fused.add(blocks.some(new))
        if old:
            fused.withdraw(old)
        here = (here | set(new)) - set(old)
        never = Fused()
        never.add(blocks.some(sorted(here)))
        assert_same_network(fused, never)
        assert all(np.isin(cell.images - ROW, sorted(here)).all() for cell in fused.cells.values())
    fused.withdraw(here)
    assert not fused.cells


def test_a_withdrawn_ray_changes_no_point_that_it_does_not_see() -> None:
    blocks, fused = Blocks.random(3), Fused()
    fused.add(blocks.some(range(5)))
    registration = fused.withdraw([4])
    seen = set(blocks.rays[4].point_ids.tolist())
    others = set(blocks.some(range(4)).point_ids.tolist())
    assert seen - others and seen & others and others - seen
    # of a point that only it saw nothing is left to be registered
    assert set(registration.directory[0].tolist()) == seen & others
    for point in seen - others:
        assert not fused.rays_of(point) and not any(point in cell.point_ids for cell in fused.cells.values())


@EXAMPLES
@given(SEEDS)
def test_company_does_not_matter(seed: int) -> None:
    # each point by itself is registered, bit by bit, as among all others
    rays = Blocks.random(seed, 0.2).some(range(5))
    whole = register(rays, IMAGES, ROWS, COVER)
    origin = {str(i): o for points in whole.arrivals.values() for i, o in zip(points.point_ids, points.origin, strict=True)}
    for point, number in zip(*whole.directory, strict=True):
        mine = rays.point_ids == point
        alone = register(rays.take(mine), IMAGES, ROWS, COVER)
        assert alone.directory[1].tolist() == list(alone.arrivals) == [number]
        np.testing.assert_array_equal(alone.arrivals[int(number)].origin[0], origin[str(point)])
        np.testing.assert_array_equal(alone.apart, whole.apart[whole.directory[0] == point])
        np.testing.assert_array_equal(alone.outside, whole.outside[mine])


@EXAMPLES
@given(SEEDS, st.integers(1, 40))
def test_parts_put_together_are_the_whole(seed: int, parts: int) -> None:
    rays = Blocks.random(seed, 0.2).some(range(5))
    whole = register(rays, IMAGES, ROWS, COVER)
    rows = by_points(rays, parts)
    assert sorted(np.concatenate(rows).tolist()) == list(range(len(rays)))
    found = arranged(rays, joined([locate(rays.take(part), IMAGES, ROWS, COVER) for part in rows], rows))
    for name in ("apart", "counts", "outside"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    for k in range(2):
        np.testing.assert_array_equal(found.directory[k], whole.directory[k])
    assert found.arrivals.keys() == whole.arrivals.keys()
    for number, points in found.arrivals.items():
        expected = whole.arrivals[number]
        np.testing.assert_array_equal(points.point_ids, expected.point_ids)
        np.testing.assert_array_equal(points.origin, expected.origin)
        mine, theirs = (sorted(zip(p.point, p.image, *p.observed.T, *p.sigma.T, strict=True)) for p in (points, expected))
        assert mine == theirs


@EXAMPLES
@given(st.lists(st.text(max_size=4).filter(lambda text: "\0" not in text), max_size=30))
def test_numbers_of_texts_are_those_of_unique(texts: list[str]) -> None:
    expected, place = np.unique(np.array(texts, dtype=np.str_), return_inverse=True)
    found, at = numbered(np.array(texts, dtype=np.str_))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(at, place)


@pytest.mark.parametrize("twin", ["a twin", "twin"])
def test_points_of_other_names_in_the_cell_that_the_directory_names_are_not_taken_for_it(twin: str) -> None:
    # two ids of one hash: the directory names the cell of the other point
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1]))
    number = fused.cell_of("p")[0].number
    fused.directory[twin] = number
    elsewhere = places([-330.0], [-340.0])
    fused.add(arriving([twin], elsewhere, [0, 1]))
    assert fused.cell_of(twin)[0].number == cell_at(elsewhere[0]) != number
    assert len(fused.rays_of("p")) == 2 and len(fused.rays_of(twin)) == 2


# Rays of two places


def rays_at(images: ImageSet, grounds: Sequence[Array], sigma: Sequence[float] | None = None) -> LooseRays:
    """One exact ray of point ``p`` in each image, each towards a ground point (1, 3) of its own."""
    n = len(grounds)
    return LooseRays.of(
        np.full(n, "p"), np.arange(ROW, ROW + n, dtype=np.int32), np.concatenate([exactly(g, k, images) for k, g in enumerate(grounds)]),
        np.repeat(np.array(sigma or [0.3] * n)[:, None], 2, axis=1), np.ones(n, dtype=np.bool_), np.arange(n, dtype=np.int32),
    )  # fmt: skip


def distance_of_rays(here: Array, there: Array, views: Sequence[tuple[float, float]]) -> float:
    """Shortest distance of the lines of sight through two ground points (east, north, up)."""
    u, v = (np.array([-east, -north, 1.0]) for east, north in views)
    normal = np.cross(u, v)
    return float(abs((there - here) @ normal) / np.linalg.norm(normal))


@pytest.mark.parametrize("tangent", [0.1, 0.3, 0.5])
@pytest.mark.parametrize(
    ("east", "north", "up"), [(0.0, 300.0, 0.0), (200.0, -1500.0, 100.0), (-100.0, 3000.0, -200.0), (900.0, 20.0, 0.0)]
)
@pytest.mark.parametrize("sigma", [(0.3, 0.3), (0.2, 1.0)])
def test_two_rays_of_two_places_are_as_far_apart_as_they_pass_each_other(
    tangent: float, east: float, north: float, up: float, sigma: tuple[float, float]
) -> None:
    views = ((-tangent, 0.0), (tangent, 0.0))
    images = image_set(views)
    registration = register(rays_at(images, [places([0.0], [0.0]), places([east], [north], 400.0 + up)], sigma), images, ROWS[:2], COVER)
    expected = distance_of_rays(np.zeros(3), np.array([east, north, up]), views)
    np.testing.assert_allclose(registration.apart, expected, rtol=5e-3)


@pytest.mark.parametrize(("here", "there"), [(1, 1), (1, 5), (2, 3), (2, 12), (9, 2), (6, 6)])
def test_two_places_are_as_far_apart_however_many_rays_see_each(here: int, there: int) -> None:
    # views to the west and to the east: height takes nothing up of a distance to the north
    count = here + there
    images = image_set([((-0.1, 0.1)[k % 2], 0.0) for k in range(count)], [f"image {k:02d}" for k in range(count)])
    rows = np.arange(ROW, ROW + count, dtype=np.int32)
    grounds = [places([0.0], [0.0])] * here + [places([0.0], [800.0])] * there
    np.testing.assert_allclose(register(rays_at(images, grounds), images, rows, COVER).apart, 800.0, rtol=5e-3)


def contradicting(rays: LooseRays) -> dict[int, tuple[str, float]]:
    return contradictions(rays, register(rays, IMAGES, ROWS, COVER), IMAGES, ROWS, COVER)


def test_the_block_that_contradicts_what_came_before_is_named_and_no_later_one() -> None:
    far, other = places([3000.0], [-2500.0]), places([-3000.0], [2500.0])
    parts = [
        arriving(["p", "q"], np.concatenate([THERE, THERE]), [0], block=0), arriving(["p"], far, [1], block=1),
        arriving(["p", "q"], np.concatenate([THERE, other]), [2], block=2), arriving(["p"], THERE, [3], block=3),
    ]  # fmt: skip
    rays = together(parts)
    found = contradicting(rays)
    assert {block: point for block, (point, _) in found.items()} == {1: "p", 2: "q"}
    # what the network has comes before every block
    known = together([replace(parts[1], block=np.full(1, IN_THE_NETWORK, dtype=np.int32)), *(parts[k] for k in (0, 3))])
    found = contradicting(known)
    assert {block: point for block, (point, _) in found.items()} == {0: "p", 3: "p"}


def test_a_blunder_that_stage_one_has_found_is_no_second_place() -> None:
    rays = together(
        [arriving(["p"], THERE, [0, 1]), replace(arriving(["p"], places([3000.0], [0.0]), [2], block=1), accepted=np.array([False]))]
    )
    assert not contradicting(rays)


@pytest.mark.parametrize("km", [1.0, 3.0, 5.5, 6.0, 7.0, 8.0])
def test_nor_where_it_draws_the_point_out_of_sight_of_a_camera(km: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a line scanner does, a camera answers only for its image and a little beside it; registration still takes all rays."""
    project, images = RpcSensor.project, replace(IMAGES, cameras=IMAGES.cameras.copy())
    images.cameras[2, -2:] *= 10.0  # half of its size: the camera of the blunder sees far

    def near_the_image(sensor: RpcSensor, cameras: Array, parameters: Array, ground: Ground, image: Index, *more: Any) -> Projection:
        seen = project(sensor, cameras, parameters, ground, image, *more)
        off = np.abs(seen.image - 5000.0).max(axis=1) > 1.06 * cameras[image, -1]
        return replace(seen, image=np.where(off[:, None], np.nan, seen.image))

    good, blunder = arriving(["p"], places([2000.0], [0.0]), [0, 1]), arriving(["p"], places([2000.0 + 1000.0 * km], [0.0]), [2], block=1)
    rays = together([good, replace(blunder, accepted=np.array([False]))])
    monkeypatch.setattr(RpcSensor, "project", near_the_image)
    registration = register(rays, images, ROWS, COVER)
    assert np.isinf(registration.apart[0]) == (km > 2.0)
    assert not contradictions(rays, registration, images, ROWS, COVER)


def test_apart_is_told_of_the_point_and_of_no_other() -> None:
    far = places([3000.0], [-2500.0])
    rays = together([arriving(["p"], THERE, [0, 1]), arriving(["q", "r"], np.concatenate([THERE, far]), [0, 1, 2], block=1),
                     arriving(["p"], far, [2, 3], block=2)])  # fmt: skip
    registration = register(rays, IMAGES, ROWS, COVER)
    of_p, told = registration.directory[0] == "p", registration.apart
    assert told[of_p].min() > SAME_POINT_METRES
    assert told[~of_p].max() < 4.0
    ((block, (point, metres)),) = contradictions(rays, registration, IMAGES, ROWS, COVER).items()
    assert (block, point) == (2, "p")
    assert metres == pytest.approx(told[of_p][0])


@pytest.mark.parametrize(("bias_px", "contradicts"), [(10.0, True), (300.0, True), (700.0, False)])
def test_cameras_known_to_kilometres_only_explain_kilometres(bias_px: float, contradicts: bool) -> None:
    """3 km apart; four sigmas of both axes, half-metre pixels, one camera to each side: 5.7 bias sigmas in metres."""
    images = replace(IMAGES, priors=tuple(replace(prior, a_priori=APriori(bias_px=bias_px)) for prior in IMAGES.priors))
    rays = together([arriving(["p"], THERE, [0, 1]), arriving(["p"], places([3000.0], [0.0]), [2], block=1)])
    assert bool(contradictions(rays, register(rays, images, ROWS, COVER), images, ROWS, COVER)) is contradicts


def test_cameras_found_to_be_bad_explain_no_more_than_before() -> None:
    """What was found depends on what came before; whether a block contradicts must not."""
    rays = together([arriving(["p"], THERE, [0, 1]), arriving(["p"], places([3000.0], [0.0]), [2], block=1)])
    released = IMAGES.release(np.ones(len(IMAGES), dtype=np.bool_))
    assert contradictions(rays, register(rays, released, ROWS, COVER), released, ROWS, COVER) == contradicting(rays) != {}


@pytest.mark.parametrize(("rays_there", "most"), [(1, 1.02), (2, 1.2)])
def test_rays_of_a_known_point_elsewhere_are_apart_from_those_in_the_network(rays_there: int, most: float) -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1, 4]))
    far = places([2315.0], [-1955.0])
    registration = fused.add(arriving(["p"], far, [2, 3][:rays_there]))
    # views that lean to all sides spread further, as no one height suits them
    distance = np.hypot(2280.0, 2000.0)
    told = registration.apart
    assert distance < told.min() <= told.max() < most * distance
    assert told.shape == (1,)


def test_a_single_ray_is_not_apart_from_itself_wherever_it_lies() -> None:
    ground = places([20.0, 900.0, -5000.0], [30.0, -100.0, 6000.0])
    registration = register(arriving(["p", "q", "r"], ground, [1]), IMAGES, ROWS, COVER)
    np.testing.assert_allclose(registration.apart, 0.0, rtol=0.0, atol=1e-6)


def unreachable() -> ImageSet:
    """The images, but the second turns back at 2,500 pixels from its middle: nothing on the ground is seen at sample 9,500."""
    images = replace(IMAGES, cameras=IMAGES.cameras.copy())
    images.cameras[1, 10 + 4 * 7 + 2] = -images.cameras[1, 10 + 4 * 1 + 2]
    return images


def test_rays_that_reach_no_ground_go_nowhere() -> None:
    rays = arriving(["lost", "p"], np.concatenate([THERE, THERE]), [0])
    bad = replace(rays, image=np.array([ROW + 1, ROW], dtype=np.int32), observed=np.array([[9500.0, 5000.0], rays.observed[1]]))
    registration = register(bad, unreachable(), ROWS, COVER)
    assert np.isinf(registration.apart[0]) and registration.apart[1] == 0.0
    assert not registration.outside.any()
    assert [new.point_ids.tolist() for new in registration.arrivals.values()] == [["p"]]
    assert registration.directory[0].tolist() == ["lost", "p"]
    assert registration.directory[1].tolist() == [-1, next(iter(registration.arrivals))]


def test_nothing_but_rays_that_reach_no_ground() -> None:
    rays = replace(arriving(["lost"], THERE, [1]), observed=np.array([[9500.0, 5000.0]]))
    registration = register(rays, unreachable(), ROWS, COVER)
    assert np.isinf(registration.apart).all() and not registration.arrivals
    assert registration.directory[1].tolist() == [-1]


def test_no_rays_are_registered_nowhere() -> None:
    registration = register(NOTHING, IMAGES.take([]), ROWS[:0], COVER)
    assert not registration.arrivals
    assert [len(part) for part in (*registration.directory, registration.apart, registration.outside)] == [0] * 4


def test_points_outside_the_area_are_marked_and_belong_to_the_nearest_core() -> None:
    fused = Fused()
    ground = places([20.0, 900.0], [30.0, 20.0])
    registration = fused.add(arriving(["in", "out"], ground, [0, 1]))
    np.testing.assert_array_equal(registration.outside, [False, True, False, True])
    assert COVER.owner(fused.cell_of("out")[0].number) == 4 * COVER.columns + COVER.columns - 1


# Rays and points between cells


def test_rays_taken_out_are_all_rays_of_the_chosen_points() -> None:
    fused = Fused()
    ground = places([35.0, 37.0, 39.0], [45.0, 46.0, 47.0])
    fused.add(arriving(["a", "b", "c"], ground, [1, 3]))
    cell, _ = fused.cell_of("b")
    assert len(cell) == 3
    rays = taken_out(cell, np.array([True, False, True]))
    assert len(rays) == 4
    assert rays.block.tolist() == [IN_THE_NETWORK] * 4
    expected = {("a", ROW + 1), ("a", ROW + 3), ("c", ROW + 1), ("c", ROW + 3)}
    assert set(zip(rays.point_ids.tolist(), rays.image.tolist(), strict=True)) == expected
    for k in range(4):
        j, image = "abc".index(rays.point_ids[k]), int(rays.image[k]) - ROW
        np.testing.assert_array_equal(rays.observed[k], observed(ground, image)[j])
    np.testing.assert_array_equal(rays.sigma, 0.3)
    assert len(taken_out(cell, np.zeros(3, dtype=np.bool_))) == 0


def test_blocks_can_be_put_together_and_left_out() -> None:
    parts = [arriving(["a"], THERE, [0], block=0), arriving(["a long name"], THERE, [1], block=1), arriving(["c"], THERE, [2], block=2)]
    rays = together(parts)
    assert len(rays) == 3 and len(NOTHING) == 0
    assert rays.point_ids.tolist() == ["a", "a long name", "c"]
    kept = rays.take(rays.block != 1)
    assert kept.point_ids.tolist() == ["a", "c"] and kept.block.tolist() == [0, 2]
    for name in ("image", "observed", "sigma"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(rays, name)[[0, 2]])
    assert (rays.image.dtype, rays.block.dtype) == (np.int32, np.int32)


def random_points(rng: np.random.Generator, ids: Sequence[str]) -> RegisteredPoints:
    """Points with one to four rays each, in any order, seen by some of a dozen images."""
    count = rng.integers(1, 5, len(ids))
    point = rng.permutation(np.repeat(np.arange(len(ids)), count)).astype(np.int32)
    r = len(point)
    return RegisteredPoints(
        np.array(ids, dtype=np.str_), rng.normal(0.0, 4e6, (len(ids), 3)), point,
        rng.choice(12, r).astype(np.int32), rng.normal(5e3, 1e3, (r, 2)), rng.uniform(0.3, 1.0, (r, 2)),
    )  # fmt: skip


def random_ids(rng: np.random.Generator) -> tuple[list[str], list[str]]:
    """Two sets of ids, neither of which need have any."""
    ids = [f"{'abcde'[int(rng.integers(5))]}/{i}" for i in range(int(rng.integers(0, 25)))]
    ids = rng.permutation(np.array(ids, dtype=np.str_)).tolist()
    half = int(rng.integers(0, len(ids) + 1))
    return ids[:half], ids[half:]


@EXAMPLES
@given(SEEDS)
def test_points_that_come_and_go_leave_no_trace(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mine, theirs = random_ids(rng)
    cell = with_points(empty_cell(7, P), random_points(rng, mine))
    # adjusted meanwhile
    cell = replace(
        cell, linearised_at=cell.origin + rng.normal(size=cell.origin.shape), theta=rng.normal(size=cell.theta.shape),
        rays=cell.rays.with_accepted(rng.uniform(size=len(cell.rays)) < 0.7),
    )  # fmt: skip
    new = random_points(rng, theirs)
    more = with_points(cell, new)
    assert more.point_ids.tolist() == sorted(mine + theirs)
    assert len(more.rays) == len(cell.rays) + len(new.point)
    assert_same(without_points(more, new.point_ids), cell)
    # ids that the cell does not hold are no matter
    assert_same(without_points(cell, new.point_ids), cell)
    assert_same(without_points(more, more.point_ids), empty_cell(7, P))


@EXAMPLES
@given(SEEDS)
def test_points_that_go_and_come_back_are_as_they_were(seed: int) -> None:
    rng = np.random.default_rng(seed)
    staying, leaving = random_ids(rng)
    points = random_points(rng, staying + leaving)
    cell = with_points(empty_cell(7, P), points)
    chosen = np.isin(cell.point_ids, leaving)
    rays = taken_out(cell, chosen)
    ids, row = np.unique(rays.point_ids, return_inverse=True)
    order = rng.permutation(len(rays))
    back = RegisteredPoints(
        ids, cell.origin[chosen], row.astype(np.int32)[order], rays.image[order], rays.observed[order], rays.sigma[order]
    )  # fmt: skip
    less = without_points(cell, np.array(leaving, dtype=np.str_))
    assert less.point_ids.tolist() == sorted(staying)
    np.testing.assert_array_equal(less.images, np.unique(cell.images[cell.rays.image[~chosen[cell.rays.point]]]))
    assert_same(with_points(less, back), cell)
    # in whatever order they came first
    first, then = (random_points(np.random.default_rng(seed + k), part) for k, part in ((1, staying), (2, leaving)))
    assert_same(with_points(with_points(empty_cell(7, P), first), then), with_points(with_points(empty_cell(7, P), then), first))


@EXAMPLES
@given(SEEDS)
def test_a_cell_keeps_what_its_points_came_with(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mine, theirs = random_ids(rng)
    parts = [random_points(rng, ids) for ids in (mine, theirs)]
    cell = with_points(with_points(empty_cell(7, P), parts[0]), parts[1])
    origin = {str(i): o for part in parts for i, o in zip(part.point_ids, part.origin, strict=True)}
    np.testing.assert_array_equal(cell.origin, np.array([origin[i] for i in cell.point_ids.tolist()]).reshape(-1, 3))
    came = sorted(
        (str(part.point_ids[p]), int(i), *o, *s)
        for part in parts
        for p, i, o, s in zip(part.point, part.image, part.observed.tolist(), part.sigma.tolist(), strict=True)
    )
    found = zip(cell.point_ids[cell.rays.point].tolist(), cell.images[cell.rays.image].tolist(), *cell.rays.observed.T.tolist(),
                *cell.rays.sigma.T.tolist(), strict=True)  # fmt: skip
    assert sorted(found) == came
    assert cell.rays.accepted.all() and not cell.theta.any()
