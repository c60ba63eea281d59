"""Read SMPL, SMPL-H and SMPL-X: body models from the user's own .npz or .pkl, and motions as their parameters.

The models don't ship with this package: their licence asks every user to fetch them. Motions are AMASS .npz
(mostly Z up) and the pickles of HOOD and of the VTO dataset (Y up), which hold rotations of numbered joints and
no skeleton.

Source: Loper et al. 2015 (doi:10.1145/2816795.2818013); Pavlakos et al. 2019 (arXiv:1904.05866); AMASS,
Mahmood et al. 2019 (arXiv:1904.03278).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from eslr_jax.errors import AssetError, MotionError
from eslr_jax.files.npz import check_layout, read_arrays
from eslr_jax.pipeline.formats.bundled import read_number
from eslr_jax.pipeline.formats.pickle import read_pickle
from eslr_jax.pipeline.formats.registry import reader
from eslr_jax.pose.skeleton import (
    RiggedMesh,
    Skeleton,
    SkeletonMotion,
    chain_positions,
    chain_rotations,
    order_joints,
    rotation_matrices,
)

NUM_SHAPES = 10  # leading shape directions kept; later files hold up to 400
MAX_VERTICES = 1 << 20
HOOD_FPS = 30.0  # [1/s] of HOOD and of the VTO dataset, whose files don't tell it

_BODY = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
_BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
_HANDS = tuple(
    f"{side}_{finger}{number}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for number in (1, 2, 3)
)
_FACE = ("jaw", "left_eye", "right_eye")
JOINT_NAMES = {  # by number of joints
    22: _BODY,
    24: (*_BODY, "left_hand", "right_hand"),  # SMPL
    52: (*_BODY, *_HANDS),  # SMPL-H
    55: (*_BODY, *_FACE, *_HANDS),  # SMPL-X
}
_MODEL = {
    "v_template": ("fiu", "vertices 3"),
    "f": ("fiu", "faces 3"),
    "weights": ("fiu", "vertices joints"),
    "J_regressor": ("fiu", "joints vertices"),
    "kintree_table": ("fiu", "2 joints"),
}
_BLENDS = {"shapedirs": ("fiu", "vertices 3 shapes"), "posedirs": ("fiu", "vertices 3 entries")}

# A person of 1.7 m in a T-pose [m], for motions that come without a body: straight limbs with the segments of
# Drillis and Contini (1966). Only directions and the length of the legs are used.
_T_POSE = {
    "pelvis": (0, 0, 0), "hip": (0.09, -0.08, 0), "knee": (0.09, -0.495, 0), "ankle": (0.09, -0.915, 0),
    "foot": (0.09, -0.96, 0.13), "spine1": (0, 0.11, 0), "spine2": (0, 0.24, 0), "spine3": (0, 0.3, 0),
    "neck": (0, 0.51, 0), "head": (0, 0.6, 0), "collar": (0.08, 0.42, 0), "shoulder": (0.18, 0.44, 0),
    "elbow": (0.49, 0.44, 0), "wrist": (0.74, 0.44, 0), "hand": (0.82, 0.44, 0),
}  # fmt: skip


# ---------------------------------------------------------------- bodies


def _is_smpl_model(path: Path) -> bool:
    """Tell a SMPL model from another .npz, by its keys."""
    return path.suffix.lower() == ".pkl" or {"v_template", "kintree_table"} <= set(
        read_arrays(path, content="body", names=tuple(_MODEL))
    )


@reader("body", [".npz", ".pkl"], accepts=_is_smpl_model)
def read_smpl_body(path: Path, _meshes: str = "") -> RiggedMesh:
    """Read the mean body of a model in the layout of SMPL, with its shape and pose blend shapes.

    It has v_template, f, weights, J_regressor, kintree_table, and optionally shapedirs, posedirs and
    joint_names. A model with other than 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) joints needs joint_names.
    """
    if path.suffix.lower() == ".pkl":
        values = read_pickle(path, content="body")
    else:
        values = read_arrays(path, content="body", names=(*_MODEL, *_BLENDS, "joint_names"))
    if not isinstance(values, dict):
        raise AssetError(f"body file {path} holds no table; give a SMPL model")
    missing = [key for key in _MODEL if key not in values]
    if missing:
        raise AssetError(f"body file {path} lacks {', '.join(missing)}; give a SMPL model")
    arrays = {
        key: values[key] if scipy.sparse.issparse(values[key]) else np.asarray(values[key])
        for key in (*_MODEL, *_BLENDS)
        if key in values
    }
    check_layout(arrays, _MODEL | _BLENDS, what=f"body file {path}", remedy="fetch the file again")
    positions, weights = arrays["v_template"].astype(np.float64), arrays["weights"].astype(np.float64)
    count, joints = weights.shape
    if not 0 < count <= MAX_VERTICES:
        raise AssetError(f"body file {path} has {count} vertices; expected 1 to {MAX_VERTICES}")
    names = _joint_names(path, values, joints)
    tree = arrays["kintree_table"].astype(np.int64)
    numbers = {int(number): place for place, number in enumerate(tree[1])}
    parents = [-1, *(numbers.get(int(parent), -2) for parent in tree[0, 1:])]
    order, new_parents = order_joints(names, parents, what=f"body file {path}")
    if order != list(range(joints)):
        raise AssetError(f"body file {path} has joints before their parents; give a SMPL model")
    regressor = arrays["J_regressor"].astype(np.float64)
    shapes = joint_shapes = pose = None
    if "shapedirs" in arrays:
        shapes = arrays["shapedirs"].astype(np.float64)[:, :, :NUM_SHAPES]
        joint_shapes = (regressor @ shapes.reshape(count, -1)).reshape(joints, 3, -1)
    if "posedirs" in arrays:
        pose = arrays["posedirs"].astype(np.float64)
        if pose.shape[2] != 9 * (joints - 1) or not np.isfinite(pose).all():
            raise AssetError(
                f"{path}: posedirs {pose.shape} must be finite, {9 * (joints - 1)} a vertex; fetch the file again"
            )
    used = max(1, int((weights > 0).sum(1).max()))
    indices = np.argsort(-weights, axis=1, kind="stable")[:, :used]
    return RiggedMesh(
        name=path.name,
        positions=positions,
        faces=arrays["f"].astype(np.int64),
        skin_weights=np.take_along_axis(weights, indices, axis=1),
        skin_indices=indices,
        skeleton=Skeleton(tuple(names), tuple(new_parents), regressor @ positions),
        shape_directions=shapes,
        joint_shape_directions=joint_shapes,
        pose_directions=pose,
    )


def _joint_names(path: Path, values: Mapping[str, Any], joints: int) -> list[str]:
    """Return the names of a model's joints."""
    if "joint_names" in values:
        names = [str(name) for name in np.ravel(np.asarray(values["joint_names"]))]
        if len(names) == joints and len(set(names)) == joints:
            return names
        raise AssetError(f"{path}: joint_names does not name {joints} joints; correct it")
    if joints not in JOINT_NAMES:
        raise AssetError(
            f"{path} has {joints} joints; SMPL has 24, SMPL-H 52, SMPL-X 55: add joint_names for another model"
        )
    return list(JOINT_NAMES[joints])


