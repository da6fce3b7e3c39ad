"""Cases of a catalogue whose structure is wrong: nothing of it comes in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bad_input.world import POINT, SIGMAS, World, case, simply


def changed(name: str, change: Callable[[World], Any]) -> None:
    """Enter a case in which a changed catalogue is run."""

    def words(w: World) -> list[Any]:
        change(w)
        return [*w.run(), "--batch-blocks", 1]  # were the first block committed before the last row is read, it would show

    case(name)(words)


simply("no such catalogue", lambda w: ["run", w.folder / "nowhere", w.network])
simply("file in place of a catalogue", lambda w: ["run", w.write("file", "mine"), w.network])
simply("folder that is not a catalogue", lambda w: ["run", w.network, w.network])
changed("metadata that are not JSON", lambda w: w.write("catalogue/catalogue.json", "name: region") if w.catalogue else None)
changed("metadata that are not UTF-8", lambda w: w.write("catalogue/catalogue.json", b'{"name": "Z\xfcrich"}') if w.catalogue else None)
changed("unknown key in the metadata", lambda w: w.metadata(datum="WGS84"))
changed("missing key in the metadata", lambda w: (w.catalogue / "catalogue.json").write_text('{"name": "region"}'))
changed("catalogue of another format version", lambda w: w.metadata(format_version=2))
changed("orthometric heights", lambda w: w.metadata(height_kind="orthometric"))
changed("ellipsoid that is none", lambda w: w.metadata(semimajor_axis=-1.0))
changed("another frame", lambda w: w.metadata(frame="ITRF2014"))
changed("another epoch", lambda w: w.metadata(epoch="2010.0"))
changed("another body", lambda w: w.metadata(body="moon", semimajor_axis=1737400.0, flattening=0.0))

changed("table missing", lambda w: (w.catalogue / "measurements.parquet").unlink())
changed("table there twice", lambda w: (w.catalogue / "measurements.csv").write_text("mine"))
changed(
    "missing column of measurements", lambda w: w.put("measurements", {k: v for k, v in w.columns("measurements").items() if k != "line"})
)
changed("missing column of images", lambda w: w.put("images", {k: v for k, v in w.columns("images").items() if k != "camera"}))
changed("column of another type", lambda w: w.put("measurements", w.columns("measurements") | {"sample": ["here"] * 300}))
changed("empty id", lambda w: w.set("measurements", "point_id", "", row=4))
changed("unknown image in a measurement", lambda w: w.set("measurements", "image_id", "T9", row=4))
changed("image of another block in a measurement", lambda w: w.set("measurements", "image_id", w.columns("images")["image_id"][-1], row=4))
changed("unknown block in a measurement", lambda w: w.set("measurements", "block_id", "T9", row=299))
changed(
    "measurements not sorted by block", lambda w: w.put("measurements", {k: [*v[1:], v[0]] for k, v in w.columns("measurements").items()})
)
changed("no measurements in the file", lambda w: w.rows("measurements", lambda row: False))
changed(
    "truncated Parquet",
    lambda w: (w.catalogue / "measurements.parquet").write_bytes((w.catalogue / "measurements.parquet").read_bytes()[:2000]),
)
changed("Parquet of no bytes", lambda w: (w.catalogue / "measurements.parquet").write_bytes(b""))


@case("CSV of no bytes")
def _(w: World) -> list[Any]:
    w.csv("measurements").write_bytes(b"")
    return w.run()


@case("CSV with a ragged row")
def _(w: World) -> list[Any]:
    path = w.csv("measurements")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:7], lines[7] + ",9", *lines[8:]]))
    return w.run()


@case("CSV with text where a number belongs")
def _(w: World) -> list[Any]:
    path = w.csv("measurements")
    lines = path.read_text().splitlines()
    words = lines[7].split(",")
    path.write_text("\n".join([*lines[:7], ",".join([*words[:3], "left", *words[4:]]), *lines[8:]]))
    return w.run()


@case("CSV that is not UTF-8")
def _(w: World) -> list[Any]:
    path = w.csv("measurements")
    path.write_bytes(path.read_bytes().replace(b"P", b"\xfc", 1))
    return w.run()


changed("image there twice", lambda w: w.set("images", "image_id", w.columns("images")["image_id"][0], row=2))
changed("image without size", lambda w: w.set("images", "width", 0))
changed("time that is none", lambda w: w.set("images", "acquired", "noon"))
changed("geometry that is not WKB", lambda w: w.set("images", "geometry", b"polygon", row=1))
changed("unknown sensor", lambda w: w.set("images", "sensor", "sonar"))
changed("camera that is not JSON", lambda w: w.set("images", "camera", "<rpc/>"))
changed("RPC without a list of coefficients", lambda w: w.camera(lambda c: c.pop("SAMP_DEN_COEFF")))
changed("RPC with 19 coefficients", lambda w: w.camera(lambda c: c["LINE_NUM_COEFF"].pop()))
changed("RPC with a scale of zero", lambda w: w.camera(lambda c: c.update(LAT_SCALE=0.0)))
changed("RPC with a value that is not finite", lambda w: w.camera(lambda c: c.update(LINE_OFF=float("nan"))))
changed("RPC with a value that is not a number", lambda w: w.camera(lambda c: c.update(LINE_OFF="left")))


def framed(name: str, **changes: Any) -> None:
    """Enter a case in which an image is said to be of a frame camera, which lacks something."""

    def change(w: World) -> None:
        w.camera(lambda c: (c.clear(), c.update({**FRAME, **changes})))
        w.set("images", "sensor", "frame")

    changed(name, change)


FRAME = {
    "position": [7e6, 0.0, 0.0], "rotation": [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]], "focal_length": 3000.0,
    "mm_to_pixel": [[5000.0, 100.0, 0.0], [5000.0, 0.0, 100.0]], "height": 0.0,
}  # fmt: skip

framed("frame camera without a place", position=None)
framed("frame camera with a rotation that is none", rotation=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
framed("frame camera with a distortion that says not which way", distortion={"radial": [1e-9, 0.0, 0.0]})
framed("frame camera with a distortion that folds the image", distortion={"radial": [-1e-3, 0.0, 0.0], "direction": "measured to ideal"})
changed("RPC with swapped axes", lambda w: w.camera(lambda c: c.update(LAT_OFF=c["LONG_OFF"], LONG_OFF=c["LAT_OFF"])))

changed("priors that are not JSON", lambda w: (w.catalogue / "priors.json").write_text("bias 10"))
changed("priors that are not an object", lambda w: w.priors([]))
changed("unknown key in the priors", lambda w: w.priors({"defaults": {}}))
changed("unknown key in a block's prior", lambda w: w.priors({"default": {"bias_mm": 10}}))
changed("prior of an unknown block", lambda w: w.priors({"blocks": {"T9": {}}}))
changed("prior without a number", lambda w: w.priors({"default": {"bias_px": "large"}}))
changed("prior sigma that is not positive", lambda w: w.priors({"default": {"bias_px": 0}}))
changed(
    "prior covariance that is not positive definite", lambda w: w.priors({"default": {"correlation": "fixed", "correlation_parameter": 1}})
)
changed("prior part out of range", lambda w: w.priors({"default": {"common_to_pass": 1.5}}))
changed("unknown correlation of the priors", lambda w: w.priors({"default": {"correlation": "linear"}}))

MATRIX = {"cov_ee": [1.0], "cov_en": [2.0], "cov_eu": [0.0], "cov_nn": [1.0], "cov_nu": [0.0], "cov_uu": [1.0]}

changed("control without covariance", lambda w: w.put("control", POINT))
changed("control covariance that is not positive definite", lambda w: w.put("control", POINT | MATRIX | {"cov_en": [1.0]}))
changed("check covariance that is not positive definite", lambda w: w.put("check", POINT | MATRIX))
changed("negative sigma of a point", lambda w: w.put("control", POINT | SIGMAS | {"sigma_n": [-1.0]}))
changed("point there twice", lambda w: w.put("check", {k: v * 2 for k, v in (POINT | SIGMAS).items()}))
changed("point with swapped axes", lambda w: w.put("check", POINT | SIGMAS | {"longitude": [35.0], "latitude": [100.0]}))
