"""One frame: from the cloth's state and its problem to the next state, by the solver, a network, or both."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.config import SimConfig
from eslr_jax.errors import ConfigError, Status
from eslr_jax.networks.network import Network, Prediction
from eslr_jax.numerics import safe_norm
from eslr_jax.solver.guess import Start, initial_guess
from eslr_jax.solver.lbfgs import Minimum
from eslr_jax.solver.potential import (
    Point,
    any_passed,
    contact_load,
    corrected,
    evaluate,
    potential_terms,
)
from eslr_jax.solver.solve import lower_point, solve_frame
from eslr_jax.terms.term import FrameProblem, pin, weight_norm
from eslr_jax.types import ClothState, PastState

# [weights] Force up to which BDF2 carries a frame on. A T-shirt's frames end with 0.3, those of a fast dance with
# up to 5. With 5, cloth that was stretched or crumpled swings on, with faces that stay stretched by 9 %.
_MOST_CARRIED = 1.0


class FrameReport(NamedTuple):
    """How a frame went."""

    energies: dict[str, Float[Array, ""]]  # that it ended with [J], by the names of the terms
    residual: Float[Array, ""]  # force norm over weight
    iterations: Int[Array, ""]  # of the solver
    demands: dict[str, Int[Array, ""]]  # see Trajectory
    # Share of the initial gap that the solver left at most; infinite without one.
    gap_bound: Float[Array, ""] | float = math.inf
    is_passed: Bool[Array, ""] | None = None  # see Trajectory


Stepper = Callable[[FrameProblem, ClothState], tuple[ClothState, FrameReport]]
"""Advances the cloth by one frame; the common interface of the solver, of networks, and of both together."""


def keeps_tolerance(
    gap_bound: Float[Array, "*frames"], residual: Float[Array, "*frames"], tolerance: float
) -> Bool[Array, "*frames"]:
    """Return whether frames ended within a tolerance, by the solver's own bound.

    Args:
        gap_bound: Of `FrameReport` or `Trajectory`.
        residual: Likewise; where no force is left, there is nothing to bound.
        tolerance: Share of the initial gap that may be left.
    """
    return (gap_bound <= (1 + 1e-5) * tolerance) | (residual == 0)  # the solver's stop, but for rounding


def make_stepper(
    network: Network | None,
    config: SimConfig,
    iterations: Int[Array, ""] | int | None = None,
    tolerance: Float[Array, ""] | None = None,
) -> Stepper:
    """Return the stepper of a network, a configuration, or both.

    Args:
        network: A network, or None.
        config: Iterations and tolerance; static.
        iterations: Bound of iterations per frame in place of the configuration's. It may be traced, so that all
            numbers share a program.
        tolerance: In place of the configuration's, likewise.
    """

    def step(problem: FrameProblem, state: ClothState) -> tuple[ClothState, FrameReport]:
        if config.iterations or iterations is not None:
            # A minimum does not depend on where the solver began, and neither do its derivatives.
            start, status = find_start(*jax.lax.stop_gradient((network, problem, state)))
            minimum, data = solve_frame(
                problem,
                start,
                iterations=config.iterations if iterations is None else iterations,
                tolerance=config.tolerance if tolerance is None else tolerance,
                memory=config.memory,
            )
        else:
            if network is not None and state.past is not None:
                raise ConfigError(
                    'a network alone steps by implicit Euler; choose integrator "euler", or solver '
                    "iterations after the network"
                )
            point, _, status = _begin(network, problem, state)
            unknown = jnp.full_like(point.value, jnp.inf)
            position, data = corrected(point.position, problem)
            minimum = Minimum(position, *point[1:], iterations=jnp.int32(0), gap_bound=unknown)
        # Pins may have yielded, and have a derivative all the same.
        pinned, ended = pin(problem, minimum.position), problem.replace(data=data)
        position = pinned + jax.lax.stop_gradient(minimum.position - pinned)
        residual = safe_norm(minimum.gradient.reshape(-1)) / weight_norm(problem)
        report = FrameReport(
            energies=potential_terms(position, problem),
            residual=residual,
            iterations=minimum.iterations,
            gap_bound=minimum.gap_bound,
            demands=buffer_demands(ended),
            is_passed=any_passed(ended),
        )
        status = status | minimum.status | terms_status(ended)
        return next_state(position, problem, state, status, residual), report

    return step


def find_start(
    network: Network | None, problem: FrameProblem, state: ClothState
) -> tuple[Start, Int[Array, ""]]:
    """Return where the solver begins a frame, and status bits.

    Without a network this is the initial guess. With a network it is the prediction, or the lowest point from
    which one of its refinement steps began, if that is lower.

    Args:
        network: A network, or None.
        problem: The frame's problem.
        state: Cloth at t.
    """
    point, prediction, status = _begin(network, problem, state)
    guess = prediction.guess
    if guess is None:
        # The solver begins elsewhere, but measures its share of the gap from the energy of the inertial guess.
        guess = initial_guess(problem)
    return Start(point.position, guess.inertial_energy, prediction.previous), status


def _begin(
    network: Network | None, problem: FrameProblem, state: ClothState
) -> tuple[Point, Prediction, Int[Array, ""]]:
    """Return the point of `find_start`, what it comes from, and status bits."""
    if network is None:
        guess = initial_guess(problem)
        return evaluate(guess.position, problem), Prediction(guess.position, guess), jnp.int32(Status.OK)
    prediction = network.predict(problem, state)
    point = evaluate(prediction.position, problem)
    if prediction.previous is not None:
        point = lower_point(point, prediction.previous)
    # A solver that starts elsewhere would hide a prediction that is not a number.
    return point, prediction, _finiteness(prediction.position)


def _finiteness(values: Float[Array, ...]) -> Int[Array, ""]:
    """Return the status bits of numbers of any shape."""
    return jnp.where(jnp.all(jnp.isfinite(values)), int(Status.OK), int(Status.NON_FINITE))


def next_state(
    position: Float[Array, "vertices 3"],
    problem: FrameProblem,
    state: ClothState,
    status: Int[Array, ""],
    residual: Float[Array, ""] | float = 0.0,
) -> ClothState:
    """Return the state at t + 1, with the velocity that brought the cloth there.

    Args:
        position: Positions at t + 1 [m], shape [vertices, 3].
        problem: The frame's problem, whose data have derivatives.
        state: Cloth at t.
        status: Bits that the frame has raised so far.
        residual: Force norm over weight that the frame ended with.
    """
    # A network moves padding too; with its speed carried on it would come to look like thrown cloth.
    position = jnp.where(problem.garment.vertex_mask[:, None], position, problem.position)
    # A gradient that is not finite stops the solver where it began, at positions that are.
    status = state.status | status | terms_status(problem)
    status = status | _finiteness(position) | _finiteness(jnp.asarray(residual))
    frame = state.frame + 1
    return ClothState(
        position=position,
        velocity=(position - problem.origin) / problem.inertial_timestep,
        friction_load=contact_load(position, problem),
        frame=frame,
        status=status,
        first_bad_frame=jnp.where((state.status == 0) & (status != 0), frame, state.first_bad_frame),
        past=None if state.past is None else past_state(state, problem.timestep, residual),
    )


def terms_status(problem: FrameProblem) -> Int[Array, ""]:
    """Return the status bits of a frame's terms, such as too small a buffer or too fast a body."""
    bits = (term.status(problem, data) for term, data in problem.parts)
    return functools.reduce(jnp.bitwise_or, bits, jnp.int32(Status.OK))


def past_state(
    before: ClothState, timestep: Float[Array, ...], residual: Float[Array, ...] | float
) -> PastState:
    """Return what BDF2 remembers of the state before a frame, and whether it may be trusted.

    A frame that ends far from its minimum leaves an error, which BDF2 would carry on and amplify: a garment
    with a residual of 40 weights after 20 iterations flew apart. So the next frame is stepped by implicit Euler.

    Args:
        before: Cloth at the beginning of the frame.
        timestep: Length of the frame [s].
        residual: Force norm over weight that the frame ended with.
    """
    is_known = jnp.asarray(residual) <= _MOST_CARRIED
    return PastState(before.position, before.velocity, timestep, is_known)


def buffer_demands(problem: FrameProblem) -> dict[str, Int[Array, ""]]:
    """Return how many rows the terms of a frame ask their buffers for, by their names."""
    demands = {term.name: term.demand(data) for term, data in problem.parts}
    return {name: count for name, count in demands.items() if count is not None}
