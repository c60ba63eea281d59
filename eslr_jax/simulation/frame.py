"""From a scene and the cloth's state to the minimisation problem of one frame."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.simulation.scene import slice_tracks
from eslr_jax.terms.term import FrameProblem, MovingBody, SecondOrder, with_terms
from eslr_jax.types import ClothState, PastState, Scene


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
    """Let the terms look at the frame, and state its minimisation problem.

    Args:
        scene: Its constant parts; what moves is read from `inputs`.
        state: Cloth at t.
        inputs: The outside world from t to t + 1.
    """
    problem = FrameProblem(
        garment=scene.garment,
        material=scene.material,
        timestep=scene.timestep,
        position=state.position,
        inertial_guess=state.position + scene.timestep * state.velocity,
        time=(state.frame + 1).astype(scene.timestep.dtype) * scene.timestep,
        friction_load=state.friction_load,
        pin_targets=inputs.pin_targets,
    )
    if state.past is not None:
        problem = _second_order(problem, state, state.past)
    if scene.body is not None and inputs.body is not None:
        problem = problem.replace(body=MovingBody(scene.body.surface, *inputs.body))
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
