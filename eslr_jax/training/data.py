"""What training samples from: garments in one bucket, and every frame of a split's clips."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.assets import load_body, load_garment, load_motion, split_clips
from eslr_jax.body import lbs
from eslr_jax.body.motion import Motion, joint_transforms
from eslr_jax.body.retarget import abduct_arms, resample
from eslr_jax.config import TrainConfig
from eslr_jax.errors import ConfigError
from eslr_jax.geometry.prepare import pad_alike
from eslr_jax.numerics import vertex_normals
from eslr_jax.scene.plan import shared_surface
from eslr_jax.types import Body, BodySurface, Garment

_FPS = 30.0


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
    start_frames: Int[Array, " starts"]  # frames that another one follows

    @property
    def num_garments(self) -> int:
        """Number of stacked garments."""
        return self.garments.faces.shape[0]

    def garment(self, index: Int[Array, ""]) -> Garment:
        """Return one of the garments."""
        return jax.tree.map(lambda leaf: leaf[index], self.garments)

    def transforms(self, frame: Int[Array, ""], yaw: Float[Array, ""]) -> Float[Array, "joints 3 4"]:
        """Return joint transforms of a frame, the scene turned about the vertical by `yaw` [rad]."""
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
        turn = jnp.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos]).reshape(3, 3)
        return turn @ self.joint_transforms[frame]

    def body(
        self, transforms: Float[Array, "joints 3 4"], girth: Float[Array, ""]
    ) -> Float[Array, "surface_vertices 3"]:
        """Return the posed surface of a body that is thicker than the bundled one by `girth` [m]."""
        rest = self.surface_rest + girth * self.surface_normals
        return lbs.skin(rest, self.surface_skin_weights, self.surface_skin_indices, transforms)


def load_training_data(config: TrainConfig, vertices: str) -> TrainingData:
    """Load the garments at one resolution and the clips of a training run.

    Raises:
        ConfigError: The split is unknown or empty, or no clip has two frames.
        AssetError: A garment does not exist.
    """
    options = config.model.garment_options
    unpadded = [load_garment(name, vertices=vertices, **options) for name in config.garments]  # type: ignore[arg-type]
    return build_training_data(
        pad_alike(unpadded), load_body(), [load_motion(clip) for clip in split_clips(config.split)]
    )


def build_training_data(garments: list[Garment], body: Body, motions: list[Motion]) -> TrainingData:
    """Return what training samples from.

    Args:
        garments: Garments padded to equal sizes.
        body: The body that wears them.
        motions: Its clips.

    Raises:
        ConfigError: The garments are not near the body.
    """
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *garments)
    surface = shared_surface(garments, body)
    if surface is None:
        raise ConfigError("none of the garments is near the body; train on garments that are worn")
    surface_rest = jnp.asarray(body.rest_positions[surface.vertex_ids])
    rotations, translations, frames_left = _join_clips(motions)
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
    )


def _join_clips(motions: list[Motion]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Resample clips and put them end to end."""
    rotations, translations, frames_left = [], [], []
    for motion in motions:
        turned, moved = resample(motion.rotations, motion.translations, motion.fps, _FPS)
        if motion.arm_abduction:
            turned = abduct_arms(turned, motion.joint_names, motion.arm_abduction)
        rotations.append(turned)
        # Each clip starts above the origin: far from it float32 positions lose digits.
        translations.append(moved - moved[:1] * [1.0, 0.0, 1.0])
        frames_left.append(np.arange(len(turned))[::-1])
    return np.concatenate(rotations), np.concatenate(translations), np.concatenate(frames_left)
