"""Limited-memory BFGS, entirely inside jit, on the potential of one frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.physics.potential import Point
from eslr_jax.physics.preconditioner import Stiffness, solve_stiffness

_ARMIJO = 1e-4  # sufficient decrease (Nocedal and Wright 2006, section 3.1)
_MAX_HALVINGS = 10
_CAUTION = 400.0  # soft directions are underestimated: 99 % of frames keep what is asked, 83 % at 40


class Minimum(NamedTuple):
    """Where a minimisation stopped."""

    position: Float[Array, "vertices 3"]
    value: Float[Array, ""]  # [J]
    gradient: Float[Array, "vertices 3"]  # [N]
    iterations: Int[Array, ""]


class Stop(NamedTuple):
    """When a minimisation ends."""

    iterations: int | Int[Array, ""]  # upper bound
    # Share of what was gained since `reference`, below which the gap may fall. It is estimated by half the Newton
    # decrement, g . H^-1 g / 2, with the recursion's own H^-1, times `_CAUTION`.
    tolerance: Float[Array, ""] | float = 0.0
    reference: Float[Array, ""] | float = 0.0  # energy [J] from which the gain counts


class _State(NamedTuple):
    x: Float[Array, " n"]
    value: Float[Array, ""]
    gradient: Float[Array, " n"]
    steps: Float[Array, "memory n"]  # s_k, a ring whose newest row is `head`
    changes: Float[Array, "memory n"]  # y_k
    curvatures: Float[Array, " memory"]  # 1 / (s_k . y_k); zero marks an empty row
    head: Int[Array, ""]
    scale: Float[Array, ""]
    decrement: Float[Array, ""]  # gap [J] that the last point was estimated to have
    iterations: Int[Array, ""]
    is_stuck: Bool[Array, ""]  # not even the preconditioned gradient leads down


Inverse = Callable[[Float[Array, " n"]], Float[Array, " n"]]


def _direction(state: _State, inverse: Inverse) -> Float[Array, " n"]:
    """Return minus the inverse-Hessian estimate times the gradient, by the two-loop recursion."""
    memory = state.steps.shape[0]
    rows = [(state.head - age) % memory for age in range(memory)]
    q = state.gradient
    weights = []
    for row in rows:
        weight = state.curvatures[row] * jnp.dot(state.steps[row], q)
        q = q - weight * state.changes[row]
        weights.append(weight)
    q = state.scale * inverse(q)
    for row, weight in zip(reversed(rows), reversed(weights), strict=True):
        q = q + state.steps[row] * (weight - state.curvatures[row] * jnp.dot(state.changes[row], q))
    return -q


def minimize(
    function: Callable[[Float[Array, "vertices 3"]], Float[Array, ""]],
    start: Point,
    stiffness: Stiffness,
    stop: Stop,
    *,
    memory: int = 8,
    previous: Point | None = None,
) -> Minimum:
    """Minimise `function` from `start` by L-BFGS.

    Args:
        function: Differentiable energy [J] of positions [m], shape [vertices, 3].
        start: Where to begin, with value and gradient.
        stiffness: Initial Hessian of the recursion, up to a scale.
        stop: When to end.
        memory: Number of pairs of steps and gradient changes kept; static.
        previous: A point from which something else came to `start`; the step between is the first pair.

    Returns:
        The lowest point that was reached, and the iterations it took.

    Source: Nocedal and Wright 2006, algorithm 7.4, with backtracking from the unit step.
    """
    shape = start.position.shape

    def inverse(force: Float[Array, " n"]) -> Float[Array, " n"]:
        return solve_stiffness(stiffness, force.reshape(shape)).reshape(-1)

    value_and_gradient = jax.value_and_grad(lambda x: function(x.reshape(shape)))

    def is_running(state: _State) -> Array:
        is_above = jnp.dot(state.gradient, state.gradient) > 0
        is_far = _CAUTION * state.decrement > stop.tolerance * (stop.reference - state.value)
        return (state.iterations < stop.iterations) & is_above & is_far & ~state.is_stuck

    def iterate(state: _State) -> _State:
        direction = _direction(state, inverse)
        slope = jnp.dot(direction, state.gradient)
        x, value, gradient, is_lower = _backtrack(value_and_gradient, state, direction, slope)
        # Where no step along the direction leads down, the history is dropped and tried without.
        curvatures = jnp.where(is_lower, state.curvatures, 0.0)
        moved = _advance(state._replace(curvatures=curvatures), Point(x, value, gradient), inverse)
        return moved._replace(
            decrement=-0.5 * slope,
            iterations=state.iterations + 1,
            is_stuck=~is_lower & jnp.all(state.curvatures == 0),
        )

    first = _ravel(start)
    x = first.position
    history = jnp.zeros((memory, x.size), x.dtype)
    initial = _State(
        x=x,
        value=first.value,
        gradient=first.gradient,
        steps=history,
        changes=history,
        curvatures=jnp.zeros(memory, x.dtype),
        head=jnp.zeros((), jnp.int32),
        scale=jnp.ones((), x.dtype),
        decrement=jnp.full((), jnp.inf, x.dtype),
        iterations=jnp.zeros((), jnp.int32),
        is_stuck=jnp.zeros((), bool),
    )
    if previous is not None:
        before = _ravel(previous)
        initial = _advance(initial._replace(x=before.position, gradient=before.gradient), first, inverse)
    final = jax.lax.while_loop(is_running, iterate, initial)
    return Minimum(final.x.reshape(shape), final.value, final.gradient.reshape(shape), final.iterations)


def _ravel(point: Point) -> Point:
    """Return a point whose position and gradient have one axis."""
    return Point(point.position.reshape(-1), point.value, point.gradient.reshape(-1))


def _advance(state: _State, point: Point, inverse: Inverse) -> _State:
    """Move to a point, and add the way there to the history, if it says anything about curvature."""
    x, value, gradient = point
    step, change = x - state.x, gradient - state.gradient
    curvature = jnp.dot(step, change)
    is_useful = curvature > 1e-10 * jnp.sqrt(jnp.dot(step, step) * jnp.dot(change, change))
    inverse_curvature = jnp.where(is_useful, 1.0 / jnp.where(is_useful, curvature, 1.0), 0.0)
    weighted = jnp.dot(change, inverse(change))
    head = (state.head + 1) % state.steps.shape[0]
    return state._replace(
        x=x,
        value=value,
        gradient=gradient,
        steps=state.steps.at[head].set(step),
        changes=state.changes.at[head].set(change),
        curvatures=state.curvatures.at[head].set(inverse_curvature),
        head=head,
        scale=jnp.where(is_useful, curvature / jnp.where(weighted > 0, weighted, 1.0), state.scale),
    )


def _backtrack(value_and_gradient: Callable, state: _State, direction: Array, slope: Array):
    """Halve the step until the energy falls enough; keep the old point if it never does.

    Returns:
        The point, its value and its gradient, and whether it is another point than before.
    """
    slack = 4 * jnp.finfo(state.x.dtype).eps * jnp.abs(state.value)

    def is_wanting(carry):
        size, trials, _, value, _ = carry
        is_good = value <= state.value + _ARMIJO * size * slope + slack
        return (trials == 0) | (~is_good & (trials <= _MAX_HALVINGS))

    def trial(carry):
        size, trials, *_ = carry
        size = jnp.where(trials == 0, 1.0, 0.5 * size)
        x = state.x + size * direction
        return (size, trials + 1, x, *value_and_gradient(x))

    # The first trial is one of the loop's, so that the energy is compiled once.
    untried = (jnp.zeros((), state.x.dtype), jnp.int32(0), state.x, state.value, state.gradient)
    *_, x, value, gradient = jax.lax.while_loop(is_wanting, trial, untried)
    is_kept = (value <= state.value + slack) & (slope < 0)
    return (
        jnp.where(is_kept, x, state.x),
        jnp.where(is_kept, value, state.value),
        jnp.where(is_kept, gradient, state.gradient),
        is_kept,
    )
