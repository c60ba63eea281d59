"""Computed motions for any rig with known joints: turn, jump and swing (host)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from eslr_jax.errors import MotionError
from eslr_jax.pipeline.rigs.rig import body_skeleton
from eslr_jax.pose.joints import Part, find_parts, torso_axes
from eslr_jax.pose.motion import Motion
from eslr_jax.types import Body

FPS = 30.0
SECONDS = 4.0  # length of a motion, with the time at rest
STILL_SECONDS = 1.0  # at rest before anything moves, so that the garment settles
_TURN_RATE = 2.0 * np.pi / 2.0  # [rad/s] at most: once around in two seconds
_JUMP_HEIGHT = 0.3  # [m]
_JUMP_SECONDS = 1.5  # crouch, flight and landing
_CROUCH = 0.12  # [m] the hips sink before and after the flight
_SWING = np.deg2rad(50.0)  # of arms and of the twisting trunk, each way
_SWING_SECONDS = 1.0  # there and back
_GRAVITY = 9.81  # [m/s^2]

_Rotations = dict[Part, NDArray]  # [frames, 3], local axis-angle in left, up, front [rad]
# A movement takes the time since it began [s], shape [frames], and the height of the hips above the floor [m]; it
# returns rotations and root offsets [m].


def turn(time: NDArray, _leg: float) -> tuple[_Rotations, NDArray]:
    """Turn on the spot, first faster, then slower."""
    share = np.clip(time / (SECONDS - STILL_SECONDS), 0.0, 1.0)
    angle = _TURN_RATE * (SECONDS - STILL_SECONDS) * 0.5 * (share - np.sin(2 * np.pi * share) / (2 * np.pi))
    return {("", "hips"): angle[:, None] * [0.0, 1.0, 0.0]}, np.zeros((len(time), 3))


def jump(time: NDArray, leg: float) -> tuple[_Rotations, NDArray]:
    """Jump again and again; the knees bend as the hips sink."""
    phase = np.where(time > 0, np.mod(time, _JUMP_SECONDS), 0.0)
    flight = 2.0 * np.sqrt(2.0 * _JUMP_HEIGHT / _GRAVITY)
    crouch = 0.5 * (_JUMP_SECONDS - flight)
    height = np.zeros(len(time))
    speed = np.sqrt(2.0 * _GRAVITY * _JUMP_HEIGHT)
    for start in (0.0, crouch + flight):
        share = np.clip((phase - start) / crouch, 0.0, 1.0)
        height -= _CROUCH * np.sin(np.pi * share) ** 2
    air = phase - crouch
    is_flying = (air > 0) & (air < flight)
    height = np.where(is_flying, speed * air - 0.5 * _GRAVITY * air**2, height)
    sink = np.clip(-height, 0.0, 0.9 * leg)
    bend = np.arccos(1.0 - sink / leg)  # thigh and shank of equal length, each tilted by this
    tilts = {"upper_leg": -bend, "lower_leg": 2 * bend, "foot": -bend}
    sides = [(side, part) for side in ("left", "right") for part in tilts]
    rotations = {joint: tilts[joint[1]][:, None] * [1.0, 0.0, 0.0] for joint in sides}
    return rotations, height[:, None] * [0.0, 1.0, 0.0]


def swing(time: NDArray, _leg: float) -> tuple[_Rotations, NDArray]:
    """Twist the trunk, and swing the arms against each other."""
    ramp = np.clip(time / _SWING_SECONDS, 0.0, 1.0)
    angle = _SWING * ramp * np.sin(2 * np.pi * time / _SWING_SECONDS)
    rotations: _Rotations = {("", "spine"): 0.5 * angle[:, None] * [0.0, 1.0, 0.0]}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        rotations[side, "upper_arm"] = sign * angle[:, None] * [1.0, 0.0, 0.0]
    return rotations, np.zeros((len(time), 3))


PROCEDURAL: dict[str, Callable[[NDArray, float], tuple[_Rotations, NDArray]]] = {
    movement.__name__: movement for movement in (turn, jump, swing)
}


def make_procedural(name: str, body: Body) -> Motion:
    """Return a computed motion of `PROCEDURAL` for a body: a second in the rest pose, then the movement.

    Parts that the body lacks don't move.

    Raises:
        MotionError: The rig has none of the joints that move.
    """
    skeleton = body_skeleton(body)
    parts = find_parts(skeleton)
    axes = torso_axes(skeleton, parts)
    axes = np.eye(3) if axes is None else np.round(axes)
    axes = np.eye(3) if abs(np.linalg.det(axes)) < 0.5 else axes  # the torso lies between our axes
    time = np.arange(int(SECONDS * FPS) + 1) / FPS - STILL_SECONDS
    root = skeleton.rest_positions[0] - [0.0, float(np.asarray(body.rest_positions)[:, 1].min()), 0.0]
    moved, offsets = PROCEDURAL[name](np.maximum(time, 0.0), max(root[1], 1e-3))
    rotations = np.zeros((len(time), len(skeleton), 3))
    joints = {part: parts[part][0] for part in moved if part in parts}
    for part, joint in joints.items():
        rotations[:, joint] = moved[part] @ axes.T
    if not joints:
        known = ", ".join(skeleton.joint_names[:6])
        raise MotionError(
            f"motion {name} moves joints that this body lacks ({known}, ...); give another motion"
        )
    return Motion(name, rotations, root + offsets, FPS, skeleton.joint_names, arm_abduction=0.0)
