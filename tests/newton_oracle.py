"""The minimum of one frame's potential by Newton's method, in float64 and with the dense Hessian of autodiff.

It shares the energies with the solver and nothing else: neither precision, nor preconditioner, nor steps.
For small cloth alone: the Hessian of 60 vertices has 180 rows.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import OptimizeResult, minimize

from eslr_jax.solver.guess import pushed_out_guess
from eslr_jax.solver.potential import potential
from eslr_jax.terms.term import FrameProblem, pin, weight_norm
from eslr_jax.types import tree_cast


def minimize_newton(problem: FrameProblem, *, tolerance: float = 1e-6) -> OptimizeResult:
    """Minimise the potential of a frame, from the guess whose energy the initial gap counts from.

    Returns:
        The positions `x` [m], shape [vertices, 3], their potential `fun` [J], and the iterations `nit`.

    Raises:
        RuntimeError: The force norm is not below `tolerance` times the norm of the vertices' weights.
    """
    problem = to_float64(problem)
    with jax.enable_x64(True):
        start, is_free, weight = (np.asarray(part) for part in _begin(problem))

        def places(free: np.ndarray) -> np.ndarray:
            x = start.copy()
            x[is_free] = free
            return x

        def energy(free: np.ndarray) -> tuple[float, np.ndarray]:
            value, gradient = _energy(places(free), problem)
            return float(value), np.asarray(gradient)[is_free]

        def hessian(free: np.ndarray) -> np.ndarray:
            return np.asarray(_hessian(places(free), problem))[np.ix_(is_free.ravel(), is_free.ravel())]

        options = {"gtol": tolerance * float(weight), "initial_trust_radius": 0.01}  # [N], [m]
        found = minimize(
            energy, start[is_free], jac=True, hess=hessian, method="trust-exact", options=options
        )
    if not found.success:
        raise RuntimeError(f"Newton's method stopped: {found.message}")
    return OptimizeResult(found, x=places(found.x))


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
