"""What readers of bodies and motions return: a rigged mesh, and a skeleton that moves.

Axes are right-handed, Y up, in metres where the format has a unit. The rest pose of a file is its bind pose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from eslr_jax.errors import AssetError, MotionError

MAX_JOINTS = 4096  # more than any character has; a damaged file may claim more
MAX_FRAMES = 1 << 20  # nine hours at 30 frames per second
MAX_POSES = 1 << 23  # frames times joints: half a gigabyte of matrices
_ROUNDED = 2e-4  # share of a frame rate that rounded times lose; 29.97 is five times as far from 30


def whole_rate(rate: float) -> float:
    """Return a frame rate [1/s] measured from rounded times: a whole number if it misses one by little."""
    nearest = float(np.round(rate))
    return nearest if abs(rate - nearest) < _ROUNDED * rate else rate


@dataclasses.dataclass(frozen=True)
class Skeleton:
    """Named joints at rest."""

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]  # -1 is the root, joint 0; a parent comes before its children
    rest_positions: np.ndarray  # [joints, 3]

    def __len__(self) -> int:
        """Number of joints."""
        return len(self.joint_names)


@dataclasses.dataclass(frozen=True)
class SkeletonMotion:
    """A skeleton that moves, joint by joint in world space."""

    name: str
    skeleton: Skeleton
    rotations: np.ndarray  # in world axes since the rest pose [frames, joints, 3, 3]
    positions: np.ndarray  # [frames, joints, 3]
    fps: float  # [1/s]
    # Only for formats without a skeleton, whose positions are relative to the root of the body's own rest pose,
    # which is Y up whatever the file: the axis "y" or "z" that points up in most of their files.
    usual_up: str | None = None

    def __post_init__(self) -> None:
        """Raise a MotionError unless there are frames of finite values at a possible rate."""
        joints = len(self.skeleton.parents)
        tracks = {"rotations": (self.rotations, (joints, 3, 3)), "positions": (self.positions, (joints, 3))}
        check_tracks(f"motion {self.name}", tracks, self.fps)


def check_tracks(what: str, tracks: Mapping[str, tuple[np.ndarray, tuple[int, ...]]], fps: float) -> None:
    """Raise a MotionError unless arrays have frames of finite values, each of its shape, at a possible rate."""
    frames = min(len(values) for values, _ in tracks.values())
    if not 0 < frames <= MAX_FRAMES:
        raise MotionError(f"{what} has {frames or 'no'} frames; give 1 to {MAX_FRAMES}")
    for label, (values, shape) in tracks.items():
        if values.shape != (frames, *shape):
            raise MotionError(f"{what}: {label} {values.shape} do not fit its {frames} frames of {shape}")
        is_bad = ~np.isfinite(values.reshape(frames, -1)).all(axis=1)
        if is_bad.any():
            raise MotionError(
                f"{what}: {label} of frame {np.argmax(is_bad)} are not finite; cut or repair it"
            )
    if not 1.0 <= fps <= 1000.0:
        raise MotionError(f"{what}: {fps} frames per second; expected 1 to 1000")


@dataclasses.dataclass(frozen=True)
class RiggedMesh:
    """A body as its file has it, in the rest pose."""

    name: str
    positions: np.ndarray  # [vertices, 3] [m]
    faces: np.ndarray  # [faces, 3]
    skin_weights: np.ndarray  # [vertices, influences], rows sum to one
    skin_indices: np.ndarray  # [vertices, influences]
    skeleton: Skeleton
    shape_directions: np.ndarray | None = None  # [vertices, 3, shapes] [m] per standard deviation
    joint_shape_directions: np.ndarray | None = None  # [joints, 3, shapes]
    pose_directions: np.ndarray | None = None  # [vertices, 3, 9 (joints - 1)], of the entries of R - I


def order_joints(names: list[str], parents: list[int], *, what: str) -> tuple[list[int], list[int]]:
    """Return joints with parents before children, and the parent of each in that order.

    A parent of -1 is a root; further ones become children of the first. Messages say `names`, and `what` for the
    file.

    Raises:
        AssetError: There are no joints, too many joints, or a cycle.
    """
    if not 0 < len(names) <= MAX_JOINTS:
        raise AssetError(f"{what} has {len(names)} joints; expected 1 to {MAX_JOINTS}")
    if any(not -1 <= parent < len(names) for parent in parents) or -1 not in parents:
        raise AssetError(f"{what} has joints without a root; export the skeleton again")
    root = parents.index(-1)
    if root == 0 and all(0 <= parent < joint for joint, parent in enumerate(parents[1:], 1)):
        return list(range(len(names))), parents  # as the file has it
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(parents):
        if joint != root:
            children.setdefault(root if parent < 0 else parent, []).append(joint)
    order, new_parents = [root], [-1]
    for position, joint in enumerate(order):
        order += children.get(joint, [])
        new_parents += [position] * len(children.get(joint, []))
    if len(order) != len(names):
        lost = next(joint for joint in range(len(names)) if joint not in order)
        raise AssetError(f"{what} has joint {names[lost]!r} in a cycle of parents; export the skeleton again")
    return order, new_parents


def unique_names(names: list[str]) -> list[str]:
    """Return distinct names: a repeated one gets a number, as in hand, hand.2."""
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name}.{seen[name]}")
    return result


def nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to each matrix [..., 3, 3], without its scale and shear."""
    left, _, right = np.linalg.svd(matrices)
    sign = np.sign(np.linalg.det(left @ right))
    left[..., :, 2] *= np.where(sign == 0, 1.0, sign)[..., None]
    return left @ right


