"""A network grows: tiles that see too many images are split exactly, points come about when their second ray comes, images enter tiles."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from networks import accepted_rays, area_of, rewrite, same_network

import submin
from orchestration.create import create
from orchestration.executors import SerialExecutor, executor_for
from orchestration.info import describe
from orchestration.run import run
from orchestration.withdraw import withdraw
from submin.geodesy import geocentric_to_geodetic
from submin.simulation.region import SimulatedRegion
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block
from submin.storage.repository import create_network, versions
from submin.storage.snapshot import Snapshot

HERE = SerialExecutor()
LIMIT = 100  # parameters: 16 images


def empty(region: SimulatedRegion, catalogue: Path, network: Path, limit: int = LIMIT) -> None:
    create(str(network), area_of(region), Catalogue.open(catalogue).metadata, 60.0, 20.0, max_parameters=limit)


@pytest.fixture(scope="module")
def grown(region: SimulatedRegion, catalogue: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All blocks at once into tiles that are too large for them."""
    network = tmp_path_factory.mktemp("grown") / "network"
    empty(region, catalogue, network)
    assert run(Catalogue.open(catalogue), str(network), HERE).fused == 12
    return network


def test_tiles_over_the_limit_are_split_in_the_same_commit(grown: Path, region: SimulatedRegion) -> None:
    before, after = Snapshot.open(str(grown), "v0"), Snapshot.open(str(grown))
    assert [v.name for v in versions(str(grown))] == ["v1", "v0"]
    assert (before.cover.tile_count, before.cover.splits) == (9, ())
    assert len(after.cover.splits) >= 3
    for tile in after.tile_numbers():
        assert tile not in after.cover.splits
        assert len(after.tile_images(tile)) <= LIMIT // 6 or not after.cover.can_split(tile)
    assert any(len(after.tile_images(tile)) > 12 for tile in after.tile_numbers())  # no finer than it must be
    names = {after.cover.cell_name(number) for number in after.cell_numbers()}
    assert not any(after.cover.tile_name(tile) in name.split("+") for tile in after.cover.splits for name in names)
    image_ids = [image.image_id for image in region.images]
    expected = {(str(region.point_ids[p]), image_ids[i]) for p, i in zip(region.point, region.image, strict=True)}
    assert set(accepted_rays(grown)) == expected


def test_a_split_is_as_if_the_tiles_had_been_so_from_the_beginning(grown: Path, catalogue: Path, tmp_path: Path) -> None:
    metadata = dataclasses.replace(Snapshot.open(str(grown)).metadata, max_parameters=10**6)
    create_network(str(tmp_path / "finer"), metadata)
    run(Catalogue.open(catalogue), str(tmp_path / "finer"), HERE)
    same_network(grown, tmp_path / "finer")


@pytest.mark.parametrize("batch_blocks", [1, 5])
def test_blocks_one_at_a_time_split_the_same_tiles(
    grown: Path, region: SimulatedRegion, catalogue: Path, tmp_path: Path, batch_blocks: int
) -> None:
    network = tmp_path / "network"
    empty(region, catalogue, network)
    with executor_for(2 if batch_blocks == 5 else 0) as executor:
        run(Catalogue.open(catalogue), str(network), executor, batch_blocks=batch_blocks)
    assert Snapshot.open(str(network)).cover.splits == Snapshot.open(str(grown)).cover.splits
    same_network(grown, network)


