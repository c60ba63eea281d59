"""What training samples from: garments in one bucket, and every frame of a split's clips."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.skinning import smooth
from eslr_jax.numerics import product, vertex_normals
from eslr_jax.pose import lbs
from eslr_jax.pose.motion import Motion, joint_transforms
from eslr_jax.pose.retarget import abduct_arms, resample
from eslr_jax.simulation.plan import shared_surface
from eslr_jax.types import Body, BodySurface, Garment

FPS = 30.0  # frames per second of training
_SMOOTHING_STEPS = 10  # of what a garment takes over from the body


@struct.dataclass
class Shapes:
    """How far everything at rest moves with the body's shape coefficients [m per standard deviation]."""

    surface: Float[Array, "surface_vertices 3 shapes"]
    joints: Float[Array, "frames joints 3 shapes"]  # of the offsets in the joints' transforms
    garments: Float[Array, "garments vertices 3 shapes"]  # of the skinned start; lengths at rest stay


@struct.dataclass
class TrainingData:
    """Constant arrays of a training run; garments are stacked along a leading axis."""

    garments: Garment
    surface: BodySurface  # body faces that any of the garments can touch
    surface_rest: Float[Array, "surface_vertices 3"]  # [m]
    surface_normals: Float[Array, "surface_vertices 3"]  # outward unit normals at rest
    surface_skin_weights: Float[Array, "surface_vertices influences"]
    surface_skin_indices: Int[Array, "surface_vertices influences"]
    joint_transforms: Float[Array, "frames joints 3 4"]  # all clips, end to end
    frames_left: Int[Array, " frames"]  # frames of the same clip after this one
    start_frames: Int[Array, " starts"]  # frames that are not the last of their clip
    shapes: Shapes | None  # None: all trajectories have the same body

    @property
    def num_garments(self) -> int:
        """Number of stacked garments."""
        return self.garments.faces.shape[0]

    def garment(self, index: Int[Array, ""]) -> Garment:
        """Return one of the garments."""
        return jax.tree.map(lambda leaf: leaf[index], self.garments)

    def is_same_clip(self, frame: Int[Array, ""], other: Int[Array, ""]) -> Bool[Array, ""]:
        """Tell whether two frames are of one clip; the first may lie outside all clips."""
        return frame + self.frames_left[frame] == other + self.frames_left[other]

    def next_frame(self, frame: Int[Array, ""], before: Int[Array, ""]) -> Int[Array, ""]:
        """Return which frame follows `frame` after `before`: clips are played back and forth."""
        onward = 2 * frame - before
        return jnp.where(self.is_same_clip(onward, frame), onward, before)

    def transforms(
        self, frame: Int[Array, ""], yaw: Float[Array, ""], shape: Float[Array, " shapes"] | None = None
    ) -> Float[Array, "joints 3 4"]:
        """Return joint transforms of a frame, the scene turned about the vertical by `yaw` [rad]."""
        transforms = self.joint_transforms[frame]
        if self.shapes is not None and shape is not None:
            transforms = transforms.at[:, :, 3].add(product(self.shapes.joints[frame], shape))
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
        turn = jnp.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos]).reshape(3, 3)
        return product(turn[None], transforms)

    def body(
        self,
        transforms: Float[Array, "joints 3 4"],
        girth: Float[Array, ""],
        shape: Float[Array, " shapes"] | None = None,
    ) -> Float[Array, "surface_vertices 3"]:
        """Return the posed surface of a body of some shape, thicker by `girth` [m]."""
        rest = self.surface_rest + girth * self.surface_normals
        if self.shapes is not None and shape is not None:
            rest = rest + product(self.shapes.surface, shape)
        return lbs.skin(rest, self.surface_skin_weights, self.surface_skin_indices, transforms)

    def skinned(
        self,
        index: Int[Array, ""],
        transforms: Float[Array, "joints 3 4"],
        shape: Float[Array, " shapes"] | None = None,
    ) -> Float[Array, "vertices 3"]:
        """Return a garment carried by the joints [m]; it moves with the shape of the body under it."""
        garment = self.garment(index)
        rest = garment.rest_positions
        if self.shapes is not None and shape is not None:
            rest = rest + product(self.shapes.garments[index], shape)
        return lbs.skin(rest, garment.skin_weights, garment.skin_indices, transforms)


