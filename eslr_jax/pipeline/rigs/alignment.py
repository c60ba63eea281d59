"""Scale and rotations between the rest poses of two rigs (host)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MotionError
from eslr_jax.pose.joints import HAND, Part, find_parts, torso_axes
from eslr_jax.pose.skeleton import Skeleton, SkeletonMotion

SAME_REST = 1e-3  # [m] by which the rest joints of one rig differ from file to file
ORDINARY_TILT = np.deg2rad(35.0)  # rest poses that lean less than this are taken to stand alike
MAX_LEG_TURN = np.deg2rad(75.0)  # between the legs of two rest poses that both stand
MAX_NEAREST_TURN = np.deg2rad(120.0)  # of a leg in the frame nearest to the rest pose: one that sits has 90
_LEG = ("upper_leg", "lower_leg")
LIMBS = {"upper_leg": "lower_leg", "lower_leg": "foot", "upper_arm": "forearm", "forearm": "hand"}
_BEFORE = {
    "upper_leg": "hips", "lower_leg": "upper_leg", "foot": "hips",
    "clavicle": "chest", "upper_arm": "chest", "forearm": "upper_arm",
}  # fmt: skip

Parts = Mapping[Part, list[int]]  # joints of each part of a rig


def match_parts(target: Skeleton, source: Skeleton, followed: list[int]) -> tuple[Parts, Parts]:
    """Return the joints of each part that both rigs have: those of the body, and those of the source.

    `followed` has the joint of the source that each joint of the body follows, or -1.
    """
    ours: dict[Part, list[int]] = {}
    theirs: dict[Part, list[int]] = {}
    known, others = find_parts(target), find_parts(source)
    part_of = {joint: part for part, joints in known.items() for joint in joints}
    part_of_other = {joint: part for part, joints in others.items() for joint in joints}
    for joint, other in enumerate(followed):
        part = part_of.get(joint) or part_of_other.get(other)
        if other >= 0 and part is not None:
            ours.setdefault(part, []).append(joint)
            theirs.setdefault(part, []).append(other)
    ours["", "hips"], theirs["", "hips"] = [0], others["", "hips"] if followed[0] < 0 else [followed[0]]
    return ours, theirs


def rig_scale(target: Skeleton, source: Skeleton, followed: list[int]) -> float | None:
    """Return the metres per unit of the source if it is the body's rig in other units; None for another rig."""
    names = source.joint_names
    if any(
        other < 0 or names[other] != name for name, other in zip(target.joint_names, followed, strict=True)
    ):
        return None
    theirs = source.rest_positions[followed] - source.rest_positions[followed[0]]
    ours = target.rest_positions - target.rest_positions[0]
    scale = float((ours * theirs).sum() / max((theirs**2).sum(), 1e-30))
    for factor in (1.0, scale):
        if np.abs(factor * theirs - ours).max() < SAME_REST:
            return factor
    return None


def align_rests(
    target: Skeleton, source: Skeleton, ours: Parts, theirs: Parts, motion: SkeletonMotion | None = None
) -> NDArray:
    """Return the rotation from the body's rest pose to the source's for each joint, shape [joints, 3, 3].

    A limb turns as little as lays the body's bone along the source's. If the source's legs do not stand at rest,
    as when all bones lie along one axis, the frames of its motion, Y up, decide; see `_turns_of_frames`. `ours`
    and `theirs` are the joints of each part; see `match_parts`.

    Raises:
        MotionError: The source's legs stand neither at rest nor in a frame.
    """
    upright = _torso_turn(target, ours, source, theirs)
    limbs = _find_limbs(target, source, ours, theirs)
    turns = {part: _smallest_turn(upright @ bone, end) @ upright for part, (bone, end) in limbs.items()}
    legs = [limb for part, limb in limbs.items() if part[1] in _LEG]
    if any(_angle_between(upright @ bone, end) > MAX_LEG_TURN for bone, end in legs):
        if motion is None:
            raise MotionError("the rest pose of a skeleton does not stand; export it with a T-pose at rest")
        turns = _turns_of_frames(limbs, theirs, upright, motion)
    result = np.tile(upright, (len(target), 1, 1))
    continued = {"forearm": HAND, "foot": ("toe",)}
    for (side, chain), turn in turns.items():
        for part in (chain, *continued.get(chain, ())):
            result[ours.get((side, part), [])] = turn
    return result


