"""A plan says what a run then does: tiles, images, rays, splits, rejections, memory; and it writes nothing."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import shapely
from networks import area_of, rewrite
from outlines import landsat_rings

import submin
from orchestration.cli import main
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.plan import Plan, TilePlan, plan
from orchestration.run import run
from submin.simulation.region import SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import CONTROL_PREFIX
from submin.storage.catalogue_writer import CatalogueWriter
from submin.storage.ledger import Ledger
from submin.storage.snapshot import Snapshot


def made(path: Path, area: shapely.Geometry, catalogue: Path, **options: object) -> str:
    create(str(path), area, Catalogue.open(catalogue).metadata, 60.0, 20.0, **options)  # type: ignore[arg-type]
    return str(path)


def found(network: str) -> dict[str, TilePlan]:
    """What the tiles of a network have."""
    snapshot = Snapshot.open(network)
    blocks, cover = snapshot.image_columns(["block_id"])["block_id"], snapshot.cover
    tiles = {}
    for tile in snapshot.tile_numbers():
        images = snapshot.tile_images(tile)
        cells = [cell for cell in cover.cells_held(tile) if cell in snapshot.cell_numbers()]
        rays = sum(counts["rays"] for counts in snapshot.cell_counts(cells))
        of_images = {block for block in blocks[images].tolist() if not block.startswith(CONTROL_PREFIX)}
        tiles[cover.tile_name(tile)] = TilePlan("", len(of_images), len(images), 6 * len(images), rays)
    return tiles


def compare(planned: Plan, network: str) -> None:
    """A run has put no more into any tile than was planned, little less, and exactly these rays."""
    tiles, plans = found(network), {tile.tile: tile for tile in planned.tiles}
    assert set(tiles) <= set(plans)
    for name, tile in tiles.items():
        assert tile.blocks <= plans[name].blocks and tile.images <= plans[name].images and tile.parameters <= plans[name].parameters
    assert {name: t.rays for name, t in plans.items() if t.rays} == {name: t.rays for name, t in tiles.items()}
    assert sum(t.images for t in tiles.values()) > 0.7 * sum(t.images for t in plans.values())


def test_a_run_does_what_was_planned(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    network = made(tmp_path / "network", area_of(region), catalogue)
    before = sorted((path, path.stat().st_mtime_ns) for path in (tmp_path / "network").rglob("*"))
    planned = plan(Catalogue.open(catalogue), network)
    assert sorted((path, path.stat().st_mtime_ns) for path in (tmp_path / "network").rglob("*")) == before
    assert (planned.blocks, planned.new, planned.already_there, planned.refused, planned.unmeasured) == (12, 12, 0, (), 0)
    assert (planned.images, planned.rays, planned.rays_outside, planned.split, planned.over_limit) == (36, len(region.point), 0, (), ())
    assert planned.tiles_of_the_area == len(planned.tiles) == 9
    # the command itself, in a process of its own: its memory is its own
    words = [sys.executable, "-m", "orchestration.cli", "run", str(catalogue), network, "--json"]
    done = json.loads(subprocess.run(words, capture_output=True, check=True, text=True).stdout)
    assert done["blocks_fused"] == 12
    compare(planned, network)
    assert 0.5 < planned.expected[0].memory_mb / done["peak_memory_mb"] < 2.0
    assert 0.05 < planned.expected[0].seconds / done["seconds"] < 20.0
    again = plan(Catalogue.open(catalogue), network)
    assert (again.new, again.already_there, again.tiles, again.rays) == (0, 12, (), 0)


def test_blocks_that_are_in_the_network_count_in_its_tiles_once(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())[:7]
    network = made(tmp_path / "network", area_of(region), catalogue)
    run(Catalogue.open(rewrite(catalogue, tmp_path / "first", blocks[:4])), network, SerialExecutor())
    seven = Catalogue.open(rewrite(catalogue, tmp_path / "seven", blocks))
    planned = plan(seven, network)
    assert (planned.new, planned.already_there) == (3, 4)
    assert planned.rays == sum(len(block) for block in blocks[4:])
    run(seven, network, SerialExecutor())
    tiles = found(network)
    for tile in planned.tiles:
        if tile.rays:
            assert tiles[tile.tile].images <= tile.images and tiles[tile.tile].blocks >= tile.blocks - 2
    assert max(tile.images for tile in planned.tiles) <= 21


def test_tiles_that_grow_are_split_as_planned(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    network = made(tmp_path / "network", area_of(region), catalogue, max_parameters=120)
    blocks = list(Catalogue.open(catalogue).blocks())
    run(Catalogue.open(rewrite(catalogue, tmp_path / "first", blocks[:3])), network, SerialExecutor())
    planned = plan(Catalogue.open(catalogue), network)
    run(Catalogue.open(catalogue), network, SerialExecutor())
    cover, tiles = Snapshot.open(network).cover, found(network)
    split = {cover.tile_name(tile) for tile in cover.splits}
    assert len(split) >= 1 and split <= set(planned.split)
    assert len(planned.split) <= len(split) + 3
    plans = {tile.tile: tile for tile in planned.tiles}
    for name, tile in tiles.items():
        parts = [plans[part] for part in plans if part.startswith(name)]  # whole, or split by the plan
        assert parts and tile.images <= sum(part.images for part in parts)
        if name in plans:
            assert tile.images <= plans[name].images
    assert set(planned.over_limit) <= set(plans)
    assert all(plans[name].parameters > 120 for name in planned.over_limit)


def test_blocks_outside_are_those_that_a_run_rejects(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    west, south, east, north = area_of(region).bounds
    middle = 0.5 * (west + east)
    # a triangle in the west: of four tiles the north-eastern one is none of the area
    area = shapely.Polygon([(west, south), (middle, south), (west, 0.5 * (south + north))])
    network = str(tmp_path / "network")
    create(network, area, Catalogue.open(catalogue).metadata, 30.0, 5.0)
    planned = plan(Catalogue.open(catalogue), network)
    assert planned.tiles_of_the_area == Snapshot.open(network).cover.tile_count
    done = run(Catalogue.open(catalogue), network, SerialExecutor())
    assert {r.block_id: r.reason for r in planned.refused} == {r.block_id: r.reason for r in done.rejected}
    assert len(planned.refused) > 2 < planned.new == done.fused
    compare(planned, network)
    # rays on points outside the triangle, by the truth
    fused = {entry.block_id for entry in Ledger.of(Snapshot.open(network)).fused()}
    blocks = [block for block in Catalogue.open(catalogue).blocks() if block.block_id in fused]
    ids = np.concatenate([block.point_ids for block in blocks])
    truth = dict(zip(region.point_ids.tolist(), region.truth[:, :2], strict=True))
    at = np.array([truth[point] for point in ids.tolist()])
    outside = ~shapely.contains_xy(area, at[:, 0], at[:, 1])
    assert abs(planned.rays_outside - int(outside.sum())) <= 0.02 * len(ids)
    assert planned.rays_outside > 0 < planned.blocks_outside_in_part
    elsewhere = made(tmp_path / "elsewhere", shapely.box(34.0, 80.0, 36.0, 82.0), catalogue)
    nothing = plan(Catalogue.open(catalogue), elsewhere)
    assert (nothing.new, len(nothing.refused), nothing.tiles) == (0, 12, ())


def test_footprints_from_cameras_where_the_catalogue_has_none(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    source = Catalogue.open(catalogue)
    with CatalogueWriter(tmp_path / "bare", source.metadata) as writer:
        writer.write_images(dataclasses.replace(image, footprint=b"") for image in source.images)
        for block in source.blocks():
            writer.write_block(block)
        writer.write_priors(source.default_prior, source.priors)
    network = made(tmp_path / "network", area_of(region), catalogue)
    bare, full = (plan(Catalogue.open(path), network) for path in (tmp_path / "bare", catalogue))
    assert bare.tiles == full.tiles


def test_control_of_the_catalogue_takes_part(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    area = area_of(region)
    rows = [f"{name},{lon},{lat},{h},1,1,1" for name, (lon, lat, h) in zip(region.point_ids[:5], region.truth[:5], strict=True)]
    blocks = list(Catalogue.open(catalogue).blocks())[:5]
    with_control = rewrite(catalogue, tmp_path / "catalogue", blocks)
    header = "point_id,longitude,latitude,height,sigma_e,sigma_n,sigma_u"
    (with_control / "control.csv").write_text("\n".join([header, *rows]) + "\n")
    network = made(tmp_path / "network", area, catalogue)
    planned = plan(Catalogue.open(with_control), network)
    assert (planned.control_points, planned.new, planned.rays) == (5, 5, sum(len(block) for block in blocks) + 10)
    run(Catalogue.open(with_control), network, SerialExecutor())
    compare(planned, network)


def test_images_without_measurements_go_to_every_tile_that_they_meet(
    region: SimulatedRegion, catalogue: Path, tmp_path: Path, data: Path
) -> None:
    # Landsat scenes over Morocco; only their footprints are real: the camera is any
    rings = [r for r in landsat_rings() if (r[:, 0] > -14).all() and (r[:, 0] < 1).all() and (r[:, 1] > 27).all() and (r[:, 1] < 37).all()]
    assert len(rings) > 40
    source = Catalogue.open(catalogue)
    shapes = [shapely.Polygon(ring) for ring in rings]
    with CatalogueWriter(tmp_path / "landsat", source.metadata) as writer:
        writer.write_images(
            dataclasses.replace(source.images[0], image_id=f"S{k}", block_id=f"B{k // 3}", pass_id="P", footprint=shapely.to_wkb(s))
            for k, s in enumerate(shapes)
        )  # fmt: skip
    network = str(tmp_path / "network")
    create(network, shapely.box(-12.0, 28.0, -1.0, 36.0), source.metadata, 300.0, 100.0, max_parameters=90)
    planned = plan(Catalogue.open(tmp_path / "landsat"), network)
    count = len({k // 3 for k in range(len(rings))})
    assert (planned.new, planned.unmeasured, planned.rays, planned.images) == (count, count, 0, len(rings))
    assert planned.split
    cover = Snapshot.open(network).cover
    for name in planned.split:  # larger ones have shorter names
        tile = next(t for t in cover.leaves() if cover.tile_name(t) == name)
        cover = cover.split(tile)
    flat = [shapely.Polygon(np.column_stack(cover.plane(*ring.T))) for ring in rings]
    for tile in cover.leaves():
        outline = shapely.box(*np.clip(cover.tile_bounds(tile), -1e8, 1e8))
        met = np.flatnonzero([outline.intersects(shape) for shape in flat])
        (said,) = [t for t in planned.tiles if t.tile == cover.tile_name(tile)] or [TilePlan("", 0, 0, 0, 0)]
        assert (said.images, said.blocks) == (len(met), len({k // 3 for k in met.tolist()}))
        assert said.parameters <= 90 or said.tile in planned.over_limit


def test_the_command(
    region: SimulatedRegion,
    catalogue: Path,
    complete: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def said(*words: str) -> str:
        monkeypatch.setattr("sys.argv", ["submin", "plan", str(catalogue), network, *words])
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code
        return capsys.readouterr().out

    network = made(tmp_path / "network", area_of(region), catalogue)
    text = said()
    assert "12 blocks, 12 new, 0 already there, 0 would be rejected" in text and "workers" in text and "estimate" in text
    values = json.loads(said("--json"))
    assert values["tiles"] == len(values["by_tile"]) == 9 and values["blocks_per_tile"]["most"] <= 12
    assert [e["workers"] for e in values["expected"]] == [1, 2, 4, 8]
    assert submin.open(network).version == "v0"
    network = str(complete)
    text = said()
    assert "0 new, 12 already there" in text and "nothing would come in" in text
