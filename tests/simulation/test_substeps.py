"""Substeps: a frame simulated in shorter steps."""

import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from jax.tree_util import Partial
from known_answers.strip import kept_per_period, strip

from eslr_jax.config import SimConfig
from eslr_jax.errors import ConfigError
from eslr_jax.scene.plan import prepare_scene
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.simulation.simulate import simulate
from eslr_jax.terms import Air, scene_terms

GRAVITY = 9.81  # [m/s^2]
FRAMES = 13


def rising_wind(points, time):
    """A wind along x that grows by 6 m/s every second."""
    return jnp.zeros_like(points).at[:, 0].set(6.0 * time)


def draped(*, substeps=1, shorter=1, integrator="euler"):
    """A square on a drifting ball that holds two of its corners; `shorter` makes as many frames of each one."""
    is_pinned = np.zeros(64, bool)
    is_pinned[[0, 7]] = True
    poses = drifting_ball(shorter * (FRAMES - 1) + 1, speed=0.3 / shorter)
    poses = poses.replace(timestep=poses.timestep / shorter)
    options = {
        "terms": scene_terms(Air(Partial(rising_wind))),
        "integrator": integrator,
        "substeps": substeps,
    }
    return prepare_scene(square(is_pinned=is_pinned), poses, **options)


def test_a_frame_in_two_substeps_is_two_frames_of_half_the_length():
    """Of a body that moves straight, with pins, and a wind that grows with time."""
    config = SimConfig(iterations=100)
    whole = rollout_scene(None, draped(substeps=2), config)
    fine = rollout_scene(None, draped(shorter=2), config)
    once = rollout_scene(None, draped(), config)
    early = slice(6)  # later, rounding decides how the cloth folds
    np.testing.assert_allclose(whole.positions[early], fine.positions[::2][early], atol=3e-4)
    assert float(jnp.abs(once.positions - whole.positions).max()) > 3e-3
    np.testing.assert_allclose(whole.velocities[1], fine.velocities[2], atol=1e-4)
    np.testing.assert_array_equal(whole.iterations[1:], 100)  # the most of a substep


@pytest.mark.parametrize("substeps", [1, 3])
def test_bdf2_falls_too_far_by_the_square_of_a_substep(substeps):
    """By 3/4 g dt^2, which is what its first step by Euler becomes."""
    frames, dt = 31, 1 / 30
    scene = strip("bdf2", frames=frames, is_pinned=False).replace(substeps=substeps)
    end = rollout_scene(None, scene, SimConfig(iterations=5)).positions[-1]
    fallen = float(jnp.mean(scene.initial_state.position[:, 1] - end[:, 1]))
    time = (frames - 1) * dt
    too_far = fallen - GRAVITY * time**2 / 2
    assert too_far == pytest.approx(0.75 * GRAVITY * (dt / substeps) ** 2, abs=1e-3)


def test_substeps_of_bdf2_keep_a_strip_swinging():
    assert kept_per_period("bdf2", substeps=2) > kept_per_period("bdf2") > 0.95


def test_substeps_go_on_where_they_were_interrupted():
    config, scene = SimConfig(iterations=15), draped(substeps=2, integrator="bdf2")
    whole = simulate(None, scene, config=config).trajectory
    first = simulate(None, scene, config=config, is_stopping=lambda: True).trajectory
    joined = simulate(None, scene, config=config, done=first).trajectory
    np.testing.assert_array_equal(joined.positions, whole.positions)


@pytest.mark.parametrize("wrong", [0, 1.5, True])
def test_a_number_of_substeps_that_is_none_is_refused(wrong):
    with pytest.raises(ConfigError, match="substeps"):
        prepare_scene(square(), drifting_ball(3), substeps=wrong)
