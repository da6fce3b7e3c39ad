"""Names of tiles and cells, and the description of a cover, come back as what they name."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from covers import EXAMPLES, MOON, covers
from hypothesis import given
from shapely.geometry import box

from submin.errors import InputError
from submin.tiling.area import cover_area
from submin.tiling.cover import Cover


@EXAMPLES
@given(covers())
def test_names_come_back_as_numbers(cover: Cover) -> None:
    names = [cover.tile_name(tile) for tile in cover.tiles()]
    assert len(set(names)) == len(names)
    assert [cover.tile_number(name) for name in names] == list(cover.tiles())
    cells = [cell for tile in cover.tiles() for cell in cover.cells_owned(tile)]
    cell_names = [cover.cell_name(cell) for cell in cells]
    assert len(set(cell_names)) == len(cell_names)
    assert [cover.cell_number(name) for name in cell_names] == cells
    for cell, name in zip(cells, cell_names, strict=True):
        owner, *others = (cover.tile_number(part) for part in name.split("+"))
        assert owner == Cover.owner(cell)
        assert others == [tile for tile in cover.holders(cell) if tile != owner]


@EXAMPLES
@given(covers())
def test_a_split_tile_is_refused_with_its_parts_named(cover: Cover) -> None:
    for tile in cover.splits:
        name = cover.tile_name(tile)
        parts = [cover.tile_name(part) for part in cover.quarters(tile)]
        assert parts == [f"{name}{q}" if "q" in name else f"{name}q{q}" for q in range(4)]
        words = f"tile is '{name}', which was split; expected one of its parts {', '.join(parts)}$"
        for refused in (cover.tile_number, cover.cell_number):
            with pytest.raises(InputError, match=words):
                refused(name)
    for tile in cover.tiles():
        for part in cover.quarters(tile):
            with pytest.raises(InputError, match=f"tile is '{cover.tile_name(part)}'; expected a name .*, or of a part of a split one"):
                cover.tile_number(cover.tile_name(part))


def test_quarters_are_named_from_the_south_west() -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 3, 4, 100.0, 1.0).split(6)
    assert [cover.tile_name(tile) for tile in cover.quarters(6)] == ["r001c002q0", "r001c002q1", "r001c002q2", "r001c002q3"]
    cover = cover.split(cover.quarters(6)[2])
    assert [cover.tile_name(tile) for tile in cover.quarters(cover.quarters(6)[2])] == [f"r001c002q2{q}" for q in range(4)]
    at = cover.geographic(np.array([210.0, 240.0, 210.0, 240.0, 275.0]), np.array([160.0, 160.0, 190.0, 190.0, 175.0]))
    owners = [cover.tile_name(Cover.owner(cell)) for cell in cover.cells_of(*at)]
    assert owners == ["r001c002q20", "r001c002q21", "r001c002q22", "r001c002q23", "r001c002q3"]


def test_unknown_cells_are_named_with_those_of_their_owner() -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 1, 2, 100.0, 10.0)
    for name in ("r000c000+r000c000", "r000c000+r000c001+r000c001", "r000c000-c", "r000c000+"):
        with pytest.raises(InputError):
            cover.cell_number(name)
    with pytest.raises(InputError, match=r"cell is 'r000c000\+r001c000'; expected one of r000c000, r000c000\+r000c001$"):
        cover.cell_number("r000c000+r001c000")
    # the owner comes first
    assert cover.cell_number("r000c001+r000c000") != cover.cell_number("r000c000+r000c001")


def test_names_beyond_a_thousand_rows() -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 1200, 3, 10.0, 1.0)
    assert cover.tile_name(3 * 1100 + 2) == "r1100c002"
    assert cover.tile_number("r1100c002") == 3 * 1100 + 2


@pytest.mark.parametrize(
    "name",
    ["r003c000", "r000c004", "r0c0", "x", "", "r000c000-c", "R000c000", "r-01c000", "r0000c000", "r000c000q", "r000c000q0",
     "r000c001q4", "r000c001q00", "r000c001q0q0", "r000c000+r000c001"],
)  # fmt: skip
def test_unknown_tiles_are_named_with_what_there_is(name: str) -> None:
    cover = Cover((0.0, 0.0), (0.0, 0.0), 3, 4, 10.0, 1.0).split(1)
    with pytest.raises(InputError, match=re.escape(f"tile is {name!r}; expected a name from r000c000 to r002c003, or of a part")):
        cover.tile_number(name)


@EXAMPLES
@given(covers())
def test_description_is_plain_and_comes_back(cover: Cover) -> None:
    back = Cover.from_mapping(json.loads(json.dumps(cover.to_mapping())))
    assert back == cover and hash(back) == hash(cover)
    assert back.splits == cover.splits and list(back.tiles()) == list(cover.tiles())
    assert cover == replace(cover) and (not cover.splits or cover != replace(cover, splits=()))


def test_description_keeps_the_body() -> None:
    cover = cover_area(box(3.0, 25.0, 4.0, 26.0), 5e3, 1e3, MOON)
    assert Cover.from_mapping(json.loads(json.dumps(cover.to_mapping()))).ellipsoid == MOON
