"""Registration: a position from all the rays that a point has, and the cell that it lies in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from registering import ROW, THERE, Fused, P, arriving, cell_at, observed, places, position, positions

from submin.geodesy import geocentric_to_geodetic
from submin.network.registration import (
    SAME_POINT_METRES,
)


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
