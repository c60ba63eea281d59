"""Baselines that see the body's motion and not the cloth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paper import posed, supervised
from paper.posed import pose_features
from scipy.spatial.transform import Rotation


def motion(num_frames=4, num_joints=5):
    generator = np.random.default_rng(0)
    turned = Rotation.random(num_frames * num_joints, random_state=0).as_matrix()
    moved = generator.standard_normal((num_frames * num_joints, 3, 1))
    return np.concatenate([turned, moved], axis=2).reshape(num_frames, num_joints, 3, 4).astype(np.float32)


@pytest.mark.parametrize("is_static", [False, True])
def test_features_do_not_change_when_the_scene_is_turned_and_shifted(is_static):
    moving, joints = motion(), jnp.array([1, 3])
    yaw = Rotation.from_euler("y", 70, degrees=True).as_matrix().astype(np.float32)
    turned = yaw @ moving
    turned[..., 3] += [1.0, 0.5, -2.0]
    features = pose_features(jnp.asarray(moving), joints, is_static=is_static)
    assert features.shape == (4, 12 + 3 + (0 if is_static else 9))
    again = pose_features(jnp.asarray(turned), joints, is_static=is_static)
    np.testing.assert_allclose(again, features, atol=2e-5 * np.abs(features).max())
    tilted = moving.copy()
    tilted[2] = Rotation.from_euler("x", 30, degrees=True).as_matrix() @ moving[2]
    changed = pose_features(jnp.asarray(tilted), joints, is_static=is_static)
    assert np.abs(changed[2] - features[2]).max() > 0.1  # gravity is seen
    np.testing.assert_array_equal(changed[:2], features[:2])


def test_seeds_of_a_training_share_no_random_numbers():
    """Step k of a seed once drew what step k - 1 of the next one did."""
    assert posed.fit is supervised.fit

    def keys_of(seed):
        seen = set()

        def slope_of(params, batch, key):
            jax.debug.callback(lambda data: seen.add(tuple(data.tolist())), jax.random.key_data(key))
            return jnp.sum(params**2), 2 * params

        with jax.numpy_dtype_promotion("standard"):  # optax mixes types
            _, losses = supervised.fit(slope_of, jnp.ones(1), lambda _: None, 5, seed)
        jax.effects_barrier()
        assert losses[-1] < losses[0]
        return seen

    first, second = keys_of(0), keys_of(1)
    assert len(first | second) == 10


@pytest.mark.slow
@pytest.mark.parametrize("system", posed.SYSTEMS)
def test_two_steps_change_every_weight(system):
    with jax.numpy_dtype_promotion("standard"):
        network, losses = posed.train(system, "tshirt", 2)
        other, _ = posed.train(system, "tshirt", 1)
    assert np.isfinite(losses).all()
    moved = jax.tree.map(lambda one, two: np.any(one != two), network.params, other.params)
    assert np.mean(jax.tree.leaves(moved)) > 0.9
