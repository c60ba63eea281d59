"""Rotations of a rig's joints over time: local to global, resampled, and with lifted arms (host, NumPy).

A motion is `rotations` [frames, joints, 3], local axis-angle vectors [rad] in world-aligned rest axes, and
`translations` [frames, 3], the position of the root joint [m]. Y is up, and the rest pose faces +Z.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MotionError
from eslr_jax.pose.joints import Part, find_named_parts
from eslr_jax.pose.skeleton import chain_rotations, rotation_matrices

ARM_ABDUCTION = 12.0  # [degrees]; least that keeps the hanging arms of the bundled walks clear of the torso


def local_rotations(global_rotations: NDArray, parents: Sequence[int]) -> NDArray:
    """Return local axis-angle rotations [rad] of matrices since the rest pose, shape [frames, joints, 3, 3]."""
    local = np.array(global_rotations, dtype=np.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(global_rotations[:, parent], 1, 2) @ global_rotations[:, joint]
    return Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(local.shape[:3])


def global_rotations(rotations: NDArray, parents: Sequence[int]) -> NDArray:
    """Return rotation matrices since the rest pose, shape [frames, joints, 3, 3]."""
    return chain_rotations(rotation_matrices(rotations), tuple(parents))


def leg_length(joint_rest_positions: NDArray, parts: Mapping[Part, Sequence[int]]) -> float | None:
    """Return the length of a thigh and shank in the unit of the positions, or None without such a leg."""
    for side in ("left", "right"):
        chain = [parts.get((side, name), [None])[0] for name in ("upper_leg", "lower_leg", "foot")]
        if None not in chain:
            bones = np.diff(np.asarray(joint_rest_positions, np.float64)[chain], axis=0)
            return float(np.linalg.norm(bones, axis=1).sum()) or None
    return None


def abduct_arms(
    rotations: NDArray,
    joint_names: Sequence[str],
    degrees: float = ARM_ABDUCTION,
    *,
    front: Sequence[float] | NDArray = (0.0, 0.0, 1.0),
) -> NDArray:
    """Return rotations with both arms lifted sideways, shape [frames, joints, 3] [rad], or raise a MotionError.

    Bodies skinned to captured motion press their hanging arms into the torso; a few degrees keep the armpits open
    for a garment. `front` is the direction that the resting chest faces.
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


def count_resampled(num_frames: int, fps_in: float, fps_out: float) -> int:
    """Return how many frames a motion has at another rate: its last one lies inside the motion."""
    return int(np.floor((num_frames - 1) / fps_in * fps_out + 1e-6)) + 1


def resample(
    rotations: NDArray, translations: NDArray, fps_in: float, fps_out: float = 30.0
) -> tuple[NDArray, NDArray]:
    """Return a motion at another frame rate: slerp for rotations, a cubic spline for the root.

    The first frame is kept; the last output frame is the last that falls inside the input. A MotionError says
    where the motion is empty or a frame rate is not positive.
    """
    if len(rotations) == 0 or len(rotations) != len(translations):
        raise MotionError(f"{len(rotations)} frames of rotations, {len(translations)} of translations")
    if not (fps_in > 0 and fps_out > 0):
        raise MotionError(f"frame rates must be positive, not {fps_in} and {fps_out}")
    times = np.arange(len(rotations)) / fps_in
    count = count_resampled(len(rotations), fps_in, fps_out)
    return interpolate(rotations, translations, times, np.arange(count) / fps_out)


def interpolate(
    rotations: NDArray, translations: NDArray, times: NDArray, new_times: NDArray
) -> tuple[NDArray, NDArray]:
    """Return rotations [rad] and translations [m] at other times [s], which must lie within the old ones."""
    if len(times) == 1:
        repeat = np.zeros(len(new_times), dtype=int)
        return np.asarray(rotations, np.float64)[repeat], np.asarray(translations, np.float64)[repeat]
    before = np.clip(np.searchsorted(times, new_times, side="right") - 1, 0, len(times) - 2)
    fraction = np.clip((new_times - times[before]) / (times[before + 1] - times[before]), 0.0, 1.0)
    turned = blend_rotations(rotations[before], rotations[before + 1], fraction)
    return turned, CubicSpline(times, translations)(new_times)


def blend_rotations(start: NDArray, end: NDArray, fraction: NDArray) -> NDArray:
    """Return rotations at a share of the way between two, the shorter way [rad], shape [frames, joints, 3]."""
    first, last = (Rotation.from_rotvec(np.reshape(values, (-1, 3))) for values in (start, end))
    step = (first.inv() * last).as_rotvec() * np.repeat(fraction, start.shape[1])[:, None]
    return (first * Rotation.from_rotvec(step)).as_rotvec().reshape(start.shape)
