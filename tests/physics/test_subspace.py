"""The step in a span: exact on quadratics, never uphill, and harmless where there is nothing to gain."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from physics_cases import make_case

from eslr_jax.physics.potential import potential
from eslr_jax.physics.problem import start_guess
from eslr_jax.physics.subspace import combine_directions


def combine(function, position, directions):
    value, gradient = jax.value_and_grad(function)(position)
    return combine_directions(function, position, value, gradient, directions)


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


def test_cloth_never_climbs():
    case = make_case(dtype=np.float32)

    def energy(x):
        return potential(x, case.problem, case.garment, case.material)

    position = start_guess(case.problem, case.garment)
    gradient = jax.grad(energy)(position)
    for seed in range(5):
        noise = 5e-3 * jax.random.normal(jax.random.key(seed), (2, *position.shape), jnp.float32)
        downhill = -1e-4 * gradient / jnp.max(jnp.abs(gradient))
        move = combine(energy, position, jnp.concatenate([noise, downhill[None]]))
        assert energy(position + move) < energy(position)
        assert energy(position + noise[0]) > energy(position), "the first direction alone must not do"


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
