"""ISIS control networks, as PVL and as binary files, and the cameras of ISD files; simulated ones, and what is said to broken ones."""

from __future__ import annotations

import gzip
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import isis_files
import numpy as np
import pytest

from submin.errors import InputError
from submin.formats.isis_camera import read_isd
from submin.formats.isis_network import ControlNetwork, read_network
from submin.formats.isis_pvl import parse_pvl

POINTS = isis_files.points()[:4]
FIRST, SECOND, THIRD = (isis_files.serial(k) for k in range(3))


def test_pvl_of_every_kind_of_value() -> None:
    found = parse_pvl("""
        /* a comment
           of two lines */
        Object = Outer
          A = 1.5 <meters>     # and a comment here
          B = "two words"  C = 'one'
          D = (1, 2.5 <m>, "three four",
               five)
          E = {x}
          F = APOLLO15/METRIC/1971-07-31T14:00:53.547
          G = "broken over
               two lines"
          Group = Inner
            A = True
          End_Group = Inner
          Group = Inner
          EndGroup
        End_Object
        End
        anything at all: (
    """)
    outer = found.part("Outer")
    assert outer is not None
    assert outer.values == {
        "A": "1.5", "B": "two words", "C": "one", "D": ["1", "2.5", "three four", "five"], "E": ["x"],
        "F": "APOLLO15/METRIC/1971-07-31T14:00:53.547", "G": "broken over two lines",
    }  # fmt: skip
    assert [part.name for part in outer.parts] == ["Inner", "Inner"]
    assert (outer.parts[0].values, outer.line, outer.parts[0].line, outer.parts[1].line) == ({"A": "True"}, 4, 13, 16)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Object = A\n B = 1\n", "A that begins on line 1 does not end; the file looks cut short"),
        ("A = 1\n\nEnd_Object\n", "line 3: 'End_Object' stands where nothing ends; expected 'name = value'"),
        ("A = 1\nB = (1,\n2\n", "line 2: 'B = (1,' is no PVL; expected 'name = value'"),
        ("A 1", "line 1: 'A' stands where nothing ends; expected 'name = value'"),
        ("\n= 1", "line 2: '= 1' is no PVL; expected 'name = value'"),
    ],
)
def test_broken_pvl_is_named_by_its_line(text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        parse_pvl(text)


def write(folder: Path, points: list[isis_files.Point], form: str) -> Path:
    path = folder / f"network.{form}"
    if form == "net":
        path.write_bytes(isis_files.binary(points))
    elif form == "pvl.gz":
        path.write_bytes(gzip.compress(isis_files.pvl(points).encode()))
    else:
        path.write_text(isis_files.pvl(points), encoding="utf-8")
    return path


@pytest.fixture(params=["pvl", "pvl.gz", "net"])
def form(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_a_network_is_what_was_written(tmp_path: Path, form: str) -> None:
    found = read_network(write(tmp_path, POINTS, form))
    assert (found.network_id, found.target, found.left_out) == ("Simulated", "Moon", {})
    assert [(p.point_id, p.kind, p.a_priori, p.covariance) for p in found.points] == [
        (p.point_id, p.kind, p.xyz, p.covariance) for p in POINTS
    ]
    for point, written in zip(found.points, POINTS, strict=True):
        assert {m.serial_number: (m.sample, m.line) for m in point.measures} == written.measures
        assert {(m.sigma_sample, m.sigma_line) for m in point.measures} == {(None, None)}
    assert [point.kind for point in found.points].count("Constrained") == 1


def test_what_the_network_says_to_ignore_is_left_out_and_counted(tmp_path: Path, form: str) -> None:
    points = [
        replace(POINTS[0], extra={"Ignore": "True"}),
        replace(POINTS[1], extra={"JigsawRejected": "True"}),
        replace(POINTS[2], measure_extra={
            FIRST: {"Ignore": "True"}, SECOND: {"JigsawRejected": "True"}, THIRD: {"SampleSigma": "0.7", "LineSigma": "0.8"},
        }),
        replace(POINTS[3], extra={"Ignore": "False"}, measure_extra={THIRD: {"MeasureType": "Candidate"}}),
    ]  # fmt: skip
    found = read_network(write(tmp_path, points, form))
    assert found.left_out == {
        "ignored points": 1, "rejected points": 1, "ignored measures": 1, "rejected measures": 1, "candidate measures": 1,
    }  # fmt: skip
    assert [(p.point_id, [m.serial_number for m in p.measures]) for p in found.points] == [("P02", [THIRD]), ("P03", [FIRST, SECOND])]
    assert (found.points[0].measures[0].sigma_sample, found.points[0].measures[0].sigma_line) == (0.7, 0.8)


def test_types_of_older_networks(tmp_path: Path) -> None:
    path = tmp_path / "old.pvl"
    path.write_text(isis_files.pvl([replace(POINTS[1], kind="Tie"), replace(POINTS[2], kind="Ground")], version="3"), encoding="utf-8")
    assert [point.kind for point in read_network(path).points] == ["Free", "Fixed"]


def spoiled(tmp_path: Path, old: str, new: str) -> ControlNetwork:
    text = isis_files.pvl(POINTS)
    assert old in text
    path = tmp_path / "network.pvl"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return read_network(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Object = ControlNetwork", "Object = Network", "holds no Object = ControlNetwork; expected an ISIS control network"),
        ("Version = 5", "Version = 2", "Version of the network is 2; expected one of 3, 4, 5"),
        ("PointId = P01", "PointId = P00", "line 48: point P00 is there twice; expected it once"),
        ("PointType = Free", "PointType = Loose", "PointType is 'Loose'; expected one of Free, Constrained, Fixed"),
        ("PointId = P01", "", "line 48: ControlPoint has no PointId; expected one"),
        (f"SerialNumber = {FIRST}", "", "ControlMeasure has no SerialNumber; expected one"),
        ("Sample = ", "Sampel = ", "point P00: the measure in APOLLO15/METRIC/1971-07-31T14:00:53.547 has no Sample"),
        ("Line = ", "Line = x", "Line of ControlMeasure is 'x"),
        ("AprioriY = ", "AprioriY = nan Y = ", "AprioriY of ControlPoint is 'nan'; expected a finite number"),
        ("(400.0, 30.0,", "(400.0,", "expected 6 numbers: xx, xy, xz, yy, yz, zz (m2)"),
        ("PointId = P01", "PointId = (P01, P02)", "PointId of ControlPoint is a sequence of 2; expected one value"),
        ("End_Object\nEnd", "", "ControlNetwork that begins on line 1 does not end; the file looks cut short"),
    ],
)  # fmt: skip
def test_broken_network_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError) as refused:
        spoiled(tmp_path, old, new)
    assert str(refused.value).startswith(f"{tmp_path / 'network.pvl'}: ")
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda b: b.replace(b"Version = 5", b"Version = 2"),
            "Version of the binary network is 2; expected 5: convert it with ISIS: cnetbin2pvl",
        ),
        (lambda b: b[:-40], "the file looks cut short"),
        (lambda b: b.replace(b"PointsBytes = ", b"PointsBytes = x"), "PointsBytes of the binary network's label is 'x"),
        (lambda b: b.replace(b"Object = Core", b"Object = Heart"), "the label of the binary network names no Core"),
        (lambda b: b[:-200] + bytes(200), "holds a point that cannot be decoded, after 3 that can"),
    ],
)
def test_broken_binary_network_is_named(tmp_path: Path, change: Any, message: str) -> None:
    path = tmp_path / "network.net"
    path.write_bytes(change(isis_files.binary(POINTS)))
    with pytest.raises(InputError, match=re.escape(message)):
        read_network(path)


