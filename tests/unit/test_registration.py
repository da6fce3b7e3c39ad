"""Registration: a position from all rays, provisional while there is one, final with the second; every ray in one cell, exactly once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import sorted_rays
from submin.geodesy import geocentric_to_geodetic, geodetic_to_geocentric
from submin.network.cell import Cell, empty_cell, summed, with_rays, without_points
from submin.network.registration import SAME_POINT_METRES, ArrivingRays, Registration, register
from submin.sensors import sensor_named
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Index = NDArray[np.int32]

P = 6
CENTRE = np.array([5.4, 43.3])
VIEWS = ((-0.5, 0.1), (0.5, 0.0), (0.0, 0.5), (0.1, -0.5), (0.3, 0.3))
"""Tangents of the views to the east and north. At 400 m above the mean height a single ray lands some 200 m off."""
COVER = Cover((5.4, 43.3), (-600.0, -600.0), 8, 8, 150.0, 40.0)
ROW = 10
"""The images are rows 10, 11, ... of their network."""


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


def image_set() -> ImageSet:
    sensor = sensor_named("rpc")
    cameras = np.stack([sensor.pack(camera(*view), 10000.0, 10000.0) for view in VIEWS])
    priors = tuple(ImagePrior(f"b{i}", f"p{i}", 0.0, APriori(), sensor.bias) for i in range(len(VIEWS)))
    return ImageSet(tuple(f"image {i}" for i in range(len(VIEWS))), ("rpc",) * len(VIEWS), cameras, priors, COVER.ellipsoid)


IMAGES = image_set()


def places(east: Sequence[float], north: Sequence[float], height: float = 400.0) -> Array:
    """Geocentric coordinates (n, 3) of places of the cover's plane, at this height."""
    lon, lat = COVER.geographic(np.array(east), np.array(north))
    return geodetic_to_geocentric(np.column_stack([lon, lat, np.full(len(lon), height)]))


def observed(ground: Array, image: int, seed: int = 1) -> Array:
    """Where an image sees these points (n, 2), with 0.3 pixels of noise."""
    rows = np.arange(len(ground), dtype=np.int32)
    exact = IMAGES.project(np.zeros((len(VIEWS), P)), IMAGES.ground(ground), np.full(len(ground), image, np.int32), rows).image
    return exact + np.random.default_rng(seed + 10 * image).normal(0.0, 0.3, exact.shape)


def arriving(
    ids: Sequence[str], ground: Array, images: Sequence[int], accepted: Sequence[bool] | None = None, block: int = 0
) -> ArrivingRays:
    """Rays of every point in each of some images; ``accepted`` by image."""
    n = len(ids)
    flags = np.repeat(np.ones(len(images), dtype=np.bool_) if accepted is None else np.array(accepted, dtype=np.bool_), n)
    return ArrivingRays(
        np.tile(np.array(ids, dtype=np.str_), len(images)), (ROW + np.repeat(np.array(images, dtype=np.int32), n)).astype(np.int32),
        np.concatenate([observed(ground, i) for i in images]), np.full((n * len(images), 2), 0.3), flags,
        np.full(n * len(images), block, dtype=np.int32),
    )  # fmt: skip


