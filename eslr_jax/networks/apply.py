"""Networks applied: to a graph, and to a frame's problem, by an acceleration or by corrections of a guess."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import jraph
from jaxtyping import Array, Bool, Float

from eslr_jax.contact.nearest import find_near_vertices
from eslr_jax.networks import build, features, normalizer
from eslr_jax.networks.features import GraphInputs, RefinementInputs
from eslr_jax.networks.network import Network, Prediction, Statistics
from eslr_jax.numerics import safe_norm
from eslr_jax.solver.guess import initial_guess
from eslr_jax.solver.potential import evaluate, potential
from eslr_jax.solver.preconditioner import solve_stiffness, stiffness
from eslr_jax.solver.subspace import combine_directions
from eslr_jax.terms import Collision
from eslr_jax.terms.term import FrameProblem, pin
from eslr_jax.types import ClothState, Garment


class Places(NamedTuple):
    """Where the garment's vertices lie on it."""

    embedding: Float[Array, "vertices embedding"]  # geodesic embedding [m]
    mask: Bool[Array, " vertices"]  # vertices that are not padding


def apply_model(
    network: Network, graph: jraph.GraphsTuple, garment: Garment
) -> Float[Array, "vertices outputs"]:
    """Return the network's raw output for a graph of `build_graph`, of the network's kind; see `scale_output`."""
    places = Places(garment.geodesic_embedding, garment.vertex_mask)
    return _call(network, graph, network.statistics, places)


def encode_frame(network: Network, graph: jraph.GraphsTuple) -> Any:
    """Return what all refinement steps of a frame share, from a graph of `build_frame_graph`."""
    return _call(network, graph, network.statistics, method="encode")


def apply_refinement(
    network: Network, encoded: Any, changing: jraph.GraphsTuple, garment: Garment
) -> Float[Array, "vertices outputs"]:
    """Return the raw output of one refinement step; equals `apply_model` on the joined graph.

    `encoded` is the result of `encode_frame`, and `changing` a graph of `build_refinement_graph`.
    """
    places = Places(garment.geodesic_embedding, garment.vertex_mask)
    return _call(network, encoded, places, changing, method="process")


def _call(network: Network, *args: Any, **options: Any) -> Any:
    weights = {"params": network.params}
    if network.constants:
        weights["constants"] = network.constants
    return network.config.module_class(network.config).apply(weights, *args, **options)


