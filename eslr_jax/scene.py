"""Decide what a scene needs; what it does not need is absent from the compiled step."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from eslr_jax.body.motion import skin_garment
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.contact.surface import prepare_surface
from eslr_jax.errors import MotionError
from eslr_jax.geometry.padding import choose_bucket, common_bucket
from eslr_jax.geometry.prepare import pad_alike
from eslr_jax.physics.materials import COTTON
from eslr_jax.types import Body, BodyMotion, BodySurface, ClothState, Garment, Material, Scene

# [m] that cloth strays from where it is skinned to, besides how loose it hangs; farther body faces are left out.
REACH = 0.08
_SHARED_REACH = 0.15  # [m] of scenes that share a surface, chosen in the rest pose alone
_SAMPLED_FRAMES = 12  # frames in which the reachable faces are looked for
_PUSH_OUT_STEPS = 8  # tangent-plane projections that take the skinned start out of the body
_START_CLEARANCE = 2e-3  # [m]; the collision thickness


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """What to model beyond what is there; host only."""

    reach: float = REACH  # [m], besides how far the garment hangs from the body at rest
    has_body: bool = True
    start_at_rest: bool = False  # zero initial velocity instead of the body's


def prepare_scene(
    garment: Garment,
    poses: BodyMotion,
    *,
    material: Material = COTTON,
    options: SceneOptions | None = None,
    surface: BodySurface | None = None,
) -> Scene:
    """Collect what a rollout reads, and leave out what it does not need.

    Frame 0 is the garment skinned to the first pose and pushed out of the body.

    Args:
        garment: A prepared garment.
        poses: The body in motion.
        material: Fabric.
        options: What to leave out or add.
        surface: Search this part of the body instead of what the garment can reach, so that several scenes
            share one compiled rollout; see `shared_surface`.

    Raises:
        MotionError: The motion has fewer than two frames.
    """
    options = options or SceneOptions()
    num_frames = poses.joint_transforms.shape[0]
    if num_frames < 2:
        raise MotionError(f"a simulation needs two frames or more; this motion has {num_frames}")
    skinned = skin_garment(garment, poses.joint_transforms)
    if surface is None and options.has_body:
        is_near = reachable_vertices(garment, skinned, poses, options.reach)
        surface = _surface_near(is_near, poses)
    body_positions = None if surface is None else poses.positions[:, surface.vertex_ids]
    position = skinned[0]
    if surface is not None:
        assert body_positions is not None
        position = _clear_of_body(position, garment, body_positions[0], surface)
    velocity = (skinned[1] - skinned[0]) / poses.timestep
    if options.start_at_rest:
        velocity = jnp.zeros_like(velocity)
    return Scene(
        garment=garment,
        material=material,
        start=initial_state(position, velocity),
        timestep=poses.timestep,
        surface=surface,
        body_positions=body_positions,
        pin_targets=skinned if bool(np.any(garment.is_pinned)) else None,
        num_frames=num_frames,
    )


def prepare_scenes(
    garments: Sequence[Garment],
    poses: Sequence[BodyMotion],
    *,
    material: Material = COTTON,
    options: SceneOptions | None = None,
) -> list[Scene]:
    """Prepare scenes that can be stacked: padded to one bucket, over one part of the body.

    What one of them needs, all of them model: pins, and the body faces near any garment at rest, whatever the
    motion: other motions of the same garments then run the same compiled rollout.

    Args:
        garments: Unpadded garments of like sizes.
        poses: As many motions of bodies with the same faces and of the same length.
        material: Fabric of all.
        options: What to leave out or add.
    """
    options = options or SceneOptions()
    bucket = common_bucket([choose_bucket(garment) for garment in garments])
    padded = pad_alike(garments, bucket)
    surface = shared_surface(padded, poses[0]) if options.has_body else None
    scenes = [
        prepare_scene(garment, motion, material=material, options=options, surface=surface)
        for garment, motion in zip(padded, poses, strict=True)
    ]
    if all(scene.pin_targets is None for scene in scenes):
        return scenes
    return [
        scene.replace(pin_targets=skin_garment(scene.garment, motion.joint_transforms))
        for scene, motion in zip(scenes, poses, strict=True)
    ]


def initial_state(position: jax.Array, velocity: jax.Array) -> ClothState:
    """Return a cloth state without history."""
    return ClothState(
        position=position,
        velocity=velocity,
        friction_load=jnp.zeros(position.shape[0], position.dtype),
        frame=jnp.int32(0),
        status=jnp.int32(0),
        first_bad_frame=jnp.int32(-1),
    )


def reachable_vertices(garment: Garment, skinned: jax.Array, poses: BodyMotion, reach: float) -> np.ndarray:
    """Return which body vertices the skinned garment can reach in a sample of frames.

    A T-shirt's scene then searches no legs, no head and no feet.
    """
    frames = np.unique(np.linspace(0, len(skinned) - 1, _SAMPLED_FRAMES).astype(int))
    is_real = np.asarray(garment.vertex_mask)
    radii = reach + _looseness(garment, poses)
    is_near = np.zeros(poses.positions.shape[1], bool)
    for frame in frames:
        far = np.flatnonzero(~is_near)  # once is enough
        points = np.asarray(poses.positions[frame])[far]
        is_near[far] = _within(radii, np.asarray(skinned[frame])[is_real], points)
    return is_near


def shared_surface(
    garments: Sequence[Garment], body: Body | BodyMotion, reach: float = _SHARED_REACH
) -> BodySurface | None:
    """Return the obstacle faces that any of the garments can reach in the rest pose; `reach` in metres."""
    rest = np.asarray(body.rest_positions)
    is_near = np.zeros(len(rest), bool)
    for garment in garments:
        points = np.asarray(garment.rest_positions)[np.asarray(garment.vertex_mask)]
        is_near |= _within(reach + _looseness(garment, body), points, rest)
    return _surface_near(is_near, body)


def _surface_near(is_near: np.ndarray, body: Body | BodyMotion) -> BodySurface | None:
    """Return the surface of the obstacle faces with a vertex among those; None without any."""
    faces = np.asarray(body.faces)[np.asarray(body.is_obstacle)]
    is_kept = is_near[faces].any(axis=1)
    if not is_kept.any():
        return None
    boundary = np.intersect1d(faces[is_kept], faces[~is_kept])
    return prepare_surface(np.asarray(body.rest_positions), faces[is_kept], boundary=boundary)


def _looseness(garment: Garment, body: Body | BodyMotion) -> np.ndarray:
    """Return how far real vertices hang from the body at rest [m]: a hem swings, a collar does not."""
    obstacle = np.unique(np.asarray(body.faces)[np.asarray(body.is_obstacle)])
    points = np.asarray(garment.rest_positions)[np.asarray(garment.vertex_mask)]
    distance, _ = cKDTree(np.asarray(body.rest_positions)[obstacle]).query(points)
    return distance


def _within(radii: np.ndarray, centers: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points lie within the radius around any of the centers."""
    is_within = np.zeros(len(points), bool)
    for hits in cKDTree(points).query_ball_point(centers, radii):
        is_within[hits] = True
    return is_within


@jax.jit
def _clear_of_body(position: jax.Array, garment: Garment, body: jax.Array, surface: BodySurface) -> jax.Array:
    """Move vertices that lie within the clearance of the body onto it; pinned ones stay."""

    def project(_, position):
        contacts = find_contacts(position, body, body, surface)
        height = jnp.sum((position - contacts.points) * contacts.normals, axis=-1)
        height = jnp.minimum(height, contacts.distances)
        lift = jnp.where(contacts.is_near, jnp.maximum(_START_CLEARANCE - height, 0.0), 0.0)
        lift = jnp.where(garment.is_pinned, 0.0, lift)
        return position + lift[:, None] * contacts.normals

    return jax.lax.fori_loop(0, _PUSH_OUT_STEPS, project, position)
