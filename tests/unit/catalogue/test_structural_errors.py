"""Every structural error of a catalogue is named: file, row, value, what was expected."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from catalogues import as_csv, camera, put, put_one, rewrite

from submin.errors import CatalogueError
from submin.formats import columns as reading
from submin.storage.catalogue import Catalogue

MEASUREMENT_ERRORS = [
    (lambda t: t.drop_columns(["line"]), r"measurements.parquet: column 'line' is missing; expected block_id, image_id, point_id, sample"),
    (lambda t: put(t, "sample", ["x"] * t.num_rows), r"measurements.parquet: column 'sample' holds string; expected numbers"),
    (lambda t: put(t, "point_id", list(range(t.num_rows))), r"measurements.parquet: column 'point_id' holds int64; expected text"),
    (lambda t: put_one(t, "image_id", 6, "zz"), r"row 6: image_id is 'zz', which the images table does not have"),
    (lambda t: put_one(t, "image_id", 9, "a2"), r"row 9: image_id is 'a2', an image of block 'A'; expected an image of block 'B'"),
    (lambda t: put_one(t, "block_id", 10, "C"), r"row 10: block_id is 'C'; expected a block of the images table"),
    (lambda t: put_one(t, "point_id", 2, None), r"row 2: point_id is None; expected a text that is not empty"),
    (lambda t: put_one(t, "point_id", 2, ""), r"row 2: point_id is ''; expected a text that is not empty"),
    (lambda t: pa.concat_tables([t, t.slice(0, 1)]), r"row 11: block_id 'A' comes back after 'B'; expected rows sorted by block"),
]
IMAGE_ERRORS = [
    (lambda t: t.drop_columns(["camera"]), r"images.parquet: column 'camera' is missing; expected image_id, .*\(optional: acquired"),
    (lambda t: put_one(t, "image_id", 3, "a1"), r"images.parquet: row 3: image_id 'a1' is that of row 1 too"),
    (lambda t: put_one(t, "sensor", 2, "sonar"), r"images.parquet: row 2: image a2: sensor is 'sonar'; expected one of .*rpc"),
    (lambda t: put_one(t, "camera", 3, "{"), r"images.parquet: row 3: image b1: camera is not JSON"),
    (lambda t: put_one(t, "camera", 3, "[]"), r"row 3: image b1: camera is list; expected a JSON object"),
    (
        lambda t: put_one(t, "camera", 1, json.dumps(camera(SAMP_DEN_COEFF=[1.0]))),
        r"images.parquet: row 1: image a1: RPC: SAMP_DEN_COEFF has 1 coefficients; expected 20",
    ),
    (
        lambda t: put_one(t, "camera", 1, json.dumps(camera(origin=["left", 0]))),
        r"images.parquet: row 1: image a1: .*'?left'?",
    ),
    (lambda t: put_one(t, "width", 2, 0), r"row 2: image a2: size is 0 x 800"),
    (lambda t: put_one(t, "width", 2, None), r"row 2: width is None; expected a number of pixels"),
    (lambda t: put(t, "width", [1000.0, 10.5, 3.0]), r"row 2: width is 10.5; expected a whole number"),
    (lambda t: put_one(t, "acquired", 1, "noon"), r"row 1: time is 'noon'"),
    (lambda t: put_one(t, "pass_id", 1, ""), r"row 1: pass_id is ''"),
    (lambda t: t.slice(0, 0), r"images.parquet: holds no images"),
]


class TestStructuralErrors:
    def test_no_measurements_at_all(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: t.slice(0, 0))
        with pytest.raises(CatalogueError, match=r"measurements.parquet: holds no measurements; expected at least one row"):
            Catalogue.open(folder).validate()

    @pytest.mark.parametrize("monkeyed", [False, True])
    @pytest.mark.parametrize(("change", "message"), MEASUREMENT_ERRORS)
    def test_measurements(self, folder: Path, change: Any, message: str, monkeyed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        if monkeyed:  # the number of a row is that in the file, wherever batches begin
            monkeypatch.setattr(reading, "BATCH_ROWS", 3)
        rewrite(folder, "measurements", change)
        with pytest.raises(CatalogueError, match=message):
            Catalogue.open(folder).validate()
        with pytest.raises(CatalogueError, match=message):
            list(Catalogue.open(folder).blocks())

    @pytest.mark.parametrize(("change", "message"), IMAGE_ERRORS)
    def test_images(self, folder: Path, change: Any, message: str) -> None:
        rewrite(folder, "images", change)
        with pytest.raises(CatalogueError, match=message):
            Catalogue.open(folder).validate()

    def test_a_number_in_csv_that_is_none_names_its_row(self, folder: Path) -> None:
        as_csv(folder, False)
        lines = (folder / "measurements.csv").read_text().splitlines()
        lines[7] = lines[7].replace("30.25", "3o.25")
        (folder / "measurements.csv").write_text("\n".join(lines))
        with pytest.raises(CatalogueError, match=r"measurements.csv: row 7: sample is '3o.25'; expected a number"):
            Catalogue.open(folder).validate()

    @pytest.mark.parametrize("line", ["A,a1,p", "A,a1,p,1,2,0.5,0.5,9"])
    def test_a_broken_line_of_csv_is_an_error(self, folder: Path, line: str) -> None:
        as_csv(folder, False)
        with (folder / "measurements.csv").open("a") as file:
            file.write(line + "\n")
        with pytest.raises(CatalogueError, match=r"measurements.csv: row 11: Expected 7 columns, got"):
            Catalogue.open(folder).validate()

    def test_what_is_no_parquet(self, folder: Path) -> None:
        (folder / "measurements.parquet").write_bytes(b"PAR1 or not")
        with pytest.raises(CatalogueError, match=r"measurements.parquet: cannot be read as a table"):
            Catalogue.open(folder).validate()

    def test_missing_files(self, folder: Path, tmp_path: Path) -> None:
        with pytest.raises(CatalogueError, match="no such folder; expected a catalogue"):
            Catalogue.open(tmp_path / "nowhere")
        (folder / "measurements.parquet").unlink()
        with pytest.raises(CatalogueError, match="no table 'measurements'; expected one of measurements.parquet, measurements.csv"):
            Catalogue.open(folder)

    def test_two_files_of_one_table(self, folder: Path) -> None:
        (folder / "images.csv").write_text("image_id\n")
        with pytest.raises(CatalogueError, match="images.parquet and images.csv hold the same table"):
            Catalogue.open(folder)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"height_kind": "orthometric"}, "height_kind is 'orthometric'; expected 'ellipsoidal'"),
            ({"format_version": 2}, "format_version is 2; expected 1"),
            ({"body": "moon"}, "key 'semimajor_axis' is missing"),
            ({"body": "moon", "semimajor_axis": -1.0, "flattening": 0.0}, "semimajor_axis is -1.0"),
            ({"semimajor_axis": "big"}, "semimajor_axis, flattening are 'big', .*; expected two numbers"),
            ({"hieght_kind": "ellipsoidal"}, "unknown key 'hieght_kind'; expected some of name, format_version"),
            ({"name": ""}, "name is ''"),
        ],
    )
    def test_metadata(self, folder: Path, changes: dict[str, Any], message: str) -> None:
        (folder / "catalogue.json").write_text(json.dumps({"name": "n", "format_version": 1} | changes))
        with pytest.raises(CatalogueError, match=f"catalogue.json: {message}"):
            Catalogue.open(folder)

    def test_metadata_of_another_body(self, folder: Path) -> None:
        values = {"name": "n", "format_version": 1, "body": "moon", "semimajor_axis": 1737400.0, "flattening": 0.0, "frame": "ME"}
        (folder / "catalogue.json").write_text(json.dumps(values))
        assert Catalogue.open(folder).metadata.ellipsoid.semiminor_axis == 1737400.0

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ('{"blocks": {"Z": {}}}', "block 'Z' has no image"),
            ('{"default": {"bias": 3}}', "unknown key 'bias'"),
            ('{"defaults": {}}', "unknown key 'defaults'"),
            ('{"default": 3}', "must be JSON objects"),
            ("[", "is not JSON"),
            ("[]", "holds list; expected a JSON object"),
        ],
    )
    def test_priors(self, folder: Path, text: str, message: str) -> None:
        (folder / "priors.json").write_text(text)
        with pytest.raises(CatalogueError, match=f"priors.json: .*{message}"):
            Catalogue.open(folder)
