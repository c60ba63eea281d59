"""Random features against exact attention, in NumPy."""

import jax.numpy as jnp
import numpy as np
from reference_models import exact_attention

from eslr_jax.networks.attention import (
    linear_attention,
    orthogonal_projection,
    relu_features,
    softmax_features,
)

ROWS, SIZE, WIDTH = 200, 16, 6


def draw(scale, seed=0):
    generator = np.random.default_rng(seed)
    q, k = (scale * generator.standard_normal((ROWS, SIZE)) for _ in range(2))
    return q, k, generator.standard_normal((ROWS, WIDTH))


def attend(q, k, v, num_features, seed=0, mask=None):
    projection = orthogonal_projection(num_features, SIZE, seed)
    q, k, v, projection = (jnp.asarray(array, jnp.float32) for array in (q, k, v, projection))
    return np.asarray(linear_attention(*softmax_features(q, k, projection, mask), v, mask))


def error(num_features):
    q, k, v = draw(0.3)
    exact = exact_attention(q, k, v)
    runs = [attend(q, k, v, num_features, seed) - exact for seed in range(3)]
    return np.mean([np.linalg.norm(run) for run in runs]) / np.linalg.norm(exact)


def test_error_falls_with_features():
    errors = [error(count) for count in (16, 64, 256)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.1


def test_linear_attention_matches_its_kernel_written_as_a_matrix():
    q, k, v = draw(0.5)
    projection = orthogonal_projection(32, SIZE, 0)
    q_features, k_features = (np.maximum(x @ projection.T, 0) + 1e-3 for x in (q, k))
    kernel = q_features @ k_features.T
    expected = kernel / kernel.sum(axis=1, keepdims=True) @ v
    q, k, v, projection = (jnp.asarray(array, jnp.float32) for array in (q, k, v, projection))
    actual = linear_attention(*relu_features(q, k, projection), v)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_weights_do_not_collapse_to_the_mean():
    """A largest exponent per key, or a large epsilon, would give every key about the same weight."""
    q, k, v = draw(0.3)
    exact = exact_attention(q, k, v)
    spread = np.linalg.norm(exact - v.mean(axis=0, keepdims=True))
    assert np.linalg.norm(attend(q, k, v, 512) - exact) < 0.5 * spread


def test_huge_queries_and_keys_stay_finite():
    q, k, v = draw(50.0)
    assert np.isfinite(attend(q, k, v, 64)).all()


def test_masked_rows_change_nothing():
    q, k, v = draw(0.5)
    mask = jnp.arange(ROWS) < 150
    spoiled = np.where(np.arange(ROWS)[:, None] < 150, v, 1e6)
    first, second = (attend(q, k, rows, 64, mask=mask)[:150] for rows in (v, spoiled))
    np.testing.assert_allclose(first, second, atol=1e-6)
    loud = np.where(np.arange(ROWS)[:, None] < 150, k, 20 * k)  # their exponents are the largest of all
    np.testing.assert_allclose(attend(q, loud, v, 64, mask=mask)[:150], first, atol=1e-6)


def test_directions_are_orthogonal_seeded_and_as_long_as_gaussian_vectors():
    projection = orthogonal_projection(SIZE, SIZE, 3)
    gram = projection @ projection.T
    np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0, atol=1e-12)
    np.testing.assert_array_equal(projection, orthogonal_projection(SIZE, SIZE, 3))
    assert not np.allclose(projection, orthogonal_projection(SIZE, SIZE, 4))
    lengths = np.linalg.norm(orthogonal_projection(40 * SIZE, SIZE, 0), axis=1)
    np.testing.assert_allclose(np.mean(lengths**2), SIZE, rtol=0.05)
