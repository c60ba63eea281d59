"""The network as a predictor: from a frame's problem to positions at its end."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.config import ModelConfig, Predictor
from eslr_jax.graph.build import build_frame_graph, build_graph, build_refinement_graph
from eslr_jax.graph.inputs import GraphInputs, next_refinement, required
from eslr_jax.models.registry import apply_model, apply_refinement, encode_frame, scale_output
from eslr_jax.numerics import safe_norm
from eslr_jax.physics.guess import InitialGuess, initial_guess
from eslr_jax.physics.potential import Point, evaluate, potential
from eslr_jax.physics.preconditioner import solve_stiffness, stiffness
from eslr_jax.physics.subspace import combine_directions
from eslr_jax.terms import Collision
from eslr_jax.terms.problem import FrameProblem, pin
from eslr_jax.types import ClothState


class Prediction(NamedTuple):
    """What a network makes of a frame."""

    position: Float[Array, "vertices 3"]  # at t + 1 [m]
    guess: InitialGuess | None = None  # that was refined; None for one acceleration
    previous: Point | None = None  # the lowest point that a refinement step began from


class Refinement(NamedTuple):
    """What the refinement steps of a frame lead to."""

    guess: InitialGuess
    starts: Point  # of every step, stacked
    positions: Float[Array, "steps vertices 3"]  # after every step [m]


def predict(
    params: Any, problem: FrameProblem, state: ClothState, config: ModelConfig | Predictor
) -> Prediction:
    """Return the network's prediction for a frame.

    Args:
        params: Weights of the network.
        problem: The frame's problem.
        state: Cloth at t.
        config: Architecture, or a network of one's own; static.
    """
    if not isinstance(config, ModelConfig):
        return Prediction(pin(problem, config.apply(params, problem, state)))
    if config.output == "acceleration":
        return Prediction(predict_acceleration(params, problem, state, config))
    guess, starts, positions = refine(params, problem, state, config)
    lowest = jnp.nanargmin(starts.value)
    return Prediction(positions[-1], guess, jax.tree.map(lambda rows: rows[lowest], starts))


def graph_inputs(problem: FrameProblem, state: ClothState) -> GraphInputs:
    """Return what the graph is built from; pinned vertices already carry their next target (HOOD)."""
    position = pin(problem, state.position)
    velocity = state.velocity * problem.timestep
    if problem.pin_targets is not None:
        is_pinned = problem.garment.is_pinned[:, None]
        velocity = jnp.where(is_pinned, position - state.position, velocity)
    touched = problem.data_of(Collision)
    contacts = None if touched is None else touched.nearest
    return GraphInputs(
        position=position,
        velocity=velocity,
        timestep=problem.timestep,
        contacts=contacts,
        body_velocity=None if contacts is None else contacts.next_points - contacts.points,
        inertial_guess=problem.inertial_guess,
        weight=problem.gravity * problem.masses,
    )


def predict_acceleration(
    params: Any, problem: FrameProblem, state: ClothState, config: ModelConfig
) -> Float[Array, "vertices 3"]:
    """Integrate the network's acceleration, as the paper does, and return positions [m], shape [vertices, 3].

    Source: the paper's method section, Q' = Q + A dt and X' = X + Q' dt, in HOOD's per-frame units.
    """
    inputs = graph_inputs(problem, state)
    graph = build_graph(problem.garment, problem.material, inputs, config)
    output = apply_model(config, params, graph, problem.garment)
    velocity = inputs.velocity + scale_output(config, params, output)
    return pin(problem, inputs.position + velocity)


def refine(
    params: Any, problem: FrameProblem, state: ClothState, config: ModelConfig, *, detach: bool = False
) -> Refinement:
    """Correct the solver's own initial guess, step by step.

    Before each step the potential's gradient, and the preconditioned step down it, are taken at the last
    positions.

    Args:
        params: Weights of the network.
        problem: The frame's problem.
        state: Cloth at t.
        config: Architecture with any `output` but "acceleration"; static.
        detach: Stop gradients between steps, and those of the weights that combine directions: each step is then
            trained to do its best from where it begins.
    """
    garment, material = problem.garment, problem.material
    inputs = graph_inputs(problem, state)
    graph = build_frame_graph(garment, material, inputs, config)
    guess = initial_guess(problem)
    zeros = jnp.zeros_like(guess.position)
    inputs = inputs.replace(
        guess=guess.position, gradient=zeros, step=zeros, correction=zeros, previous_gradient=zeros
    )
    encoded = encode_frame(config, params, graph)
    longest: Array = graph.globals["edge_length"]  # type: ignore[index, assignment]: jraph's trees

    def one_step(carry: GraphInputs, _):
        point = evaluate(required(carry, "guess"), problem)
        inputs = carry.replace(gradient=point.gradient, step=descent_step(problem, point, longest))
        changing = build_refinement_graph(garment, material, inputs, graph)
        output = apply_refinement(config, params, encoded, changing, garment)
        move = correct(config, params, output, inputs)
        if config.output == "subspace":
            directions = jnp.stack([move, inputs.step, inputs.correction])
            if problem.pin_targets is not None:
                directions = jnp.where(garment.is_pinned[:, None], 0.0, directions)
            move = combine_directions(
                lambda x: potential(x, problem), point, directions, fixed_weights=detach
            )
        position = pin(problem, inputs.guess + move)
        onward = jax.lax.stop_gradient(position) if detach else position
        return next_refinement(inputs, onward), (position, point)

    _, (positions, starts) = jax.lax.scan(one_step, inputs, None, length=config.refinement_steps)
    return Refinement(guess, starts, positions)


def descent_step(
    problem: FrameProblem, point: Point, longest: Float[Array, ""]
) -> Float[Array, "vertices 3"]:
    """Return the preconditioned step down the gradient [m], shape [vertices, 3], bounded by `longest`.

    The stretch energy grows with the fourth power of a displacement: from a torn-up state, full steps would
    overshoot further each time. The bound is a trust region of one mesh spacing.

    Args:
        problem: The frame's problem.
        point: Positions with their gradient.
        longest: Bound of a vertex's step [m].
    """
    step = solve_stiffness(stiffness(problem, point.position), -point.gradient)
    length = safe_norm(step, keepdims=True)
    return step * (longest / jnp.maximum(length, longest))


def correct(
    config: ModelConfig, params: Any, output: Float[Array, "vertices outputs"], inputs: GraphInputs
) -> Float[Array, "vertices 3"]:
    """Return the way from the guess to the end of a refinement step [m], shape [vertices, 3].

    For "descent" and "subspace" the network adds to a preconditioned gradient method with momentum: one gate
    per vertex scales the step (1 + gate), another the last correction. A new network is plain preconditioned
    descent.
    """
    correction = scale_output(config, params, output[:, :3])
    if config.output == "correction":
        return correction
    step, last = required(inputs, "step"), required(inputs, "correction")
    return correction + (1.0 + output[:, 3:4]) * step + output[:, 4:5] * last