# ---------------------------------------------------------------- motions

_KEYS = {  # of AMASS, and of what is made with SMPL-X; the face moves no cloth
    "poses": ("poses",),
    "root": ("root_orient", "global_orient"),
    "body": ("pose_body", "body_pose"),
    "hands": ("pose_hand",),
    "moves": ("trans", "transl", "translation"),
    "rate": ("mocap_framerate", "mocap_frame_rate", "fps"),
}


@reader("motion", [".npz"])
def read_amass(path: Path, _clip: str = "") -> SkeletonMotion:
    """Read a motion with keys of AMASS or SMPL-X: rotations, whole or in parts, translations and frame rate."""
    values = read_arrays(path, content="motion", names=[key for keys in _KEYS.values() for key in keys])
    found = {what: next((values[k] for k in keys if k in values), None) for what, keys in _KEYS.items()}
    if found["poses"] is None and found["root"] is not None and found["body"] is not None:
        parts = [part for part in (found["root"], found["body"], found["hands"]) if part is not None]
        found["poses"] = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    if missing := [" or ".join(_KEYS[what]) for what in ("poses", "moves", "rate") if found[what] is None]:
        keys = ", ".join(values) or "no key of a motion"
        raise MotionError(
            f"motion file {path} has {keys}; it lacks {', '.join(missing)} (in place of poses: root_orient and "
            "pose_body); give a motion of AMASS, not its shape"
        )
    fps = read_number(found["rate"], f"motion file {path}: the frame rate")
    return _parameters(path, found["poses"], found["moves"], fps, "z")


