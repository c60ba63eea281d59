"""The polynomial that stands for atan2 in float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.numerics import arctan2


def test_arctan2_matches_numpy_around_the_circle():
    angle = np.linspace(-np.pi, np.pi, 40_001)
    for radius in (1e-12, 1.0, 1e12):
        y, x = np.float32(radius * np.sin(angle)), np.float32(radius * np.cos(angle))
        expected = np.arctan2(y.astype(np.float64), x.astype(np.float64))
        # Two units in the last place of pi are 5e-7.
        np.testing.assert_allclose(arctan2(jnp.asarray(y), jnp.asarray(x)), expected, atol=5e-7)


def test_arctan2_is_relatively_exact_for_small_angles():
    y = np.float32(np.logspace(-20, -1, 200))
    np.testing.assert_allclose(arctan2(jnp.asarray(y), jnp.ones(200)), np.arctan2(y, 1), rtol=4e-7)


@pytest.mark.parametrize(
    ("y", "x", "expected"),
    [(0, 1, 0), (0, -1, np.pi), (1, 0, np.pi / 2), (-1, 0, -np.pi / 2), (0, 0, 0), (1, 1, np.pi / 4)],
)
def test_arctan2_on_the_axes(y, x, expected):
    np.testing.assert_allclose(arctan2(jnp.float32(y), jnp.float32(x)), expected, atol=3e-7)


def test_arctan2_calls_the_library_in_float64():
    angle = np.linspace(-np.pi, np.pi, 1001)
    with jax.enable_x64(True):
        found = np.asarray(arctan2(jnp.sin(angle), jnp.cos(angle)))
    np.testing.assert_allclose(found[1:-1], angle[1:-1], atol=1e-14)


def test_arctan2_has_the_exact_gradient_and_none_at_the_origin():
    gradient = jax.grad(arctan2, argnums=(0, 1))
    for y, x in ((0.3, 0.4), (-2.0, 0.1), (1e-6, -1.0)):
        squared = x * x + y * y
        np.testing.assert_allclose(gradient(y, x), (x / squared, -y / squared), rtol=1e-6)
    assert gradient(0.0, 0.0) == (0.0, 0.0)