def together(parts: Sequence[ArrivingRays]) -> ArrivingRays:
    names = ("point_ids", "image", "observed", "sigma", "accepted", "block")
    return ArrivingRays(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclass
class Fused:
    """Cells and directory of a network, brought up to date batch by batch as a run does it."""

    cells: dict[int, Cell] = field(default_factory=dict)
    directory: dict[str, int] = field(default_factory=dict)

    def add(self, rays: ArrivingRays, directory: Mapping[str, int] | None = None) -> Registration:
        listed = self.directory if directory is None else directory
        known = np.array([listed.get(str(i), -1) for i in np.unique(rays.point_ids)], dtype=np.int64)
        before = {int(n): self.cells.get(int(n), empty_cell(int(n), P)) for n in np.unique(known[known >= 0])}
        rows = np.arange(ROW, ROW + len(VIEWS), dtype=np.int32)
        registration = register(rays, IMAGES, rows, known, before, COVER)
        for number in {*registration.arrivals, *registration.departures}:
            cell = self.cells.get(number, empty_cell(number, P))
            if number in registration.departures:
                cell = without_points(cell, registration.departures[number])
            if number in registration.arrivals:
                cell = with_rays(cell, registration.arrivals[number])
            self.cells[number] = summed(cell, IMAGES.take(cell.images - ROW)) if len(cell) else cell
        ids, cells = registration.directory
        self.directory |= dict(zip(ids.tolist(), cells.tolist(), strict=True))
        return registration

    def cell_of(self, point: str) -> tuple[Cell, int]:
        """The cell that holds a point, and its row; fails unless there is exactly one, and it is the one of the directory."""
        found = [(cell, int(row)) for cell in self.cells.values() for row in np.flatnonzero(cell.point_ids == point)]
        assert len(found) == 1
        assert self.directory[point] == found[0][0].number
        return found[0]

    def rays_of(self, point: str) -> list[tuple[int, float, float, bool]]:
        """Rays of a point: row of the network's image, sample, line, accepted."""
        rays = []
        for cell in self.cells.values():
            for r in np.flatnonzero(cell.point_ids[cell.rays.point] == point):
                rays.append((int(cell.images[cell.rays.image[r]]), *cell.rays.observed[r].tolist(), bool(cell.rays.accepted[r])))
        return sorted(rays)

    def origin(self, point: str) -> Array:
        cell, row = self.cell_of(point)
        return np.asarray(cell.origin[row])


def position(ground: Array, images: Sequence[int]) -> Array:
    """Intersection (3,) of the rays of one point in some images."""
    rays = arriving(["x"], ground, images)
    zero = np.zeros(len(images), dtype=np.int32)
    bundle = sorted_rays(zero, (rays.image - ROW).astype(np.int32), rays.observed, rays.sigma, rays.accepted)
    return np.asarray(intersect(IMAGES, bundle, 1).geocentric[0])


def cell_at(geocentric: Array) -> int:
    geodetic = geocentric_to_geodetic(geocentric[None], COVER.ellipsoid)
    return int(COVER.cells_of(geodetic[:, 0], geodetic[:, 1])[0])


THERE = places([20.0], [30.0])


def test_position_comes_from_all_rays() -> None:
    fused = Fused()
    ids = [f"p{i}" for i in range(6)]
    ground = places([-400.0, -250.0, -80.0, 90.0, 260.0, 400.0], [330.0, -330.0, 100.0, -100.0, 40.0, 200.0])
    registration = fused.add(arriving(ids, ground, [0, 2, 4]))
    for k, point in enumerate(ids):
        np.testing.assert_array_equal(fused.origin(point), position_of_many(ids, ground, [0, 2, 4])[k])
        assert np.linalg.norm(fused.origin(point) - ground[k]) < 2.0
        cell, row = fused.cell_of(point)
        assert cell.number == cell_at(ground[k]) and bool(cell.final[row])
    assert len(fused.cells) > 1
    assert registration.misfit.max() < 2.0
    assert not registration.outside.any() and not registration.departures


def position_of_many(ids: Sequence[str], ground: Array, images: Sequence[int]) -> Array:
    rays = arriving(ids, ground, images)
    point = np.tile(np.arange(len(ids), dtype=np.int32), len(images))
    bundle = sorted_rays(point, (rays.image - ROW).astype(np.int32), rays.observed, rays.sigma, rays.accepted)
    return intersect(IMAGES, bundle, len(ids)).geocentric


def test_rays_that_stage_one_rejected_take_part_in_the_position_and_are_kept() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1, 2], accepted=[True, False, True]))
    np.testing.assert_array_equal(fused.origin("p"), position(THERE, [0, 1, 2]))
    assert [accepted for *_, accepted in fused.rays_of("p")] == [True, False, True]


def test_single_ray_is_registered_at_the_mean_height_for_the_time_being() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0]))
    cell, row = fused.cell_of("p")
    assert not cell.final[row]
    geodetic = geocentric_to_geodetic(fused.origin("p")[None])
    assert abs(geodetic[0, 2]) < 1e-3
    assert np.linalg.norm(fused.origin("p") - THERE[0]) > 300.0
    assert cell.sums.redundancy == 0 and not cell.sums.information.any()


def test_two_rays_of_which_one_is_rejected_are_provisional_still() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1], accepted=[True, False]))
    cell, row = fused.cell_of("p")
    assert not cell.final[row]
    fused.add(arriving(["p"], THERE, [2]))
    cell, row = fused.cell_of("p")
    assert cell.final[row]
    np.testing.assert_allclose(fused.origin("p"), position(THERE, [0, 1, 2]), rtol=0.0, atol=1e-6)
    assert len(fused.rays_of("p")) == 3


