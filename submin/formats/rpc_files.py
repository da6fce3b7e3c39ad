"""RPC files as camera descriptions with GDAL's names, which `submin.sensors.rpc` packs.

Read are JSON with GDAL's names, JSON with the names of the Python package rpcm (perhaps under a key ``rpc``, beside other things), and
text as in ``*_RPC.TXT``, a line ``NAME: value unit`` each (GDAL, "RPCs in GeoTIFF"; STDI-0002, appendix E).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from submin.errors import InputError
from submin.sensors.rpc import POLYNOMIALS, SCALARS, TERMS, RpcSensor

ACCURACIES = ("ERR_BIAS", "ERR_RAND")
"""RMS errors in metres that the vendor states; kept when a file has them."""

_RPCM_NAMES = {
    "row_offset": "LINE_OFF", "col_offset": "SAMP_OFF", "lat_offset": "LAT_OFF", "lon_offset": "LONG_OFF", "alt_offset": "HEIGHT_OFF",
    "row_scale": "LINE_SCALE", "col_scale": "SAMP_SCALE", "lat_scale": "LAT_SCALE", "lon_scale": "LONG_SCALE", "alt_scale": "HEIGHT_SCALE",
    "row_num": "LINE_NUM_COEFF", "row_den": "LINE_DEN_COEFF", "col_num": "SAMP_NUM_COEFF", "col_den": "SAMP_DEN_COEFF",
}  # fmt: skip

_TEXT_LINE = re.compile(r"\s*([A-Z][A-Z_0-9]*)\s*[:=]\s*(.*)")


def read_rpc(path: str | Path) -> dict[str, Any]:
    """Camera description of an RPC file: GDAL's names, numbers and lists of 20 numbers.

    Parameters
    ----------
    path : JSON with GDAL's or rpcm's names, or text as in ``*_RPC.TXT``; what it is is told from its content

    Returns
    -------
    dict
        ``LINE_OFF`` ... ``HEIGHT_SCALE`` (degrees, metres above the ellipsoid, pixels; the file's pixel frame is kept),
        ``LINE_NUM_COEFF`` ... ``SAMP_DEN_COEFF`` in the RPC00B order of terms, and ``ERR_BIAS``, ``ERR_RAND`` where the file has them.

    Raises
    ------
    InputError
        Naming the file and what is missing or wrong.
    """
    file = Path(path)
    try:
        content = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{file}: no such file; expected an RPC") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read as an RPC, JSON or text ({error})") from None
    spelling: Mapping[str, str] = {}
    try:
        values, spelling = _from_json(content) if content.lstrip().startswith("{") else (_from_text(content), spelling)
        camera = _camera(values)
        RpcSensor().pack(camera, 1, 1)
    except InputError as error:
        message = str(error)
        for name, own in spelling.items():
            message = message.replace(name, own)
        raise InputError(f"{file}: {message}") from None
    return camera


def _from_json(content: str) -> tuple[Mapping[str, Any], Mapping[str, str]]:
    """Entries under GDAL's names, and how the file itself spells those."""
    try:
        values = json.loads(content)
    except json.JSONDecodeError as error:
        raise InputError(f"is not JSON ({error})") from None
    if isinstance(values.get("rpc"), dict):
        values = values["rpc"]
    if any(name in values for name in (*SCALARS, *POLYNOMIALS)):
        return values, {}
    if any(name in values for name in _RPCM_NAMES):
        named = {gdal: values[name] for name, gdal in _RPCM_NAMES.items() if name in values}
        return named, {gdal: name for name, gdal in _RPCM_NAMES.items()}
    raise InputError("RPC: names are not known; expected GDAL's (LINE_OFF, LINE_NUM_COEFF, ...) or rpcm's (row_offset, row_num, ...)")


def _from_text(content: str) -> Mapping[str, Any]:
    values: dict[str, Any] = {m[1]: m[2] for m in map(_TEXT_LINE.fullmatch, content.splitlines()) if m}
    if not any(name.startswith((*SCALARS, *POLYNOMIALS)) for name in values):
        raise InputError("RPC: holds no line that is known; expected JSON, or text with lines as 'LINE_OFF: 1234.5 pixels'")
    for name in POLYNOMIALS:
        if name in values:
            continue
        terms = [f"{name}_{k}" for k in range(1, TERMS + 1)]
        missing = [term for term in terms if term not in values]
        if missing:
            raise InputError(f"RPC: {missing[0]} is missing; expected {terms[0]} to {terms[-1]}")
        values[name] = [_first_number(term, values[term]) for term in terms]
    return values


def _camera(values: Mapping[str, Any]) -> dict[str, Any]:
    """The known entries of a description, texts turned into numbers; whether all are there is left to the sensor model."""
    camera: dict[str, Any] = {}
    for name in (*SCALARS, *ACCURACIES):
        value = values.get(name)
        if value is None or (name in ACCURACIES and not str(value).strip()):
            continue
        camera[name] = _first_number(name, value)
    for name in POLYNOMIALS:
        if name in values:
            value = values[name]
            terms = value.split() if isinstance(value, str) else value
            if not isinstance(terms, list):
                raise InputError(f"RPC: {name} is {value!r}; expected {TERMS} coefficients")
            camera[name] = [_first_number(f"{name}, coefficient {k}", term) for k, term in enumerate(terms, start=1)]
    return camera


def _first_number(name: str, value: Any) -> float:
    """A number, or the number at the head of a text: a unit may follow it."""
    head = value.split()[:1] if isinstance(value, str) else [value]
    try:
        if not head or isinstance(head[0], bool):
            raise ValueError
        return float(head[0])
    except (TypeError, ValueError):
        raise InputError(f"RPC: {name} is {value!r}; expected a number") from None


__all__ = ["ACCURACIES", "read_rpc"]
