"""Baselines that see the body's motion and not the cloth."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from posed import pose_features
from scipy.spatial.transform import Rotation


def motion(num_frames=4, num_joints=5):
    generator = np.random.default_rng(0)
    turned = Rotation.random(num_frames * num_joints, random_state=0).as_matrix()
    moved = generator.standard_normal((num_frames * num_joints, 3, 1))
    return np.concatenate([turned, moved], axis=2).reshape(num_frames, num_joints, 3, 4).astype(np.float32)


@pytest.mark.parametrize("is_static", [False, True])
def test_features_do_not_change_when_the_scene_is_turned_and_shifted(is_static):
    posed, joints = motion(), jnp.array([1, 3])
    yaw = Rotation.from_euler("y", 70, degrees=True).as_matrix().astype(np.float32)
    turned = yaw @ posed
    turned[..., 3] += [1.0, 0.5, -2.0]
    features = pose_features(jnp.asarray(posed), joints, is_static=is_static)
    assert features.shape == (4, 12 + 3 + (0 if is_static else 9))
    again = pose_features(jnp.asarray(turned), joints, is_static=is_static)
    np.testing.assert_allclose(again, features, atol=2e-5 * np.abs(features).max())
    tilted = posed.copy()
    tilted[2] = Rotation.from_euler("x", 30, degrees=True).as_matrix() @ posed[2]
    changed = pose_features(jnp.asarray(tilted), joints, is_static=is_static)
    assert np.abs(changed[2] - features[2]).max() > 0.1  # gravity is seen
    np.testing.assert_array_equal(changed[:2], features[:2])
