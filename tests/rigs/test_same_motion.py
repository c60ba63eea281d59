"""One motion, a CMU clip, through every loader of motions: the body's joints are at the same places."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_files import (
    Z_UP_FROM_Y_UP,
    posed_joints,
    smpl_parameters,
    write_amass,
    write_bvh,
    write_character,
    write_hood,
    write_vto,
)
from scipy.spatial.transform import Rotation

from eslr_jax import load_motion
from eslr_jax.pipeline.formats.registry import find_reader

CLIP = Path(__file__).parents[1] / "fixtures" / "cmu_01_01.bvh"  # 120 frames at 30 Hz of CMU 01_01, a jump
TOLERANCE = 0.01  # [m]
# Beyond a second neck joint and a finger's base.
NOT_IN_SMPL = {"Head", "LeftHandFinger1", "RightHandFinger1"}
COLLAR_FAMILY = {  # names of BVH files that call the upper arm a shoulder
    "LeftUpLeg": "LeftHip", "LeftLeg": "LeftKnee", "LeftFoot": "LeftAnkle", "LeftToeBase": "LeftToe",
    "LeftShoulder": "LeftCollar", "LeftArm": "LeftShoulder", "LeftForeArm": "LeftElbow",
    "LeftHand": "LeftWrist", "LowerBack": "Chest", "Spine": "Chest2", "Spine1": "Chest3",
}  # fmt: skip
COLLAR_FAMILY |= {
    key.replace("Left", "Right"): value.replace("Left", "Right")
    for key, value in COLLAR_FAMILY.items()
    if key.startswith("Left")
}
UNREAL = {
    "Hips": "pelvis", "LowerBack": "spine_01", "Spine": "spine_02", "Spine1": "spine_03", "Neck": "neck_01",
    "Neck1": "neck_02", "Head": "head", "UpLeg": "thigh", "Leg": "calf", "Foot": "foot", "ToeBase": "ball",
    "Shoulder": "clavicle", "Arm": "upperarm", "ForeArm": "lowerarm", "Hand": "hand",
}  # fmt: skip


def unreal(name):
    for side in ("Left", "Right"):
        if name.startswith(side) and name.removeprefix(side) in UNREAL:
            return f"{UNREAL[name.removeprefix(side)]}_{side[0].lower()}"
    return UNREAL.get(name, name)


@pytest.fixture(scope="module")
def clip():
    whole = find_reader("motion", CLIP)(CLIP)
    return replace(whole, rotations=whole.rotations[1:], positions=whole.positions[1:])  # but its T-pose


@pytest.fixture(scope="module")
def own_motion(body):
    with pytest.warns(UserWarning, match="skipped its first frame"):  # a T-pose
        return load_motion(CLIP, body=body)


@pytest.fixture(scope="module")
def expected(own_motion, body):
    return posed_joints(own_motion, body)


def write_same(kind, folder, clip, own):
    """Write the clip as this kind of file; returns its path."""
    path = folder / f"clip.{kind.rpartition(' ')[2]}"
    rotations, pelvis = smpl_parameters(clip)
    if kind == "AMASS npz":
        write_amass(path, rotations, pelvis, clip.fps)
    elif kind == "AMASS of SMPL-X npz":
        write_amass(path, rotations, pelvis, clip.fps, num_joints=55)
    elif kind == "keys of SMPL-X npz":
        write_amass(folder / "amass.npz", rotations, pelvis, clip.fps)
        with np.load(folder / "amass.npz") as file:
            poses, moves = file["poses"], file["trans"]
        parts = {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66], "pose_hand": poses[:, 66:]}
        np.savez(path, **parts, pose_jaw=np.zeros((len(poses), 3)), transl=moves, fps=np.array(clip.fps))
    elif kind == "HOOD pkl":
        write_hood(path, rotations, pelvis)
    elif kind == "VTO pkl":
        write_vto(path, rotations, pelvis)
    elif kind == "archive npz":
        arrays = {"joint_names": np.array(own.joint_names), "a/fps": np.array(own.fps)}
        np.savez(path, **arrays, **{"a/rotations": own.rotations, "a/translations": own.translations})
    elif kind.endswith("bvh"):
        options = {
            "centimetres, Z up bvh": {"unit": 6.158, "axes": Z_UP_FROM_Y_UP},
            "collar names bvh": {"names": [COLLAR_FAMILY.get(n, n) for n in clip.skeleton.joint_names]},
            "Unreal names bvh": {"names": [unreal(n) for n in clip.skeleton.joint_names]},
            "Mixamo prefix bvh": {
                "names": [f"mixamorig:{n}" for n in clip.skeleton.joint_names],
                "order": "XYZ",
            },
        }
        write_bvh(path, clip, **options[kind])
    else:
        frames = None
        if kind.startswith("turned bones"):
            frames = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(31, 3))).as_matrix()
        metres = 0.06158  # per unit of this BVH
        skeleton = replace(clip.skeleton, rest_positions=metres * clip.skeleton.rest_positions)
        triangle = skeleton.rest_positions[:3] + np.eye(3), np.array([[0, 1, 2]])
        skin = np.tile([1.0, 0, 0, 0], (3, 1)), np.zeros((3, 4), int)
        motion = clip.rotations, metres * clip.positions
        write_character(path, skeleton, *triangle, *skin, motion=motion, frames=frames)
    return path


KINDS = (
    "AMASS npz", "AMASS of SMPL-X npz", "keys of SMPL-X npz", "HOOD pkl", "VTO pkl", "archive npz",
    "centimetres, Z up bvh", "collar names bvh", "Unreal names bvh", "Mixamo prefix bvh",
    "character glb", "turned bones glb",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_clip_puts_joints_at_the_same_places(kind, tmp_path, clip, body, own_motion, expected):
    motion = load_motion(write_same(kind, tmp_path, clip, own_motion), body=body)
    assert motion.fps == pytest.approx(30.0, rel=1e-4)
    found = posed_joints(motion, body)
    assert found.shape == expected.shape
    distance = np.linalg.norm(found - expected, axis=-1).max(axis=0)
    compared = [
        joint
        for joint, name in enumerate(body.joint_names)
        if not (kind.startswith(("AMASS", "keys", "HOOD", "VTO")) and name in NOT_IN_SMPL)
    ]
    assert distance[compared].max() < TOLERANCE


def test_a_motion_of_smpl_that_is_y_up_stands(tmp_path, clip, body, expected):
    rotations, pelvis = smpl_parameters(clip)
    path = tmp_path / "yup.npz"
    np.savez(path, poses=rotations[:, :22].reshape(-1, 66), trans=pelvis, mocap_framerate=np.array(clip.fps))
    with pytest.warns(UserWarning, match=r"yup: taken as Y up.*though not as usual.*--motion-up z"):
        guessed = load_motion(path, body=body)
    compared = [joint for joint, name in enumerate(body.joint_names) if name not in NOT_IN_SMPL]
    for motion in (guessed, load_motion(path, body=body, up="y")):
        found = posed_joints(motion, body)
        assert np.linalg.norm(found - expected, axis=-1)[:, compared].max() < TOLERANCE


def test_the_clip_stands_on_the_floor_and_starts_above_the_origin(body, expected):
    feet = [joint for joint, name in enumerate(body.joint_names) if name.endswith(("Foot", "ToeBase"))]
    rest = np.asarray(body.joint_rest_positions)[feet, 1] - float(np.asarray(body.rest_positions)[:, 1].min())
    lowest = (expected[:, feet, 1] - rest).min(axis=1)
    assert abs(np.quantile(lowest, 0.05)) < 1e-9
    np.testing.assert_allclose(expected[0, 0, [0, 2]], 0.0, atol=1e-9)


def test_limbs_point_where_the_clip_points(clip, body, expected):
    place = {name: joint for joint, name in enumerate(clip.skeleton.joint_names)}
    names = list(body.joint_names)
    for start, end in (("LeftArm", "LeftForeArm"), ("RightLeg", "RightFoot"), ("LeftUpLeg", "LeftLeg")):
        ours = expected[:, names.index(end)] - expected[:, names.index(start)]
        theirs = clip.positions[:, place[end]] - clip.positions[:, place[start]]
        cosine = np.sum(ours * theirs, axis=1) / np.linalg.norm(ours, axis=1) / np.linalg.norm(theirs, axis=1)
        assert np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))) < 0.01
