"""Limited-memory BFGS, entirely inside jit, on the potential of one frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_ARMIJO = 1e-4  # sufficient decrease (Nocedal and Wright 2006, section 3.1)
_MAX_HALVINGS = 10


class Minimum(NamedTuple):
    """Where a minimisation stopped."""

    position: Float[Array, "vertices 3"]
    value: Float[Array, ""]  # [J]
    gradient: Float[Array, "vertices 3"]  # [N]
    iterations: Int[Array, ""]


class _State(NamedTuple):
    x: Float[Array, " n"]
    value: Float[Array, ""]
    gradient: Float[Array, " n"]
    steps: Float[Array, "memory n"]  # s_k, newest in slot `head`
    changes: Float[Array, "memory n"]  # y_k
    curvatures: Float[Array, " memory"]  # 1 / (s_k . y_k); zero marks an empty slot
    scale: Float[Array, ""]
    iterations: Int[Array, ""]


def _direction(state: _State, inverse_diagonal: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return minus the inverse-Hessian estimate times the gradient, by the two-loop recursion."""
    memory = state.steps.shape[0]
    q = state.gradient
    weights = []
    for k in range(memory):
        weight = state.curvatures[k] * jnp.dot(state.steps[k], q)
        q = q - weight * state.changes[k]
        weights.append(weight)
    q = state.scale * inverse_diagonal * q
    for k in reversed(range(memory)):
        q = q + state.steps[k] * (weights[k] - state.curvatures[k] * jnp.dot(state.changes[k], q))
    return -q


def minimize(
    function: Callable[[Float[Array, "vertices 3"]], Float[Array, ""]],
    start: Float[Array, "vertices 3"],
    diagonal: Float[Array, " vertices"],
    *,
    iterations: int,
    memory: int = 8,
    residual_tolerance: Float[Array, ""] | float = 0.0,
) -> Minimum:
    """Minimise `function` from `start`.

    Args:
        function: Energy [J] of positions; differentiable.
        start: Initial positions [m].
        diagonal: Positive stiffness per vertex [N/m]; the initial Hessian of the recursion up to a scale.
        iterations: Upper bound of iterations; static.
        memory: Pairs of steps and gradient changes kept; static.
        residual_tolerance: Stop when the gradient norm [N] falls below it.

    Source: Nocedal and Wright 2006, algorithm 7.4, with backtracking from the unit step.
    """
    shape = start.shape
    inverse_diagonal = jnp.repeat(1.0 / diagonal, shape[1]).astype(start.dtype)
    value_and_gradient = jax.value_and_grad(lambda x: function(x.reshape(shape)))

    def is_running(state: _State) -> Array:
        is_above = jnp.dot(state.gradient, state.gradient) > jnp.square(residual_tolerance)
        return (state.iterations < iterations) & is_above

    def iterate(state: _State) -> _State:
        direction = _direction(state, inverse_diagonal)
        slope = jnp.dot(direction, state.gradient)
        is_ascent = ~(slope < 0)
        direction = jnp.where(is_ascent, -inverse_diagonal * state.gradient, direction)
        slope = jnp.where(is_ascent, jnp.dot(direction, state.gradient), slope)
        x, value, gradient = _backtrack(value_and_gradient, state, direction, slope)

        step, change = x - state.x, gradient - state.gradient
        curvature = jnp.dot(step, change)
        is_useful = curvature > 1e-10 * jnp.sqrt(jnp.dot(step, step) * jnp.dot(change, change))
        inverse_curvature = 1.0 / jnp.where(is_useful, curvature, 1.0)
        weighted = jnp.dot(change, inverse_diagonal * change)

        def shifted(history: Array, newest: Array) -> Array:
            return jnp.where(is_useful, jnp.concatenate([newest[None], history[:-1]]), history)

        return _State(
            x=x,
            value=value,
            gradient=gradient,
            steps=shifted(state.steps, step),
            changes=shifted(state.changes, change),
            curvatures=shifted(state.curvatures, inverse_curvature),
            scale=jnp.where(is_useful, curvature / jnp.where(weighted > 0, weighted, 1.0), state.scale),
            iterations=state.iterations + 1,
        )

    x = start.reshape(-1)
    value, gradient = value_and_gradient(x)
    history = jnp.zeros((memory, x.size), x.dtype)
    initial = _State(
        x=x,
        value=value,
        gradient=gradient,
        steps=history,
        changes=history,
        curvatures=jnp.zeros(memory, x.dtype),
        scale=jnp.ones((), x.dtype),
        iterations=jnp.zeros((), jnp.int32),
    )
    final = jax.lax.while_loop(is_running, iterate, initial)
    return Minimum(final.x.reshape(shape), final.value, final.gradient.reshape(shape), final.iterations)


def _backtrack(value_and_gradient: Callable, state: _State, direction: Array, slope: Array):
    """Halve the step until the energy falls enough; keep the old point if it never does."""
    slack = 4 * jnp.finfo(state.x.dtype).eps * jnp.abs(state.value)

    def trial(size):
        x = state.x + size * direction
        return (x, *value_and_gradient(x))

    def is_rejected(carry):
        size, halvings, _, value, _ = carry
        is_good = value <= state.value + _ARMIJO * size * slope + slack
        return ~is_good & (halvings < _MAX_HALVINGS)

    def halve(carry):
        size, halvings, *_ = carry
        return (0.5 * size, halvings + 1, *trial(0.5 * size))

    one = jnp.ones((), state.x.dtype)
    _, _, x, value, gradient = jax.lax.while_loop(
        is_rejected, halve, (one, jnp.zeros((), jnp.int32), *trial(one))
    )
    is_kept = value <= state.value + slack
    return (
        jnp.where(is_kept, x, state.x),
        jnp.where(is_kept, value, state.value),
        jnp.where(is_kept, gradient, state.gradient),
    )
