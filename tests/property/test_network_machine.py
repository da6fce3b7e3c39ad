"""Anything may happen to a network, in any order; after every step it is what its blocks and control points say, counted once.

After each step the rays in the cells are compared with the blocks that are in, the answers with a dense adjustment of all unknowns
(exact_covariance.py), old versions with what they answered when they were new. In the end a network made at once from the same blocks
must be the same: nothing depends on how it came about.
"""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule, run_state_machine_as_test
from networks import area_of, rewrite, same_network
from property.exact_covariance import adjusted_together, equations, located, monolithic

import submin
from orchestration.control import add_control
from orchestration.create import create
from orchestration.executors import SerialExecutor
from orchestration.run import run
from orchestration.verify import verify
from orchestration.withdraw import withdraw
from submin.adjustment.priors import APriori
from submin.errors import InputError
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.catalogue_schema import Block, PointTable
from submin.storage.repository import create_network
from submin.storage.simulated import write_region
from submin.storage.snapshot import Snapshot

DESIGN = RegionDesign(
    width_km=60, height_km=60, point_spacing_km=9.5, blunder_rate=0.0, bad_cameras=0, seed=5,
    priors=APriori(correlation="exponential", correlation_parameter=60.0),
)  # fmt: skip
EVERYWHERE = (90.0, 30.0, 110.0, 40.0)
HERE = SerialExecutor()


class Crash(Exception):
    """Stands for whatever ends a run in its middle."""


class CrashingExecutor(SerialExecutor):
    """Ends the run at its n-th task."""

    def __init__(self, tasks: int) -> None:
        self.left = tasks

    def submit_all(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], name: str, advance: Any) -> list[Any]:
        done = []
        for args in arguments:
            self.left -= 1
            if self.left < 0:
                raise Crash
            done.append(function(*args))
        return done


def part(block: Block, images: list[int], name: str) -> Block:
    """Some images of a block as a block of their own."""
    rays = np.isin(block.image, images)
    return Block(
        name, tuple(dataclasses.replace(block.images[k], block_id=name) for k in images), block.a_priori, block.point_ids[rays],
        np.searchsorted(images, block.image[rays]).astype(np.int32), block.sample[rays], block.line[rays],
        block.sigma_sample[rays], block.sigma_line[rays],
    )  # fmt: skip


class World:
    """Blocks and control points that exist, made once."""

    def __init__(self, folder: Path) -> None:
        self.region = simulate_region(DESIGN)
        self.catalogue = folder / "catalogue"
        write_region(self.region, self.catalogue)
        triplets = list(Catalogue.open(self.catalogue).blocks())
        pairs = [part(block, [0, 2], f"{block.block_id}-pair") for block in triplets]
        singles = [part(block, [1], f"{block.block_id}-single") for block in triplets]
        self.blocks = {block.block_id: block for block in (*pairs, *singles)}
        self.area = area_of(self.region)

    def control(self, k: int) -> PointTable:
        """Point k of the region, surveyed to half a metre."""
        covariance = np.array([[0.25, 0.1, 0.0], [0.1, 0.25, -0.05], [0.0, -0.05, 0.4]])
        return PointTable(self.region.point_ids[[k]], self.region.truth[[k]], covariance[None], np.array([""]))


