"""Implicit Euler and BDF2 against what is known of falling and swinging cloth."""

import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from known_answers.strip import LENGTH, kept_per_period, strip

from eslr_jax.config import SimConfig
from eslr_jax.errors import ConfigError
from eslr_jax.evaluation.gap import trajectory_gap
from eslr_jax.models.eslr import Eslr
from eslr_jax.scene.plan import prepare_scene
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.simulation.simulate import simulate
from eslr_jax.simulation.stepper import MOST_RESIDUAL

GRAVITY = 9.81  # [m/s^2]


def test_bdf2_keeps_a_strip_swinging_and_euler_does_not():
    per_period = {name: kept_per_period(name) for name in ("euler", "bdf2")}
    assert per_period["bdf2"] > 0.95, per_period
    assert per_period["euler"] < 0.5, per_period


@pytest.mark.parametrize("integrator", ["euler", "bdf2"])
def test_a_free_fall_is_off_by_as_much_as_the_integrator_says(integrator):
    """Euler falls g dt t / 2 too far; BDF2 3/4 g dt^2, which is what its first step by Euler becomes."""
    frames, dt = 31, 1 / 30
    scene = strip(integrator, frames=frames, is_pinned=False)
    end = rollout_scene(None, scene, SimConfig(iterations=5)).positions[-1]
    fallen = float(jnp.mean(scene.initial_state.position[:, 1] - end[:, 1]))
    time = (frames - 1) * dt
    too_far = GRAVITY * dt * {"euler": time / 2, "bdf2": 0.75 * dt}[integrator]
    assert fallen == pytest.approx(GRAVITY * time**2 / 2 + too_far, abs=1e-3)


def test_bdf2_with_few_iterations_stays_where_the_cloth_is():
    """A thrown strip of which every frame stops far from its minimum: BDF2 alone would amplify what is left."""
    scene = strip("bdf2", frames=60, is_pinned=True)
    thrown = 20.0 * jnp.sin(20.0 * scene.garment.rest_positions)
    scene = scene.replace(initial_state=scene.initial_state.replace(velocity=thrown))
    trajectory = rollout_scene(None, scene, SimConfig(iterations=3))
    assert float(trajectory.residuals.max()) > MOST_RESIDUAL
    distance = jnp.linalg.norm(trajectory.positions - scene.garment.rest_positions[:1][None], axis=-1)
    assert float(distance[30:].max()) < 2.0 * LENGTH  # without the guard: 47 m


@pytest.fixture(scope="module")
def draped():
    return prepare_scene(square(), drifting_ball(13), integrator="bdf2")


def test_bdf2_goes_on_where_it_was_interrupted(draped):
    config = SimConfig(iterations=15)
    whole = simulate(None, draped, config=config).trajectory
    first = simulate(None, draped, config=config, is_stopping=lambda: True).trajectory
    joined = simulate(None, draped, config=config, done=first).trajectory
    np.testing.assert_array_equal(joined.positions, whole.positions)


def test_the_gap_of_a_bdf2_trajectory_is_that_of_its_own_problems(draped):
    trajectory = rollout_scene(None, draped, SimConfig(iterations=100))
    gap = trajectory_gap(trajectory, draped, every=6)
    assert float(jnp.max(gap.share(gap.reached))) < 1e-3


def test_a_network_alone_refuses_bdf2(draped):
    model = Eslr(message_passing_steps=1, attention_blocks=0, latent_size=8)
    with pytest.raises(ConfigError, match="implicit Euler"):
        rollout_scene(model.new_network(), draped, SimConfig(iterations=0))
