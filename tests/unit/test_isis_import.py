"""Import of simulated ISIS control networks: cameras, pixels, control and priors come out as they were put in."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import isis_files
import numpy as np
import pytest

from submin.errors import InputError
from submin.geodesy import geodetic_to_geocentric, local_axes, rotate_covariance
from submin.sensors import Ground, sensor_named
from submin.storage.catalogue import Catalogue
from submin.storage.imports import ImportSummary
from submin.storage.isis_import import camera_priors, import_isis

POINTS = isis_files.points()


def run(folder: Path, points: list[isis_files.Point] | None = None, **options: Any) -> tuple[ImportSummary, Catalogue]:
    network = isis_files.write(folder / "moon", points)
    summary = import_isis(network, folder / "moon", folder / "catalogue", **options)
    catalogue = Catalogue.open(folder / "catalogue")
    catalogue.validate()
    return summary, catalogue


def refused(folder: Path, points: list[isis_files.Point] | None = None, **options: Any) -> str:
    with pytest.raises(InputError) as error:
        run(folder, points, **options)
    assert not (folder / "catalogue").exists()
    return str(error.value)


def test_measures_fall_where_cameras_see_the_points(tmp_path: Path) -> None:
    """Rotations, kilometres, first pixel, reduction and distortion: a mistake in any of them would be pixels, and it is a millionth."""
    summary, catalogue = run(tmp_path)
    (block,) = catalogue.blocks()
    place = {f"moon/{point.point_id}": point.xyz for point in POINTS}
    ground = Ground.at(np.array([place[str(name)] for name in block.point_ids]), isis_files.MOON)
    cameras, every = np.stack([image.pack() for image in block.images]), np.arange(len(block), dtype=np.int32)
    seen = sensor_named("frame").project(cameras, np.zeros((3, 7)), ground, block.image, every).image
    np.testing.assert_allclose(np.column_stack([block.sample, block.line]), seen, rtol=0.0, atol=1e-6)
    assert np.ptp(block.sample) > 300.0
    assert (summary.images, summary.points, summary.rays, summary.control, summary.blocks, summary.passes) == (3, 30, 90, 3, 1, 1)
    assert summary.notes[0] == "the images are taken as reduced 4 times from the detectors of the ISDs (measured: 4.000)"
    assert summary.notes[1].startswith("before any adjustment measures lie 0.0 px (median) from the a priori positions of their points")


def test_catalogue_says_which_body(tmp_path: Path) -> None:
    _, catalogue = run(tmp_path)
    m = catalogue.metadata
    assert (m.name, m.body, m.semimajor_axis, m.flattening, m.frame) == ("moon", "moon", 1737400.0, 0.0, "NAIF 310001")
    assert [image.acquired for image in catalogue.images] == [f"1971-07-31T14:0{k}:53.547000Z" for k in range(3)]
    assert {image.pass_id for image in catalogue.images} == {"APOLLO 15-19710731T140053"}
    assert {(image.sensor, image.platform, image.width, image.height) for image in catalogue.images} == {("frame", "APOLLO 15", 2000, 1800)}
    assert all(image.footprint for image in catalogue.images)
    heights = [json.loads(image.camera)["height"] for image in catalogue.images]
    np.testing.assert_allclose(heights, -1500.0, atol=1000.0)


def test_constrained_points_are_control_with_their_covariance(tmp_path: Path) -> None:
    _, catalogue = run(tmp_path)
    control = catalogue.points("control")
    assert control is not None and control.joint_covariance is None
    assert control.point_ids.tolist() == ["moon/P00", "moon/P10", "moon/P20"]
    expected = [point.xyz for point in POINTS if point.kind == "Constrained"]
    np.testing.assert_allclose(geodetic_to_geocentric(control.geodetic, isis_files.MOON), expected, rtol=0.0, atol=1e-6)
    back = rotate_covariance(control.covariance_enu, np.swapaxes(local_axes(control.geodetic), 1, 2))
    np.testing.assert_allclose(back[0], [[400.0, 30.0, 20.0], [30.0, 300.0, 10.0], [20.0, 10.0, 500.0]], rtol=1e-9)


def test_sigmas_are_the_networks_or_the_default(tmp_path: Path) -> None:
    stated = replace(POINTS[1], measure_extra={isis_files.serial(0): {"SampleSigma": "0.7", "LineSigma": "0.8"}})
    points = [stated if point.point_id == "P01" else point for point in POINTS]
    for options, sigma in (({}, 1.4), ({"sigma": 0.25, "overwrite": True}, 0.25)):
        (block,) = run(tmp_path, points, **options)[1].blocks()
        at = (block.point_ids == "moon/P01") & (block.image == 0)
        assert (block.sigma_sample[at], block.sigma_line[at]) == (0.7, 0.8)
        assert set(block.sigma_sample[~at]) | set(block.sigma_line[~at]) == {sigma}


def test_priors_are_those_of_old_cameras_or_as_given(tmp_path: Path) -> None:
    frame = sensor_named("frame")
    (block,) = run(tmp_path)[1].blocks()
    believed = [block.a_priori.of(parameter) for parameter in frame.parameters]  # type: ignore[union-attr]
    np.testing.assert_allclose([u.sigma for u in believed], [1000.0] * 3 + [np.radians(2.0)] * 3 + [0.0])
    assert {u.common_to_pass for u in believed} == {0.0}
    (block,) = run(tmp_path, a_priori=camera_priors(50.0, 0.1, 0.02), overwrite=True)[1].blocks()
    believed = [block.a_priori.of(parameter) for parameter in frame.parameters]  # type: ignore[union-attr]
    np.testing.assert_allclose([u.sigma for u in believed], [50.0] * 3 + [np.radians(0.1)] * 3 + [0.02])


def test_shared_ids_and_dataset(tmp_path: Path) -> None:
    _, catalogue = run(tmp_path, shared_ids=True, dataset="apollo")
    assert catalogue.metadata.name == "apollo"
    assert set(next(iter(catalogue.blocks())).point_ids) == {point.point_id for point in POINTS}
    assert catalogue.points("control").point_ids.tolist() == ["P00", "P10", "P20"]  # type: ignore[union-attr]


def test_what_does_not_count_is_said(tmp_path: Path) -> None:
    """Ignored measures and points, and an image that only they name."""
    third = {isis_files.serial(2): {"Ignore": "True"}}
    points = [replace(point, measure_extra=third) for point in POINTS[:20]] + [
        replace(point, extra={"Ignore": "True"}) for point in POINTS[20:]
    ]
    summary, catalogue = run(tmp_path, points)
    assert (summary.images, summary.points, summary.rays, summary.control) == (2, 20, 40, 2)
    assert [image.image_id for image in catalogue.images] == ["cube0", "cube1"]
    assert summary.notes[:3] == (
        "left out, as the network says: 20 ignored measures", "left out, as the network says: 10 ignored points",
        "left out, because no measure names them: cube2",
    )  # fmt: skip


def test_reduction_may_be_given(tmp_path: Path) -> None:
    found = run(tmp_path)[1].images[0].camera
    assert run(tmp_path, reduction=4.0, overwrite=True)[1].images[0].camera == found
    wrong = json.loads(run(tmp_path, reduction=1.0, overwrite=True)[1].images[0].camera)
    assert wrong["mm_to_pixel"][0][1] == 4.0 * json.loads(found)["mm_to_pixel"][0][1]


def test_a_scale_that_is_no_whole_number_is_refused(tmp_path: Path) -> None:
    shrunk = [replace(p, measures={k: (0.9 * s, 0.9 * t) for k, (s, t) in p.measures.items()}) for p in POINTS]
    assert re.search(r"the measures are 4\.44\d times coarser than the detectors that the ISDs describe", refused(tmp_path, shrunk))


@pytest.mark.parametrize(
    ("point", "message"),
    [
        (replace(POINTS[0], kind="Fixed"), "point P00 is Fixed, without any error; expected Constrained with its AprioriCovarianceMatrix"),
        (replace(POINTS[0], covariance=None), "point P00 is Constrained without AprioriCovarianceMatrix; expected it, or PointType Free"),
        (replace(POINTS[0], covariance=(1.0, 2.0, 0.0, 1.0, 0.0, 1.0)), "expected a positive definite matrix (m2), constrained in all"),
        (replace(POINTS[0], measures={"APOLLO15/METRIC/x": (1.0, 1.0)}), "serial number is 'APOLLO15/METRIC/x'; expected one of"),
        (replace(POINTS[0], measure_extra={isis_files.serial(1): {"SampleSigma": "0", "LineSigma": "1"}}), "expected positive numbers"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_named(tmp_path: Path, point: isis_files.Point, message: str) -> None:
    assert message in refused(tmp_path, [point, *POINTS[1:]])


def test_a_point_measured_twice_in_an_image_is_refused(tmp_path: Path) -> None:
    network = isis_files.write(tmp_path / "moon")
    text = network.read_text()
    network.write_text(text.replace(isis_files.serial(1), isis_files.serial(0), 1))
    with pytest.raises(InputError, match=f"point P00 is measured twice in {isis_files.serial(0)}; expected one measure"):
        import_isis(network, tmp_path / "moon", tmp_path / "catalogue")


def test_a_network_without_measures_is_refused(tmp_path: Path) -> None:
    assert "holds no measure that counts" in refused(tmp_path, [replace(point, extra={"Ignore": "True"}) for point in POINTS])


@pytest.mark.parametrize(("name", "value"), [("sigma", 0.0), ("sigma", float("nan")), ("reduction", -1.0)])
def test_options_out_of_range(tmp_path: Path, name: str, value: float) -> None:
    assert refused(tmp_path, **{name: value}) == f"{name} is {value}; expected a positive number"


def test_cameras_of_two_bodies_are_refused(tmp_path: Path) -> None:
    network = isis_files.write(tmp_path / "moon")
    other = isis_files.isd(2, radii={"semimajor": 3396.19, "semiminor": 3376.2})
    (tmp_path / "moon" / "image2.isd").write_text(json.dumps(other))
    with pytest.raises(InputError, match="ellipsoid of cube2 is .* expected one body and frame"):
        import_isis(network, tmp_path / "moon", tmp_path / "catalogue")


def test_table_of_images(tmp_path: Path) -> None:
    network = isis_files.write(tmp_path / "moon")
    table = tmp_path / "moon" / "images.csv"
    rows = table.read_text()
    for changed, message in (
        (rows.replace(isis_files.serial(1), isis_files.serial(0)), "row 2: serial_number .* is that of row 1 too; expected it once"),
        (rows.replace("cube1", "cube0"), "row 2: image 'cube0' is that of row 1 too; expected it once"),
        (rows.replace("image1.isd", "none.isd"), "none.isd: no such file; expected an ISD"),
        (rows.replace("2000,1800", "0,1800"), "row 1: size is 0 x 1800, reduction None; expected positive numbers"),
        (rows.splitlines()[0] + "\n", "holds no images; expected at least one row"),
        (rows.replace("serial_number", "serial"), "column 'serial_number' is missing"),
    ):
        table.write_text(changed)
        with pytest.raises(InputError, match=message):
            import_isis(network, tmp_path / "moon", tmp_path / "catalogue")


def test_size_and_name_of_an_image_may_be_left_to_the_camera_and_the_serial_number(tmp_path: Path) -> None:
    network = isis_files.write(tmp_path / "moon")
    rows = [f"{isis_files.serial(k)},image{k}.isd" for k in range(3)]
    (tmp_path / "list.csv").write_text("\n".join(["serial_number,isd", *rows, ""]))
    import_isis(network, tmp_path / "moon", tmp_path / "catalogue", images_csv=tmp_path / "list.csv")
    images = Catalogue.open(tmp_path / "catalogue").images
    assert [(image.image_id, image.width, image.height) for image in images] == [(isis_files.serial(k), 2000, 1800) for k in range(3)]