def _find_limbs(
    target: Skeleton, source: Skeleton, ours: Parts, theirs: Parts
) -> dict[Part, tuple[NDArray, NDArray]]:
    """Return the resting bones of limbs that both rigs have: the body's, and the source's."""
    found = {}
    for side, chain in ((side, chain) for side in ("left", "right") for chain in LIMBS):
        pair = (side, LIMBS[chain]), (side, chain)
        if all(part in ours and part in theirs for part in pair):
            bone, other = (
                np.subtract(*(rig.rest_positions[joints[part][0]] for part in pair))
                for rig, joints in ((target, ours), (source, theirs))
            )
            if min(np.linalg.norm(bone), np.linalg.norm(other)) >= 1e-9:
                found[side, chain] = bone, other
    return found


def _turns_of_frames(
    limbs: Mapping[Part, tuple[NDArray, NDArray]], theirs: Parts, upright: NDArray, motion: SkeletonMotion
) -> dict[Part, NDArray]:
    """Return the turns of limbs between rest poses of which the source's does not stand, shape [3, 3] each.

    A bone's turn is the smallest in the frame in which it is nearest to the body's rest pose as the bone before
    it has turned it. How feet and shoulders slope differs from rig to rig, so that bones don't tell: a foot is
    as the hips under a shin that points down, in the frame in which the lower half of the ankle's heights has the
    shin most upright, and a shoulder as the chest in the frame in which the leg of its side is straightest.
    """
    hips = theirs["", "hips"]
    trunk = {"hips": hips[0], "chest": theirs.get(("", "spine"), hips)[-1]}
    up = np.array([0.0, 1.0, 0.0])
    turns: dict[Part, NDArray] = {}
    for side in ("left", "right"):
        # In world axes since the body's rest pose, in every frame.
        turned = {chain: motion.rotations[:, joint] @ upright for chain, joint in trunk.items()}
        bent = np.zeros(len(motion.rotations))  # by how much the leg is, in every frame [rad]
        for chain in (chain for chain in _BEFORE if (side, chain) in theirs and _BEFORE[chain] in turned):
            carried, moved = turned[_BEFORE[chain]], motion.rotations[:, theirs[side, chain][0]]
            if (side, chain) in limbs:
                bone, end = limbs[side, chain]
                away = _angle_between(carried @ bone, moved @ end)
                frame = int(away.argmin())
                if chain in _LEG and away[frame] > MAX_NEAREST_TURN:
                    raise MotionError(
                        f"motion {motion.name}: it stands neither at rest nor in a frame ({side} {chain} points "
                        "elsewhere); export it with a T-pose at rest"
                    )
                bent += away * (chain in _LEG)
                turn = _smallest_turn(carried[frame] @ bone, moved[frame] @ end) @ carried[frame]
            elif chain == "foot" and (side, "lower_leg") in limbs:
                ankle, knee = (motion.positions[:, theirs[side, part][0]] for part in ("foot", "lower_leg"))
                is_lifted = ankle[:, 1] > np.median(ankle[:, 1])
                frame = int((_angle_between(knee - ankle, up) + np.pi * is_lifted).argmin())
                turn = _smallest_turn(carried[frame] @ up, (knee - ankle)[frame]) @ carried[frame]
            else:
                frame = int(bent.argmin())
                turn = carried[frame]
            turns[side, chain] = moved[frame].T @ turn
            turned[chain] = moved @ turns[side, chain]
    return turns


def _smallest_turn(start: NDArray, end: NDArray) -> NDArray:
    return Rotation.align_vectors(end[None], start[None])[0].as_matrix()


def _angle_between(one: NDArray, other: NDArray) -> NDArray:
    """Return the angle between directions [rad], each of shape [..., 3]."""
    return np.arctan2(np.linalg.norm(np.cross(one, other), axis=-1), (one * other).sum(-1))


def _torso_turn(target: Skeleton, ours: Parts, source: Skeleton, theirs: Parts) -> NDArray:
    """Return the rotation from the body's rest torso to the source's, shape [3, 3].

    If a combination of quarter turns is near this rotation, that combination is returned: two rest poses that
    stand alike still lean by some degrees.
    """
    one, other = torso_axes(target, ours), torso_axes(source, theirs)
    if one is None or other is None:
        return np.eye(3)
    turn = other @ one.T
    quarters = Rotation.create_group("O").as_matrix()
    # Rounding may carry a cosine beyond 1.
    angles = np.arccos(np.clip((np.einsum("nab,ab->n", quarters, turn) - 1) / 2, -1, 1))
    return np.round(quarters[angles.argmin()]) if angles.min() < ORDINARY_TILT else turn
