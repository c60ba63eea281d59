"""Joints by any name, and motions carried from rig to rig."""

import dataclasses
import json
import warnings

import jax
import numpy as np
import pytest
import trimesh
from cloth import turn_about
from foreign_files import moving, posed_joints, rigged
from scipy.spatial.transform import Rotation

from eslr_jax import AssetError, MeshError, MotionError, load_motion, pose_body
from eslr_jax.pipeline.assets.motions import read_joint_map
from eslr_jax.pipeline.rigs.clothing import body_pieces
from eslr_jax.pipeline.rigs.procedural import PROCEDURAL
from eslr_jax.pipeline.rigs.rig import body_skeleton, hips_first, make_body, make_motion
from eslr_jax.pose.joints import find_named_parts, find_parts, map_joints
from eslr_jax.pose.motion import obstacle_surface, still_motion
from eslr_jax.pose.retarget import global_rotations
from eslr_jax.pose.skeleton import Skeleton

RIGS = {
    "Mixamo": """
        mixamorig:Hips mixamorig:Spine2 mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot
        mixamorig:LeftShoulder mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand
        mixamorig:LeftHandIndex1 mixamorig:Head
    """,
    "SMPL": """
        pelvis spine3 left_hip left_knee left_ankle left_collar left_shoulder left_elbow left_wrist
        left_index1 head
    """,
    "Unreal": "pelvis spine_03 thigh_l calf_l foot_l clavicle_l upperarm_l lowerarm_l hand_l index_01_l head",
    "VRM": """
        J_Bip_C_Hips J_Bip_C_UpperChest J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_Shoulder
        J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand J_Bip_L_Index1 J_Bip_C_Head
    """,
    "Rigify": """
        pelvis DEF-spine.003 DEF-thigh.L DEF-shin.L DEF-foot.L DEF-shoulder.L DEF-upper_arm.L DEF-forearm.L
        DEF-hand.L DEF-f_index.01.L head
    """,
    "ASF": "root thorax lfemur ltibia lfoot lclavicle lhumerus lradius lhand lfingers head",
    "collars": """
        Hips Chest LeftHip LeftKnee LeftAnkle LeftCollar LeftShoulder LeftElbow LeftWrist LeftIndex Head
    """,
}  # fmt: skip
EXPECTED = (
    ("", "hips"), ("", "spine"), ("left", "upper_leg"), ("left", "lower_leg"), ("left", "foot"),
    ("left", "clavicle"), ("left", "upper_arm"), ("left", "forearm"), ("left", "hand"), ("left", "index"),
    ("", "head"),
)  # fmt: skip
PARENTS = (-1, 0, 0, 2, 3, 1, 5, 6, 7, 8, 1)


@pytest.mark.parametrize("family", RIGS)
def test_joints_are_known_by_the_names_of_every_family(family):
    names = RIGS[family].split()
    parts = find_parts(Skeleton(tuple(names), PARENTS, np.zeros((11, 3))))
    for joint, part in enumerate(EXPECTED):
        if family == "ASF" and part[1] == "index":
            part = ("left", "fingers")
        assert parts[part] == [joint], names[joint]


