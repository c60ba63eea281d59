"""The comparison with other simulators: what our own row of its tables steps."""

import jax
import numpy as np
import pytest
from hard_cases import drop_scene, find_case
from peers import our_method, split_frames

from eslr_jax.config import SimConfig
from eslr_jax.scene.plan import first_frames
from eslr_jax.simulation.rollout import rollout_scene


def test_split_frames_keep_whole_frames_and_go_straight_in_between():
    drop = drop_scene({}, columns=3, seconds=0.8).scene
    twist = first_frames(find_case("twist").build({})["twist"].scene, 4)
    for scene, track in (
        (drop, lambda scene: scene.body.positions),
        (twist, lambda scene: scene.pin_targets),
    ):
        fine = split_frames(scene, 3)
        assert fine.num_frames == 3 * (scene.num_frames - 1) + 1 == len(track(fine))
        np.testing.assert_allclose(fine.timestep * 3, scene.timestep, rtol=1e-6)
        np.testing.assert_allclose(track(fine)[::3], track(scene), atol=1e-6)
        bends = np.diff(track(fine), n=2, axis=0)
        np.testing.assert_allclose(bends[0::3], 0, atol=1e-6)
        np.testing.assert_allclose(bends[1::3], 0, atol=1e-6)


@pytest.mark.slow
def test_our_method_steps_as_a_rollout_of_the_split_scene_does():
    scene = drop_scene({}, columns=5, seconds=0.3).scene
    method, state = our_method(scene, 2, 10), scene.initial_state
    for frame in range(scene.num_frames - 1):
        state = method.step(state, frame)
    whole = jax.device_get(rollout_scene(None, split_frames(scene, 2), SimConfig(iterations=10)))
    np.testing.assert_allclose(state.position, whole.positions[-1], atol=1e-5)
