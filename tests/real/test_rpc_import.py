"""Import of RPC images with tie points: real WorldView-3 and Pleiades data, and the errors that their tables may hold."""

from __future__ import annotations

import gzip
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from submin.adjustment.priors import APriori
from submin.errors import CatalogueError, InputError
from submin.geodesy import WGS84
from submin.sensors import sensor_named
from submin.storage.catalogue import Block, Catalogue, defects
from submin.storage.imports import ImportSummary
from submin.storage.rpc_import import import_rpc

FOLDERS = {"wv3_jax068": "rpc_raw", "pleiades_provence_triplet": "rpc", "pleiades_ventoux_pair": "rpc"}


def run(source: Path, out: Path, **options: Any) -> ImportSummary:
    return import_rpc(source / "images.csv", source / FOLDERS.get(source.name, "rpc"), source / "tracks.csv.gz", out, **options)


@pytest.fixture
def ventoux(data: Path, tmp_path: Path) -> Path:
    """The tables of the pair, to be spoiled; tracks as plain CSV rows."""
    source = tmp_path / "ventoux"
    shutil.copytree(data / "pleiades_ventoux_pair" / "rpc", source / "rpc", copy_function=shutil.copyfile)
    shutil.copyfile(data / "pleiades_ventoux_pair" / "images.csv", source / "images.csv")
    (source / "tracks.csv").write_bytes(gzip.decompress((data / "pleiades_ventoux_pair" / "tracks.csv.gz").read_bytes()))
    return source


def run_plain(source: Path, out: Path, **options: Any) -> ImportSummary:
    return import_rpc(source / "images.csv", source / "rpc", source / "tracks.csv", out, **options)


@pytest.mark.parametrize(
    ("name", "blocks", "expected"),
    [
        ("wv3_jax068", "pass", (17, 17, 19, 5002, 15433)),
        ("wv3_jax068", "image", (19, 17, 19, 5002, 15433)),
        ("wv3_jax068", "all", (1, 17, 19, 5002, 15433)),
        ("pleiades_provence_triplet", "pass", (1, 1, 3, 3911, 9713)),
        ("pleiades_ventoux_pair", "pass", (1, 1, 2, 322, 644)),
        ("pleiades_ventoux_pair", "image", (2, 1, 2, 322, 644)),
    ],
)
def test_counts(data: Path, tmp_path: Path, name: str, blocks: Any, expected: tuple[int, ...]) -> None:
    summary = run(data / name, tmp_path / "c", blocks=blocks)
    assert (summary.blocks, summary.passes, summary.images, summary.points, summary.rays) == expected
    assert (summary.dataset, summary.catalogue) == (name, tmp_path / "c")
    catalogue = Catalogue.open(tmp_path / "c")
    found = catalogue.validate()
    assert (found.blocks, found.images, found.rays) == (expected[0], expected[2], expected[4])
    read = list(catalogue.blocks())
    assert [b.block_id for b in read] == list(catalogue.block_ids)
    assert [defects(b) for b in read] == [None] * expected[0]
    assert len(np.unique(np.concatenate([b.point_ids for b in read]))) == expected[3]
    assert all(point_id.startswith(f"{name}/") for b in read for point_id in b.point_ids)


def test_worldview_passes(data: Path, tmp_path: Path) -> None:
    run(data / "wv3_jax068", tmp_path / "c")
    blocks = {b.block_id: b for b in Catalogue.open(tmp_path / "c").blocks()}
    pair = blocks["wv3_jax068-20141005T160138"]
    assert [i.image_id for i in pair.images] == ["JAX_068_001_RGB", "JAX_068_002_RGB"]
    assert [i.acquired for i in pair.images] == ["2014-10-05T16:01:38Z", "2014-10-05T16:01:49Z"]
    assert {i.pass_id for i in pair.images} == {pair.block_id}
    assert sorted(len(b.images) for b in blocks.values()) == [1] * 15 + [2, 2]


def test_tracks_arrive_unchanged(data: Path, tmp_path: Path) -> None:
    """Every ray of the file, by track and image, against the catalogue's."""
    source = data / "wv3_jax068"
    run(source, tmp_path / "c")
    rows = np.genfromtxt(source / "tracks.csv.gz", delimiter=",", names=True, dtype=None, encoding="utf-8")
    expected = {(f"wv3_jax068/{r['track_id']}", str(r["image_id"])): (float(r["col"]), float(r["row"])) for r in rows}
    found = {
        (str(p), b.images[i].image_id): (float(s), float(ln))
        for b in Catalogue.open(tmp_path / "c").blocks()
        for p, i, s, ln in zip(b.point_ids, b.image, b.sample, b.line, strict=True)
    }
    assert found == expected


