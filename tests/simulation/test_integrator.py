"""Implicit Euler, BDF2 and substeps against what is known of falling and swinging cloth."""

import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from jax.tree_util import Partial
from known_answers.strip import LENGTH, kept_in, strip

from eslr_jax import (
    ConfigError,
    SimConfig,
    load_model,
    prepare_scene,
    rollout_scene,
    scene_terms,
    score_trajectory,
)
from eslr_jax.terms import FAST, Air

GRAVITY = 9.81  # [m/s^2]


FRAMES = 100  # of every strip: one program for each integrator
MOST = SimConfig(iterations=60)


def positions_of(scene, iterations=60):
    return rollout_scene(None, scene, MOST, jnp.int32(iterations)).positions


def kept_per_period(integrator):
    """Return the share of its energy that a swinging strip keeps over a period."""
    return kept_in(np.asarray(positions_of(strip(integrator, frames=FRAMES, is_pinned=True))))


def test_bdf2_keeps_a_strip_swinging_and_euler_does_not():
    assert kept_per_period("bdf2") > 0.95
    assert kept_per_period("euler") < 0.5


@pytest.mark.slow
def test_substeps_keep_a_strip_swinging_more():
    finer = strip("bdf2", frames=FRAMES, is_pinned=True).replace(substeps=2)
    assert kept_in(np.asarray(positions_of(finer))) > kept_per_period("bdf2")


@pytest.mark.parametrize(("integrator", "substeps"), [("euler", 1), ("bdf2", 1), ("bdf2", 3)])
def test_a_free_fall_is_off_by_as_much_as_the_integrator_says(integrator, substeps):
    """Euler falls g dt t / 2 too far; BDF2 3/4 g dt^2, which is what its first step by Euler becomes."""
    scene = strip(integrator, frames=FRAMES, is_pinned=True).replace(substeps=substeps)
    nowhere = jnp.zeros_like(scene.garment.is_pinned)
    scene = scene.replace(garment=scene.garment.replace(is_pinned=nowhere))
    time, dt = 1.0, 1 / 30 / substeps
    end = positions_of(scene, iterations=5)[30]
    fallen = float(jnp.mean(scene.initial_state.position[:, 1] - end[:, 1]))
    too_far = GRAVITY * dt * {"euler": time / 2, "bdf2": 0.75 * dt}[integrator]
    assert fallen == pytest.approx(GRAVITY * time**2 / 2 + too_far, abs=1e-3)


def test_bdf2_with_few_iterations_stays_where_the_cloth_is():
    """A thrown strip of which every frame stops far from its minimum: BDF2 alone would amplify what is left."""
    scene = strip("bdf2", frames=FRAMES, is_pinned=True)
    thrown = 20.0 * jnp.sin(20.0 * scene.garment.rest_positions)
    scene = scene.replace(initial_state=scene.initial_state.replace(velocity=thrown))
    trajectory = rollout_scene(None, scene, MOST, jnp.int32(3))
    assert float(trajectory.residuals.max()) > 5.0  # weights, from which on no past is taken
    distance = jnp.linalg.norm(trajectory.positions - scene.garment.rest_positions[:1][None], axis=-1)
    assert float(distance[30:60].max()) < 2.0 * LENGTH  # without the guard: 47 m


@pytest.mark.slow
def test_the_gap_of_a_bdf2_trajectory_is_that_of_its_own_problems():
    """Without strict contact, whose pushes leave the minimum."""
    draped = prepare_scene(square(), drifting_ball(13), terms=FAST, integrator="bdf2")
    trajectory = rollout_scene(None, draped, SimConfig(iterations=100))
    assert score_trajectory(trajectory, draped, every=6)["gap_relative_max"] < 1e-3


def test_a_network_alone_refuses_bdf2():
    scene = strip("bdf2", frames=2, is_pinned=True)
    with pytest.raises(ConfigError, match="implicit Euler"):
        rollout_scene(load_model("smooth-small"), scene, SimConfig(iterations=0))


def rising_wind(points, time):
    """A wind along x that grows by 6 m/s every second."""
    return jnp.zeros_like(points).at[:, 0].set(6.0 * time)


def windy(*, substeps=1, shorter=1):
    """A square on a drifting ball that holds two of its corners, in frames that may be `shorter`."""
    is_pinned = np.zeros(64, bool)
    is_pinned[[0, 7]] = True
    poses = drifting_ball(13, speed=0.3 / shorter)
    poses = poses.replace(timestep=poses.timestep / shorter)
    terms = scene_terms(Air(Partial(rising_wind)))
    return prepare_scene(square(is_pinned=is_pinned), poses, terms=terms, substeps=substeps)


@pytest.mark.slow
def test_a_frame_in_two_substeps_is_two_frames_of_half_the_length():
    """Of a body that moves straight, with pins, and a wind that grows with time."""
    config = SimConfig(iterations=100)
    whole = rollout_scene(None, windy(substeps=2), config)
    fine = rollout_scene(None, windy(shorter=2), config)
    once = rollout_scene(None, windy(), config)
    # Later, rounding decides how the cloth folds.
    np.testing.assert_allclose(whole.positions[:6], fine.positions[:12:2], atol=3e-4)
    assert float(jnp.abs(once.positions - whole.positions).max()) > 3e-3
    np.testing.assert_allclose(whole.velocities[1], fine.velocities[2], atol=1e-4)
    np.testing.assert_array_equal(whole.iterations[1:], 100)  # the most of a substep


@pytest.mark.parametrize("wrong", [0, 1.5, True])
def test_a_number_of_substeps_that_is_none_is_refused(wrong):
    with pytest.raises(ConfigError, match="substeps"):
        prepare_scene(square(), drifting_ball(3), substeps=wrong)
