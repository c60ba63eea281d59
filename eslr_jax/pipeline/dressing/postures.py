"""The body with its arms at the angles in which garments are modelled: T-pose, A-poses, arms hanging."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from eslr_jax.mesh.topology import face_cross_products, vertex_components, vertex_normals
from eslr_jax.pipeline.formats.mesh import Faces, Positions
from eslr_jax.pose.motion import SHOULDERS, joint_transforms
from eslr_jax.types import Body

ARM_ANGLES = (0.0, 25.0, 45.0, 65.0)  # degrees below the horizontal that are tried; 0 is the T-pose
_OFF_AXIS = 0.04  # of the body's height: joints farther from the middle belong to a limb
_ASIDE = 0.08  # of the body's height, half the depth of a trunk: a body whose root is farther stands aside
_LIMB = 0.11  # of the body's height: length from which a bone is that of an arm or leg


@dataclasses.dataclass(frozen=True)
class Posture:
    """A body with its arms at one angle, ready for distance queries."""

    positions: Float[np.ndarray, "body_vertices 3"]  # [m]
    transforms: Float[np.ndarray, "joints 3 4"]  # rest -> this posture
    joints: Float[np.ndarray, "joints 3"]  # [m]
    parents: tuple[int, ...]  # of the joints
    faces: Int[np.ndarray, "body_faces 3"]
    is_obstacle: Bool[np.ndarray, " body_faces"]
    arm_angle: float | None  # degrees below the horizontal, if it is one of `ARM_ANGLES`

    @cached_property
    def normals(self) -> Float[np.ndarray, "body_vertices 3"]:
        """Unit normals of the vertices."""
        return vertex_normals(self.positions, self.faces)

    @cached_property
    def touchable(self) -> Int[np.ndarray, " touchable"]:
        """Vertices of the faces that cloth may touch."""
        is_touchable = np.zeros(len(self.positions), bool)
        is_touchable[self.faces[self.is_obstacle]] = True  # quicker than to sort them
        return np.flatnonzero(is_touchable)

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the touchable vertices."""
        return cKDTree(self.positions[self.touchable])

    @cached_property
    def bones(self) -> Float[np.ndarray, "bones 2 3"]:
        """Segments from every joint's parent to the joint [m]."""
        children = [joint for joint, parent in enumerate(self.parents) if parent >= 0]
        parents = [self.parents[joint] for joint in children]
        return np.stack([self.joints[parents], self.joints[children]], axis=1)

    @cached_property
    def is_limb(self) -> Bool[np.ndarray, " bones"]:
        """Mask of the long bones, those of arms and legs."""
        lengths = np.linalg.norm(self.bones[:, 1] - self.bones[:, 0], axis=1)
        return lengths > _LIMB * np.ptp(self.positions[:, 1])

    @property
    def floor(self) -> float:
        """Height of the lowest vertex [m]."""
        return float(self.positions[:, 1].min())

    @cached_property
    def stands(self) -> list[Float[np.ndarray, " 3"]]:
        """Places on the floor that a file may mean by its origin, if that is between the feet [m].

        They are under the body's origin and, if it stands aside, under its root.
        """
        x, _, z = self.root
        is_aside = np.hypot(x, z) > _ASIDE * np.ptp(self.positions[:, 1])
        return [np.array([x, self.floor, z]) for x, z in [(0.0, 0.0), (x, z)][: 1 + is_aside]]

    @cached_property
    def root(self) -> Float[np.ndarray, " 3"]:
        """The root joint, or the middle of a moving mesh's many roots [m]."""
        return np.median(self.joints[np.array(self.parents) < 0], axis=0)

    def tangent_planes(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
        """Return the distance to the nearest touchable vertex, the height over its plane [m], and its normal."""
        distance, nearest = self.tree.query(points)
        vertex = self.touchable[nearest]
        normals = self.normals[vertex]
        return distance, np.einsum("px,px->p", points - self.positions[vertex], normals), normals

    def heights(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
        """Return the distance of every point to the nearest touchable vertex [m], negative inside."""
        distance, side, _ = self.tangent_planes(points)
        return np.where(side < 0, -distance, distance)

    def is_turned_in(self, positions: Positions, faces: Faces) -> Bool[np.ndarray, " faces"]:
        """Return which faces belong to a piece that faces the body."""
        _, nearest = self.tree.query(positions[faces].mean(axis=1))
        outward = np.vecdot(face_cross_products(positions, faces), self.normals[self.touchable[nearest]])
        piece = vertex_components(faces, len(positions))[1][faces[:, 0]]
        return (np.bincount(piece, weights=outward) < 0)[piece]


def rest_posture(body: Body) -> Posture:
    """Return the body in its rest pose."""
    return take_posture(body, body.rest_positions, np.tile(np.eye(3, 4), (len(body.parents), 1, 1)))


def arm_postures(body: Body) -> list[Posture]:
    """Return the rest posture, followed by one for each of `ARM_ANGLES` that differs if the body has arms."""
    arms = find_arms(body)
    if arms is None:
        return [rest_posture(body)]
    joints = np.asarray(body.joint_rest_positions, np.float64)
    bones = [joints[child] - joints[joint] for joint, child in arms]
    rest_angles = [np.degrees(np.arctan2(-bone[1], abs(bone[0]))) for bone in bones]
    angles = [angle for angle in ARM_ANGLES if max(abs(angle - rest) for rest in rest_angles) > 5.0]
    rotations = np.zeros((len(angles), len(joints), 3))
    for (joint, _), bone, rest_angle in zip(arms, bones, rest_angles, strict=True):
        rotations[:, joint, 2] = np.sign(bone[0]) * np.radians(rest_angle - np.array(angles))
    translations = np.tile(joints[body.parents.index(-1)], (len(angles), 1))
    turned = joint_transforms(rotations, translations, body.joint_rest_positions, body.parents)
    postures = [rest_posture(body)]
    for transforms, angle in zip(np.asarray(turned, np.float64), angles, strict=True):
        weights = np.asarray(body.skin_weights, np.float64)
        blended = blend(weights, np.asarray(body.skin_indices), transforms)
        posed = np.einsum("vxy,vy->vx", blended[:, :, :3], postures[0].positions) + blended[:, :, 3]
        postures.append(take_posture(body, posed, transforms, angle))
    return postures


def find_arms(body: Body) -> list[tuple[int, int]] | None:
    """Return the (upper arm, forearm) joints of both sides, or None if the rig has no arms.

    The joint farthest to a side is a fingertip. Of the bones from there to the middle of the body, the two
    longest are the upper arm and the forearm. No joint names are needed.
    """
    joints = np.asarray(body.joint_rest_positions, np.float64)
    aside = joints[:, 0] - body_middle(body)[0]
    off_axis = _OFF_AXIS * float(np.ptp(np.asarray(body.rest_positions)[:, 1]))
    arms = []
    for side in (1.0, -1.0):
        chain = [int(np.argmax(side * aside))]
        while body.parents[chain[-1]] >= 0 and side * aside[body.parents[chain[-1]]] > off_axis:
            chain.append(body.parents[chain[-1]])
        if len(chain) < 3:
            return None
        lengths = np.linalg.norm(joints[chain[1:]] - joints[chain[:-1]], axis=1)
        upper = int(np.max(np.argsort(-lengths, kind="stable")[:2]))
        arms.append((chain[upper + 1], chain[upper]))
    return arms


def body_middle(body: Body) -> Float[np.ndarray, " 3"]:
    """Return the median of the vertices in the rest pose [m]: a body may stand anywhere."""
    return np.median(np.asarray(body.rest_positions, np.float64), axis=0)


def shoulder_height(body: Body) -> float:
    """Return the height of the upper arm joints in the rest pose [m]; an estimate if the rig has no arms."""
    arms = find_arms(body)
    if arms is not None:
        return float(np.mean(np.asarray(body.joint_rest_positions)[[joint for joint, _ in arms], 1]))
    aside, heights, _ = np.asarray(body.rest_positions).T
    is_aside = np.abs(aside - body_middle(body)[0]) > 2 * _OFF_AXIS * np.ptp(heights)
    return float(heights.min() + SHOULDERS * np.ptp(heights[~is_aside]))  # without raised arms


def blend(weights: np.ndarray, indices: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Return the blended map of every vertex, shape [vertices, 3, 4]."""
    return np.einsum("vi,vixy->vxy", weights, transforms[indices])


def take_posture(
    body: Body, positions: np.ndarray, transforms: np.ndarray, arm_angle: float | None = None
) -> Posture:
    """Return a body in a pose, given its vertices there [m] and the maps of its joints to it; see `Posture`."""
    transforms = np.asarray(transforms, np.float64)
    rest_joints = np.asarray(body.joint_rest_positions, np.float64)
    return Posture(
        positions=np.asarray(positions, np.float64),
        transforms=transforms,
        joints=np.einsum("jxy,jy->jx", transforms[:, :, :3], rest_joints) + transforms[:, :, 3],
        parents=body.parents,
        faces=np.asarray(body.faces, np.int64),
        is_obstacle=np.asarray(body.is_obstacle),
        arm_angle=arm_angle,
    )
