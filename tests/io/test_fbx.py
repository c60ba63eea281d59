"""FBX through ufbx, on a real file of Blender: bones are rigid, the mesh is where its joints bind it."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from broken import refuses

import eslr_jax.io.fbx as fbx
from eslr_jax.errors import MissingExtraError
from eslr_jax.io.fbx import fbx_clip_names, read_fbx_body, read_fbx_motion

pytest.importorskip("ufbx")
FILE = Path(__file__).parents[1] / "fixtures" / "huesitos.fbx"  # a small skinned mesh of assimp's tests


@pytest.fixture(scope="module")
def character():
    return read_fbx_body(FILE), read_fbx_motion(FILE)


def test_a_real_file_is_read(character):
    body, motion = character
    assert body.positions.shape == (62, 3)
    assert body.skeleton.joint_names[0] == "Bone"
    np.testing.assert_allclose(body.skin_weights.sum(axis=1), 1.0)
    assert motion.name == "Armature|Action"
    assert fbx_clip_names(FILE) == ("Armature|Action",)
    assert motion.fps == pytest.approx(25.0)
    assert motion.rotations.shape == (40, 11, 3, 3)
    assert np.ptp(motion.positions, axis=0).max() > 0.1  # it moves


def test_bones_keep_their_length_and_rotations_are_rotations(character):
    body, motion = character
    names, parents = body.skeleton.joint_names, body.skeleton.parents
    joints = [j for j, parent in enumerate(parents) if parent >= 0 and "_end" not in names[j]]
    above = [body.skeleton.parents[j] for j in joints]
    rest = body.skeleton.rest_positions
    lengths = np.linalg.norm(motion.positions[:, joints] - motion.positions[:, above], axis=-1)
    expected = np.linalg.norm(rest[joints] - rest[above], axis=1)
    np.testing.assert_allclose(lengths, np.tile(expected, (40, 1)), atol=1e-4)
    gram = np.swapaxes(motion.rotations, -1, -2) @ motion.rotations
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-6)


def test_a_bone_points_where_its_rotation_says(character):
    body, motion = character
    rest, parents = body.skeleton.rest_positions, body.skeleton.parents
    joint = body.skeleton.joint_names.index("Bone.001")
    bone = rest[joint] - rest[parents[joint]]
    found = motion.positions[:, joint] - motion.positions[:, parents[joint]]
    np.testing.assert_allclose(found, motion.rotations[:, parents[joint]] @ bone, atol=1e-4)


DATA = FILE.read_bytes()
BROKEN = {
    "empty": b"",
    "text": b"hello",
    "truncated": DATA[:20000],
    "no mesh": b"; FBX 7.4.0 project file\nFBXHeaderExtension: {\n\tFBXVersion: 7400\n}\n",
    "scrambled": DATA[:3000] + bytes(range(256)) * 20 + DATA[8120:],
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_files_are_named_in_one_line(tmp_path, kind):
    path = tmp_path / "avatar.fbx"
    path.write_bytes(BROKEN[kind])
    refuses(read_fbx_body, path)


def test_a_clip_that_is_not_there(tmp_path):
    refuses(lambda path: read_fbx_motion(path, "dance"), FILE, "Action")


def test_a_reader_that_dies_or_hangs_is_a_named_error(monkeypatch, tmp_path):
    path = tmp_path / "avatar.fbx"
    path.write_bytes(DATA)
    real = subprocess.run
    monkeypatch.setattr(
        fbx.subprocess, "run", lambda command, **options: real(["sh", "-c", "kill -SEGV $$"], **options)
    )
    refuses(read_fbx_body, path, "broke down")
    monkeypatch.setattr(fbx.subprocess, "run", lambda command, **options: real(["sleep", "9"], **options))
    monkeypatch.setattr(fbx, "TIMEOUT", 0.1)
    refuses(read_fbx_body, path, "not read within")


def test_without_the_extra_the_remedy_is_named(monkeypatch):
    monkeypatch.setattr(fbx.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"eslr-jax\[fbx\].*glTF"):
        read_fbx_body(FILE)
