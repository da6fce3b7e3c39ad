"""Metadata of points against a count over the catalogue, point by point; dates; queries by number. All on one small network."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from networks import accepted_rays, area_of, fuse

import submin
from orchestration.cli import main
from orchestration.control import add_control
from orchestration.executors import SerialExecutor
from orchestration.info import describe
from orchestration.retire import retire
from orchestration.withdraw import withdraw
from submin.errors import BusyError, InputError, QueryError
from submin.query.point_metadata import PointMetadata
from submin.sensors import sensor_named
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, PointTable
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.check_points import check_points
from submin.storage.repository import versions
from submin.storage.simulated import write_region
from submin.storage.snapshot import Snapshot
from submin.storage.writer_lock import writing

EVERYWHERE = (90.0, 30.0, 110.0, 40.0)
HERE = SerialExecutor()
TWIN = "twin"


def with_odd_points(block: Block) -> Block:
    """The block with a point of one ray, and three points that only two images of one place see."""
    twin = dataclasses.replace(block.images[0], image_id=TWIN)
    rows = np.flatnonzero(block.image == 0)[:3]
    more = {name: getattr(block, name)[np.r_[rows, rows, rows[:1]]] for name in ("sample", "line", "sigma_sample", "sigma_line")}
    return dataclasses.replace(
        block, images=(*block.images, twin),
        point_ids=np.concatenate([block.point_ids, ["U0", "U1", "U2", "U0", "U1", "U2", "lone"]]),
        image=np.concatenate([block.image, np.array([0, 0, 0, 3, 3, 3, 0], dtype=np.int32)]),
        **{name: np.concatenate([getattr(block, name), values]) for name, values in more.items()},
    )  # fmt: skip


def licensed(block: Block, licences: tuple[str, ...]) -> Block:
    """The block with licences of its images, one after another."""
    images = (dataclasses.replace(image, licence=licences[k % len(licences)]) for k, image in enumerate(block.images))
    return dataclasses.replace(block, images=tuple(images))


@dataclasses.dataclass(frozen=True)
class World:
    folder: Path
    blocks: list[Block]
    control: PointTable
    checked: PointTable

    @property
    def place(self) -> Path:
        return self.folder / "network"

    def points(self, **question: Any) -> PointMetadata:
        return submin.open(self.place).points(**question)


def write(out: Path, source: Catalogue, blocks: list[Block], check: PointTable | None) -> Path:
    with CatalogueWriter(out, source.metadata) as writer:
        writer.write_images(image for block in blocks for image in block.images)
        for block in blocks:
            writer.write_block(block)
        writer.write_priors(source.default_prior, source.priors)
        if check is not None:
            writer.write_points("check", check)
    return out


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    """Four blocks: two of them at once, the second last after the last one; check points with the first, then control."""
    folder = tmp_path_factory.mktemp("points")
    region = simulate_region(RegionDesign(width_km=60, height_km=60, point_spacing_km=9.5, blunder_rate=0.01, bad_cameras=0, seed=3))
    write_region(region, folder / "region")
    source = Catalogue.open(folder / "region")
    blocks = list(source.blocks())
    licences = (("CC BY 4.0", ""), ("b; c",), (), ("a", "CC BY 4.0"))
    blocks = [licensed(block, names) if names else block for block, names in zip(blocks, licences, strict=True)]
    blocks[1] = with_odd_points(blocks[1])
    table = [PointTable(region.point_ids[k], region.truth[k], np.tile(0.01 * np.eye(3), (len(k), 1, 1)), np.full(len(k), ""))
             for k in ([5, 17], [5, 6, 7, 30])]  # fmt: skip
    control, checked = table
    for name, of_run, check in (("a", [0, 1], checked), ("b", [3], None), ("c", [2], checked)):
        catalogue = write(folder / name, source, [blocks[k] for k in of_run], check)
        fuse(catalogue, folder / "network", area_of(region), tile_km=40, overlap_km=15)
    add_control(control, "test", str(folder / "network"), HERE)
    return World(folder, blocks, control, checked)


@pytest.fixture
def copy(world: World, tmp_path: Path) -> World:
    """The same with a network that may be changed."""
    shutil.copytree(world.place, tmp_path / "network")
    return dataclasses.replace(world, folder=tmp_path)


def test_counts_are_those_of_the_catalogue(world: World) -> None:
    accepted = accepted_rays(world.place)
    found = world.points(bbox=EVERYWHERE)
    rays = [(str(p), block, block.images[i]) for block in world.blocks for p, i in zip(block.point_ids, block.image, strict=True)]
    assert found.ids.tolist() == sorted({p for p, _, _ in rays})
    arrival = {b.block_id: v for b, v in zip(world.blocks, (1, 1, 3, 2), strict=True)}
    assert found.rays_rejected.sum() > 0
    for k, point in enumerate(found.ids.tolist()):
        mine = [(block, image) for p, block, image in rays if p == point]
        used = [(block, image) for block, image in mine if accepted[point, image.image_id]]
        assert (found.rays[k], found.rays_rejected[k]) == (len(used), len(mine) - len(used))
        names = sorted({block.block_id for block, _ in used}, key=lambda name: (arrival[name], name))
        assert (found.blocks[k], found.first_block[k], found.last_block[k]) == (len(names), *((names[0], names[-1]) if names else ("", "")))
        times = sorted((image.seconds, image.acquired) for _, image in used)
        assert (found.first_acquired[k], found.last_acquired[k]) == ((times[0][1], times[-1][1]) if used else ("", ""))
        assert found.licences[k] == "; ".join(sorted({image.licence for _, image in used} - {""}))
    assert len(set(found.blocks.tolist())) > 2 and len(set(found.licences.tolist())) > 3


def test_status(world: World) -> None:
    found = world.points(bbox=EVERYWHERE)
    status = dict(zip(found.ids.tolist(), found.status.tolist(), strict=True))
    control, checked = set(world.control.point_ids.tolist()), set(world.checked.point_ids.tolist())
    expected = dict.fromkeys(status, "internal") | dict.fromkeys(checked & set(status), "check") | dict.fromkeys(control, "external")
    assert status == expected | {"lone": "pending", "U0": "undetermined", "U1": "undetermined", "U2": "undetermined"}
    assert found.with_status("check").ids.tolist() == sorted(checked - control)
    assert found.with_status("external").ids.tolist() == sorted(control)
    # whoever is neither pending nor undetermined is answered for
    determined = found.ids[~np.isin(found.status, ["pending", "undetermined"])]
    np.testing.assert_array_equal(submin.open(world.place).query(bbox=EVERYWHERE, policy="rigorous").ids, determined)


def test_convergence_is_the_largest_angle_between_two_lines_of_sight(world: World) -> None:
    """Lines of sight from two heights in the unadjusted cameras, which turn by pixels only."""
    accepted, found = accepted_rays(world.place), world.points(bbox=EVERYWHERE)
    lines: dict[str, list[np.ndarray]] = {}
    ellipsoid = Catalogue.open(world.folder / "a").metadata.ellipsoid
    for block in world.blocks:
        for point, i, sample, line in zip(block.point_ids, block.image, block.sample, block.line, strict=True):
            record = block.images[i]
            if not accepted[str(point), record.image_id]:
                continue
            sensor, camera = sensor_named(record.sensor), record.pack()[None]
            heights = sensor.mean_height(camera) + np.array([-200.0, 200.0])
            at = [
                sensor.localise(camera, np.zeros(1, dtype=np.int32), np.array([sample]), np.array([line]), height[None], ellipsoid)
                for height in heights
            ]
            low, high = (submin.geodesy.geodetic_to_geocentric(place, ellipsoid)[0] for place in at)
            lines.setdefault(str(point), []).append((high - low) / np.linalg.norm(high - low))
    for k, point in enumerate(found.ids.tolist()):
        directions = np.array(lines[point])
        if len(directions) < 2:
            assert np.isnan(found.convergence[k])
            continue
        cosines = np.clip(np.abs(directions @ directions.T), 0.0, 1.0)
        assert found.convergence[k] == pytest.approx(np.degrees(np.arccos(cosines.min())), abs=0.02)
    assert np.nanmin(found.convergence) < 0.02 and np.nanmax(found.convergence) > 30.0


def test_places(world: World) -> None:
    network, found = submin.open(world.place), world.points(bbox=EVERYWHERE)
    answer = network.query(bbox=EVERYWHERE, policy="rigorous")
    determined = np.isin(found.ids, answer.ids)
    metres = 111_000.0 * np.abs(found.geodetic - found.registered)[:, :2].max(axis=1)
    assert 1.0 < np.median(metres[determined]) < 100.0
    assert (metres[~determined] == 0.0).all()
    own = network.accuracy()
    at = np.searchsorted(found.ids, own.ids)
    off = np.abs(found.geodetic[at] - own.geodetic)  # an adjustment ends where a step is nothing beside its accuracy
    assert (111_000.0 * off[:, :2].max(axis=1) < 1e-3 * own.ce90).all() and (off[:, 2] < 1e-3 * own.le90).all()
    np.testing.assert_array_equal(found.tile[at], own.tile)
    cells = [cell.split("+")[0] for cell in found.cell.tolist()]
    assert cells == found.tile.tolist()
    assert len(set(found.cell.tolist())) > 4


def test_every_way_to_ask_gives_the_same_points(world: World) -> None:
    network, every = submin.open(world.place), world.points(bbox=EVERYWHERE)
    box = (99.8, 34.8, 100.1, 35.1)
    inside = every.take((every.geodetic[:, 0] > box[0]) & (every.geodetic[:, 0] < box[2])
                        & (every.geodetic[:, 1] > box[1]) & (every.geodetic[:, 1] < box[3]))  # fmt: skip
    assert 5 < len(inside) < 0.7 * len(every)
    ways: list[dict[str, Any]] = [{"bbox": box}, {"points": inside.ids[::-1]}]
    for way in ways:
        for name, values in network.points(**way).columns().items():
            np.testing.assert_array_equal(values, inside.columns()[name])
    tile = network.cover.tile_name(network.snapshot.tile_numbers()[0])
    held = network.points(tile=tile)
    assert set(network.query(tile=tile).ids) == set(held.ids[~np.isin(held.status, ["pending", "undetermined"])])
    assert len(network.points(bbox=(10.0, 10.0, 11.0, 11.0))) == 0
    with pytest.raises(QueryError, match="1 of 2 points are not in the network: nobody; expected ids of its points"):
        network.points(points=["nobody", "lone"])
    with pytest.raises(QueryError, match="asked by nothing; expected one of"):
        network.points()
    with pytest.raises(QueryError, match="asked by bbox and tile; expected one of"):
        network.points(bbox=box, tile=tile)


def test_blocks_come_and_go_and_an_image_does_not_make_its_block_younger(copy: World) -> None:
    before = copy.points(bbox=EVERYWHERE)
    withdraw(str(copy.place), HERE, image=copy.blocks[0].images[1].image_id)
    after = copy.points(points=before.ids)
    seen = np.isin(before.ids, copy.blocks[0].point_ids[copy.blocks[0].image == 1])
    np.testing.assert_array_equal(after.first_block[~seen], before.first_block[~seen])
    assert (after.rays[seen] + after.rays_rejected[seen] == before.rays[seen] + before.rays_rejected[seen] - 1).all()
    assert (after.first_block == copy.blocks[0].block_id).sum() > 10
    withdraw(str(copy.place), HERE, block=copy.blocks[0].block_id)
    left = copy.points(bbox=EVERYWHERE)
    assert not (left.first_block == copy.blocks[0].block_id).any()
    withdraw(str(copy.place), HERE, control=str(copy.control.point_ids[0]))
    assert copy.points(points=copy.control.point_ids).status[0] == "check"


def test_check_points_are_remembered_with_blocks_only_and_once(world: World, copy: World) -> None:
    names = sorted(world.checked.point_ids.tolist())
    assert [check_points(Snapshot.open(str(world.place), f"v{k}")).tolist() for k in range(5)] == [[], names, names, names, names]
    assert Snapshot.open(str(world.place)).root["check_points"]["point_id.ends"].shape == (len(names),)
    more = PointTable(np.array(["P00001"]), world.checked.geodetic[:1], world.checked.covariance_enu[:1], np.array([""]))
    write(copy.folder / "again", Catalogue.open(world.folder / "a"), world.blocks[:2], more)
    assert fuse(copy.folder / "again", copy.place, area_of(simulate_region(RegionDesign(width_km=60, height_km=60)))).version == "v4"
    assert check_points(Snapshot.open(str(copy.place))).tolist() == names
    withdraw(str(copy.place), HERE, block=world.blocks[3].block_id)
    assert check_points(Snapshot.open(str(copy.place))).tolist() == names


# Dates


def test_retired_points_are_left_out_of_areas_and_tiles_after_their_day(copy: World) -> None:
    network = submin.open(copy.place)
    every = network.query(bbox=EVERYWHERE, policy="rigorous")
    gone = every.ids[3:9]
    done = retire(str(copy.place), gone, valid_to="2026-05-31", reason="quarry")
    assert done.to_json() == {"version": "v5", "points": 6, "points_changed": 6}
    assert versions(str(copy.place))[0].message == "6 points valid to 2026-05-31: quarry"
    after = submin.open(copy.place)
    tile = after.cover.tile_name(after.snapshot.tile_numbers()[0])
    for day, here in ((date(2026, 5, 31), every.ids), (date(2026, 6, 1), np.setdiff1d(every.ids, gone))):
        np.testing.assert_array_equal(after.query(bbox=EVERYWHERE, policy="rigorous", on=day).ids, here)
        np.testing.assert_array_equal(np.sort(after.accuracy(on=day).ids), here)
        held = network.query(tile=tile).ids
        np.testing.assert_array_equal(after.query(tile=tile, on=day).ids, np.intersect1d(held, here))
    left = after.query(bbox=EVERYWHERE, policy="rigorous", on=date(2026, 6, 1))
    rows = (3 * np.searchsorted(every.ids, left.ids)[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose(left.covariance, every.covariance[np.ix_(rows, rows)], rtol=0.0, atol=1e-10)
    assert left.validity == ()
    named = after.query(points=gone, policy="rigorous", on=date(2026, 6, 1))
    assert named.ids.tolist() == gone.tolist()
    assert named.validity == tuple(f"{point} ../2026-05-31" for point in gone)
    assert named.subset([1]).validity == (f"{gone[1]} ../2026-05-31",)
    found = after.points(points=every.ids)
    assert set(found.valid_to[np.isin(found.ids, gone)]) == {"2026-05-31"} and set(found.reason) == {"", "quarry"}
    assert describe(after)["points"] == len(every)


def test_dates_once_are_dates_for_ever_and_can_be_taken_back(copy: World) -> None:
    place, ids = str(copy.place), np.array(["lone", str(copy.control.point_ids[0])])
    assert retire(place, ids, valid_to="2020-01-01", reason="flood").changed == 2
    assert retire(place, ids, valid_to="2020-01-01").to_json() == {"version": "v5", "points": 2, "points_changed": 0}
    assert retire(place, np.r_[ids, ids], valid_to="2020-01-01", reason="flood").version == "v5"
    assert retire(place, ids[:1], valid_from="2019-01-01").version == "v6"
    assert submin.open(place).validity.rows_of(ids[:1]) == (["2019-01-01"], ["2020-01-01"], [""])
    assert retire(place, ids, valid_to="none").changed == 2
    assert submin.open(place).validity.intervals(ids) == ("lone 2019-01-01/..",)
    assert copy.points(points=ids[1:]).reason.tolist() == [""]
    old = submin.open(place, "v5")
    assert old.points(points=ids).valid_to.tolist() == ["2020-01-01"] * 2
    assert old.validity.rows_of(ids)[2].tolist() == ["flood"] * 2
    # whatever comes later, and even when the point has left meanwhile, what was said of it stays
    withdraw(place, HERE, block=copy.blocks[3].block_id)
    assert submin.open(place).validity.intervals(ids) == ("lone 2019-01-01/..",)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"valid_to": "31.5.2026"}, "--valid-to is '31.5.2026'; expected a date as 2026-05-31, or none"),
        ({"valid_from": "soon"}, "--valid-from is 'soon'; expected a date as 2026-05-31, or none"),
        ({"valid_from": "2026-06-01", "valid_to": "2026-05-31"}, "point lone would be valid from 2026-06-01 to 2026-05-31"),
        ({}, "no date is given; expected --valid-to, --valid-from, or both"),
        ({"valid_to": "2026-05-31", "ids": ["lone", "nobody", "no"]}, "2 of 3 points are not in the network: no, nobody; expected ids of"),
    ],
)
def test_what_cannot_be_retired(world: World, given: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        retire(str(world.place), np.array(given.pop("ids", ["lone"])), **given)
    assert Snapshot.open(str(world.place)).number == 4


def test_nobody_retires_while_another_writes(copy: World) -> None:
    with writing(str(copy.place)), pytest.raises(BusyError, match="is writing to this network"):
        retire(str(copy.place), np.array(["lone"]), valid_to="2026-05-31")
    assert Snapshot.open(str(copy.place)).number == 4


# Queries by number


@pytest.mark.parametrize("policy", ["auto", "tile", "ci", "bci", "split", "rigorous"])
@pytest.mark.parametrize("most", [1, 2, 7, 20, 10_000])
def test_at_most_so_many_points_are_exactly_so_many(world: World, policy: str, most: int) -> None:
    network = submin.open(world.place)
    tile = network.cover.tile_name(network.snapshot.tile_numbers()[0])
    question: dict[str, Any] = {"tile": tile} if policy == "tile" else {"bbox": EVERYWHERE}
    every, some = (network.query(**question, policy=policy, max_points=n) for n in (None, most))
    assert len(some) == min(most, len(every))
    assert set(some.ids) <= set(every.ids)
    if policy not in ("ci", "bci", "split"):  # whose weights are those of the points asked for
        rows = (3 * np.searchsorted(every.ids, some.ids)[:, None] + np.arange(3)).ravel()
        if some.tiles == every.tiles:
            np.testing.assert_allclose(some.covariance, every.covariance[np.ix_(rows, rows)], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("most", [0, -1])
def test_fewer_than_one_point_is_no_question(world: World, most: int) -> None:
    with pytest.raises(QueryError, match=f"max_points is {most}; expected 1 or more"):
        submin.open(world.place).query(bbox=EVERYWHERE, max_points=most)


# The command line


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    def run(*words: object, code: int = 0) -> dict[str, Any]:
        monkeypatch.setattr(sys, "argv", ["submin", *map(str, words), "--json"])
        with pytest.raises(SystemExit) as ended:
            main()
            raise SystemExit(0)
        printed = capsys.readouterr()
        assert (ended.value.code or 0) == code, printed.err
        values: dict[str, Any] = json.loads(printed.out)
        return values

    return run


def test_commands(copy: World, shell: Callable[..., dict[str, Any]]) -> None:
    out, listed = copy.folder / "points.parquet", copy.folder / "ids.txt"
    box = ("--bbox", *EVERYWHERE)
    every = copy.points(bbox=EVERYWHERE)
    values = shell("points", copy.place, *box, "--out", out)
    assert (values["points"], values["version"], values["status"]["undetermined"]) == (len(every), "v4", 3)
    assert pq.read_table(out)["point_id"].to_pylist() == every.ids.tolist()
    assert shell("points", copy.place, *box, "--status", "external", "--out", out)["points"] == 2
    assert pq.read_table(out)["status"].to_pylist() == ["external"] * 2
    assert "expected one of internal, external" in shell("points", copy.place, *box, "--status", "good", "--out", out, code=2)["error"]
    assert "unknown suffix" in shell("points", copy.place, *box, "--out", copy.folder / "points.npz", code=2)["error"]

    listed.write_text("P000009\n")
    assert shell("retire", copy.place, "--points", listed, "--valid-to", "2026-05-31", "--reason", "road")["version"] == "v5"
    assert shell("retire", copy.place, "--points", listed, "--valid-to", "2026-05-31")["points_changed"] == 0
    before, after = (shell("query", copy.place, *box, "--on", day)["points"] for day in ("2026-05-31", "2026-06-01"))
    assert before == after + 1
    assert shell("query", copy.place, "--points", listed, "--on", "2026-06-01")["validity"] == ["P000009 ../2026-05-31"]
    assert shell("query", copy.place, *box, "--on", "today", code=2)["error"] == "--on is 'today'; expected a date as 2026-05-31"


@pytest.mark.parametrize("suffix", ["parquet", "csv", "geojson", "npz"])
def test_details_go_into_every_format(world: World, shell: Callable[..., dict[str, Any]], tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"control.{suffix}"
    shell("query", world.place, "--bbox", *EVERYWHERE, "--max-points", 8, "--details", "--out", out)
    if suffix == "parquet":
        table = pq.read_table(out)
        found = world.points(points=table["point_id"].to_pylist())
        for name, values in found.details().items():
            assert table[name].to_pylist() == values.tolist()
    elif suffix == "npz":
        with np.load(out) as arrays:
            assert arrays["covariance"].shape == (24, 24) and len(arrays["convergence"]) == 8
    else:
        assert "first_block" in out.read_text()
    plain = tmp_path / f"plain.{suffix}"
    shell("query", world.place, "--bbox", *EVERYWHERE, "--max-points", 8, "--out", plain)
    assert b"first_block" not in plain.read_bytes()
