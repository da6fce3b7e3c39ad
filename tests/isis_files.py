"""Small simulated ISIS control networks with their cameras, in all forms in which they come: PVL, binary, ISD."""

from __future__ import annotations

import csv
import json
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from submin.geodesy import Ellipsoid, geodetic_to_geocentric, local_axes
from submin.sensors import Ground, sensor_named

Array = NDArray[np.float64]

MOON = Ellipsoid(1737400.0, 0.0)
SIZE = (2000, 1800)
"""Samples and lines of the images as measured; the detectors have `REDUCTION` times as many."""
REDUCTION = 4
KERNEL = {
    "BODY_FRAME_CODE": 310001, "INS-915240_PP": [-0.006, -0.002], "INS-915240_OD_K": [-1.3e-06, 5.2e-10, -5.1e-14],
    "INS-915240_DECENTER": [-5.5e-07, -4.6e-11, 2.97],
}  # fmt: skip
TO_BODY = Rotation.from_euler("zxy", [30.0, -20.0, 70.0], degrees=True).as_matrix()
CONSTANT = Rotation.from_euler("x", 0.5, degrees=True).as_matrix()
"""From J2000 to the body's time-dependent frame, and from there to the body-fixed frame."""


@dataclass(frozen=True)
class Point:
    """A point to be written: values as a network has them, measures by serial number; ``extra`` are further keywords by their PVL names."""

    point_id: str
    xyz: tuple[float, float, float]
    measures: dict[str, tuple[float, float]]
    kind: str = "Free"
    covariance: tuple[float, ...] | None = None
    extra: dict[str, str] = field(default_factory=dict)
    measure_extra: dict[str, dict[str, str]] = field(default_factory=dict)


def serial(k: int) -> str:
    return f"APOLLO15/METRIC/1971-07-31T14:0{k}:53.547"


def quaternion(matrix: Array) -> list[float]:
    """Scalar first."""
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    return [float(v) for v in (w, x, y, z)]


def places() -> tuple[Array, Array]:
    """Perspective centres (3, 3) and ground points (30, 3), body-fixed, metres."""
    centres = geodetic_to_geocentric(np.array([[10.0 + 1.2 * k, 20.0 + 0.1 * k, 100e3] for k in range(3)]), MOON)
    rng = np.random.default_rng(1)
    ground = np.array([11.2, 20.1, -1500.0]) + rng.uniform(-0.25, 0.25, (30, 3)) * np.array([1.0, 1.0, 2000.0])
    return centres, geodetic_to_geocentric(ground, MOON)


def rotation(k: int) -> Array:
    """Body-fixed to camera of image k, which looks along -z at the middle of the points."""
    centres, ground = places()
    sight = ground.mean(axis=0) - centres[k]
    sight /= np.linalg.norm(sight)
    right = np.cross(sight, centres[k])
    right /= np.linalg.norm(right)
    return np.stack([-right, np.cross(sight, right), -sight])  # samples run against x, lines along y


def isd(k: int, **changes: Any) -> dict[str, Any]:
    centres, _ = places()
    to_j2000 = (CONSTANT @ TO_BODY).T
    east = local_axes(np.array([[10.0, 20.0, 0.0]]))[0, 0]
    return {
        "name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL", "name_platform": "APOLLO 15", "name_sensor": "METRIC",
        "image_samples": SIZE[0], "image_lines": SIZE[1], "radii": {"semimajor": 1737.4, "semiminor": 1737.4},
        "reference_height": {"minheight": -1000, "maxheight": 1000},
        "body_rotation": {"quaternions": [quaternion(TO_BODY)], "constant_rotation": CONSTANT.ravel().tolist()},
        "instrument_pointing": {"quaternions": [quaternion(rotation(k) @ to_j2000.T)], "constant_rotation": np.eye(3).ravel().tolist()},
        "instrument_position": {
            "positions": [(to_j2000 @ centres[k] / 1000.0).tolist()], "velocities": [(1.6 * to_j2000 @ east).tolist()],
        },
        "focal_length_model": {"focal_length": 76.054}, "detector_center": {"line": None, "sample": None},
        "focal2pixel_samples": [0.0, -200.0, 0.0], "focal2pixel_lines": [0.0, 0.0, 200.0], "naif_keywords": KERNEL,
        "optical_distortion": {"radial": {"coefficients": [0.0, 0.0, 0.0]}},
    } | changes  # fmt: skip


def measured(k: int) -> Array:
    """Sample and line (30, 2) of the points in image k as ISIS counts them, by the frame sensor with the detector's own numbers."""
    centres, ground = places()
    # half the reduced size, counted from 1 in the full image, brought to pixels reduced four times and counted from 0
    origin = [(0.5 * n * REDUCTION - 1.0 + 0.5) / REDUCTION - 0.5 for n in SIZE]
    camera = {
        "position": centres[k].tolist(), "rotation": rotation(k).tolist(), "looks_along": "-z", "focal_length": 76.054,
        "principal_point": KERNEL["INS-915240_PP"], "mm_to_pixel": [[origin[0], -50.0, 0.0], [origin[1], 0.0, 50.0]], "height": 0.0,
        "distortion": {
            "radial": KERNEL["INS-915240_OD_K"], "decentering": KERNEL["INS-915240_DECENTER"], "direction": "measured to ideal",
        },
    }  # fmt: skip
    sensor, rows = sensor_named("frame"), np.arange(30, dtype=np.int32)
    return sensor.project(sensor.pack(camera, *SIZE)[None], np.zeros((1, 7)), Ground.at(ground, MOON), 0 * rows, rows).image + 1.0


