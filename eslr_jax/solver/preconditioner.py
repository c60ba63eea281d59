"""Estimates of the potential's Hessian that are cheap to invert: a diagonal, and one with springs."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.numerics import Vector3, components
from eslr_jax.terms.term import FrameProblem, Term, free_vertices

_TERMS = 4  # of the Chebyshev series; more measured no better per second (experiments/tried.md)
_REACH = 0.9  # share of every spring that is inverted; one is exact and needs many terms
# Share of its stiffness at rest that a spring keeps where its edge has collapsed, to under a third of its length.
# Without it, the energy of cloth that starts flat on a line rises by 0.5 % of its drop (hard case `bad_start`).
_LEAST_SPRING = 0.1


@struct.dataclass
class Stiffness:
    """A matrix that stands for the Hessian: springs between neighbours, alike along every axis."""

    diagonal: Float[Array, " vertices"]  # [N/m], no smaller than the sum of the row's springs
    neighbors: Int[Array, "vertices degree"]  # padded with the vertex itself
    springs: Float[Array, "vertices degree"]  # [N/m], the same both ways; zero where padded or pinned


def hessian_diagonal(
    problem: FrameProblem, position: Float[Array, "vertices 3"]
) -> Float[Array, " vertices"]:
    """Return the sum of the terms' stiffness per vertex [N/m] at positions [m]; one where padded."""
    return jnp.where(problem.garment.vertex_mask, sum_diagonals(problem, position), 1.0)


def sum_diagonals(
    problem: FrameProblem,
    position: Float[Array, "vertices 3"],
    is_counted: Callable[[Term], bool] = lambda term: True,
) -> Float[Array, " vertices"]:
    """Return the sum of the curvatures per vertex [N/m] that some of the terms estimate at positions [m]."""
    x = components(position)
    diagonals = (term.diagonal(x, problem, data) for term, data in problem.parts if is_counted(term))
    return sum(diagonals, jnp.zeros_like(x[0]))


def stiffness(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Stiffness:
    """Return the diagonal at `position` with the springs that share out its membrane part.

    Every edge gets the smaller of what its two ends can give, so the matrix is symmetric and diagonally
    dominant. A cotangent Laplacian measured no better, and can lose definiteness on obtuse triangles. Contact and
    friction are linearised at `position` [m].
    """
    garment = problem.garment
    degree = jnp.maximum(jnp.sum(garment.neighbor_mask, axis=1, dtype=garment.rest_areas.dtype), 1)
    elastic = sum_diagonals(problem, position, lambda term: term.is_elastic)
    share = jnp.where(free_vertices(problem), elastic / degree, 0.0)
    springs = jnp.minimum(share[:, None], share[garment.neighbors])
    return Stiffness(
        diagonal=hessian_diagonal(problem, position),
        neighbors=garment.neighbors,
        springs=jnp.where(garment.neighbor_mask, springs, 0.0),
    )


def stretched_stiffness(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Stiffness:
    """Return the stiffness that the solver starts from: springs as they are stretched at `position`.

    A spring of the St. Venant-Kirchhoff membrane stiffens with the square of its stretch. The diagonal changes by
    the sum of the changes of a vertex's springs, and no more: with a larger diagonal long waves converge slowly
    (experiments/tried.md). Networks take `stiffness`, which they were trained with.
    """
    matrix = stiffness(problem, position)
    squared, rest = (
        _squared_lengths(points, matrix.neighbors) for points in (position, problem.garment.sewn_positions)
    )
    is_spring = matrix.springs > 0
    stretched = jnp.where(is_spring, squared, 0.0) / jnp.where(is_spring, rest, 1.0)
    springs = matrix.springs * jnp.maximum(stretched, _LEAST_SPRING)
    added = jnp.sum(springs - matrix.springs, axis=1)
    return matrix.replace(springs=springs, diagonal=matrix.diagonal + added)


def _squared_lengths(
    points: Float[Array, "vertices 3"], neighbors: Int[Array, "vertices degree"]
) -> Float[Array, "vertices degree"]:
    return sum((part[neighbors] - part[:, None]) ** 2 for part in points.T)  # type: ignore[return-value]


def solve_stiffness(matrix: Stiffness, force: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return displacements [m] that nearly balance a force [N]; see `stiffness_inverse`."""
    return stiffness_inverse(matrix)(force)


def stiffness_inverse(
    matrix: Stiffness,
) -> Callable[[Float[Array, "vertices 3"]], Float[Array, "vertices 3"]]:
    """Return a map from forces [N] to displacements [m] that nearly balance them, a polynomial in D^-1 W.

    Four terms of the Chebyshev semi-iteration on D - reach W, with diagonal D and springs W. The eigenvalues
    of D^-1 W lie in [-1, 1], so the polynomial is positive: the map is linear, symmetric and positive
    definite, as L-BFGS needs. Outside a loop, its coefficients are computed once.

    Source: Golub and Varga 1961, doi 10.1007/BF01386013.
    """
    inverse_diagonal = 1.0 / matrix.diagonal
    weights = (_REACH * inverse_diagonal[:, None] * matrix.springs).T
    neighbors = matrix.neighbors.T
    factors = jnp.asarray(_chebyshev_factors(), matrix.diagonal.dtype)

    def smooth(x: Array) -> Array:
        return sum(weight * x[neighbor] for weight, neighbor in zip(weights, neighbors, strict=True))  # type: ignore[return-value]

    def add_term(term: Array, carry: tuple[Vector3, Vector3, Vector3]):
        update, total, residual = (list(part) for part in carry)
        for axis in range(3):
            residual[axis] = residual[axis] - update[axis] + smooth(update[axis])
            update[axis] = factors[term, 0] * update[axis] + factors[term, 1] * residual[axis]
            total[axis] = total[axis] + update[axis]
        return tuple(update), tuple(total), tuple(residual)

    def solve(force: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        first = components(inverse_diagonal[:, None] * force)
        # A loop, although its length is fixed: unrolled, XLA computes a term anew for each of its neighbours.
        _, total, _ = jax.lax.fori_loop(0, _TERMS - 1, add_term, (first, first, first))
        return jnp.stack(total, axis=-1)

    return solve


def _chebyshev_factors() -> np.ndarray:
    """Return what each term keeps of the last update, and its share of the residual."""
    factors, ratio = [], _REACH
    for _ in range(_TERMS - 1):
        next_ratio = 1.0 / (2.0 / _REACH - ratio)
        factors.append((next_ratio * ratio, 2.0 * next_ratio / _REACH))
        ratio = next_ratio
    return np.array(factors)
