"""A catalogue: what is written is read, whatever the format; every structural error is named; blocks tell what is wrong inside them."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pcsv
import pyarrow.parquet as pq
import pytest
import shapely

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError, InputError
from submin.formats import columns as reading
from submin.geodesy import local_axes, rotate_covariance
from submin.storage.catalogue import Block, Catalogue, CatalogueMetadata, ImageRecord, PointTable, defects
from submin.storage.catalogue_schema import parse_utc
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.point_table import read_point_table

FOOTPRINT = shapely.to_wkb(shapely.box(10.0, 50.0, 10.1, 50.1))


def camera(**changes: Any) -> dict[str, Any]:
    zeros = [0.0] * 20
    return {
        "LINE_OFF": 500.0, "SAMP_OFF": 500.0, "LAT_OFF": 50.0, "LONG_OFF": 10.0, "HEIGHT_OFF": 100.0,
        "LINE_SCALE": 500.0, "SAMP_SCALE": 500.0, "LAT_SCALE": 0.01, "LONG_SCALE": 0.01, "HEIGHT_SCALE": 500.0,
        "LINE_NUM_COEFF": [0.0, 0.0, -1.0, 0.1, *zeros[4:]], "LINE_DEN_COEFF": [1.0, *zeros[1:]],
        "SAMP_NUM_COEFF": [0.0, 1.0, 0.0, 0.1, *zeros[4:]], "SAMP_DEN_COEFF": [1.0, *zeros[1:]],
    } | changes  # fmt: skip


def image(image_id: str, block_id: str, **changes: Any) -> ImageRecord:
    record = ImageRecord(
        image_id, block_id, f"{block_id}-pass", "WV", "rpc", json.dumps(camera()), 1000, 800, "2020-01-01T10:00:00Z", FOOTPRINT, "free"
    )
    return replace(record, **changes)


IMAGES = (image("a1", "A"), image("a2", "A", acquired="2020-01-01T10:00:10.5Z"), image("b1", "B", acquired="", footprint=b"", licence=""))


def block(block_id: str, points: int = 4, a_priori: APriori | None = None) -> Block:
    """Every image of a block sees every point, somewhere else."""
    members = tuple(i for i in IMAGES if i.block_id == block_id)
    m = len(members)
    index = np.tile(np.arange(m, dtype=np.int32), points)
    point = np.repeat(np.arange(points), m)
    sample = np.asarray(10.0 * point + index + 0.25, dtype=np.float64)
    line = np.asarray(2.0 * sample, dtype=np.float64)
    return Block(
        block_id, members, a_priori or APriori(), np.array([f"D/p{k}" for k in point]), index,
        sample, line, np.full(m * points, 0.5), np.full(m * points, 0.4),
    )  # fmt: skip


def points(n: int = 3) -> PointTable:
    covariance = np.array([[4.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 9.0]]) * (1.0 + np.arange(n))[:, None, None]
    geodetic = np.stack([10.0 + 0.01 * np.arange(n), np.full(n, 50.0), np.full(n, 100.0)], axis=1)
    return PointTable(np.array([f"c{k}" for k in range(n)]), geodetic, covariance, np.array(["west"] * n))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with CatalogueWriter(tmp_path / "catalogue", CatalogueMetadata("test", epoch="2020.0")) as writer:
        writer.write_images(IMAGES)
        writer.write_block(block("A"))
        writer.write_block(block("B", 2))
        writer.write_priors(APriori(bias_px=5.0), {"B": APriori(drift_px=0.1)})
        writer.write_points("control", points())
        writer.write_points("truth", points(7))
    return tmp_path / "catalogue"


def same_rays(a: Block, b: Block) -> bool:
    arrays = ("point_ids", "image", "sample", "line", "sigma_sample", "sigma_line")
    return all(np.array_equal(getattr(a, n), getattr(b, n)) and getattr(a, n).dtype.kind == getattr(b, n).dtype.kind for n in arrays)


def rewrite(folder: Path, stem: str, change: Any) -> None:
    """Replace a table by what ``change`` makes of it."""
    path = folder / f"{stem}.parquet"
    pq.write_table(change(pq.read_table(path)), path)


def put(table: pa.Table, name: str, values: list[Any] | pa.Array) -> pa.Table:
    array = values if isinstance(values, pa.Array) else pa.array(values)
    if name not in table.schema.names:
        return table.append_column(name, array)
    return table.set_column(table.schema.get_field_index(name), name, array)


def put_one(table: pa.Table, name: str, row: int, value: Any) -> pa.Table:
    """A value in a row, counted from 1."""
    values = table[name].to_pylist()
    return put(table, name, [*values[: row - 1], value, *values[row:]])


def as_csv(folder: Path, compressed: bool) -> None:
    for path in list(folder.glob("*.parquet")):
        table = pq.read_table(path)
        if "geometry" in table.schema.names:
            table = put(table, "geometry", [None if g is None else g.hex() for g in table["geometry"].to_pylist()])
        name = path.with_suffix(".csv.gz" if compressed else ".csv")
        path.unlink()
        with gzip.open(name, "wb") if compressed else name.open("wb") as file:
            pcsv.write_csv(table, file)


class TestRoundTrip:
    def test_all_that_is_written_is_read(self, folder: Path) -> None:
        catalogue = Catalogue.open(folder)
        assert catalogue.metadata == CatalogueMetadata("test", epoch="2020.0")
        assert tuple(catalogue.images) == IMAGES
        assert catalogue.block_ids == ("A", "B")
        assert catalogue.block_count == 2
        assert catalogue.a_priori("A") == APriori(bias_px=5.0)
        assert catalogue.a_priori("B") == APriori(drift_px=0.1)
        read = list(catalogue.blocks())
        assert [b.block_id for b in read] == ["A", "B"]
        assert same_rays(read[0], block("A")) and same_rays(read[1], block("B", 2))
        assert read[0].images == IMAGES[:2]
        assert read[0].a_priori == APriori(bias_px=5.0)
        summary = catalogue.validate()
        assert (summary.blocks, summary.images, summary.rays) == (2, 3, 10)

    @pytest.mark.parametrize("compressed", [False, True])
    def test_csv_holds_the_same(self, folder: Path, compressed: bool) -> None:
        parquet = Catalogue.open(folder)
        expected, control = list(parquet.blocks()), parquet.points("control")
        as_csv(folder, compressed)
        catalogue = Catalogue.open(folder)
        assert tuple(catalogue.images) == IMAGES
        assert all(same_rays(a, b) for a, b in zip(catalogue.blocks(), expected, strict=True))
        assert [b.content_hash() for b in catalogue.blocks()] == [b.content_hash() for b in expected]
        found = catalogue.points("control")
        assert control is not None and found is not None
        np.testing.assert_array_equal(found.covariance_enu, control.covariance_enu)
        assert catalogue.validate().rays == 10

    def test_ids_that_look_like_numbers_stay_texts(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: put(t, "point_id", [f"00{k}" for k in range(t.num_rows)]))
        as_csv(folder, False)
        assert next(Catalogue.open(folder).blocks()).point_ids[:2].tolist() == ["000", "001"]

    def test_batches_do_not_show(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        expected = list(Catalogue.open(folder).blocks())
        monkeypatch.setattr(reading, "BATCH_ROWS", 3)
        assert all(same_rays(a, b) for a, b in zip(Catalogue.open(folder).blocks(), expected, strict=True))

    def test_blocks_can_be_skipped_or_taken_one_at_a_time(self, folder: Path) -> None:
        catalogue = Catalogue.open(folder)
        assert [b.block_id for b in catalogue.blocks(skip={"A"})] == ["B"]
        assert same_rays(catalogue.block("B"), block("B", 2))
        with pytest.raises(CatalogueError, match="no block 'C'; expected one of A, B$"):
            catalogue.block("C")

    def test_a_block_without_measurements_comes_last_and_is_defect(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: t.slice(8))
        read = list(Catalogue.open(folder).blocks())
        assert [b.block_id for b in read] == ["B", "A"]
        assert str(defects(read[1])).startswith("the block has no measurements")
        assert len(Catalogue.open(folder).block("A")) == 0

    def test_sigmas_default_to_half_a_pixel(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: put_one(t, "sigma_sample", 1, None).drop_columns(["sigma_line"]))
        read = next(Catalogue.open(folder).blocks())
        assert (read.sigma_line == 0.5).all()
        assert read.sigma_sample[0] == 0.5

    def test_footprints_are_geoparquet(self, folder: Path) -> None:
        schema = pq.read_schema(folder / "images.parquet")
        geo = json.loads(schema.metadata[b"geo"])
        assert geo["columns"][geo["primary_column"]]["encoding"] == "WKB"
        assert pq.read_table(folder / "images.parquet")["geometry"].to_pylist() == [FOOTPRINT, FOOTPRINT, None]

    def test_footprint_as_well_known_text(self, folder: Path) -> None:
        as_csv(folder, False)
        text = (folder / "images.csv").read_text().replace(FOOTPRINT.hex(), shapely.box(10.0, 50.0, 10.1, 50.1).wkt)
        (folder / "images.csv").write_text(text)
        assert shapely.from_wkb(Catalogue.open(folder).images[0].footprint).equals(shapely.from_wkb(FOOTPRINT))

    def test_times_of_images(self) -> None:
        assert IMAGES[1].seconds - IMAGES[0].seconds == 10.5
        assert np.isnan(IMAGES[2].seconds)

    @pytest.mark.parametrize("text", ["2014-10-05", "20141005", "yesterday", "20141305160138"])
    def test_a_text_that_is_no_time_is_refused(self, text: str) -> None:
        with pytest.raises(InputError, match="expected 20141005160138 or ISO 8601"):
            parse_utc(text)

    def test_priors_of_a_block_start_from_the_default(self, folder: Path) -> None:
        (folder / "priors.json").write_text('{"default": {"bias_px": 3}, "blocks": {"A": {"drift_px": 2}}}')
        assert Catalogue.open(folder).a_priori("A") == APriori(bias_px=3.0, drift_px=2.0)
        (folder / "priors.json").unlink()
        assert Catalogue.open(folder).a_priori("A") == APriori()

    def test_entries_by_parameter_of_a_block_stand_beside_those_of_the_default(self, folder: Path) -> None:
        entries = {"default": {"parameters": {"rate": {"sigma": 1}}}, "blocks": {"A": {"parameters": {"position": {"sigma": 2}}}}}
        (folder / "priors.json").write_text(json.dumps(entries))
        assert Catalogue.open(folder).a_priori("A").parameters == {"rate": {"sigma": 1}, "position": {"sigma": 2}}


class TestContentHash:
    def test_order_and_layout_leave_no_trace(self) -> None:
        first = block("A")
        order = np.random.default_rng(1).permutation(len(first))
        images = tuple(replace(i, camera=json.dumps(json.loads(i.camera), indent=2, sort_keys=True)) for i in first.images[::-1])
        second = Block(
            "A", images, first.a_priori, first.point_ids[order], (1 - first.image[order]).astype(np.int32),
            first.sample[order], first.line[order], first.sigma_sample[order], first.sigma_line[order],
        )  # fmt: skip
        assert first.content_hash() == second.content_hash()
        assert len(first.content_hash()) == 64

    def test_footprint_and_licence_do_not_count(self) -> None:
        first = block("A")
        images = tuple(replace(i, footprint=b"", licence="other") for i in first.images)
        assert replace(first, images=images).content_hash() == first.content_hash()

    @pytest.mark.parametrize(
        "change",
        [
            lambda b: replace(b, sample=b.sample + np.eye(1, len(b), 3)[0] * 1e-9),
            lambda b: replace(b, sigma_line=b.sigma_line * 2.0),
            lambda b: replace(b, image=b.image[::-1].copy()),
            lambda b: replace(b, point_ids=np.char.add(b.point_ids, "x")),
            lambda b: replace(b, a_priori=APriori(bias_px=9.0)),
            lambda b: replace(b, images=(replace(b.images[0], image_id="a0"), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], pass_id="other"), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], width=999), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], acquired=""), b.images[1])),
            lambda b: replace(b, images=(replace(b.images[0], camera=json.dumps(camera(LINE_OFF=500.1))), b.images[1])),
        ],
    )
    def test_what_an_adjustment_depends_on_counts(self, change: Any) -> None:
        assert change(block("A")).content_hash() != block("A").content_hash()


def with_value(name: str, row: int, value: Any) -> Block:
    b = block("A")
    values = getattr(b, name).copy()
    values[row] = value
    return replace(b, **{name: values})


class TestDefects:
    def test_a_good_block_has_none(self) -> None:
        assert defects(block("A")) is None

    @pytest.mark.parametrize(
        ("bad", "reason"),
        [
            (with_value("sample", 3, np.nan), "point D/p1 in image a2: sample is nan; expected a finite number of pixels"),
            (with_value("line", 2, np.inf), "point D/p1 in image a1: line is inf; expected a finite number of pixels"),
            (with_value("sigma_sample", 0, 0.0), "point D/p0 in image a1: sigma_sample is 0.0; expected a positive number of pixels"),
            (with_value("sigma_line", 7, -0.5), "point D/p3 in image a2: sigma_line is -0.5; expected a positive number of pixels"),
            (with_value("sigma_line", 7, np.nan), "point D/p3 in image a2: sigma_line is nan; expected a finite number of pixels"),
            (
                with_value("point_ids", 5, "D/p0"),
                "point D/p0 in image a2 is measured twice, the second time at sample 21.25, line 42.5; expected one ray",
            ),
            (
                replace(block("A"), images=(*IMAGES[:2], image("a3", "A"))),
                "image a3 has no measurements; expected some in every image of the block",
            ),
            (block("A", 0), "the block has no measurements; measure it, or remove its images"),
            (block("B", 2), "the block has 2 rays; expected at least 3: measure more, or join it to another block"),
            (
                block("B", a_priori=APriori(correlation="gaussian", correlation_parameter=60.0)),
                "image b1 has no time; the gaussian correlation of the priors needs column 'acquired'",
            ),
        ],
    )
    def test_each_is_named(self, bad: Block, reason: str) -> None:
        assert defects(bad) == reason

    def test_nan_survives_parquet_and_csv(self, folder: Path) -> None:
        rewrite(folder, "measurements", lambda t: put_one(t, "sample", 4, float("nan")))
        assert "sample is nan" in str(defects(next(Catalogue.open(folder).blocks())))
        as_csv(folder, False)
        catalogue = Catalogue.open(folder)
        catalogue.validate()  # no structural error: it rejects its block only
        assert "point D/p1 in image a2: sample is nan" in str(defects(next(catalogue.blocks())))


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


class TestPoints:
    def test_control_and_truth(self, folder: Path) -> None:
        catalogue = Catalogue.open(folder)
        control, truth = catalogue.points("control"), catalogue.points("truth")
        assert control is not None and truth is not None and catalogue.points("check") is None
        np.testing.assert_array_equal(control.covariance_enu, points().covariance_enu)
        np.testing.assert_array_equal(control.geodetic, points().geodetic)
        assert control.area.tolist() == ["west"] * 3
        assert len(truth) == 7 and not truth.covariance_enu.any() and truth.area.tolist() == [""] * 7

    def test_sigmas_stand_for_covariances(self, tmp_path: Path) -> None:
        path = tmp_path / "check.csv"
        path.write_text("point_id,longitude,latitude,height,sigma_e,sigma_n,sigma_u\n7,10,50,100,1,2,3\n")
        table = read_point_table(path)
        assert table.point_ids.tolist() == ["7"]
        np.testing.assert_array_equal(table.covariance_enu[0], np.diag([1.0, 4.0, 9.0]))

    def test_joint_covariance_of_correlated_points(self, tmp_path: Path) -> None:
        factor = np.random.default_rng(2).normal(size=(9, 12))
        joint = factor @ factor.T
        table = points()
        own = np.stack([joint[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(3)])
        table = replace(table, covariance_enu=rotate_covariance(own, local_axes(table.geodetic)), joint_covariance=joint)
        with CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer:
            writer.write_points("control", table)
        path = tmp_path / "c" / "control.parquet"
        read = read_point_table(path, "definite")
        assert read.joint_covariance is not None
        np.testing.assert_array_equal(read.joint_covariance, joint)
        pq.write_table(pq.read_table(path).drop_columns(["cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu"]), path)
        np.testing.assert_allclose(read_point_table(path).covariance_enu, table.covariance_enu, rtol=1e-12)

    @pytest.mark.parametrize(
        ("kind", "change", "message"),
        [
            ("any", lambda t: put_one(t, "point_id", 3, "c0"), "row 3: point_id 'c0' is that of row 1 too"),
            ("any", lambda t: put_one(t, "latitude", 2, 91.0), "row 2: latitude is 91.0; expected degrees from -90 to 90"),
            ("any", lambda t: put_one(t, "height", 2, None), "row 2: height is None; expected metres"),
            ("any", lambda t: put_one(t, "cov_nn", 2, -1.0), "row 2: covariance is .* expected a matrix without negative eigenvalues"),
            ("any", lambda t: put_one(t, "cov_uu", 2, float("nan")), "row 2: cov_uu is nan; expected a finite number"),
            ("any", lambda t: t.drop_columns(["cov_en"]), "column 'cov_en' is missing"),
            ("any", lambda t: t.select(["point_id", "longitude", "latitude", "height"]), "columns of the covariance are missing"),
            ("any", lambda t: t.drop_columns(["height"]), "column 'height' is missing"),
            (
                "definite",
                lambda t: put(put(put(t, "cov_uu", [0.0] * 3), "cov_eu", [0.0] * 3), "cov_nu", [0.0] * 3),
                "row 1: covariance is .* expected a positive definite matrix",
            ),
            ("any", lambda t: put(t, "covariance_row", [[1.0]] * 3), "covariance_row"),
        ],
    )
    def test_errors(self, folder: Path, kind: Any, change: Any, message: str) -> None:
        rewrite(folder, "control", change)
        with pytest.raises(CatalogueError, match=rf"control.parquet: .*{message}"):
            read_point_table(folder / "control.parquet", kind)

    def test_validate_reads_the_points(self, folder: Path) -> None:
        rewrite(folder, "control", lambda t: put_one(t, "latitude", 2, 91.0))
        with pytest.raises(CatalogueError, match="control.parquet: row 2"):
            Catalogue.open(folder).validate()


class TestWriter:
    def test_a_failure_leaves_nothing(self, tmp_path: Path) -> None:
        with pytest.raises(RuntimeError, match="on purpose"), CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer:
            writer.write_images(IMAGES)
            raise RuntimeError("on purpose")
        assert list(tmp_path.iterdir()) == []

    def test_what_is_there_is_not_written_over(self, folder: Path) -> None:
        with pytest.raises(CatalogueError, match="is not empty"):
            CatalogueWriter(folder, CatalogueMetadata("n"))

    def test_overwrite_replaces_a_catalogue_or_leaves_it(self, folder: Path) -> None:
        with pytest.raises(RuntimeError), CatalogueWriter(folder, CatalogueMetadata("n"), overwrite=True):
            raise RuntimeError
        assert Catalogue.open(folder).validate().rays == 10
        with CatalogueWriter(folder, CatalogueMetadata("n"), overwrite=True) as writer:
            writer.write_images([IMAGES[2]])
            writer.write_block(block("B"))
        assert Catalogue.open(folder).block_ids == ("B",)
        assert not (folder / "control.parquet").exists()
        assert [p.name for p in folder.parent.iterdir()] == ["catalogue"]

    def test_only_a_catalogue_is_overwritten(self, tmp_path: Path) -> None:
        (tmp_path / "letters.txt").write_text("dear")
        with pytest.raises(CatalogueError, match="holds other things than a catalogue"):
            CatalogueWriter(tmp_path, CatalogueMetadata("n"), overwrite=True)

    def test_an_empty_folder_is_used(self, tmp_path: Path) -> None:
        (tmp_path / "c").mkdir()
        with CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer:
            writer.write_images(IMAGES)
        assert len(Catalogue.open(tmp_path / "c").images) == 3

    def test_a_block_is_written_once(self, tmp_path: Path) -> None:
        with (
            pytest.raises(CatalogueError, match="block 'A' is written twice"),
            CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")) as writer,
        ):
            writer.write_block(block("A"))
            writer.write_block(block("A"))

    def test_writing_needs_an_open_writer(self, tmp_path: Path) -> None:
        with pytest.raises(CatalogueError, match="not open"):
            CatalogueWriter(tmp_path / "c", CatalogueMetadata("n")).write_block(block("A"))


def test_the_documented_priors_are_read_as_they_stand(folder: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "catalogue.md").read_text(encoding="utf-8")
    values = json.loads(text.split("```json")[1].split("```")[0])
    values["blocks"] = {"A": values["blocks"]["block 1"]}
    (folder / "priors.json").write_text(json.dumps(values))
    catalogue = Catalogue.open(folder)
    assert catalogue.default_prior == APriori()
    assert catalogue.a_priori("A").parameters["attitude kappa"] == {"sigma": 1e-4, "common_to_pass": 0.5}
