"""WorldView metadata (the vendor's XML of a level 1B image) as a description of a pushbroom camera.

Read are the sections IMD (size, line times), EPH (positions and velocities in body-fixed axes), ATT (quaternions x, y, z, w that take
camera axes to body-fixed axes), GEO (focal length and detector line) and RPB (the vendor's own RPC). Camera axes are x along the track, y
along the detector line, z to the ground; samples run against y. The centre of the first pixel is (0, 0), and the time of a line is that of
its middle: `tests/real/test_mojave.py` shows each of these, and that the vendor's RPC contains aberration and refraction as
`submin.sensors.pushbroom` models them. What the files at hand could not show (a detector that is turned, a camera that is mounted askew,
lens distortion) is refused.

The XML is read by the standard library: expat fetches no external entity and bounds the growth of internal ones, so that a package to
guard it would add nothing.
"""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.sensors.pushbroom_camera import margins

Array = NDArray[np.float64]

ROTATION_RATE = 7.292115e-5
"""Of the Earth, rad/s (NIMA TR8350.2)."""
ZENITH_PATH = 2.33
"""Metres: refractivity of air at 15 degrees and 1013.25 hPa in red light, 2.765e-4, times the height of such air that weighs as much."""
SCALE_HEIGHT = 8434.5
"""Metres: that height, pressure over density and gravity."""
SPARE_SAMPLES = 3
"""Samples of orbit and attitude kept beyond the margin of the image, for the derivatives at its ends."""
SAME_LINE = 0.1
"""Lines by which the time of the first line may differ from what the table of line times says."""

_RPC_SCALARS = {
    "LINE_OFF": "LINEOFFSET", "SAMP_OFF": "SAMPOFFSET", "LAT_OFF": "LATOFFSET", "LONG_OFF": "LONGOFFSET", "HEIGHT_OFF": "HEIGHTOFFSET",
    "LINE_SCALE": "LINESCALE", "SAMP_SCALE": "SAMPSCALE", "LAT_SCALE": "LATSCALE", "LONG_SCALE": "LONGSCALE", "HEIGHT_SCALE": "HEIGHTSCALE",
    "ERR_BIAS": "ERRBIAS", "ERR_RAND": "ERRRAND",
}  # fmt: skip
_RPC_POLYNOMIALS = {
    "LINE_NUM_COEFF": "LINENUMCOEF", "LINE_DEN_COEFF": "LINEDENCOEF", "SAMP_NUM_COEFF": "SAMPNUMCOEF", "SAMP_DEN_COEFF": "SAMPDENCOEF",
}  # fmt: skip


@dataclass(frozen=True)
class WorldViewImage:
    """What a metadata file says of an image.

    Attributes
    ----------
    image_id : the vendor's catalogue id
    satellite, band : as the vendor names them
    width, height : pixels
    acquired : time of the first line, ISO 8601 in UTC
    camera : description for `submin.sensors.pushbroom.PushbroomSensor`, of numbers and lists, ready for JSON
    rpc : the vendor's RPC with GDAL's names, and ``ERR_BIAS``, ``ERR_RAND`` (metres)
    position_covariance : (3, 3) of the orbit at the middle line, m2, geocentric
    attitude_covariance : (3, 3) of roll, pitch and yaw (rotations about the camera's own axes) at the middle line, rad2
    """

    image_id: str
    satellite: str
    band: str
    width: int
    height: int
    acquired: str
    camera: dict[str, Any]
    rpc: dict[str, Any]
    position_covariance: Array
    attitude_covariance: Array

    @property
    def uncertainties(self) -> dict[str, dict[str, float]]:
        """Sigmas of the attitude as the vendor states them, for `submin.adjustment.priors.APriori`'s ``parameters``."""
        sigmas = np.sqrt(np.diag(self.attitude_covariance))
        names = ("attitude roll", "attitude pitch", "attitude yaw")
        return {name: {"sigma": float(sigma)} for name, sigma in zip(names, sigmas, strict=True)}


def read_worldview(path: str | Path, aberration: bool = True, refraction: bool = True) -> WorldViewImage:
    """Read the metadata of one image.

    Parameters
    ----------
    path : the vendor's XML, perhaps compressed (``.gz``)
    aberration, refraction : whether the camera is described with these effects; without them it is 9 to 40 pixels and up to a few
        pixels off what the vendor's own RPC says

    Raises
    ------
    InputError
        Naming the file and what is missing, wrong or not provided for.
    """
    file = Path(path)
    try:
        return _image(_parse(file), aberration, refraction)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _parse(file: Path) -> ElementTree.Element:
    try:
        content = file.read_bytes()
        return ElementTree.fromstring(gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content)
    except FileNotFoundError:
        raise InputError("no such file; expected the metadata of an image, XML") from None
    except (OSError, EOFError, zlib.error, ElementTree.ParseError) as error:
        raise InputError(f"cannot be read as XML ({error})") from None