def rays_miss_m(block: Block, height: float) -> float:
    """Median distance in metres between the places of two rays of one point, unadjusted cameras, at one height above the ellipsoid."""
    sensor = sensor_named("rpc")
    cameras = np.stack([image.pack() for image in block.images])
    ground = sensor.localise(cameras, block.image, block.sample, block.line, np.full(len(block), height), WGS84)
    order = np.argsort(block.point_ids, kind="stable")
    ids, ground = block.point_ids[order], ground[order]
    metres = np.diff(ground[:, :2], axis=0)[ids[1:] == ids[:-1]] * 111e3
    return float(np.median(np.hypot(metres[:, 0] * np.cos(np.radians(ground[0, 1])), metres[:, 1])))


@pytest.mark.parametrize(
    ("name", "height", "limit"),
    [("wv3_jax068", -20.0, 3.0), ("pleiades_provence_triplet", 180.0, 15.0), ("pleiades_ventoux_pair", 535.0, 10.0)],
)
def test_tracks_are_in_the_frame_of_the_cameras(data: Path, tmp_path: Path, name: str, height: float, limit: float) -> None:
    """At the height of the ground (PROVENANCE) rays of one point meet but for relief and raw biases; with sample and line exchanged, or
    each crop counted from its own corner, they do not."""
    run(data / name, tmp_path / "c", blocks="all")
    block = next(Catalogue.open(tmp_path / "c").blocks())
    assert rays_miss_m(block, height) < limit
    assert rays_miss_m(replace(block, sample=block.line, line=block.sample), height) > limit
    origin = np.array([json.loads(image.camera)["origin"] for image in block.images])[block.image]
    if origin.any():
        assert rays_miss_m(replace(block, sample=block.sample - origin[:, 0], line=block.line - origin[:, 1]), height) > limit


@pytest.mark.parametrize("name", list(FOLDERS))
def test_footprints_cover_the_tie_points(data: Path, tmp_path: Path, name: str) -> None:
    run(data / name, tmp_path / "c", blocks="all")
    block = next(Catalogue.open(tmp_path / "c").blocks())
    sensor = sensor_named("rpc")
    cameras = np.stack([image.pack() for image in block.images])
    ground = sensor.localise(cameras, block.image, block.sample, block.line, sensor.mean_height(cameras)[block.image], WGS84)
    footprints = shapely.from_wkb([image.footprint for image in block.images])
    inside = shapely.contains_xy(footprints[block.image], ground[:, 0], ground[:, 1])
    assert inside.all()
    # and are no larger than the images: a pixel is 0.3 to 0.8 m on the ground
    side = np.sqrt([image.width * image.height for image in block.images])
    metres = np.sqrt(shapely.area(footprints) * np.cos(np.radians(ground[0, 1]))) * 111e3
    assert (metres > 0.25 * side).all() and (metres < 0.8 * side).all()


def test_worldview_footprints_agree_with_the_published_ones(data: Path, tmp_path: Path) -> None:
    """The data set's own outlines were made on the ground, ours at the mean height of the RPC (some 20 m off): tens of metres."""
    source = data / "wv3_jax068"
    run(source, tmp_path / "c")
    for image in Catalogue.open(tmp_path / "c").images:
        published = json.loads((source / "rpc_raw" / f"{image.image_id}.json").read_text())["geojson"]["center"]
        centre = shapely.from_wkb(image.footprint).centroid
        assert np.hypot(centre.x - published[0], centre.y - published[1]) * 111e3 < 60.0


def test_origin_of_a_crop(data: Path, tmp_path: Path) -> None:
    summary = run(data / "pleiades_ventoux_pair", tmp_path / "c")
    origins = {i.image_id: json.loads(i.camera)["origin"] for i in Catalogue.open(tmp_path / "c").images}
    assert origins == {"left_image": [5000.0, 5000.0], "right_image": [4915.0, 5162.0]}
    assert not any("outside" in note for note in summary.notes)


def test_without_times_one_pass_and_it_says_so(data: Path, tmp_path: Path) -> None:
    summary = run(data / "pleiades_provence_triplet", tmp_path / "c", dataset="provence")
    assert summary.notes == ("neither pass_id nor acquisition_utc is known of 3 images of 3: they are taken as one pass, provence-pass",)
    assert Catalogue.open(tmp_path / "c").block_ids == ("provence-pass",)


