"""One side of an exchange of networks between Pythons: ``python interchange.py write|read|continue FOLDER``.

``write`` makes a network of half of a region's blocks and notes what it answers; ``read`` opens the network and answers as was noted;
``continue`` fuses the other half into it and notes the new answer.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from networks import SMALL, area_of, fuse, rewrite

import submin
from submin.simulation.region import simulate_region
from submin.storage.catalogue import Catalogue
from submin.storage.simulated import write_region

EVERYWHERE = (90.0, 30.0, 110.0, 40.0)


def note(folder: Path) -> None:
    """Note the answer for all points."""
    found = submin.open(folder / "network").query(bbox=EVERYWHERE, policy="rigorous")
    np.savez(folder / "noted.npz", version=found.version, ids=found.ids, geocentric=found.geocentric, covariance=found.covariance)


def write(folder: Path) -> None:
    """Half of the blocks into a new network."""
    region = simulate_region(SMALL)
    write_region(region, folder / "catalogue")
    half = rewrite(folder / "catalogue", folder / "half", list(Catalogue.open(folder / "catalogue").blocks())[:6])
    assert fuse(half, folder / "network", area_of(region)).fused == 6
    note(folder)


def read(folder: Path) -> None:
    """The same answer as was noted, to the last digits of another build of the same arithmetic."""
    noted = np.load(folder / "noted.npz")
    found = submin.open(folder / "network").query(bbox=EVERYWHERE, policy="rigorous")
    assert found.version == str(noted["version"])
    assert found.ids.tolist() == noted["ids"].tolist()
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.abs((found.geocentric - noted["geocentric"]).ravel() / sigma).max() < 1e-9
    assert (np.abs(found.covariance - noted["covariance"]) / sigma / sigma[:, None]).max() < 1e-9


def go_on(folder: Path) -> None:
    """The other half of the blocks into a network that is there."""
    result = fuse(folder / "catalogue", folder / "network", area_of(simulate_region(SMALL)))
    assert (result.fused, result.skipped, result.rejected) == (6, 6, ())
    note(folder)


if __name__ == "__main__":
    {"write": write, "read": read, "continue": go_on}[sys.argv[1]](Path(sys.argv[2]))
