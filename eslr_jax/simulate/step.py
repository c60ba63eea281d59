"""One frame: contacts, the stepper's answer, the corrector, and the new state."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.config import SimConfig
from eslr_jax.contact.nearest import MAX_APPROACH, approach, find_both_sides
from eslr_jax.contact.self_contact import (
    CELL_CAPACITY,
    FacePairs,
    find_self_contacts,
    find_tip_contacts,
)
from eslr_jax.errors import Status
from eslr_jax.numerics import safe_norm
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.lbfgs import Minimum, Point, lower_point, minimize
from eslr_jax.physics.potential import next_friction_load, potential
from eslr_jax.physics.preconditioner import stiffness
from eslr_jax.physics.problem import FrameProblem, PhysicsParameters, make_problem, pin, separate, start_guess
from eslr_jax.physics.start import solver_start
from eslr_jax.simulate.network import network_step
from eslr_jax.types import BodySurface, ClothState, Garment, Material


class FrameInput(NamedTuple):
    """What the outside world does during one frame; None is not modelled."""

    body: Float[Array, "surface_vertices 3"] | None  # at t [m]
    next_body: Float[Array, "surface_vertices 3"] | None  # at t + 1 [m]
    pin_targets: Float[Array, "vertices 3"] | None  # at t + 1 [m]


class StepReport(NamedTuple):
    """How a frame went."""

    residual: Float[Array, ""]  # force norm over weight
    iterations: Int[Array, ""]
    needed_capacity: Int[Array, " capacities"] | None  # see Trajectory


def frame_problem(
    garment: Garment,
    state: ClothState,
    frame: FrameInput,
    surface: BodySurface | None,
    timestep: Float[Array, ""],
    parameters: PhysicsParameters,
    config: SimConfig | None = None,
) -> FrameProblem:
    """Find the frame's contacts and state its minimisation problem.

    Args:
        garment: Rest mesh.
        state: Cloth at t.
        frame: The outside world from t to t + 1.
        surface: Search tables of the body; None without one.
        timestep: Duration of the frame [s].
        parameters: Constants of the scene.
        config: Says whether layers and tips collide; neither does by default.
    """
    config = config or SimConfig()
    contacts = opposing = tips = self_contacts = None
    guess = state.position + timestep * state.velocity
    if surface is not None:
        assert frame.body is not None
        assert frame.next_body is not None
        contacts, opposing = find_both_sides(state.position, frame.body, frame.next_body, surface)
        if config.tip_contact:
            tips = find_tip_contacts(state.position, guess, frame.body, frame.next_body, garment)
    if config.self_contact:
        self_contacts = find_self_contacts(
            state.position,
            guess,
            garment,
            capacity=config.self_contact_capacity,
            cell_capacity=config.self_contact_cell_capacity or CELL_CAPACITY,
        )
    return make_problem(
        garment,
        state,
        contacts,
        frame.pin_targets,
        timestep,
        parameters,
        self_contacts=self_contacts,
        opposing=opposing,
        tips=tips,
        next_body=frame.next_body,
    )


def solve(
    problem: FrameProblem,
    garment: Garment,
    material: Material,
    start: Float[Array, "vertices 3"] | Point,
    *,
    iterations: int | Int[Array, ""],
    memory: int = SimConfig.solver_memory,
    tolerance: float = 0.0,
    earlier: Point | None = None,
) -> Minimum:
    """Minimise the frame's potential from `start` by L-BFGS; see `minimize` and `SimConfig.tolerance`."""

    def energy(position: Float[Array, "vertices 3"]) -> Float[Array, ""]:
        return potential(position, problem, garment, material)

    return minimize(
        energy,
        start,
        stiffness(problem, garment, material, start.position if isinstance(start, Point) else start),
        iterations=iterations,
        memory=memory,
        gap_tolerance=tolerance,
        # Whatever it starts from, a frame's gain counts from the best guess that costs nothing.
        reference_value=energy(start_guess(problem, garment)) if tolerance else None,
        earlier=earlier,
    )


def evaluate(
    position: Float[Array, "vertices 3"], problem: FrameProblem, garment: Garment, material: Material
) -> Point:
    """Return positions with the frame's potential and its gradient there."""
    return Point(position, *jax.value_and_grad(potential)(position, problem, garment, material))


