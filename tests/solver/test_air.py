"""Air and damping against known answers: terminal velocity, a strip in the wind, gusts, a decrement."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from jax.tree_util import Partial
from known_answers.strip import LENGTH, strip
from scipy.optimize import brentq
from scipy.signal import find_peaks

from eslr_jax import ConfigError, SimConfig, plan_scene, rollout_scene
from eslr_jax.fabric.materials import COTTON
from eslr_jax.simulation.frame import first_problem
from eslr_jax.terms import Air, Damping
from eslr_jax.terms.air import blowing, gusts

GRAVITY = 9.81  # [m/s^2]
WEIGHT = float(COTTON.density) * GRAVITY  # [N/m^2]
CONFIG = SimConfig(iterations=30)


FRAMES = 121  # of both strips: one program

# The quick tier's compiler options, and no others, make a gradient of air NaN on some processors (jaxlib 0.10.2).
_OPTION = "xla_cpu_use_fusion_emitters"
run = jax.jit(
    rollout_scene,
    static_argnums=2,
    compiler_options={_OPTION: True} if _OPTION in os.environ.get("XLA_FLAGS", "") else None,
)


@pytest.mark.parametrize("integrator", ["euler", pytest.param("bdf2", marks=pytest.mark.slow)])
def test_a_flat_strip_falls_as_fast_as_its_drag_lets_it(integrator):
    air = Air(jnp.zeros(3))
    scene = strip(integrator, air, frames=FRAMES, is_pinned=True, tilt=np.pi / 2)
    nowhere = jnp.zeros_like(scene.garment.is_pinned)
    scene = scene.replace(garment=scene.garment.replace(is_pinned=nowhere))
    fall = -float(run(None, scene, CONFIG).velocities[39, :, 1].mean())
    assert fall == pytest.approx(np.sqrt(2.0 * WEIGHT / (air.density * air.normal_drag)), rel=0.005)


def test_a_wind_lifts_a_hanging_strip_to_the_angle_of_balance():
    """Weight and drag along the normal balance everywhere: sigma g sin(a) = rho / 2 C_n (U cos(a))^2."""
    speed = 2.0  # [m/s]
    air = Air(jnp.array([0.0, 0.0, speed]), tangential_drag=0.0)
    pressure = 0.5 * air.density * air.normal_drag * speed**2
    expected = brentq(lambda a: WEIGHT * np.sin(a) - pressure * np.cos(a) ** 2, 0.0, np.pi / 2)
    scene = strip("euler", air, frames=FRAMES, is_pinned=True, tilt=expected + 0.1)
    end = np.asarray(run(None, scene, CONFIG).positions[-1]).reshape(2, 11, 3)
    along = (end[:, -1] - end[:, 0]).mean(axis=0)
    assert np.arctan2(along[2], -along[1]) == pytest.approx(expected, abs=0.01)


def test_a_stretched_strip_loses_the_share_per_period_that_theory_says():
    """With viscosity tau a mode of angular frequency w has the damping ratio tau w / 2."""
    damping, timestep = 4e-3, 1e-3  # [s]
    scene = strip(
        "bdf2",
        Damping(jnp.float32(damping)),
        frames=500,
        is_pinned=True,
        timestep=timestep,
        tilt=0.0,
    )
    scene = scene.replace(terms=tuple(term for term in scene.terms if term.name != "gravity"))
    rest = scene.garment.rest_positions
    pulled = rest.at[:, 1].add(-0.005 * jnp.sin(jnp.pi / 2 * -rest[:, 1] / LENGTH))  # the first mode
    scene = scene.replace(initial_state=scene.initial_state.replace(position=pulled))
    lowest = np.asarray(rollout_scene(None, scene, SimConfig(iterations=20)).positions[:, :, 1].min(axis=1))
    swing = -(lowest + LENGTH)
    peaks, _ = find_peaks(swing)
    assert len(peaks) > 2
    heights, period = swing[peaks], np.diff(peaks).mean() * timestep
    decrement = np.log(heights[:-1] / heights[1:]).mean()
    # The decrement is 2 pi z / sqrt(1 - z^2), and the undamped frequency 2 pi / T / sqrt(1 - z^2).
    ratio = decrement / np.hypot(2.0 * np.pi, decrement)
    frequency = 2.0 * np.pi / period / np.sqrt(1.0 - ratio**2)
    assert ratio == pytest.approx(damping * frequency / 2.0, rel=0.05)


def test_gusts_have_the_mean_and_the_strength_asked_for():
    wind = gusts((4.0, 0.0, 3.0), 0.2, seed=1)
    blown = np.asarray(jax.vmap(lambda time: wind(jnp.zeros((1, 3)), time))(jnp.linspace(0.0, 400.0, 4000)))
    np.testing.assert_allclose(blown.mean(axis=0), (4.0, 0.0, 3.0), atol=0.03)
    np.testing.assert_allclose(blown.std(axis=0), 0.2 * 5.0, rtol=0.03)


def test_a_function_blows_where_and_when_it_is_asked():
    scene = strip(frames=2, is_pinned=True)
    shear = Air(Partial(lambda rate, points, time: rate * time * points, jnp.float32(3.0)))
    flow = shear.prepare(jax.jit(first_problem)(scene).replace(time=jnp.float32(2.0)))
    real = np.asarray(scene.garment.rest_areas) > 0
    corners = np.asarray(scene.initial_state.position)[np.asarray(scene.garment.faces)]
    np.testing.assert_allclose(flow.wind[real], 6.0 * corners.mean(axis=1)[real], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(flow.areas.sum(), 0.05 * LENGTH, rtol=1e-5)


def test_a_plain_function_is_a_wind():
    air = plan_scene(square(3, 0.1), drifting_ball(2), (Air(lambda points, time: 2.0 * points),))[0][-1]
    assert len(jax.tree.leaves(air)) == 3, "its numbers"
    np.testing.assert_array_equal(air.wind(jnp.ones((1, 3)), 0.0), 2.0)
    gusty = blowing((3.0, 0.0, 0.0), 0.3)
    gusty.check()
    assert len(jax.tree.leaves(gusty)) > 3, "mean, strength and phases of gusts are traced"


@pytest.mark.parametrize(
    ("wind", "gust"), [((1.0, 2.0), 0.0), ((0.0, np.nan, 0.0), 0.0), ((0.0, 0.0, 500.0), 0.0), (None, 0.5)]
)
def test_an_impossible_wind_is_refused(wind, gust):
    with pytest.raises(ConfigError, match="wind"):
        blowing(wind, gust).check()
