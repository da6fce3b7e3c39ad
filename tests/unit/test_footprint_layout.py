"""Images laid out over given outlines: who sees what, formats, and what is left out."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
import shapely

from benchmarks.footprint_layout import LEAST_RAYS, MARGIN_PX, Footprint, Look, footprint_layout
from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.geodesy import geodetic_to_geocentric
from submin.simulation.scene import realise

TIME = datetime.datetime(2020, 1, 1, 10, 0, tzinfo=datetime.UTC)
FORWARD, BACKWARD, ASIDE = Look("F", 22.0, 10.0), Look("B", 22.0, 190.0), Look("", 25.0, 100.0)


def footprint(name: str, west: float, looks: tuple[Look, ...], pass_id: str = "pass") -> Footprint:
    outline = shapely.get_coordinates(shapely.box(west, 30.0, west + 0.5, 30.5))
    return Footprint(name, name, pass_id, TIME, outline, looks, 2.5, 600e3)


def places(west: float, east: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(west, east, 200), rng.uniform(30.0, 30.5, 200)])


def test_points_are_measured_where_the_outlines_hold_them() -> None:
    footprints = [footprint("b", 10.4, (FORWARD, BACKWARD)), footprint("a", 10.0, (FORWARD, BACKWARD))]
    layout = footprint_layout("two", footprints, APriori(bias_px=2.0), places(9.9, 11.0))
    assert [image.image_id for image in layout.images] == ["a-F", "a-B", "b-F", "b-B"]
    assert {image.pass_id for image in layout.images} == {"pass"}
    at = layout.truth[layout.point]
    west = np.array([10.0, 10.0, 10.4, 10.4])[layout.image]
    assert ((at[:, 0] >= west) & (at[:, 0] <= west + 0.5)).all()
    inside = (places(9.9, 11.0)[:, 0] > 10.0) & (places(9.9, 11.0)[:, 0] < 10.9)
    assert len(layout.point_ids) == inside.sum()
    in_both = (layout.truth[:, 0] > 10.4) & (layout.truth[:, 0] < 10.5)
    np.testing.assert_array_equal(np.bincount(layout.point), np.where(in_both, 4, 2))


def test_true_measurements_lie_in_the_formats() -> None:
    layout = footprint_layout("one", [footprint("a", 10.0, (FORWARD, BACKWARD))], APriori(bias_px=2.0), places(10.0, 10.5))
    scene = realise(layout, 0)
    size = np.array([[image.width, image.height] for image in layout.images])[layout.image]
    assert ((scene.observed > 0.0) & (scene.observed < size - 1)).all()
    # without corrections points are well inside: the margin is theirs, and relief moves them by less
    ground = layout.image_set.ground(geodetic_to_geocentric(layout.truth))
    exact = layout.image_set.project(np.zeros((2, layout.image_set.parameters)), ground, layout.image, layout.point).image
    assert exact.min() > -0.5 * 2000.0 / 2.5
    assert np.ptp(exact, axis=0).min() > 0.5 * (size.max() - 2.0 * MARGIN_PX)


def test_the_rays_of_a_point_meet_where_they_are_said_to() -> None:
    """Forward and backward at 22 degrees from 600 km: 24.2 degrees from the vertical on the ground, so heights show with its sine."""
    layout = footprint_layout("one", [footprint("a", 10.0, (FORWARD, BACKWARD))], APriori(), places(10.2, 10.3))
    ground = layout.image_set.ground(geodetic_to_geocentric(layout.truth))
    higher = layout.image_set.ground(geodetic_to_geocentric(layout.truth + np.array([0.0, 0.0, 100.0])))
    theta = np.zeros((2, layout.image_set.parameters))
    low, high = (layout.image_set.project(theta, g, layout.image, layout.point).image for g in (ground, higher))
    moved = (high - low)[:, 1] * 2.5 / 100.0  # along the track, in the plane across the line of sight
    incidence = np.arcsin((1.0 + 600e3 / 6378137.0) * np.sin(np.radians(22.0)))
    forward = layout.image == 0
    middle = np.abs(layout.truth[layout.point, 1] - 30.25) < 0.03
    assert np.count_nonzero(middle) > 20
    np.testing.assert_allclose(np.abs(moved[middle]), np.sin(incidence), rtol=0.02)
    assert np.sign(moved[forward]).tolist() == (-np.sign(moved[~forward])).tolist()


def test_what_one_direction_sees_is_left_out() -> None:
    single = footprint("single", 12.0, (ASIDE,))
    layout = footprint_layout("three", [footprint("a", 10.0, (FORWARD, BACKWARD)), single], APriori(), places(10.0, 12.5))
    assert {image.block_id for image in layout.images} == {"a"}
    assert layout.truth[:, 0].max() <= 10.5
    few = places(10.0, 10.5)[: LEAST_RAYS // 2 - 1]
    for candidates, footprints in ((places(12.0, 12.5), [single]), (few, [footprint("a", 10.0, (FORWARD, BACKWARD))])):
        with pytest.raises(InputError, match="none: no points are seen from directions 10 degrees apart; expected overlapping footprints"):
            footprint_layout("none", footprints, APriori(), candidates)