WHOLE = """
    Hips Spine Spine1 Spine2 Neck Head
    LeftShoulder LeftArm LeftForeArm LeftHand RightShoulder RightArm RightForeArm RightHand
    LeftUpLeg LeftLeg LeftFoot LeftToeBase RightUpLeg RightLeg RightFoot RightToeBase
"""
FAMILIES = {
    "OptiTrack": """
        Hip Ab Ab2 Chest Neck Head LShoulder LUArm LFArm LHand RShoulder RUArm RFArm RHand
        LThigh LShin LFoot LToe RThigh RShin RFoot RToe
    """,
    "Xsens": """
        Pelvis L5 L3 T8 Neck Head LeftShoulder LeftUpperArm LeftForeArm LeftHand
        RightShoulder RightUpperArm RightForeArm RightHand
        LeftUpperLeg LeftLowerLeg LeftFoot LeftToe RightUpperLeg RightLowerLeg RightFoot RightToe
    """,
    "AdvancedSkeleton": """
        Root_M Spine1_M Spine2_M Chest_M Neck_M Head_M Scapula_L Shoulder_L Elbow_L Wrist_L
        Scapula_R Shoulder_R Elbow_R Wrist_R Hip_L Knee_L Ankle_L Toes_L Hip_R Knee_R Ankle_R Toes_R
    """,
    "Kinect": """
        SpineBase SpineMid Torso SpineShoulder Neck Head ClavicleLeft ShoulderLeft ElbowLeft WristLeft
        ClavicleRight ShoulderRight ElbowRight WristRight
        HipLeft KneeLeft AnkleLeft FootLeft HipRight KneeRight AnkleRight FootRight
    """,
    "arms of unknown names": """
        Hips Spine Spine1 Spine2 Neck Head LeftShoulder LeftUpper LeftLower LeftHand RightShoulder
        RightUpper RightLower RightHand LeftHipBone LeftShank LeftFoot LeftToe RightHipBone RightShank
        RightFoot RightToe
    """,
    "three.js": " ".join(f"mixamorig{name}" for name in WHOLE.split()),
    "a prefix": " ".join(f"Robot_{name}" for name in WHOLE.split()),
    "a suffix": " ".join(f"{name}_JNT" for name in WHOLE.split()),
}
WHOLE_PARENTS = (-1, 0, 1, 2, 3, 4, 3, 6, 7, 8, 3, 10, 11, 12, 0, 14, 15, 16, 0, 18, 19, 20)


@pytest.mark.parametrize("family", FAMILIES)
def test_joints_of_unknown_names_are_known_by_what_they_hang_between(family):
    expected, found = (
        find_parts(Skeleton(tuple(names.split()), WHOLE_PARENTS, np.zeros((22, 3))))
        for names in (WHOLE, FAMILIES[family])
    )
    assert found == expected


def test_limbs_that_follow_nothing_are_named(walking, body):
    names = list(walking.skeleton.joint_names)
    joint = names.index("LeftForeArm")
    names[joint : joint + 5] = ["box"] * 5
    renamed = tuple(f"{name}.{k}" if name == "box" else name for k, name in enumerate(names))
    source = dataclasses.replace(walking, skeleton=dataclasses.replace(walking.skeleton, joint_names=renamed))
    with pytest.warns(
        UserWarning, match="no joint of it is known as left forearm, which move with.*joint-map"
    ):
        make_motion(source, body)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_motion(source, body, joint_map={"LeftForeArm": f"box.{joint}"})


def test_helpers_are_no_part_of_the_body():
    names = ("upperarm_twist_01_l", "LeftToe_End", "ik_hand_l", "prop", "__UpLeg_L", "")
    assert find_named_parts(names) == {}


def test_the_map_can_be_changed(tmp_path, body):
    target = body_skeleton(body)
    source = Skeleton(tuple(RIGS["Unreal"].split()), PARENTS, np.zeros((11, 3)))
    path = tmp_path / "map.json"
    path.write_text(json.dumps({"LeftArm": "lowerarm_l", "Head": ""}))
    found = map_joints(target, source, read_joint_map(path))
    assert found["LeftArm"] == "lowerarm_l"
    assert found["LeftForeArm"] == "lowerarm_l"
    assert "Head" not in found
    with pytest.raises(MotionError, match="did you mean LeftArm"):
        map_joints(target, source, {"LeftArn": "hand_l"})
    with pytest.raises(MotionError, match="the motion has no joint"):
        map_joints(target, source, {"LeftArm": "tail"})
    for text in ("", "[1]", '{"a": 1}', "{"):
        path.write_text(text)
        with pytest.raises(AssetError, match=r"map\.json"):
            read_joint_map(path)