class NetworkMachine(RuleBasedStateMachine):
    """Operations on a network, and a model that only knows which blocks, images and control points are in."""

    world: World
    count = 0

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.network = self.folder / "network"
        self.blocks: dict[str, set[str]] = {}
        self.control: set[int] = set()
        self.answers: dict[str, submin.ControlSet] = {}
        # ten images to a tile: growth splits tiles
        create(str(self.network), self.world.area, Catalogue.open(self.world.catalogue).metadata, 40.0, 12.0, max_parameters=60)

    def teardown(self) -> None:
        try:
            self.is_the_network_of_its_blocks()
        finally:
            shutil.rmtree(self.folder)

    def catalogue_of(self, names: Sequence[str], change: float = 0.0) -> Catalogue:
        NetworkMachine.count += 1
        blocks = [self.world.blocks[name] for name in names]
        blocks = [dataclasses.replace(block, sample=block.sample + change) for block in blocks]
        return Catalogue.open(rewrite(self.world.catalogue, self.folder / f"catalogue-{NetworkMachine.count}", blocks))

    def version(self) -> str:
        return Snapshot.open(str(self.network)).version

    def absent(self) -> list[str]:
        return sorted(set(self.world.blocks) - set(self.blocks))

    @initialize(data=st.data())
    def begin(self, data: st.DataObject) -> None:
        self.fuse(data, 3)

    @precondition(lambda self: self.absent())
    @rule(data=st.data(), batch=st.integers(1, 3))
    def fuse(self, data: st.DataObject, batch: int) -> None:
        names = data.draw(st.lists(st.sampled_from(self.absent()), min_size=1, max_size=3, unique=True))
        result = run(self.catalogue_of(names), str(self.network), HERE, batch_blocks=batch)
        assert (result.fused, result.rejected) == (len(names), ())
        self.blocks |= {name: {image.image_id for image in self.world.blocks[name].images} for name in names}

    @precondition(lambda self: self.blocks)
    @rule(data=st.data())
    def fuse_again(self, data: st.DataObject) -> None:
        name, before = data.draw(st.sampled_from(sorted(self.blocks))), self.version()
        result = run(self.catalogue_of([name]), str(self.network), HERE)
        assert (result.fused, result.skipped, result.version) == (0, 1, before)

    @precondition(lambda self: self.blocks)
    @rule(data=st.data())
    def fuse_changed(self, data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(self.blocks)))
        (refused,) = run(self.catalogue_of([name], change=0.25), str(self.network), HERE).rejected
        assert refused.block_id == name
        assert "other content" in refused.reason

    @precondition(lambda self: self.blocks)
    @rule(data=st.data())
    def withdraw_block(self, data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(self.blocks)))
        withdraw(str(self.network), HERE, block=name)
        del self.blocks[name]

    @precondition(lambda self: self.blocks)
    @rule(data=st.data())
    def withdraw_image(self, data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(self.blocks)))
        image = data.draw(st.sampled_from(sorted(self.blocks[name])))
        withdraw(str(self.network), HERE, image=image)
        self.blocks[name].remove(image)
        if not self.blocks[name]:
            del self.blocks[name]

    @rule(k=st.integers(0, 8))
    def add_control(self, k: int) -> None:
        added = add_control(self.world.control(4 * k), "test", str(self.network), HERE)
        assert (added.fused, added.skipped) == ((0, 1) if 4 * k in self.control else (1, 0))
        self.control.add(4 * k)

    @precondition(lambda self: self.control)
    @rule(data=st.data())
    def withdraw_control(self, data: st.DataObject) -> None:
        k = data.draw(st.sampled_from(sorted(self.control)))
        withdraw(str(self.network), HERE, control=str(self.world.region.point_ids[k]))
        self.control.remove(k)

    @precondition(lambda self: self.absent())
    @rule(data=st.data(), tasks=st.integers(0, 12))
    def crash(self, data: st.DataObject, tasks: int) -> None:
        """A run that ends in its middle changes nothing, and leaves nothing that a later run would trip over."""
        name, before = data.draw(st.sampled_from(self.absent())), self.version()
        try:
            run(self.catalogue_of([name]), str(self.network), CrashingExecutor(tasks))
        except Crash:
            assert self.version() == before
        else:
            self.blocks[name] = {image.image_id for image in self.world.blocks[name].images}

    @precondition(lambda self: self.absent())
    @rule(data=st.data())
    def withdraw_what_is_not_there(self, data: st.DataObject) -> None:
        before = self.version()
        with pytest.raises(InputError, match="is not in the network"):
            withdraw(str(self.network), HERE, block=data.draw(st.sampled_from(self.absent())))
        assert self.version() == before

    @precondition(lambda self: self.answers)
    @rule(data=st.data())
    def look_back(self, data: st.DataObject) -> None:
        version = data.draw(st.sampled_from(sorted(self.answers)))
        again = submin.open(self.network, version).query(bbox=EVERYWHERE, policy="rigorous")
        assert np.array_equal(again.covariance, self.answers[version].covariance)
        assert np.array_equal(again.geocentric, self.answers[version].geocentric)

    def expected_rays(self) -> list[tuple[str, str, float, float]]:
        """Every ray that must be in, by point and image."""
        rays = []
        for name, images in self.blocks.items():
            block = self.world.blocks[name]
            for point, k, sample, line in zip(block.point_ids, block.image, block.sample, block.line, strict=True):
                if block.images[k].image_id in images:
                    rays.append((str(point), block.images[k].image_id, float(sample), float(line)))
        for k in self.control:
            point = str(self.world.region.point_ids[k])
            rays += [(point, f"control:{point}:{view}", 0.0, 0.0) for view in range(2)]
        return sorted(rays)

    @invariant()
    def holds_every_ray_once(self) -> None:
        snapshot = Snapshot.open(str(self.network))
        images, rays = snapshot.image_columns(["image_id"])["image_id"], []
        for number in snapshot.cell_numbers():
            cell = snapshot.cell(number)
            assert len(cell)
            ids = cell.point_ids[cell.rays.point].tolist()
            rays += list(zip(ids, images[cell.images[cell.rays.image]].tolist(), *cell.rays.observed.T.tolist(), strict=True))
        assert sorted(rays) == self.expected_rays()

    @invariant()
    def answers_as_one_dense_adjustment(self) -> None:
        network = submin.open(self.network)
        found = network.query(bbox=EVERYWHERE, policy="rigorous")
        self.answers[network.version] = found
        if not len(found):
            return
        problem = equations(network)
        positions, covariance = monolithic(problem)
        assert set(found.ids) <= set(problem.point_ids)
        rows = np.searchsorted(problem.point_ids, found.ids)
        axes = (3 * rows[:, None] + np.arange(3)).ravel()
        close(found, positions[rows], covariance[np.ix_(axes, axes)])
        tile = network.snapshot.tile_numbers()[len(self.answers) % len(network.snapshot.tile_numbers())]
        alone = network.query(tile=network.cover.tile_name(tile))
        if len(alone):
            ways = located(problem, adjusted_together(problem, [tile], np.ones(1)), alone.ids)
            origin = problem.origin[np.searchsorted(problem.point_ids, alone.ids)]
            # the map gives the errors of y and of the a priori values their unit variance
            close(alone, origin + (ways @ problem.data).reshape(-1, 3), ways @ ways.T)

    @invariant()
    def tiles_keep_their_limit(self) -> None:
        snapshot = Snapshot.open(str(self.network))
        for tile in snapshot.tile_numbers():
            assert len(snapshot.tile_images(tile)) <= 10 or not snapshot.cover.can_split(tile)

    def is_the_network_of_its_blocks(self) -> None:
        """One network made at once of what is in, with the tiles that have come about, is the same; and it is sound."""
        assert verify(str(self.network), HERE).problems == ()
        NetworkMachine.count += 1
        fresh = self.folder / f"fresh-{NetworkMachine.count}"
        create_network(str(fresh), Snapshot.open(str(self.network)).metadata)
        parts = []
        for name, images in self.blocks.items():
            block = self.world.blocks[name]
            parts.append(part(block, [k for k, image in enumerate(block.images) if image.image_id in images], name))
        if parts:
            at_once = rewrite(self.world.catalogue, self.folder / f"all-{NetworkMachine.count}", parts[::-1])
            assert not run(Catalogue.open(at_once), str(fresh), HERE).rejected
        for k in sorted(self.control, reverse=True):
            add_control(self.world.control(k), "test", str(fresh), HERE)
        same_network(self.network, fresh)


def close(found: submin.ControlSet, positions: np.ndarray, covariance: np.ndarray) -> None:
    """Positions within 1e-9 sigma of the correction's size, covariance within 1e-9 of the sigmas' product."""
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs((found.geocentric - positions).ravel() / np.maximum(sigma, 1.0)).max() < 2e-9
    assert (np.abs(found.covariance - covariance) / sigma / sigma[:, None]).max() < 1e-9


def test_a_network_is_what_its_blocks_say(tmp_path: Path) -> None:
    NetworkMachine.world = World(tmp_path)
    machine = settings(
        max_examples=8, stateful_step_count=12, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )  # fmt: skip
    run_state_machine_as_test(NetworkMachine, settings=machine)
