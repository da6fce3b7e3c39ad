"""RPC files in their three spellings give one camera; every defect is named with its file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from submin.errors import InputError
from submin.formats.rpc_files import read_rpc
from submin.sensors.rpc import POLYNOMIALS, SCALARS, RpcSensor

RPCM = {
    "LINE_OFF": "row_offset", "SAMP_OFF": "col_offset", "LAT_OFF": "lat_offset", "LONG_OFF": "lon_offset", "HEIGHT_OFF": "alt_offset",
    "LINE_SCALE": "row_scale", "SAMP_SCALE": "col_scale", "LAT_SCALE": "lat_scale", "LONG_SCALE": "lon_scale", "HEIGHT_SCALE": "alt_scale",
    "LINE_NUM_COEFF": "row_num", "LINE_DEN_COEFF": "row_den", "SAMP_NUM_COEFF": "col_num", "SAMP_DEN_COEFF": "col_den",
}  # fmt: skip
UNITS = {"LINE": "pixels", "SAMP": "pixels", "LAT": "degrees", "LONG": "degrees", "HEIGHT": "meters"}


def camera() -> dict[str, Any]:
    """A camera of which no two numbers are the same, so that none can be taken for another."""
    scalars = {name: 11.5 + k for k, name in enumerate(SCALARS)}
    return scalars | {name: [1.0 + k + 0.01 * term for term in range(20)] for k, name in enumerate(POLYNOMIALS)}


def as_rpc_txt(values: dict[str, Any]) -> str:
    lines = []
    for name, value in values.items():
        if isinstance(value, list):
            lines += [f"{name}_{k}: {term:+.16E}" for k, term in enumerate(value, start=1)]
        else:
            lines.append(f"{name}: {value:+013.4f} {UNITS.get(name.split('_')[0], 'meters')}")
    return "\r\n".join(lines) + "\r\n"


def as_rpcm(values: dict[str, Any]) -> dict[str, Any]:
    return {RPCM[name]: value for name, value in values.items()}


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), newline="")
    return path


@pytest.mark.parametrize(
    "content",
    [
        camera(),
        {name: " ".join(map(str, v)) if isinstance(v, list) else str(v) for name, v in camera().items()},
        {"rpc": camera(), "width": 10},
        as_rpcm(camera()),
        {"img": "a.tif", "min_alt": -27, "rpc": as_rpcm(camera())},
        as_rpc_txt(camera()),
        "\ufeff" + json.dumps(camera()),
    ],
    ids=["gdal", "gdal-texts", "gdal-nested", "rpcm", "rpcm-nested", "text", "byte-order-mark"],
)
def test_every_spelling_gives_the_same_camera(tmp_path: Path, content: Any) -> None:
    read = read_rpc(write(tmp_path / "any.name", content))
    assert read == camera()
    np.testing.assert_array_equal(RpcSensor().pack(read, 10, 10), RpcSensor().pack(camera(), 10, 10))


@pytest.mark.parametrize("spelled", [lambda c: c, as_rpc_txt])
def test_accuracies_are_kept(tmp_path: Path, spelled: Any) -> None:
    read = read_rpc(write(tmp_path / "a", spelled(camera() | {"ERR_BIAS": 3.5, "ERR_RAND": 0.5})))
    assert (read["ERR_BIAS"], read["ERR_RAND"]) == (3.5, 0.5)
    assert "ERR_BIAS" not in read_rpc(write(tmp_path / "b", camera() | {"ERR_BIAS": ""}))


def without(name: str) -> dict[str, Any]:
    return {k: v for k, v in camera().items() if k != name}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (without("LAT_OFF"), "RPC: LAT_OFF is missing; expected one number"),
        (without("SAMP_DEN_COEFF"), "RPC: SAMP_DEN_COEFF is missing; expected 20 coefficients"),
        (camera() | {"LINE_NUM_COEFF": [1.0] * 19}, "RPC: LINE_NUM_COEFF has 19 coefficients; expected 20"),
        (camera() | {"LINE_NUM_COEFF": "1 2 3"}, "RPC: LINE_NUM_COEFF has 3 coefficients; expected 20"),
        (camera() | {"LINE_NUM_COEFF": 5.0}, "RPC: LINE_NUM_COEFF is 5.0; expected 20 coefficients"),
        (camera() | {"LINE_NUM_COEFF": ["x"] * 20}, "RPC: LINE_NUM_COEFF, coefficient 1 is 'x'; expected a number"),
        (camera() | {"LONG_OFF": "east"}, "RPC: LONG_OFF is 'east'; expected a number"),
        (camera() | {"LONG_OFF": True}, "RPC: LONG_OFF is True; expected a number"),
        (camera() | {"HEIGHT_SCALE": 0.0}, "RPC: HEIGHT_SCALE is 0; expected a positive number"),
        (camera() | {"HEIGHT_OFF": float("nan")}, "RPC: HEIGHT_OFF is nan; expected a finite number"),
        (camera() | {"ERR_BIAS": "small"}, "RPC: ERR_BIAS is 'small'; expected a number"),
        (as_rpcm(without("LINE_SCALE")), "RPC: row_scale is missing; expected one number"),
        (as_rpcm(camera() | {"SAMP_NUM_COEFF": [1.0]}), "RPC: col_num has 1 coefficients; expected 20"),
        (as_rpc_txt(without("SAMP_OFF")), "RPC: SAMP_OFF is missing; expected one number"),
        (
            as_rpc_txt(camera()).replace("LINE_DEN_COEFF_7:", "LINE_DEN_KOEFF_7:"),
            "RPC: LINE_DEN_COEFF_7 is missing; expected LINE_DEN_COEFF_1",
        ),
        ({"type": "Feature"}, "RPC: names are not known"),
        ("{", "is not JSON"),
        ("satId = QB02;", "RPC: holds no line that is known"),
        ("", "RPC: holds no line that is known"),
    ],
)
def test_defects_are_named(tmp_path: Path, content: Any, message: str) -> None:
    path = write(tmp_path / "bad_rpc", content)
    with pytest.raises(InputError) as raised:
        read_rpc(path)
    assert str(raised.value).startswith(f"{path}: {message}")
    assert "\n" not in str(raised.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file; expected an RPC"):
        read_rpc(tmp_path / "nothing")
    (tmp_path / "image.tif").write_bytes(b"II*\x00\xff\xfe\x80")
    with pytest.raises(InputError, match=r"image.tif: cannot be read as an RPC"):
        read_rpc(tmp_path / "image.tif")