def chain_rotations(local: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
    """Return rotations in world axes of local ones, both [frames, joints, 3, 3]; parents come before children."""
    result = np.array(local, np.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            result[:, joint] = result[:, parent] @ result[:, joint]
    return result


def chain_offsets(rotations: np.ndarray, offsets: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
    """Return the positions [frames, joints, 3] of joints at turned offsets from their parents.

    Rotations are in world axes since the rest pose [frames, joints, 3, 3], and offsets in the rest pose's axes
    [frames, joints, 3]. A parent comes before its children.
    """
    result = np.array(offsets, np.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            moved = np.einsum("tab,tb->ta", rotations[:, parent], result[:, joint])
            result[:, joint] = result[:, parent] + moved
    return result


def chain_positions(rotations: np.ndarray, root: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Return the positions [frames, joints, 3] of the joints of rigid bones, with those of joint 0 [frames, 3].

    Rotations are in world axes since the rest pose [frames, joints, 3, 3].
    """
    rest = skeleton.rest_positions
    offsets = np.tile(rest - rest[np.maximum(skeleton.parents, 0)], (len(rotations), 1, 1))
    offsets[:, np.asarray(skeleton.parents) < 0] = np.asarray(root)[:, None]
    return chain_offsets(rotations, offsets, skeleton.parents)


def pose_offsets(
    name: str,
    joint_names: list[str],
    parents: list[int],
    rest_offsets: np.ndarray,
    local: np.ndarray,
    offsets: np.ndarray,
    fps: float,
) -> SkeletonMotion:
    """Return the motion of joints that are each told relative to their parent; -1 is a root.

    `rest_offsets` [joints, 3] and `offsets` [frames, joints, 3] are positions, `local` rotations
    [frames, joints, 3, 3].
    """
    names = unique_names(joint_names)
    order, new_parents = order_joints(names, parents, what=f"motion {name}")
    chain = tuple(new_parents)
    rotations = chain_rotations(local[:, order], chain)
    rest = chain_offsets(np.tile(np.eye(3), (1, len(order), 1, 1)), rest_offsets[None, order], chain)[0]
    skeleton = Skeleton(tuple(names[joint] for joint in order), chain, rest)
    return SkeletonMotion(name, skeleton, rotations, chain_offsets(rotations, offsets[:, order], chain), fps)


def rotation_matrices(vectors: np.ndarray) -> np.ndarray:
    """Return the rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] [rad]."""
    vectors = np.asarray(vectors, np.float64)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