def test_options_reach_the_catalogue(data: Path, tmp_path: Path) -> None:
    run(data / "pleiades_ventoux_pair", tmp_path / "c", dataset="v", shared_ids=True, a_priori=APriori(bias_px=7.0))
    catalogue = Catalogue.open(tmp_path / "c")
    assert (catalogue.metadata.name, catalogue.metadata.frame) == ("v", "WGS84")
    block = next(catalogue.blocks())
    assert block.a_priori == APriori(bias_px=7.0)
    assert block.point_ids[:3].tolist() == ["0", "0", "1"]


def test_accuracy_stated_by_the_files_becomes_the_prior(ventoux: Path, tmp_path: Path) -> None:
    """Written into the files here: the vendor's own are silent. Pleiades images come with pixels of half a metre."""
    for name, bias, random in (("left_image", 14.0, 0.3), ("right_image", 7.0, -1.0)):
        path = ventoux / "rpc" / f"{name}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"ERR_BIAS": bias, "ERR_RAND": random}))
    summary = run_plain(ventoux, tmp_path / "c")
    model = next(Catalogue.open(tmp_path / "c").blocks()).a_priori
    assert model is not None and "a priori sigmas of 1 of 1 blocks are those that their RPC files state" in summary.notes
    # left: hypot(14.0, 0.3) m. The drift of the right image is not stated: the default stays
    assert 14.0 / 0.52 < model.bias_px < 14.01 / 0.49
    assert (model.drift_px, model.common_to_pass) == (1.0, 0.5)


def test_accuracy_that_one_image_does_not_state_leaves_the_default(ventoux: Path, tmp_path: Path) -> None:
    path = ventoux / "rpc" / "left_image.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"ERR_BIAS": 14.0, "ERR_RAND": 0.3}))
    summary = run_plain(ventoux, tmp_path / "c")
    assert next(Catalogue.open(tmp_path / "c").blocks()).a_priori == APriori()
    assert not any("a priori" in note for note in summary.notes)


