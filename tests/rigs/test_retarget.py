import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eslr_jax import MotionError
from eslr_jax.pose import retarget

NAMES = ("Hips", "LeftArm", "LeftForeArm", "LeftHand", "RightArm")
PARENTS = (-1, 0, 1, 2, 0)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


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
