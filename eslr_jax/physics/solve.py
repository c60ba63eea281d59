"""One frame, solved: from a starting point to the minimum of its potential, and how the minimum moves.

The minimum x* of the potential P(x, theta) is a function of everything the problem holds. Differentiating
grad P(x*, theta) = 0 gives dx*/dtheta = -H^-1 d(grad P)/dtheta with the Hessian H = d^2 P / dx^2. So a derivative
costs one linear system, whatever the solver did on its way, and the starting point drops out. It is exact at the
minimum; where the solver stops early it is off in the order of the gradient that was left.

Source: Griewank and Walther 2008, Evaluating Derivatives, section 15 (implicit functions).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.physics.guess import InitialGuess
from eslr_jax.physics.lbfgs import Minimum, Stop, minimize
from eslr_jax.physics.potential import Point, evaluate, potential
from eslr_jax.physics.preconditioner import stiffness, stiffness_inverse
from eslr_jax.physics.problem import FrameProblem

SOLUTION = "solution"  # what checkpointing keeps of a frame, so that it is not solved twice
_LINEAR_TOLERANCE = {"float32": 1e-4, "float64": 1e-9}  # of the linear system, relative to its right side
_LINEAR_STALL = 1e-2  # likewise, above which the derivative is refused
_LINEAR_ITERATIONS = 1000


class Start(NamedTuple):
    """Where the solver begins a frame."""

    point: Point
    inertial_energy: Float[Array, ""]  # [J], see `InitialGuess`
    previous: Point | None = None  # from which a network came to `point`; None for the solver's own guess


class LinearSolution(NamedTuple):
    """What conjugate gradients made of H v = b."""

    displacement: Float[Array, "vertices 3"]  # v [m]
    residual: Float[Array, ""]  # relative to b, in the preconditioner's norm
    iterations: Int[Array, ""]
    is_indefinite: Bool[Array, ""]  # a direction of negative curvature was met: `position` is no minimum


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
    """Minimise the frame's potential by L-BFGS; differentiable by every real number in `problem`.

    Forward and reverse mode solve one linear system (see the module). Where it stalls, the derivative is NaN
    rather than wrong; `solve_hessian` tells why. `gradient` and `iterations` of the result have no derivative.

    Args:
        problem: The frame's problem.
        start: Where to begin; it has no influence on the minimum, and its derivative is zero.
        iterations: Upper bound of iterations; may be traced.
        tolerance: Share of the initial gap that may be left, see `SimConfig.tolerance`.
        memory: Number of pairs that L-BFGS keeps; static.

    Raises:
        ConfigError: The number of iterations is not an integer, as where somebody differentiates by it.
    """
    iterations = jnp.asarray(iterations)
    if not jnp.issubdtype(iterations.dtype, jnp.integer):
        raise ConfigError(f"iterations are {iterations.dtype}; give a whole number, which has no derivative")
    return _solve(problem, jax.lax.stop_gradient(start), iterations, (tolerance, memory))


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _solve(
    problem: FrameProblem, start: Start, iterations: Int[Array, ""], settings: tuple[float, int]
) -> Minimum:
    tolerance, memory = settings
    return minimize(
        lambda position: potential(position, problem),
        start.point,
        stiffness(problem, start.point.position),
        Stop(iterations, tolerance, start.inertial_energy),
        memory=memory,
        previous=start.previous,
    )


@_solve.defjvp
def _solve_jvp(settings: tuple[float, int], primals: tuple, tangents: tuple) -> tuple[Minimum, Any]:
    problem, start, iterations = primals
    minimum = _solve(problem, start, iterations, settings)
    position = checkpoint_name(minimum.position, SOLUTION)
    minimum = minimum._replace(position=position)

    def at_minimum(problem: FrameProblem) -> tuple[Array, Array]:
        return jax.value_and_grad(potential)(position, problem)

    _, (value_change, force_change) = jax.jvp(at_minimum, (problem,), tangents[:1])
    move = -_solve_hessian_linear(problem, position, force_change)
    value_change = value_change + jnp.sum(minimum.gradient * move)
    fixed = np.zeros((), jax.dtypes.float0)
    return minimum, Minimum(move, value_change, jnp.zeros_like(minimum.gradient), fixed)  # type: ignore[arg-type]


def _solve_hessian_linear(
    problem: FrameProblem, position: Float[Array, "vertices 3"], force: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Return H^-1 force, linear in the force; NaN where the system stalls."""

    def solved(_, force: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        found = solve_hessian(problem, position, force)
        return jnp.where(found.residual < _LINEAR_STALL, found.displacement, jnp.nan)

    problem = jax.lax.stop_gradient(problem)
    apply = _hessian(problem, position)
    return jax.lax.custom_linear_solve(apply, force, solved, symmetric=True)


def _hessian(problem: FrameProblem, position: Float[Array, "vertices 3"]):
    """Return the product with the Hessian [N/m]; vertices that don't move stand for themselves."""
    is_free = problem.garment.vertex_mask
    if problem.pin_targets is not None:
        is_free = is_free & ~problem.garment.is_pinned
    is_free = is_free[:, None]
    _, product = jax.linearize(lambda x: jax.grad(potential)(x, problem), position)

    def apply(move: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        return jnp.where(is_free, product(jnp.where(is_free, move, 0.0)), move)

    return apply


def solve_hessian(
    problem: FrameProblem, position: Float[Array, "vertices 3"], force: Float[Array, "vertices 3"]
) -> LinearSolution:
    """Solve H v = force by conjugate gradients, preconditioned by springs.

    Args:
        problem: The frame's problem.
        position: Where the Hessian is taken [m], shape [vertices, 3]; a minimum of the potential.
        force: Right side [N], shape [vertices, 3].

    Source: Nocedal and Wright 2006, algorithm 5.3.
    """
    apply = _hessian(problem, position)
    precondition = stiffness_inverse(stiffness(problem, position))
    tolerance = _LINEAR_TOLERANCE[str(force.dtype)]

    def is_running(state):
        _, _, _, energy, iterations, _ = state
        return (energy > tolerance**2 * whole) & (iterations < _LINEAR_ITERATIONS)

    def iterate(state):
        move, residual, direction, energy, iterations, is_indefinite = state
        product = apply(direction)
        curvature = jnp.vdot(direction, product)
        is_flat = curvature == 0
        size = jnp.where(is_flat, 0.0, energy / jnp.where(is_flat, 1.0, curvature))
        move, residual = move + size * direction, residual - size * product
        smoothed = precondition(residual)
        after = jnp.vdot(residual, smoothed)
        direction = smoothed + after / jnp.where(energy > 0, energy, 1.0) * direction
        return move, residual, direction, after, iterations + 1, is_indefinite | (curvature < 0)

    first = precondition(force)
    whole = jnp.vdot(force, first)
    state = (jnp.zeros_like(force), force, first, whole, jnp.int32(0), jnp.zeros((), bool))
    move, _, _, energy, iterations, is_indefinite = jax.lax.while_loop(is_running, iterate, state)
    residual = jnp.sqrt(jnp.maximum(energy, 0.0) / jnp.where(whole > 0, whole, 1.0))
    return LinearSolution(move, residual, iterations, is_indefinite)
