"""Internal damping against the logarithmic decrement of a strip that swings lengthwise."""

import jax.numpy as jnp
import numpy as np
import pytest
from known_answers.strip import LENGTH, strip
from scipy.signal import find_peaks

from eslr_jax import SimConfig, rollout_scene
from eslr_jax.terms import Damping


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
        gravity=0.01,
    )
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