def test_point_moves_with_its_second_ray_and_takes_the_first_along_once() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0]))
    first = fused.cell_of("p")[0].number
    registration = fused.add(arriving(["p"], THERE, [1]))
    cell, row = fused.cell_of("p")
    assert cell.number == cell_at(THERE[0]) != first
    assert bool(cell.final[row])
    assert list(registration.arrivals) == [cell.number]
    assert {n: ids.tolist() for n, ids in registration.departures.items()} == {first: ["p"]}
    assert [image for image, *_ in fused.rays_of("p")] == [ROW, ROW + 1]
    np.testing.assert_allclose(np.array([r[1:3] for r in fused.rays_of("p")]), np.stack([observed(THERE, i)[0] for i in (0, 1)]))
    # the cell that it left is empty: no point, no image, no information
    left = fused.cells[first]
    assert (len(left), len(left.images), len(left.rays)) == (0, 0, 0)
    np.testing.assert_array_equal(cell.images, [ROW, ROW + 1])
    assert cell.sums.redundancy == 1


def test_point_that_stays_in_its_cell_keeps_its_first_ray_once() -> None:
    # at the mean height the single ray lands on the spot
    there = places([20.0], [30.0], height=0.0)
    fused = Fused()
    fused.add(arriving(["p"], there, [0]))
    number = fused.cell_of("p")[0].number
    registration = fused.add(arriving(["p"], there, [1]))
    assert not registration.departures
    assert registration.arrivals[number].image.tolist() == [ROW + 1]
    assert len(registration.directory[0]) == 0
    cell, row = fused.cell_of("p")
    assert cell.number == number and bool(cell.final[row])
    assert [image for image, *_ in fused.rays_of("p")] == [ROW, ROW + 1]
    np.testing.assert_allclose(fused.origin("p"), position(there, [0, 1]), rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(cell.linearised_at[row], cell.origin[row])


def test_neighbours_in_a_cell_stay_when_a_point_leaves() -> None:
    ids = ["a", "b", "c"]
    ground = places([20.0, 25.0, 30.0], [30.0, 28.0, 26.0])
    fused = Fused()
    fused.add(arriving(ids, ground, [0]))
    first = fused.cell_of("a")[0].number
    assert {fused.cell_of(point)[0].number for point in ids} == {first}
    before = {point: (fused.rays_of(point), fused.origin(point)) for point in ids}
    fused.add(arriving(["b"], ground[1:2], [1]))
    assert fused.cells[first].point_ids.tolist() == ["a", "c"]
    assert fused.cell_of("b")[0].number != first
    for point in ("a", "c"):
        assert fused.rays_of(point) == before[point][0]
        np.testing.assert_array_equal(fused.origin(point), before[point][1])
    assert fused.rays_of("b")[0] == before["b"][0][0]


def test_final_registration_stays_whatever_comes() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1]))
    number, origin = fused.cell_of("p")[0].number, fused.origin("p").copy()
    # a ray that puts the point hundreds of metres away
    elsewhere = places([420.0], [-380.0])
    registration = fused.add(arriving(["p"], elsewhere, [2]))
    assert not registration.departures and list(registration.arrivals) == [number]
    assert registration.arrivals[number].image.tolist() == [ROW + 2]
    assert fused.cell_of("p")[0].number == number
    np.testing.assert_array_equal(fused.origin("p"), origin)
    assert len(fused.rays_of("p")) == 3
    assert 300.0 < registration.misfit[0] < SAME_POINT_METRES


def test_linearisation_of_final_points_is_left_alone() -> None:
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1]))
    number = fused.cell_of("p")[0].number
    cell = fused.cells[number]
    fused.cells[number] = replace(cell, linearised_at=cell.linearised_at + 7.0, theta=cell.theta + 3.0)
    fused.add(together([arriving(["p"], THERE, [2]), arriving(["q"], THERE, [0, 3])]))
    cell, row = fused.cell_of("p")
    np.testing.assert_array_equal(cell.linearised_at[row], cell.origin[row] + 7.0)
    # images known to the cell keep their corrections, new ones start from none
    np.testing.assert_array_equal(cell.theta[cell.images <= ROW + 1], 3.0)
    np.testing.assert_array_equal(cell.theta[cell.images > ROW + 1], 0.0)


@pytest.mark.parametrize("order", list(permutations(range(2))))
def test_two_rays_in_any_order_or_together_register_alike(order: tuple[int, ...]) -> None:
    fused, at_once = Fused(), Fused()
    at_once.add(arriving(["p"], THERE, [0, 1]))
    for image in order:
        fused.add(arriving(["p"], THERE, [image]))
    np.testing.assert_array_equal(fused.origin("p"), at_once.origin("p"))
    assert fused.rays_of("p") == at_once.rays_of("p")
    assert fused.cell_of("p")[0].number == at_once.cell_of("p")[0].number