def build_training_data(
    garments: list[Garment], body: Body, motions: list[Motion], *, has_shapes: bool = False
) -> TrainingData:
    """Return what training samples from: garments padded to equal sizes, the body that wears them, and its clips.

    With `has_shapes` trajectories draw the coefficients of the body's shape.

    Raises:
        ConfigError: The garments are not near the body, no clip has two frames, or the body has no shapes and
            they are asked for, or it has pose blend shapes.
    """
    if body.pose_directions is not None:
        raise ConfigError("the body has pose blend shapes, which training leaves out; train on one without")
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *garments)
    surface = shared_surface(garments, body)
    if surface is None:
        raise ConfigError("none of the garments is near the body; train on garments that are worn")
    surface_rest = jnp.asarray(body.rest_positions[surface.vertex_ids])
    rotations, translations, frames_left = _join_clips(motions)
    if not np.any(frames_left):
        raise ConfigError("no clip has two frames; train on clips in which something moves")
    shapes = None
    if has_shapes:
        if not body.shape_directions.shape[-1]:
            raise ConfigError("the body has no shapes; train with shape_range = 0")
        # Offsets of joint transforms are linear in the joints' places.
        nowhere, directions = np.zeros((len(rotations), 3)), body.joint_shape_directions
        joints = [
            joint_transforms(rotations, nowhere, directions[..., k], body.parents)[..., 3]
            for k in range(directions.shape[-1])
        ]
        shapes = Shapes(
            surface=body.shape_directions[surface.vertex_ids],
            joints=jnp.stack(joints, axis=-1),
            garments=jnp.stack([_garment_shifts(garment, body) for garment in garments]),
        )
    return TrainingData(
        garments=stacked,
        surface=surface,
        surface_rest=surface_rest,
        surface_normals=vertex_normals(surface_rest, surface.faces, surface.face_incidence),
        surface_skin_weights=body.skin_weights[surface.vertex_ids],
        surface_skin_indices=body.skin_indices[surface.vertex_ids],
        joint_transforms=joint_transforms(rotations, translations, body.joint_rest_positions, body.parents),
        frames_left=jnp.asarray(frames_left, jnp.int32),
        start_frames=jnp.asarray(np.flatnonzero(frames_left), jnp.int32),
        shapes=shapes,
    )


def _garment_shifts(garment: Garment, body: Body) -> Float[Array, "vertices 3 shapes"]:
    """Return how a garment moves with the shape: as the closest point of the body at rest, smoothed.

    HOOD takes the nearest body vertex's shape directions too, and for loose garments a mean over several.
    """
    faces = np.asarray(body.faces)
    nearest, weights = closest_points(
        np.asarray(garment.rest_positions, np.float64), np.asarray(body.rest_positions, np.float64), faces
    )
    shifts = np.einsum("vk,vkxs->vxs", weights, np.asarray(body.shape_directions)[faces[nearest]])
    flat = smooth(shifts.reshape(len(shifts), -1), np.asarray(garment.faces), _SMOOTHING_STEPS)
    return jnp.asarray(flat.reshape(shifts.shape), jnp.float32)


def _join_clips(motions: list[Motion]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Resample clips and put them end to end."""
    rotations, translations, frames_left = [], [], []
    for motion in motions:
        turned, moved = resample(motion.rotations, motion.translations, motion.fps, FPS)
        if motion.arm_abduction:
            turned = abduct_arms(turned, motion.joint_names, motion.arm_abduction)
        rotations.append(turned)
        # Each clip starts above the origin: far from it float32 positions lose digits.
        translations.append(moved - moved[:1] * [1.0, 0.0, 1.0])
        frames_left.append(np.arange(len(turned))[::-1])
    return np.concatenate(rotations), np.concatenate(translations), np.concatenate(frames_left)
