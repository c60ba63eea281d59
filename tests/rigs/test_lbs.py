from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eslr_jax import MotionError
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


# --- motions on other rest poses and rates ------------------------------------------------------------------

NAMES = ("Hips", "LeftArm", "LeftForeArm", "LeftHand", "RightArm")
PARENTS = (-1, 0, 1, 2, 0)


def random_motion(rng, frames=12):
    return rng.normal(0.0, 0.5, (frames, len(NAMES), 3)), rng.normal(0.0, 1.0, (frames, 3))


def angles_between(one, other):
    one, other = (Rotation.from_rotvec(np.reshape(x, (-1, 3))) for x in (one, other))
    return (one.inv() * other).magnitude()


def test_local_and_global_rotations_are_inverse(rng):
    rotations, _ = random_motion(rng)
    back = retarget.local_rotations(retarget.global_rotations(rotations, PARENTS), PARENTS)
    assert angles_between(back, rotations).max() < 1e-7


def test_abduct_arms_lifts_hanging_arms_outwards():
    rotations = np.zeros((2, len(NAMES), 3))
    lifted = retarget.abduct_arms(rotations, NAMES, 90.0)
    down = [0.0, -1.0, 0.0]
    left, right = (
        Rotation.from_rotvec(lifted[0, NAMES.index(n)]).apply(down) for n in ("LeftArm", "RightArm")
    )
    np.testing.assert_allclose(left, [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(right, [-1.0, 0.0, 0.0], atol=1e-12)
    assert not lifted[:, [0, 2, 3]].any()
    assert not rotations.any()  # the input is left alone


def test_abduct_arms_there_and_back_is_nothing(rng):
    rotations, _ = random_motion(rng)
    back = retarget.abduct_arms(retarget.abduct_arms(rotations, NAMES, 12.0), NAMES, -12.0)
    assert angles_between(back, rotations).max() < 1e-7


def test_abduct_arms_names_the_missing_joint():
    with pytest.raises(MotionError, match="LeftArm"):
        retarget.abduct_arms(np.zeros((1, 1, 3)), ("Hips",))


@pytest.mark.parametrize("fps_out", [30.0, 24.0, 100.0 / 3.0, 120.0])
def test_resample_is_exact_for_uniform_motion(fps_out):
    spin, speed, fps_in = np.array([0.4, 2.0, -1.0]), np.array([1.0, 0.0, -0.5]), 100.0 / 3.0
    times = np.arange(40) / fps_in
    turns = np.tile((times[:, None] * spin)[:, None], (1, 2, 1))
    rotations, translations = retarget.resample(turns, times[:, None] * speed, fps_in, fps_out)
    new_times = np.arange(len(rotations)) / fps_out
    assert new_times[-1] <= times[-1] + 1e-9 < new_times[-1] + 1 / fps_out
    assert angles_between(rotations[:, 1], new_times[:, None] * spin).max() < 1e-7
    np.testing.assert_allclose(translations, new_times[:, None] * speed, atol=1e-12)


def test_resample_takes_the_short_way_through_a_half_turn():
    before, after = np.pi - 0.1, -(np.pi - 0.1)  # the same axis-angle chart wraps here
    turns = np.array([[[0.0, before, 0.0]], [[0.0, after, 0.0]]])
    rotations, _ = retarget.resample(turns, np.zeros((2, 3)), 15.0, 30.0)
    assert np.linalg.norm(rotations[1, 0]) == pytest.approx(np.pi)


def test_resample_keeps_a_single_frame(rng):
    rotations, translations = random_motion(rng, frames=1)
    new_rotations, new_translations = retarget.resample(rotations, translations, 60.0)
    np.testing.assert_array_equal(new_rotations, rotations)
    np.testing.assert_array_equal(new_translations, translations)


@pytest.mark.parametrize(("frames", "fps"), [(0, 30.0), (3, 0.0), (3, -1.0), (3, np.nan)])
def test_resample_refuses_nonsense(frames, fps):
    with pytest.raises(MotionError):
        retarget.resample(np.zeros((frames, 1, 3)), np.zeros((frames, 3)), fps)