def points() -> list[Point]:
    """Thirty points, all of them in all images; every tenth one is constrained."""
    _, ground = places()
    images = [measured(k) for k in range(3)]
    made = []
    for j, (x, y, z) in enumerate(ground.tolist()):
        point = Point(f"P{j:02d}", (x, y, z), {serial(k): tuple(image[j].tolist()) for k, image in enumerate(images)})
        if j % 10 == 0:
            point = replace(point, kind="Constrained", covariance=(400.0, 30.0, 20.0, 300.0, 10.0, 500.0))
        made.append(point)
    return made


def pvl(of: list[Point], version: str = "5") -> str:
    """The network as PVL, as ISIS lays it out."""
    lines = ["Object = ControlNetwork", "  NetworkId = Simulated", "  TargetName = Moon", "  UserName = nobody",
             "  Created = 2010-09-17T12:53:49", '  Description = "a network in',
             '                 two lines"', f"  Version = {version}", ""]  # fmt: skip
    for point in of:
        lines += ["  Object = ControlPoint", f"    PointType = {point.kind}", f"    PointId = {point.point_id}", ""]
        lines += [
            f"    # AprioriLatitude = {j} <degrees>\n    Apriori{a} = {v!r} <meters>"
            for j, (a, v) in enumerate(zip("XYZ", point.xyz, strict=True))
        ]
        if point.covariance is not None:
            values = [repr(v) for v in point.covariance]
            lines += [f"    AprioriCovarianceMatrix = ({', '.join(values[:2])},", f"      {', '.join(values[2:])})"]
        lines += [f"    {name} = {value}" for name, value in point.extra.items()]
        for number, (sample, line) in point.measures.items():
            lines += ["", "    Group = ControlMeasure", f"      SerialNumber = {number}", "      MeasureType = RegisteredPixel",
                      '      ChooserName = "Application pointreg"', f"      Sample = {sample!r}", f"      Line = {line!r}"]  # fmt: skip
            lines += [f"      {name} = {value}" for name, value in point.measure_extra.get(number, {}).items()]
            lines += ["    End_Group"]
        lines += ["  End_Object", ""]
    return "\n".join([*lines, "End_Object", "End", ""])


def write(folder: Path, of: list[Point] | None = None) -> Path:
    """A folder with the cameras and ``network.pvl``; returns the network."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(3):
        (folder / f"image{k}.isd").write_text(json.dumps(isd(k)), encoding="utf-8")
    with (folder / "images.csv").open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(["image", "isd", "serial_number", "image_samples", "image_lines"])
        rows.writerows([f"cube{k}", f"image{k}.isd", serial(k), *SIZE] for k in range(3))
    network = folder / "network.pvl"
    network.write_text(pvl(points() if of is None else of), encoding="utf-8")
    return network


# Protocol buffers, written by hand: field number and wire type, then a varint, eight bytes, or a length and bytes


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _number(field_number: int, value: int) -> bytes:
    return _varint(field_number << 3) + _varint(value)


def _double(field_number: int, value: float) -> bytes:
    return _varint(field_number << 3 | 1) + struct.pack("<d", value)


def _bytes(field_number: int, value: bytes) -> bytes:
    return _varint(field_number << 3 | 2) + _varint(len(value)) + value


def binary(of: list[Point], version: str = "5") -> bytes:
    """The network as the binary file of version 5: label, header at byte 65536, points each with its length before it."""
    kinds = {"Free": 2, "Constrained": 3, "Fixed": 4}
    messages = b""
    for point in of:
        parts = [_bytes(1, point.point_id.encode()), _number(2, kinds[point.kind]), _bytes(3, b"nobody")]
        parts += [_number(6, int(point.extra.get("Ignore") == "True")), _number(7, int(point.extra.get("JigsawRejected") == "True"))]
        parts += [_double(16 + k, v) for k, v in enumerate(point.xyz)]
        if point.covariance is not None:
            parts.append(_bytes(19, struct.pack("<6d", *point.covariance)))
        for number, (sample, line) in point.measures.items():
            extra = point.measure_extra.get(number, {})
            measure = [_bytes(1, number.encode()), _number(2, 0 if extra.get("MeasureType") == "Candidate" else 2)]
            measure += [_double(3, sample), _double(4, line), _double(5, 0.25)]
            measure += [_number(10, int(extra.get("Ignore") == "True")), _number(11, int(extra.get("JigsawRejected") == "True"))]
            measure += [_double(n, float(extra[name])) for n, name in ((15, "SampleSigma"), (16, "LineSigma")) if name in extra]
            parts.append(_bytes(25, b"".join(measure)))
        message = b"".join(parts)
        messages += struct.pack("<I", len(message)) + message
    header = _bytes(1, b"Simulated") + _bytes(2, b"Moon") + _number(7, len(of))
    label = (
        f"Object = ProtoBuffer\n  Object = Core\n    HeaderStartByte = 65536\n    HeaderBytes = {len(header)}\n"
        f"    PointsStartByte = {65536 + len(header)}\n    PointsBytes = {len(messages)}\n  End_Object\n\n"
        f"  Group = ControlNetworkInfo\n    NetworkId = Simulated\n    Version = {version}\n  End_Group\nEnd_Object\nEnd\n"
    )
    return label.encode().ljust(65536, b"\x00") + header + messages
