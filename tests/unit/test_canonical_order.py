"""The canonical order of rays: by point, image, then what was observed, however it is found; and ids numbered as texts sort."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from submin.adjustment.rays import canonical_order
from submin.network.id_hash import hash_ids
from submin.network.id_numbers import LETTERS, numbered


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.integers(1, 8), st.integers(1, 8))
def test_the_order_is_that_of_a_sort_by_each_column(seed: int, rays: int, points: int, images: int) -> None:
    """Few points and images: pairs come twice, and columns that are equal decide by the next."""
    rng = np.random.default_rng(seed)
    point, image = rng.integers(0, points, rays, dtype=np.int32), rng.integers(0, images, rays, dtype=np.int32)
    observed = rng.integers(0, 3, (rays, 2)).astype(np.float64)
    order = canonical_order(point, image, observed)
    assert sorted(order.tolist()) == list(range(rays))
    columns = np.column_stack([point, image, observed])
    assert columns[order].tolist() == sorted(columns.tolist())


def test_rays_in_order_stay_where_they_are() -> None:
    point, image = np.repeat(np.arange(4, dtype=np.int32), 3), np.tile(np.arange(3, dtype=np.int32), 4)
    assert canonical_order(point, image, np.zeros((12, 2))).tolist() == list(range(12))
    turned = np.arange(12)[::-1]
    assert canonical_order(point[turned], image[turned], np.zeros((12, 2))).tolist() == turned.tolist()


@pytest.mark.parametrize("letters", [1, 7, 8, 9, 16, 17, LETTERS, LETTERS + 1])
@pytest.mark.parametrize("alphabet", ["ab", "aé", "0123456789"])
def test_ids_of_any_length_are_numbered_as_texts_sort(letters: int, alphabet: str) -> None:
    """Around the lengths at which another word begins, in letters of one byte and of more, with a common beginning and without."""
    rng = np.random.default_rng(letters)
    for begin in ("", "P-"):
        texts = np.array([
            (begin + "".join(rng.choice(list(alphabet), rng.integers(1, letters + 1))))[:letters] for _ in range(300)
        ])  # fmt: skip
        expected, place = np.unique(texts, return_inverse=True)
        found, at = numbered(texts)
        assert found.tolist() == expected.tolist()
        assert at.tolist() == place.tolist()


def test_hash_of_letters_of_one_byte_is_that_of_the_same_id_beside_others() -> None:
    plain = np.array(["a", "P0001", "a-longer-id"])
    assert hash_ids(plain).tolist() == hash_ids(np.append(plain, "é"))[:3].tolist()
