"""Random numbers that belong to names: even, independent, and the same whoever asks."""

from __future__ import annotations

import numpy as np
import pytest

from submin.simulation.keyed_random import key_of, keyed_normal, keyed_uniform

COUNT = 200_000


def test_numbers_do_not_depend_on_who_asks() -> None:
    keys = np.arange(1000)
    whole = keyed_normal(3, "a", keys, 7)
    order = np.random.default_rng(0).permutation(1000)
    np.testing.assert_array_equal(keyed_normal(3, "a", keys[order], np.full(1000, 7))[np.argsort(order)], whole)
    np.testing.assert_array_equal(keyed_normal(3, "a", 500, 7), whole[500])


@pytest.mark.parametrize("keys", [np.arange(COUNT), np.arange(COUNT) << 32, key_of("image") - np.arange(COUNT).astype(np.uint64)])
def test_neighbouring_keys_give_independent_numbers(keys: np.ndarray) -> None:
    uniform, normal = keyed_uniform(1, "u", keys), keyed_normal(1, "n", keys)
    assert uniform.min() >= 0.0 and uniform.max() < 1.0
    counts = np.histogram(uniform, 100, (0.0, 1.0))[0]
    assert ((counts - COUNT / 100) ** 2 / (COUNT / 100)).sum() < 160.0  # chi-square of 99, one in 10,000
    every = np.column_stack([uniform, normal, np.roll(uniform, 1), np.roll(normal, 1, axis=0), np.roll(uniform, 2)])
    apart = np.corrcoef(every.T) - np.eye(every.shape[1])
    assert np.abs(apart).max() < 5.0 / np.sqrt(COUNT)
    np.testing.assert_allclose(normal.mean(axis=0), 0.0, atol=5.0 / np.sqrt(COUNT))
    np.testing.assert_allclose((normal**2).mean(axis=0), 1.0, atol=5.0 * np.sqrt(2.0 / COUNT))
    np.testing.assert_allclose((normal**4).mean(axis=0), 3.0, atol=5.0 * np.sqrt(96.0 / COUNT))


def test_seed_stream_and_each_key_count() -> None:
    keys = np.arange(COUNT // 10)
    drawn = [keyed_uniform(s, stream, keys, k) for s in (0, 1) for stream in ("a", "b") for k in (0, 1)]
    drawn.append(keyed_uniform(0, "a", 0, keys))
    assert np.abs(np.corrcoef(np.stack(drawn)) - np.eye(len(drawn))).max() < 5.0 / np.sqrt(len(keys))