def test_joints_of_one_rig_follow_by_name_whatever_their_order():
    """Two toes of two links: a file lists toe by toe, and a body, made from the hips outwards, link by link."""
    thighs, toes = ["Bip01 L Thigh", "Bip01 R Thigh"], ("Toe0", "Toe01", "Toe1", "Toe11")
    names = ["Bip01", "Bip01 Pelvis", "Bip01 Spine", *thighs, "Bip01 L Foot"]
    names += [f"Bip01 L {toe}" for toe in toes]
    source = Skeleton(tuple(names), (-1, 0, 1, 1, 1, 3, 5, 6, 5, 8), np.zeros((10, 3)))
    target, _ = hips_first(source)
    assert target.joint_names != source.joint_names
    assert map_joints(target, source) == {name: name for name in names}
    longer = Skeleton((*names, "Prop"), (*source.parents, 0), np.zeros((11, 3)))
    assert map_joints(target, longer) == {name: name for name in names}


@pytest.fixture(scope="module")
def walking(body):
    """The default clip as the moving skeleton of a file."""
    return moving(body)


def test_a_motion_of_nameless_joints_is_refused(walking, body):
    names = tuple(f"bone{joint}" for joint in range(len(walking.skeleton)))
    nameless = dataclasses.replace(walking.skeleton, joint_names=names)
    with pytest.raises(MotionError, match=r"no joint of the motion \(bone0"):
        make_motion(dataclasses.replace(walking, skeleton=nameless), body)


def test_a_motion_of_this_rig_is_taken_as_it_is(walking, body):
    motion = load_motion()
    back = make_motion(walking, body)
    np.testing.assert_allclose(back.translations, motion.translations, atol=1e-9)
    turned, again = (global_rotations(m.rotations, body.parents) for m in (motion, back))
    np.testing.assert_allclose(again, turned, atol=1e-9)
    assert back.arm_abduction == 0.0


def test_what_a_characters_own_bones_do_but_turn_is_told(walking, body):
    source = walking
    head, neck = (body.joint_names.index(name) for name in ("Head", "Neck1"))
    stretched = source.positions.copy()
    stretched[7, head] += [0.0, 0.05, 0.0]
    moved = dataclasses.replace(source, positions=stretched)
    with pytest.warns(UserWarning, match=r"Head is 5\.0 cm away in frame 7.*moving mesh"):
        make_motion(moved, body)
    indices = np.asarray(body.skin_indices)
    bald = body.replace(skin_indices=np.where(indices == head, neck, indices))
    stretched[7, head] += [0.0, 0.05, 0.0]
    make_motion(moved, bald)  # a joint without skin may be anywhere
    stretched[7, head] = source.positions[7, head] + [0.0, 0.005, 0.0]
    make_motion(moved, body)


def test_a_source_that_faces_elsewhere_moves_the_body_alike(walking, body):
    """A rig whose rest pose faces -x: limbs point where its limbs point."""
    quarter = Rotation.from_euler("y", -90, degrees=True).as_matrix()
    skeleton = Skeleton(body.joint_names, body.parents, walking.skeleton.rest_positions @ quarter.T)
    turned = walking.rotations @ quarter.T  # since another rest pose
    found = make_motion(dataclasses.replace(walking, skeleton=skeleton, rotations=turned), body)
    difference = posed_joints(found, body) - walking.positions
    assert np.ptp(difference, axis=(0, 1)).max() < 1e-6  # but for where it starts


def test_a_rest_pose_that_does_not_stand_is_refused(walking, body):
    rest = walking.skeleton.rest_positions.copy()
    names = list(body.joint_names)
    rest[names.index("LeftFoot")] = rest[names.index("LeftLeg")] + [0, 0.4, 0]
    lying = dataclasses.replace(walking.skeleton, rest_positions=rest)
    with pytest.raises(MotionError, match="stands neither at rest nor in a frame"):
        make_motion(dataclasses.replace(walking, skeleton=lying), body)


