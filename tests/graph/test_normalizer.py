"""Cumulative statistics against NumPy over everything seen."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.graph.normalizer import (
    MAX_UPDATES,
    init_normalizer,
    inverse,
    measure,
    merge,
    normalize,
    standard_deviation,
)


def batches(seed=0, sizes=(7, 1, 40, 3)):
    generator = np.random.default_rng(seed)
    scale, offset = np.array([1e-3, 1.0, 50.0]), np.array([5.0, 0.0, -1e3])
    return [generator.standard_normal((size, 3)) * scale + offset for size in sizes]


def accumulate(rows, dtype=jnp.float32):
    normalizer = init_normalizer(3, dtype)
    for batch in rows:
        normalizer = merge(normalizer, measure(jnp.asarray(batch, dtype)))
    return normalizer


def test_statistics_match_numpy():
    rows = batches()
    everything = np.concatenate(rows)
    normalizer = accumulate(rows)
    assert normalizer.count == len(everything)
    np.testing.assert_allclose(normalizer.mean, everything.mean(axis=0), rtol=1e-6, atol=0.1)
    # float32 rounds the first column, 5 +- 1e-3, to about 5e-7
    np.testing.assert_allclose(standard_deviation(normalizer), everything.std(axis=0), rtol=1e-3)


@pytest.mark.numerics
def test_statistics_match_numpy_in_float64():
    rows = batches()
    everything = np.concatenate(rows)
    with jax.enable_x64(True):
        normalizer = accumulate(rows, jnp.float64)
        np.testing.assert_allclose(normalizer.mean, everything.mean(axis=0), rtol=1e-10)
        np.testing.assert_allclose(standard_deviation(normalizer), everything.std(axis=0), rtol=1e-10)


def test_masked_rows_do_not_count_even_when_nan():
    rows = np.concatenate(batches())
    spoiled = np.concatenate([np.full((2, 3), np.nan), rows])
    masked = merge(
        init_normalizer(3), measure(jnp.asarray(spoiled, jnp.float32), jnp.arange(len(spoiled)) >= 2)
    )
    plain = merge(init_normalizer(3), measure(jnp.asarray(rows, jnp.float32)))
    for first, second in zip(jax.tree.leaves(masked), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-5)


def test_inverse_undoes_normalize():
    rows = jnp.asarray(np.concatenate(batches()), jnp.float32)
    normalizer = accumulate(batches())
    np.testing.assert_allclose(inverse(normalizer, normalize(normalizer, rows)), rows, rtol=1e-5, atol=1e-5)


def test_a_new_normalizer_changes_nothing():
    rows = jnp.ones((2, 3))
    np.testing.assert_array_equal(normalize(init_normalizer(3), rows), rows)


def test_a_constant_feature_normalizes_to_zero():
    normalizer = init_normalizer(1)
    for _ in range(3):
        normalizer = merge(normalizer, measure(jnp.full((11, 1), 1 / 30)))
    np.testing.assert_array_equal(normalize(normalizer, jnp.full((2, 1), 1 / 30)), jnp.zeros((2, 1)))


def test_many_updates_keep_their_precision():
    """A sum of squares in float32 would have lost the variance of 1 +- 1e-3 after a few thousand rows."""
    step = jax.jit(lambda state, rows: (merge(state, measure(rows)), None))
    generator = np.random.default_rng(0)
    rows = jnp.asarray(1 + 1e-3 * generator.standard_normal((400, 5000, 1)), jnp.float32)
    normalizer, _ = jax.lax.scan(step, init_normalizer(1), rows)
    expected = np.asarray(rows, np.float64).std()
    np.testing.assert_allclose(standard_deviation(normalizer)[0], expected, rtol=1e-3)


def test_statistics_freeze_after_the_last_update_and_ignore_empty_batches():
    full = init_normalizer(3).replace(num_updates=jnp.int32(MAX_UPDATES))
    assert merge(full, measure(jnp.ones((4, 3)))).count == 0
    assert merge(init_normalizer(3), measure(jnp.ones((4, 3)), jnp.zeros(4, bool))).num_updates == 0
