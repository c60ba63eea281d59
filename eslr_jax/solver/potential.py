"""The incremental potential: the sum of the energies whose minimum is one step of the integrator."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from eslr_jax.numerics import components
from eslr_jax.terms.term import FrameProblem, pin


class Point(NamedTuple):
    """Positions with the potential and its gradient there, so that neither is computed twice."""

    position: Float[Array, "*shape"]  # [m]
    value: Float[Array, ""]  # [J]
    gradient: Float[Array, "*shape"]  # [N]


@jax.jit  # so that it is traced once, where a step evaluates it four times
def potential_terms(
    position: Float[Array, "vertices 3"], problem: FrameProblem
) -> dict[str, Float[Array, ""]]:
    """Return every energy of the frame [J], by the names of its terms, at positions at t + 1 [m].

    Pinned vertices are put in place first, so that the gradient vanishes there.
    """
    x = components(pin(problem, position))  # once: gradients of all terms are then summed by components
    energies: dict[str, Array] = {}
    for term, data in problem.parts:
        energy = term.energy(x, problem, data)
        energies[term.name] = energies[term.name] + energy if term.name in energies else energy
    return energies


def potential(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, ""]:
    """Return the incremental potential [J]: the sum of all terms at positions [m], shape [vertices, 3]."""
    return sum(potential_terms(position, problem).values(), jnp.zeros((), position.dtype))


def evaluate(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Point:
    """Return positions [m], shape [vertices, 3], with the frame's potential and its gradient there."""
    return Point(position, *jax.value_and_grad(potential)(position, problem))


def contact_load(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, " vertices"]:
    """Return the normal force on every vertex [N], at positions at t + 1 [m], for the next frame's friction."""
    loads = (term.load(position, problem, data) for term, data in problem.parts)
    return sum(loads, jnp.zeros(position.shape[0], position.dtype))


def corrected(
    position: Float[Array, "vertices 3"], problem: FrameProblem
) -> tuple[Float[Array, "vertices 3"], tuple[Any, ...]]:
    """Return positions at t + 1 [m] as the terms let the frame end, and the terms' data with what came of it."""
    position, ended = pin(problem, position), []
    for term, data in problem.parts:
        position, data = term.correct(position, problem, data)
        ended.append(data)
    return position, tuple(ended)


def any_passed(problem: FrameProblem) -> Bool[Array, ""] | None:
    """Return whether something may have passed through the cloth; None where no term watches that."""
    found = [term.is_passed(data) for term, data in problem.parts]
    watched = [one for one in found if one is not None]
    return functools.reduce(jnp.logical_or, watched) if watched else None
