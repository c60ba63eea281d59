"""Carry motions from one skeleton to another, and resample, ground and adjust them (host, NumPy).

A motion is `rotations` [frames, joints, 3], local axis-angle vectors [rad] in world-aligned rest axes, and
`translations` [frames, 3], the position of the root joint [m]; Y up, and the rest pose faces +Z.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from eslr_jax.body.joints import Part, find_named_parts
from eslr_jax.errors import MotionError

ARM_ABDUCTION = 12.0  # [degrees]; least that keeps the hanging arms of the bundled walks clear of the torso
_SIDES = ("Left", "Right")
_LIMB_BONES = {"UpLeg": "Leg", "Leg": "Foot", "Arm": "ForeArm", "ForeArm": "Hand"}
_HAND_JOINTS = ("{side}Hand", "{initial}Thumb", "{side}FingerBase", "{side}HandFinger1")


def limb_bones(joint_names: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Bones whose rest direction differs from rig to rig: the limbs, and hands that continue the forearm.

    Args:
        joint_names: Joints of a rig with CMU names (`LeftArm`, `RThumb`, ...).

    Returns:
        For each such joint the two joints that span its bone; absent joints are left out.
    """
    bones = {}
    for side in _SIDES:
        for start, end in _LIMB_BONES.items():
            bones[side + start] = (side + start, side + end)
        for name in _HAND_JOINTS:
            bones[name.format(side=side, initial=side[0])] = (side + "ForeArm", side + "Hand")
    present = set(joint_names)
    return {name: bone for name, bone in bones.items() if present.issuperset((name, *bone))}


