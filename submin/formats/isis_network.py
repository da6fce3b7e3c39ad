"""ISIS control networks: points with what is known of them beforehand, and their measures in images; PVL, or the binary file of version 5.

Coordinates of a measure are as in the file: the centre of the first pixel is (1, 1).
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from submin.errors import InputError
from submin.formats.isis_pvl import Aggregate, parse_pvl

PVL_VERSIONS = ("3", "4", "5")
"""Versions whose points have geocentric coordinates (AprioriX, AprioriY, AprioriZ)."""
POINT_TYPES = ("Free", "Constrained", "Fixed")
_FORMER_TYPES = {"Tie": "Free", "Ground": "Fixed"}
_CONVERT = "convert it with ISIS: cnetbin2pvl from=NETWORK.net to=NETWORK.pvl"


@dataclass(frozen=True)
class Measure:
    """A point as measured in an image: sample and line with (1, 1) the centre of the first pixel, sigmas where the network states them."""

    serial_number: str
    sample: float
    line: float
    sigma_sample: float | None = None
    sigma_line: float | None = None


@dataclass(frozen=True)
class NetworkPoint:
    """A point of a control network.

    Attributes
    ----------
    point_id : unique in its network
    kind : ``Free``, ``Constrained`` or ``Fixed``
    a_priori : geocentric coordinates, metres, or None
    covariance : xx, xy, xz, yy, yz, zz of the a priori coordinates, m2, or None
    measures : those that count
    """

    point_id: str
    kind: str
    a_priori: tuple[float, float, float] | None
    covariance: tuple[float, ...] | None
    measures: tuple[Measure, ...]


@dataclass(frozen=True)
class ControlNetwork:
    """A control network without what it says to ignore.

    Attributes
    ----------
    network_id, target : its name, and the body
    points : in the order of the file
    left_out : how many points and measures were not taken, by reason
    """

    network_id: str
    target: str
    points: tuple[NetworkPoint, ...]
    left_out: Mapping[str, int]


def read_network(path: str | Path) -> ControlNetwork:
    """A control network of a file: PVL (perhaps gzipped), or binary of version 5; what it is is told from its content.

    Points and measures that are ignored or were rejected by an adjustment are left out and counted, and so are candidates, which nobody has
    measured.

    Raises
    ------
    InputError
        Naming the file and the line or point that cannot be used.
    """
    file = Path(path)
    try:
        content = file.read_bytes()
        if content[:2] == b"\x1f\x8b":
            content = gzip.decompress(content)
    except FileNotFoundError:
        raise InputError(f"{file}: no such file; expected an ISIS control network") from None
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{file}: cannot be read ({error}); copy it again") from None
    try:
        return _from_binary(content) if b"ProtoBuffer" in content[:4096] else _from_pvl(content)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


class _Taken:
    """Points with the measures that count; what does not is counted."""

    def __init__(self) -> None:
        self.points: list[NetworkPoint] = []
        self.left_out: Counter[str] = Counter()
        self._ids: set[str] = set()

    def add(self, point: NetworkPoint, ignored: bool, rejected: bool) -> None:
        if point.kind not in POINT_TYPES:
            raise InputError(f"point {point.point_id}: PointType is {point.kind!r}; expected one of {', '.join(POINT_TYPES)}")
        if point.point_id in self._ids:
            raise InputError(f"point {point.point_id} is there twice; expected it once")
        self._ids.add(point.point_id)
        if ignored or rejected:
            self.left_out["ignored points" if ignored else "rejected points"] += 1
        else:
            self.points.append(point)

    def keeps(self, ignored: bool, rejected: bool, candidate: bool) -> bool:
        """Whether a measure counts."""
        reason = "ignored" if ignored else "rejected" if rejected else "candidate" if candidate else ""
        if reason:
            self.left_out[f"{reason} measures"] += 1
        return not reason


def _from_pvl(content: bytes) -> ControlNetwork:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError("is neither PVL in UTF-8 nor a binary control network; expected an ISIS control network") from None
    network = parse_pvl(text).part("ControlNetwork")
    if network is None:
        raise InputError("holds no Object = ControlNetwork; expected an ISIS control network")
    version = network.text("Version")
    if version not in PVL_VERSIONS:
        raise InputError(
            f"Version of the network is {version}; expected one of {', '.join(PVL_VERSIONS)}: write it again with a newer ISIS"
        )
    taken = _Taken()
    for part in network.parts:
        if part.name == "ControlPoint":
            try:
                _take_pvl_point(part, taken)
            except InputError as error:
                raise InputError(f"line {part.line}: {str(error).removeprefix(f'line {part.line}: ')}") from None
    return ControlNetwork(network.text("NetworkId") or "", network.text("TargetName") or "", tuple(taken.points), dict(taken.left_out))


def _take_pvl_point(part: Aggregate, taken: _Taken) -> None:
    point_id = _required(part, "PointId")
    kind = _required(part, "PointType")
    measures = []
    for group in part.parts:
        if group.name != "ControlMeasure":
            continue
        candidate = group.text("MeasureType") == "Candidate"
        if taken.keeps(_true(group, "Ignore"), _true(group, "JigsawRejected"), candidate):
            serial_number = _required(group, "SerialNumber")
            sample, line = _number(group, "Sample"), _number(group, "Line")
            if sample is None or line is None:
                raise InputError(f"point {point_id}: the measure in {serial_number} has no {'Sample' if sample is None else 'Line'}")
            measures.append(Measure(serial_number, sample, line, _number(group, "SampleSigma"), _number(group, "LineSigma")))
    x, y, z = (_number(part, f"Apriori{axis}") for axis in "XYZ")
    a_priori = None if x is None or y is None or z is None else (x, y, z)
    point = NetworkPoint(point_id, _FORMER_TYPES.get(kind, kind), a_priori, _covariance(part), tuple(measures))
    taken.add(point, _true(part, "Ignore"), _true(part, "JigsawRejected"))


def _required(part: Aggregate, name: str) -> str:
    value = part.text(name)
    if not value:
        raise InputError(f"{part.name} has no {name}; expected one")
    return value


def _true(part: Aggregate, name: str) -> bool:
    return (part.text(name) or "").lower() in ("true", "yes")


def _number(part: Aggregate, name: str) -> float | None:
    value = part.text(name)
    if value is None:
        return None
    return _finite(value, f"{name} of {part.name}")


def _finite(value: str, name: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise InputError(f"{name} is {value!r}; expected a finite number")
    return number


def _covariance(part: Aggregate) -> tuple[float, ...] | None:
    value = part.values.get("AprioriCovarianceMatrix")
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 6:
        raise InputError(f"AprioriCovarianceMatrix of {part.name} is {value!r}; expected 6 numbers: xx, xy, xz, yy, yz, zz (m2)")
    return tuple(_finite(item, "AprioriCovarianceMatrix") for item in value)


# The binary file: a label in PVL, which says where the header and the points stand, and protocol buffers, each point with its length
# before it. Field numbers are those of ControlPointFileEntryV0002.proto and ControlNetFileHeaderV0005.proto of ISIS (public domain).

_VARINT, _DOUBLE, _BYTES, _FLOAT = 0, 1, 2, 5
_KINDS = {0: "Free", 1: "Fixed", 2: "Free", 3: "Constrained", 4: "Fixed"}

Fields = dict[int, list[int | bytes]]


def _from_binary(content: bytes) -> ControlNetwork:
    label_end = content.find(b"\x00")
    label = parse_pvl(content[: label_end if label_end > 0 else len(content)].decode("utf-8", "replace")).part("ProtoBuffer")
    core, about = (None, None) if label is None else (label.part("Core"), label.part("ControlNetworkInfo"))
    if core is None or about is None:
        raise InputError(f"the label of the binary network names no Core and ControlNetworkInfo; {_CONVERT}")
    version = about.text("Version")
    if version != "5":
        raise InputError(f"Version of the binary network is {version}; expected 5: {_CONVERT}")
    start, length, points = (_whole(core, name) for name in ("HeaderStartByte", "HeaderBytes", "PointsBytes"))
    first = _whole(core, "PointsStartByte") if "PointsStartByte" in core.values else start + length
    if first + points > len(content) or start + length > len(content):
        raise InputError(f"is {len(content)} bytes long where its label says {first + points}; the file looks cut short")
    taken = _Taken()
    try:
        header = _fields(content[start : start + length])
        for message in _messages(content, first, first + points):
            _take_binary_point(_fields(message), taken)
        return ControlNetwork(_text(header, 1), _text(header, 2), tuple(taken.points), dict(taken.left_out))
    except (struct.error, IndexError, KeyError, UnicodeDecodeError, TypeError):
        raise InputError(f"holds a point that cannot be decoded, after {len(taken.points)} that can; {_CONVERT}") from None


def _whole(core: Aggregate, name: str) -> int:
    value = core.text(name) or ""
    if not value.isdigit():
        raise InputError(f"{name} of the binary network's label is {value!r}; expected a number of bytes: {_CONVERT}")
    return int(value)


def _messages(content: bytes, at: int, end: int) -> Iterator[bytes]:
    while at < end:
        (size,) = struct.unpack_from("<I", content, at)
        if at + 4 + size > end:
            raise IndexError
        yield content[at + 4 : at + 4 + size]
        at += 4 + size


def _fields(message: bytes) -> Fields:
    """Values of a protocol buffer by field number: integers, or bytes of all else."""
    fields: Fields = {}
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        value: int | bytes
        if kind == _VARINT:
            value, at = _varint(message, at)
        else:
            if kind == _BYTES:
                size, at = _varint(message, at)
            else:
                size = {_DOUBLE: 8, _FLOAT: 4}[kind]
            if at + size > len(message):
                raise IndexError
            value, at = message[at : at + size], at + size
        fields.setdefault(number, []).append(value)
    return fields


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = message[at]
        value, shift, at = value | (byte & 0x7F) << shift, shift + 7, at + 1
        if byte < 0x80:
            return value, at


def _take_binary_point(fields: Fields, taken: _Taken) -> None:
    measures = []
    for part in fields.get(25, []):
        measure = _fields(_raw(part))
        if taken.keeps(_flag(measure, 10), _flag(measure, 11), measure[2][-1] == 0):
            sample, line = _double(measure, 3), _double(measure, 4)
            if sample is None or line is None:
                raise InputError(f"point {_text(fields, 1)}: the measure in {_text(measure, 1)} has no coordinates")
            measures.append(Measure(_text(measure, 1), sample, line, _double(measure, 15), _double(measure, 16)))
    x, y, z = (_double(fields, number) for number in (16, 17, 18))
    a_priori = None if x is None or y is None or z is None else (x, y, z)
    covariance = b"".join(_raw(part) for part in fields.get(19, []))  # packed in one piece, or in eight bytes each
    values = struct.unpack(f"<{len(covariance) // 8}d", covariance) if covariance else None
    kind = fields[2][-1]
    point = NetworkPoint(_text(fields, 1), _KINDS.get(kind, str(kind)) if isinstance(kind, int) else "", a_priori, values, tuple(measures))
    taken.add(point, _flag(fields, 6), _flag(fields, 7))


def _raw(value: int | bytes) -> bytes:
    if not isinstance(value, bytes):
        raise TypeError
    return value


def _text(fields: Fields, number: int) -> str:
    return _raw(fields[number][-1]).decode("utf-8") if number in fields else ""


def _flag(fields: Fields, number: int) -> bool:
    return bool(fields.get(number, [0])[-1])


def _double(fields: Fields, number: int) -> float | None:
    if number not in fields:
        return None
    value = float(struct.unpack("<d", _raw(fields[number][-1]))[0])
    if not np.isfinite(value):
        raise InputError(f"point {_text(fields, 1)}: field {number} is {value}; expected a finite number")
    return value


__all__ = ["ControlNetwork", "Measure", "NetworkPoint", "read_network"]
