"""The minimum of one frame's potential by Newton's method, in float64 and with the dense Hessian of autodiff.

It shares the energies with the solver and nothing else: neither precision, nor preconditioner, nor line search.
For small cloth alone: the Hessian of 60 vertices has 180 rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.solver.guess import pushed_out_guess
from eslr_jax.solver.potential import potential
from eslr_jax.terms.problem import FrameProblem, pin, weight_norm
from eslr_jax.types import tree_cast

_ARMIJO = 1e-4  # sufficient decrease (Nocedal and Wright 2006, section 3.1)
_FLATTEST = 1e-9  # least curvature, as a share of the largest


class NewtonMinimum(NamedTuple):
    """Where Newton's method stopped."""

    position: np.ndarray  # [m], shape [vertices, 3]
    value: float  # [J]
    residual: float  # force norm over weight
    iterations: int


def minimize_newton(
    problem: FrameProblem, *, tolerance: float = 1e-6, max_iterations: int = 100
) -> NewtonMinimum:
    """Minimise the potential of a frame, from the guess whose energy the initial gap counts from.

    Where the potential is not convex, the curvature counts by its size: the step goes down there too.

    Raises:
        RuntimeError: The force norm is not below `tolerance` times the norm of the vertices' weights.
    """
    problem = to_float64(problem)
    with jax.enable_x64(True):
        x, free, weight = (np.asarray(part) for part in _begin(problem))
        for iteration in range(max_iterations + 1):
            value, gradient = _energy(x, problem)
            slope = np.where(free, gradient, 0.0)
            residual = float(np.linalg.norm(slope) / weight)
            if residual <= tolerance:
                return NewtonMinimum(x, float(value), residual, iteration)
            size, axes = np.linalg.eigh(_hessian(x, problem)[np.ix_(free.ravel(), free.ravel())])
            step = np.zeros_like(x)
            size = np.maximum(np.abs(size), _FLATTEST * size[-1])
            step[free] = -axes @ ((axes.T @ slope[free]) / size)
            x = _line_search(x, step, float(value), float(np.sum(slope * step)), problem)
    raise RuntimeError(f"Newton's method left a residual of {residual:g} weights")


def potential_float64(position: Any, problem: FrameProblem) -> float:
    """Return the potential at positions [m], shape [vertices, 3], in float64 [J]."""
    with jax.enable_x64(True):
        return float(_energy(np.asarray(position, np.float64), to_float64(problem))[0])


def to_float64(tree: Any) -> Any:
    """Return a pytree with NumPy leaves, the floating ones in float64."""
    with jax.enable_x64(True):
        return tree_cast(jax.tree.map(np.asarray, tree), np.float64)


_energy = jax.jit(jax.value_and_grad(potential))


@jax.jit
def _begin(problem: FrameProblem) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return where to begin [m], which coordinates may move, and the norm of the weights [N]."""
    free = problem.garment.vertex_mask
    if problem.pin_targets is not None:
        free = free & ~problem.garment.is_pinned
    start = pin(problem, pushed_out_guess(problem))
    return start, jnp.broadcast_to(free[:, None], start.shape), weight_norm(problem)


@jax.jit
def _hessian(position: jax.Array, problem: FrameProblem) -> jax.Array:
    """Return the potential's second derivatives [N/m], rows by vertex, then axis."""
    _, product = jax.linearize(lambda x: jax.grad(potential)(x, problem), position)
    moves = jnp.eye(position.size).reshape(-1, *position.shape)
    return jax.lax.map(product, moves).reshape(position.size, position.size)


def _line_search(x: np.ndarray, step: np.ndarray, value: float, slope: float, problem: FrameProblem):
    """Halve the step until the energy falls enough, or by nothing that float64 shows."""
    slack = 4 * np.finfo(np.float64).eps * abs(value)
    for size in 0.5 ** np.arange(40):
        if _energy(x + size * step, problem)[0] <= value + _ARMIJO * size * slope + slack:
            return x + size * step
    raise RuntimeError("no step along Newton's direction lowers the energy")