def _image(root: ElementTree.Element, aberration: bool, refraction: bool) -> WorldViewImage:
    width, height = (int(_number(root, f"IMD/{name}")) for name in ("NUMCOLUMNS", "NUMROWS"))
    first_line = _time(root, "IMD/IMAGE/FIRSTLINETIME")
    lines, line_times = _line_times(root, first_line)
    margin = margins(width, height)[1]
    reached = np.sort(np.interp([-margin, height - 1.0 + margin], *_extended(lines, line_times, margin + height)))
    middle = float(np.interp(0.5 * (height - 1.0), *_extended(lines, line_times, height)))

    ephemeris_times, ephemeris = _samples(root, "EPH", "EPHEMLIST", 12, first_line)
    attitude_times, attitude = _samples(root, "ATT", "ATTLIST", 14, first_line)
    ephemeris_rows, attitude_rows = _needed(ephemeris_times, reached), _needed(attitude_times, reached)
    rpc = _rpc(root)
    camera: dict[str, Any] = {
        "epoch": _text(root, "IMD/IMAGE/FIRSTLINETIME"),
        "position": {
            "times": ephemeris_times[ephemeris_rows].tolist(),
            "values": ephemeris[ephemeris_rows, :3].tolist(),
            "velocities": ephemeris[ephemeris_rows, 3:6].tolist(),
        },
        "attitude": {"times": attitude_times[attitude_rows].tolist(), "values": attitude[attitude_rows, :4].tolist()},
        "lines": {"times": line_times.tolist(), "values": lines.tolist()},
        **_geometry(root),
        "mean_height": rpc["HEIGHT_OFF"],
    }
    if aberration:
        camera["aberration"] = {"rotation_rate": ROTATION_RATE}
    if refraction:
        camera["refraction"] = {"zenith_path": ZENITH_PATH, "scale_height": SCALE_HEIGHT}
    at_middle = attitude[np.abs(attitude_times - middle).argmin()]
    return WorldViewImage(
        image_id=_text(root, "IMD/IMAGE/CATID"),
        satellite=_text(root, "IMD/IMAGE/SATID"),
        band=_text(root, "IMD/BANDID"),
        width=width,
        height=height,
        acquired=_text(root, "IMD/IMAGE/FIRSTLINETIME"),
        camera=camera,
        rpc=rpc,
        position_covariance=_symmetric(ephemeris[np.abs(ephemeris_times - middle).argmin(), 6:], 3),
        attitude_covariance=_rotation_covariance(at_middle[:4], _symmetric(at_middle[4:], 4)),
    )


def _line_times(root: ElementTree.Element, first_line: datetime) -> tuple[Array, Array]:
    """Lines and their times in seconds from the first line's: the table, or its one entry and the mean rate."""
    start = _since(_time(root, "IMD/IMAGE/TLCTIME"), first_line)
    table = _rows(root, "IMD/IMAGE/TLCLISTList", "TLCLIST", 2)
    rate = _number(root, "IMD/IMAGE/AVGLINERATE")
    if len(table) == 1:
        if _text(root, "IMD/IMAGE/SCANDIRECTION") != "Forward":
            raise InputError("IMD/IMAGE/TLCLISTList has one entry in a reverse scan; expected two or more")
        table = np.vstack([table, table[0] + [rate, 1.0]])
    lines, times = table[:, 0], start + table[:, 1]
    first = float(np.interp(0.0, lines, times))
    if not (lines[0] <= 0.0 and abs(first) * rate < SAME_LINE):
        raise InputError(
            f"IMD/IMAGE: the table of line times has line 0 at {first:g} s from FIRSTLINETIME; expected the same: lines of this image "
            "are not those of the sensor (a mosaic or a part?)"
        )
    return lines, times


def _extended(lines: Array, times: Array, reach: float) -> tuple[Array, Array]:
    """The table with an entry on either side, by its first and last interval."""
    slopes = np.diff(times) / np.diff(lines)
    before, after = times[0] - reach * slopes[0], times[-1] + reach * slopes[-1]
    return np.array([lines[0] - reach, *lines, lines[-1] + reach]), np.array([before, *times, after])


def _samples(root: ElementTree.Element, section: str, name: str, columns: int, epoch: datetime) -> tuple[Array, Array]:
    """Times in seconds from the epoch, and what follows the running number in each row (n, columns)."""
    interval = _number(root, f"{section}/TIMEINTERVAL")
    rows = _rows(root, f"{section}/{name}List", name, 1 + columns)
    count = int(_number(root, f"{section}/NUMPOINTS"))
    if not (len(rows) == count and np.array_equal(rows[:, 0], np.arange(1, count + 1))):
        raise InputError(f"{section}/{name}List has {len(rows)} rows; expected {count}, numbered from 1")
    times: Array = _since(_time(root, f"{section}/STARTTIME"), epoch) + interval * np.arange(count, dtype=np.float64)
    return times, rows[:, 1:]


def _needed(times: Array, reached: Array) -> slice:
    """Samples that cover the image and its margin, and a few to spare."""
    first, last = np.searchsorted(times, reached)
    return slice(max(int(first) - SPARE_SAMPLES, 0), int(last) + SPARE_SAMPLES)


