"""From a frame's problem to positions at its end: by an acceleration, or by corrections of the solver's guess."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.networks.apply import apply_model, apply_refinement, encode_frame, scale_output
from eslr_jax.networks.build import build_frame_graph, build_graph, build_refinement_graph
from eslr_jax.networks.inputs import GraphInputs, next_refinement, required
from eslr_jax.networks.network import Network, Prediction
from eslr_jax.numerics import safe_norm
from eslr_jax.solver.guess import initial_guess
from eslr_jax.solver.potential import Point, evaluate, potential
from eslr_jax.solver.preconditioner import solve_stiffness, stiffness
from eslr_jax.solver.subspace import combine_directions
from eslr_jax.terms import Collision
from eslr_jax.terms.problem import FrameProblem, pin
from eslr_jax.types import ClothState


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


def predict_acceleration(network: Network, problem: FrameProblem, state: ClothState) -> Prediction:
    """Integrate the network's acceleration, as the paper does.

    Source: the paper's method section, Q' = Q + A dt and X' = X + Q' dt, in HOOD's per-frame units.
    """
    inputs = graph_inputs(problem, state)
    graph = build_graph(problem.garment, problem.material, inputs, network.config.graph)
    output = apply_model(network, graph, problem.garment)
    velocity = inputs.velocity + scale_output(network, output)
    return Prediction(pin(problem, inputs.position + velocity)[None])


def refine(network: Network, problem: FrameProblem, state: ClothState, *, detach: bool = False) -> Prediction:
    """Correct the solver's own initial guess, step by step.

    Before each step the potential's gradient, and the preconditioned step down it, are taken at the last
    positions.

    Args:
        network: One that reads the potential's gradient.
        problem: The frame's problem.
        state: Cloth at t.
        detach: Stop gradients between steps, and those of the weights that combine directions: each step is then
            trained to do its best from where it begins.
    """
    garment, material, config = problem.garment, problem.material, network.config
    inputs = graph_inputs(problem, state)
    graph = build_frame_graph(garment, material, inputs, config.graph)
    guess = initial_guess(problem)
    zeros = jnp.zeros_like(guess.position)
    inputs = inputs.replace(
        guess=guess.position, gradient=zeros, step=zeros, correction=zeros, previous_gradient=zeros
    )
    encoded = encode_frame(network, graph)
    longest: Array = graph.globals["edge_length"]  # type: ignore[index, assignment]: jraph's trees

    def one_step(carry: GraphInputs, _):
        point = evaluate(required(carry, "guess"), problem)
        inputs = carry.replace(gradient=point.gradient, step=descent_step(problem, point, longest))
        changing = build_refinement_graph(garment, material, inputs, graph)
        output = apply_refinement(network, encoded, changing, garment)
        move = correct(network, output, inputs)
        if config.is_combined:
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
    lowest = jnp.nanargmin(starts.value)
    return Prediction(positions, guess, jax.tree.map(lambda rows: rows[lowest], starts))


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
    network: Network, output: Float[Array, "vertices outputs"], inputs: GraphInputs
) -> Float[Array, "vertices 3"]:
    """Return the way from the guess to the end of a refinement step [m], shape [vertices, 3].

    With gates the network adds to a preconditioned gradient method with momentum: one gate
    per vertex scales the step (1 + gate), another the last correction. A new network is plain preconditioned
    descent.
    """
    correction = scale_output(network, output[:, :3])
    if not network.config.has_gates:
        return correction
    step, last = required(inputs, "step"), required(inputs, "correction")
    return correction + (1.0 + output[:, 3:4]) * step + output[:, 4:5] * last