def test_bones_that_lie_along_one_axis_at_rest_move_the_body_alike(walking, body):
    """As in LAFAN1: each joint's own axes, of any twist, are the world's at rest, and its bone is along x."""
    ends = {"Arm": "ForeArm", "ForeArm": "Hand", "UpLeg": "Leg", "Leg": "Foot", "Foot": "ToeBase"}
    names, rest, rng = list(body.joint_names), walking.skeleton.rest_positions, np.random.default_rng(0)
    bones = [
        (names.index(side + a), names.index(side + b)) for side in ("Left", "Right") for a, b in ends.items()
    ]
    own = np.tile(
        Rotation.from_euler("z", 90, degrees=True).as_matrix(), (len(names), 1, 1)
    )  # trunk: x is up
    for start, end in bones:
        twist = Rotation.from_rotvec([rng.uniform(-np.pi, np.pi), 0, 0])
        along = Rotation.align_vectors((rest[end] - rest[start])[None], [[1.0, 0, 0]])[0]
        own[start:] = np.where(
            below(body, start)[start:, None, None], (along * twist).as_matrix(), own[start:]
        )
    lying = np.zeros_like(rest)
    for joint, parent in enumerate(body.parents[1:], 1):
        lying[joint] = lying[parent] + own[parent].T @ (rest[joint] - rest[parent])
    skeleton = dataclasses.replace(walking.skeleton, rest_positions=lying)
    motion = make_motion(
        dataclasses.replace(walking, skeleton=skeleton, rotations=walking.rotations @ own), body
    )
    found = posed_joints(motion, body)
    for start, end in bones:
        ours, theirs = (positions[:, end] - positions[:, start] for positions in (found, walking.positions))
        cosine = (ours * theirs).sum(-1) / np.linalg.norm(ours, axis=-1) / np.linalg.norm(theirs, axis=-1)
        most = 10.0 if "Foot" in names[start] else 1.0  # [degrees]; nothing tells how a rig's soles lie
        assert np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))) < most, names[start]
    turned = global_rotations(motion.rotations, body.parents)
    twisted = Rotation.from_matrix(
        (np.swapaxes(turned, 2, 3) @ walking.rotations).reshape(-1, 3, 3)
    ).magnitude()
    assert np.degrees(twisted.max()) < 30.0


def below(body, joint):
    """Whether each joint is this one or hangs on it."""
    found = np.arange(len(body.parents)) == joint
    for other, parent in enumerate(body.parents):
        found[other] |= parent >= 0 and found[parent]
    return found


@pytest.mark.parametrize("name", PROCEDURAL)
def test_computed_motions_start_at_rest_and_move(name, body):
    motion = load_motion(name, body=body)
    assert len(motion.rotations) == 121
    assert not motion.rotations[:30].any()
    speed = np.linalg.norm(np.diff(motion.rotations, axis=0), axis=-1).max(axis=1) * motion.fps
    lift = np.ptp(motion.translations, axis=0)
    assert speed.max() > 1.0  # [rad/s]
    assert speed.max() < 12.0
    expected = {"turn": (0.0, 0.0), "jump": (0.35, 0.5), "swing": (0.0, 0.0)}[name]
    assert expected[0] - 1e-9 <= lift[1] <= expected[1] + 1e-9
    poses = pose_body(body, motion, num_frames=31)
    assert float(np.asarray(poses.positions)[0, :, 1].min()) == pytest.approx(0.0, abs=1e-5)  # on the floor


def test_feet_stay_where_they_are_while_knees_bend(body):
    motion = load_motion("jump", body=body)
    foot = posed_joints(motion, body)[:, list(body.joint_names).index("LeftFoot")]
    on_floor = motion.translations[:, 1] <= motion.translations[0, 1] + 1e-6
    assert np.linalg.norm((foot - foot[0])[on_floor], axis=1).max() < 0.03  # [m]


def test_a_rig_without_the_joints_is_refused(body):
    strange = body.replace(joint_names=tuple(f"bone{k}" for k in range(len(body.joint_names))))
    with pytest.raises(MotionError, match="lacks"):
        load_motion("swing", body=strange)


def test_a_computed_motion_takes_no_map_of_joints(body):
    with pytest.raises(MotionError, match="leave out the map of joints"):
        load_motion("turn", body=body, joint_map={"Hips": "hip"})


