"""Motions that are cut, repeated, settled and checked for speed."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from foreign_files import moving, posed_joints, write_bvh

from eslr_jax import MotionError, load_motion, pose_body
from eslr_jax.pipeline.assets import asset_names
from eslr_jax.pose.motion import still_motion
from eslr_jax.pose.retarget import count_resampled, global_rotations
from eslr_jax.pose.timing import check_speed, cut_start, loop_motion, skip_start_pose, with_settling


@pytest.fixture(scope="module")
def walking(body):
    return moving(body)


def with_rest_pose_first(source, frames, offset=(0.0, 0.0, 0.0)):
    rest = np.tile(source.skeleton.rest_positions + offset, (frames, 1, 1))
    turned = np.tile(np.eye(3), (frames, len(source.skeleton), 1, 1))
    return dataclasses.replace(
        source,
        positions=np.concatenate([rest, source.positions]),
        rotations=np.concatenate([turned, source.rotations]),
    )


@pytest.mark.parametrize("frames", [1, 3])
def test_a_rest_pose_before_a_motion_is_skipped_and_named(walking, frames):
    kept, text = skip_start_pose(with_rest_pose_first(walking, frames, offset=(1.5, 0.0, 0.0)))
    np.testing.assert_array_equal(kept.positions, walking.positions)
    np.testing.assert_array_equal(kept.rotations, walking.rotations)
    assert "skipped its first " + ("frame," if frames == 1 else "3 frames,") in text


def test_a_motion_knows_when_it_begins_in_its_file(walking, body, tmp_path):
    whole = with_rest_pose_first(walking, 3, offset=(1.5, 0.0, 0.0))
    write_bvh(tmp_path / "walk.bvh", whole)
    with pytest.warns(UserWarning, match="skipped its first 3 frames"):
        motion = load_motion(tmp_path / "walk.bvh", body=body)
    assert motion.start == pytest.approx(3 / walking.fps)
    later = cut_start(motion, 10 / motion.fps)
    assert later.start == pytest.approx(13 / walking.fps)
    assert loop_motion(later, 20.0).start == later.start
    assert load_motion("cmu_016_32").start == 0.0


def test_a_motion_without_a_rest_pose_is_kept(walking, body):
    for source in (walking, moving(body, "jump")):
        kept, text = skip_start_pose(source)
        assert kept is source
        assert text == ""


def test_a_jump_in_a_motion_that_jumps_again_is_kept(walking):
    source = with_rest_pose_first(walking, 1, offset=(1.5, 0.0, 0.0))
    positions = source.positions.copy()
    positions[60:] += [1.0, 0.0, 0.0]
    source = dataclasses.replace(source, positions=positions)
    assert skip_start_pose(source)[0] is source


def test_a_cut_motion_starts_where_it_was_at_that_time(body):
    motion = load_motion("cmu_016_32")
    cut = cut_start(motion, 0.5)
    first = round(0.5 * motion.fps)
    np.testing.assert_array_equal(cut.translations, motion.translations[first:])
    np.testing.assert_array_equal(cut.rotations, motion.rotations[first:])
    for seconds in (-1.0, 1e3, np.nan):
        with pytest.raises(MotionError, match="s long"):
            cut_start(motion, seconds)


def test_a_repeated_walk_goes_on_without_a_jump(body):
    motion = load_motion("cmu_016_32")
    length = (len(motion.rotations) - 1) / motion.fps
    looped = loop_motion(motion, 3 * length)
    assert len(looped.rotations) == round(3 * length * motion.fps) + 1
    once, thrice = (posed_joints(each, body) for each in (motion, looped))
    steps, longest = (
        np.linalg.norm(np.diff(positions, axis=0), axis=-1).max() for positions in (thrice, once)
    )
    assert steps < 1.5 * longest
    np.testing.assert_array_equal(looped.rotations[:30], motion.rotations[:30])
    walked = np.linalg.norm(np.ptp(motion.translations[:, [0, 2]], axis=0))
    assert np.linalg.norm(np.ptp(looped.translations[:, [0, 2]], axis=0)) > 2.3 * walked
    with pytest.raises(MotionError, match="can't be repeated"):
        loop_motion(motion, 0.0)


def test_simulated_frames_are_counted_at_the_rate_of_the_simulation(body):
    poses = pose_body(body, still_motion(body, 158, fps=33.3), arm_abduction=0.0)
    assert len(poses.positions) == count_resampled(158, 33.3, 30.0) == 142


def test_settling_holds_the_first_pose_at_the_speed_of_the_first_step(walk):
    settled = with_settling(walk, 5)
    assert len(settled.positions) == len(walk.positions) + 5
    np.testing.assert_array_equal(settled.positions[5:], walk.positions)
    shape = settled.positions - settled.positions.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(shape[:5], np.broadcast_to(shape[5], shape[:5].shape), atol=1e-6)
    centers = np.asarray(settled.positions.mean(axis=1))
    steps = np.diff(centers[:7], axis=0)
    np.testing.assert_allclose(steps[:, [0, 2]], np.broadcast_to(steps[-1, [0, 2]], (6, 2)), atol=1e-6)
    np.testing.assert_allclose(centers[:6, 1], centers[5, 1], atol=1e-6)  # on the floor
    np.testing.assert_allclose(
        settled.joint_transforms[0, :, :, 3] - walk.joint_transforms[0, :, :, 3],
        np.broadcast_to(centers[0] - centers[5], (walk.joint_transforms.shape[1], 3)),
        atol=1e-6,
    )
    with pytest.raises(MotionError, match="settle"):
        with_settling(walk, -1)


def test_limbs_come_from_the_rest_pose_while_a_garment_settles(body, walk):
    settled = with_settling(walk, 30, body)
    np.testing.assert_array_equal(settled.positions[30:], walk.positions)
    # The last third holds the first pose, as without a body.
    np.testing.assert_allclose(settled.positions[20:], with_settling(walk, 30).positions[20:], atol=1e-6)

    def shape(positions):
        """Return lengths between vertices, which no motion of the whole body changes."""
        picked = np.asarray(positions)[:: len(positions) // 40]
        return np.linalg.norm(picked[:, None] - picked[None], axis=-1)

    np.testing.assert_allclose(shape(settled.positions[0]), shape(body.rest_positions), atol=1e-4)
    steps = np.linalg.norm(np.diff(settled.positions, axis=0), axis=-1).max(axis=1)
    assert steps[:30].max() < 0.1, "limbs jump"
    lowest = np.asarray(settled.positions[:31, :, 1].min(axis=1))
    assert lowest.min() >= lowest[30] - 1e-6, "a foot dips into the ground"
    # Too few frames for the limbs.
    np.testing.assert_array_equal(with_settling(walk, 24, body).positions, with_settling(walk, 24).positions)


def test_a_body_that_is_too_fast_is_named_with_its_frame(walk):
    check_speed(walk, 0.3)
    positions = jnp.asarray(walk.positions).at[4:].add(jnp.array([0.0, 0.0, 0.5])[None, None])
    fast = walk.replace(positions=positions)
    told = r"moves 0\.(4[5-9]|5[0-5]) m in one frame, to frame 4 .* m/s.*frames 0 to 3 are fine, --frames 4"
    with pytest.raises(MotionError, match=told):
        check_speed(fast, 0.3)
    check_speed(fast, 0.3, vertices=np.zeros(0, int))


# --- the bundled clips: for the bundled body, from the origin, on the floor ---------------------------------


@pytest.fixture(scope="module")
def clips(body):
    return [(load_motion(name), moving(body, name)) for name in asset_names("motion")]


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
