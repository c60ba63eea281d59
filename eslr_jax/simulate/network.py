"""The network as a stepper: from a frame's problem to its answer."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.config import ModelConfig
from eslr_jax.graph.build import build_frame_graph, build_graph, build_refinement_graph
from eslr_jax.graph.inputs import GraphInputs, next_refinement
from eslr_jax.models.registry import apply_model, apply_refinement, encode_frame, scale_output
from eslr_jax.numerics import safe_norm
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.lbfgs import Point
from eslr_jax.physics.potential import potential
from eslr_jax.physics.preconditioner import solve_stiffness, stiffness
from eslr_jax.physics.problem import FrameProblem, pin
from eslr_jax.physics.start import solver_start
from eslr_jax.physics.subspace import combine_directions
from eslr_jax.types import ClothState, Garment, Material


def graph_inputs(
    problem: FrameProblem, garment: Garment, material: Material, state: ClothState
) -> GraphInputs:
    """Return what the graph is built from; pinned vertices already carry their next target (HOOD)."""
    contacts = problem.contacts
    position = pin(problem, garment, state.position)
    velocity = state.velocity * problem.timestep
    if problem.pin_targets is not None:
        velocity = jnp.where(garment.is_pinned[:, None], position - state.position, velocity)
    return GraphInputs(
        position=position,
        velocity=velocity,
        timestep=problem.timestep,
        contacts=contacts,
        body_velocity=None if contacts is None else contacts.next_points - contacts.points,
        inertial_guess=problem.inertial_guess,
        weight=problem.parameters.gravity * vertex_masses(garment, material),
    )


def predict_acceleration(
    params: Any,
    garment: Garment,
    problem: FrameProblem,
    inputs: GraphInputs,
    material: Material,
    config: ModelConfig,
) -> tuple[Float[Array, "vertices 3"], Int[Array, ""]]:
    """Integrate the network's acceleration, as the paper does, and return positions and status bits.

    Source: the paper's method section, Q' = Q + A dt and X' = X + Q' dt, in HOOD's per-frame units.
    """
    graph = build_graph(garment, material, inputs, config)
    output = apply_model(config, params, graph, garment)
    velocity = inputs.velocity + scale_output(config, params, output)
    return pin(problem, garment, inputs.position + velocity), graph.globals["status"]


class Correction(NamedTuple):
    """What passes over a frame's guess lead to."""

    starts: Point  # of every pass, stacked
    answers: Float[Array, "refinement_steps vertices 3"]  # [m]
    status: Int[Array, ""]


class NetworkAnswer(NamedTuple):
    """What a network makes of a frame."""

    position: Float[Array, "vertices 3"]  # at t + 1 [m]
    earlier: Point | None  # the lowest that a pass started from; None where no guess is corrected
    status: Int[Array, ""]


def refine(
    params: Any,
    garment: Garment,
    material: Material,
    problem: FrameProblem,
    inputs: GraphInputs,
    config: ModelConfig,
    *,
    detach: bool = False,
) -> Correction:
    """Correct the guess that the solver starts from too, pass by pass.

    Before each pass the potential's gradient, and the preconditioned step down it, are taken at the last
    answer.

    Args:
        params: Weights.
        garment: Rest mesh.
        material: Fabric.
        problem: The frame's problem.
        inputs: Of `graph_inputs`.
        config: With any `output` but "acceleration"; static.
        detach: Stop gradients between passes, so that each is trained to do its best from where it starts.
    """
    graph = build_frame_graph(garment, material, inputs, config)
    guess = solver_start(problem, garment, material)
    zeros = jnp.zeros_like(guess)
    inputs = inputs.replace(
        guess=guess, gradient=zeros, step=zeros, correction=zeros, previous_gradient=zeros
    )
    encoded = encode_frame(config, params, graph, garment)
    longest = graph.globals["edge_length"]

    def energy(position: Float[Array, "vertices 3"]) -> Float[Array, ""]:
        return potential(position, problem, garment, material)

    def one_step(carry: GraphInputs, _):
        value, gradient = jax.value_and_grad(energy)(carry.guess)
        step = descent_step(problem, garment, material, carry.guess, gradient, longest)
        inputs = carry.replace(gradient=gradient, step=step)
        changing = build_refinement_graph(garment, material, inputs, graph)
        output = apply_refinement(config, params, encoded, changing, garment)
        move = correct(config, params, output, inputs)
        if config.output == "subspace":
            directions = jnp.stack([move, step, inputs.correction])
            if problem.pin_targets is not None:
                directions = jnp.where(garment.is_pinned[:, None], 0.0, directions)
            move = combine_directions(energy, inputs.guess, value, gradient, directions)
        answer = pin(problem, garment, inputs.guess + move)
        onward = jax.lax.stop_gradient(answer) if detach else answer
        return next_refinement(inputs, onward, gradient), (answer, Point(inputs.guess, value, gradient))

    _, (answers, starts) = jax.lax.scan(one_step, inputs, None, length=config.refinement_steps)
    return Correction(starts, answers, graph.globals["status"])


def descent_step(
    problem: FrameProblem,
    garment: Garment,
    material: Material,
    guess: Float[Array, "vertices 3"],
    gradient: Float[Array, "vertices 3"],
    longest: Float[Array, ""],
) -> Float[Array, "vertices 3"]:
    """Return the preconditioned step down a gradient [m], no vertex farther than `longest`.

    The stretch energy grows with the fourth power of a displacement: from a torn-up state, full steps would
    overshoot further each time. The bound is a trust region of one mesh spacing.
    """
    step = solve_stiffness(stiffness(problem, garment, material, guess), -gradient)
    length = safe_norm(step, keepdims=True)
    return step * (longest / jnp.maximum(length, longest))


def correct(
    config: ModelConfig, params: Any, output: Float[Array, "vertices outputs"], inputs: GraphInputs
) -> Float[Array, "vertices 3"]:
    """Return the way from the guess to the answer of a pass [m].

    For "descent" and "subspace" the network adds to a preconditioned gradient method with momentum: one gate
    per vertex scales the step (1 + gate), another the last correction. A new network is plain preconditioned
    descent.
    """
    correction = scale_output(config, params, output[:, :3])
    if config.output == "correction":
        return correction
    return correction + (1.0 + output[:, 3:4]) * inputs.step + output[:, 4:5] * inputs.correction


def network_step(
    params: Any,
    garment: Garment,
    material: Material,
    problem: FrameProblem,
    state: ClothState,
    config: ModelConfig,
) -> NetworkAnswer:
    """Return the network's answer to a frame, and from where its passes came.

    Args:
        params: Weights.
        garment: Rest mesh.
        material: Fabric.
        problem: The frame's problem.
        state: Cloth at t.
        config: Architecture; static.
    """
    inputs = graph_inputs(problem, garment, material, state)
    if config.output == "acceleration":
        position, status = predict_acceleration(params, garment, problem, inputs, material, config)
        return NetworkAnswer(position, None, status)
    starts, answers, status = refine(params, garment, material, problem, inputs, config)
    lowest = jnp.nanargmin(starts.value)
    return NetworkAnswer(answers[-1], jax.tree.map(lambda rows: rows[lowest], starts), status)
