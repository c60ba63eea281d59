"""Running statistics against NumPy over everything seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.networks.normalizer import (
    MAX_UPDATES,
    WARMUP_UPDATES,
    init_normalizer,
    inverse,
    is_warming_up,
    measure,
    merge,
    normalize,
    standard_deviation,
)

add = jax.jit(lambda seen, rows: merge(seen, measure(rows)))


def batches(sizes=(7, 1, 40, 3)):
    generator = np.random.default_rng(0)
    scale, offset = np.array([1e-3, 1.0, 50.0]), np.array([5.0, 0.0, -1e3])
    return [generator.standard_normal((size, 3)) * scale + offset for size in sizes]


def accumulate(rows, dtype=jnp.float32):
    normalizer = init_normalizer(3, dtype)
    for batch in rows:
        normalizer = add(normalizer, jnp.asarray(batch, dtype))
    return normalizer


def test_statistics_match_numpy():
    rows = batches()
    everything = np.concatenate(rows)
    normalizer = accumulate(rows)
    assert normalizer.count == len(everything)
    assert normalizer.num_updates == len(rows)
    np.testing.assert_allclose(normalizer.mean, everything.mean(axis=0), rtol=1e-6, atol=0.1)
    # float32 rounds the first column, 5 +- 1e-3, to about 5e-7
    np.testing.assert_allclose(standard_deviation(normalizer), everything.std(axis=0), rtol=1e-3)


@pytest.mark.numerics
def test_statistics_match_numpy_in_float64():
    rows = batches((20, 20, 20))
    everything = np.concatenate(rows)
    with jax.enable_x64(True):
        normalizer = accumulate(rows, jnp.float64)
        np.testing.assert_allclose(normalizer.mean, everything.mean(axis=0), rtol=1e-10)
        np.testing.assert_allclose(standard_deviation(normalizer), everything.std(axis=0), rtol=1e-10)


def test_masked_rows_do_not_count_even_when_nan():
    rows = np.concatenate(batches())
    spoiled = np.concatenate([np.full((2, 3), np.nan), rows])
    masked = measure(jnp.asarray(spoiled, jnp.float32), jnp.arange(len(spoiled)) >= 2)
    plain = measure(jnp.asarray(rows, jnp.float32))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), masked, plain)


def test_inverse_undoes_normalize():
    rows = jnp.asarray(np.concatenate(batches()), jnp.float32)
    normalizer = measure(rows)
    np.testing.assert_allclose(inverse(normalizer, normalize(normalizer, rows)), rows, rtol=1e-5, atol=1e-5)


def test_a_new_normalizer_changes_nothing():
    rows = jnp.ones((2, 3))
    np.testing.assert_array_equal(normalize(init_normalizer(3), rows), rows)


def test_a_constant_feature_normalizes_to_zero():
    rows = jnp.full((11, 3), 1 / 30)
    normalizer = accumulate([rows, rows])
    np.testing.assert_array_equal(normalize(normalizer, rows), jnp.zeros_like(rows))


def test_many_updates_keep_their_precision():
    """A sum of squares in float32 would have lost the variance of 1 +- 1e-3 after a few thousand rows."""
    generator = np.random.default_rng(0)
    rows = jnp.asarray(1 + 1e-3 * generator.standard_normal((400, 5000, 1)), jnp.float32)
    normalizer, _ = jax.lax.scan(lambda seen, rows: (add(seen, rows), None), init_normalizer(1), rows)
    expected = np.asarray(rows, np.float64).std()
    np.testing.assert_allclose(standard_deviation(normalizer)[0], expected, rtol=1e-3)


def test_statistics_freeze_after_the_last_update_and_ignore_empty_batches():
    full = init_normalizer(3).replace(num_updates=jnp.int32(MAX_UPDATES))
    assert merge(full, measure(jnp.ones((4, 3)))).count == 0
    assert merge(init_normalizer(3), measure(jnp.ones((4, 3)), jnp.zeros(4, bool))).num_updates == 0


def test_warming_up_ends_with_the_hundredth_graph_even_without_a_body():
    graph = measure(jnp.ones((4, 3)))
    statistics = {"garment": init_normalizer(3), "world": init_normalizer(3)}
    statistics["garment"] = statistics["garment"].replace(num_updates=jnp.int32(WARMUP_UPDATES - 1))
    assert is_warming_up(statistics)
    statistics["garment"] = merge(statistics["garment"], graph)
    assert not is_warming_up(statistics)
    assert not is_warming_up({})