def test_old_versions_keep_their_tiles(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    network = tmp_path / "network"
    empty(region, catalogue, network)
    first = rewrite(catalogue, tmp_path / "first", list(Catalogue.open(catalogue).blocks())[:4])
    run(Catalogue.open(first), str(network), HERE)
    early = submin.open(network).query(bbox=(90, 30, 110, 40), policy="rigorous")
    run(Catalogue.open(catalogue), str(network), HERE)
    assert Snapshot.open(str(network), "v1").cover.tile_count < Snapshot.open(str(network)).cover.tile_count
    again = submin.open(network, "v1").query(bbox=(90, 30, 110, 40), policy="rigorous")
    assert np.array_equal(early.covariance, again.covariance)


def test_splits_stay_when_blocks_leave(grown: Path, catalogue: Path, tmp_path: Path) -> None:
    blocks = list(Catalogue.open(catalogue).blocks())
    metadata = Snapshot.open(str(grown)).metadata
    for name, chosen in (("less", blocks[:3]), ("more", blocks[:5])):
        create_network(str(tmp_path / name), metadata)
        run(Catalogue.open(rewrite(catalogue, tmp_path / f"{name}-blocks", chosen)), str(tmp_path / name), HERE)
    for block in blocks[3:5]:
        withdraw(str(tmp_path / "more"), HERE, block=block.block_id)
    same_network(tmp_path / "less", tmp_path / "more")


def image_alone(block: Block, k: int, points: set[str]) -> Block:
    """One image of a block, with its rays on some points."""
    rays = (block.image == k) & np.isin(block.point_ids, sorted(points))
    image = dataclasses.replace(block.images[k], block_id=block.images[k].image_id)
    return Block(
        image.image_id, (image,), block.a_priori, block.point_ids[rays], np.zeros(rays.sum(), dtype=np.int32),
        block.sample[rays], block.line[rays], block.sigma_sample[rays], block.sigma_line[rays],
    )  # fmt: skip


def test_pending_points_become_points_with_their_second_ray(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    """Image after image of one triplet: nothing, then all points of two images; every image is in its tiles from its first ray on."""
    block = list(Catalogue.open(catalogue).blocks())[6]
    every = set(block.point_ids.tolist())
    network = tmp_path / "network"
    empty(region, catalogue, network, 10**6)
    seen: list[set[str]] = []
    for k in range(3):
        one = rewrite(catalogue, tmp_path / f"image-{k}", [image_alone(block, k, every)])
        assert run(Catalogue.open(one), str(network), HERE).fused == 1
        seen.append(set(block.point_ids[block.image == k].tolist()))
        found = submin.open(network).query(bbox=(90, 30, 110, 40), policy="rigorous")
        twice = {p for p in every if sum(p in points for points in seen) >= 2}
        assert set(found.ids) == twice
        described = describe(submin.open(network))
        assert described["points_pending"] == len(set().union(*seen)) - len(twice)
        snapshot = Snapshot.open(str(network))
        rows = np.unique(np.concatenate([snapshot.tile_images(tile) for tile in snapshot.tile_numbers()]))
        assert rows.tolist() == list(range(k + 1))
    assert len(snapshot.tile_numbers()) > 1


def test_an_image_that_enters_a_tile_through_a_pending_ray_counts_once(region: SimulatedRegion, catalogue: Path, tmp_path: Path) -> None:
    """An image with one ray only in a tile, whose point gets its second ray from another block later: as all at once, each tile alone."""
    blocks = list(Catalogue.open(catalogue).blocks())
    positions = {str(p): tuple(t) for p, t in zip(region.point_ids, region.truth, strict=True)}
    empty(region, catalogue, tmp_path / "at-once", 10**6)
    cover = Snapshot.open(str(tmp_path / "at-once")).cover

    def held_by(tile: int, point: str) -> bool:
        lon, lat, _ = positions[point]
        return tile in cover.holders(int(cover.cells_of(np.array([lon]), np.array([lat]))[0]))

    # an image over several tiles: all its rays outside one of them, and a single one inside
    block, k, tile = next(
        (b, k, t) for b in blocks for k in range(3) for t in cover.tiles()
        if 3 < sum(held_by(t, p) for p in b.point_ids[b.image == k].tolist()) < (b.image == k).sum() - 5
    )  # fmt: skip
    own = block.point_ids[block.image == k].tolist()
    inside = [p for p in own if held_by(tile, p)]
    scout = image_alone(block, k, {p for p in own if p not in inside} | {inside[0]})
    others = [part for b in blocks for j in range(3) if (b, j) != (block, k) for part in [image_alone(b, j, set(positions))]]
    others.sort(key=lambda b: inside[0] in b.point_ids)  # those with the second ray come last
    batches = [[scout], others]
    network = tmp_path / "network"
    empty(region, catalogue, network, 10**6)
    for n, batch in enumerate(batches):
        assert not run(Catalogue.open(rewrite(catalogue, tmp_path / f"batch-{n}", batch)), str(network), HERE).rejected
        if not n:
            snapshot = Snapshot.open(str(network))
            assert tile in snapshot.tile_numbers()
            assert snapshot.sub_min(tile).redundancy == 0  # held, and nothing known of it here
    run(Catalogue.open(rewrite(catalogue, tmp_path / "all", [*others, scout])), str(tmp_path / "at-once"), HERE)
    same_network(tmp_path / "at-once", network)


def of_points(block: Block, images: list[int], points: set[str], name: str) -> Block:
    """Some images of a block, with their rays on some points."""
    rays = np.isin(block.image, images) & np.isin(block.point_ids, sorted(points))
    return Block(
        name, tuple(dataclasses.replace(block.images[k], block_id=name) for k in images), block.a_priori, block.point_ids[rays],
        np.searchsorted(images, block.image[rays]).astype(np.int32), block.sample[rays], block.line[rays],
        block.sigma_sample[rays], block.sigma_line[rays],
    )  # fmt: skip


def registered(network: Path) -> dict[str, tuple[float, float]]:
    """Easting and northing at which each point of a network is registered."""
    snapshot, at = Snapshot.open(str(network)), {}
    for number in snapshot.cell_numbers():
        cell = snapshot.cell(number)
        geodetic = geocentric_to_geodetic(cell.origin, snapshot.metadata.ellipsoid)
        east, north = snapshot.cover.plane(geodetic[:, 0], geodetic[:, 1])
        at.update({str(p): (float(x), float(y)) for p, x, y in zip(cell.point_ids, east, north, strict=True)})
    return at


def test_a_tile_that_loses_its_last_shared_point_in_a_split_is_judged_again(
    region: SimulatedRegion, catalogue: Path, tmp_path: Path
) -> None:
    """The only point that tiles A and B share moves out of A with its third ray, in the batch that splits B."""
    block = list(Catalogue.open(catalogue).blocks())[6]
    seen = [set(block.point_ids[block.image == k].tolist()) for k in range(3)]
    every = seen[0] & seen[1] & seen[2]
    at = []
    for name, images in (("two", [0, 1]), ("three", [0, 1, 2])):
        empty(region, catalogue, tmp_path / name, 10**6)
        one = rewrite(catalogue, tmp_path / f"{name}-images", [of_points(block, images, every, name)])
        run(Catalogue.open(one), str(tmp_path / name), HERE)
        at.append(registered(tmp_path / name))
    two, three = at
    mover = next(
        p for p in sorted(every, key=lambda p: two[p][0] - three[p][0])
        if sum(three[q][0] > three[p][0] + 500.0 for q in every) >= 8 and sum(three[q][0] < three[p][0] - 21e3 for q in every) >= 2
    )  # fmt: skip
    assert three[mover][0] > two[mover][0]
    edge = 0.5 * (two[mover][0] + three[mover][0])  # of tile A, half an overlap east of the border
    metadata = Snapshot.open(str(tmp_path / "two")).metadata
    cover = dataclasses.replace(
        Snapshot.open(str(tmp_path / "two")).cover, origin=(edge - 70e3, three[mover][1] - 30e3), rows=1, columns=2, core=60e3, overlap=20e3
    )
    metadata = dataclasses.replace(metadata, cover=cover.to_mapping(), max_parameters=12)
    beyond = {q for q in every if three[q][0] > edge + 100.0}
    own = {q for q in every if max(two[q][0], three[q][0]) < edge - 20.1e3}
    first, second = of_points(block, [0, 1], {mover} | beyond | own, "first"), of_points(block, [2], {mover} | beyond, "second")
    create_network(str(tmp_path / "grown"), metadata)
    for name, part in (("first", first), ("second", second)):
        run(Catalogue.open(rewrite(catalogue, tmp_path / name, [part])), str(tmp_path / "grown"), HERE)
    after = Snapshot.open(str(tmp_path / "grown"))
    assert after.cover.splits == (1,)
    create_network(str(tmp_path / "at-once"), dataclasses.replace(after.metadata, max_parameters=10**6))
    run(Catalogue.open(rewrite(catalogue, tmp_path / "both", [first, second])), str(tmp_path / "at-once"), HERE)
    assert after.sub_min(0).redundancy == Snapshot.open(str(tmp_path / "at-once")).sub_min(0).redundancy == len(own)
    same_network(tmp_path / "grown", tmp_path / "at-once")
