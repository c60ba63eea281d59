"""The bundled clips: for the bundled body, from the origin, on the floor."""

import numpy as np
import pytest

from eslr_jax import load_motion
from eslr_jax.pipeline.assets import asset_names
from eslr_jax.pipeline.rigs.rig import skeleton_motion
from eslr_jax.pose.retarget import global_rotations


@pytest.fixture(scope="module")
def clips(body):
    return [(load_motion(name), skeleton_motion(load_motion(name), body)) for name in asset_names("motion")]


def test_clips_start_at_the_origin_on_the_floor_facing_front(clips, body):
    for motion, skeleton in clips:
        assert 10 < motion.fps < 130
        front = global_rotations(motion.rotations[:1], body.parents)[0, 0, :, 2]
        assert front[2] > 0
        assert abs(front[0]) < 1e-3
        np.testing.assert_allclose(motion.translations[0, [0, 2]], 0.0, atol=1e-4)
        # Joints lie inside the body; a foot's are up to 0.1 m above the sole.
        assert -0.1 < skeleton.positions[:, :, 1].min() < 0.13


def test_cmu_feet_stand_still_once_in_every_step(clips, body):
    feet = [body.joint_names.index(side + part) for side in ("Left", "Right") for part in ("Foot", "ToeBase")]
    for motion, skeleton in clips:
        if motion.name.startswith("cmu"):
            steps = np.diff(skeleton.positions[:, feet], axis=0)[..., [0, 2]]
            speed = np.linalg.norm(steps, axis=-1) * motion.fps
            assert np.median(speed.min(axis=1)) < 0.15  # [m/s]; a walk's hips move at 0.7 to 1.7
