"""What training learns from: clips, and bodies of many shapes."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_limb, swing_motion

from eslr_jax import ConfigError, pose_body
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.pipeline.assets import split_clips
from eslr_jax.pose.motion import shape_body
from eslr_jax.terms import Collision
from eslr_jax.training.data import build_training_data
from eslr_jax.training.loop import train
from eslr_jax.training.pool import start_trajectory, turn_round
from eslr_jax.training.step import slot_problem


def test_unknown_split_lists_what_exists():
    with pytest.raises(ConfigError, match="validation"):
        split_clips("holdout")


@pytest.fixture(scope="module")
def starts(config, small_data):
    """The configuration and the starts of twenty trajectories that differ in girth; half of the bodies stand."""
    config = dataclasses.replace(config, girth=0.01, noise=0.0, still_probability=0.5)
    start = jax.jit(partial(start_trajectory, data=small_data, index=jnp.int32(0), config=config))
    return config, [start(jax.random.key(seed)) for seed in range(20)]


def test_bodies_of_trajectories_differ_in_girth_and_cloth_starts_outside_them(starts, small_data):
    slots = starts[1][:4]
    girths = np.array([slot.girth for slot in slots])
    assert np.ptp(girths) > 2e-3
    assert np.all(np.abs(girths) <= 0.01)

    @jax.jit
    def worn(slot):
        transforms = small_data.transforms(slot.frame, slot.yaw)
        thin, own = small_data.body(transforms, jnp.float32(0.0)), small_data.body(transforms, slot.girth)
        return own - thin, find_contacts(slot.state.position, own, own, small_data.surface).distances

    for slot in slots:
        grown, distances = worn(slot)
        np.testing.assert_allclose(np.linalg.norm(grown, axis=-1), abs(slot.girth), rtol=0.1)
        assert np.min(distances) > 0


def test_clips_are_played_back_and_forth_and_never_into_each_other(small_garment):
    body = make_limb()
    data = build_training_data([small_garment], body, [swing_motion(body, 4), swing_motion(body, 3)])

    def play(frame, before):
        frames = [frame]
        for _ in range(7):
            frame, before = int(data.next_frame(jnp.int32(frame), jnp.int32(before))), frame
            frames.append(frame)
        return frames

    assert play(1, 0) == [1, 2, 3, 2, 1, 0, 1, 2]
    assert play(0, 1) == [0, 1, 2, 3, 2, 1, 0, 1]  # a clip's first frame has none before it
    assert play(5, 4) == [5, 6, 5, 4, 5, 6, 5, 4]
    assert play(2, 2) == [2] * 8  # stands still


def test_a_body_turns_round_in_its_clip_and_stands_where_it_stands(starts, small_data):
    for slot in starts[1]:
        onward = small_data.next_frame(slot.frame, slot.before)
        turned = turn_round(jax.random.key(0), slot, small_data, 1.0)
        back = small_data.next_frame(turned.frame, turned.before)
        if slot.frame == slot.before:  # it stands
            assert back == slot.frame
        elif small_data.is_same_clip(2 * slot.frame - onward, slot.frame):
            assert (int(turned.frame), int(back)) == (int(slot.frame), 2 * int(slot.frame) - int(onward))
        else:  # an end of the clip
            assert back == onward
        assert turn_round(jax.random.key(0), slot, small_data, 0.0).before == slot.before


def test_a_body_stands_still_as_often_as_asked(starts, small_data):
    config, slots = starts
    standing = [slot for slot in slots if int(slot.frame) == int(slot.before)]
    assert 4 <= len(standing) <= 16
    assert sum(abs(int(slot.frame - slot.before)) for slot in slots) == len(slots) - len(standing)
    problem = jax.jit(partial(slot_problem, data=small_data, index=jnp.int32(0), config=config))
    for slot in standing:
        np.testing.assert_array_equal(slot.state.velocity, 0.0)
        contacts = problem(slot).data_of(Collision).nearest
        np.testing.assert_allclose(contacts.next_points, contacts.points, atol=1e-7)


@pytest.fixture(scope="module")
def shaped_data(small_garment):
    """The sleeve on a limb of two shapes: longer, with its joint higher up; and thicker."""
    limb, up = make_limb(), np.float32([0.0, 0.3, 0.0])
    rest = np.asarray(limb.rest_positions)
    longer, thicker = rest * np.float32([0.0, 0.1, 0.0]) + up / 15, rest * np.float32([0.05, 0.0, 0.05])
    body = limb.replace(
        rest_positions=jnp.asarray(rest + up),
        shape_directions=jnp.asarray(np.stack([longer, thicker], axis=-1)),
        joint_rest_positions=jnp.array([[0.0, 0.25, 0.0]]),
        joint_shape_directions=jnp.array([[[0.0, 0.0], [0.01, 0.0], [0.0, 0.0]]]),
    )
    garment = small_garment.replace(rest_positions=jnp.asarray(np.asarray(small_garment.rest_positions) + up))
    motion = swing_motion(body, 12)
    return body, motion, build_training_data([garment], body, [motion], has_shapes=True)


def test_a_shaped_body_moves_as_the_same_body_shaped_first(shaped_data):
    body, motion, data = shaped_data
    coefficients = np.array([1.5, -2.0])
    expected = pose_body(shape_body(body, coefficients), motion).positions[:, data.surface.vertex_ids]
    still = jnp.float32(0.0)

    @jax.jit
    def moved(frame, shape):
        transforms = data.transforms(frame, still, shape)
        found = data.body(transforms, still, shape)
        sleeve = data.skinned(jnp.int32(0), transforms, shape)
        return found, find_contacts(sleeve, found, found, data.surface).distances

    for frame in (0, 7):
        shape = jnp.asarray(coefficients, jnp.float32)
        found, distances = moved(jnp.int32(frame), shape)
        np.testing.assert_allclose(found, expected[frame], atol=1e-6)
        # The sleeve lies 8 mm off the limb, whatever the limb's shape.
        np.testing.assert_allclose(distances, 0.008, atol=0.004)


def test_bodies_of_trajectories_differ_in_shape_and_cloth_starts_outside_them(config, shaped_data):
    *_, data = shaped_data
    config = dataclasses.replace(config, shape_range=2.0, noise=0.0)
    start = jax.jit(partial(start_trajectory, data=data, index=jnp.int32(0), config=config))
    slots = [start(jax.random.key(seed)) for seed in range(6)]
    shapes = np.array([slot.shape for slot in slots])
    assert shapes.shape == (6, 2)
    assert np.all(np.ptp(shapes, axis=0) > 1.0)
    assert np.all(np.abs(shapes) <= 2.0)

    @jax.jit
    def distances(slot):
        transforms = data.transforms(slot.frame, slot.yaw, slot.shape)
        own = data.body(transforms, slot.girth, slot.shape)
        return find_contacts(slot.state.position, own, own, data.surface).distances

    for slot in slots:
        assert np.min(distances(slot)) > 0


@pytest.mark.slow
def test_a_run_on_shapes_keeps_them_while_a_trajectory_lives(config, shaped_data, tmp_path):
    *_, data = shaped_data
    config = dataclasses.replace(config, shape_range=1.0, horizon_growth=1, steps=3, slots_per_garment=1)
    state = train(config, tmp_path, datasets=(data,))
    assert int(state.skipped) == 0
    assert np.abs(np.array(state.pools[0].shape)).max() > 0
    assert np.isfinite(np.array(state.pools[0].state.position)).all()


@pytest.mark.parametrize(
    ("num_frames", "changed", "options", "message"),
    [
        (4, {"pose_directions": jnp.zeros((162, 3, 9))}, {}, "pose blend shapes"),
        (1, {}, {}, "no clip has two frames"),
        (3, {}, {"has_shapes": True}, "no shapes; train with shape_range = 0"),
    ],
)
def test_what_cannot_be_learned_from_is_refused(small_garment, num_frames, changed, options, message):
    body = make_limb().replace(**changed)
    with pytest.raises(ConfigError, match=message):
        build_training_data([small_garment], body, [swing_motion(body, num_frames)], **options)