def test_neither_pvl_nor_binary(tmp_path: Path) -> None:
    path = tmp_path / "image.tif"
    path.write_bytes(b"II*\x00\xff\xfe")
    with pytest.raises(InputError, match="is neither PVL in UTF-8 nor a binary control network"):
        read_network(path)
    with pytest.raises(InputError, match="no such file; expected an ISIS control network"):
        read_network(tmp_path / "nowhere.pvl")
    (tmp_path / "short.pvl.gz").write_bytes(gzip.compress(isis_files.pvl(POINTS).encode())[:-20])
    with pytest.raises(InputError, match="cannot be read"):
        read_network(tmp_path / "short.pvl.gz")


def read(folder: Path, **changes: Any) -> Any:
    path = folder / "image.isd"
    path.write_text(json.dumps(isis_files.isd(1, **changes)), encoding="utf-8")
    return read_isd(path)


def test_camera_of_an_isd_is_body_fixed(tmp_path: Path) -> None:
    found = read(tmp_path)
    centres, _ = isis_files.places()
    np.testing.assert_allclose(found.position, centres[1], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(found.rotation, isis_files.rotation(1), rtol=0.0, atol=1e-12)
    assert (found.ellipsoid, found.frame, found.looks_along, found.size) == (isis_files.MOON, "NAIF 310001", "-z", isis_files.SIZE)
    assert found.distortion["direction"] == "measured to ideal"


def test_detector_centre_as_stated_or_in_the_middle(tmp_path: Path) -> None:
    """The middle as ISIS counts it; a stated one as ALE counts it, the first pixel's centre at (0.5, 0.5)."""
    middle = np.array(read(tmp_path).description((2000, 1800), 1.0, 0.0)["mm_to_pixel"])[:, 0]
    np.testing.assert_allclose(middle, [999.0, 899.0])
    stated = read(tmp_path, detector_center={"sample": 1000.5, "line": 900.5})
    np.testing.assert_allclose(np.array(stated.description((2000, 1800), 1.0, 0.0)["mm_to_pixel"])[:, 0], [1000.0, 900.0])


def test_another_camera_is_taken_without_distortion_only(tmp_path: Path) -> None:
    plain = read(tmp_path, name_sensor="WIDE ANGLE")
    assert (plain.distortion, plain.looks_along) == (None, "+z")
    with pytest.raises(InputError, match="the lens distortion of camera 'WIDE ANGLE' is .* known are those of the Apollo metric cameras"):
        read(tmp_path, name_sensor="WIDE ANGLE", optical_distortion={"radial": {"coefficients": [0.0, 1e-5, 0.0]}})
    with pytest.raises(InputError, match="the lens distortion of camera 'WIDE ANGLE' is"):
        read(tmp_path, name_sensor="WIDE ANGLE", optical_distortion={"kaguyalism": {"x": [0.0]}})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"}, "expected 'USGS_ASTRO_FRAME_SENSOR_MODEL', a frame camera"),
        ({"instrument_position": {"positions": [[1, 2, 3]] * 2}}, "positions of instrument_position holds 2 times; expected one"),
        ({"instrument_position": {}}, "instrument_position / positions is missing; expected 1x3 numbers"),
        ({"body_rotation": {"quaternions": [[1, 1, 0, 0]]}}, "quaternion of body_rotation has length 1.41421; expected a unit quaternion"),
        ({"radii": {"semimajor": "big"}}, "radii / semimajor is 'big'; expected one finite numbers"),
        ({"focal2pixel_lines": [0.0, 1.0]}, "focal2pixel_lines is [0.0, 1.0]; expected 3 finite numbers"),
        ({"naif_keywords": {}}, "OD_K is missing; expected 3 numbers"),
        ({"naif_keywords": []}, "naif_keywords is list; expected a JSON object"),
    ],
)
def test_broken_isd_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as refused:
        read(tmp_path, **changes)
    assert str(refused.value).startswith(f"{tmp_path / 'image.isd'}: ISD: ")
    assert message in str(refused.value)


def test_isd_that_is_no_json(tmp_path: Path) -> None:
    (tmp_path / "image.isd").write_text("no", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read as an ISD, a JSON object"):
        read_isd(tmp_path / "image.isd")
    (tmp_path / "image.isd").write_text("[1]", encoding="utf-8")
    with pytest.raises(InputError, match="holds list; expected a JSON object"):
        read_isd(tmp_path / "image.isd")
    with pytest.raises(InputError, match="no such file; expected an ISD"):
        read_isd(tmp_path / "none.isd")
