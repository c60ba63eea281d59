"""Bodies that pass through themselves make room for cloth; cloth that a pose folds through itself opens."""

import itertools

import jax
import numpy as np
import pytest
import trimesh

from eslr_jax import load_garment, load_motion, pose_body
from eslr_jax.mesh.parting import parted, uncrossed
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pose.lbs import skin_garment
from eslr_jax.terms.worn import Worn, parted_body


@pytest.fixture(scope="module")
def walking(body, tshirt):
    """What a T-shirt reaches of a walking body: arms touch the trunk, and a crease crosses itself."""
    poses = pose_body(body, load_motion("cmu_016_32"))
    surface = Worn(tshirt, poses).surface
    ids = np.asarray(surface.vertex_ids)
    positions = np.asarray(poses.positions)[[0, 48, 84]][:, ids]
    return positions, np.asarray(body.rest_positions)[ids], np.asarray(surface.faces)


def test_a_body_that_crosses_itself_yields_by_millimetres(walking):
    positions, rest, faces = walking
    made = np.concatenate([parted(frame[None], rest, faces) for frame in positions])
    assert all(len(intersecting_pairs(frame, faces)) > 0 for frame in positions)
    assert not any(len(intersecting_pairs(frame, faces)) for frame in made)
    yielded = np.linalg.norm(made - positions, axis=2)
    assert 1e-3 < yielded.max() < 9e-3
    assert np.mean(yielded > 0) < 0.05  # the rest of the body stays where it is


def test_legs_that_pass_each_other_between_two_frames_yield_at_both(body):
    """A kick of 15 cm a frame: at its frames the legs are apart, and on straight ways between them not."""
    poses = pose_body(body, load_motion("cmu_016_29"), num_frames=32)
    surface = Worn(load_garment("pants", vertices="1k"), poses).surface
    ids, faces = np.asarray(surface.vertex_ids), np.asarray(surface.faces)
    positions, rest = np.asarray(poses.positions)[29:32][:, ids], np.asarray(body.rest_positions)[ids]

    def crossing(frames):
        return [
            len(intersecting_pairs((1 - s) * a + s * b, faces))
            for a, b in itertools.pairwise(frames)
            for s in (0.0, 0.25, 0.5, 0.75)
        ]

    alone = np.concatenate([parted(frame[None], rest, faces) for frame in positions])
    assert max(crossing(alone)) > 50
    assert max(crossing(parted(positions, rest, faces))) == 0


def test_parts_that_close_slowly_yield_in_the_last_frames():
    """Two balls come nearer by 4 cm each, 9 mm a frame, and end a centimetre deep in each other."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    side = np.repeat([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], len(ball.vertices), axis=0)
    shape = np.tile(ball.vertices, (2, 1))
    frames = np.stack([shape + place * side for place in np.linspace(0.135, 0.095, 10)])
    assert len(intersecting_pairs(frames[-1], faces)) > 50
    assert not any(len(intersecting_pairs(frame, faces)) for frame in parted(frames, frames[0], faces))


def test_a_body_begins_to_yield_before_it_has_to(walking):
    """Five still frames without a crossing, then one that crosses: the frames before it yield too."""
    positions, rest, faces = walking
    frames = np.concatenate([np.repeat(rest[None], 5, axis=0), positions[:1]])
    yielded = np.linalg.norm(parted(frames, rest, faces) - frames, axis=2).max(axis=1)
    np.testing.assert_allclose(yielded[:5], yielded[5] * 0.8 ** np.arange(5, 0, -1), rtol=1e-2)


def test_a_body_that_made_room_is_kept_beside_compiled_programs(body, tshirt, walk, tmp_path):
    """Its file is read again; a damaged one is made anew."""
    surface = Worn(tshirt, walk).surface
    walk = walk.replace(surface=surface)
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    try:
        made = parted_body(walk).positions
        (file,) = (tmp_path / "parted").iterdir()
        np.savez(file, positions=np.zeros((8, len(surface.vertex_ids), 3), np.float32))
        assert not parted_body(walk).positions[:, surface.vertex_ids].any()
        file.write_bytes(b"damaged")
        np.testing.assert_array_equal(parted_body(walk).positions, made)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_a_body_that_crosses_nothing_stays(walking):
    _, rest, faces = walking
    np.testing.assert_array_equal(parted(rest[None], rest, faces)[0], rest)


def test_a_crease_that_skinning_folds_through_itself_opens(tshirt, body, walk):
    skinned = np.asarray(skin_garment(tshirt, walk.joint_transforms[:1]))[0]
    faces = np.asarray(tshirt.faces)
    assert len(intersecting_pairs(skinned, faces)) > 0
    opened = uncrossed(skinned, faces)
    assert len(intersecting_pairs(opened, faces)) == 0
    assert np.linalg.norm(opened - skinned, axis=1).max() < 0.02
