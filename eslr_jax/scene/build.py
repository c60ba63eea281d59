"""From a garment, a moving body and a plan to the scene that a rollout reads; pure, for jit, vmap and grad."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.body import lbs
from eslr_jax.contact.ground import clear_of_ground
from eslr_jax.contact.nearest import clear_of_body
from eslr_jax.contact.skin import lift_off_skin
from eslr_jax.physics.materials import COTTON, constants_for
from eslr_jax.terms.bending import Bending
from eslr_jax.terms.collision import Collision, SkinCollision
from eslr_jax.terms.friction import Friction
from eslr_jax.terms.gravity import Gravity
from eslr_jax.terms.inertia import Inertia
from eslr_jax.terms.repulsion import Repulsion, TipCollision
from eslr_jax.terms.stretch import Stretch
from eslr_jax.terms.term import Term
from eslr_jax.types import (
    BodyMotion,
    BodySurface,
    ClothState,
    Garment,
    Material,
    PairCapacity,
    PastState,
    PhysicsConstants,
    Scene,
    SceneBody,
)

Integrator = Literal["euler", "bdf2"]
"""Implicit Euler is the paper's, and networks are trained with it. BDF2, of second order, keeps motion alive."""


@struct.dataclass
class ScenePlan:
    """What a scene models, with which constants, and how large its buffers are."""

    surface: BodySurface | None  # body faces that are searched for contacts; None: no body
    constants: PhysicsConstants | None = None  # None: those for the fabric, see `constants_for`
    has_pins: bool = struct.field(pytree_node=False, default=True)
    starts_at_rest: bool = struct.field(
        pytree_node=False, default=False
    )  # else frame 0 moves as the body does
    self_contact: PairCapacity | None = struct.field(pytree_node=False, default=None)  # None: layers cross
    pieces: Int[Array, " vertices"] | None = None  # of self-contact between different pieces only
    has_skin: bool = struct.field(pytree_node=False, default=False)  # faces of the cloth keep off the skin
    has_tips: bool = struct.field(pytree_node=False, default=False)  # the body has tips finer than the cloth
    integrator: Integrator = struct.field(pytree_node=False, default="euler")
    ground: Float[Array, ""] | None = None  # height of a level ground [m]; None: no ground
    terms: tuple[Term, ...] = ()  # besides those that `scene_terms` finds
    substeps: int = struct.field(pytree_node=False, default=1)  # in which a frame is simulated


def build_scene(garment: Garment, poses: BodyMotion, material: Material, plan: ScenePlan) -> Scene:
    """Return the scene of a garment on a moving body.

    Frame 0 is the garment skinned to the first pose, pushed out of the body and lifted off the ground.

    Args:
        garment: A prepared garment.
        poses: The body in motion, two frames or more.
        material: Fabric.
        plan: What to model.
    """
    skinned = skin_garment(garment, poses.joint_transforms)
    position, body = skinned[0], None
    if plan.surface is not None:
        track = poses.positions[:, plan.surface.vertex_ids]
        body = SceneBody(plan.surface, track, has_skin=plan.has_skin, has_tips=plan.has_tips)
        position = clear_of_body(position, body.positions[0], plan.surface, garment)
        if plan.has_skin:
            position = lift_off_skin(position, body.positions[0], plan.surface, garment)
    if plan.ground is not None:
        position = clear_of_ground(position, plan.ground, garment.is_pinned)
    velocity = (skinned[1] - skinned[0]) / poses.timestep
    if plan.starts_at_rest:
        velocity = jnp.zeros_like(velocity)
    met = scene_terms(body, has_ground=plan.ground is not None, has_layers=plan.self_contact is not None)
    return Scene(
        garment=garment.replace(material=None),
        material=material,
        constants=plan.constants or constants_for(material),
        initial_state=start_integrator(initial_state(position, velocity), plan.integrator),
        timestep=poses.timestep,
        body=body,
        pin_targets=skinned if plan.has_pins else None,
        num_frames=skinned.shape[0],
        self_contact=plan.self_contact,
        pieces=plan.pieces,
        ground=plan.ground,
        terms=(*met, *plan.terms),
        substeps=plan.substeps,
    )


def scene_terms(body: SceneBody | None, *, has_ground: bool, has_layers: bool) -> tuple[Term, ...]:
    """Return the terms that every scene has, and those of what its cloth can touch.

    Args:
        body: The scene's body.
        has_ground: Whether there is a ground.
        has_layers: Whether layers of cloth keep apart.
    """
    terms: list[Term] = [Stretch(), Bending(), Inertia(), Gravity()]
    if body is not None or has_ground:
        terms += [Collision(), Friction()]
    if body is not None and body.has_skin:
        terms.append(SkinCollision())
    if body is not None and body.has_tips:
        terms.append(TipCollision())
    if has_layers:
        terms.append(Repulsion())
    return tuple(terms)


def worn_material(garment: Garment, material: Material | None) -> Material:
    """Return the fabric that a garment is simulated with: one that is given, or its own, or cotton."""
    if material is not None:
        return material
    return COTTON if garment.material is None else garment.material


def slice_tracks(scene: Scene, frames: slice | Int[Array, " frames"]) -> Scene:
    """Return a scene with some frames of what moves: body and pins; the number of frames is left as it is."""
    body, pins = scene.body, scene.pin_targets
    return scene.replace(
        body=None if body is None else body.replace(positions=body.positions[frames]),
        pin_targets=None if pins is None else pins[frames],
    )


def safe_plan(poses: BodyMotion) -> ScenePlan:
    """Return the plan that holds whatever the values are: the whole body is searched, and pins are modelled."""
    return ScenePlan(surface=poses.surface)


def skin_garment(
    garment: Garment, transforms: Float[Array, "frames joints 3 4"]
) -> Float[Array, "frames vertices 3"]:
    """Return the garment carried by the joints [m], shape [frames, vertices, 3].

    Args:
        garment: Rest mesh with its skin weights.
        transforms: Maps from rest to posed points, shape [frames, joints, 3, 4].
    """
    return lbs.skin_frames(garment.rest_positions, garment.skin_weights, garment.skin_indices, transforms)


def start_integrator(state: ClothState, integrator: Integrator) -> ClothState:
    """Return a state without a past, from which an integrator can begin."""
    if integrator == "euler":
        return state.replace(past=None)
    nothing = jnp.zeros_like(state.position)
    return state.replace(past=PastState(nothing, nothing, jnp.ones((), nothing.dtype), jnp.zeros((), bool)))


def initial_state(position: Float[Array, "vertices 3"], velocity: Float[Array, "vertices 3"]) -> ClothState:
    """Return a state without history.

    Args:
        position: Vertex positions [m], shape [vertices, 3].
        velocity: Vertex velocities [m/s], shape [vertices, 3].
    """
    return ClothState(
        position=position,
        velocity=velocity,
        friction_load=jnp.zeros(position.shape[0], position.dtype),
        frame=jnp.int32(0),
        status=jnp.int32(0),
        first_bad_frame=jnp.int32(-1),
    )
