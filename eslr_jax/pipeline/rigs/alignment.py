"""Scale and rotations between the rest poses of two rigs (host)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MotionError
from eslr_jax.pose.joints import HAND, Part, find_parts, torso_axes
from eslr_jax.pose.skeleton import Skeleton

SAME_REST = 1e-3  # [m] by which the rest joints of one rig differ from file to file
ORDINARY_TILT = np.deg2rad(35.0)  # rest poses that lean less than this are taken to stand alike
MAX_LEG_TURN = np.deg2rad(75.0)  # between the legs of two rest poses that both stand
_LIMBS = {"upper_leg": "lower_leg", "lower_leg": "foot", "upper_arm": "forearm", "forearm": "hand"}

Parts = Mapping[Part, list[int]]  # joints of each part of a rig


def match_parts(
    target: Skeleton, source: Skeleton, followed: list[int]
) -> tuple[dict[Part, list[int]], dict[Part, list[int]]]:
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


def align_rests(target: Skeleton, source: Skeleton, ours: Parts, theirs: Parts, name: str) -> NDArray:
    """Return the rotation from the body's rest pose to the source's for each joint, shape [joints, 3, 3].

    `ours` and `theirs` are the joints by part; see `match_parts`. `name` is what messages call the motion.

    Raises:
        MotionError: The source's rest pose does not stand.
    """
    upright = _torso_turn(target, ours, source, theirs)
    result = np.tile(upright, (len(target), 1, 1))
    for side in ("left", "right"):
        for chain, beyond in _LIMBS.items():
            parts = (side, chain), (side, beyond)
            if not all(part in ours and part in theirs for part in parts):
                continue
            bone, other = (
                np.subtract(*(rig.rest_positions[joints[part][0]] for part in reversed(parts)))
                for rig, joints in ((target, ours), (source, theirs))
            )
            if min(np.linalg.norm(bone), np.linalg.norm(other)) < 1e-9:
                continue
            # Of all rotations that do it, the smallest.
            turn = Rotation.align_vectors(other[None], (upright @ bone)[None])[0].as_matrix()
            if beyond in ("lower_leg", "foot") and _angle(np.trace(turn)) > MAX_LEG_TURN:
                raise MotionError(
                    f"motion {name}: its rest pose does not stand ({side} {chain} points elsewhere); "
                    "export it with a T-pose at rest"
                )
            chains = (chain, *HAND) if chain == "forearm" else (chain,)
            for part in chains:
                result[ours.get((side, part), [])] = turn @ upright
    return result


def _angle(trace: NDArray) -> NDArray:
    """Return the angles of rotations [rad] from the traces of their matrices; rounding may exceed the range."""
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


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
    angles = _angle(np.einsum("nab,ab->n", quarters, turn))
    return np.round(quarters[angles.argmin()]) if angles.min() < ORDINARY_TILT else turn