def _geometry(root: ElementTree.Element) -> dict[str, Any]:
    """Focal length and detector line; raises for a camera that is not as those that could be checked."""
    if root.find("GEO") is None:
        raise InputError("has no section GEO; expected the metadata of a level 1B image, which alone describe the camera")
    if _number(root, "GEO/OPTICAL_DISTORTION/POLYORDER") > 0:
        raise InputError("GEO/OPTICAL_DISTORTION: POLYORDER is positive; expected a camera without distortion")
    for name, expected in (
        ("PERSPECTIVE_CENTER/CX", 0.0), ("PERSPECTIVE_CENTER/CY", 0.0), ("PERSPECTIVE_CENTER/CZ", 0.0),
        ("CAMERA_ATTITUDE/QCS1", 0.0), ("CAMERA_ATTITUDE/QCS2", 0.0), ("CAMERA_ATTITUDE/QCS3", 0.0), ("CAMERA_ATTITUDE/QCS4", 1.0),
    ):  # fmt: skip
        value = _number(root, f"GEO/{name}")
        if value != expected:
            raise InputError(f"GEO/{name} is {value:g}; expected {expected:g}: camera and satellite with the same origin and axes")
    band = f"GEO/DETECTOR_MOUNTING/BAND_{_text(root, 'IMD/BANDID')}/DETECTOR_ARRAY"
    arrays = len(root.findall(band))
    if arrays != 1:
        raise InputError(f"has {arrays} of {band}; expected one detector line")
    turned = _number(root, f"{band}/DETROTANGLE")
    if turned != 0.0:
        raise InputError(f"{band}/DETROTANGLE is {turned:g}; expected 0, a detector line along the camera's second axis")
    return {
        "focal_length": _number(root, "GEO/PRINCIPAL_DISTANCE/PD"),
        "detector": {
            "origin": [_number(root, f"{band}/DETORIGINX"), _number(root, f"{band}/DETORIGINY")],
            "step": [0.0, -_number(root, f"{band}/DETPITCH")],
        },
    }


def _rpc(root: ElementTree.Element) -> dict[str, Any]:
    rpc: dict[str, Any] = {gdal: _number(root, f"RPB/IMAGE/{name}") for gdal, name in _RPC_SCALARS.items()}
    for gdal, name in _RPC_POLYNOMIALS.items():
        rpc[gdal] = _rows(root, f"RPB/IMAGE/{name}List", name, 20)[0].tolist()
    return rpc


def _symmetric(upper: Array, size: int) -> Array:
    """A matrix from its upper triangle, row by row."""
    whole = np.zeros((size, size))
    whole[np.triu_indices(size)] = upper
    return whole + np.triu(whole, 1).T


def _rotation_covariance(quaternion: Array, covariance: Array) -> Array:
    """Covariance (3, 3) of the small rotations about the camera's own axes, from that (4, 4) of the quaternion x, y, z, w."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    by_quaternion = 2.0 * np.array([[w, z, -y, -x], [-z, w, x, -y], [y, -x, w, -z]])
    return np.asarray(by_quaternion @ covariance @ by_quaternion.T)


def _text(root: ElementTree.Element, path: str) -> str:
    found = root.find(path)
    if found is None or not (found.text or "").strip():
        raise InputError(f"{path} is missing")
    return str(found.text).strip()


def _number(root: ElementTree.Element, path: str) -> float:
    value = _text(root, path)
    try:
        number = float(value)
    except ValueError:
        number = float("nan")
    if not np.isfinite(number):
        raise InputError(f"{path} is {value!r}; expected a number")
    return number


def _time(root: ElementTree.Element, path: str) -> datetime:
    value = _text(root, path)
    try:
        time = datetime.fromisoformat(value)
    except ValueError:
        raise InputError(f"{path} is {value!r}; expected a time as 2014-06-19T18:52:50.787577Z") from None
    if time.utcoffset() != timedelta(0):
        raise InputError(f"{path} is {value!r}; expected a time in UTC, as 2014-06-19T18:52:50.787577Z")
    return time


def _since(time: datetime, epoch: datetime) -> float:
    return (time - epoch) / timedelta(seconds=1)


def _rows(root: ElementTree.Element, section: str, name: str, columns: int) -> Array:
    """The numbers of all elements of that name in a section (n, columns)."""
    elements = root.findall(f"{section}/{name}")
    if not elements:
        raise InputError(f"{section}/{name} is missing; expected {columns} numbers in each")
    rows = np.empty((len(elements), columns))
    for k, element in enumerate(elements):
        words = (element.text or "").split()
        try:
            rows[k] = [float(word) for word in words]
        except ValueError:
            raise InputError(f"{section}/{name}, entry {k + 1}, is {' '.join(words)[:60]!r}; expected {columns} numbers") from None
    if not np.isfinite(rows).all():
        k = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise InputError(f"{section}/{name}, entry {k + 1}, holds a value that is not finite; expected {columns} numbers")
    return rows


__all__ = ["ROTATION_RATE", "SCALE_HEIGHT", "ZENITH_PATH", "WorldViewImage", "read_worldview"]
