"""Records, growing tables and hashes of ids, as they lie in a Zarr store."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.errors import StoreError
from submin.storage.arrays import (
    append_table,
    array_of,
    create_table,
    decode_text,
    encode_text,
    existing_groups,
    group_of,
    hash_ids,
    member_names,
    read_record,
    read_records,
    read_spans,
    read_table,
    replace_table,
    set_rows,
    table_length,
    write_record,
)

AnyArray = NDArray[Any]

EXAMPLES = settings(max_examples=20, deadline=None, derandomize=True)
# numpy's texts of fixed width cannot end in NUL, and lone surrogates are no UTF-8
TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
TEXTS = st.lists(TEXT, max_size=20).map(lambda texts: np.array(texts, dtype=np.str_))
UNICODE = np.array(["JAX_068/17", "", "žluťoučký kůň", "点", "🛰️ 5", "a" * 300, "x y\tz\n"])


def root() -> zarr.Group:
    return zarr.create_group(zarr.storage.MemoryStore())


def assert_same(found: dict[str, AnyArray], expected: dict[str, AnyArray]) -> None:
    assert set(found) == set(expected)
    for name, values in expected.items():
        assert found[name].shape == values.shape
        np.testing.assert_array_equal(found[name], values)


# Texts


@EXAMPLES
@given(TEXTS)
def test_texts_come_back(texts: NDArray[np.str_]) -> None:
    data, ends = encode_text(texts)
    assert data.dtype == np.uint8 and len(ends) == len(texts)
    np.testing.assert_array_equal(decode_text(data, ends), texts)


def test_texts_are_utf8_one_after_another() -> None:
    data, ends = encode_text(np.array(["a", "", "é", "点"]))
    assert bytes(data) == "aé点".encode()
    np.testing.assert_array_equal(ends, [1, 1, 3, 6])


@pytest.mark.parametrize("texts", [UNICODE, UNICODE[::2], UNICODE[3:5], np.array(["", "", ""]), np.array([], dtype="U1")])
def test_texts_of_any_layout_come_back(texts: NDArray[np.str_]) -> None:
    np.testing.assert_array_equal(decode_text(*encode_text(texts)), texts)


# Records


def parts() -> dict[str, AnyArray]:
    rng = np.random.default_rng(1)
    return {
        "ids": UNICODE,
        "positions": rng.normal(0.0, 1e7, (7, 3)),
        "flags": np.array([True, False, True]),
        "rows": np.array([[1, 2], [3, -(2**40)]], dtype=np.int64),
        "small": np.array([7, 8], dtype=np.int32),
        "special": np.array([np.nan, np.inf, -0.0, 5e-324]),
        "none": np.empty((0, 3)),
        "no columns": np.empty((4, 0)),
        "no rows": np.empty(0, dtype=np.int32),
        "no names": np.empty(0, dtype="U1"),
        "blank names": np.array(["", ""]),
        "more ids": np.array(["ü", "b"]),
    }


def test_record_comes_back_whole() -> None:
    group = root()
    write_record(group, "cell", parts(), {"number": 5})
    found = read_record(group_of(group, "cell"))
    assert_same(found, parts())
    assert np.signbit(found["special"][2])
    assert found["flags"].dtype == found["small"].dtype == np.int64
    assert group_of(group, "cell").attrs["number"] == 5


@pytest.mark.parametrize(
    "wanted", [["ids"], ["positions"], ["more ids", "rows"], ["none"], ["no names", "special"], ["flags", "ids", "no rows"], []]
)
def test_only_what_is_wanted_is_read(wanted: list[str]) -> None:
    group = root()
    write_record(group, "cell", parts())
    assert_same(read_record(group_of(group, "cell"), wanted), {name: parts()[name] for name in wanted})


def test_record_has_at_most_one_array() -> None:
    group = root()
    write_record(group, "cell", parts())
    assert sorted(group_of(group, "cell").array_keys()) == ["data"]
    write_record(group, "empty", {"none": np.empty((0, 3)), "ids": np.empty(0, dtype="U1")})
    assert list(group_of(group, "empty").array_keys()) == []
    assert_same(read_record(group_of(group, "empty")), {"none": np.empty((0, 3)), "ids": np.empty(0, dtype="U1")})


def test_record_replaces_the_one_before() -> None:
    group = root()
    write_record(group, "cell", parts(), {"number": 5})
    smaller = {"ids": np.array(["z"]), "other": np.array([1.5])}
    write_record(group, "cell", smaller, {"version": 6})
    assert_same(read_record(group_of(group, "cell")), smaller)
    assert "number" not in group_of(group, "cell").attrs


@EXAMPLES
@given(
    TEXTS, TEXTS, st.lists(st.floats(allow_nan=False), max_size=10), st.lists(st.integers(-(2**63), 2**63 - 1), max_size=10),
    st.sets(st.sampled_from(["a", "b", "real", "whole"])),
)  # fmt: skip
def test_any_record_comes_back_in_any_parts(
    first: NDArray[np.str_], second: NDArray[np.str_], reals: list[float], whole: list[int], wanted: set[str]
) -> None:
    group = root()
    content: dict[str, AnyArray] = {"a": first, "real": np.array(reals), "whole": np.array(whole, dtype=np.int64), "b": second}
    write_record(group, "r", content)
    assert_same(read_record(group_of(group, "r"), wanted), {name: content[name] for name in wanted})


def test_large_record_spans_chunks() -> None:
    rng = np.random.default_rng(2)
    content: dict[str, AnyArray] = {"x": rng.normal(size=(150_000, 2)), "y": rng.normal(size=77), "n": np.arange(200_000)}
    group = root()
    write_record(group, "r", content)
    assert_same(read_record(group_of(group, "r"), ["y"]), {"y": content["y"]})
    assert_same(read_record(group_of(group, "r")), content)


@pytest.mark.parametrize("read", [lambda g: group_of(g, "cell"), lambda g: array_of(g, "cell"), lambda g: group_of(g, "array")])
def test_damage_is_named(read: Any) -> None:
    group = root()
    group.create_array("array", shape=(1,), dtype="float64")
    with pytest.raises(StoreError, match="damaged"):
        read(group)


# Tables

COLUMNS = {"name": "text", "value": "float64", "note": "text", "count": "int64", "hash": "uint64", "flag": "uint8"}


def rows(count: int, seed: int = 1) -> dict[str, AnyArray]:
    rng = np.random.default_rng(seed)
    return {
        "name": np.array([f"{UNICODE[rng.integers(len(UNICODE))]}{k}" for k in range(count)], dtype=np.str_),
        "value": rng.normal(size=count),
        "note": np.array(["" if rng.uniform() < 0.5 else "öä" for _ in range(count)], dtype=np.str_),
        "count": rng.integers(-9, 9, count),
        "hash": rng.integers(0, 2**64 - 1, count, dtype=np.uint64),
        "flag": rng.integers(0, 2, count).astype(np.uint8),
    }


def cut(content: dict[str, AnyArray], start: int | None, stop: int | None) -> dict[str, AnyArray]:
    return {name: values[start:stop] for name, values in content.items()}


def filled(content: dict[str, AnyArray], pieces: list[int]) -> zarr.Group:
    """A table of small chunks, so that most spans of it are of several."""
    table = create_table(root(), "table", COLUMNS, rows=4, letters=16)
    for start, stop in zip([0, *pieces], [*pieces, None], strict=True):
        append_table(table, cut(content, start, stop))
    return table


def test_new_table_is_empty() -> None:
    table = create_table(root(), "table", COLUMNS)
    assert table_length(table) == 0
    found = read_table(table)
    assert {name: len(values) for name, values in found.items()} == dict.fromkeys(COLUMNS, 0)


@EXAMPLES
@given(st.integers(0, 25), st.lists(st.integers(0, 25), max_size=4), st.integers(0, 2**32 - 1))
def test_table_grown_in_pieces_is_the_whole(count: int, pieces: list[int], seed: int) -> None:
    content = rows(count, seed)
    table = filled(content, sorted(min(piece, count) for piece in pieces))
    assert table_length(table) == count
    assert_same(read_table(table), content)


@EXAMPLES
@given(st.integers(0, 12), st.one_of(st.none(), st.integers(0, 12)))
def test_some_rows_of_a_table(start: int, stop: int | None) -> None:
    content = rows(10)
    table = filled(content, [3, 3, 8])
    assert_same(read_table(table, None, start, stop), cut(content, start, stop))
    assert_same(read_table(table, ["note", "hash"], start, stop), {k: v[start:stop] for k, v in content.items() if k in ("note", "hash")})


def test_first_column_need_not_be_text() -> None:
    table = create_table(root(), "directory", {"hash": "uint64", "cell": "int64"})
    append_table(table, {"cell": np.array([1, 2, 3]), "hash": np.array([9, 8, 2**64 - 1], dtype=np.uint64)})
    assert table_length(table) == 3
    np.testing.assert_array_equal(read_table(table)["hash"], np.array([9, 8, 2**64 - 1], dtype=np.uint64))


@pytest.mark.parametrize("change", [lambda c: {k: v for k, v in c.items() if k != "note"}, lambda c: c | {"other": np.arange(3)}])
def test_every_column_must_be_given(change: Any) -> None:
    table = filled(rows(2), [])
    with pytest.raises(ValueError, match="columns are .*; expected"):
        append_table(table, change(rows(3)))
    assert table_length(table) == 2


def test_rows_can_be_changed() -> None:
    content = rows(10)
    table = filled(content, [4])
    set_rows(table, "flag", np.array([1, 7]), np.array([5, 6], dtype=np.uint8))
    set_rows(table, "flag", np.array([], dtype=np.int64), np.array([], dtype=np.uint8))
    content["flag"][[1, 7]] = [5, 6]
    assert_same(read_table(table), content)


@pytest.mark.parametrize("count", [0, 2, 30])
def test_rows_can_be_replaced(count: int) -> None:
    table = create_table(root(), "flags", {"tile": "int64", "image": "int64"})
    append_table(table, {"tile": np.arange(10), "image": np.arange(10)})
    replace_table(table, {"tile": np.arange(count) + 5, "image": np.arange(count) * 2})
    assert table_length(table) == count
    assert_same(read_table(table), {"tile": np.arange(count) + 5, "image": np.arange(count) * 2})


# Hashes


def fnv1a(text: str) -> int:
    """64-bit FNV-1a, letter by letter (Fowler, Noll, Vo; RFC 9923)."""
    value = 0xCBF29CE484222325
    for byte in text.encode():
        value = ((value ^ byte) * 0x100000001B3) % 2**64
    return value


def test_published_hashes() -> None:
    published = {"": 0xCBF29CE484222325, "a": 0xAF63DC4C8601EC8C, "foobar": 0x85944171F73967E8}
    assert {text: fnv1a(text) for text in published} == published
    assert hash_ids(np.array(list(published))).tolist() == list(published.values())


@EXAMPLES
@given(TEXTS)
def test_hashes_are_those_of_plain_python(texts: NDArray[np.str_]) -> None:
    found = hash_ids(texts)
    assert found.dtype == np.uint64
    assert found.tolist() == [fnv1a(str(text)) for text in texts]


@pytest.mark.parametrize("texts", [UNICODE, UNICODE[::2], UNICODE[::-1], np.array(["", ""]), np.array(["only"])])
def test_hash_of_an_id_does_not_depend_on_its_company(texts: NDArray[np.str_]) -> None:
    assert hash_ids(texts).tolist() == [fnv1a(str(text)) for text in texts]
    for text in texts:
        assert hash_ids(np.array([text])).tolist() == [fnv1a(str(text))]


# Side by side


def test_records_are_read_side_by_side_and_missing_ones_told() -> None:
    parent = root().create_group("cells")
    for k in range(5):
        write_record(parent, f"c{k}", {"ids": np.array([f"p{k}", "q"]), "values": np.full(k, 0.5), "count": np.arange(3)}, {"number": k})
    names = ["c3", "none", "c0", "c4"]
    found = read_records(parent, names)
    assert [record is None for record in found] == [False, True, False, False]
    for name, record in zip(names, found, strict=True):
        if record is not None:
            assert_same(dict(record.parts), read_record(group_of(parent, name)))
            assert record.attributes["number"] == int(name[1:])
    (some,) = read_records(parent, ["c3"], ["ids"])
    assert some is not None and set(some.parts) == {"ids"}
    assert existing_groups(parent, names) == [True, False, True, True]
    assert member_names(parent) == [f"c{k}" for k in range(5)]
    assert read_records(parent, []) == [] and existing_groups(parent, []) == []


def test_a_record_that_is_an_array_is_damage() -> None:
    parent = root()
    parent.create_array("c0", data=np.arange(3))
    with pytest.raises(StoreError, match="has an array 'c0'"):
        read_records(parent, ["c0"])


def test_spans_are_what_each_by_itself_is() -> None:
    table = create_table(root(), "images", {"name": "text", "value": "float64"})
    append_table(table, {"name": np.array([f"n{k}" * (k % 4) for k in range(50)]), "value": np.arange(50.0)})
    spans: list[tuple[int, int | None]] = [(0, 3), (7, 8), (40, None), (12, 12), (48, 60)]
    for span, found in zip(spans, read_spans(table, ["value", "name"], spans), strict=True):
        assert_same(found, read_table(table, ["value", "name"], *span))
        assert_same(found, {name: values[span[0] : span[1]] for name, values in read_table(table).items()})
