"""Symmetric matrices about images: the compiled kernels against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment import symmetric
from submin.adjustment.symmetric import add_into, add_packed, between, fill_symmetric, packed, permuted, taken, unpacked

P = 3


def lower_of(images: int, seed: int = 0) -> NDArray[np.float64]:
    return np.tril(np.random.default_rng(seed).normal(size=(images * P, images * P)))


def rows_of(images: NDArray[np.integer]) -> NDArray[np.int64]:
    return np.asarray((images[:, None] * P + np.arange(P)).ravel(), dtype=np.int64)


@pytest.mark.parametrize("images", [0, 1, 2, 9])
def test_permuted_images(images: int) -> None:
    lower, order = lower_of(images), np.random.default_rng(images).permutation(images)
    rows = rows_of(order)
    expected = fill_symmetric(lower.copy())[np.ix_(rows, rows)]
    found = permuted(lower, order, P)
    np.testing.assert_array_equal(found, np.tril(expected))


@pytest.mark.parametrize("weight", [1.0, 0.3])
def test_added_at_the_rows_of_their_images(weight: float) -> None:
    total, part, at = lower_of(7), lower_of(3, 1), np.array([0, 2, 6])
    expected, rows = total.copy(), rows_of(at)
    expected[np.ix_(rows, rows)] += weight * part
    add_into(total, part, at, P, weight)
    np.testing.assert_array_equal(total, expected)


@pytest.mark.parametrize("sparse", [True, False])
@pytest.mark.parametrize("transposed", [True, False])
def test_products_from_both_sides(monkeypatch: pytest.MonkeyPatch, sparse: bool, transposed: bool) -> None:
    if sparse:
        monkeypatch.setattr(symmetric, "DENSE_SIZE", 0)
        monkeypatch.setattr(symmetric, "DENSE_PART", 1.0)
    rng = np.random.default_rng(4)
    factor = sp.random_array((21, 15), density=0.2, rng=rng, format="csr")
    size = factor.shape[0 if transposed else 1]
    full = fill_symmetric(rng.normal(size=(size, size)))
    dense = factor.toarray().T if transposed else factor.toarray()
    found = between(factor, full, transposed=transposed)
    np.testing.assert_allclose(found, dense @ full @ dense.T, rtol=0.0, atol=1e-13)
    np.testing.assert_array_equal(found, found.T)


def test_a_triangle_in_the_order_of_lapack_is_filled_too() -> None:
    lower = np.asfortranarray(lower_of(50))
    lower[np.triu_indices(150, 1)] = np.nan  # LAPACK leaves it undefined
    found = fill_symmetric(lower)
    np.testing.assert_array_equal(found, np.tril(lower) + np.tril(lower, -1).T)


@pytest.mark.parametrize("size", [0, 1, 2, 3, 50, 600])
def test_packed_triangle_comes_back(size: int) -> None:
    lower = np.tril(np.random.default_rng(size).normal(size=(size, size)))
    values = packed(lower)
    assert values.shape == (size * (size + 1) // 2,)
    np.testing.assert_array_equal(unpacked(values), lower)


def test_packed_triangle_added_and_taken_in_any_order() -> None:
    rng = np.random.default_rng(5)
    part, total = np.tril(rng.normal(size=(4, 4))), np.tril(rng.normal(size=(7, 7)))
    at = np.array([5, 0, 6, 2])
    expected = fill_symmetric(total.copy())
    expected[np.ix_(at, at)] += fill_symmetric(part.copy())
    add_packed(total, packed(part), at)
    np.testing.assert_allclose(fill_symmetric(total.copy()), expected, rtol=1e-15)
    np.testing.assert_array_equal(taken(packed(total), at), fill_symmetric(total.copy())[np.ix_(at, at)])
