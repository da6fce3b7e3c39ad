"""ISD files of frame cameras (image support data as ISIS and ALE write them) as descriptions that `submin.sensors.frame` packs.

An ISD has the position (km) and attitude of the camera and the attitude of the body, all against J2000, and the keywords of the
instrument's kernel. Its detector is that of the full resolution; images may have been reduced from it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.geodesy import Ellipsoid
from submin.sensors.frame import quaternion_rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class IsdCamera:
    """A frame camera of an ISD file.

    Attributes
    ----------
    platform, sensor : as the file names them
    ellipsoid : of the body
    frame : of the body-fixed coordinates, as the file numbers it
    position : (3,), body-fixed, metres; velocity : (3,), direction of flight in body-fixed axes
    rotation : (3, 3), body-fixed to camera
    looks_along : ``+z`` or ``-z``
    focal_length, principal_point : millimetres
    samples_by_mm, lines_by_mm : (3,), of the full detector: constant part in pixels, and by millimetre of x and y
    detector_centre : (2,) sample and line of the detector's origin, first pixel's centre (0, 0), or None: in the middle
    distortion : as of `submin.sensors.frame`, or None
    size : (2,) samples and lines
    reference_height : metres, of mean ground where nothing better is known
    """

    platform: str
    sensor: str
    ellipsoid: Ellipsoid
    frame: str
    position: Array
    velocity: Array
    rotation: Array
    looks_along: str
    focal_length: float
    principal_point: Array
    samples_by_mm: Array
    lines_by_mm: Array
    detector_centre: Array | None
    distortion: dict[str, Any] | None
    size: tuple[int, int]
    reference_height: float

    def description(self, size: tuple[int, int], reduction: float, height: float) -> dict[str, Any]:
        """Description for the frame sensor, of an image of a size (samples, lines) that was reduced from the detector so many times.

        A reduced pixel is the mean of ``reduction`` x ``reduction`` pixels: what is at p in the full image, counted from the centre of the
        first pixel, is at ``(p + 0.5) / reduction - 0.5`` in the reduced one. ISIS puts the origin of the detector at half its size,
        counted from 1.
        """
        full = np.array(size) * reduction
        origin = full / 2.0 - 1.0 if self.detector_centre is None else self.detector_centre
        to_pixel = np.stack([self.samples_by_mm, self.lines_by_mm]) / reduction
        to_pixel[:, 0] = (origin + np.array([self.samples_by_mm[0], self.lines_by_mm[0]]) + 0.5) / reduction - 0.5
        description = {
            "position": self.position.tolist(), "rotation": self.rotation.tolist(), "looks_along": self.looks_along,
            "focal_length": self.focal_length, "principal_point": self.principal_point.tolist(), "mm_to_pixel": to_pixel.tolist(),
            "velocity": self.velocity.tolist(), "height": height,
        }  # fmt: skip
        return description if self.distortion is None else description | {"distortion": self.distortion}


def read_isd(path: str | Path) -> IsdCamera:
    """The frame camera of an ISD file.

    The lens distortion of the Apollo metric cameras is known (kernel keywords ``OD_K`` and ``DECENTER``, from measured to ideal
    coordinates, looking along -z); another camera must have none, or is refused: a wrong distortion would look plausible.

    Raises
    ------
    InputError
        Naming the file and what is missing or wrong.
    """
    file = Path(path)
    try:
        isd = json.loads(file.read_text(encoding="utf-8-sig"))
        if not isinstance(isd, dict):
            raise InputError(f"holds {type(isd).__name__}; expected a JSON object")
        return _camera(isd)
    except FileNotFoundError:
        raise InputError(f"{file}: no such file; expected an ISD, the camera of an image") from None
    except (OSError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read as an ISD, a JSON object ({error})") from None
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def _camera(isd: dict[str, Any]) -> IsdCamera:
    model = isd.get("name_model")
    if model != "USGS_ASTRO_FRAME_SENSOR_MODEL":
        raise InputError(f"ISD: name_model is {model!r}; expected 'USGS_ASTRO_FRAME_SENSOR_MODEL', a frame camera")
    radii = [1000.0 * float(_numbers(isd, ("radii", name), ())) for name in ("semimajor", "semiminor")]
    to_body, to_camera = _attitude(isd, "body_rotation"), _attitude(isd, "instrument_pointing")
    position, velocity = (_of_one_time(isd, "instrument_position", name, 3) for name in ("positions", "velocities"))
    metric = str(isd.get("name_sensor", "")).upper() == "METRIC"
    keywords = _kernel(isd)
    if not metric:
        _refuse_distortion(isd)
    return IsdCamera(
        platform=str(isd.get("name_platform", "")),
        sensor=str(isd.get("name_sensor", "")),
        ellipsoid=Ellipsoid(radii[0], 1.0 - radii[1] / radii[0]),
        frame=f"NAIF {keywords['BODY_FRAME_CODE']}" if "BODY_FRAME_CODE" in keywords else "body-fixed",
        position=1000.0 * (to_body @ position),
        velocity=to_body @ velocity,
        rotation=to_camera @ to_body.T,
        looks_along="-z" if metric else "+z",
        focal_length=float(_numbers(isd, ("focal_length_model", "focal_length"), ())),
        principal_point=_numbers(keywords, ("PP",), (2,)) if "PP" in keywords else np.zeros(2),
        samples_by_mm=_numbers(isd, ("focal2pixel_samples",), (3,)),
        lines_by_mm=_numbers(isd, ("focal2pixel_lines",), (3,)),
        detector_centre=_detector_centre(isd),
        distortion=_apollo_metric(keywords) if metric else None,
        size=(int(_numbers(isd, ("image_samples",), ())), int(_numbers(isd, ("image_lines",), ()))),
        reference_height=float(np.mean([_numbers(isd, ("reference_height", name), ()) for name in ("minheight", "maxheight")])),
    )


def _apollo_metric(keywords: dict[str, Any]) -> dict[str, Any]:
    radial, decentering = (_numbers(keywords, (name,), (3,)).tolist() for name in ("OD_K", "DECENTER"))
    return {"radial": radial, "decentering": decentering, "direction": "measured to ideal"}


def _refuse_distortion(isd: dict[str, Any]) -> None:
    """Refuse a distortion, of whatever model, that is not zero."""
    stated = isd.get("optical_distortion") or {}
    models = stated.values() if isinstance(stated, dict) else [None]
    if any(not isinstance(model, dict) or any(model.get("coefficients", [1.0])) for model in models):
        raise InputError(
            f"ISD: the lens distortion of camera {isd.get('name_sensor')!r} is {stated}; "
            "known are those of the Apollo metric cameras, and none"
        )


def _kernel(isd: dict[str, Any]) -> dict[str, Any]:
    """Keywords of the instrument's kernel without the instrument's number: ``OD_K`` of ``INS-915240_OD_K``."""
    keywords = isd.get("naif_keywords", {})
    if not isinstance(keywords, dict):
        raise InputError(f"ISD: naif_keywords is {type(keywords).__name__}; expected a JSON object")
    return {name.split("_", 1)[1] if name.startswith("INS") and "_" in name else name: value for name, value in keywords.items()}


def _attitude(isd: dict[str, Any], table: str) -> Array:
    """Rotation (3, 3) from J2000 to the frame of a table, by its quaternion and the constant rotation after it."""
    quaternion = _of_one_time(isd, table, "quaternions", 4)
    if abs(np.linalg.norm(quaternion) - 1.0) > 1e-6:
        raise InputError(
            f"ISD: quaternion of {table} has length {np.linalg.norm(quaternion):.6g}; expected a unit quaternion, scalar first"
        )
    rotation = quaternion_rotation(quaternion)
    if "constant_rotation" in isd[table]:
        rotation = _numbers(isd, (table, "constant_rotation"), (9,)).reshape(3, 3) @ rotation
    return np.asarray(rotation)


def _of_one_time(isd: dict[str, Any], table: str, name: str, width: int) -> Array:
    values = isd.get(table, {}).get(name) if isinstance(isd.get(table, {}), dict) else None
    if isinstance(values, list) and len(values) > 1:
        raise InputError(f"ISD: {name} of {table} holds {len(values)} times; expected one, that of a frame image")
    return np.asarray(_numbers(isd, (table, name), (1, width))[0])


def _detector_centre(isd: dict[str, Any]) -> Array | None:
    """Sample and line, first pixel's centre (0, 0), of the origin of the detector; ALE counts that centre as (0.5, 0.5)."""
    stated = isd.get("detector_center") or {}
    if not isinstance(stated, dict) or stated.get("sample") is None or stated.get("line") is None:
        return None
    return np.array([_numbers(isd, ("detector_center", name), ()) for name in ("sample", "line")]) - 0.5


def _numbers(values: dict[str, Any], path: tuple[str, ...], shape: tuple[int, ...]) -> Array:
    name = " / ".join(path)
    found: Any = values
    for key in path:
        if not isinstance(found, dict) or key not in found:
            raise InputError(f"ISD: {name} is missing; expected {'x'.join(map(str, shape)) or 'one'} numbers")
        found = found[key]
    try:
        numbers = np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise InputError(f"ISD: {name} is {found!r}; expected {'x'.join(map(str, shape)) or 'one'} finite numbers")
    return numbers


__all__ = ["IsdCamera", "read_isd"]
