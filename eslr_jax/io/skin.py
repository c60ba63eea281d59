"""Describe how joints move a mesh, in the terms of scene formats: influences, local motions, corrections."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MeshError, MotionError

_RIGID_TOLERANCE = 1e-3  # entries of R^T R - I that forward kinematics in float32 may reach
_FLAT = 0.05  # determinant of blended rotations below which a vertex can't be moved in every direction
_NEGLIGIBLE_WEIGHT = (
    1e-6  # a skin weight that moves a vertex by less than float32 resolves over a body's size
)


@dataclasses.dataclass(frozen=True)
class Skin:
    """Joints that move, and how a mesh is bound to them: posed = sum_j weight_j (R_j rest + t_j)."""

    skin_weights: np.ndarray  # [vertices, influences], rows sum to one
    skin_indices: np.ndarray  # [vertices, influences]
    joint_transforms: np.ndarray  # [frames, joints, 3, 4], rest point -> posed point [m]
    joint_rest_positions: np.ndarray  # [joints, 3] [m]
    parents: Sequence[int]  # -1 is a root
    joint_names: Sequence[str]


def check_skin(name: str, skin: Skin, num_vertices: int) -> None:
    """Raise unless a skin is that of a mesh, and its joints move rigidly.

    Args:
        name: Name of the mesh, for messages.
        skin: The skin.
        num_vertices: Number of vertices of the mesh.

    Raises:
        MeshError: The weights don't fit the mesh.
        MotionError: The joints don't fit each other, or a transform is no rotation with a translation.
    """
    weights, indices = np.asarray(skin.skin_weights), np.asarray(skin.skin_indices)
    transforms = np.asarray(skin.joint_transforms)
    joints = len(skin.parents)
    if (
        transforms.shape[1:] != (joints, 3, 4)
        or np.shape(skin.joint_rest_positions) != (joints, 3)
        or len(skin.joint_names) != joints
    ):
        raise MotionError(
            f"{name} has joint transforms {transforms.shape}, {len(skin.joint_rest_positions)} rest positions, "
            f"{joints} parents and {len(skin.joint_names)} names; they must be of the same joints"
        )
    if weights.shape != indices.shape or weights.ndim != 2 or len(weights) != num_vertices:
        raise MeshError(
            f"mesh {name} has skin weights {weights.shape} and skin indices {indices.shape}; "
            f"both must be [{num_vertices}, influences]"
        )
    if indices.min() < 0 or indices.max() >= joints:
        raise MeshError(f"mesh {name} has a skin weight for joint {indices.max()} of {joints}")
    if weights.min() < 0 or not np.allclose(weights.sum(1), 1, atol=1e-3):
        raise MeshError(
            f"mesh {name} has skin weights that are negative or don't sum to one; normalise them first"
        )
    matrices = transforms[..., :3]
    gram = np.einsum("tjab,tjac->tjbc", matrices, matrices)
    is_rigid = (np.abs(gram - np.eye(3)) < _RIGID_TOLERANCE).all((2, 3)) & (np.linalg.det(matrices) > 0)
    is_rigid &= np.isfinite(transforms).all((2, 3))
    if not is_rigid.all():
        frame, joint = np.argwhere(~is_rigid)[0]
        raise MotionError(
            f"{name}: joint {joint} is not rotated rigidly in frame {frame}; leave out its skin"
        )


def influences(skin: Skin) -> tuple[np.ndarray, np.ndarray]:
    """Return skin weights that matter, largest first, and their joints, both [vertices, influences]."""
    weights, indices = np.asarray(skin.skin_weights, np.float64), np.asarray(skin.skin_indices)
    order = np.argsort(-weights, axis=1, kind="stable")
    weights, indices = np.take_along_axis(weights, order, 1), np.take_along_axis(indices, order, 1)
    used = max(1, int((weights > _NEGLIGIBLE_WEIGHT).any(0).sum()))
    weights, indices = weights[:, :used], indices[:, :used]
    return weights / weights.sum(1, keepdims=True), np.where(weights > 0, indices, 0)


def local_motion(skin: Skin) -> tuple[np.ndarray, np.ndarray]:
    """Split joint transforms into rotations and translations relative to each joint's parent.

    Returns:
        Quaternions (x, y, z, w), shape [frames, joints, 4], which never take the long way round from one frame to
        the next, and translations [m], shape [frames, joints, 3]. At rest no joint is rotated.
    """
    transforms = np.asarray(skin.joint_transforms, np.float64)
    matrices, rest = transforms[..., :3], np.asarray(skin.joint_rest_positions, np.float64)
    origins = np.einsum("tjab,jb->tja", matrices, rest) + transforms[..., 3]
    rotations, translations = np.empty((*transforms.shape[:2], 4)), np.empty((*transforms.shape[:2], 3))
    for joint, parent in enumerate(skin.parents):
        local, shift = matrices[:, joint], origins[:, joint]
        if parent >= 0:
            local = np.einsum("tba,tbc->tac", matrices[:, parent], local)
            shift = np.einsum("tba,tb->ta", matrices[:, parent], shift - origins[:, parent])
        quaternions = Rotation.from_matrix(local).as_quat()
        flips = np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1]) < 0
        signs = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
        rotations[:, joint], translations[:, joint] = quaternions * signs[:, None], shift
    return rotations.astype(np.float32), translations.astype(np.float32)


def corrections(skin: Skin, rest: np.ndarray, positions: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Return what to add to the rest vertices so that the joints move them to given positions.

    Args:
        skin: The skin.
        rest: Vertex positions at rest [m], shape [vertices, 3].
        positions: Vertex positions [m], shape [frames, vertices, 3].
        tolerance: Distance that needs no correction [m].

    Returns:
        Offsets [m], shape [frames, vertices, 3], float32; None where the joints alone keep the tolerance.
    """
    weights, indices = influences(skin)
    rows = np.repeat(np.arange(len(rest)), weights.shape[1])
    blend = scipy.sparse.csr_array((weights.ravel(), (rows, indices.ravel())), (len(rest), len(skin.parents)))
    transforms = np.asarray(skin.joint_transforms, np.float64).reshape(len(positions), -1, 12)

    def blended(frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return each vertex's matrix, and what the joints leave of its way."""
        matrices = (blend @ transforms[frame]).reshape(-1, 3, 4)
        moved = np.einsum("vab,vb->va", matrices[..., :3], rest) + matrices[..., 3]
        return matrices[..., :3], positions[frame] - moved

    frames = range(len(positions))
    if all(np.linalg.norm(blended(frame)[1], axis=1).max() <= tolerance for frame in frames):
        return None
    result = np.zeros(np.shape(positions), np.float32)
    for frame in frames:
        matrices, away = blended(frame)
        # Where opposite rotations cancel, no offset helps: a blend of rotations near zero counts as the identity.
        is_flat = np.abs(np.linalg.det(matrices)) < _FLAT
        matrices[is_flat] = np.eye(3)
        result[frame] = np.linalg.solve(matrices, away[..., None])[..., 0]
    return result
