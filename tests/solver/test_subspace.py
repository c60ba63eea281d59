"""The step in a span: exact on quadratics, never uphill, and harmless where there is nothing to gain."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.fabric.materials import COTTON
from eslr_jax.solver.potential import Point
from eslr_jax.solver.subspace import combine_directions
from eslr_jax.terms.stretch import stretch_energy


@partial(jax.jit, static_argnums=0)
def combine(function, position, directions):
    return combine_directions(function, Point(position, *jax.value_and_grad(function)(position)), directions)


def make_quadratic(count=5, seed=0):
    random = np.random.default_rng(seed)
    root = random.standard_normal((3 * count, 3 * count))
    center = random.standard_normal((count, 3))
    directions = random.standard_normal((3, count, 3)) * np.array([1e-3, 1.0, 30.0])[:, None, None]

    def function(x):
        offset = root @ (x - center).ravel()
        return 0.5 * offset @ offset

    return function, jnp.zeros((count, 3)), jnp.asarray(directions)


def test_a_quadratic_is_minimised_in_the_span_whatever_the_lengths_of_the_directions():
    with jax.enable_x64(True):
        function, position, directions = make_quadratic()
        move = combine(function, position, directions)
        slopes = jnp.einsum("kij,ij->k", directions, jax.grad(function)(position + move))
        before = jnp.einsum("kij,ij->k", directions, jax.grad(function)(position))
        np.testing.assert_allclose(slopes / jnp.abs(before), 0.0, atol=1e-9)
        weights = jnp.linalg.lstsq(directions.reshape(3, -1).T, move.ravel())[0]
        np.testing.assert_allclose(jnp.einsum("k,kij->ij", weights, directions), move, atol=1e-9)


def test_cloth_never_climbs(small_garment):
    def energy(x):
        return stretch_energy(x, small_garment, COTTON)

    evaluate = jax.jit(jax.value_and_grad(energy))
    keys = jax.random.split(jax.random.key(0), 5)
    for key in keys:
        noise = 5e-3 * jax.random.normal(key, (3, *small_garment.rest_positions.shape), jnp.float32)
        position = small_garment.rest_positions + noise[0]
        before, gradient = evaluate(position)
        downhill = -1e-4 * gradient / jnp.max(jnp.abs(gradient))
        move = combine(energy, position, jnp.concatenate([noise[1:], downhill[None]]))
        after, first = (evaluate(position + step)[0] for step in (move, noise[1]))
        assert after < before < first, "the first direction alone must not do"


def test_a_step_that_would_blow_up_is_not_taken():
    def wall(x):
        return jnp.sum(jnp.where(x > 1.0, jnp.nan, -x))

    move = combine(wall, jnp.zeros((2, 3)), jnp.full((1, 2, 3), 2.0))
    np.testing.assert_array_equal(move, 0.0)


def test_directions_of_zero_give_no_step_and_finite_gradients():
    function, position, directions = make_quadratic()
    position, directions = position.astype(jnp.float32), directions.astype(jnp.float32)
    np.testing.assert_array_equal(combine(function, position, jnp.zeros_like(directions)), 0.0)

    def after(scale):
        first = scale * directions[:1]
        rest = jnp.zeros_like(directions[1:])
        return function(position + combine(function, position, jnp.concatenate([first, rest])))

    assert np.isfinite(jax.grad(after)(jnp.float32(1.0)))
    assert np.isfinite(jax.grad(after)(jnp.float32(0.0)))
