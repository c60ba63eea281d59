"""The physics loss: the incremental potential of what the network answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.config import TrainConfig
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.potential import PotentialTerms, potential_terms
from eslr_jax.physics.problem import FrameProblem, pin, start_guess
from eslr_jax.simulate.network import refine, graph_inputs, predict_acceleration
from eslr_jax.simulate.step import solve
from eslr_jax.types import ClothState, Garment, Material

_FALL = 0.01  # [m]; the loss is in units of the work of lifting the garment by this
_MIN_GAP = 1e-2  # of a pass, as a share of the first one's: the optimum itself is not known better
_MIN_INITIAL_GAP = 1e-7  # [J] of a frame in which nothing happens
_MIN_DISTANCE = 1e-5  # [m] likewise, root of the sum over vertices


EnergyTerms = Callable[[Array, FrameProblem, Garment, Material], PotentialTerms]


class LossReport(NamedTuple):
    """What one evaluation of the loss shows."""

    answer: Float[Array, "vertices 3"]  # positions at t + 1 [m], from which the trajectory goes on
    terms: PotentialTerms  # at the network's answer [J]
    start: Float[Array, ""]  # potential at the pushed-out inertial guess [J]


def physics_loss(
    params: Any,
    garment: Garment,
    material: Material,
    problem: FrameProblem,
    state: ClothState,
    config: TrainConfig,
    terms_of: EnergyTerms = potential_terms,
) -> tuple[Float[Array, ""], LossReport]:
    """Return the loss, without unit, and its report.

    Args:
        params: Weights.
        garment: Rest mesh.
        material: Fabric.
        problem: The frame's problem.
        state: Cloth at t.
        config: Architecture and which passes count; static.
        terms_of: The set of energies, as a function of positions, problem, garment and fabric.
    """
    model = config.model
    inputs = graph_inputs(problem, garment, material, state)
    if model.output == "acceleration":
        answer, _ = predict_acceleration(params, garment, problem, inputs, material, model)
        answers = answer[None]
    else:
        answers = refine(params, garment, material, problem, inputs, model, detach=True).answers
    terms = jax.vmap(terms_of, in_axes=(0, None, None, None))(answers, problem, garment, material)
    energies = jnp.sum(jnp.stack([jnp.broadcast_to(term, answers.shape[:1]) for term in terms]), axis=0)
    scale = _FALL * problem.parameters.gravity * jnp.sum(vertex_masses(garment, material))
    guess = start_guess(problem, garment)
    start = sum(terms_of(guess, problem, garment, material))
    onward = answers[-1]
    if config.corrector_steps:
        fixed = jax.lax.stop_gradient(answers[-1])
        minimum = solve(problem, garment, material, fixed, iterations=config.corrector_steps)
        onward = pin(problem, garment, minimum.position)
        loss = _mean_start_error(answers, energies, onward, minimum.value, guess, start, garment)
    elif config.refinement_weights == "last":
        loss = energies[-1] / scale
    elif config.refinement_weights == "equal":
        loss = jnp.mean(energies) / scale
    else:
        loss = _mean_contraction(jnp.concatenate([jnp.reshape(start, 1), energies]))
    last = PotentialTerms(*(jnp.broadcast_to(term, answers.shape[:1])[-1] for term in terms))
    return loss, LossReport(onward, last, start)  # type: ignore[arg-type]


def _mean_start_error(
    answers: Float[Array, "refinement_steps vertices 3"],
    energies: Float[Array, " passes"],
    optimum: Float[Array, "vertices 3"],
    least: Float[Array, ""],
    guess: Float[Array, "vertices 3"],
    start: Float[Array, ""],
    garment: Garment,
) -> Float[Array, ""]:
    """Return how far answers are from the optimum: mean logarithm of the shares of gap and squared distance.

    Shares are of what the pushed-out guess has. The gap alone is mostly stretch, which the solver's first
    iterations remove; what takes it many is where distances are long and energies small.
    """

    def squared_distance(position: Float[Array, "vertices 3"]) -> Float[Array, ""]:
        offset = jnp.where(garment.vertex_mask[:, None], position - optimum, 0.0)
        return jnp.sum(offset * offset)

    def log_share(left: Array, whole: Array) -> Array:
        return jnp.log(jnp.maximum(left / whole, 0.0) + _MIN_GAP)

    drop = jnp.maximum(start - least, _MIN_INITIAL_GAP)
    distance = jnp.maximum(squared_distance(guess), _MIN_DISTANCE**2)
    gap, apart = energies - least, jax.vmap(squared_distance)(answers)
    return jnp.mean(0.5 * log_share(gap, drop) + 0.5 * log_share(apart, distance))


def _mean_contraction(energies: Float[Array, " passes+1"]) -> Float[Array, ""]:
    """Return the mean share of a pass's gap that is left after it; the last answer stands for the optimum.

    Early passes move energies of joules, late ones of microjoules: their mean trains the early ones alone.
    """
    fixed = jax.lax.stop_gradient(energies)
    gap = fixed[:-1] - fixed[-1]
    floor = _MIN_GAP * jnp.maximum(gap[0], 0.0)
    reference = jnp.where(floor > 0, jnp.maximum(gap, floor), 1.0)
    return jnp.mean((energies[1:] - fixed[-1]) / reference)