def scale_output(network: Network, output: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return vectors, the output's first three columns, in metres; accelerations in metres per frame squared.

    Source: HOOD's output normaliser, applied backwards, for accelerations.
    """
    if network.config.reads_gradient:
        return output * network.config.correction_scale
    return normalizer.inverse(network.statistics["output"], output)


def measure_statistics(
    network: Network, graph: jraph.GraphsTuple, garment: Garment, acceleration: Float[Array, "vertices 3"]
) -> Statistics:
    """Return the statistics of one graph and of target accelerations [m per frame^2].

    There are none for features that are not normalised. HOOD's targets are those of the skinned garment.

    Source: HOOD's `utils/normalization.py`.
    """
    if network.config.reads_gradient:
        return {}
    nodes = jax.lax.stop_gradient(_call(network, graph, method="with_types"))
    edges, topology = cast(build.Rows, graph.edges), cast(build.Topology, graph.globals)
    masks = {"garment": garment.vertex_mask, "mesh": garment.edge_mask}
    levels = zip(build.COARSE_SETS, topology.get("coarse", ()), strict=False)
    masks |= {name: level.edge_mask for name, level in levels}
    groups = {"output": [(acceleration, garment.vertex_mask)]}
    for name, rows in (nodes | edges).items():
        kind = build.normalizer_of(name)
        changing = rows[:, : rows.shape[1] - features.HOOD_STATIC[kind]]
        groups.setdefault(kind, []).append((changing, masks.get(name, topology.get("world_mask"))))
    joined = {kind: map(jnp.concatenate, zip(*parts, strict=True)) for kind, parts in groups.items()}
    return {kind: normalizer.measure(*parts) for kind, parts in joined.items()}


def merge_statistics(network: Network, measured: Statistics) -> Network:
    """Return a network whose normalisers include what was measured."""
    seen = network.statistics
    merged = {name: normalizer.merge(seen[name], new) for name, new in measured.items()}
    return network.replace(statistics={**seen, **merged})


def graph_inputs(problem: FrameProblem, state: ClothState, kind: build.GraphKind) -> GraphInputs:
    """Return what a graph of a kind is built from; pinned vertices already carry their next target (HOOD)."""
    position = pin(problem, state.position)
    velocity = state.velocity * problem.timestep
    if problem.pin_targets is not None:
        is_pinned = problem.garment.is_pinned[:, None]
        velocity = jnp.where(is_pinned, position - state.position, velocity)
    touched, body, others = problem.data_of(Collision), problem.body, kind.world_edges - 1
    contacts = None if touched is None else touched.nearest
    if contacts is not None and body is not None and others:
        near = find_near_vertices(position, body.start, body.end, body.surface, others)
        contacts = jax.tree.map(lambda *rows: jnp.concatenate(rows), contacts, near)
    return GraphInputs(
        position=position,
        velocity=velocity,
        timestep=problem.timestep,
        contacts=contacts,
        inertial_guess=problem.inertial_guess,
        weight=problem.gravity * problem.masses,
    )


def predict_acceleration(network: Network, problem: FrameProblem, state: ClothState) -> Prediction:
    """Integrate the network's acceleration, as the paper does.

    Source: the paper's method section, Q' = Q + A dt and X' = X + Q' dt, in HOOD's per-frame units.
    """
    inputs = graph_inputs(problem, state, network.config.graph)
    graph = build.build_graph(problem.garment, problem.material, inputs, network.config.graph)
    output = apply_model(network, graph, problem.garment)
    velocity = inputs.velocity + scale_output(network, output)
    return Prediction(pin(problem, inputs.position + velocity)[None])


def refine(network: Network, problem: FrameProblem, state: ClothState, *, detach: bool = False) -> Prediction:
    """Correct the solver's own initial guess, step by step, by a network that reads the potential's gradient.

    Before each step the potential's gradient, and the preconditioned step down it, are taken at the last
    positions. With gates the network adds to a preconditioned gradient method with momentum: a new network is
    plain preconditioned descent.

    With `detach` gradients stop between steps, and so do those of the weights that combine directions: each step
    is then trained to do its best from where it begins.
    """
    garment, material, config = problem.garment, problem.material, network.config
    inputs = graph_inputs(problem, state, config.graph)
    graph = build.build_frame_graph(garment, material, inputs, config.graph)
    guess = initial_guess(problem)
    encoded = encode_frame(network, graph)
    longest: Array = graph.globals["edge_lengths"]["mesh"]  # type: ignore[index, call-overload]: jraph's trees

    def one_step(carry: tuple[Array, Array, Array], _):
        start, correction, previous_gradient = carry
        point = evaluate(start, problem)
        # The stretch energy grows with the fourth power of a displacement: from a torn-up state, full steps would
        # overshoot further each time. The bound is a trust region of one mesh spacing.
        step = solve_stiffness(stiffness(problem, point.position), -point.gradient)
        step = step * (longest / jnp.maximum(safe_norm(step, keepdims=True), longest))
        now = RefinementInputs(
            **vars(inputs),
            guess=start,
            gradient=point.gradient,
            step=step,
            correction=correction,
            previous_gradient=previous_gradient,
        )
        changing = build.build_refinement_graph(garment, material, now, graph)
        output = apply_refinement(network, encoded, changing, garment)
        move = scale_output(network, output[:, :3])
        if config.has_gates:  # one per vertex scales the step (1 + gate), another the last correction
            move = move + (1.0 + output[:, 3:4]) * step + output[:, 4:5] * correction
        if config.is_combined:
            directions = jnp.stack([move, step, correction])
            if problem.pin_targets is not None:
                directions = jnp.where(garment.is_pinned[:, None], 0.0, directions)
            move = combine_directions(
                lambda x: potential(x, problem), point, directions, fixed_weights=detach
            )
        position = pin(problem, start + move)
        onward = jax.lax.stop_gradient(position) if detach else position
        return (onward, onward - point.position, point.gradient), (position, point)

    zeros = jnp.zeros_like(guess.position)
    first = (guess.position, zeros, zeros)
    _, (positions, starts) = jax.lax.scan(one_step, first, None, length=config.refinement_steps)
    lowest = jnp.nanargmin(starts.value)
    return Prediction(positions, guess, jax.tree.map(lambda rows: rows[lowest], starts))
