"""SMPL files, written in exactly their layout since none may ship, against SMPL's equations in float64."""

import pickle
import sys
import types
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.sparse
from foreign_files import (
    SMPL_NAMES,
    SMPL_PARENTS,
    relative,
    smpl_layout,
    smpl_model,
    write_amass,
    write_hood,
    write_vto,
)
from scipy.spatial.transform import Rotation

from eslr_jax import load_body, load_motion, pose_body
from eslr_jax.pose.motion import Motion

GOLDEN = Path(__file__).parents[1] / "fixtures" / "anny_lbs_golden.npz"


@pytest.fixture(scope="module")
def model(body):
    return smpl_model(body, np.random.default_rng(0))


def smpl_vertices(model, rotations, translation, shape):
    """Vertices of Loper et al. 2015, equations 2 to 10, written out in float64."""
    template = model["v_template"] + model["shapedirs"] @ shape
    joints = model["J_regressor"] @ template
    turned = Rotation.from_rotvec(rotations).as_matrix()
    bent = template + model["posedirs"] @ (turned[1:] - np.eye(3)).ravel()
    chain = []
    for joint, parent in enumerate(SMPL_PARENTS):
        matrix = np.eye(4)
        matrix[:3, :3] = turned[joint]
        matrix[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        chain.append(chain[parent] @ matrix if parent >= 0 else matrix)
    for joint in range(24):
        chain[joint][:3, 3] -= chain[joint][:3, :3] @ joints[joint]
    blended = np.einsum("vj,jab->vab", model["weights"], np.array(chain))
    return np.einsum("vab,vb->va", blended[:, :3, :3], bent) + blended[:, :3, 3] + translation


class Ch:
    """Stands in for chumpy's array in files that are written here; the reader has no such class."""

    def __init__(self, x):
        self.x, self._cache = x, object


def write_chumpy_pickle(path, model, protocol):
    """A pickle as SMPL's are, of Python 2: chumpy arrays, a sparse regressor."""
    package, module = types.ModuleType("chumpy"), types.ModuleType("chumpy.ch")
    Ch.__module__, module.Ch = "chumpy.ch", Ch
    sys.modules |= {"chumpy": package, "chumpy.ch": module}
    values = dict(model)
    for key in ("v_template", "shapedirs", "posedirs", "weights"):
        values[key] = Ch(model[key])
    values["J_regressor"] = scipy.sparse.csc_matrix(model["J_regressor"])
    values |= {"bs_style": "lbs", "bs_type": "lrotmin"}
    try:
        path.write_bytes(pickle.dumps(values, protocol=protocol))
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]


@pytest.mark.parametrize("protocol", [None, 0, 2])
def test_a_smpl_body_moves_as_its_equations_say(tmp_path, model, protocol):
    path = tmp_path / ("model.npz" if protocol is None else "model.pkl")
    if protocol is None:
        # Real archives also hold pickled objects, which are left alone.
        np.savez(path, **model, part2num=np.array({"pelvis": 0}, dtype=object))
    else:
        write_chumpy_pickle(path, model, protocol)
    rng = np.random.default_rng(1)
    rotations, root = rng.normal(0.0, 0.4, (2, 24, 3)), rng.normal(0.0, 0.3, (2, 3))
    shape = rng.normal(size=10)
    body = load_body(path, betas=shape)
    rest = model["J_regressor"] @ (model["v_template"] + model["shapedirs"] @ shape)
    motion = Motion("a", rotations, rest[0] + root, 30.0, SMPL_NAMES)
    poses = pose_body(body, motion, arm_abduction=0.0)
    for frame in range(2):
        expected = smpl_vertices(model, rotations[frame], root[frame], shape)
        np.testing.assert_allclose(poses.positions[frame], expected, atol=2e-5)  # [m], float32 and 207 blends


def test_the_bundled_body_in_smpl_layout_reproduces_the_golden_poses(tmp_path, body):
    skin = body.skin_weights, body.skin_indices
    layout = smpl_layout(body.rest_positions, body.faces, *skin, body.joint_rest_positions, body.parents)
    np.savez(tmp_path / "anny.npz", **layout, joint_names=np.array(body.joint_names))
    loaded = load_body(tmp_path / "anny.npz")
    with np.load(GOLDEN) as golden:
        local = relative(golden["global_rotations"], body.parents)
        rotations = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(local.shape[:3])
        motion = Motion("golden", rotations, golden["joint_positions"][:, 0], 30.0, loaded.joint_names)
        poses = pose_body(loaded, motion, arm_abduction=0.0)
        found = np.asarray(poses.positions)[:, golden["vertex_index"]]
        np.testing.assert_allclose(found, golden["vertices"], atol=1e-5)  # [m]
    np.testing.assert_array_equal(loaded.faces, body.faces)


def test_parameters_move_a_smpl_body_to_the_same_place_in_every_format(tmp_path, model):
    np.savez(tmp_path / "model.npz", **model)
    body = load_body(tmp_path / "model.npz")
    rng = np.random.default_rng(2)
    rotations, shift = rng.normal(0.0, 0.3, (4, 24, 3)), rng.normal(size=(4, 3))
    rotations[:, 22:] = 0.0
    write_hood(tmp_path / "hood.pkl", rotations, shift)
    write_vto(tmp_path / "vto.pkl", rotations, shift)
    for name in ("hood.pkl", "vto.pkl"):
        motion = load_motion(tmp_path / name, body=body, up="y")
        np.testing.assert_allclose(motion.rotations, rotations, atol=1e-6)
        root = np.asarray(body.joint_rest_positions)[0]
        np.testing.assert_allclose(motion.translations, root + shift, atol=1e-6)
        assert motion.arm_abduction == 0.0
    # AMASS: vertices are those of the parameters, then turned from Z up to Y up.
    write_amass(tmp_path / "amass.npz", rotations, shift, 30.0)
    motion = load_motion(tmp_path / "amass.npz", body=body)
    to_y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    with np.load(tmp_path / "amass.npz") as file:
        poses, trans = file["poses"][:, :72].reshape(-1, 24, 3).copy(), file["trans"]
    poses[:, 22:] = 0.0
    found = np.asarray(pose_body(body, motion).positions)
    for frame in range(4):
        expected = smpl_vertices(model, poses[frame], trans[frame], np.zeros(10)) @ to_y.T
        np.testing.assert_allclose(found[frame], expected, atol=2e-5)


def test_hands_are_no_obstacle(tmp_path, model):
    np.savez(tmp_path / "model.npz", **model)
    body = load_body(tmp_path / "model.npz")
    leading = np.take_along_axis(
        np.asarray(body.skin_indices), np.asarray(body.skin_weights).argmax(1)[:, None], axis=1
    )[:, 0]
    is_hand = np.isin(leading, [20, 21, 22, 23])[np.asarray(body.faces)].all(axis=1)
    np.testing.assert_array_equal(np.asarray(body.is_obstacle), ~is_hand)
    assert is_hand.any()


def test_centimetres_are_recognised(tmp_path, model):
    in_metres, in_centimetres = tmp_path / "m.npz", tmp_path / "cm.npz"
    np.savez(in_metres, **model)
    lengths = {key: 100 * model[key] for key in ("v_template", "shapedirs", "posedirs")}
    np.savez(in_centimetres, **(model | lengths))
    with pytest.warns(UserWarning, match="in cm"):
        found = load_body(in_centimetres)
    expected = load_body(in_metres)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
