"""A training step of several frames, and of several trajectories side by side."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_network import Nudge

from eslr_jax import TrainConfig
from eslr_jax.training.step import _Entry, _sample_gradient, init_train_state, make_train_step

FRAMES = 3


@pytest.fixture(scope="module")
def still():
    """A run whose weights hardly move, and whose trajectories don't end."""
    return TrainConfig(
        model=Nudge(width=4),
        steps=9,
        warmup=0,
        learning_rate=1e-12,
        slots_per_garment=2,
        batch_size=2,
        horizon_growth=1,
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
    state = jax.eval_shape(lambda: init_train_state(still, (small_data,)))
    step = make_train_step(dataclasses.replace(still, frames=17), 0)
    assert scan_lengths(jax.make_jaxpr(step)(state, small_data).jaxpr).count(17) == 1


def test_several_frames_of_trajectories_side_by_side_are_as_many_steps_of_one_by_one(still, small_data):
    several = make_train_step(dataclasses.replace(still, frames=FRAMES, vmap_size=2), 0)
    single = make_train_step(still, 0)

    def later(state):  # when trajectories are longer; a step donates its state
        return jax.tree.map(jnp.array, state).replace(step=jnp.int32(8))

    begun, _ = single(later(init_train_state(still, (small_data,))), small_data)
    together, metrics = several(later(begun), small_data)
    state, losses = begun, []
    for _ in range(FRAMES):
        state, own = single(later(state), small_data)
        losses.append(float(own["loss"]))
    assert len(set(losses)) == FRAMES
    np.testing.assert_array_equal(together.pools[0].age, state.pools[0].age)
    np.testing.assert_allclose(metrics["loss"], np.mean(losses), rtol=1e-4)
    positions = [one.pools[0].state.position for one in (together, state)]
    np.testing.assert_allclose(*positions, atol=1e-5)


@pytest.fixture(scope="module")
def measured(still, small_data):
    """Weights, and a function from how many frames a gradient passes to that of weights to gradient and loss."""
    config = dataclasses.replace(still, frames=2)
    state = init_train_state(config, (small_data,))
    slot = jax.tree.map(lambda leaf: leaf[0], state.pools[0])

    def measure(params, through_time):
        trial = dataclasses.replace(config, through_time=through_time)
        keys = jax.random.split(jax.random.key(1), trial.frames // through_time)
        entry = _Entry(jnp.int32(0), keys, slot)
        trained = state.network.replace(params=params)
        # One step of two frames was taken: trajectories may have three.
        gradient, sample = _sample_gradient(trained, small_data, jnp.int32(1), entry, config=trial)
        return gradient, sample.metrics["loss"]

    return state.network.params, lambda length: jax.jit(partial(measure, through_time=length))


def norm(tree):
    return jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(tree)))


def test_a_gradient_through_time_is_the_slope_of_the_mean_loss(measured):
    params, measure = measured
    through = measure(2)
    gradient, _ = through(params)
    size = norm(gradient)
    step = 1e-3 / size

    def moved(sign):
        there = jax.tree.map(lambda leaf, slope: leaf + sign * step * slope / size, params, gradient)
        return through(there)[1]

    np.testing.assert_allclose((moved(1) - moved(-1)) / (2 * step), size, rtol=0.02)


@pytest.mark.slow
def test_without_it_a_later_frame_does_not_know_how_the_earlier_ones_came_about(measured):
    """Or else the slope would prove nothing."""
    params, measure = measured
    through, apart = (measure(length)(params)[0] for length in (2, 1))
    assert norm(jax.tree.map(jnp.subtract, through, apart)) > 0.05 * norm(through)
