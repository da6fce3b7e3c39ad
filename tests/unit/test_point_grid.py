"""The grid of tie points: whoever looks at a part of the ground finds the same points, everywhere on the body."""

from __future__ import annotations

import numpy as np
import pytest

from submin.errors import InputError
from submin.geodesy import geodetic_to_geocentric
from submin.simulation.point_grid import PointGrid

GRID = PointGrid(20.0, 3000.0, 5)
BOX = (100.0, 30.0, 110.0, 40.0)


def test_every_point_lies_in_its_own_field() -> None:
    number = np.arange(0, GRID.fields, 97)
    for n, (longitude, latitude, _) in zip(number.tolist(), GRID.geodetic(number).tolist(), strict=True):
        assert GRID.numbers_in(longitude, latitude, longitude, latitude).tolist() == [n]


def test_a_part_of_the_ground_has_the_points_of_the_whole() -> None:
    whole = GRID.numbers_in(*BOX)
    at = GRID.geodetic(whole)
    assert len(np.unique(whole)) == len(whole)
    part = GRID.numbers_in(103.0, 33.0, 104.5, 36.0)
    inside = (at[:, 0] >= 103.0) & (at[:, 0] <= 104.5) & (at[:, 1] >= 33.0) & (at[:, 1] <= 36.0)
    assert set(whole[inside].tolist()) <= set(part.tolist()) <= set(whole.tolist())
    area = 111.2**2 * 10.0 * np.degrees(np.sin(np.radians(40.0)) - np.sin(np.radians(30.0)))
    assert len(whole) == pytest.approx(area / 400.0, rel=0.05)


def test_the_antimeridian_is_no_border() -> None:
    across = GRID.numbers_in(179.0, -10.0, 181.0, -9.0)
    both = np.concatenate([GRID.numbers_in(179.0, -10.0, 179.9999, -9.0), GRID.numbers_in(-180.0, -10.0, -179.0, -9.0)])
    assert set(across.tolist()) == set(both.tolist())


def test_spacing_is_about_the_same_at_all_latitudes() -> None:
    for south in (-80.0, -45.0, 0.0, 60.0):
        x = geodetic_to_geocentric(GRID.geodetic(GRID.numbers_in(20.0, south, 30.0, south + 5.0)))
        nearest = np.sort(np.linalg.norm(x[:, None] - x[None], axis=2), axis=1)[:, 1]
        assert nearest.min() > 3e3 and nearest.max() < 35e3
        assert 12e3 < np.median(nearest) < 20e3


def test_heights_are_smooth_and_within_the_relief() -> None:
    at = GRID.geodetic(GRID.numbers_in(*BOX))
    assert at[:, 2].min() >= 0.0 and at[:, 2].max() <= 3000.0 and np.ptp(at[:, 2]) > 1500.0
    beside = GRID.heights(at[:, 0] + 1e-4, at[:, 1])
    assert np.abs(beside - at[:, 2]).max() < 10.0 * 0.3


def test_a_seed_moves_points_and_nothing_else() -> None:
    other, number = PointGrid(20.0, 3000.0, 6), GRID.numbers_in(*BOX)
    np.testing.assert_array_equal(other.numbers_in(*BOX), number)
    assert np.abs(other.geodetic(number)[:, :2] - GRID.geodetic(number)[:, :2]).max(axis=1).min() > 0.0


@pytest.mark.parametrize(("spacing", "relief"), [(0.0, 1.0), (1.0, -1.0), (float("nan"), 1.0)])
def test_a_grid_of_nothing_is_refused(spacing: float, relief: float) -> None:
    with pytest.raises(InputError, match="expected a positive number"):
        PointGrid(spacing, relief, 0)
