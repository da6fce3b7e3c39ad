"""Covers of every kind for property tests, and places in them."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.geodesy import Ellipsoid
from submin.tiling.cover import ZONES, Cover

Array = NDArray[np.float64]

EXAMPLES = settings(max_examples=40, deadline=None, derandomize=True)
MILLIMETRES = 5e-3
"""PROJ's series for the authalic latitude brings a place of the plane back to a millimetre. Only the way to the plane decides on cells."""
MOON = Ellipsoid(1737400.0, 0.0)
CODES = ZONES**2
"""Codes of cells to a tile."""


@st.composite
def grids(draw: st.DrawFn) -> Cover:
    """Covers of up to five by five cores anywhere on the Earth, without overlap, with some, with nearly a core's."""
    core = draw(st.sampled_from([50.0, 3e3, 1e5]))
    return Cover(
        (draw(st.floats(-180.0, 180.0)), draw(st.floats(-90.0, 90.0))),
        (draw(st.floats(-3.0, 1.0)) * core, draw(st.floats(-3.0, 1.0)) * core),
        draw(st.integers(1, 5)), draw(st.integers(1, 5)), core, core * draw(st.sampled_from([0.0, 0.07, 0.1, 0.25, 1.0 / 3.0, 0.5, 0.97])),
    )  # fmt: skip


def splittable(cover: Cover, most: int = 4) -> list[int]:
    """Tiles that can be split, of cores that were halved less than ``most`` times."""
    return [tile for tile in cover.tiles() if cover.can_split(tile) and cover.side(tile) > 1.01 * cover.core / 2**most]


@st.composite
def covers(draw: st.DrawFn) -> Cover:
    """Grids of which up to eight tiles were split one after another: any tile, or a part of the one before."""
    cover = draw(grids())
    last: int | None = None
    for _ in range(draw(st.sampled_from([0, 1, 2, 3, 4, 6, 8]))):
        possible = splittable(cover)
        if last is not None and draw(st.booleans()):
            possible = [tile for tile in cover.quarters(last) if tile in possible] or possible
        if not possible:
            break
        last = draw(st.sampled_from(possible))
        cover = cover.split(last)
    return cover


@st.composite
def covers_to_split(draw: st.DrawFn) -> tuple[Cover, int]:
    """A cover and one of its tiles that can be split."""
    cover = draw(covers().filter(lambda cover: bool(splittable(cover, 5))))
    return cover, draw(st.sampled_from(splittable(cover, 5)))


def cores_of(cover: Cover) -> dict[int, tuple[float, float, float, float]]:
    """West, south, east, north of every core, from the grid and the splits alone: written out once more, by halving."""
    found: dict[int, tuple[float, float, float, float]] = {}

    def halve(tile: int, west: float, south: float, side: float) -> None:
        if tile not in cover.splits:
            found[tile] = west, south, west + side, south + side
            return
        for quarter, part in enumerate(cover.quarters(tile)):
            halve(part, west + (quarter % 2) * 0.5 * side, south + (quarter // 2) * 0.5 * side, 0.5 * side)

    for tile in range(cover.rows * cover.columns):
        row, column = divmod(tile, cover.columns)
        halve(tile, cover.origin[0] + column * cover.core, cover.origin[1] + row * cover.core, cover.core)
    return found


def near(a: float, b: float, cover: Cover) -> bool:
    return abs(a - b) < 1e-6 * cover.core


def outlines_of(cover: Cover, widen: float) -> tuple[NDArray[np.int64], Array]:
    """Numbers (t,) of all tiles and bounds (t, 4) of their cores, so much widened; those on the rim reach to infinity."""
    cores = cores_of(cover)
    rim = [*cover.origin, cover.origin[0] + cover.columns * cover.core, cover.origin[1] + cover.rows * cover.core]
    bounds = []
    for core in cores.values():
        wide = [core[0] - widen, core[1] - widen, core[2] + widen, core[3] + widen]
        bounds.append([(-np.inf if k < 2 else np.inf) if near(core[k], rim[k], cover) else wide[k] for k in range(4)])
    return np.array(list(cores)), np.array(bounds)


def tiles_at(cover: Cover, east: Array, north: Array, widen: float) -> list[list[int]]:
    """For each place of the plane the tiles, ascending, whose cores, so much widened, hold it."""
    tiles, bounds = outlines_of(cover, widen)
    inside = (bounds[:, 0] <= east[:, None]) & (east[:, None] < bounds[:, 2]) & (bounds[:, 1] <= north[:, None])
    inside &= north[:, None] < bounds[:, 3]
    return [sorted(tiles[row].tolist()) for row in inside]


def places(cover: Cover, seed: int, count: int = 200) -> tuple[Array, Array]:
    """Places (easting, northing) in and around a cover and its smallest tiles, none within a thousandth of a core (5 cm) of an outline."""
    rng = np.random.default_rng(seed)
    low, high = np.array(cover.origin), np.array(cover.origin) + cover.core * np.array([cover.columns, cover.rows])
    anywhere = rng.uniform(low - 1.5 * cover.core, high + 1.5 * cover.core, (4 * count, 2))
    cores = np.array(list(cores_of(cover).values()))
    small = cores[rng.integers(0, len(cores), 4 * count)]
    reach = 0.6 * cover.overlap
    about = rng.uniform(small[:, :2] - reach, small[:, 2:] + reach)
    both = np.stack([anywhere, about], axis=1).reshape(-1, 2)
    half, outline = 0.5 * cover.overlap, np.concatenate([cores[:, :2], cores[:, 2:]])
    lines = np.concatenate([outline, outline - half, outline + half])
    chosen = both[(np.abs(both[:, None] - lines[None]) > 1e-3 * cover.core).all(axis=(1, 2))][:count]
    assert len(chosen) == count
    return chosen[:, 0], chosen[:, 1]
