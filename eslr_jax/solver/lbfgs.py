"""Limited-memory BFGS, entirely inside jit, on the potential of one frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import product
from eslr_jax.solver.potential import Point
from eslr_jax.solver.preconditioner import Stiffness, stiffness_inverse

_ARMIJO = 1e-4  # sufficient decrease (Nocedal and Wright 2006, section 3.1)
_MAX_HALVINGS = 10
# With 2, 98.8 % of 342 frames kept 1 % (experiments/speed.md); 2.5 takes 43 instead of 40 iterations.
_CAUTION = 2.5  # the gap's share of the gain is taken as sqrt(_CAUTION * d), see `Stop.tolerance`


class Minimum(NamedTuple):
    """Where a minimisation stopped."""

    position: Float[Array, "vertices 3"]
    value: Float[Array, ""]  # [J]
    gradient: Float[Array, "vertices 3"]  # [N]
    iterations: Int[Array, ""]
    gap_bound: Float[Array, ""]  # share of the initial gap that is left at most, see `Stop.tolerance`
    status: Int[Array, ""] | int = 0  # errors.Status bits


class Stop(NamedTuple):
    """When a minimisation ends."""

    iterations: int | Int[Array, ""]  # upper bound
    # Stop where the estimated gap is below this share of the gain, the fall of the energy from `reference`. Half
    # the Newton decrement, g . H^-1 g / 2 with the recursion's own H^-1, misses soft directions, and more of them
    # near the minimum. Where it is a share d of the gain, the gap is a share of at most sqrt(2.5 d) in 99 % of
    # the frames (`_CAUTION`; experiments/speed.md).
    tolerance: Float[Array, ""] | float = 0.0
    reference: Float[Array, ""] | float = 0.0  # energy [J] from which the gain counts
    force: Float[Array, ""] | float = 0.0  # norm of the gradient [N] at which to stop
    # Norm of the gradient [N] above which the share is not enough: of a start that strains cloth to pieces, one
    # in a hundred tears it still.
    most_force: Float[Array, ""] | float = jnp.inf


class _State(NamedTuple):
    point: Point  # of flat positions, as all vectors here
    smoothed: Float[Array, " n"]  # P g, with the preconditioner P
    pairs: Float[Array, "rows n"]  # steps s_k, then P y_k; two rings whose newest row is `head`
    by_gradient: Float[Array, " rows"]  # products of the pairs' rows with the gradient
    by_change: Float[Array, "rows memory"]  # the same with the gradient changes y_k
    is_kept: Bool[Array, " memory"]  # rows in use
    head: Int[Array, ""]
    scale: Float[Array, ""]
    decrement: Float[Array, ""]  # gap [J] that the last point was estimated to have
    iterations: Int[Array, ""]  # -1 before the start is evaluated
    is_stuck: Bool[Array, ""]  # not even the preconditioned gradient leads down


Inverse = Callable[[Float[Array, " n"]], Float[Array, " n"]]


def _direction(state: _State) -> Float[Array, " n"]:
    """Return minus the inverse-Hessian estimate times the gradient, in its compact form.

    With S and Y the kept steps and changes in columns, R the upper triangle of S'Y, D its diagonal and P times
    a scale c as the first estimate:
    H g = c P g + S R^-T ((D + c Y'PY) R^-1 S'g - c Y'P g) - c PY R^-1 S'g.

    It equals the two-loop recursion, but reads the pairs half as often, and applies P to the gradient alone.

    Source: Byrd, Nocedal and Schnabel 1994, doi 10.1007/BF01582063, theorem 2.2.
    """
    memory = state.is_kept.shape[0]
    order = (state.head + 1 + jnp.arange(memory, dtype=state.head.dtype)) % memory  # oldest first
    is_kept = state.is_kept[order]
    both = is_kept[:, None] & is_kept[None, :]
    of_step, of_change = state.by_gradient[order], state.by_gradient[memory + order]
    step_change = jnp.where(both, state.by_change[:memory][order][:, order], 0.0)
    change_change = jnp.where(both, state.by_change[memory:][order][:, order], 0.0)
    curvatures = jnp.diag(step_change)
    upper = jnp.triu(step_change) + jnp.diag(jnp.where(is_kept, 0.0, 1.0))  # an empty row solves to nothing
    back = solve_triangular(upper, jnp.where(is_kept, of_step, 0.0))
    right = curvatures * back + state.scale * (
        product(change_change, back) - jnp.where(is_kept, of_change, 0.0)
    )
    forth = solve_triangular(upper, right, trans="T")
    weights = jnp.zeros_like(state.by_gradient).at[order].set(forth)
    weights = weights.at[memory + order].set(-state.scale * back)
    return -(state.scale * state.smoothed + product(weights, state.pairs))


def minimize(
    function: Callable[[Float[Array, "vertices 3"]], Float[Array, ""]],
    start: Float[Array, "vertices 3"],
    stiffness: Stiffness,
    stop: Stop,
    *,
    memory: int = 8,
    previous: Point | None = None,
) -> Minimum:
    """Minimise `function`, an energy [J] of positions [m], shape [vertices, 3], from `start` [m] by L-BFGS.

    The first pass of the loop evaluates the start, and does not count as an iteration. So the energy, which is
    most of a frame's program, is compiled only once.

    Args:
        function: Differentiable energy.
        start: Where to begin.
        stiffness: Initial Hessian of the recursion, up to a scale.
        stop: When to end.
        memory: Number of pairs of steps and gradient changes kept; static.
        previous: A point from which something else came to `start`; the step between is the first pair.

    Source: Nocedal and Wright 2006, algorithm 7.4, with backtracking from the unit step.
    """
    balance = stiffness_inverse(stiffness)

    def inverse(force: Float[Array, " n"]) -> Float[Array, " n"]:
        return _flat(balance(_vectors(force)))

    def at(x: Float[Array, " n"]) -> Point:
        split = tuple(jax.lax.split(x, (x.size // 3,) * 3))
        value, parts = jax.value_and_grad(lambda parts: function(jnp.stack(parts, axis=1)))(split)
        # Written over x one by one: joined at once, XLA computes them in a loop that it can't vectorise.
        gradient = x
        for axis, part in enumerate(parts):
            gradient = jax.lax.dynamic_update_slice(gradient, part, (axis * part.size,))
        return Point(x, value, gradient)

    def is_at_rest(state: _State) -> Array:
        # Cloth that does not move gains less than the rounding of its energy, with either sign.
        value = state.point.value
        most = jnp.maximum(jnp.abs(stop.reference - value), _CAUTION * state.decrement)
        return jnp.isfinite(value) & (most <= _rounding(value))

    def is_running(state: _State) -> Array:
        _, value, gradient = state.point
        is_above = product(gradient, gradient) > jnp.square(stop.force)
        is_far = _CAUTION * state.decrement > stop.tolerance**2 * (stop.reference - value)
        is_far = is_far | (product(gradient, gradient) > jnp.square(stop.most_force))
        is_far = is_far & ~((stop.tolerance > 0) & is_at_rest(state))
        is_going = (state.iterations < stop.iterations) & is_above & is_far & ~state.is_stuck
        return is_going | (state.iterations < 0)

    def iterate(state: _State) -> _State:
        is_first = state.iterations < 0
        direction = jnp.where(is_first, _flat(start) - state.point.position, _direction(state))
        slope = product(direction, state.point.gradient)
        point, is_lower = _backtrack(at, state, direction, slope)
        # If no step along the direction lowers the energy, the next iteration goes without the history. The
        # decrement of a direction that rounding has turned uphill tells nothing about the gap.
        kept = state._replace(is_kept=state.is_kept & is_lower)
        return _advance(kept, point, inverse)._replace(
            decrement=jnp.where(is_first | (slope >= 0), jnp.inf, -0.5 * slope),
            iterations=state.iterations + 1,
            is_stuck=~is_lower & ~jnp.any(state.is_kept),
        )

    before = unknown_point(start) if previous is None else previous
    x, gradient = _flat(before.position), _flat(before.gradient)
    initial = _State(
        point=Point(x, jnp.full((), jnp.inf, x.dtype), gradient),
        smoothed=gradient if previous is None else inverse(gradient),  # of zero it is zero
        pairs=jnp.zeros((2 * memory, x.size), x.dtype),
        by_gradient=jnp.zeros(2 * memory, x.dtype),
        by_change=jnp.zeros((2 * memory, memory), x.dtype),
        is_kept=jnp.zeros(memory, bool),
        head=jnp.zeros((), jnp.int32),
        scale=jnp.ones((), x.dtype),
        decrement=jnp.full((), jnp.inf, x.dtype),
        iterations=jnp.full((), -1, jnp.int32),
        is_stuck=jnp.zeros((), bool),
    )
    final = jax.lax.while_loop(is_running, iterate, initial)
    gain = stop.reference - final.point.value
    share = _CAUTION * final.decrement / jnp.where(gain > 0, gain, 1.0)
    gap_bound = jnp.where(gain > 0, jnp.sqrt(share), jnp.inf)
    gap_bound = jnp.where(is_at_rest(final), 0.0, gap_bound)
    position, gradient = _vectors(final.point.position), _vectors(final.point.gradient)
    return Minimum(position, final.point.value, gradient, final.iterations, gap_bound, jnp.int32(0))


def unknown_point(position: Float[Array, "vertices 3"]) -> Point:
    """Return positions [m], shape [vertices, 3], as a point at which nothing is known.

    As the previous point of its own position it adds nothing to the history: the step has no length.
    """
    return Point(position, jnp.full((), jnp.inf, position.dtype), jnp.zeros_like(position))


def _rounding(value: Float[Array, ""]) -> Float[Array, ""]:
    """Return by how much an energy may differ from itself, computed in another order [J]."""
    return 4 * jnp.finfo(value.dtype).eps * jnp.abs(value)


def _flat(vectors: Float[Array, "vertices 3"]) -> Float[Array, " n"]:
    """Return vectors with one axis: all x, all y, all z."""
    return vectors.T.reshape(-1)


def _vectors(flat: Float[Array, " n"]) -> Float[Array, "vertices 3"]:
    """Return flat vectors in rows."""
    return flat.reshape(3, -1).T


def _advance(state: _State, point: Point, inverse: Inverse) -> _State:
    """Move to a point, and add the way there to the history, if it says anything about curvature."""
    step, change = point.position - state.point.position, point.gradient - state.point.gradient
    # P g is summed up: as a difference of two P g, P y holds ten times the rounding.
    smoothed_change = inverse(change)
    smoothed = state.smoothed + smoothed_change
    curvature = product(step, change)
    is_useful = curvature > 1e-10 * jnp.sqrt(product(step, step) * product(change, change))
    memory = state.is_kept.shape[0]
    head = (state.head + 1) % memory
    pairs = state.pairs.at[head].set(step).at[memory + head].set(smoothed_change)
    products = product(pairs, change)
    by_change = state.by_change.at[:, head].set(products)
    by_change = by_change.at[memory + head].set(products[memory:])  # Y'PY is symmetric
    weighted = products[memory + head]
    return state._replace(
        point=point,
        smoothed=smoothed,
        pairs=pairs,
        by_gradient=product(pairs, point.gradient),
        by_change=by_change,
        is_kept=state.is_kept.at[head].set(is_useful),
        head=head,
        scale=jnp.where(is_useful, curvature / jnp.where(weighted > 0, weighted, 1.0), state.scale),
    )


def _backtrack(
    at: Callable[[Float[Array, " n"]], Point], state: _State, direction: Array, slope: Array
) -> tuple[Point, Bool[Array, ""]]:
    """Halve the step until the energy falls enough; return the point and whether it is another one.

    The first pass of `minimize` goes to the start, whatever its energy.
    """
    is_first = state.iterations < 0
    before = state.point
    slack = _rounding(before.value)

    def is_wanting(carry):
        size, trials, point = carry
        is_good = (point.value <= before.value + _ARMIJO * size * slope + slack) | is_first
        return (trials == 0) | (~is_good & (trials <= _MAX_HALVINGS))

    def trial(carry):
        size, trials, _ = carry
        size = jnp.where(trials == 0, 1.0, 0.5 * size)
        return size, trials + 1, at(before.position + size * direction)

    # The first trial is one of the loop's, so that the energy is compiled once.
    untried = (jnp.zeros_like(before.value), jnp.int32(0), before)
    *_, point = jax.lax.while_loop(is_wanting, trial, untried)
    is_kept = ((point.value <= before.value + slack) & (slope < 0)) | is_first
    return jax.tree.map(lambda new, old: jnp.where(is_kept, new, old), point, before), is_kept