def minimal_rotation(start: NDArray, end: NDArray) -> NDArray:
    """Return the smallest rotation that turns direction `start` onto `end`; [3], [3] -> [3, 3]."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis, cosine = np.cross(start, end), float(start @ end)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        return Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix()
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * axis / sine).as_matrix()


def rest_alignments(
    joint_names: Sequence[str], joint_rest_positions: NDArray, source_directions: Mapping[str, NDArray]
) -> NDArray:
    """Return, for each joint, the rotation from the rig's rest bone to the source's rest bone.

    Args:
        joint_names: Joints of the rig.
        joint_rest_positions: Their rest positions [m], shape [joints, 3].
        source_directions: Direction of the source's bone at rest, in the rig's axes, for the joints of
            `limb_bones` that should be aligned; shape [3] each.

    Returns:
        Rotations, identity where nothing is aligned, shape [joints, 3, 3].
    """
    index = {name: i for i, name in enumerate(joint_names)}
    alignments = np.tile(np.eye(3), (len(joint_names), 1, 1))
    for name, (start, end) in limb_bones(joint_names).items():
        if name in source_directions:
            bone = joint_rest_positions[index[end]] - joint_rest_positions[index[start]]
            alignments[index[name]] = minimal_rotation(bone, source_directions[name])
    return alignments


def retarget(
    source_rotations: NDArray, source_joints: Sequence[int], alignments: NDArray, parents: Sequence[int]
) -> NDArray:
    """Return the rig's local rotations that follow a source skeleton's global ones.

    Joint j of the rig turns by G_j = D_s A_j: first from its own rest bone onto the source's (A_j), then as
    the source joint s turned since its rest pose (D_s). So limbs point where the source's point, whatever the
    two rest poses.

    Args:
        source_rotations: Global rotation of each source joint since its rest pose, in the rig's axes, shape
            [frames, source_joints, 3, 3].
        source_joints: Source joint followed by each joint of the rig, shape [joints].
        alignments: See `rest_alignments`, shape [joints, 3, 3].
        parents: Parent of each joint, -1 for the root.

    Returns:
        Local axis-angle rotations [rad], shape [frames, joints, 3].
    """
    return local_rotations(source_rotations[:, list(source_joints)] @ alignments, parents)


def local_rotations(global_rotations: NDArray, parents: Sequence[int]) -> NDArray:
    """Global rotation matrices [frames, joints, 3, 3] to local axis-angle [rad], [frames, joints, 3]."""
    local = np.array(global_rotations, dtype=np.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(global_rotations[:, parent], 1, 2) @ global_rotations[:, joint]
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(local.shape[:3])


def global_rotations(rotations: NDArray, parents: Sequence[int]) -> NDArray:
    """Local axis-angle [rad], [frames, joints, 3], to global rotation matrices [frames, joints, 3, 3]."""
    matrices = _matrices(rotations)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            matrices[:, joint] = matrices[:, parent] @ matrices[:, joint]
    return matrices


def leg_length(joint_names: Sequence[str], joint_rest_positions: NDArray) -> float | None:
    """Length of a thigh and shank: the ratio of two skeletons' legs scales a motion's steps.

    Args:
        joint_names: Joints of a rig, by any names that `find_named_parts` knows.
        joint_rest_positions: Their rest positions, shape [joints, 3].

    Returns:
        The length in the unit of the positions, or None if the rig has no such leg.
    """
    return leg_of(joint_rest_positions, find_named_parts(joint_names))


def leg_of(joint_rest_positions: NDArray, parts: Mapping[Part, Sequence[int]]) -> float | None:
    """Length of a thigh and shank, by the joints of each part; see `leg_length`."""
    for side in ("left", "right"):
        chain = [parts.get((side, name), [None])[0] for name in ("upper_leg", "lower_leg", "foot")]
        if None not in chain:
            bones = np.diff(np.asarray(joint_rest_positions, np.float64)[chain], axis=0)
            length = float(np.linalg.norm(bones, axis=1).sum())
            return length if length > 0 else None
    return None


def abduct_arms(
    rotations: NDArray,
    joint_names: Sequence[str],
    degrees: float = ARM_ABDUCTION,
    *,
    front: Sequence[float] | NDArray = (0.0, 0.0, 1.0),
) -> NDArray:
    """Return the motion with both arms lifted sideways about the chest's front axis.

    Bodies skinned to captured motion press their hanging arms into the torso; a few degrees keep the armpits
    open for a garment.

    Args:
        rotations: Local axis-angle rotations [rad], shape [frames, joints, 3].
        joint_names: Joints of the rig; both upper arms must be among them.
        degrees: Abduction added to each arm [degrees]; zero returns the motion as it is.
        front: Where the resting chest faces, shape [3].

    Returns:
        Rotations [rad], shape [frames, joints, 3].

    Raises:
        MotionError: If the rig has no such arms.
    """
    parts = find_named_parts(joint_names)
    result = np.array(rotations, dtype=np.float64)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        if (side, "upper_arm") not in parts:
            raise MotionError(
                f"the rig has no {side} upper arm ({side.capitalize()}Arm); set the arm abduction to 0"
            )
        arm = parts[side, "upper_arm"][0]
        lift = Rotation.from_rotvec(sign * np.deg2rad(degrees) * np.asarray(front, np.float64))
        result[:, arm] = (lift * Rotation.from_rotvec(result[:, arm])).as_rotvec()
    return result


def resample(
    rotations: NDArray, translations: NDArray, fps_in: float, fps_out: float = 30.0
) -> tuple[NDArray, NDArray]:
    """Return a motion at another frame rate: slerp for rotations, a cubic spline for the root.

    The first frame is kept; the last output frame is the last that falls inside the input.

    Args:
        rotations: Local axis-angle rotations [rad], shape [frames, joints, 3].
        translations: Root positions [m], shape [frames, 3].
        fps_in: Frames per second of the input.
        fps_out: Frames per second wanted.

    Returns:
        Rotations [rad] and translations [m] at `fps_out`.

    Raises:
        MotionError: If the motion is empty or a frame rate is not positive.
    """
    if len(rotations) == 0 or len(rotations) != len(translations):
        raise MotionError(f"{len(rotations)} frames of rotations, {len(translations)} of translations")
    if not (fps_in > 0 and fps_out > 0):
        raise MotionError(f"frame rates must be positive, not {fps_in} and {fps_out}")
    times = np.arange(len(rotations)) / fps_in
    count = int(np.floor(times[-1] * fps_out + 1e-6)) + 1
    return interpolate(rotations, translations, times, np.arange(count) / fps_out)


def interpolate(
    rotations: NDArray, translations: NDArray, times: NDArray, new_times: NDArray
) -> tuple[NDArray, NDArray]:
    """Return a motion at other times, which must lie within the old ones.

    Args:
        rotations: Local axis-angle rotations [rad], shape [frames, joints, 3].
        translations: Root positions [m], shape [frames, 3].
        times: Time of each frame [s], ascending, shape [frames].
        new_times: Times wanted [s], shape [new_frames].

    Returns:
        Rotations [rad], shape [new_frames, joints, 3], and translations [m], shape [new_frames, 3].
    """
    if len(times) == 1:
        repeat = np.zeros(len(new_times), dtype=int)
        return np.asarray(rotations, np.float64)[repeat], np.asarray(translations, np.float64)[repeat]
    before = np.clip(np.searchsorted(times, new_times, side="right") - 1, 0, len(times) - 2)
    fraction = np.clip((new_times - times[before]) / (times[before + 1] - times[before]), 0.0, 1.0)
    start = Rotation.from_rotvec(np.reshape(rotations[before], (-1, 3)))
    end = Rotation.from_rotvec(np.reshape(rotations[before + 1], (-1, 3)))
    step = (start.inv() * end).as_rotvec() * np.repeat(fraction, rotations.shape[1])[:, None]
    turned = (start * Rotation.from_rotvec(step)).as_rotvec().reshape(len(new_times), *rotations.shape[1:])
    return turned, CubicSpline(times, translations)(new_times)


def start_facing_front(rotations: NDArray, translations: NDArray) -> tuple[NDArray, NDArray]:
    """Return the motion moved so that the root starts above the origin and faces +Z.

    Args:
        rotations: Local axis-angle rotations [rad], the root first, shape [frames, joints, 3].
        translations: Root positions [m], shape [frames, 3].

    Returns:
        Rotations [rad] and translations [m]; heights are unchanged.
    """
    front = Rotation.from_rotvec(rotations[0, 0]).apply([0.0, 0.0, 1.0])
    turn = Rotation.from_euler("y", -np.arctan2(front[0], front[2]))
    result = np.array(rotations, dtype=np.float64)
    result[:, 0] = (turn * Rotation.from_rotvec(result[:, 0])).as_rotvec()
    return result, turn.apply(translations - translations[0] * [1.0, 0.0, 1.0])


def _matrices(rotations: NDArray) -> NDArray:
    """Axis-angle [..., 3] to matrices [..., 3, 3]."""
    rotations = np.asarray(rotations, np.float64)
    return Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix().reshape(*rotations.shape, 3)
