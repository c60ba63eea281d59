"""From a scene and the cloth's state to the minimisation problem of one frame."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.contact.ground import ground_contacts
from eslr_jax.contact.layer_edges import LayerPairs, with_edges
from eslr_jax.contact.nearest import are_pinched, find_both_sides
from eslr_jax.contact.self_contact import find_self_contacts, find_tip_contacts
from eslr_jax.contact.skin import find_skin_contacts
from eslr_jax.scene.build import slice_tracks
from eslr_jax.terms.collision import contact_forces
from eslr_jax.terms.problem import (
    BodyContact,
    FrameProblem,
    GroundContact,
    SecondOrder,
    SelfContact,
    contact_thickness,
    with_terms,
)
from eslr_jax.terms.repulsion import pair_heights
from eslr_jax.types import ClothState, PastState, Scene, SceneBody


class BodyStep(NamedTuple):
    """Where the searched part of the body is at both ends of a frame."""

    start: Float[Array, "surface_vertices 3"]  # at t [m]
    end: Float[Array, "surface_vertices 3"]  # at t + 1 [m]


class FrameInput(NamedTuple):
    """What the outside world does during one frame; None is not modelled."""

    body: BodyStep | None
    pin_targets: Float[Array, "vertices 3"] | None  # at t + 1 [m]


def frame_inputs(scene: Scene) -> FrameInput:
    """Return the inputs of all frames, stacked along a leading axis of num_frames - 1."""
    return FrameInput(
        body=None if scene.body is None else BodyStep(scene.body.positions[:-1], scene.body.positions[1:]),
        pin_targets=None if scene.pin_targets is None else scene.pin_targets[1:],
    )


def part_of_frame(state: ClothState, frame: FrameInput, row: Int[Array, ""], parts: int) -> FrameInput:
    """Return the motion of body and pins during one of the equal parts of a frame, by straight lines.

    Args:
        state: Cloth at t: its pinned vertices are where the pins are.
        frame: The outside world from t to t + 1.
        row: Number of the part, from zero.
        parts: Number of parts.
    """

    def between(start: Float[Array, "rows 3"], end: Float[Array, "rows 3"], number: Int[Array, ""]) -> Array:
        share = number.astype(start.dtype) / parts
        return (1 - share) * start + share * end

    body, pins = frame.body, frame.pin_targets
    return FrameInput(
        body=None if body is None else BodyStep(between(*body, row), between(*body, row + 1)),
        pin_targets=None if pins is None else between(state.position, pins, row + 1),
    )


def without_tracks(scene: Scene) -> Scene:
    """Return a scene without what moves, so that scenes of any length share a compiled program."""
    nothing = jax.tree.map(jnp.zeros_like, scene.initial_state)
    return slice_tracks(scene, slice(0)).replace(initial_state=nothing, num_frames=0)


def frame_problem(scene: Scene, state: ClothState, inputs: FrameInput) -> FrameProblem:
    """Find the frame's contacts and state its minimisation problem.

    Args:
        scene: Its constant parts; what moves is read from `inputs`.
        state: Cloth at t.
        inputs: The outside world from t to t + 1.
    """
    problem = FrameProblem(
        garment=scene.garment,
        material=scene.material,
        constants=scene.constants,
        timestep=scene.timestep,
        position=state.position,
        inertial_guess=state.position + scene.timestep * state.velocity,
        time=(state.frame + 1).astype(scene.timestep.dtype) * scene.timestep,
        pin_targets=inputs.pin_targets,
    )
    if state.past is not None:
        problem = _second_order(problem, state, state.past)
    if scene.body is not None and inputs.body is not None:
        body = _body_contact(problem, scene.body, inputs.body, state.friction_load)
        problem = problem.replace(body=body)
    if scene.ground is not None:
        problem = problem.replace(ground=_ground_contact(scene, state, scene.ground))
    if scene.self_contact is not None:
        cloth = (state.position, problem.inertial_guess, scene.garment)
        pairs = find_self_contacts(*cloth, scene.self_contact, pieces=scene.pieces)
        pairs = with_edges(*cloth[:2], pairs, scene.garment)
        problem = problem.replace(layers=_layers(problem, pairs))
    return with_terms(problem, scene.terms)


def first_problem(scene: Scene) -> FrameProblem:
    """Return the problem of a scene's first frame, such as to initialise a network of one's own on."""
    first = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))
    return frame_problem(scene, scene.initial_state, first)


def _second_order(problem: FrameProblem, state: ClothState, past: PastState) -> FrameProblem:
    """Return the problem of BDF2 in the place of implicit Euler's.

    With an acceleration a that acts for a time h, v' = v + h a and x' = x + h v'. Implicit Euler takes x and v at
    t, and h = dt. BDF2 takes (4 x_t - x_{t-1}) / 3, (4 v_t - v_{t-1}) / 3 and h = 2/3 dt. Both minimise
    m abs(x' - x - h v)^2 / (2 h^2) with the other energies. The first frame has no past and takes Euler's.
    After a step of another length, with r = dt / dt_last, it takes ((1 + r)^2 x_t - r^2 x_{t-1}) / (1 + 2 r), v
    likewise, and h = (1 + r) / (1 + 2 r) dt.

    Source: Hairer, Norsett and Wanner 1993, Solving Ordinary Differential Equations I, section III.5.
    """
    ratio = problem.timestep / past.timestep
    now_weight, whole = jnp.square(1.0 + ratio), 1.0 + 2.0 * ratio

    def before(
        now: Float[Array, "vertices 3"], then: Float[Array, "vertices 3"]
    ) -> Float[Array, "vertices 3"]:
        return jnp.where(past.is_known, (now_weight * now - jnp.square(ratio) * then) / whole, now)

    origin, velocity = before(state.position, past.position), before(state.velocity, past.velocity)
    acts = jnp.where(past.is_known, (1.0 + ratio) / whole, 1.0) * problem.timestep
    return problem.replace(inertial_guess=origin + acts * velocity, bdf2=SecondOrder(origin, acts))


def _body_contact(
    problem: FrameProblem, body: SceneBody, step: BodyStep, friction_load: Float[Array, " vertices"]
) -> BodyContact:
    """Return the contact of a frame with the scene's body."""
    garment, constants = problem.garment, problem.constants
    nearest, opposing = find_both_sides(
        problem.position, step.start, step.end, body.surface, garment.vertex_blocks, problem.inertial_guess
    )
    skin = tips = None
    if body.has_skin:
        cloth = (problem.position, problem.inertial_guess)
        skin = find_skin_contacts(cloth, (step.start, step.end), nearest, body.surface, garment)
        # Between two limbs nobody sees skin, and rows of both would pull the cloth to both sides.
        pinched = are_pinched(nearest, opposing)
        skin = skin.replace(is_near=skin.is_near & ~jnp.any(pinched[skin.corners], axis=1))
    if body.has_tips:
        tips = find_tip_contacts(
            problem.position, problem.inertial_guess, *step, body.surface.patch_vertices, garment
        )
    return BodyContact(
        nearest=nearest,
        opposing=opposing,
        friction_load=friction_load,
        thickness=contact_thickness(garment, constants.collision_thickness),
        skin=skin,
        tips=tips,
    )


def _layers(problem: FrameProblem, pairs: LayerPairs) -> SelfContact:
    """Return the contact of a frame between layers of the cloth.

    A vertex on the wrong side of a face is pushed back by one contact thickness a frame. Pushed back within one
    frame, from centimetres deep, it tore the cloth: neighbouring pairs with opposite sides pulled with thousands
    of times the weight.
    """
    thickness = contact_thickness(problem.garment, problem.constants.repulsion_thickness)
    height, _ = pair_heights(problem.position, pairs)
    return SelfContact(pairs, thickness + jnp.minimum(height, 0.0), limit=thickness)


def _ground_contact(scene: Scene, state: ClothState, height: Float[Array, ""]) -> GroundContact:
    """Return the contact of a frame with the ground.

    The ground is flat and stands still: no edge dips into it, and where the cloth is tells how hard it presses.
    """
    constants, contacts = scene.constants, ground_contacts(state.position, height)
    thickness = constants.collision_thickness
    load = contact_forces(state.position, contacts, scene.garment, constants.collision_stiffness, thickness)
    return GroundContact(contacts, load, thickness)
