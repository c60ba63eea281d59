"""One frame, solved: from a starting point to the minimum of its potential."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.physics.guess import InitialGuess
from eslr_jax.physics.lbfgs import Minimum, Stop, minimize
from eslr_jax.physics.potential import Point, evaluate, potential
from eslr_jax.physics.preconditioner import stiffness
from eslr_jax.physics.problem import FrameProblem


class Start(NamedTuple):
    """Where the solver begins a frame."""

    point: Point
    inertial_energy: Float[Array, ""]  # [J], see `InitialGuess`
    previous: Point | None = None  # from which a network came to `point`; None for the solver's own guess


def start_from_guess(problem: FrameProblem, guess: InitialGuess) -> Start:
    """Return the solver's own guess as a start, with its potential and gradient."""
    return Start(evaluate(guess.position, problem), guess.inertial_energy)


def lower_point(reached: Point, previous: Point) -> Point:
    """Return the lower of two points; the previous one where they are level, the other where one is NaN."""
    is_lower = (reached.value < previous.value) | jnp.isnan(previous.value)
    return jax.tree.map(lambda new, old: jnp.where(is_lower, new, old), reached, previous)


def solve(
    problem: FrameProblem,
    start: Start,
    *,
    iterations: int | Int[Array, ""],
    tolerance: float = 0.0,
    memory: int = 8,
) -> Minimum:
    """Minimise the frame's potential by L-BFGS.

    Args:
        problem: The frame's problem.
        start: Where to begin.
        iterations: Upper bound of iterations; may be traced.
        tolerance: Share of the initial gap that may be left, see `SimConfig.tolerance`.
        memory: Number of pairs that L-BFGS keeps; static.
    """
    return minimize(
        lambda position: potential(position, problem),
        start.point,
        stiffness(problem, start.point.position),
        Stop(iterations, tolerance, start.inertial_energy),
        memory=memory,
        previous=start.previous,
    )
