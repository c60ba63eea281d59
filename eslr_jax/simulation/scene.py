"""From a garment, a moving body and terms to the scene that a rollout reads; pure, for jit, vmap and grad."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from eslr_jax.fabric.materials import COTTON
from eslr_jax.pose.lbs import skin_garment
from eslr_jax.terms import Term
from eslr_jax.types import BodyMotion, ClothState, Garment, Material, Obstacle, PastState, Scene

Integrator = Literal["euler", "bdf2"]
"""Implicit Euler is the paper's, and networks are trained with it. BDF2, of second order, keeps motion alive."""


def build_scene(
    garment: Garment,
    poses: BodyMotion,
    material: Material,
    terms: tuple[Term, ...],
    *,
    integrator: Integrator = "euler",
    substeps: int = 1,
    starts_at_rest: bool = False,
    has_pins: bool = True,
) -> Scene:
    """Return the scene of a garment on a moving body.

    Args:
        garment: A prepared garment.
        poses: The body in motion, two frames or more; the faces of its surface can be touched.
        material: Fabric.
        terms: What to model, of `plan_scene`.
        integrator: How time is stepped.
        substeps: Number of equal parts in which a frame is simulated.
        starts_at_rest: Frame 0 stands still; else it moves as the body does.
        has_pins: Model the garment's pins.
    """
    body = reached_body(poses, terms)
    worn = garment, poses.joint_transforms[:2], poses.timestep, body, terms
    start = first_state(*worn, integrator=integrator, starts_at_rest=starts_at_rest)
    pins = skin_garment(garment, poses.joint_transforms) if has_pins else None
    return scene_from(start, garment, poses, material, terms, body=body, pin_targets=pins, substeps=substeps)


def reached_body(poses: BodyMotion, terms: tuple[Term, ...]) -> Obstacle | None:
    """Return the part of the body that terms read; None where none does."""
    if not any(term.reads_body for term in terms):
        return None
    return Obstacle(poses.surface, poses.positions[:, poses.surface.vertex_ids])


def first_state(
    garment: Garment,
    transforms: Float[Array, "2 joints 3 4"],
    timestep: Float[Array, ""],
    body: Obstacle | None,
    terms: tuple[Term, ...],
    *,
    integrator: Integrator,
    starts_at_rest: bool,
) -> ClothState:
    """Return frame 0: the garment skinned to the first pose, moved out of what the terms forbid.

    Args:
        garment: A prepared garment.
        transforms: Of the joints in the first two frames.
        timestep: Between them [s].
        body: Of `reached_body`, whose first frame is read.
        terms: What to model.
        integrator: How time is stepped.
        starts_at_rest: It stands still; else it moves as the body does.
    """
    skinned = skin_garment(garment, transforms)
    position = skinned[0]
    for term in terms:
        position = term.start(position, garment, body)
    velocity = (skinned[1] - skinned[0]) / timestep
    if starts_at_rest:
        velocity = jnp.zeros_like(velocity)
    return start_integrator(initial_state(position, velocity), integrator)


def scene_from(
    start: ClothState,
    garment: Garment,
    poses: BodyMotion,
    material: Material,
    terms: tuple[Term, ...],
    *,
    body: Obstacle | None,
    pin_targets: Float[Array, "frames vertices 3"] | None,
    substeps: int,
) -> Scene:
    """Return the scene that begins with a state of `first_state`; see `build_scene`."""
    return Scene(
        garment=garment.replace(material=None),
        material=material,
        terms=terms,
        initial_state=start,
        timestep=poses.timestep,
        body=body,
        pin_targets=pin_targets,
        num_frames=poses.joint_transforms.shape[0],
        substeps=substeps,
    )


def worn_material(garment: Garment, material: Material | None) -> Material:
    """Return the fabric that a garment is simulated with: one that is given, or its own, or cotton."""
    if material is not None:
        return material
    return COTTON if garment.material is None else garment.material


def slice_tracks(scene: Scene, frames: slice | Int[ArrayLike, " frames"]) -> Scene:
    """Return a scene with some frames of what moves: body and pins; the number of frames is left as it is."""
    body, pins = scene.body, scene.pin_targets
    return scene.replace(
        body=None if body is None else body.replace(positions=body.positions[frames]),
        pin_targets=None if pins is None else pins[frames],
    )


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
