"""The physics loss: the incremental potential of what the network predicts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.config import TrainConfig
from eslr_jax.networks.network import Network
from eslr_jax.solver.guess import Start, pushed_out_guess
from eslr_jax.solver.potential import potential_terms
from eslr_jax.solver.solve import solve
from eslr_jax.terms.term import FrameProblem, pin
from eslr_jax.types import ClothState

_FALL = 0.01  # [m]; the loss of set "consistent" is in units of the work of lifting the garment by this
_MIN_GAP = 1e-2  # after a refinement step, as a share of the first one's: the optimum is not known better
_MIN_INITIAL_GAP = 1e-7  # [J] of a frame in which nothing happens
_MIN_DISTANCE = 1e-5  # [m] likewise, root of the sum over vertices


EnergyTerms = Callable[[Array, FrameProblem], dict[str, Array]]
"""From positions [m] and the frame's problem to energies [J]."""


class LossReport(NamedTuple):
    """What one evaluation of the loss shows."""

    onward: Float[Array, "vertices 3"]  # positions at t + 1 [m], from which the trajectory goes on
    energies: dict[str, Array]  # by term, at the network's prediction [J]
    inertial_energy: Float[Array, ""]  # potential at the pushed-out inertial guess [J]


def physics_loss(
    network: Network,
    problem: FrameProblem,
    state: ClothState,
    config: TrainConfig,
    terms_of: EnergyTerms = potential_terms,
) -> tuple[Float[Array, ""], LossReport]:
    """Return the loss of a set of energies, without unit or in joules (set "hood"), and its report."""
    positions = network.predict(problem, state, detach=True).positions
    terms = jax.vmap(terms_of, in_axes=(0, None))(positions, problem)
    energies = sum(terms.values())
    guess = pushed_out_guess(problem)
    guess_value = sum(terms_of(guess, problem).values())
    onward = positions[-1]
    if config.iterations:
        start = Start(jax.lax.stop_gradient(positions[-1]), guess_value)
        minimum = solve(problem, start, iterations=config.iterations)
        onward = pin(problem, minimum.position)
        optimum = onward, minimum.value
        loss = _mean_start_error(problem, optimum, (guess, guess_value), (positions, energies))
    elif config.refinement_weights == "contraction":
        loss = _mean_contraction(jnp.concatenate([jnp.reshape(guess_value, 1), energies]))
    else:
        # HOOD's is in joules, and its gradient is clipped in these.
        scale = 1.0
        if config.energy_set == "consistent":
            scale = _FALL * problem.gravity * jnp.sum(problem.masses)
        loss = jnp.mean(energies) / scale
    last = jax.tree.map(lambda values: values[-1], terms)
    return loss, LossReport(onward, last, guess_value)


def _mean_start_error(
    problem: FrameProblem,
    optimum: tuple[Array, Array],
    guess: tuple[Array, Array],
    predictions: tuple[Array, Array],
) -> Float[Array, ""]:
    """Return how far predictions are from the optimum: mean logarithm of the shares of gap and squared distance.

    All are positions [m] with their potential [J]; predictions along a leading axis of steps. Both shares are
    relative to the pushed-out inertial guess. The gap alone is mostly stretch, which the solver's first
    iterations remove. The solver needs many iterations where distances are long and energies small.
    """

    def squared_distance(position: Float[Array, "vertices 3"]) -> Float[Array, ""]:
        offset = jnp.where(problem.garment.vertex_mask[:, None], position - optimum[0], 0.0)
        return jnp.sum(offset * offset)

    def log_share(left: Array, whole: Array) -> Array:
        return jnp.log(jnp.maximum(left / whole, 0.0) + _MIN_GAP)

    initial_gap = jnp.maximum(guess[1] - optimum[1], _MIN_INITIAL_GAP)
    distance = jnp.maximum(squared_distance(guess[0]), _MIN_DISTANCE**2)
    gap, apart = predictions[1] - optimum[1], jax.vmap(squared_distance)(predictions[0])
    return jnp.mean(0.5 * log_share(gap, initial_gap) + 0.5 * log_share(apart, distance))


def _mean_contraction(energies: Float[Array, " energies"]) -> Float[Array, ""]:
    """Return the mean share of the gap that a refinement step leaves; the last prediction stands for the optimum.

    Early steps move energies of joules, late ones of microjoules: their mean trains the early ones alone.
    """
    fixed = jax.lax.stop_gradient(energies)
    gap = fixed[:-1] - fixed[-1]
    # By size, as a prediction may be worse than the guess.
    reference = jnp.maximum(jnp.abs(gap), jnp.maximum(_MIN_GAP * jnp.abs(gap[0]), _MIN_INITIAL_GAP))
    return jnp.mean((energies[1:] - fixed[-1]) / reference)