def test_a_figure_that_lies_in_its_motion_alone_is_told_to_be_taken_as_z_up(walking, body):
    lie = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    crawling = dataclasses.replace(
        walking, rotations=lie @ walking.rotations, positions=walking.positions @ lie.T
    )
    with pytest.warns(UserWarning, match="taken as Z up.*--motion-up y"):
        make_motion(crawling, body, up="auto")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_motion(crawling, body, up="y")
        make_motion(walking, body, up="auto")


def test_a_character_that_is_inside_out_or_of_hands_alone_is_refused(body):
    mesh = rigged(body)
    make_body(mesh)
    with pytest.raises(MeshError, match="body hero: its faces point inside; flip the normals"):
        make_body(dataclasses.replace(mesh, faces=mesh.faces[:, ::-1]))
    hands = np.full((len(mesh.positions), 1), body.joint_names.index("LeftHand"))
    with pytest.raises(AssetError, match="body glove is hands alone; bind its other meshes"):
        make_body(rigged(body, name="glove", skin_weights=np.ones(hands.shape), skin_indices=hands))


def test_only_a_bvh_is_told_which_axis_points_up(body):
    for name in ("turn", "cmu_016_32"):
        with pytest.raises(MotionError, match=f"{name} has its own up axis.*--motion-up"):
            load_motion(name, body=body, up="z")


def test_arms_are_lifted_to_the_side_of_a_body_that_faces_elsewhere(body):
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # it faces +X
    other = turn_about(body, turn.T)
    ours, theirs = (pose_body(one, still_motion(one, 2, arm_angle=20.0)) for one in (body, other))
    away = np.asarray(theirs.positions[0]) - np.asarray(ours.positions[0]) @ turn.T
    assert np.abs(away - away[0]).max() < 0.03, "a chest that faces nearly ahead is taken to face ahead"


def test_a_body_in_float64_has_the_same_search_tables(body):
    double = body.replace(
        rest_positions=np.asarray(body.rest_positions, np.float64), faces=np.asarray(body.faces, np.int64)
    )
    jax.tree.map(np.testing.assert_array_equal, obstacle_surface(body), obstacle_surface(double))


# --- what a body wears in pictures --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pieces(body):
    positions, faces = np.asarray(body.rest_positions), np.asarray(body.faces)
    return {piece.name: piece for piece in body_pieces(positions, faces, body)}


def test_pieces_are_the_body_s_surface(body, pieces):
    positions, faces = np.asarray(body.rest_positions, np.float64), np.asarray(body.faces)
    assert set(pieces) == {"skin", "top", "shorts"}
    areas = {
        name: trimesh.Trimesh(piece.place(positions), piece.faces, process=False).area
        for name, piece in pieces.items()
    }
    total = sum(areas.values())
    assert total == pytest.approx(trimesh.Trimesh(positions, faces, process=False).area, rel=1e-4)
    sides = {name: area / total for name, area in areas.items()}
    assert 0.1 < sides["top"] < 0.35
    assert 0.1 < sides["shorts"] < 0.3


def test_head_hands_and_feet_are_bare(body, pieces):
    positions = np.asarray(body.rest_positions)
    joints = {name: np.asarray(body.joint_rest_positions)[k] for k, name in enumerate(body.joint_names)}
    top, shorts = (pieces[name].place(positions) for name in ("top", "shorts"))
    assert top[:, 1].max() < joints["Head"][1]
    assert abs(top[:, 0]).max() < joints["LeftForeArm"][0]
    assert top[:, 1].min() == pytest.approx(shorts[:, 1].max(), abs=1e-5)  # they meet at the waist
    assert shorts[:, 1].min() > joints["LeftLeg"][1]  # over the knees
    assert abs(shorts[:, 0]).max() < joints["LeftForeArm"][0]


def test_a_body_of_unknown_joints_is_all_skin(body):
    unknown = body.replace(joint_names=tuple(f"bone{k}" for k in range(len(body.joint_names))))
    (piece,) = body_pieces(np.asarray(body.rest_positions), np.asarray(body.faces), unknown)
    assert piece.name == "skin"
    np.testing.assert_array_equal(piece.place(body.rest_positions), np.asarray(body.rest_positions))
