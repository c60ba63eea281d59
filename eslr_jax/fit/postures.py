"""The body with its arms at the angles in which garments are modelled: T-pose, A-poses, arms hanging."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from eslr_jax.body.motion import joint_transforms, skin_frames
from eslr_jax.geometry.topology import face_cross_products
from eslr_jax.types import Body

ARM_ANGLES = (0.0, 25.0, 45.0, 65.0)  # degrees below the horizontal that are tried; 0 is the T-pose
_OFF_AXIS = 0.04  # of the body's height: joints farther from the middle belong to a limb


@dataclasses.dataclass(frozen=True)
class Posture:
    """A body with its arms at one angle, ready for queries of distance."""

    positions: Float[np.ndarray, "body_vertices 3"]  # [m]
    normals: Float[np.ndarray, "body_vertices 3"]
    transforms: Float[np.ndarray, "joints 3 4"]  # rest -> this posture
    faces: Int[np.ndarray, "body_faces 3"]
    is_obstacle: Bool[np.ndarray, " body_faces"]
    arm_angle: float | None  # degrees below the horizontal; None: the rest pose as it is

    @cached_property
    def touchable(self) -> Int[np.ndarray, " touchable"]:
        """Vertices of the faces that cloth may touch."""
        return np.unique(self.faces[self.is_obstacle])

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the touchable vertices."""
        return cKDTree(self.positions[self.touchable])

    def heights(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Return the distance of every point to the nearest touchable vertex [m], negative inside."""
        distance, nearest = self.tree.query(points)
        vertex = self.touchable[nearest]
        side = np.einsum("px,px->p", points - self.positions[vertex], self.normals[vertex])
        return np.where(side < 0, -distance, distance)


def rest_posture(body: Body) -> Posture:
    """Return the body in its rest pose."""
    return _posture(body, np.asarray(body.rest_positions, np.float64), _identity(body), None)


def arm_postures(body: Body) -> list[Posture]:
    """Return the rest posture and, where the body has arms, one for each of `ARM_ANGLES` that differs."""
    arms = find_arms(body)
    if arms is None:
        return [rest_posture(body)]
    joints = np.asarray(body.joint_rest_positions, np.float64)
    rest_angles = []
    for joint, child in arms:
        bone = joints[child] - joints[joint]
        rest_angles.append(np.degrees(np.arctan2(-bone[1], abs(bone[0]))))
    angles = [angle for angle in ARM_ANGLES if max(abs(angle - rest) for rest in rest_angles) > 5.0]
    rotations = np.zeros((len(angles), len(joints), 3))
    for (joint, child), rest_angle in zip(arms, rest_angles, strict=True):
        side = np.sign(joints[child, 0] - joints[joint, 0])
        rotations[:, joint, 2] = side * np.radians(rest_angle - np.array(angles))
    translations = np.tile(joints[body.parents.index(-1)], (len(angles), 1))
    transforms = joint_transforms(rotations, translations, body.joint_rest_positions, body.parents)
    posed = np.asarray(
        skin_frames(body.rest_positions, body.skin_weights, body.skin_indices, transforms), np.float64
    )
    turned = [
        _posture(body, posed[k], np.asarray(transforms[k], np.float64), angle)
        for k, angle in enumerate(angles)
    ]
    return [rest_posture(body), *turned]


def find_arms(body: Body) -> list[tuple[int, int]] | None:
    """Return (upper arm, forearm) joints of both sides by the shape of the rig alone; None without arms.

    The joint farthest to a side is a fingertip. Of the bones from it to the middle of the body, the two
    longest are upper arm and forearm.
    """
    joints = np.asarray(body.joint_rest_positions, np.float64)
    positions = np.asarray(body.rest_positions)
    off_axis = _OFF_AXIS * float(np.ptp(positions[:, 1]))
    arms = []
    for side in (1.0, -1.0):
        tip = int(np.argmax(side * joints[:, 0]))
        chain = [tip]
        while body.parents[chain[-1]] >= 0 and side * joints[body.parents[chain[-1]], 0] > off_axis:
            chain.append(body.parents[chain[-1]])
        if len(chain) < 3:
            return None
        lengths = np.linalg.norm(joints[chain[1:]] - joints[chain[:-1]], axis=1)
        upper = int(np.max(np.argsort(-lengths, kind="stable")[:2]))
        arms.append((chain[upper + 1], chain[upper]))
    return arms


def unpose(
    positions: Float[np.ndarray, "vertices 3"],
    skin_weights: Float[np.ndarray, "vertices influences"],
    skin_indices: Int[np.ndarray, "vertices influences"],
    transforms: Float[np.ndarray, "joints 3 4"],
) -> Float[np.ndarray, "vertices 3"]:
    """Undo linear blend skinning: the rest points that the blended maps take to `positions`."""
    blended = np.einsum("vi,vixy->vxy", skin_weights, transforms[skin_indices])
    return np.linalg.solve(blended[:, :, :3], (positions - blended[:, :, 3])[:, :, None])[:, :, 0]


def _identity(body: Body) -> np.ndarray:
    """Return the maps of the rest pose."""
    return np.tile(np.eye(3, 4), (len(body.parents), 1, 1))


def _posture(body: Body, positions: np.ndarray, transforms: np.ndarray, angle: float | None) -> Posture:
    """Return a posture with vertex normals."""
    faces = np.asarray(body.faces, np.int64)
    normals = np.zeros_like(positions)
    crosses = face_cross_products(positions, faces)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], crosses)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return Posture(positions, normals, transforms, faces, np.asarray(body.is_obstacle), angle)
