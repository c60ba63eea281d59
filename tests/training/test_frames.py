"""A training step of several frames, and of several trajectories side by side."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax import TrainConfig
from eslr_jax.networks.registry import MODELS
from eslr_jax.training.step import _Entry, _sample_gradient, init_train_state, make_train_step

FRAMES = 3


@pytest.fixture(scope="module")
def still(cheap_model):
    """A run whose weights hardly move, and whose trajectories don't end."""
    return TrainConfig(
        model=cheap_model, steps=9, warmup=0, learning_rate=1e-12, slots_per_garment=2, horizon_growth=1
    )


def scan_lengths(jaxpr):
    """Return the lengths of all scans in a program."""
    found = []
    for equation in jaxpr.eqns:
        if equation.primitive.name == "scan":
            found.append(equation.params["length"])
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            inner = getattr(inner, "jaxpr", inner)
            if hasattr(inner, "eqns"):
                found += scan_lengths(inner)
    return found


def test_the_compiled_step_scans_frames(still, small_data):
    def lengths(frames):
        config = dataclasses.replace(still, frames=frames)
        state = jax.eval_shape(lambda: init_train_state(still, (small_data,)))
        return scan_lengths(jax.make_jaxpr(make_train_step(config, 0))(state, small_data).jaxpr)

    assert lengths(17).count(17) == lengths(1).count(17) + 1


def test_a_step_of_several_frames_goes_where_as_many_steps_of_one_go(still, small_data):
    several = make_train_step(dataclasses.replace(still, frames=FRAMES), 0)
    single = make_train_step(still, 0)

    def later():  # when trajectories are longer, and the turn is the first one's; a step donates it
        return jnp.int32(8)

    together, metrics = several(init_train_state(still, (small_data,)).replace(step=later()), small_data)
    state, losses = init_train_state(still, (small_data,)), []
    for _ in range(FRAMES):
        state, own = single(state.replace(step=later()), small_data)
        losses.append(float(own["loss"]))
    assert len(set(losses)) == FRAMES
    assert int(together.pools[0].age[0]) == int(state.pools[0].age[0])
    np.testing.assert_allclose(metrics["loss"], np.mean(losses), rtol=1e-4)
    np.testing.assert_allclose(
        together.pools[0].state.position[0], state.pools[0].state.position[0], atol=1e-5
    )


def test_a_gradient_through_time_is_the_slope_of_the_mean_loss(still, small_data):
    """And without it, a later frame's loss does not know how the earlier ones came about."""
    model = dataclasses.replace(
        MODELS["mgn-5"], features="state", message_passing_steps=1, latent_size=8
    )  # unlike refinement, it holds nothing fixed within a frame
    config = dataclasses.replace(still, frames=2, model=model)
    state = init_train_state(config, (small_data,))
    output = state.network.statistics["output"]
    output = output.replace(count=jnp.float32(1), squared_deviations=jnp.full(3, 1e-3**2))  # [m per frame^2]
    network = state.network.replace(statistics={**state.network.statistics, "output": output})
    slot = jax.tree.map(lambda leaf: leaf[0], state.pools[0])

    def measure(params, through_time):
        trial = dataclasses.replace(config, through_time=through_time)
        keys = jax.random.split(jax.random.key(1), trial.frames // through_time)
        entry = _Entry(jnp.int32(0), keys, slot)
        trained = network.replace(params=params)
        # One step of two frames was taken: trajectories may have three.
        gradient, sample = _sample_gradient(trained, small_data, jnp.int32(1), entry, config=trial)
        return gradient, sample.metrics["loss"]

    through, apart = (jax.jit(partial(measure, through_time=length)) for length in (2, 1))
    params = state.network.params
    gradient, _ = through(params)
    size = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
    step = 1e-3 / size

    def moved(sign):
        return through(jax.tree.map(lambda leaf, slope: leaf + sign * step * slope / size, params, gradient))[
            1
        ]

    np.testing.assert_allclose((moved(1) - moved(-1)) / (2 * step), size, rtol=0.02)
    without = apart(params)[0]
    away = sum(jnp.sum((a - b) ** 2) for a, b in zip(*map(jax.tree.leaves, (gradient, without)), strict=True))
    assert jnp.sqrt(away) > 0.05 * size


def test_trajectories_side_by_side_are_those_one_by_one(still, small_data):
    config = dataclasses.replace(still, batch_size=2)
    found = []
    for size in (1, 2):
        step = make_train_step(dataclasses.replace(config, vmap_size=size), 0)
        state, metrics = step(init_train_state(config, (small_data,)), small_data)
        found.append((metrics, state.pools[0].state))
    for one, other in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)