def test_the_same_import_twice_is_the_same_content(data: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        run(data / "wv3_jax068", tmp_path / name)
    hashes = [[b.content_hash() for b in Catalogue.open(tmp_path / name).blocks()] for name in ("a", "b")]
    assert hashes[0] == hashes[1]
    with pytest.raises(CatalogueError, match="is not empty"):
        run(data / "wv3_jax068", tmp_path / "a")
    run(data / "wv3_jax068", tmp_path / "a", overwrite=True, blocks="image")
    assert Catalogue.open(tmp_path / "a").block_count == 19


HEADER = "image_id,width,height,col0,row0,rpc,platform,acquisition_utc,pass_id\n"


def images(left: str = "PHR1A,,", right: str = "PHR1A,,", extra: str = "") -> str:
    return HEADER + f"left_image,500,500,5000,5000,left_image.json,{left}\nright_image,498,495,4915,5162,,{right}\n" + extra


@pytest.mark.parametrize(
    ("left", "right", "passes"),
    [
        ("P,20200101100000,", "P,2020-01-01T10:03:00Z,", ["P-20200101T100000"] * 2),
        ("P,20200101100000,", "P,2020-01-01T10:03:01Z,", ["P-20200101T100000", "P-20200101T100301"]),
        ("P,20200101100000,", "Q,20200101100000,", ["P-20200101T100000", "Q-20200101T100000"]),
        ("P,2020-01-01T12:00:00+02:00,", ",20200101100000,", ["P-20200101T100000", "ventoux-20200101T100000"]),
        ("P,20200101100000,rev7", "P,20200909100000,rev7", ["rev7", "rev7"]),
        ("P,20200101100000,", "P,,", ["P-20200101T100000", "ventoux-pass"]),
        ("P,20200101100000,rev7", "P,20200101100010,", ["rev7", "P-20200101T100010"]),
    ],
)
def test_passes(ventoux: Path, tmp_path: Path, left: str, right: str, passes: list[str]) -> None:
    (ventoux / "images.csv").write_text(images(left, right))
    summary = run_plain(ventoux, tmp_path / "c")
    found = {i.image_id: (i.pass_id, i.block_id) for i in Catalogue.open(tmp_path / "c").images}
    assert found == {"left_image": (passes[0],) * 2, "right_image": (passes[1],) * 2}
    assert summary.passes == summary.blocks == len(set(passes))
    assert Catalogue.open(tmp_path / "c").validate().rays == 644


def test_images_without_tracks_are_left_out_and_noted(ventoux: Path, tmp_path: Path) -> None:
    (ventoux / "images.csv").write_text(images(extra="unseen,10,10,,,none.json,,,\n"))
    summary = run_plain(ventoux, tmp_path / "c")
    assert summary.images == 2
    assert "left out, because no track names them: unseen" in summary.notes


def test_size_from_the_tracks(ventoux: Path, tmp_path: Path) -> None:
    (ventoux / "images.csv").write_text("image_id,col0,row0\nleft_image,5000,5000\nright_image,4915,5162\n")
    summary = run_plain(ventoux, tmp_path / "c")
    assert "width or height is not known; the extent of the tracks stands for it: left_image, right_image" in summary.notes
    block = next(Catalogue.open(tmp_path / "c").blocks())
    for k, image in enumerate(block.images):
        origin = json.loads(image.camera)["origin"]
        last = (block.sample[block.image == k].max() - origin[0], block.line[block.image == k].max() - origin[1])
        assert (image.width, image.height) == (round(last[0]) + 1, round(last[1]) + 1)
        assert 400 < image.width <= 500


def test_tracks_outside_the_image_are_noted(ventoux: Path, tmp_path: Path) -> None:
    (ventoux / "images.csv").write_text("image_id,width,height\nleft_image,500,500\nright_image,498,495\n")
    summary = run_plain(ventoux, tmp_path / "c")
    assert "some tracks lie outside the image, so check col0, row0, width, height: left_image, right_image" in summary.notes


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("900,other,1,2", "row 645: image_id is 'other'; expected an image of .*images.csv"),
        ("900,left_image,1,x", "row 645: row is 'x'; expected a number"),
        ("900,left_image,,2", "row 645: col is None; expected a finite number of pixels"),
        ("900,left_image,inf,2", "row 645: col is inf; expected a finite number of pixels"),
        ("0,right_image,1,2", "row 645: track '0' is in image 'right_image' as in row 2; expected one ray"),
        (",left_image,1,2", "row 645: track_id is ''; expected a text that is not empty"),
        ("900,left_image,1", "row 645: Expected 4 columns, got 3"),
    ],
)
def test_bad_tracks(ventoux: Path, tmp_path: Path, row: str, message: str) -> None:
    with (ventoux / "tracks.csv").open("a") as file:
        file.write(row + "\n")
    with pytest.raises(CatalogueError, match=f"tracks.csv: {message}"):
        run_plain(ventoux, tmp_path / "c")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ventoux"]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("id\nleft_image\n", r"images.csv: column 'image_id' is missing; expected image_id \(optional: acquisition_utc, width"),
        (images(extra="left_image,1,1,,,,,,\n"), "images.csv: row 3: image_id 'left_image' is that of row 1 too"),
        (images(left="P,noon,"), "images.csv: row 1: acquisition_utc: time is 'noon'"),
        (images().replace("500,500,", "-5,500,"), "images.csv: row 1: width is -5; expected a positive number"),
        (images().replace("500,500,", "5oo,500,"), "images.csv: row 1: width is '5oo'; expected a whole number"),
        (images().replace("left_image.json", "l.json"), "images.csv: row 1: no RPC of image 'left_image'; expected .*rpc.l.json"),
        ("image_id,col0,row0\nleft_image,9000,5000\nright_image,4915,5162\n", "images.csv: row 1: size of image left_image is not given"),
        (HEADER, "images.csv: holds no images"),
    ],
)
def test_bad_images(ventoux: Path, tmp_path: Path, table: str, message: str) -> None:
    (ventoux / "images.csv").write_text(table)
    with pytest.raises(CatalogueError, match=message):
        run_plain(ventoux, tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_bad_rpc_and_options(ventoux: Path, tmp_path: Path) -> None:
    with pytest.raises(CatalogueError, match="blocks is 'strip'; expected one of pass, image, all"):
        run_plain(ventoux, tmp_path / "c", blocks="strip")
    rpc = ventoux / "rpc" / "right_image.json"
    rpc.write_text(json.dumps(json.loads(rpc.read_text()) | {"LAT_SCALE": -1.0}))
    with pytest.raises(InputError, match=r"right_image.json: RPC: LAT_SCALE is -1; expected a positive number"):
        run_plain(ventoux, tmp_path / "c")
    assert not (tmp_path / "c").exists()
