"""One frame, solved: from a starting point to the minimum of its potential, and how the minimum moves.

The minimum x* of the potential P(x, theta) is a function of everything the problem holds. Differentiating
grad P(x*, theta) = 0 gives dx*/dtheta = -H^-1 d(grad P)/dtheta with the Hessian H = d^2 P / dx^2. So a derivative
costs one linear solve, however many iterations the solver took, and does not depend on the starting point. It is
exact at the minimum. If the solver stops early, its error is of the order of the remaining gradient.

Source: Griewank and Walther 2008, Evaluating Derivatives, section 15 (implicit functions).
"""

from __future__ import annotations

import functools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import zero_from_primal
from jaxtyping import Array, Float, Int

from eslr_jax.errors import ConfigError, Status
from eslr_jax.numerics import safe_norm
from eslr_jax.solver import tangent
from eslr_jax.solver.guess import Start
from eslr_jax.solver.lbfgs import Minimum, Stop, minimize, unknown_point
from eslr_jax.solver.potential import Point, any_passed, corrected, potential
from eslr_jax.solver.preconditioner import hessian_diagonal, stretched_stiffness
from eslr_jax.solver.tangent import LinearSolution, solve_symmetric
from eslr_jax.terms.term import FrameProblem, weight_norm

SOLUTION = "solution"  # what checkpointing keeps of a frame, so that it is not solved twice
_MOST_ITERATIONS = 2000  # of a frame that is differentiated
# [weights] Force above which a frame has no derivative. With 0.2 the derivative of a T-shirt's height by its
# density is off by 2 %, with 1 by 20 %.
_REFUSED = 0.1
# Residual of the linear system to reach, relative to its right side, and the most iterations. In float32 1e-4
# puts a T-shirt's gradient through five frames off by 0.7 %, 1e-3 by 3 % (experiments/inverse/accuracy.py).
_LINEAR_STOP = {"float32": (1e-4, 500), "float64": (1e-9, 3000)}
_LINEAR_STALL = 1e-2  # residual above which the derivative is refused
# Of a frame that is solved and corrected, at most. Two or three do; a sheet that crumples in steps of 0.1 s takes
# up to seven.
_PASSES = 8
# [weights] Force with which a frame is not yet solved, whatever its tolerance. Within 1 % of the optimum torn
# cloth leaves 3, a T-shirt 0.15.
_MOST_RESIDUAL = 5.0


def lower_point(reached: Point, previous: Point) -> Point:
    """Return the lower of two points; the previous one where they are level, the other where one is NaN."""
    is_lower = (reached.value < previous.value) | jnp.isnan(previous.value)
    return jax.tree.map(lambda new, old: jnp.where(is_lower, new, old), reached, previous)


class Solved(NamedTuple):
    """How a frame ends."""

    minimum: Minimum  # with positions as the terms corrected them
    data: tuple[Any, ...]  # of the terms, with what came of it; it has no derivative


def solve(
    problem: FrameProblem,
    start: Start,
    *,
    iterations: int | Int[Array, ""],
    tolerance: float | Float[Array, ""] = 0.0,
    memory: int = 8,
) -> Minimum:
    """Minimise the frame's potential by L-BFGS; differentiable by every real number in `problem`.

    Forward and reverse mode solve the frame on until it rests, whatever the tolerance, and then one linear system
    (see the module). Where the frame does not come to rest, its status says so, and the derivative is NaN rather
    than wrong. It is NaN too where the linear system stalls; `solve_hessian` tells why. `gradient`, `iterations`
    and `gap_bound` of the result have no derivative.

    Args:
        problem: The frame's problem.
        start: Where to begin; it has no influence on the minimum, and its derivative is zero.
        iterations: Upper bound of iterations; may be traced.
        tolerance: Share of the initial gap that may be left, see `SimConfig.tolerance`; may be traced. The
            minimum does not depend on it: its derivative is zero.
        memory: Number of pairs that L-BFGS keeps; static.

    Raises:
        ConfigError: The number of iterations is not an integer, as where somebody differentiates by it.
    """
    limits = {"iterations": iterations, "tolerance": tolerance, "memory": memory}
    return solve_frame(problem, start, **limits, is_corrected=False).minimum


def solve_frame(
    problem: FrameProblem,
    start: Start,
    *,
    iterations: int | Int[Array, ""],
    tolerance: float | Float[Array, ""] = 0.0,
    memory: int = 8,
    is_corrected: bool = True,
) -> Solved:
    """Solve a frame, and let its terms correct where it ends (`Term.correct`) if `is_corrected`, which is static.

    Where they move cloth far, the cloth around knows nothing of it. Then the frame is solved again from
    there, with their new data. The other arguments, errors and derivatives are those of `solve`; these take no
    notice of corrections.
    """
    iterations = jnp.asarray(iterations)
    if not jnp.issubdtype(iterations.dtype, jnp.integer):
        raise ConfigError(f"iterations are {iterations.dtype}; give a whole number, which has no derivative")
    limits = iterations, jnp.asarray(tolerance, start.inertial_energy.dtype)
    return _solve(problem, *jax.lax.stop_gradient((start, limits)), memory, is_corrected)


@partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _solve(
    problem: FrameProblem,
    start: Start,
    limits: tuple[Int[Array, ""], Float[Array, ""]],
    memory: int,
    is_corrected: bool,
) -> Solved:
    most_force = _MOST_RESIDUAL * weight_norm(problem)
    stop = Stop(*limits, start.inertial_energy, most_force=most_force)
    if not is_corrected:
        return Solved(_minimum(problem, start, stop, memory), problem.data)

    def is_passed(data: tuple[Any, ...]) -> Array:
        found = any_passed(problem.replace(data=data))
        return jnp.zeros((), bool) if found is None else found

    has_passed = is_passed(problem.data)  # by its start already: then no end is better

    def is_going(carry: tuple[Solved, Array]) -> Array:
        (_, data), count = carry
        far = (term.is_far(own) for term, own in zip(problem.terms, data, strict=True))
        return (count == 0) | ((count < _PASSES) & functools.reduce(jnp.logical_or, far, False))

    def once(carry: tuple[Solved, Array]) -> tuple[Solved, Array]:
        last, count = carry
        now = problem.replace(data=last.data)
        begin = start._replace(position=last.minimum.position)
        if start.previous is not None:  # a step of the first pass; no step of the others
            unknown = unknown_point(begin.position)
            known = jax.tree.map(lambda a, b: jnp.where(count == 0, a, b), start.previous, unknown)
            begin = begin._replace(previous=known)
        minimum = _minimum(now, begin, stop, memory)
        spent = last.minimum.iterations + minimum.iterations
        position, data = corrected(minimum.position, now)
        solved = Solved(minimum._replace(position=position, iterations=spent), data)
        # What can't be reached without letting something through is no end for a frame that has another one, and
        # once more does not help it.
        is_lost = (count > 0) & is_passed(data) & ~has_passed
        is_worse = is_lost & ~is_passed(last.data)
        kept = jax.tree.map(lambda old, new: jnp.where(is_worse, old, new), last, solved)
        return kept, jnp.where(is_lost, _PASSES, count + 1)

    nothing = jnp.zeros_like(start.position)
    unknown = jnp.zeros_like(start.inertial_energy)
    first = Minimum(start.position, unknown, nothing, jnp.int32(0), unknown, jnp.int32(0))
    data = jax.tree.map(jnp.asarray, problem.data)
    return jax.lax.while_loop(is_going, once, (Solved(first, data), jnp.int32(0)))[0]


def _minimum(problem: FrameProblem, start: Start, stop: Stop, memory: int) -> Minimum:
    return minimize(
        lambda position: potential(position, problem),
        start.position,
        stretched_stiffness(problem, start.position),
        stop,
        memory=memory,
        previous=start.previous,
    )


@_solve.defjvp
def _solve_jvp(memory: int, is_corrected: bool, primals: tuple, tangents: tuple) -> tuple[Solved, Any]:
    """Solve to rest, and move the minimum by one linear system.

    A tolerance of 1 % of the gap is enough for motion, and far too little for a derivative: there the Hessian is
    still indefinite. So the frames of a derivative are solved on, to the force that rounding raises: positions
    that are off by the spacing of their numbers strain their edges. In float32, at 1k vertices, that is 0.008
    weights, and 0.002 are left at best.
    """
    problem, start, (iterations, _) = primals
    spacing = jnp.finfo(start.position.dtype).eps * jnp.max(jnp.abs(start.position))
    rounding = spacing * safe_norm(hessian_diagonal(problem, start.position))
    stop = Stop(jnp.maximum(iterations, _MOST_ITERATIONS), 0.0, start.inertial_energy, rounding)
    minimum = _minimum(problem, start, stop, memory)
    is_refused = safe_norm(minimum.gradient.reshape(-1)) > _REFUSED * weight_norm(problem)
    position, is_refused = checkpoint_name((minimum.position, is_refused), SOLUTION)
    status = jnp.where(is_refused, jnp.int32(Status.DERIVATIVE_REFUSED), jnp.int32(Status.OK))
    minimum = minimum._replace(position=position, status=status)

    def at_minimum(problem: FrameProblem) -> tuple[Array, Array]:
        return jax.value_and_grad(potential)(position, problem)

    _, (value_change, force_change) = jax.jvp(at_minimum, (problem,), tangents[:1])
    move = -_solve_hessian_linear(problem, position, force_change)
    move = jnp.where(is_refused, jnp.nan, 1.0) * move
    value_change = value_change + jnp.sum(minimum.gradient * move)
    data = jax.tree.map(jnp.asarray, problem.data)
    if is_corrected:
        ended, data = jax.lax.stop_gradient(corrected(position, problem))
        minimum = minimum._replace(position=ended)
    solved = Solved(minimum, data)
    still = zero_from_primal(solved)
    return solved, still._replace(minimum=still.minimum._replace(position=move, value=value_change))


def _solve_hessian_linear(
    problem: FrameProblem, position: Float[Array, "vertices 3"], force: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Return H^-1 force, linear in the force; NaN where the system stalls."""
    problem = jax.lax.stop_gradient(problem)
    matrix = tangent.tangent(problem, position)

    def solved(_, force: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        found = solve_hessian(problem, position, force, matrix)
        return jnp.where(found.residual < _LINEAR_STALL, found.displacement, jnp.nan)

    apply = partial(tangent.apply, matrix)
    return jax.lax.custom_linear_solve(lambda move: apply(move.T).T, force, solved, symmetric=True)


def solve_hessian(
    problem: FrameProblem,
    position: Float[Array, "vertices 3"],
    force: Float[Array, "vertices 3"],
    matrix: tangent.Tangent | None = None,
) -> LinearSolution:
    """Solve H v = force [N] by MINRES, preconditioned by the blocks on the diagonal of H.

    The Hessian is that at positions [m], shape [vertices, 3], of a minimum of the potential; or `matrix`, if
    known.
    """
    matrix = tangent.tangent(problem, position) if matrix is None else matrix
    inverse = tangent.inverse_diagonal(matrix, problem, position)
    tolerance, iterations = _LINEAR_STOP[str(force.dtype)]
    found = solve_symmetric(
        partial(tangent.apply, matrix),
        partial(tangent.precondition, inverse),
        force.T,
        tolerance=tolerance,
        iterations=iterations,
    )
    return found._replace(displacement=found.displacement.T)
