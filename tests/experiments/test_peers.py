"""The comparison with other simulators: what our own row of its tables steps."""

import jax
import numpy as np
import pytest
from hard_cases import drop_scene
from peers import our_method

from eslr_jax import SimConfig, rollout_scene


@pytest.mark.slow
def test_our_method_steps_as_a_rollout_does():
    scene = drop_scene({}, columns=5, seconds=0.3).scene
    method, state = our_method(scene, 2, 10), scene.initial_state
    for frame in range(scene.num_frames - 1):
        state = method.step(state, frame)
    whole = jax.device_get(rollout_scene(None, scene.replace(substeps=2), SimConfig(iterations=10)))
    np.testing.assert_allclose(state.position, whole.positions[-1], atol=1e-5)
