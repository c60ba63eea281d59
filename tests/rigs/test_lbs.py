from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eslr_jax.pose import lbs, retarget

GOLDEN = Path(__file__).parents[1] / "fixtures" / "anny_lbs_golden.npz"
TREE = (-1, 0, 1, 0)  # a chain of three joints and a branch
joint_transforms = jax.jit(lbs.joint_transforms, static_argnums=3)
skin_points = jax.jit(lbs.skin)
rotation_matrix = jax.jit(lbs.rotation_matrix)
turning = jax.jit(jax.jacobian(lbs.rotation_matrix))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def random_tree(rng):
    rotations = rng.normal(0.0, 0.7, (len(TREE), 3)).astype(np.float32)
    joints = rng.normal(0.0, 0.5, (len(TREE), 3)).astype(np.float32)
    translation = rng.normal(0.0, 1.0, 3).astype(np.float32)
    return jnp.asarray(rotations), jnp.asarray(translation), jnp.asarray(joints)


def random_skin(rng, vertices=20):
    positions = rng.normal(0.0, 0.5, (vertices, 3)).astype(np.float32)
    weights = rng.dirichlet(np.ones(3), vertices).astype(np.float32)
    indices = rng.integers(0, len(TREE), (vertices, 3)).astype(np.int16)
    return jnp.asarray(positions), jnp.asarray(weights), jnp.asarray(indices)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.0999, 0.1001, 1.0, 3.1, np.pi, 7.0])
def test_rotation_matrix_equals_scipy(angle, rng):
    axis = rng.normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_matrix(jnp.float32(vector)), expected, atol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1e-20, 1e-4, 0.1])
def test_rotation_matrix_gradient_near_zero_is_the_generator(scale):
    jacobian = turning(jnp.float32([scale, 0.0, 0.0]))
    generator = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    assert np.isfinite(jacobian).all()
    np.testing.assert_allclose(jacobian[..., 0], generator, atol=1.01 * scale + 1e-6)


def test_rotation_matrix_gradient_is_continuous_where_the_series_ends():
    below, above = (jnp.float32([np.sqrt(lbs.SERIES_BELOW * f), 0.0, 0.0]) for f in (0.9999, 1.0001))
    np.testing.assert_allclose(turning(below), turning(above), atol=2e-5)


def test_skin_reproduces_golden_poses(body):
    with np.load(GOLDEN) as file:
        golden = dict(file)
    local = retarget.local_rotations(golden["global_rotations"], body.parents)
    joints, rows = body.joint_rest_positions, golden["vertex_index"]
    skin = body.rest_positions[rows], body.skin_weights[rows], body.skin_indices[rows]
    for rotations, positions, vertices in zip(
        local, golden["joint_positions"], golden["vertices"], strict=True
    ):
        transforms = joint_transforms(jnp.float32(rotations), jnp.float32(positions[0]), joints, body.parents)
        posed_joints = jnp.sum(transforms[:, :, :3] * joints[:, None, :], axis=2) + transforms[:, :, 3]
        np.testing.assert_allclose(posed_joints, positions, atol=1e-5)  # [m]
        np.testing.assert_allclose(skin_points(*skin, transforms), vertices, atol=1e-5)  # [m]


def test_joint_transforms_equal_a_float64_chain(rng):
    rotations, translation, joints = random_tree(rng)
    matrices = Rotation.from_rotvec(np.asarray(rotations, np.float64)).as_matrix()
    rest = np.asarray(joints, np.float64)
    turned, posed = [matrices[0]], [np.asarray(translation, np.float64)]
    for joint in range(1, len(TREE)):
        parent = TREE[joint]
        turned.append(turned[parent] @ matrices[joint])
        posed.append(posed[parent] + turned[parent] @ (rest[joint] - rest[parent]))
    result = np.asarray(joint_transforms(rotations, translation, joints, TREE))
    np.testing.assert_allclose(result[:, :, :3], turned, atol=1e-6)
    np.testing.assert_allclose(result[:, :, 3] + np.einsum("jab,jb->ja", turned, rest), posed, atol=2e-6)


def test_skin_is_equivariant_to_moving_and_turning_the_root(rng):
    rotations, _, joints = random_tree(rng)
    skin = random_skin(rng)
    turn, offset = Rotation.from_rotvec([0.3, 1.1, -0.4]), np.float32([0.5, -0.25, 2.0])
    root = (turn * Rotation.from_rotvec(np.asarray(rotations[0]))).as_rotvec()
    turned = rotations.at[0].set(jnp.float32(root))
    here = skin_points(*skin, joint_transforms(rotations, jnp.zeros(3), joints, TREE))
    there = skin_points(*skin, joint_transforms(turned, jnp.asarray(offset), joints, TREE))
    np.testing.assert_allclose(there, turn.apply(np.asarray(here)) + offset, atol=3e-6)


def test_whole_turns_change_nothing(rng):
    rotations, translation, joints = random_tree(rng)
    lengths = jnp.linalg.norm(rotations, axis=1, keepdims=True)
    further = rotations * (1.0 + 2.0 * jnp.pi / lengths)
    one = joint_transforms(rotations, translation, joints, TREE)
    other = joint_transforms(further, translation, joints, TREE)
    np.testing.assert_allclose(other, one, atol=1e-5)


def test_gradients_are_finite_at_the_rest_pose(rng):
    _, translation, joints = random_tree(rng)
    skin = random_skin(rng)

    @jax.jit
    def height(rotations):
        return skin_points(*skin, joint_transforms(rotations, translation, joints, TREE))[:, 1].sum()

    zero = jnp.zeros((len(TREE), 3))
    gradient = np.asarray(jax.grad(height)(zero))
    assert np.isfinite(gradient).all()
    step = 1e-2
    for joint in range(len(TREE)):
        above, below = (float(height(zero.at[joint, 0].set(sign * step))) for sign in (1, -1))
        assert gradient[joint, 0] == pytest.approx((above - below) / (2 * step), abs=2e-3)
