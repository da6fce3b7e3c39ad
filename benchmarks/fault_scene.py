"""What trials begin with, and what the networks that they leave are compared by."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import submin
from benchmarks.started import Command, submin_command
from orchestration.create import create, fit_catalogue
from submin.query.control_set import ControlSet
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import write_region

EVERYWHERE = (-180.0, -90.0, 180.0, 90.0)


@dataclass(frozen=True)
class Scene:
    """What every trial begins with.

    Attributes
    ----------
    folder : for networks and logs; catalogue : simulated; empty : network to copy
    batch_blocks, workers : of every run
    """

    folder: Path
    catalogue: Path
    empty: Path
    batch_blocks: int
    workers: int

    def network(self, name: str) -> Path:
        """A new copy of the empty network."""
        return Path(shutil.copytree(self.empty, self.folder / name))

    def run(self, network: Path | str, name: str, *where: object) -> Command:
        """``submin run``, started; on a local cluster unless told where."""
        return submin_command(
            "run", self.catalogue, network, "--batch-blocks", self.batch_blocks, "--json", *(where or ("--workers", self.workers)),
            log=self.folder / name,
        )  # fmt: skip


def make_scene(folder: Path, side_km: float, batch_blocks: int, workers: int) -> Scene:
    """A square region and an empty network over it."""
    write_region(simulate_region(RegionDesign(width_km=side_km, height_km=side_km)), folder / "catalogue")
    catalogue = Catalogue.open(folder / "catalogue")
    area, _, _ = fit_catalogue(catalogue)
    create(str(folder / "empty"), area, catalogue.metadata, 60.0, 20.0)
    return Scene(folder, folder / "catalogue", folder / "empty", batch_blocks, workers)


@dataclass(frozen=True, eq=False)
class Content:
    """What two networks are compared by: ledger, rays, the rigorous answer for all points, and what each tile answers alone."""

    ledger: tuple[tuple[object, ...], ...]
    rays: tuple[tuple[str, str, bool], ...]
    control: ControlSet
    tiles: tuple[ControlSet, ...]

    @classmethod
    def of(cls, network: Path | str) -> Content:
        """Of the newest version."""
        opened = submin.open(network)
        snapshot, rays = opened.snapshot, []
        images = snapshot.image_columns(["image_id"])["image_id"]
        for number in snapshot.cell_numbers():
            cell = snapshot.cell(number, with_sums=False)
            names = images[cell.images[cell.rays.image]]
            rays += list(zip(cell.point_ids[cell.rays.point].tolist(), names.tolist(), cell.rays.accepted.tolist(), strict=True))
        # rays_rejected is a block's count at its own version, before later blocks
        table = snapshot.ledger(["block_id", "content", "status", "images", "rays"])
        ledger = zip(*(column.tolist() for column in table.values()), strict=True)
        tiles = tuple(opened.query(tile=snapshot.cover.tile_name(tile)) for tile in snapshot.tile_numbers())
        return cls(tuple(sorted(ledger)), tuple(sorted(rays)), opened.query(bbox=EVERYWHERE, policy="rigorous"), tiles)

    def faults(self, other: Content) -> list[str]:
        """What is wrong with another network that should be the same."""
        found = []
        if self.ledger != other.ledger or len({row[0] for row in other.ledger}) < len(other.ledger):
            found.append("another ledger")
        if self.rays != other.rays or len({row[:2] for row in other.rays}) < len(other.rays):
            found.append("other rays")
        differences = self.differences(other)
        if np.isnan(differences).any():
            found.append("other points")
        elif not max(differences) <= 1e-9:
            found.append("another answer")
        return found

    def differences(self, other: Content) -> tuple[float, float]:
        """Largest difference of coordinates, in standard deviations, and of the covariance, as a correlation. NaN: other points."""
        if len(self.tiles) != len(other.tiles):
            return np.nan, np.nan
        pairs = zip((self.control, *self.tiles), (other.control, *other.tiles), strict=True)
        moved, spread = np.array([differences(one, another) for one, another in pairs]).max(axis=0)  # which keeps NaN
        return float(moved), float(spread)


def differences(one: ControlSet, other: ControlSet) -> tuple[float, float]:
    """As `Content.differences`, of two answers."""
    if one.ids.tolist() != other.ids.tolist():
        return np.nan, np.nan
    sigma = np.sqrt(np.diag(one.covariance))
    moved = np.abs(one.geocentric - other.geocentric).ravel() / sigma
    spread = np.abs(one.covariance - other.covariance) / sigma / sigma[:, None]
    return float(moved.max(initial=0.0)), float(spread.max(initial=0.0))