class Start(NamedTuple):
    """Where the solver starts a frame."""

    point: Point
    earlier: Point | None  # from which a network came, see `minimize`; None for the solver's own start
    status: Int[Array, ""]


def start_point(
    params: Any,
    garment: Garment,
    material: Material,
    problem: FrameProblem,
    state: ClothState,
    config: SimConfig,
) -> Start:
    """Return the solver's own start, or a network's answer where that is no higher than what it came from.

    The arguments are those of `step`.
    """
    if config.simulator == "physics":
        own = solver_start(problem, garment, material)
        return Start(evaluate(own, problem, garment, material), None, jnp.int32(Status.OK))
    assert config.model is not None
    answer = network_step(params, garment, material, problem, state, config.model)
    point = evaluate(separate(problem, garment, answer.position), problem, garment, material)
    if answer.earlier is not None:
        point = lower_point(point, answer.earlier)
    # A solver that starts elsewhere would hide an answer that is no number.
    return Start(point, answer.earlier, answer.status | _finiteness(answer.position))


def step(
    params: Any,
    garment: Garment,
    material: Material,
    problem: FrameProblem,
    state: ClothState,
    config: SimConfig,
    iterations: Int[Array, ""] | None = None,
) -> tuple[ClothState, StepReport]:
    """Advance the cloth by one frame.

    Args:
        params: Weights of the network; None for the physics simulator.
        garment: Rest mesh.
        material: Fabric.
        problem: The frame's minimisation problem, which holds contacts and pins.
        state: Cloth at t.
        config: Choice of simulator; static.
        iterations: Of L-BFGS, in place of the configuration's; traced, so that all numbers share a program.
    """
    point, earlier, status = start_point(params, garment, material, problem, state, config)
    if config.iterations or iterations is not None:
        minimum = solve(
            problem,
            garment,
            material,
            point,
            iterations=config.iterations if iterations is None else iterations,
            memory=config.solver_memory,
            tolerance=config.tolerance,
            earlier=earlier,
        )
    else:  # no loop: the network alone can be differentiated through time
        minimum = Minimum(*point, iterations=jnp.int32(0))
    position = pin(problem, garment, minimum.position)
    weight = problem.parameters.gravity * safe_norm(vertex_masses(garment, material))
    report = StepReport(
        residual=safe_norm(minimum.gradient.reshape(-1)) / weight,
        iterations=minimum.iterations,
        needed_capacity=_needed_capacity(problem.self_contacts),
    )
    return next_state(position, problem, garment, state, status), report


def _needed_capacity(pairs: FacePairs | None) -> Int[Array, " capacities"] | None:
    """Return the capacities that self-contact needed, for pairs and for faces in a search column."""
    return None if pairs is None else jnp.stack([pairs.count, pairs.listed])


def _finiteness(position: Float[Array, "vertices 3"]) -> Int[Array, ""]:
    """Return the status bits of positions."""
    return jnp.where(jnp.all(jnp.isfinite(position)), int(Status.OK), int(Status.NON_FINITE))


def next_state(
    position: Float[Array, "vertices 3"],
    problem: FrameProblem,
    garment: Garment,
    state: ClothState,
    status: Int[Array, ""],
) -> ClothState:
    """Semi-implicit Euler: the velocity that brought the cloth to `position`, and what the frame left behind."""
    load = state.friction_load
    if problem.contacts is not None:
        load = next_friction_load(position, problem, garment)
        contacts = problem.contacts
        moved = approach(contacts.points, contacts.next_points, contacts.normals)
        is_too_fast = jnp.any(contacts.is_near & (moved > MAX_APPROACH) & garment.vertex_mask)
        status = status | jnp.where(is_too_fast, int(Status.BODY_TOO_FAST), int(Status.OK))
    for pairs in (problem.self_contacts, problem.tips):
        if pairs is not None:
            status = status | pairs.status
    status = state.status | status | _finiteness(position)
    return ClothState(
        position=position,
        velocity=(position - problem.position) / problem.timestep,
        friction_load=load,
        status=status,
        frame=state.frame + 1,
        first_bad_frame=jnp.where(
            (state.status == 0) & (status != 0), state.frame + 1, state.first_bad_frame
        ),
    )