@pytest.mark.parametrize("batches", [[[0, 1, 2, 3, 4]], [[0], [1], [2, 3, 4]], [[3, 4], [0, 2], [1]], [[4], [3], [2], [1], [0]]])
def test_every_ray_is_in_one_cell_exactly_once(batches: list[list[int]]) -> None:
    rng = np.random.default_rng(5)
    ids = [f"p{i:02d}" for i in range(40)]
    ground = places(rng.uniform(-550.0, 550.0, 40).tolist(), rng.uniform(-550.0, 550.0, 40).tolist())
    seen = {(point, image) for point in ids for image in range(5) if rng.uniform() < 0.5}
    fused = Fused()
    for batch in batches:
        rays = arriving(ids, ground, batch)
        keep = np.array([(str(p), int(i) - ROW) in seen for p, i in zip(rays.point_ids, rays.image, strict=True)])
        fused.add(ArrivingRays(*(getattr(rays, name)[keep] for name in ("point_ids", "image", "observed", "sigma", "accepted", "block"))))
    found = [(str(cell.point_ids[p]), int(cell.images[i]) - ROW) for cell in fused.cells.values()
             for p, i in zip(cell.rays.point, cell.rays.image, strict=True)]  # fmt: skip
    assert len(found) == len(seen) and set(found) == seen
    for point in {p for p, _ in seen}:
        cell, row = fused.cell_of(point)
        assert bool(cell.final[row]) == (len(fused.rays_of(point)) >= 2)
        assert cell.number == cell_at(cell.origin[row])


@pytest.mark.parametrize("twin", ["a twin", "twin"])
def test_points_of_other_names_in_the_cell_that_the_directory_names_are_not_taken_for_it(twin: str) -> None:
    # two ids of one hash: the directory names the cell of the other point
    fused = Fused()
    fused.add(arriving(["p"], THERE, [0, 1]))
    number = fused.cell_of("p")[0].number
    elsewhere = places([-330.0], [-340.0])
    fused.add(arriving([twin], elsewhere, [0, 1]), directory={twin: number})
    assert fused.cell_of(twin)[0].number == cell_at(elsewhere[0]) != number
    assert len(fused.rays_of("p")) == 2 and len(fused.rays_of(twin)) == 2


def test_one_id_at_two_places_shows_in_the_misfit() -> None:
    far = places([3000.0], [-2500.0])
    fused = Fused()
    registration = fused.add(together([arriving(["p"], THERE, [0, 1]), arriving(["p"], far, [2, 3], block=1)]))
    assert registration.misfit.max() > SAME_POINT_METRES
    again = Fused()
    again.add(arriving(["p"], THERE, [0, 1]))
    registration = again.add(arriving(["p"], far, [2]))
    assert registration.misfit[0] == pytest.approx(np.hypot(2980.0, 2530.0), rel=0.1)


def test_points_outside_the_area_are_marked_and_belong_to_the_nearest_core() -> None:
    fused = Fused()
    ground = places([20.0, 900.0], [30.0, 20.0])
    registration = fused.add(arriving(["in", "out"], ground, [0, 1]))
    np.testing.assert_array_equal(registration.outside, [False, True, False, True])
    assert COVER.owner(fused.cell_of("out")[0].number) % COVER.columns == COVER.columns - 1


def test_rays_that_reach_no_ground_go_nowhere() -> None:
    rays = arriving(["lost", "p"], np.concatenate([THERE, THERE]), [0])
    unreachable = replace(IMAGES, cameras=IMAGES.cameras.copy())
    # image 1 turns back at 2,500 pixels from its middle
    unreachable.cameras[1, 10 + 40 + 7] = -unreachable.cameras[1, 10 + 40 + 1]
    bad = replace(rays, image=np.array([ROW + 1, ROW], dtype=np.int32), observed=np.array([[9500.0, 5000.0], rays.observed[1]]))
    rows = np.arange(ROW, ROW + len(VIEWS), dtype=np.int32)
    registration = register(bad, unreachable, rows, np.array([-1, -1]), {}, COVER)
    assert np.isinf(registration.misfit[0]) and registration.misfit[1] < 1.0
    assert [new.point_ids.tolist() for new in registration.arrivals.values()] == [["p"]]
    assert registration.directory[0].tolist() == ["p"]


def test_blocks_can_be_left_out() -> None:
    rays = together([arriving(["a"], THERE, [0], block=0), arriving(["b"], THERE, [1], block=1), arriving(["c"], THERE, [2], block=2)])
    kept = rays.of_blocks(np.array([True, False, True]))
    assert kept.point_ids.tolist() == ["a", "c"] and kept.block.tolist() == [0, 2]
    np.testing.assert_array_equal(kept.observed, rays.observed[[0, 2]])