@reader("motion", [".pkl"])
def read_smpl_pickle(path: Path, _clip: str = "") -> SkeletonMotion:
    """Read a motion of HOOD or VTO at 30 frames per second.

    A pickle of `global_orient`, `body_pose`, `transl` (HOOD) or `pose`, `translation` (VTO).
    """
    values = read_pickle(path, content="motion")
    values = values if isinstance(values, dict) else {}
    pose = next((key for key in ("pose", "poses") if key in values), None)
    move = next((key for key in ("transl", "translation", "trans") if key in values), None)
    if {"global_orient", "body_pose"} <= values.keys():
        parts = (np.atleast_2d(np.asarray(values[key])) for key in ("global_orient", "body_pose"))
        poses = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    elif pose is not None:
        poses = values[pose]
    else:
        found = ", ".join(str(key)[:30] for key in list(values)[:6]) or "no table"
        raise MotionError(f"motion file {path} has {found}; it needs body_pose and global_orient, or pose")
    if move is None:
        raise MotionError(f"motion file {path} has no transl or translation; give a motion of HOOD or VTO")
    return _parameters(path, poses, values[move], HOOD_FPS, "y")


def _parameters(path: Path, poses: Any, moves: Any, fps: float, up: str) -> SkeletonMotion:
    """Return the motion of rotations [frames, 3 joints] [rad] and root translations [m]; `up` is usual."""
    poses, moves = np.asarray(poses), np.asarray(moves)
    is_table = poses.ndim == 2 and poses.dtype.kind in "fiu" and moves.dtype.kind in "fiu" and len(poses) > 0
    joints, rest = divmod(poses.shape[1], 3) if is_table else (0, 0)
    if joints not in JOINT_NAMES or rest or moves.shape != (len(poses), 3):
        raise MotionError(
            f"motion file {path}: rotations {poses.shape} and translations {moves.shape}; expected [frames, 3 "
            f"times {', '.join(map(str, JOINT_NAMES))} joints] and [frames, 3]"
        )
    is_finite = np.isfinite(poses).all(axis=1) & np.isfinite(moves).all(axis=1)
    if not is_finite.all():
        raise MotionError(f"motion file {path}: frame {np.argmin(is_finite)} is not finite; cut or repair it")
    skeleton = _standing_skeleton(joints)
    rotations = chain_rotations(rotation_matrices(poses.reshape(len(poses), -1, 3)), skeleton.parents)
    positions = chain_positions(rotations, moves.astype(np.float64), skeleton)
    return SkeletonMotion(path.stem, skeleton, rotations, positions, fps, usual_up=up)


def _standing_skeleton(joints: int) -> Skeleton:
    """Return SMPL's joints of a person in a T-pose."""
    names, rest = JOINT_NAMES[joints], []
    parents: list[int] = list(_BODY_PARENTS)
    for place, name in enumerate(names[len(_BODY) :], len(_BODY)):
        end = "head" if name in _FACE else f"{name.split('_')[0]}_wrist"
        parents.append(place - 1 if name.endswith(("2", "3")) else _BODY.index(end))
    for name, parent in zip(names, parents, strict=True):
        side, _, word = name.rpartition("_")
        if word in _T_POSE:
            x, y, z = _T_POSE[word]
            rest.append((-x if side == "right" else x, y, z))
        else:
            rest.append(rest[parent])
    return Skeleton(names, tuple(parents), np.array(rest, np.float64))
